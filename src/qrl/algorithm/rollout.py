"""Step many lanes of a Brax environment under a policy, with a fresh start for every episode.

Brax's AutoResetWrapper restarts a lane from that lane's own first state and loses the final observation; here every
episode gets a new draw, and the observation before reset is recorded.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import threefry_2x32

from qrl.algorithm import replay_buffer
from qrl.algorithm.carried import Carried, Carry, lanes_first, lanes_last
from qrl.algorithm.networks import log_density
from qrl.algorithm.replay_buffer import ReplayBuffer
from qrl.algorithm.types import State, TaskEnv, Transition, info_flag
from qrl_envs.fusion import stored

TRUNCATIONS = "truncated", "truncation", "out_of_bounds"  # of an environment's `info`
# Fields of a `Transition`: with a vector a lane and step, and without time axis; the others have a number.
WIDE, UNTIMED = ("observation", "action"), ("final_observation", "memory")
BLOCK_LANES = 512  # most lanes stepped at a time on a CPU: with more, what passes between steps leaves its cache


class Lanes(NamedTuple):
    """The environments between unrolls; leading axis N everywhere.

    All that is drawn for a lane follows from keys that all lanes share, the lane's id and its reset count. So results
    do not depend on which lanes are stepped together, or on which device.
    """

    lane_id: chex.Array  # [N] int32 among all lanes of the run
    state: Any  # a State; where no later step depends on a leaf, it may be that of an earlier step
    steps: chex.Array  # [N] int32 into the episode
    done: chex.Array  # [N] bool: the episode is over; the lane restarts before its next step
    next_state: Any  # a State likewise: each lane's next start
    reset_count: chex.Array  # [N] int32: which of its starts that is
    next_state_used: chex.Array  # [N] bool
    num_early: chex.Array  # [N] int32: episodes so far that ended before their last step
    memory: Any = ()  # [N, H] the policy's; () for none


class UnrollCarry(NamedTuple):
    """The lanes between two steps of an unroll; leading axis N, but in what is carried of states."""

    lanes: Lanes  # `state` and `next_state` are a `Carry` each
    truncated: chex.Array  # [N] bool: the last step of this unroll ended an episode that is bootstrapped
    found: chex.Array  # [N] bool: an earlier one did
    final_observation: chex.Array  # [N, F] after the first that did


def _first_truncation(now: UnrollCarry) -> chex.Array:
    """The lanes [N] whose last step was the first of this unroll to end an episode that is bootstrapped."""
    return now.lanes.done & now.truncated & ~now.found


def _record_final(now: UnrollCarry) -> UnrollCarry:
    first = _first_truncation(now)
    final = jnp.where(first[:, None], now.lanes.state.observation, now.final_observation)
    return now._replace(found=now.found | first, final_observation=final)


def init(
    env: TaskEnv,
    key: chex.PRNGKey,
    lane_id: chex.Array,
    num_lanes: int,
    max_episode_steps: int,
    unroll_length: int,
    memory: Any = (),
) -> Lanes:
    """The lanes `lane_id` [N] of a run's `num_lanes`, at their first starts, with the policy's initial `memory`.

    They are staggered by multiples of an unroll, so that episodes do not end together.
    """
    none = jnp.zeros(lane_id.shape, bool)
    count = jnp.zeros(lane_id.shape, jnp.int32)
    state = jax.vmap(env.reset)(_start_keys(key, lane_id, count))
    steps = lane_id * (max_episode_steps // unroll_length) // num_lanes * unroll_length
    return Lanes(lane_id, state, steps.astype(jnp.int32), none, state, count, ~none, count, memory)


def _start_keys(key: chex.PRNGKey, lane_id: chex.Array, reset_count: chex.Array) -> chex.PRNGKey:
    return jax.vmap(lambda n, s: jax.random.fold_in(jax.random.fold_in(key, n), s))(lane_id, reset_count)


class Steps:
    """The steps and restarts of a batch of lanes, whose states are carried (`carried.Carried`)."""

    def __init__(self, env: TaskEnv, lanes: Lanes) -> None:
        """Of lanes [n, ...]; only their shapes are read. Raises ValueError for a step or restart whose states have
        another structure.
        """
        self._env = env
        states = jax.tree.map(lambda x: jax.ShapeDtypeStruct((*x.shape[1:], x.shape[0]), x.dtype), lanes.state)
        action = jax.ShapeDtypeStruct((env.action_size, *lanes.done.shape), jnp.float32)
        key = jax.random.PRNGKey(0)
        self._carried = Carried(env.step_lanes, states, action, _results, restart=lambda state: env.restart(state, key))

    def pack(self, lanes: Lanes) -> Lanes:
        """Lanes with what is carried of their states."""
        state, next_state = (self._carried.pack(lanes_last(each)) for each in (lanes.state, lanes.next_state))
        return lanes._replace(state=state, next_state=next_state)

    def unpack(self, lanes: Lanes, before: Lanes) -> Lanes:
        """Lanes with complete states; what is not carried of them is that of the lanes `before`."""
        state, next_state = (
            lanes_first(self._carried.unpack(carry, lanes_last(constant)))
            for carry, constant in ((lanes.state, before.state), (lanes.next_state, before.next_state))
        )
        return lanes._replace(state=state, next_state=next_state)

    def restart(self, lanes: Lanes, constant: State, key: chex.PRNGKey) -> Lanes:
        """Put lanes whose episode is over at their next start, with a memory of zeros; the others stay as they are.

        Starts are drawn for all lanes at once, and only when some lane has used its own: drawn at every step they
        would cost many times the physics. A lane that has not gets the same start again.
        """

        def draw(lanes: Lanes) -> Lanes:
            reset_count = lanes.reset_count + lanes.next_state_used
            states = self._carried.unpack(lanes.state, constant)
            keys = _start_keys(key, lanes.lane_id, reset_count)
            starts = jax.vmap(self._env.restart, in_axes=(-1, 0), out_axes=-1)(states, keys)
            # Stored, or XLA would lay starts out lane by lane, and transpose them at every step.
            next_state = stored(self._carried.pack(starts))
            unused = jnp.zeros_like(lanes.next_state_used)
            return lanes._replace(next_state=next_state, reset_count=reset_count, next_state_used=unused)

        lanes = _at_most_once(lambda now: _any(now.done & now.next_state_used), draw, lanes, cheap=False)
        return lanes._replace(
            state=_chosen(lanes.done, lanes.next_state, lanes.state),
            steps=jnp.where(lanes.done, 0, lanes.steps),
            done=jnp.zeros_like(lanes.done),
            next_state_used=lanes.next_state_used | lanes.done,
            memory=jax.tree.map(lambda x: jnp.where(lanes.done[:, None], 0.0, x), lanes.memory),
        )

    def step(self, carry: Carry, constant: State, action: chex.Array) -> tuple[Carry, State]:
        """What is carried after a step under the actions [n, A], clipped to [−1, 1]; and the states, lanes last."""
        states = self._carried.unpack(carry, constant)
        after = self._env.step_lanes(states, stored(jnp.clip(action, -1.0, 1.0).T))
        return self._carried.follow(carry, after), after


@jax.custom_batching.custom_vmap
def _any(lanes: chex.Array) -> chex.Array:
    """Whether any of the lanes [n] is chosen, of any member where members are vmapped: by predicates of their own a
    condition would run both branches, always. It may ask only for what changes nothing where no lane is chosen.
    """
    return jnp.any(lanes)


@_any.def_vmap
def _any_of_members(axis_size: int, in_batched: Any, lanes: chex.Array) -> tuple[chex.Array, bool]:
    del axis_size, in_batched
    return jnp.any(lanes), False


def _chosen(chosen: chex.Array, carry: Carry, other: Carry) -> Carry:
    """`carry` in the lanes `chosen` [n], else `other`."""
    observation = _chosen_rows(chosen[:, None], carry.observation, other.observation)
    rest = jax.tree.map(
        lambda x, y: jnp.where(chosen, x, y), carry._replace(observation=()), other._replace(observation=())
    )
    return rest._replace(observation=observation)


def _chosen_rows(chosen: chex.Array, x: chex.Array, other: chex.Array) -> chex.Array:
    """`x` [n, F] where `chosen` [n, 1], else `other`; floats by their bits, since LLVM compiles a selection over so
    short a row to a load for each number.
    """
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.where(chosen, x, other)
    unsigned = jnp.dtype(f"uint{8 * x.dtype.itemsize}")
    mask = jnp.where(chosen, ~unsigned.type(0), unsigned.type(0))
    bits, others = (jax.lax.bitcast_convert_type(each, unsigned) for each in (x, other))
    return jax.lax.bitcast_convert_type(bits & mask | others & ~mask, x.dtype)


def _results(state: State) -> Any:
    """What `_step` takes of the states that a step gives."""
    return state.obs, state.reward, state.done, [state.info.get(name) for name in TRUNCATIONS]


def _at_most_once(needed: Callable[[Any], chex.Array], act: Callable[[Any], Any], values: Any, cheap: bool) -> Any:
    """act(values) where `needed`(values), else the values themselves.

    On a CPU a loop, which takes its values in place where the branches of a condition copy them. A GPU reads a
    predicate back to the host: there what is `cheap`, and changes nothing where it is not needed, is done each time.
    """
    if jax.default_backend() == "cpu":
        first = needed(values), values
        return jax.lax.while_loop(lambda now: now[0], lambda now: (jnp.zeros_like(now[0]), act(now[1])), first)[1]
    return act(values) if cheap else jax.lax.cond(needed(values), act, lambda now: now, values)


Policy = Callable[[Any, chex.Array], tuple[Any, chex.Array]]  # (memory, observation) -> next memory and mean


def _step(
    steps: Steps,
    policy: Policy,
    sigma: chex.Array,
    start_key: chex.PRNGKey,
    max_episode_steps: int,
    constant: State,
    now: UnrollCarry,
    noise: chex.Array,
) -> tuple[UnrollCarry, Transition]:
    """One step of the lanes [n] with the noise [n, A], after the restart of those whose episode is over; its
    transitions [n, ...], without final observations and memory. `constant` has what is not carried of the states.
    """

    def restart_done_lanes(now: UnrollCarry) -> UnrollCarry:
        found = _at_most_once(lambda now: _any(_first_truncation(now)), _record_final, now, cheap=True)
        return found._replace(lanes=steps.restart(now.lanes, constant, start_key))

    now = _at_most_once(lambda now: _any(now.lanes.done), restart_done_lanes, now, cheap=True)
    lanes = now.lanes
    observation = lanes.state.observation
    memory, center = policy(lanes.memory, observation)
    action = center + sigma * noise
    carry, state = steps.step(lanes.state, constant, action)
    age = lanes.steps + 1
    # What an environment gives as a constant has no lanes.
    ended = jnp.broadcast_to(state.done.astype(bool), age.shape)
    out_of_bounds = ended & info_flag(state, "out_of_bounds")
    truncated = ended & functools.reduce(jnp.logical_or, [info_flag(state, name) for name in TRUNCATIONS])
    terminated = ended & ~truncated
    done = ended | (age >= max_episode_steps)
    transition = Transition(
        observation=observation,
        action=action,
        log_mu=log_density(action, center, sigma),
        reward=jnp.broadcast_to(state.reward, age.shape),
        terminated=terminated.astype(jnp.float32),
        truncated=(done & ~terminated).astype(jnp.float32),
        out_of_bounds=out_of_bounds.astype(jnp.float32),
        final_observation=(),
    )
    num_early = lanes.num_early + (ended & (age < max_episode_steps))
    after = lanes._replace(state=carry, steps=age, done=done, num_early=num_early, memory=memory)
    return now._replace(lanes=after, truncated=done & ~terminated & ~out_of_bounds), transition


def unroll(
    env: TaskEnv,
    lanes: Lanes,
    buffer: ReplayBuffer,
    policy: Policy,
    sigma: chex.Array,
    noise_key: chex.PRNGKey,
    start_key: chex.PRNGKey,
    *,
    max_episode_steps: int,
) -> tuple[Lanes, ReplayBuffer]:
    """T steps of every lane under mu = N(mean, sigma²·I), where policy(memory, observation) gives the next memory and
    the mean; its transitions are written into the next slot of `buffer`, whose data are a `Transition`.

    The environment gets the action clipped to [−1, 1]; the transition keeps it as drawn. An episode's last step is
    `truncated` where it reached `max_episode_steps` or where the environment's `info` says so ("truncation",
    "truncated", "out_of_bounds"), else `terminated`. `noise_key` is this unroll's own; `start_key` is that of `init`.
    """
    count = lanes.lane_id.shape[0]
    num_blocks = _num_blocks(count)
    size = count // num_blocks
    blocks = jax.tree.map(lambda x: x.reshape(num_blocks, size, *x.shape[1:]), lanes)
    slot, unroll_length = replay_buffer.slot(buffer), buffer.data.reward.shape[2]
    steps = Steps(env, jax.tree.map(lambda x: x[0], blocks) if num_blocks > 1 else lanes)

    def unroll_block(data: Transition, block: tuple[chex.Array, Lanes]) -> tuple[Transition, Lanes]:
        """T steps of the lanes of one block [n]."""
        first_lane, lanes = block
        write = functools.partial(replay_buffer.write, slot=slot, lane=first_lane)
        constant = lanes_last(lanes.state)
        # Zeros in a lane that is about to restart.
        memory = jax.tree.map(lambda x: jnp.where(lanes.done[:, None], 0.0, x), lanes.memory)

        def write_step(carry: tuple[UnrollCarry, Any], at: tuple[chex.Array, chex.Array]) -> tuple[Any, Any]:
            (now, wide), (t, noise) = carry, at
            now, transition = _step(steps, policy, sigma, start_key, max_episode_steps, constant, now, noise)
            wide = jax.tree.map(functools.partial(write, step=t), wide, _wide(transition))
            return (now, wide), _narrow(transition)

        noise = normal(noise_key, lanes.lane_id, unroll_length, env.action_size)
        none, packed = jnp.zeros_like(lanes.done), steps.pack(lanes)
        final = jnp.zeros_like(packed.state.observation)
        now = UnrollCarry(packed, truncated=none, found=none, final_observation=final)
        (last, wide), narrow = jax.lax.scan(write_step, (now, _wide(data)), (jnp.arange(unroll_length), noise))
        bootstrapped = last.truncated | ~last.lanes.done
        at_end = jnp.where(bootstrapped[:, None], last.lanes.state.observation, 0.0)
        ends = jnp.stack([last.final_observation, at_end], axis=1), memory
        final, memory = jax.tree.map(write, (data.final_observation, data.memory), ends)
        narrow = jax.tree.map(lambda old, x: write(old, x.T), _narrow(data), narrow)
        return Transition(**wide, **narrow, final_observation=final, memory=memory), steps.unpack(last.lanes, lanes)

    if num_blocks == 1:  # a loop that is passed once still takes its time to compile
        data, lanes = unroll_block(buffer.data, (jnp.int32(0), lanes))
    else:
        data, blocks = jax.lax.scan(unroll_block, buffer.data, (jnp.arange(num_blocks) * size, blocks))
        lanes = jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), blocks)
    return lanes, ReplayBuffer(data, buffer.inserted + 1)


def _wide(transition: Transition) -> Any:
    """The vectors [n, ...], which are written at each step."""
    return {name: getattr(transition, name) for name in WIDE}


def _narrow(transition: Transition) -> Any:
    """The numbers [n], which are written after the last step: each would take a line of the cache by itself."""
    return {name: x for name, x in transition._asdict().items() if name not in (*WIDE, *UNTIMED)}


def transitions_of(lanes: Lanes, action_size: int, unroll_length: int) -> Transition:
    """Shapes and types of what `unroll` records of lanes like these, without tracing a step."""
    state, count = lanes.state, lanes.done.shape[0]

    def each(*shape: int, dtype: Any = jnp.float32) -> Any:
        return jax.ShapeDtypeStruct((count, *shape), dtype)

    features, seen = state.obs.shape[-1], state.obs.dtype
    flag = each(unroll_length)
    return Transition(
        observation=each(unroll_length, features, dtype=seen),
        action=each(unroll_length, action_size),
        log_mu=each(unroll_length),
        reward=each(unroll_length, dtype=state.reward.dtype),
        terminated=flag,
        truncated=flag,
        out_of_bounds=flag,
        final_observation=each(2, features, dtype=seen),
        memory=jax.tree.map(lambda x: each(*x.shape[1:], dtype=x.dtype), lanes.memory),
    )


def _num_blocks(count: int) -> int:
    """How many blocks `count` lanes are stepped in: on a CPU of at most BLOCK_LANES where their number divides so."""
    block = max(size for size in range(1, BLOCK_LANES + 1) if count % size == 0)
    in_blocks = jax.default_backend() == "cpu" and count > BLOCK_LANES and block >= BLOCK_LANES // 8
    return count // block if in_blocks else 1


def normal(key: chex.PRNGKey, lane_id: chex.Array, steps: int, size: int) -> chex.Array:
    """Standard normal numbers of the lanes `lane_id` [N]: [steps, N, size]; each lane's depend on the key and its id.

    Threefry's counters are the lane and the number's place: a key for each lane, as `fold_in` makes them, takes half as
    long again as the numbers. From bits to a number the steps are those of `jax.random.normal`.
    """
    pairs = -(-steps * size // 2)
    shape = (pairs, len(lane_id))
    lane = jnp.broadcast_to(lane_id.astype(jnp.uint32), shape)
    place = jnp.broadcast_to(jnp.arange(pairs, dtype=jnp.uint32)[:, None], shape)
    counters = jnp.concatenate([lane.reshape(-1), place.reshape(-1)])  # its halves are hashed in pairs
    bits = threefry_2x32(jax.random.bits(key, (2,)), counters).reshape(2 * pairs, -1)[: steps * size]
    least = np.nextafter(np.float32(-1.0), np.float32(0.0))
    mantissa = jax.lax.bitcast_convert_type((bits >> 9) | jnp.uint32(0x3F800000), jnp.float32) - 1.0  # in [0, 1)
    uniform = jnp.maximum(least, mantissa * (1.0 - least) + least)
    return jnp.moveaxis(np.float32(np.sqrt(2.0)) * jax.lax.erf_inv(uniform).reshape(size, steps, -1), 0, -1)

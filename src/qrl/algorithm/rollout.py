"""Step many lanes of a Brax environment under a policy, with a fresh start for every episode.

Brax's AutoResetWrapper restarts a lane from that lane's own first state and loses the final observation; here every
episode gets a new draw, and the observation before reset is recorded.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm.networks import log_density
from qrl.algorithm.types import State, TaskEnv, Transition, info_flag

BLOCK_LANES = 512  # most lanes stepped at a time on a CPU: with more, what passes between steps leaves its cache


class Lanes(NamedTuple):
    """The environments between unrolls; leading axis N everywhere.

    All that is drawn for a lane follows from keys that all lanes share, the lane's id and its reset count. So results
    do not depend on which lanes are stepped together, or on which device.
    """

    lane_id: chex.Array  # [N] int32 among all lanes of the run
    state: State
    steps: chex.Array  # [N] int32 into the episode
    done: chex.Array  # [N] bool: the episode is over; the lane restarts before its next step
    next_state: State  # [N] each lane's next start
    reset_count: chex.Array  # [N] int32: which of its starts that is
    next_state_used: chex.Array  # [N] bool
    num_early: chex.Array  # [N] int32: episodes so far that ended before their last step
    memory: Any = ()  # [N, H] the policy's; () for none


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


def restart(env: TaskEnv, lanes: Lanes, key: chex.PRNGKey) -> Lanes:
    """Put lanes whose episode is over at their next start, with a memory of zeros.

    Starts are drawn for all lanes at once, and only when some lane has used its own: drawn at every step they would
    cost many times the physics. A lane that has not gets the same start again.
    """

    def draw() -> tuple[State, chex.Array, chex.Array]:
        reset_count = lanes.reset_count + lanes.next_state_used
        keys = _start_keys(key, lanes.lane_id, reset_count)
        return jax.vmap(env.restart)(lanes.state, keys), reset_count, jnp.zeros_like(lanes.next_state_used)

    needed = jnp.any(lanes.done & lanes.next_state_used)
    keep = lanes.next_state, lanes.reset_count, lanes.next_state_used
    next_state, reset_count, used = jax.lax.cond(needed, draw, lambda: keep)

    def pick(new: chex.Array, old: chex.Array) -> chex.Array:
        return jnp.where(lanes.done.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return lanes._replace(
        state=jax.tree.map(pick, next_state, lanes.state),
        steps=jnp.where(lanes.done, 0, lanes.steps),
        done=jnp.zeros_like(lanes.done),
        next_state=next_state,
        reset_count=reset_count,
        next_state_used=used | lanes.done,
        memory=jax.tree.map(lambda x: jnp.where(lanes.done[:, None], 0.0, x), lanes.memory),
    )


def unroll(
    env: TaskEnv,
    lanes: Lanes,
    policy: Callable[[Any, chex.Array], tuple[Any, chex.Array]],
    sigma: chex.Array,
    noise_key: chex.PRNGKey,
    start_key: chex.PRNGKey,
    *,
    unroll_length: int,
    max_episode_steps: int,
) -> tuple[Lanes, Transition]:
    """T steps of every lane under mu = N(mean, sigma²·I), where policy(memory, observation) gives the next memory and
    the mean; transitions with leaves [N, T, ...], but for the memory [N, H].

    The environment gets the action clipped to [−1, 1]; the transition keeps it as drawn. An episode's last step is
    `truncated` where it reached `max_episode_steps` or where the environment's `info` says so ("truncation",
    "truncated", "out_of_bounds"), else `terminated`. `noise_key` is this unroll's own; `start_key` is that of `init`.
    """
    noise = jax.vmap(lambda n: jax.random.normal(jax.random.fold_in(noise_key, n), (unroll_length, env.action_size)))

    def step(lanes: Lanes, noise: chex.Array) -> tuple[Lanes, Transition]:
        lanes = restart(env, lanes, start_key)
        observation = lanes.state.obs
        memory, center = policy(lanes.memory, observation)
        action = center + sigma * noise
        state = jax.vmap(env.step)(lanes.state, jnp.clip(action, -1.0, 1.0))
        steps = lanes.steps + 1
        ended = state.done.astype(bool)
        out_of_bounds = info_flag(state, "out_of_bounds")
        truncated = info_flag(state, "truncated") | info_flag(state, "truncation") | out_of_bounds
        terminated = ended & ~truncated
        done = ended | (steps >= max_episode_steps)
        transition = Transition(
            observation=observation,
            action=action,
            log_mu=log_density(action, center, sigma),
            reward=state.reward,
            next_observation=state.obs,
            terminated=terminated.astype(jnp.float32),
            truncated=(done & ~terminated).astype(jnp.float32),
            out_of_bounds=(ended & out_of_bounds).astype(jnp.float32),
        )
        num_early = lanes.num_early + (ended & (steps < max_episode_steps))
        after = lanes._replace(state=state, steps=steps, done=done, num_early=num_early, memory=memory)
        return after, transition

    def unroll_block(lanes: Lanes) -> tuple[Lanes, Transition]:
        # The first step's, which is anew in a lane that is about to restart.
        memory = jax.tree.map(lambda x: jnp.where(lanes.done[:, None], 0.0, x), lanes.memory)
        lanes, transitions = jax.lax.scan(step, lanes, jnp.swapaxes(noise(lanes.lane_id), 0, 1))
        return lanes, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transitions)._replace(memory=memory)

    return _in_blocks(unroll_block, lanes)


def _in_blocks(unroll_block: Callable[[Lanes], tuple[Lanes, Transition]], lanes: Lanes) -> tuple[Lanes, Transition]:
    """`unroll_block` of all lanes, on a CPU in blocks of at most BLOCK_LANES where their number divides so."""
    count = lanes.lane_id.shape[0]
    block = max(size for size in range(1, BLOCK_LANES + 1) if count % size == 0)
    if jax.default_backend() != "cpu" or count <= BLOCK_LANES or block < BLOCK_LANES // 8:
        return unroll_block(lanes)
    blocks = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), lanes)
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), jax.lax.map(unroll_block, blocks))

"""Step many lanes of a Brax environment under a policy, with fresh starts at every episode's end.

Brax's AutoResetWrapper restarts a lane from that lane's own first state and loses the final observation;
here every episode gets a new draw, and the observation before reset is recorded.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm.networks import log_density
from qrl.algorithm.types import Env, State, Transition

BLOCK_LANES = 512  # at most, stepped at a time on a CPU: with more, what passes between the steps leaves its cache


class Lanes(NamedTuple):
    """The environments between unrolls; leading axis N everywhere.

    Whatever is drawn for a lane follows from keys that all lanes share, the lane's number and its count of starts: so
    it does not matter which lanes are stepped side by side, or on which device.
    """

    number: chex.Array  # [N] int32 among all lanes of the run
    state: State
    steps: chex.Array  # [N] int32 into the episode
    ended: chex.Array  # [N] bool: the episode is over; the lane restarts before its next step
    fresh: State  # [N] each lane's next start
    start: chex.Array  # [N] int32: which of its starts that is
    used: chex.Array  # [N] bool: it has been taken
    early: chex.Array  # [N] int32: episodes that ended before their last step, ever


def episode_steps(env: Env, configured: int | None) -> int:
    """The longest episode: as configured, else the task's own, else Brax's customary 1000."""
    return configured or getattr(env, "episode_steps", 1000)


def begin(env: Env, key: chex.PRNGKey, number: chex.Array, lanes: int, longest: int, unroll_length: int) -> Lanes:
    """Those of a run's `lanes` whose numbers are in `number` [N], at their first starts.

    They are staggered by whole unrolls, so that episodes do not end together.
    """
    none = jnp.zeros(number.shape, bool)
    count = jnp.zeros(number.shape, jnp.int32)
    state = jax.vmap(env.reset)(_start_keys(key, number, count))
    steps = number * longest // lanes // unroll_length * unroll_length
    return Lanes(number, state, steps.astype(jnp.int32), none, state, count, ~none, count)


def _start_keys(key: chex.PRNGKey, number: chex.Array, start: chex.Array) -> chex.PRNGKey:
    return jax.vmap(lambda n, s: jax.random.fold_in(jax.random.fold_in(key, n), s))(number, start)


def _restart(env: Env, lanes: Lanes, key: chex.PRNGKey) -> Lanes:
    """Put lanes whose episode is over at their next start.

    Starts are drawn for all lanes at once and only when some lane has used its own up: drawn at every
    step they would cost many times the physics. A lane that has not gets the same start again.
    """
    restart: Callable[[State, chex.PRNGKey], State] = getattr(env, "restart", lambda _, key: env.reset(key))

    def draw() -> tuple[State, chex.Array, chex.Array]:
        start = lanes.start + lanes.used
        keys = _start_keys(key, lanes.number, start)
        return jax.vmap(restart)(lanes.state, keys), start, jnp.zeros_like(lanes.used)

    needed = jnp.any(lanes.ended & lanes.used)
    fresh, start, used = jax.lax.cond(needed, draw, lambda: (lanes.fresh, lanes.start, lanes.used))

    def pick(new: chex.Array, old: chex.Array) -> chex.Array:
        return jnp.where(lanes.ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return lanes._replace(
        state=jax.tree.map(pick, fresh, lanes.state),
        steps=jnp.where(lanes.ended, 0, lanes.steps),
        ended=jnp.zeros_like(lanes.ended),
        fresh=fresh,
        start=start,
        used=used | lanes.ended,
    )


def unroll(
    env: Env,
    lanes: Lanes,
    mean: Callable[[chex.Array], chex.Array],
    sigma: chex.Array,
    key: chex.PRNGKey,
    starts: chex.PRNGKey,
    *,
    unroll_length: int,
    longest: int,
) -> tuple[Lanes, Transition]:
    """T steps of every lane under mu = N(mean(observation), sigma²·I); transitions with leaves [N, T, ...].

    The environment gets the action clipped to [−1, 1]; the transition keeps it as drawn. An episode's last
    step is `terminated` if the environment says done, and `truncated` if it reached `longest` or if the
    environment marks its own end with info["truncated"], or with info["out_of_bounds"] where no transition begins any
    more. The noise follows from `key`, which is this unroll's own; starts from `starts`, which is the key that `begin`
    had.
    """
    noise = jax.vmap(lambda n: jax.random.normal(jax.random.fold_in(key, n), (unroll_length, env.action_size)))

    def step(lanes: Lanes, noise: chex.Array) -> tuple[Lanes, Transition]:
        lanes = _restart(env, lanes, starts)
        observation = lanes.state.obs
        center = mean(observation)
        action = center + sigma * noise
        state = jax.vmap(env.step)(lanes.state, jnp.clip(action, -1.0, 1.0))
        steps = lanes.steps + 1
        done = state.done.astype(bool)
        out_of_bounds = _said(state, "out_of_bounds")
        terminated = done & ~_said(state, "truncated") & ~out_of_bounds
        ended = done | (steps >= longest)
        transition = Transition(
            observation=observation,
            action=action,
            log_mu=log_density(action, center, sigma),
            reward=state.reward,
            next_observation=state.obs,
            terminated=terminated.astype(jnp.float32),
            truncated=(ended & ~terminated).astype(jnp.float32),
            out_of_bounds=(done & out_of_bounds).astype(jnp.float32),
        )
        early = lanes.early + (done & (steps < longest))
        return lanes._replace(state=state, steps=steps, ended=ended, early=early), transition

    def steps_of(lanes: Lanes) -> tuple[Lanes, Transition]:
        lanes, transitions = jax.lax.scan(step, lanes, jnp.swapaxes(noise(lanes.number), 0, 1))
        return lanes, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transitions)

    return _in_blocks(steps_of, lanes)


def _in_blocks(steps_of: Callable[[Lanes], tuple[Lanes, Transition]], lanes: Lanes) -> tuple[Lanes, Transition]:
    """`steps_of` all lanes, on a CPU in blocks of at most BLOCK_LANES where their number divides so."""
    count = lanes.number.shape[0]
    block = max(size for size in range(1, BLOCK_LANES + 1) if count % size == 0)
    if jax.default_backend() != "cpu" or count <= BLOCK_LANES or block < BLOCK_LANES // 8:
        return steps_of(lanes)
    blocks = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), lanes)
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), jax.lax.map(steps_of, blocks))


def _said(state: State, name: str) -> chex.Array:
    """What an environment may say of its state in `info`: bool [N]."""
    return jnp.asarray(state.info.get(name, jnp.zeros_like(state.done))).astype(bool)

"""Step many lanes of a Brax environment under a policy, with fresh starts at every episode's end.

Brax's AutoResetWrapper restarts a lane from that lane's own first state and loses the final observation;
here every episode gets a new draw, and the observation before reset is recorded.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from qrl.networks import log_density
from qrl.types import Transition


class Lanes(NamedTuple):
    """The environments between unrolls; leading axis N everywhere."""

    state: State
    steps: chex.Array  # [N] int32 into the episode
    ended: chex.Array  # [N] bool: the episode is over; the lane restarts before its next step
    fresh: State  # [N] each lane's next start
    used: chex.Array  # [N] bool: that start has been taken
    early: chex.Array  # [N] int32: episodes that ended before their last step, ever


def episode_steps(env: Env, configured: int | None) -> int:
    """The longest episode: as configured, else the task's own, else Brax's customary 1000."""
    return configured or getattr(env, "episode_steps", 1000)


def begin(env: Env, key: chex.PRNGKey, lanes: int, longest: int, unroll_steps: int) -> Lanes:
    """N lanes at fresh starts, staggered by whole unrolls so that their episodes do not end together."""
    state = jax.vmap(env.reset)(jax.random.split(key, lanes))
    steps = jnp.arange(lanes) * longest // lanes // unroll_steps * unroll_steps
    none = jnp.zeros(lanes, bool)
    return Lanes(state, steps.astype(jnp.int32), none, state, ~none, jnp.zeros(lanes, jnp.int32))


def _restart(env: Env, lanes: Lanes, key: chex.PRNGKey) -> Lanes:
    """Put lanes whose episode is over at their next start.

    Starts are drawn for all lanes at once and only when some lane has used its own up: drawn at every
    step they would cost many times the physics.
    """
    restart: Callable[[State, chex.PRNGKey], State] = getattr(env, "restart", lambda _, key: env.reset(key))

    def draw() -> tuple[State, chex.Array]:
        keys = jax.random.split(key, lanes.used.shape[0])
        return jax.vmap(restart)(lanes.state, keys), jnp.zeros_like(lanes.used)

    fresh, used = jax.lax.cond(jnp.any(lanes.ended & lanes.used), draw, lambda: (lanes.fresh, lanes.used))

    def pick(new: chex.Array, old: chex.Array) -> chex.Array:
        return jnp.where(lanes.ended.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return Lanes(
        state=jax.tree.map(pick, fresh, lanes.state),
        steps=jnp.where(lanes.ended, 0, lanes.steps),
        ended=jnp.zeros_like(lanes.ended),
        fresh=fresh,
        used=used | lanes.ended,
        early=lanes.early,
    )


def unroll(
    env: Env,
    lanes: Lanes,
    mean: Callable[[chex.Array], chex.Array],
    sigma: chex.Array,
    key: chex.PRNGKey,
    *,
    unroll_steps: int,
    longest: int,
) -> tuple[Lanes, Transition]:
    """T steps of every lane under mu = N(mean(observation), sigma²·I); transitions with leaves [N, T, ...].

    The environment gets the action clipped to [−1, 1]; the transition keeps it as drawn. An episode's last
    step is `terminated` if the environment says done, and `truncated` if it reached `longest` or if the
    environment marks its own end with info["truncated"].
    """
    noise_key, key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (unroll_steps, lanes.steps.shape[0], env.action_size))

    def step(lanes: Lanes, x: tuple[chex.Array, chex.Array]) -> tuple[Lanes, Transition]:
        t, noise = x
        lanes = _restart(env, lanes, jax.random.fold_in(key, t))
        observation = lanes.state.obs
        center = mean(observation)
        action = center + sigma * noise
        state = jax.vmap(env.step)(lanes.state, jnp.clip(action, -1.0, 1.0))
        steps = lanes.steps + 1
        done = state.done.astype(bool)
        own_truncation = jnp.asarray(state.info.get("truncated", jnp.zeros_like(done))).astype(bool)
        terminated = done & ~own_truncation
        ended = done | (steps >= longest)
        transition = Transition(
            observation=observation,
            action=action,
            log_mu=log_density(action, center, sigma),
            reward=state.reward,
            next_observation=state.obs,
            terminated=terminated.astype(jnp.float32),
            truncated=(ended & ~terminated).astype(jnp.float32),
        )
        early = lanes.early + (done & (steps < longest))
        return lanes._replace(state=state, steps=steps, ended=ended, early=early), transition

    lanes, transitions = jax.lax.scan(step, lanes, (jnp.arange(unroll_steps), noise))
    return lanes, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transitions)

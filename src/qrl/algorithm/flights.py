"""Deterministic flights from many starts, and what they measure."""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm.types import Env, State


class Flights(NamedTuple):
    """Leading axis: starts."""

    returns: chex.Array  # [n] sum of the first `return_steps` rewards, up to the episode's end
    measures: dict[str, chex.Array]  # name -> [n]; empty where the environment measures nothing
    observations: chex.Array  # [n, steps + 1, F]; NaN from where an episode ended early
    actions: chex.Array  # [n, steps, A] clipped to [−1, 1]


def fly(
    env: Env,
    mean: Callable[[chex.Array], chex.Array],
    keys: chex.PRNGKey,
    longest: int,
    begin: Callable[[Env, chex.PRNGKey], State] = lambda env, keys: jax.vmap(env.reset)(keys),
) -> Flights:
    """Fly one start for each key under the deterministic action clip(mean(observation), −1, 1).

    `env` is the training environment; one with an `evaluation` (ours) is flown and measured as that says,
    another for one episode of `longest` steps. `begin` draws the starts. Where sensors err, `info["sensed"]` is what
    the policy sees; what is measured is the true observation. A flight that ends early has nothing more to observe:
    its NaNs make it a failure wherever it ended.
    """
    plan = getattr(env, "evaluation", lambda: None)()
    env, steps, return_steps, measure = plan or (env, longest, longest, None)

    def step(carry: tuple, t: chex.Array) -> tuple[tuple, tuple[chex.Array, chex.Array]]:
        state, total = carry
        action = jnp.clip(mean(state.info.get("sensed", state.obs)), -1.0, 1.0)
        after = jax.vmap(env.step)(state, action)
        over = state.done.astype(bool)
        total = total + jnp.where(over | (t >= return_steps), 0.0, after.reward)
        held = jax.tree.map(lambda new, old: jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), old, new), after, state)
        return (held, total), (_seen(state), action)

    state = begin(env, keys)
    (state, returns), (observations, actions) = jax.lax.scan(step, (state, jnp.zeros(keys.shape[0])), jnp.arange(steps))
    observations = jnp.concatenate([observations, _seen(state)[None]]).swapaxes(0, 1)
    measures = jax.vmap(measure)(observations) if measure else {}
    return Flights(returns, measures, observations, actions.swapaxes(0, 1))


def _seen(state: State) -> chex.Array:
    return jnp.where(state.done.astype(bool)[:, None], jnp.nan, state.obs)


def summarise(flights: Flights) -> dict[str, float]:
    """What a report says of flights from n starts: mean and least return and, where measured, success (a
    fraction), settle time (median and p95 over starts, infinite where too few settle) and each steady-state
    error (the median over starts of each start's RMS).
    """
    returns = np.asarray(flights.returns)
    summary = {"return_mean": float(returns.mean()), "return_min": float(returns.min()), "success": float("nan")}
    measures = {name: np.asarray(value) for name, value in flights.measures.items()}
    if measures:
        settle = np.sort(measures["settle_s"])
        summary["success"] = float(measures["success"].mean())
        summary["settle_median_s"] = float(settle[(len(settle) - 1) // 2])
        summary["settle_p95_s"] = float(settle[-(-95 * (len(settle) - 1) // 100)])
    return summary | {name: float(np.median(v)) for name, v in measures.items() if name.startswith("rms_")}

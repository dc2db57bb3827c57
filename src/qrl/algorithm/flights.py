"""Deterministic flights from many starts, and what they measure."""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm.adapter import adapt
from qrl.algorithm.types import Env, State, info_flag


class Flights(NamedTuple):
    """Leading axis: starts."""

    returns: chex.Array  # [n] sum of the first `return_steps` rewards, up to a termination
    complete: chex.Array  # [n] bool: no termination, and never out of bounds
    measures: dict[str, chex.Array]  # name -> [n]; empty where the environment measures nothing
    observations: chex.Array  # [n, steps + 1, F]; NaN from where an episode ended early
    actions: chex.Array  # [n, steps, A] clipped to [−1, 1]


def fly(
    env: Env,
    mean: Callable[[chex.Array], chex.Array],
    keys: chex.PRNGKey,
    max_episode_steps: int,
    reset: Callable[[Env, chex.PRNGKey], State] = lambda env, keys: jax.vmap(env.reset)(keys),
) -> Flights:
    """As `fly_with_memory`, under a policy without memory: mean(observation)."""
    return fly_with_memory(env, lambda memory, o: (memory, mean(o)), (), keys, max_episode_steps, reset)


def fly_with_memory(
    env: Env,
    policy: Callable[[Any, chex.Array], tuple[Any, chex.Array]],
    memory: Any,
    keys: chex.PRNGKey,
    max_episode_steps: int,
    reset: Callable[[Env, chex.PRNGKey], State] = lambda env, keys: jax.vmap(env.reset)(keys),
) -> Flights:
    """Fly one start for each key under policy(memory, observation) -> next memory, action, which is clipped to [−1, 1].

    `memory`, for all starts, is that of the first step.
    An environment with an `evaluation` is flown and measured as that says, another for one episode of
    `max_episode_steps`. `reset` draws the starts. What is recorded and measured is `info["true_obs"]`, if present,
    while the policy sees the observation. A flight that ends early has no more observations: its NaNs make it a
    failure. Out of bounds its last reward goes on: where rewards are below 0, its return would else be the better
    for it.
    """
    plan = adapt(env).evaluation()
    measure = plan.measure if plan else None
    env, steps, return_steps = (plan.env, plan.steps, plan.return_steps) if plan else (env, *[max_episode_steps] * 2)

    def step(carry: tuple, t: chex.Array) -> tuple[tuple, tuple[chex.Array, chex.Array]]:
        state, total, memory = carry
        memory, action = policy(memory, state.obs)
        action = jnp.clip(action, -1.0, 1.0)
        after = jax.vmap(env.step)(state, action)
        over = state.done.astype(bool)
        held = jax.tree.map(lambda new, old: jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), old, new), after, state)
        terminated = over & ~info_flag(state, "out_of_bounds")
        total = total + jnp.where(terminated | (t >= return_steps), 0.0, held.reward)
        return (held, total, memory), (_observed(state), action)

    state = reset(env, keys)
    first = state, jnp.zeros(keys.shape[0]), memory
    (state, returns, _), (observations, actions) = jax.lax.scan(step, first, jnp.arange(steps))
    observations = jnp.concatenate([observations, _observed(state)[None]]).swapaxes(0, 1)
    measures = jax.vmap(measure)(observations) if measure else {}
    return Flights(returns, ~state.done.astype(bool), measures, observations, actions.swapaxes(0, 1))


def _observed(state: State) -> chex.Array:
    return jnp.where(state.done.astype(bool)[:, None], jnp.nan, state.info.get("true_obs", state.obs))


def summarize(flights: Flights) -> dict[str, float]:
    """Summary of flights from n starts: mean and minimum return and, where measured, success (a fraction), settle time
    (lower median and p95 over starts, infinite where too few settle) and each steady-state error (the median over
    starts of each start's RMS).
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

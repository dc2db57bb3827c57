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
    """Fly one start for each key under policy(memory, observation) -> next memory, action, as a `FlightPlan` says.

    `memory`, for all starts, is that of the first step. `reset` draws the starts.
    """
    plan = FlightPlan.of(env, max_episode_steps)

    def step(carry: tuple[Progress, Any], _: None) -> tuple[tuple[Progress, Any], tuple[chex.Array, chex.Array]]:
        now, memory = carry
        memory, action = policy(memory, now.state.obs)
        after, action = plan.step(now, action)
        return (after, memory), (observed(now.state), action)

    (last, _), (observations, actions) = jax.lax.scan(
        step, (plan.start(reset(plan.env, keys)), memory), length=plan.steps
    )
    return plan.flights(last, observations, actions)


class Progress(NamedTuple):
    """Flights between two steps; leading axis: starts."""

    state: State
    returns: chex.Array  # [n]
    steps: chex.Array  # [] done


class FlightPlan(NamedTuple):
    """How an environment is flown and measured: as its `evaluation` says, another for one episode.

    What is recorded and measured is `info["true_obs"]`, if present, while the policy sees the observation. A flight
    that ends early has no more observations: its NaNs make it a failure. Out of bounds its last reward goes on: where
    rewards are below 0, its return would else be the better for it.
    """

    env: Env
    steps: int
    return_steps: int
    measure: Callable[[chex.Array], dict[str, chex.Array]] | None

    @classmethod
    def of(cls, env: Env, max_episode_steps: int) -> "FlightPlan":
        """`max_episode_steps`: of an environment without an `evaluation`."""
        plan = adapt(env).evaluation()
        if plan is None:
            return cls(env, max_episode_steps, max_episode_steps, None)
        return cls(plan.env, plan.steps, plan.return_steps, plan.measure)

    def start(self, state: State) -> Progress:
        """From states of a reset."""
        return Progress(state, jnp.zeros(state.reward.shape), jnp.zeros((), int))

    def step(self, now: Progress, action: chex.Array) -> tuple[Progress, chex.Array]:
        """The flights a step later, and the action [n, A] that they were given, clipped to [−1, 1]."""
        state, action = now.state, jnp.clip(action, -1.0, 1.0)
        after = jax.vmap(self.env.step)(state, action)
        over = state.done.astype(bool)
        held = jax.tree.map(lambda new, old: jnp.where(over.reshape(-1, *[1] * (new.ndim - 1)), old, new), after, state)
        terminated = over & ~info_flag(state, "out_of_bounds")
        reward = jnp.where(terminated | (now.steps >= self.return_steps), 0.0, held.reward)
        return Progress(held, now.returns + reward, now.steps + 1), action

    def flights(self, last: Progress, observations: chex.Array, actions: chex.Array) -> Flights:
        """Of what was recorded before each step, [steps, n, F] and [steps, n, A]."""
        observations = jnp.concatenate([observations, observed(last.state)[None]]).swapaxes(0, 1)
        measures = jax.vmap(self.measure)(observations) if self.measure else {}
        return Flights(last.returns, ~last.state.done.astype(bool), measures, observations, actions.swapaxes(0, 1))


def observed(state: State) -> chex.Array:
    """What is recorded of a state; NaN where the flight has ended."""
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

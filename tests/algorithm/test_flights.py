"""Deterministic flights: against a literal loop, and that nothing is gained by ending."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from qrl.algorithm import flights
from qrl.evaluation.host_flights import HostFlights
from qrl_envs import env as worlds
from qrl_envs.controllers import geometric

EDGE, STEPS = 1.2, 9


class Drifting(Env):
    """A point on a line that drifts outward; beyond EDGE its episode ends, out of bounds on the left."""

    observation_size, action_size, backend = 1, 1, "test"  # pyright: ignore[reportAssignmentType]

    def __init__(self, constant: float) -> None:
        self.constant = constant

    def reset(self, rng: jax.Array) -> State:
        return self._at(jax.random.uniform(rng, (1,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: jax.Array) -> State:
        return self._at(1.15 * state.obs + 0.1 * action)

    def _at(self, obs: jax.Array) -> State:
        done = (jnp.abs(obs[0]) > EDGE).astype(jnp.float32)
        zero = jnp.zeros(())
        return State(
            None, obs, self.constant - obs[0] ** 2, done, {}, {"out_of_bounds": jnp.where(obs[0] < 0, done, zero)}
        )


@pytest.mark.parametrize("constant", [0.0, 2.0])
def test_flights_are_those_of_a_literal_loop(constant: float) -> None:
    """Out of bounds the last reward goes on, whatever its sign; after a termination there is none. An end is NaN."""
    env, keys = Drifting(constant), jax.random.split(jax.random.PRNGKey(0), 12)
    found = jax.jit(lambda keys: flights.fly(env, lambda o: -0.5 * o, keys, STEPS))(keys)
    step, ended = jax.jit(env.step), []
    for i, key in enumerate(keys):
        state, total, seen, over = env.reset(key), 0.0, [], ""
        for _ in range(STEPS):
            seen.append(np.nan if over else float(state.obs[0]))
            if not over:
                state = step(state, jnp.clip(-0.5 * state.obs, -1.0, 1.0))
                over = ("out" if state.info["out_of_bounds"] else "terminated") if state.done else ""
                total += float(state.reward)
            elif over == "out":
                total += float(state.reward)
        ended.append(over)
        np.testing.assert_allclose(found.returns[i], total, rtol=1e-5)
        np.testing.assert_allclose(found.observations[i, :STEPS, 0], seen, rtol=1e-5)
        assert found.complete[i] == (not np.isnan(seen[-1]))
    assert set(ended) == {"", "out", "terminated"}
    assert not found.measures


class Marked(Drifting):
    """With a start of its own for calibration."""

    def reset_calibration(self, rng: jax.Array) -> State:
        return self._at(0.01 * jax.random.uniform(rng, (1,)) + 0.5)


def test_flights_of_the_host_are_those_of_one_program() -> None:
    """With a memory; the last of them start in the envelope."""
    env, keys = Marked(2.0), jax.random.split(jax.random.PRNGKey(0), 12)

    def policy(xp: Any, memory: Any, o: Any) -> tuple[Any, Any]:
        return 0.5 * memory + o, xp.clip(-0.5 * memory, -2.0, 2.0)

    def reset(env: Any, keys: jax.Array) -> State:
        states = jax.vmap(env.reset_calibration)(keys), jax.vmap(env.reset)(keys)
        last = (jnp.arange(12) >= 9).reshape(12, 1)
        return jax.tree.map(lambda a, b: jnp.where(last if a.ndim == 2 else last[:, 0], a, b), *states)

    wanted = jax.jit(
        lambda keys: flights.fly_with_memory(env, partial(policy, jnp), jnp.ones((12, 1)), keys, STEPS, reset)
    )(keys)
    found = HostFlights(env, STEPS).fly(partial(policy, np), np.ones((12, 1)), keys, from_envelope=0.25)
    assert not wanted.complete.all()
    assert np.ptp(np.asarray(wanted.observations)[9:, 0]) < 0.02
    for name in ("returns", "complete", "observations", "actions"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("task", ["hover", "circle"])
def test_tumbling_at_once_is_worse_than_doing_nothing_and_that_than_flying(task: str) -> None:
    """Rewards of circle are below 0: a return without its charge is at its best for a flight that ends at once."""
    env = worlds.make(task)
    fly = geometric.controller(env.task)

    @jax.jit
    def returns(which: jax.Array) -> tuple[jax.Array, jax.Array]:
        def mean(observation: jax.Array) -> jax.Array:
            constant = jnp.where(which == 1, jnp.array([1.0, -1.0, -1.0, 1.0]), 0.0)
            return jnp.where(which == 0, fly(observation), constant)

        found = flights.fly(env, mean, jax.random.split(jax.random.PRNGKey(1), 8), 0)
        return found.returns, found.complete

    (flown, complete), (tumbled, ends), (nothing, _) = (jax.tree.map(np.asarray, returns(i)) for i in range(3))
    assert complete.all()
    assert not ends.any()
    assert (tumbled < nothing).all()
    assert (nothing < flown).all()

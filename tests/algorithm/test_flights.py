"""Deterministic flights: against a literal loop, and that nothing is gained by ending."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from qrl.algorithm import flights
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

"""Deterministic flights on a toy that counts its steps, and the summary of many."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from qrl.algorithm import flights as evaluate
from qrl.algorithm.flights import Flights
from qrl_envs import env as worlds
from qrl_envs.task_env import Evaluation

Array = np.ndarray

N, LONGEST = 16, 12
TIME, LIFE, MOVED = range(3)


class Counter(Env):
    """Pays k for its k-th step and ends after a number of steps that the key decides; beyond its end all is NaN."""

    @property
    def observation_size(self) -> int:
        return 3

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "toy"

    def reset(self, rng: jax.Array) -> State:
        life = jnp.floor(jax.random.uniform(rng, minval=3.0, maxval=20.0))
        x = jnp.array([0.0, 0.0, 0.0]).at[LIFE].set(life)
        return State(x, x, jnp.float32(0.0), jnp.float32(0.0), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        x = state.pipeline_state
        after = x.at[TIME].add(1.0).at[MOVED].add(action[0])
        after = jnp.where(x[TIME] < x[LIFE], after, jnp.nan)
        return state.replace(
            pipeline_state=after, obs=after, reward=after[TIME], done=jnp.float32(after[TIME] >= after[LIFE])
        )


class Judged(Counter):
    """One that says how it is judged: by 9 steps of which the first 5 pay, measured on the whole flight."""

    def evaluation(self) -> Evaluation:
        def measure(observations: jax.Array) -> dict[str, jax.Array]:
            return {"last": observations[-1, TIME], "sum": jnp.sum(observations[:, TIME])}

        return Evaluation(Counter(), 9, 5, measure)


class Still(Counter):
    """At the hover point all along, until the environment ends the episode (as a tumbling vehicle's) after 3 steps."""

    def reset(self, rng: jax.Array) -> State:
        x = jnp.zeros(18).at[jnp.array([0, 4, 8])].set(1.0)
        return State(jnp.float32(0.0), x, jnp.float32(0.0), jnp.float32(0.0), {}, {"truncated": jnp.float32(0.0)})

    def step(self, state: State, action: jax.Array) -> State:
        time = state.pipeline_state + 1.0
        done = jnp.float32(time >= 3)
        return state.replace(pipeline_state=time, done=done, info={"truncated": done})

    def evaluation(self) -> Evaluation:
        return worlds.make("hover").evaluation()._replace(env=self)


def mean(observation: jax.Array) -> jax.Array:
    """Beyond ±1 most of the time."""
    return jnp.stack([observation[..., TIME] - 2.5, -9.0 + 0.0 * observation[..., LIFE]], axis=-1)


def keys(n: int = N) -> jax.Array:
    return jax.random.split(jax.random.key(0), n)


fly_plain = jax.jit(lambda keys: evaluate.fly(Counter(), mean, keys, LONGEST))


@pytest.fixture(scope="module")
def plain() -> Flights:
    """Without an `evaluation`: one episode of LONGEST steps."""
    return jax.tree.map(np.asarray, fly_plain(keys()))


@pytest.fixture(scope="module")
def judged() -> Flights:
    """With one; the longest episode of training does not matter."""
    return jax.tree.map(np.asarray, jax.jit(lambda k: evaluate.fly(Judged(), mean, k, LONGEST))(keys()))


def lives(flights: Flights) -> Array:
    """How many steps each flight had before its environment ended it."""
    return flights.observations[:, 0, LIFE]


def test_flights_meet_both_ends(plain: Flights, judged: Flights) -> None:
    """What the tests below rest on: lives shorter and longer than the flight, and than the steps that pay."""
    for flights, steps in ((plain, LONGEST), (judged, 9), (judged, 5)):
        assert (lives(flights) < steps).any()
        assert (lives(flights) > steps).any()


def test_return_counts_to_the_end_of_the_episode(plain: Flights) -> None:
    """1 + 2 + … up to the step that ends it, itself included, or the longest; no NaN from beyond."""
    last = np.minimum(lives(plain), LONGEST)
    np.testing.assert_array_equal(plain.returns, last * (last + 1) / 2)


class OutOfBounds(Counter):
    """Ends out of bounds, where another environment terminates."""

    def reset(self, rng: jax.Array) -> State:
        return super().reset(rng).replace(info={"out_of_bounds": jnp.float32(0.0)})

    def step(self, state: State, action: jax.Array) -> State:
        after = super().step(state, action)
        return after.replace(info={**after.info, "out_of_bounds": after.done})


def test_out_of_bounds_the_last_reward_goes_on() -> None:
    """To the last step that pays; and a flight that an end cut short is not complete."""
    flights = jax.tree.map(np.asarray, evaluate.fly(OutOfBounds(), mean, keys(), LONGEST))
    last = np.minimum(lives(flights), LONGEST)
    np.testing.assert_array_equal(flights.returns, last * (last + 1) / 2 + (LONGEST - last) * last)
    np.testing.assert_array_equal(flights.complete, lives(flights) > LONGEST)


def test_return_counts_the_first_return_steps_alone(judged: Flights) -> None:
    """Of a longer flight."""
    last = np.minimum(lives(judged), 5)
    np.testing.assert_array_equal(judged.returns, last * (last + 1) / 2)


def seen(flights: Flights, steps: int) -> Array:
    """The time that an observation shows: it counts up, and is NaN from where the episode ended."""
    t = np.arange(steps + 1)
    return np.where(t < lives(flights)[:, None], t, np.nan)


def test_nothing_is_observed_from_where_a_flight_ended(plain: Flights) -> None:
    """So that no measure can take where it ended for a success; K steps have K + 1 observations."""
    assert plain.observations.shape == (N, LONGEST + 1, 3)
    np.testing.assert_array_equal(plain.observations[..., TIME], seen(plain, LONGEST))


def test_measures_see_the_whole_flight(judged: Flights) -> None:
    """From the start to 9 steps later."""
    assert judged.observations.shape == (N, 10, 3)
    assert judged.measures.keys() == {"last", "sum"}
    times = seen(judged, 9)
    np.testing.assert_array_equal(judged.measures["last"], times[:, -1])
    np.testing.assert_array_equal(judged.measures["sum"], times.sum(axis=1))


def test_an_environment_without_measures_has_its_return_alone(plain: Flights) -> None:
    """Foreign environments report their return only."""
    assert plain.measures == {}
    summary = evaluate.summarize(plain)
    assert summary.keys() == {"return_mean", "return_min", "success"}
    assert np.isnan(summary["success"])


def test_actions_are_the_policys_mean_clipped(plain: Flights) -> None:
    """To [−1, 1], as recorded and as flown."""
    assert plain.actions.shape == (N, LONGEST, 2)
    flying = np.isfinite(plain.observations[:, 1:, TIME])
    wanted = np.clip(np.arange(LONGEST) - 2.5, -1.0, 1.0) + np.zeros((N, 1))
    np.testing.assert_array_equal(plain.actions[..., 0][flying], wanted[flying])
    np.testing.assert_array_equal(plain.actions[..., 1][flying], -1.0)
    moved = np.diff(plain.observations[..., MOVED], axis=1)
    np.testing.assert_allclose(moved[flying], plain.actions[..., 0][flying], atol=1e-6)


def test_flights_are_deterministic_and_each_its_keys_own(plain: Flights) -> None:
    """The same keys fly the same to the last bit; a start does not depend on those beside it."""
    again, rolled = fly_plain(keys()), fly_plain(jnp.roll(keys(), 5))
    for one, two, other in zip(*map(jax.tree.leaves, (again, plain, rolled)), strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(other, np.roll(two, 5, axis=0))
    assert len(np.unique(lives(plain))) > 4


def test_a_flight_that_ends_early_is_no_success() -> None:
    """Though it ends at the very hover point: a vehicle that tumbles there beyond the bounds fails."""
    flights = jax.jit(lambda k: evaluate.fly(Still(), lambda o: jnp.zeros((*o.shape[:-1], 4)), k, 200))(keys(2))
    np.testing.assert_array_equal(flights.measures["success"], 0.0)
    assert np.isposinf(flights.measures["settle_s"]).all()


def flown(n: int, **measures: Array) -> Flights:
    """Flights of which only returns and measures matter."""
    nothing: Any = np.zeros((n, 1, 1))
    return Flights(np.random.default_rng(n).normal(size=n), np.ones(n, bool), measures, nothing, nothing)


@pytest.mark.parametrize("n", [1, 2, 19, 20, 21, 100, 1000])
def test_summary_is_numpys(n: int) -> None:
    """Fractions, medians and the 95th percentile, the latter two as values that some flight had."""
    rng = np.random.default_rng(n)
    settle, error, success = rng.uniform(size=n), rng.uniform(size=n), rng.integers(0, 2, size=n).astype(float)
    flights = flown(n, success=success, settle_s=settle, rms_position_m=error)
    assert evaluate.summarize(flights) == pytest.approx(
        {
            "return_mean": np.mean(flights.returns),
            "return_min": np.min(flights.returns),
            "success": np.mean(success),
            "settle_median_s": np.percentile(settle, 50, method="lower"),
            "settle_p95_s": np.percentile(settle, 95, method="higher"),
            "rms_position_m": np.median(error),
        }
    )


@pytest.mark.parametrize(
    ("never", "median", "p95"), [(0, 1.0, 1.0), (4, 1.0, 1.0), (6, 1.0, np.inf), (60, np.inf, np.inf)]
)
def test_flights_that_never_settle_count_as_infinite(never: int, median: float, p95: float) -> None:
    """Of 100: settle times are finite where enough of them are, and never a NaN."""
    settle = np.where(np.arange(100) < never, np.inf, 1.0)
    flights = flown(100, success=np.isfinite(settle), settle_s=settle, rms_position_m=settle)
    summary = evaluate.summarize(flights)
    assert (summary["settle_median_s"], summary["settle_p95_s"]) == (median, p95)
    assert summary["success"] == pytest.approx(1 - never / 100)
    assert summary["rms_position_m"] == median

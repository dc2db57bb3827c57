"""Success, settle time and steady-state errors as README's "Results" defines them."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qrl_envs import env, measures

Array = np.ndarray
Measures = dict[str, Array]

DT = 0.01
HOVER = env.make("hover").evaluation()
CIRCLE = env.make("circle").evaluation()
PENDULUM = env.make("pendulum").evaluation()
X, Y, Z, VX, VY = 9, 10, 11, 12, 13
TAIL = {"hover": 600, "circle": 800}  # the first sample of the tail: at 6 s of 8, at 8 s of 12


def compiled(measure: Callable | None) -> Callable[[Array], Measures]:
    """The measures of each of n flights; one compiled program, whatever n."""
    assert measure is not None
    once = jax.jit(measure)

    def each(flights: Array) -> Measures:
        results = [once(flight) for flight in flights]
        return {name: np.array([result[name] for result in results]) for name in results[0]}

    return each


hover_measures = compiled(HOVER.measure)
circle_measures = compiled(CIRCLE.measure)
pendulum_measures = compiled(PENDULUM.measure)


def hovering(n: int = 1, distance: float = 0.0) -> Array:
    """n level flights [n, 801, 18] at rest, that far from the point all along."""
    flights = np.zeros((n, HOVER.steps + 1, 18), np.float32)
    flights[..., [0, 4, 8]] = 1.0
    flights[..., X : Z + 1] = distance * np.array([2.0, -1.0, 2.0]) / 3.0
    return flights


def circling(n: int = 1, *, radius: float = 1.0, speed: float = 2.0, height: float = 0.0) -> Array:
    """n flights [n, 1201, 18] on a circle, counter-clockwise for a positive speed, each from its own phase."""
    flights = np.zeros((n, CIRCLE.steps + 1, 18), np.float32)
    flights[..., [0, 4, 8]] = 1.0
    t = np.arange(CIRCLE.steps + 1) * DT
    phase = speed / radius * t + np.arange(n)[:, None]
    flights[..., X], flights[..., Y], flights[..., Z] = radius * np.cos(phase), radius * np.sin(phase), height
    flights[..., VX], flights[..., VY] = -speed * np.sin(phase), speed * np.cos(phase)
    return flights


FLIGHTS = {"hover": (hovering, hover_measures), "circle": (circling, circle_measures)}
each_task = pytest.mark.parametrize("task", ["hover", "circle"])


def settles_by_loop(within: list[bool]) -> float:
    """The first time from which the condition holds to the end."""
    for k in range(len(within)):
        if all(within[k:]):
            return k * DT
    return math.inf


def test_flights_are_as_long_as_design_says() -> None:
    """8 s and 12 s of 10 ms; the return is of the first 200 steps."""
    assert (HOVER.steps, HOVER.return_steps) == (800, 200)
    assert (CIRCLE.steps, CIRCLE.return_steps) == (1200, 200)


settle = jax.jit(measures.settle_s)


@settings(deadline=None, derandomize=True, database=None)
@given(st.lists(st.booleans(), min_size=12, max_size=12))
def test_settle_time_is_the_loops(within: list[bool]) -> None:
    """For any pattern of 12 samples."""
    assert float(settle(np.array(within), DT)) == pytest.approx(settles_by_loop(within))


@pytest.mark.parametrize("within", [[True], [False], [False, True], [True, False], [True] * 3, [False] * 3])
def test_settle_time_of_the_shortest_flights(within: list[bool]) -> None:
    """One to three samples; a flight that never settles takes forever."""
    assert float(settle(np.array(within), DT)) == pytest.approx(settles_by_loop(within))


@each_task
def test_a_steady_flight_succeeds_from_the_start(task: str) -> None:
    """Success, settled at once, no errors."""
    fly, measure = FLIGHTS[task]
    result = measure(fly(5))
    assert (result.pop("success") == 1).all()
    assert (result.pop("settle_s") == 0).all()
    assert len(result) == {"hover": 1, "circle": 3}[task]
    assert all((value < 1e-5).all() for value in result.values())


@each_task
def test_one_sample_outside_fails_in_the_tail_alone(task: str) -> None:
    """Away for one sample only: a failure from the sample at 6 s (8 s) on, both ends included."""
    fly, measure = FLIGHTS[task]
    last = fly(1).shape[1] - 1
    times = np.array([0, 1, 300, TAIL[task] - 1, TAIL[task], TAIL[task] + 1, last - 1, last])
    flights = fly(len(times))
    flights[np.arange(len(times)), times, Z] = 0.11
    result = measure(flights)
    np.testing.assert_array_equal(result["success"], times < TAIL[task])
    np.testing.assert_allclose(result["settle_s"], np.where(times < last, (times + 1) * DT, np.inf), rtol=1e-6)


@pytest.mark.parametrize(("distance", "success"), [(0.099, 1), (0.101, 0)])
def test_hover_succeeds_within_a_tenth_of_a_meter(distance: float, success: int) -> None:
    """In a straight line, not along each axis."""
    result = hover_measures(hovering(1, distance))
    assert result["success"] == success
    np.testing.assert_allclose(result["rms_position_m"], distance, rtol=1e-5)


@pytest.mark.parametrize(
    ("flight", "success"),
    [
        ({"radius": 1.09}, 1),
        ({"radius": 1.11}, 0),
        ({"radius": 0.91}, 1),
        ({"radius": 0.89}, 0),
        ({"height": 0.09}, 1),
        ({"height": -0.11}, 0),
        ({"radius": 1.08, "height": 0.08}, 0),
        ({"radius": 1.06, "height": 0.06}, 1),
        ({"speed": 2.19}, 1),
        ({"speed": 2.21}, 0),
        ({"speed": 1.81}, 1),
        ({"speed": 1.79}, 0),
        ({"speed": -2.0}, 0),
        ({"speed": 0.0}, 0),
    ],
    ids=str,
)
def test_circle_succeeds_near_the_circle_at_its_speed_and_sense(flight: dict[str, float], success: int) -> None:
    """d = hypot(r − 1, z) < 0.1 m and |speed − 2| < 0.2 m/s, counter-clockwise; from any phase."""
    result = circle_measures(circling(7, **flight))
    np.testing.assert_array_equal(result["success"], success)
    expected = {"radius": 1.0, "speed": 2.0, "height": 0.0} | flight
    np.testing.assert_allclose(result["rms_radius_m"], abs(expected["radius"] - 1.0), atol=1e-5)
    np.testing.assert_allclose(result["rms_height_m"], abs(expected["height"]), atol=1e-5)
    np.testing.assert_allclose(result["rms_speed_m_s"], abs(expected["speed"] - 2.0), atol=1e-5)


def test_circle_speed_is_the_tangential_one() -> None:
    """Velocity outward and upward does not count, and the lever arm is divided out."""
    flights = circling(3, radius=1.05)
    out = flights[..., X : Y + 1] / 1.05
    flights[..., VX : VY + 1] += 0.7 * out
    flights[..., VY + 1] = 0.9
    result = circle_measures(flights)
    np.testing.assert_array_equal(result["success"], 1)
    np.testing.assert_allclose(result["rms_speed_m_s"], 0.0, atol=1e-5)


def test_hover_rmse_is_of_the_tail_alone() -> None:
    """NumPy's RMS distance over the samples from 6 s to 8 s; what comes before does not touch it."""
    rng = np.random.default_rng(0)
    flights = hovering(4)
    flights[..., X : Z + 1] = rng.normal(size=(4, HOVER.steps + 1, 3))
    tail = flights[:, TAIL["hover"] :, X : Z + 1].astype(np.float64)
    expected = np.sqrt(np.mean(np.sum(tail**2, axis=-1), axis=1))
    np.testing.assert_allclose(hover_measures(flights)["rms_position_m"], expected, rtol=1e-5)
    flights[:, TAIL["hover"] - 1, X] = 1e6
    np.testing.assert_allclose(hover_measures(flights)["rms_position_m"], expected, rtol=1e-5)


def test_circle_rmses_are_of_the_tail_alone() -> None:
    """NumPy's RMS of r − 1, z and (x·vy − y·vx)/r − 2 over the samples from 8 s to 12 s."""
    rng = np.random.default_rng(1)
    flights = circling(4)
    flights[..., X : VY + 1] += 0.05 * rng.normal(size=(4, CIRCLE.steps + 1, 5))
    x, y, z, vx, vy = np.moveaxis(flights[:, TAIL["circle"] :, X : VY + 1].astype(np.float64), -1, 0)
    r = np.sqrt(x**2 + y**2)
    expected = {"radius_m": r - 1.0, "height_m": z, "speed_m_s": (x * vy - y * vx) / r - 2.0}
    flights[:, TAIL["circle"] - 1, X : VY + 1] = 50.0
    result = circle_measures(flights)
    for name, error in expected.items():
        np.testing.assert_allclose(result[f"rms_{name}"], np.sqrt(np.mean(error**2, axis=1)), rtol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@each_task
def test_a_number_that_is_not_finite_is_never_a_success(task: str, bad: float) -> None:
    """In any of the 18 channels, at the start, in the middle of the flight, at the tail's first sample and the last."""
    fly, measure = FLIGHTS[task]
    last = fly(1).shape[1] - 1
    times = [0, last // 3, TAIL[task] - 1, TAIL[task], last]
    flights = fly(18 * len(times)).reshape(18, len(times), last + 1, 18)
    for channel in range(18):
        for i, k in enumerate(times):
            flights[channel, i, k, channel] = bad
    result = measure(flights.reshape(-1, last + 1, 18))
    success = np.asarray(result["success"]).reshape(18, len(times))
    assert not success.any(), f"success with a number not finite in channels {np.flatnonzero(success.any(axis=1))}"
    assert np.isinf(result["settle_s"]).all()


@each_task
def test_a_tail_that_is_not_finite_has_an_infinite_error(task: str) -> None:
    """So that a median over flights counts it, where a NaN would spoil it."""
    fly, measure = FLIGHTS[task]
    flights = fly(1)
    flights[0, -1, X : VY + 1] = np.nan
    result = measure(flights)
    assert all(np.isposinf(value).all() for name, value in result.items() if name.startswith("rms"))


def test_a_circle_may_begin_at_its_centre() -> None:
    """There the tangential speed is undefined though every number of the flight is finite: the tail decides."""
    flights = circling(1)
    flights[0, 0, [X, Y, VX, VY]] = 0.0
    result = circle_measures(flights)
    assert result["success"] == 1
    np.testing.assert_allclose(result["settle_s"], DT, rtol=1e-6)


def test_pendulum_succeeds_upright_and_slow() -> None:
    """|θ| < 0.1 rad, by either side of the wrap, and |θ̇| < 0.2 rad/s over the last 2 s of 10 s."""
    angle = np.array([0.09, -0.09, 0.11, np.pi, 0.0, 0.0, 0.0])
    rate = np.array([0.0, 0.0, 0.0, 0.0, 0.19, -0.21, 0.21])
    flight = np.stack([np.cos(angle), np.sin(angle), rate], axis=-1)[:, None].repeat(PENDULUM.steps + 1, axis=1)
    assert PENDULUM.steps == 200
    flight[0, :160] = [-1.0, 0.0, 3.0]
    flight[1, :161] = [-1.0, 0.0, 3.0]
    result = pendulum_measures(jnp.asarray(flight, jnp.float32))
    np.testing.assert_array_equal(result["success"], [1, 0, 0, 0, 1, 0, 0])
    np.testing.assert_allclose(result["settle_s"], [8.0, 8.05, np.inf, np.inf, 0.0, np.inf, np.inf], rtol=1e-6)

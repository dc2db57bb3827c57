"""Gusts, and positions that come seldom and late: against closed forms, and a literal loop over the fixes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qrl_envs import noise, task
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.uncertainty import Uncertainty

Array = np.ndarray
DT_S = 0.01
BOUND = 6 / np.sqrt(noise.ROWS)  # the tables have so many rows, which all flights share: six sigmas of a mean


def real_task(vehicle: str | None = "crazyflie") -> task.QuadrotorTask:
    loaded = task.load("hover", vehicle)
    assert isinstance(loaded, task.QuadrotorTask)
    return loaded


def fixed(**values: float) -> Uncertainty:
    return Uncertainty(**{name: (value, value) for name, value in values.items()})


SPEC = real_task()
ROOM = fixed(gust_m_s=1.0, position_period_s=0.04, position_delay_s=0.017)
ENV = RealQuadrotorEnv(SPEC, Uncertainty(), ROOM)
LANES, STEPS = 1000, 60


@jax.jit
def _flown(params: Any) -> Any:
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, 4), minval=-0.2, maxval=0.2)
    actions = actions.at[0].set(0.0)
    env = ENV.with_params(params)
    first = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.PRNGKey(0), LANES))

    def step(s: Any, a: jax.Array) -> tuple[Any, Any]:
        s = env.step_lanes(s, jnp.broadcast_to(a[:, None], (4, LANES)))
        return s, s.pipeline_state.x

    rest = jax.lax.scan(step, first, actions)[1]
    x = first.pipeline_state.x
    return jax.tree.map(lambda x, xs: jnp.moveaxis(jnp.concatenate([x[None], xs]), -1, 0), x, rest)


def flown(uncertainty: Uncertainty, vehicle: str | None = "crazyflie") -> Any:
    """States of LANES flights under random actions from the second on; leaves [LANES, STEPS + 1, ...]. One program."""
    return jax.tree.map(np.asarray, _flown(RealQuadrotorEnv(real_task(vehicle), uncertainty).params))


def assert_ornstein_uhlenbeck(x: Array, correlation_s: float) -> None:
    """x [lanes, steps, k] has mean 0, variance 1 at the first step and the last, autocorrelation exp(−t/correlation_s),
    and axes that do not follow from each other.
    """
    assert np.abs(x.mean(axis=(0, 1))).max() < BOUND
    for step in (0, 10, -1):
        assert np.abs((x[:, step] ** 2).mean(axis=0) - 1).max() < np.sqrt(2) * BOUND
        assert np.abs((x[:, step, 0] * x[:, step, 1]).mean()) < BOUND
    for lag in (1, 5, 20):
        found = (x[:, lag:] * x[:, :-lag]).mean(axis=(0, 1))
        np.testing.assert_allclose(found, np.exp(-lag * DT_S / correlation_s), atol=np.sqrt(2) * BOUND)


def test_gusts_are_an_ornstein_uhlenbeck_process() -> None:
    """Of the speed and correlation time drawn, another in each flight; what else is drawn does not change."""
    steady = fixed(wind_m_s=1.0, force_weights=0.05)
    flight = flown(steady.model_copy(update={"gust_m_s": (0.5, 1.5), "gust_s": (0.2, 0.2)}))
    assert_ornstein_uhlenbeck(flight.gust, 0.2)
    speed = flight.world.gust.speed_m_s[:, 0]
    assert 0.5 <= speed.min() < 0.6
    assert 1.4 < speed.max() <= 1.5
    calm = flown(steady)
    np.testing.assert_array_equal(calm.world.disturbance.force_N, flight.world.disturbance.force_N)
    np.testing.assert_array_equal(calm.body.pose.position_m[:, 0], flight.body.pose.position_m[:, 0])
    assert np.abs(calm.body.twist.velocity_m_s - flight.body.twist.velocity_m_s)[:, -1].min() > 0.0


@pytest.mark.parametrize("vehicle", ["crazyflie", None])
def test_a_gust_pushes_through_drag_or_else_by_a_share_of_the_weight(vehicle: str | None) -> None:
    """Newton's law over the first period, beside the same flights without gusts."""
    flight, calm = (flown(u, vehicle) for u in (fixed(gust_m_s=2.0), Uncertainty()))
    wind = np.pad(2.0 * flight.gust[:, 0], ((0, 0), (0, 1)))
    vehicle_mass_kg = real_task(vehicle).vehicle.mass_kg
    if vehicle:
        w, x, y, z = flight.body.pose.attitude[:, 0].T
        to_world = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
        drag = np.diag([0.00734, 0.00734, 0.00541]) / vehicle_mass_kg
        pushed = np.einsum("nij,jk,nlk,nl->ni", to_world, drag, to_world, wind)
    else:
        pushed = 0.025 * 9.81 * wind
    moved = (flight.body.twist.velocity_m_s - calm.body.twist.velocity_m_s)[:, 1]
    np.testing.assert_allclose(moved, DT_S * pushed, atol=0.03 * DT_S * np.abs(pushed).max())


def expected_by_a_loop(true_m: Array, start_m_s: Array, period_s: float, phase_s: float, delay_s: float) -> Any:
    """Position and velocity [K + 1, 3] that a literal estimator has at each step of a flight with positions [K + 1, 3]:
    fixes arrive in order; between them the last moves on by the difference of the last two.
    """
    times = DT_S * np.arange(len(true_m))

    def at(time_s: float) -> Array:
        if time_s < 0:
            return true_m[0] + time_s * start_m_s
        return np.array([np.interp(time_s, times, axis) for axis in true_m.T])

    taken = [phase_s + n * period_s for n in range(-20, int(times[-1] / period_s) + 2)]
    positions, velocities = [], []
    for now in times:
        known = [s for s in taken if s + delay_s <= now + 1e-6]
        last, before = known[-1], known[-2]
        velocity = (at(last) - at(before)) / period_s
        positions.append(at(last) + (now - last) * velocity)
        velocities.append(velocity)
    return np.array(positions), np.array(velocities)


@pytest.mark.parametrize(("period_s", "delay_s"), [(1 / 30, 0.01), (0.02, 0.0), (0.0, 0.017), (0.004, 0.003)])
def test_fixes_come_when_a_literal_loop_says(period_s: float, delay_s: float) -> None:
    """A period below the loop's counts as the loop's."""
    flight = flown(fixed(position_period_s=period_s, position_delay_s=delay_s))
    phase = flight.world.sensors.fixes.phase_s[:, 0]
    assert len(set(phase[:4])) == (4 if period_s else 1)
    for i in range(4):
        body, sensed = (jax.tree.map(lambda x: np.asarray(x[i], np.float64), b) for b in (flight.body, flight.sensed))  # noqa: B023
        position, velocity = expected_by_a_loop(
            body.pose.position_m, body.twist.velocity_m_s[0], max(period_s, DT_S), float(phase[i]), delay_s
        )
        np.testing.assert_allclose(sensed.pose.position_m, position, atol=2e-5)
        np.testing.assert_allclose(sensed.twist.velocity_m_s, velocity, atol=3e-4)
        np.testing.assert_array_equal(sensed.twist.body_rate_rad_s, body.twist.body_rate_rad_s)
        np.testing.assert_allclose(sensed.pose.attitude, body.pose.attitude, atol=1e-6)
        assert np.abs(sensed.twist.velocity_m_s - body.twist.velocity_m_s).max() > 0.01  # it is late


def test_each_fix_errs_once() -> None:
    """Over a hold of 4 periods the velocity stands; it errs by the difference of two fixes, σ·√2/period."""
    ranges = {"position_period_s": 0.04, "position_noise_m": 0.001}
    noisy, clean = flown(fixed(**ranges)), flown(fixed(position_period_s=0.04))
    error = noisy.sensed.twist.velocity_m_s - clean.sensed.twist.velocity_m_s
    changes = (np.abs(np.diff(error, axis=1)).max(axis=2) > 1e-4).sum(axis=1)
    assert set(changes) == {STEPS // 4}
    np.testing.assert_allclose(error.std(axis=(0, 1)), 0.001 * np.sqrt(2) / 0.04, rtol=BOUND)


def test_a_bias_wanders() -> None:
    """An Ornstein-Uhlenbeck process about the constant bias; a velocity measured apart does not see it, one that
    is derived from the positions does. The memory's integral does.
    """
    flight = flown(fixed(bias_wander_m=0.005, bias_wander_s=0.3, position_bias_m=0.01))
    off = flight.sensed.pose.position_m - flight.body.pose.position_m - flight.world.sensors.bias_m
    assert_ornstein_uhlenbeck(off / 0.005, 0.3)
    np.testing.assert_allclose(flight.sensed.twist.velocity_m_s, flight.body.twist.velocity_m_s, atol=1e-6)
    total = np.zeros(3)
    for p in flight.sensed.pose.position_m[0].astype(np.float64):
        total = total + DT_S * p * max(0.0, 1.0 - p @ p / 0.25) ** 2
    np.testing.assert_allclose(flight.integral_m_s[0, -1], total, atol=1e-6)
    update = {"position_period_s": (1 / 30, 1 / 30), "bias_wander_m": (0.005, 0.005), "bias_wander_s": (5.0, 5.0)}
    flights = [flown(Uncertainty().model_copy(update=u)) for u in (update, update | {"bias_wander_m": (0.0, 0.0)})]
    error = flights[0].sensed.twist.velocity_m_s - flights[1].sensed.twist.velocity_m_s
    expected = 0.005 * np.sqrt(2 * (1 - np.exp(-1 / 150))) * 30  # of the difference of an OU process over 1/30 s of 5 s
    np.testing.assert_allclose(error[:, -1].std(), expected, rtol=0.15)


def test_what_is_not_asked_for_is_not_there() -> None:
    """Neither in the state of a flight, nor in a record: the fingerprints of former runs stay."""
    flight = jax.eval_shape(RealQuadrotorEnv(real_task()).reset, jax.random.PRNGKey(0)).pipeline_state.x
    assert (flight.history, flight.gust, flight.world.gust, flight.world.sensors.fixes) == ((), (), (), ())
    new = {"gust_m_s", "gust_s", "position_period_s", "position_delay_s", "bias_wander_m", "bias_wander_s"}
    assert not new & Uncertainty().model_dump().keys()
    assert new <= set(Uncertainty.model_fields)
    assert Uncertainty(gust_m_s=(0.0, 1.0)).model_dump()["gust_m_s"] == (0.0, 1.0)

"""Measures of a flight: success, settle time, steady-state errors.

For one flight: `observations` [K + 1, F] at times 0, dt, … K·dt; the caller vmaps. `of_flights` measures many flights.
A flight with a non-finite observation is a failure.
"""

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs.task import CircleReward, FlightEvaluation, PendulumEvaluation, PendulumTask, QuadrotorTask, Task


class Errors(NamedTuple):
    """Errors of one flight over time, by name, and which samples are within the tolerances."""

    finite: chex.Array  # [] bool: all observations are finite
    within: chex.Array  # [K + 1] bool
    errors: dict[str, chex.Array]  # name with unit -> [K + 1]
    most_rms_m: float | None = None  # success is the root mean square of position_m below this; None: all are `within`


def hover(observations: chex.Array, tolerance: FlightEvaluation) -> Errors:
    """Distance from the hover point [m]."""
    distance = jnp.linalg.norm(observations[:, 9:12], axis=-1)
    return Errors(_finite(observations), distance < tolerance.distance_m, {"position_m": distance})


def track(observations: chex.Array, tolerance: FlightEvaluation) -> Errors:
    """Distance from the reference [m], to which the observed positions are relative."""
    return hover(observations, tolerance)._replace(most_rms_m=tolerance.distance_m)


def circle(observations: chex.Array, tolerance: FlightEvaluation, radius_m: float, speed_m_s: float) -> Errors:
    """Radius error r − radius_m [m], height z [m], tangential speed (x·vy − y·vx)/r − speed_m_s [m/s]."""
    x, y, z, vx, vy = (observations[:, i] for i in (9, 10, 11, 12, 13))
    r = jnp.hypot(x, y)
    speed = (x * vy - y * vx) / r - speed_m_s
    assert tolerance.speed_m_s is not None  # checked by the task file's validator
    within = (jnp.hypot(r - radius_m, z) < tolerance.distance_m) & (jnp.abs(speed) < tolerance.speed_m_s)
    return Errors(_finite(observations), within, {"radius_m": r - radius_m, "height_m": z, "speed_m_s": speed})


def pendulum(observations: chex.Array, tolerance: PendulumEvaluation) -> Errors:
    """Angle from upright [rad] and rate [rad/s]."""
    theta, rate = jnp.arctan2(observations[:, 1], observations[:, 0]), observations[:, 2]
    within = (jnp.abs(theta) < tolerance.angle_rad) & (jnp.abs(rate) < tolerance.rate_rad_s)
    return Errors(_finite(observations), within, {"angle_rad": theta})


def of_vehicle(observations: chex.Array, task: QuadrotorTask) -> Errors:
    """The errors of a quadrotor's task."""
    spec = task.evaluation
    if isinstance(reward := spec.reward, CircleReward):
        return circle(observations, spec, reward.radius_m, reward.speed_m_s)
    return (track if reward.form == "track" else hover)(observations, spec)


def _finite(observations: chex.Array) -> chex.Array:
    return jnp.all(jnp.isfinite(observations))


def settle_s(within: chex.Array, dt_s: float) -> chex.Array:
    """First time [s] from which `within` [K + 1] holds to the end; infinite if it does not hold at the end; []."""
    outside = ~within
    last_outside = within.shape[0] - 1 - jnp.argmax(outside[::-1])
    settled = jnp.where(jnp.any(outside), last_outside + 1, 0)
    return jnp.where(within[-1], settled * dt_s, jnp.inf)


def summarize(flight: Errors, tail_steps: int, dt_s: float) -> dict[str, chex.Array]:
    """{"success": 0 or 1, "settle_s", "rms_<error>"…} of one flight; its tail is the last `tail_steps` periods."""
    tail = {name: error[-(tail_steps + 1) :] for name, error in flight.errors.items()}
    rms = {f"rms_{name}": jnp.sqrt(jnp.mean(error**2)) for name, error in tail.items()}
    if flight.most_rms_m is None:
        good = jnp.all(flight.within[-(tail_steps + 1) :])
    else:
        good = rms["rms_position_m"] < flight.most_rms_m
    return {
        "success": (flight.finite & good).astype(jnp.float32),
        "settle_s": jnp.where(flight.finite, settle_s(flight.within, dt_s), jnp.inf),
        **{name: jnp.where(jnp.isfinite(value), value, jnp.inf) for name, value in rms.items()},
    }


class Measured(NamedTuple):
    """Measures of n flights, in NumPy."""

    errors: dict[str, np.ndarray]  # name with unit -> [n, K + 1]
    success: np.ndarray  # [n] bool
    settle_s: np.ndarray  # [n]; infinite if it never settles


def of_flights(task: Task, observations: np.ndarray) -> Measured:
    """Errors, success and settle time of flights with `observations` [n, K + 1, F] in SI units."""
    errors, summary = jax.tree.map(np.asarray, _of_flights(task, jnp.asarray(observations, jnp.float32)))
    return Measured(errors, summary["success"] > 0, summary["settle_s"])


@functools.partial(jax.jit, static_argnums=0)
def _of_flights(task: Task, observations: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    dt_s = task.control_period_s

    def one(flight: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        errors = pendulum(flight, task.evaluation) if isinstance(task, PendulumTask) else of_vehicle(flight, task)
        return errors.errors, summarize(errors, round(task.evaluation.tail_s / dt_s), dt_s)

    return jax.vmap(one)(observations)


def failed_starts(success: np.ndarray) -> list[int]:
    """The indices of the failed flights, for `success` [n] of 0 or 1."""
    return [int(i) for i in np.flatnonzero(~(np.asarray(success) > 0))]


def list_failures(task: Task, observations: np.ndarray, success: np.ndarray, limit: int) -> list[dict[str, Any]]:
    """For the first `limit` failed flights: the index of the start, the start, and the reason of the failure.

    `observations` [n, K + 1, F] are NaN after an episode's early end. Reasons: "too far" (beyond the bound of
    distance), "tumbled" (of body rate), "did not settle", or "not finite".
    """
    return [
        {"start": i, **_start(task, observations[i, 0]), "reason": _reason(task, observations[i])}
        for i in failed_starts(success)[:limit]
    ]


def in_world(task: Task, observations: np.ndarray) -> np.ndarray:
    """Observations [n, K + 1, F] of an evaluation; where the task tracks a reference, with position and velocity in the
    world, not relative to it.
    """
    found = np.array(observations, float)
    if isinstance(task, QuadrotorTask) and (followed := task.evaluation.reference):
        reference = followed.at(np.arange(found.shape[1]) * task.control_period_s)
        found[:, :, 9:12] += reference.position_m
        found[:, :, 12:15] += reference.velocity_m_s
    return found


def tilt_deg(observations: np.ndarray) -> np.ndarray:
    """Angle between body z and world z [°], for a quadrotor's observations [..., 18]; [...]."""
    return np.degrees(np.arccos(np.clip(observations[..., 8], -1.0, 1.0)))


def speed_m_s(observations: np.ndarray) -> np.ndarray:
    """‖v‖ [m/s], for a quadrotor's observations [..., 18]; [...]."""
    return np.linalg.norm(observations[..., 12:15], axis=-1)


def _start(task: Task, observation: np.ndarray) -> dict[str, Any]:
    if not isinstance(task, QuadrotorTask):
        return {"angle_rad": float(np.arctan2(observation[1], observation[0])), "rate_rad_s": float(observation[2])}
    return {
        "tilt_deg": float(tilt_deg(observation)),
        "speed_m_s": float(speed_m_s(observation)),
        "position_m": [float(x) for x in observation[9:12]],
        "velocity_m_s": [float(x) for x in observation[12:15]],
        "body_rate_rad_s": [float(x) for x in observation[15:18]],
    }


def _reason(task: Task, observations: np.ndarray) -> str:
    invalid = np.flatnonzero(~np.isfinite(observations).all(axis=1))
    if not len(invalid):
        return "did not settle"
    if not isinstance(task, QuadrotorTask) or not invalid[0]:
        return "not finite"
    # The last valid observation is within the bounds; extrapolate it by one step to find which bound was left.
    last = observations[invalid[0] - 1]
    next_distance_m = np.linalg.norm(last[9:12] + task.control_period_s * last[12:15])
    distance = next_distance_m / task.bounds.distance_m
    rate = np.linalg.norm(last[15:18]) / task.bounds.body_rate_rad_s
    return "too far" if distance >= rate else "tumbled"

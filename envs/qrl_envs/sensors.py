"""Sensors that err, and positions that come seldom and late. For one flight; the caller vmaps.

Attitude and body rates are the gyro's, fresh at each step of the control loop. Position and velocity are, too, unless
a flight has `Fixes`: then a position is measured (by motion capture, say) once in a period, and is known a delay after.
The velocity is the difference of the last two known over a period; the position is the last known, moved by that
velocity over its age. So does the estimator of a vehicle predict between fixes; a position that is held in between
would jump at each, and be late by its whole age.
"""

from typing import NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs import noise, rotation
from qrl_envs.quadrotor import Body, Pose, Twist

EARLY = 1e-4  # of a period: what rounding may take from a fix that is due now


class Noise(NamedTuple):
    """Standard deviations of Gaussian sensor errors, independent for each axis and measurement; scalars."""

    position_m: chex.Array
    velocity_m_s: chex.Array
    attitude_rad: chex.Array
    body_rate_rad_s: chex.Array


class Fixes(NamedTuple):
    """When positions are measured, at phase_s + n·period_s for any integer n, and how their bias wanders; scalars."""

    period_s: chex.Array  # 0: at each step
    phase_s: chex.Array
    delay_s: chex.Array
    wander_m: chex.Array  # standard deviation, for each axis
    wander_s: chex.Array  # correlation time


class Sensors(NamedTuple):
    """One flight's draw."""

    noise: Noise
    bias_m: chex.Array  # [3] world
    row: chex.Array  # [] in [0, 1): where this flight begins in the tables of `noise`
    stride: chex.Array  # [] in [0, 1)
    fixes: Fixes | tuple[()] = ()  # (): positions are measured at each step


class History(NamedTuple):
    """What fixes are taken from: the state of sensors with `Fixes`."""

    position_m: chex.Array  # [H, 3] at the last H steps, the latest first, with the wandering bias
    wander: chex.Array  # [3] the bias, of its standard deviation


def begin(sensors: Sensors, body: Body, steps: int, dt_s: float) -> History | tuple[()]:
    """The history of a flight at its start, which came there at its velocity; `steps`: H."""
    if not isinstance(sensors.fixes, Fixes):
        return ()
    wander = noise.row(noise.DRIFT_TABLE, sensors.row, sensors.stride, jnp.int32(0))[:3]
    biased = body.pose.position_m + sensors.fixes.wander_m * wander
    return History(jnp.stack([biased - i * dt_s * body.twist.velocity_m_s for i in range(steps)]), wander)


def follow(
    sensors: Sensors, history: History | tuple[()], body: Body, steps: chex.Array, dt_s: float
) -> History | tuple[()]:
    """The history a period later, at the body of int32 step `steps`."""
    if not (isinstance(history, History) and isinstance(sensors.fixes, Fixes)):
        return ()
    normal = noise.row(noise.DRIFT_TABLE, sensors.row, sensors.stride, steps)[:3]
    wander = noise.ornstein_uhlenbeck(history.wander, normal, sensors.fixes.wander_s, dt_s)
    biased = body.pose.position_m + sensors.fixes.wander_m * wander
    return History(jnp.concatenate([biased[None], history.position_m[:-1]]), wander)


def sense(sensors: Sensors, history: History | tuple[()], body: Body, steps: chex.Array, dt_s: float) -> Body:
    """`body` as measured at a flight's int32 step: each flight errs by a sequence of its own."""
    size = sensors.noise
    now = _errors(sensors, steps)
    # A small-angle quaternion, normalized: a rotation exactly, its angle to 1e-5 of itself.
    small = rotation.normalize(jnp.concatenate([jnp.ones_like(now[2, :1]), size.attitude_rad / 2 * now[2]]))
    attitude = rotation.product(body.pose.attitude, small)
    rate = body.twist.body_rate_rad_s + size.body_rate_rad_s * now[3]
    if isinstance(history, History) and isinstance(sensors.fixes, Fixes):
        position, velocity = _from_fixes(sensors, sensors.fixes, history, body.twist.velocity_m_s, steps, dt_s)
    else:
        position = body.pose.position_m + sensors.bias_m + size.position_m * now[0]
        velocity = body.twist.velocity_m_s
    return Body(Pose(position, attitude), Twist(velocity + size.velocity_m_s * now[1], rate))


def _from_fixes(
    sensors: Sensors, fixes: Fixes, history: History, velocity_m_s: chex.Array, steps: chex.Array, dt_s: float
) -> tuple[chex.Array, chex.Array]:
    """Position and velocity [3] by the last two fixes that are known; without period and delay, as they are."""
    period_s = jnp.maximum(fixes.period_s, dt_s)
    now_s = dt_s * steps
    number = jnp.floor((now_s - fixes.delay_s - fixes.phase_s) / period_s + EARLY)
    age_s = now_s - fixes.phase_s - number * period_s

    def fix(number: chex.Array, age_s: chex.Array) -> chex.Array:
        # Linear between steps: off by at most dt²/8 of the acceleration, 0.1 mm at 10 m/s² and 100 Hz.
        back = jnp.arange(history.position_m.shape[0]).reshape(-1, *[1] * age_s.ndim)
        share = jnp.maximum(0.0, 1.0 - jnp.abs(age_s / dt_s - back))
        error = sensors.noise.position_m * _errors(sensors, number.astype(jnp.int32))[0]
        return jnp.sum(share[:, None] * history.position_m, axis=0) + error

    last, before = fix(number, age_s), fix(number - 1.0, age_s + period_s)
    derived = (last - before) / period_s
    fresh = (fixes.period_s == 0.0) & (fixes.delay_s == 0.0)
    return last + age_s * derived + sensors.bias_m, jnp.where(fresh, velocity_m_s, derived)


def _errors(sensors: Sensors, index: chex.Array) -> chex.Array:
    """Standard normal numbers [4, 3]: position, velocity, attitude, body rate."""
    row = noise.row(noise.SENSOR_TABLE, sensors.row, sensors.stride, index)
    return row.reshape(4, 3, *index.shape)

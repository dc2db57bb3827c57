"""A geometric tracking controller on SE(3), after Lee, Leok and McClamroch 2010 (CDC, pp. 5420–5425).

In their symbols: R, v, Omega of the vehicle; the desired force gives the thrust f = F_d·b_3 and the desired body axis
b_3d = F_d/‖F_d‖, whose rate Omega_d is fed forward; the moment M follows from the errors of attitude and rate on SO(3).
Differences: the reference is a velocity field around the target, without a clock: a position gives the desired velocity
and, by its derivatives, acceleration and jerk. Desired speeds and rates are limited to what can still be braked. The
attitude error is split into the tilt of b_3 and the heading, which matters less and has little torque.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs.controllers.mixer import action, mixer
from qrl_envs.task import CircleReward, HoverReward, QuadrotorTask, TrackReward
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2

TINY = 1e-6


class Gains(NamedTuple):
    """Bandwidths [1/s], and shares of the vehicle's own limits; mass, inertia and motors come from the vehicle."""

    position_1_s: float = 7.5  # desired speed per distance, near the target
    velocity_1_s: float = 6.5  # acceleration per velocity error
    tilt_1_s: float = 12.0  # desired rate per tilt error, near b_3d
    heading_1_s: float = 4.5
    rate_1_s: float = 30.0  # angular acceleration per rate error
    heading_rate_1_s: float = 9.0
    acceleration_share: float = 0.95  # of the maximum lift, less weight: limit of the desired acceleration
    braking_share: float = 0.27  # of that limit: the deceleration that desired speeds allow for
    angular_braking_share: float = 0.7  # of the maximum torque: the deceleration that desired rates allow for
    lift_error_share: float = 0.11  # of the maximum lift: the lift error accepted in favor of torque
    upward_share: float = 0.1  # of the weight: lower limit of the desired vertical force


def controller(task: QuadrotorTask, gains: Gains = Gains()) -> Callable[[chex.Array], chex.Array]:  # noqa: B008
    """The controller of a task's training reward: observation [..., 18 or more] -> action [..., 4] in [−1, 1].

    On the circle the heading is free; else body x is turned to world x. To track it accelerates as the reference does
    on average until the first time of the preview, if there is one.
    """
    vehicle, motors = task.vehicle, mixer(task.vehicle)
    inertia_kg_m2 = np.asarray(vehicle.inertia_kg_m2, np.float32)
    field = _velocity_field(task.reward)
    ahead_s = task.preview_s[0] if task.preview_s else None
    gravity = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2], np.float32)
    max_accel_m_s2 = gains.acceleration_share * motors.lift_N / vehicle.mass_kg - STANDARD_GRAVITY_M_S2
    braking_rad_s2 = gains.angular_braking_share * motors.torque_N_m / inertia_kg_m2

    def desired_force(
        position_m: chex.Array, velocity_m_s: chex.Array, reference_m_s2: chex.Array | float
    ) -> chex.Array:
        """F_d per mass [3] [m/s²], world."""
        accel = _desired_acceleration(
            lambda p: field(p, gains.position_1_s, gains.braking_share * max_accel_m_s2),
            position_m,
            velocity_m_s,
            gains.velocity_1_s,
            task.control_period_s,
        )
        accel = accel + reference_m_s2
        limited = accel * jnp.minimum(1.0, max_accel_m_s2 / jnp.maximum(_norm(accel), TINY))
        force: chex.Array = jnp.asarray(gravity) + limited
        return force.at[2].max(gains.upward_share * STANDARD_GRAVITY_M_S2)

    def control(observation: chex.Array) -> chex.Array:
        R = observation[:9].reshape(3, 3)
        position, velocity, Omega = observation[9:12], observation[12:15], observation[15:18]
        followed = 0.0 if ahead_s is None else observation[18:21] / ahead_s

        def desired(position_m: chex.Array, velocity_m_s: chex.Array) -> chex.Array:
            return desired_force(position_m, velocity_m_s, followed)

        b_3 = R[:, 2]
        lift = jnp.clip(jnp.dot(desired(position, velocity), b_3), 0.0, motors.lift_N / vehicle.mass_kg)
        F_d, jerk = jax.jvp(desired, (position, velocity), (velocity, lift * b_3 - gravity))
        b_3d = F_d / _norm(F_d)
        Omega_d = R.T @ jnp.cross(b_3d, jerk) / _norm(F_d) * jnp.array([1.0, 1.0, 0.0])  # of b_3d [rad/s], body
        max_feedforward = jnp.min(braking_rad_s2[:2]) / gains.tilt_1_s
        Omega_d *= jnp.minimum(1.0, max_feedforward / jnp.maximum(_norm(Omega_d), TINY))
        feedback = _rate_feedback(R, b_3d, not isinstance(task.reward, CircleReward), gains, braking_rad_s2)
        e_Omega = Omega - (feedback + Omega_d)
        k_Omega = jnp.array([gains.rate_1_s, gains.rate_1_s, gains.heading_rate_1_s])
        M: chex.Array = jnp.asarray(inertia_kg_m2) * (-k_Omega * e_Omega) + jnp.cross(Omega, inertia_kg_m2 * Omega)
        lift_N = vehicle.mass_kg * (lift - STANDARD_GRAVITY_M_S2)
        return action(motors, lift_N, M, gains.lift_error_share * motors.lift_N)

    return jnp.vectorize(control, signature="(n)->(m)")


def _velocity_field(
    reward: HoverReward | CircleReward | TrackReward,
) -> Callable[[chex.Array, float, float], chex.Array]:
    """The desired velocity [3] [m/s] at a position [3] [m], for a bandwidth [1/s] and a deceleration [m/s²]."""
    if not isinstance(reward, CircleReward):
        return lambda position, bandwidth, braking: -position * _speed_per_distance(_norm(position), bandwidth, braking)

    def circle(position: chex.Array, bandwidth: float, braking: float) -> chex.Array:
        x, y, z = position
        radius = _norm(position[:2])
        inner = jnp.maximum(radius, 0.5 * reward.radius_m)  # no direction is outward at the center
        outward = jnp.stack([x, y, jnp.zeros_like(x)]) / inner
        tangent = jnp.stack([-y, x, jnp.zeros_like(x)]) / inner
        error = outward * (radius - reward.radius_m) + jnp.stack([jnp.zeros_like(z)] * 2 + [z])
        return reward.speed_m_s * tangent - error * _speed_per_distance(_norm(error), bandwidth, braking)

    return circle


def _desired_acceleration(
    field: Callable[[chex.Array], chex.Array], position: chex.Array, velocity: chex.Array, bandwidth: float, dt_s: float
) -> chex.Array:
    """The acceleration [3] [m/s²] that brings the velocity to the field's and then follows the field.

    A simulator step updates the velocity before the position, so a velocity belongs to the middle of the step before.
    On a circle of 1 m at 2 m/s this half step is worth 3 mm.
    """
    middle = position - 0.5 * dt_s * velocity
    here, slope = jax.jvp(field, (middle,), (velocity,))
    ahead = field(position + 0.5 * dt_s * (velocity + dt_s * slope))
    return (ahead - here) / dt_s + bandwidth * (here - velocity)


def _rate_feedback(R: chex.Array, b_3d: chex.Array, heading: bool, gains: Gains, braking_rad_s2: np.ndarray):
    """Body rates [3] [rad/s] that bring b_3 to `b_3d` [3] (world) and, if `heading`, body x to world x."""
    target = R.T @ b_3d
    sine = jnp.hypot(target[0], target[1])
    inverted = (sine < TINY) & (target[2] < 0)  # exactly opposite: every axis is as short
    angle = jnp.arctan2(sine, target[2])
    axis = jnp.where(inverted, jnp.array([1.0, 0.0]), jnp.stack([-target[1], target[0]]) / jnp.maximum(sine, TINY))
    tilt_rate = axis * angle * _speed_per_distance(angle, gains.tilt_1_s, jnp.min(braking_rad_s2[:2]))
    if not heading:
        return jnp.append(tilt_rate, 0.0)
    error = _shortest_rotation(b_3d).T @ R
    psi = jnp.arctan2(error[1, 0] - error[0, 1], error[0, 0] + error[1, 1])
    return jnp.append(tilt_rate, -psi * _speed_per_distance(jnp.abs(psi), gains.heading_1_s, braking_rad_s2[2]))


def _shortest_rotation(b_3d: chex.Array) -> chex.Array:
    """R_d [3, 3] with zero heading: the shortest rotation of world z to `b_3d` [3]."""
    x, y, z = b_3d
    k = 1.0 / jnp.maximum(1.0 + z, TINY)
    return jnp.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def _speed_per_distance(distance: chex.Array, bandwidth: float, braking: chex.Array | float) -> chex.Array:
    """Speed per distance: the bandwidth near the target; farther away the speed from which `braking` still stops."""
    near = braking / bandwidth**2
    far = jnp.maximum(distance, near)
    return jnp.sqrt(braking * (2.0 * far - near)) / far


def _norm(x: chex.Array) -> chex.Array:
    """‖x‖ with gradient 0 at 0, where it has none."""
    square = jnp.sum(x**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)

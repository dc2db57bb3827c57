"""A geometric tracking controller on SE(3), after Lee, Leok and McClamroch 2010 (CDC, pp. 5420–5425).

As there, the force that the wanted motion needs is projected on the body's z axis for the lift, its direction is the
attitude to track, with the rate at which it turns fed forward, and the torque is computed from the attitude's error on
SO(3). What differs: the wanted motion is a field of velocities about the target, which needs no clock (from where the
vehicle is, it says how fast to go and, by its derivatives, with which acceleration and jerk); speeds are what can still
be braked, of the vehicle in space as of its attitude; and the error of attitude is parted into the tilt of the body's
axis and the heading, of which the first matters and the second is weak in torque.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs.controllers.mixer import action, mixer
from qrl_envs.task import STANDARD_GRAVITY_M_S2, CircleReward, HoverReward, QuadrotorTask

TINY = 1e-6


class Gains(NamedTuple):
    """Bandwidths in 1/s and shares of what the vehicle can: masses, inertias and motors are the vehicle's own."""

    position_1_s: float = 7.5  # wanted speed per distance, near the target
    velocity_1_s: float = 6.5  # acceleration per error of velocity
    tilt_1_s: float = 12.0  # wanted rate per angle, near the wanted direction
    heading_1_s: float = 4.5
    rate_1_s: float = 30.0  # angular acceleration per error of rate
    heading_rate_1_s: float = 9.0
    thrust_share: float = 0.95  # of the greatest lift, less weight: the acceleration that is ever wanted
    braking_share: float = 0.27  # of that acceleration: what speeds towards the target count on
    slewing_share: float = 0.7  # of the greatest torque: what rates towards an attitude count on
    leeway_share: float = 0.11  # of the greatest lift: how far it may be off for the sake of attitude
    falling_share: float = 0.1  # of the weight: the least force upward, whatever the motion wants


def controller(task: QuadrotorTask, gains: Gains = Gains()) -> Callable[[chex.Array], chex.Array]:  # noqa: B008
    """Hover or circle, as the task's reward says: observation [..., 18] -> action [..., 4] in [−1, 1].

    On the circle it flies whichever way the body is headed; in a hover body x is turned along world x.
    """
    vehicle, motors = task.vehicle, mixer(task.vehicle)
    inertia_kg_m2 = np.asarray(vehicle.inertia_kg_m2, np.float32)
    field = _field(task.reward)
    gravity = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2], np.float32)
    most_m_s2 = gains.thrust_share * motors.lift_N / vehicle.mass_kg - STANDARD_GRAVITY_M_S2
    slewing_rad_s2 = gains.slewing_share * motors.torque_N_m / inertia_kg_m2

    def wanted(position_m: chex.Array, velocity_m_s: chex.Array) -> chex.Array:
        """Force per mass [3] [m/s²], world."""
        free = _acceleration(
            lambda p: field(p, gains.position_1_s, gains.braking_share * most_m_s2),
            position_m,
            velocity_m_s,
            gains.velocity_1_s,
            task.control_period_s,
        )
        force: chex.Array = jnp.asarray(gravity) + free * jnp.minimum(1.0, most_m_s2 / jnp.maximum(_norm(free), TINY))
        return force.at[2].max(gains.falling_share * STANDARD_GRAVITY_M_S2)

    def control(observation: chex.Array) -> chex.Array:
        attitude = observation[:9].reshape(3, 3)
        position, velocity, rate = observation[9:12], observation[12:15], observation[15:18]
        up = attitude[:, 2]
        lift = jnp.clip(jnp.dot(wanted(position, velocity), up), 0.0, motors.lift_N / vehicle.mass_kg)
        force, jerk = jax.jvp(wanted, (position, velocity), (velocity, lift * up - gravity))
        direction = force / _norm(force)
        turning = attitude.T @ jnp.cross(direction, jerk) / _norm(force)  # of the wanted direction [rad/s], body
        rates = _rates(attitude, direction, isinstance(task.reward, HoverReward), gains, slewing_rad_s2)
        fed = turning * jnp.array([1.0, 1.0, 0.0])
        most = jnp.min(slewing_rad_s2[:2]) / gains.tilt_1_s
        fed *= jnp.minimum(1.0, most / jnp.maximum(_norm(fed), TINY))
        per_rate = jnp.array([gains.rate_1_s, gains.rate_1_s, gains.heading_rate_1_s])
        spinning = per_rate * (rates + fed - rate)
        torque: chex.Array = jnp.asarray(inertia_kg_m2) * spinning + jnp.cross(rate, inertia_kg_m2 * rate)
        return action(
            motors, vehicle.mass_kg * (lift - STANDARD_GRAVITY_M_S2), torque, gains.leeway_share * motors.lift_N
        )

    return jnp.vectorize(control, signature="(n)->(m)")


def _field(reward: HoverReward | CircleReward) -> Callable[[chex.Array, float, float], chex.Array]:
    """The wanted velocity [3] [m/s] at a position [3] [m], with a bandwidth [1/s] and a deceleration [m/s²]."""
    if isinstance(reward, HoverReward):
        return lambda position, bandwidth, braking: -position * _speed_per_distance(_norm(position), bandwidth, braking)

    def circling(position: chex.Array, bandwidth: float, braking: float) -> chex.Array:
        x, y, z = position
        radius = _norm(position[:2])
        inner = jnp.maximum(radius, 0.5 * reward.radius_m)  # no direction is outward at the centre
        outward = jnp.stack([x, y, jnp.zeros_like(x)]) / inner
        along = jnp.stack([-y, x, jnp.zeros_like(x)]) / inner
        off = outward * (radius - reward.radius_m) + jnp.stack([jnp.zeros_like(z)] * 2 + [z])
        return reward.speed_m_s * along - off * _speed_per_distance(_norm(off), bandwidth, braking)

    return circling


def _acceleration(
    field: Callable[[chex.Array], chex.Array], position: chex.Array, velocity: chex.Array, bandwidth: float, dt_s: float
) -> chex.Array:
    """That [3] [m/s²] which takes the velocity to the field's, and on along it.

    A step of the world sets the velocity first and moves with it: a velocity belongs to the middle of the step before.
    On a circle of 1 m at 2 m/s the half step is worth 3 mm.
    """
    middle = position - 0.5 * dt_s * velocity
    here, onward = jax.jvp(field, (middle,), (velocity,))
    there = field(position + 0.5 * dt_s * (velocity + dt_s * onward))
    return (there - here) / dt_s + bandwidth * (here - velocity)


def _rates(attitude: chex.Array, direction: chex.Array, heading: bool, gains: Gains, slewing_rad_s2: np.ndarray):
    """Wanted body rates [3] [rad/s] to bring body z along `direction` [3] (world) and, if `heading`, body x about."""
    seen = attitude.T @ direction
    sine = jnp.hypot(seen[0], seen[1])
    behind = (sine < TINY) & (seen[2] < 0)  # right upside down: any way round is as near
    angle = jnp.arctan2(sine, seen[2])
    axis = jnp.where(behind, jnp.array([1.0, 0.0]), jnp.stack([-seen[1], seen[0]]) / jnp.maximum(sine, TINY))
    tilting = axis * angle * _speed_per_distance(angle, gains.tilt_1_s, jnp.min(slewing_rad_s2[:2]))
    if not heading:
        return jnp.append(tilting, 0.0)
    error = _upright(direction).T @ attitude
    off = jnp.arctan2(error[1, 0] - error[0, 1], error[0, 0] + error[1, 1])
    return jnp.append(tilting, -off * _speed_per_distance(jnp.abs(off), gains.heading_1_s, slewing_rad_s2[2]))


def _upright(direction: chex.Array) -> chex.Array:
    """The attitude [3, 3] that turns world z to `direction` [3] the shortest way: no axis comes before another."""
    x, y, z = direction
    k = 1.0 / jnp.maximum(1.0 + z, TINY)
    return jnp.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def _speed_per_distance(distance: chex.Array, bandwidth: float, braking: chex.Array | float) -> chex.Array:
    """Speed per distance: the bandwidth near the target, and as much as `braking` still stops farther away."""
    near = braking / bandwidth**2
    far = jnp.maximum(distance, near)
    return jnp.sqrt(braking * (2.0 * far - near)) / far


def _norm(x: chex.Array) -> chex.Array:
    """‖x‖ with a gradient of 0 at 0, where it has none."""
    square = jnp.sum(x**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)

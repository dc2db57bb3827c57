"""The paper's quadrotor: a rigid body under gravity and motor thrust (Sec. 5). For one vehicle; the caller vmaps.

World and body frames: x forward, y left, z up. Quaternions [w, x, y, z], body -> world.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import integrate, rotation
from qrl_envs.task import FlightStart
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle


class Physics(NamedTuple):
    """A vehicle's parameters as float32 arrays, so that they batch and differentiate."""

    mass_kg: chex.Array  # []
    inertia_kg_m2: chex.Array  # [3] principal, about body x, y, z
    motor_position_m: chex.Array  # [4, 2] x, y in the body frame
    motor_spin: chex.Array  # [4] +1: reaction torque positive about body z
    motor_max_N: chex.Array  # [4]
    yaw_moment_m: chex.Array  # [] reaction torque per thrust
    hover_thrust_N: chex.Array  # [4] F_o: carries the weight without torque; mg/4 each in the paper (equ:forceOutput)
    action_scale_N: chex.Array  # []
    gravity_m_s2: chex.Array  # []


class Pose(NamedTuple):
    position_m: chex.Array  # [3] world
    attitude: chex.Array  # [4] quaternion body -> world


class Twist(NamedTuple):
    velocity_m_s: chex.Array  # [3] world
    body_rate_rad_s: chex.Array  # [3] body


class Body(NamedTuple):
    """The state of a rigid body."""

    pose: Pose
    twist: Twist


class Start(NamedTuple):
    """Half-widths of the uniform start ranges, about zero; scalars."""

    position_m: chex.Array  # world
    velocity_m_s: chex.Array  # world
    body_rate_rad_s: chex.Array  # body
    tilt_rad: chex.Array  # greatest tilt from upright


def physics(vehicle: Vehicle) -> Physics:
    """The parameters of a vehicle file."""
    return Physics(
        mass_kg=jnp.float32(vehicle.mass_kg),
        inertia_kg_m2=jnp.asarray(vehicle.inertia_kg_m2, jnp.float32),
        motor_position_m=jnp.asarray([m.position_m for m in vehicle.motors], jnp.float32),
        motor_spin=jnp.asarray([m.spin for m in vehicle.motors], jnp.float32),
        motor_max_N=jnp.asarray([m.max_N for m in vehicle.motors], jnp.float32),
        yaw_moment_m=jnp.float32(vehicle.yaw_moment_m),
        hover_thrust_N=jnp.asarray(vehicle.hover_thrusts_N, jnp.float32),
        action_scale_N=jnp.float32(vehicle.action_scale_N),
        gravity_m_s2=jnp.float32(STANDARD_GRAVITY_M_S2),
    )


def start(ranges: FlightStart) -> Start:
    """The start ranges of a task file."""
    return Start(*(jnp.float32(getattr(ranges, field)) for field in Start._fields))


def thrust_N(physics: Physics, action: chex.Array) -> chex.Array:
    """F = clip(F_o + action_scale·a, 0, max) of each motor [N], for an action clipped to [−1, 1]; [4] -> [4]."""
    command = physics.hover_thrust_N + physics.action_scale_N * jnp.clip(action, -1.0, 1.0)
    return jnp.clip(command, 0.0, physics.motor_max_N)


def applied_action(physics: Physics, thrust: chex.Array) -> chex.Array:
    """The action of rewards: a = (F − F_o)/action_scale for the applied thrust F [N]; [4] -> [4]."""
    return (thrust - physics.hover_thrust_N) / physics.action_scale_N


def derivative(physics: Physics, body: Body, thrust: chex.Array) -> Body:
    """d(body)/dt under gravity and motor thrust [4] [N] along body z, by the Newton–Euler equations."""
    omega = body.twist.body_rate_rad_s
    x, y = physics.motor_position_m[:, 0], physics.motor_position_m[:, 1]
    torque = jnp.stack(
        [jnp.sum(y * thrust), -jnp.sum(x * thrust), physics.yaw_moment_m * jnp.sum(physics.motor_spin * thrust)]
    )
    body_z = rotation.matrix(body.pose.attitude)[:, 2]
    gravity = jnp.stack([jnp.zeros_like(physics.gravity_m_s2)] * 2 + [physics.gravity_m_s2])
    return Body(
        pose=Pose(body.twist.velocity_m_s, rotation.derivative(body.pose.attitude, omega)),
        twist=Twist(
            velocity_m_s=body_z * (jnp.sum(thrust) / physics.mass_kg) - gravity,
            body_rate_rad_s=(torque - jnp.cross(omega, physics.inertia_kg_m2 * omega)) / physics.inertia_kg_m2,
        ),
    )


def step(physics: Physics, body: Body, thrust: chex.Array, dt_s: float) -> Body:
    """One control period under constant thrust [4] [N], by semi-implicit Euler: twist first, then pose."""
    body = integrate.semi_implicit_euler(lambda b: derivative(physics, b, thrust), body, dt_s)
    return body._replace(pose=body.pose._replace(attitude=rotation.normalize(body.pose.attitude)))


def step_rk4(physics: Physics, body: Body, thrust: chex.Array, dt_s: float, substeps: int) -> Body:
    """One control period under constant thrust [4] [N], by RK4 in equal substeps: more accurate than `step`."""

    def substep(_: int, body: Body) -> Body:
        body = integrate.rk4(lambda b: derivative(physics, b, thrust), body, dt_s / substeps)
        return body._replace(pose=body.pose._replace(attitude=rotation.normalize(body.pose.attitude)))

    return jax.lax.fori_loop(0, substeps, substep, body)


def observe(body: Body) -> chex.Array:
    """The observation [18]: rotation matrix body -> world row-major, position [m] and
    velocity [m/s] (world), body rates [rad/s].
    """
    return jnp.concatenate([rotation.matrix(body.pose.attitude).reshape(9), body.pose.position_m, *body.twist])


def draw(start: Start, key: chex.PRNGKey) -> Body:
    """A random start: attitude uniform within the tilt, every other coordinate uniform within ± its range."""
    u = jax.random.uniform(key, (4, 3))  # one draw, because random draws dominate the compile time of a reset
    position, velocity, rate = 2.0 * u[1:] - 1.0
    return Body(
        Pose(start.position_m * position, rotation.uniform(u[0], start.tilt_rad)),
        Twist(start.velocity_m_s * velocity, start.body_rate_rad_s * rate),
    )

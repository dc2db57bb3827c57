"""The paper's quadrotor: a rigid body under gravity and motor thrust (Sec. 5). For one vehicle; the caller vmaps.

World and body frames: x forward, y left, z up. Quaternions [w, x, y, z], body -> world.
"""

from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import integrate, rotation
from qrl_envs.fusion import stored
from qrl_envs.task import FlightStart
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle


class Physics(NamedTuple):
    """A vehicle's parameters as float32 arrays, so that they batch and differentiate; N motors."""

    mass_kg: chex.Array  # []
    inertia_kg_m2: chex.Array  # [3] about body x, y, z; or the matrix [3, 3]
    motor_axis: chex.Array | None  # [3, N] unit vectors of thrust, body frame; None: all along body z
    motor_torque_m: chex.Array  # [3, N] torque about body x, y, z per thrust
    motor_min_N: chex.Array  # [N]
    motor_max_N: chex.Array  # [N]
    hover_thrust_N: chex.Array  # [N] F_o: carries the weight without torque; mg/4 each in the paper (equ:forceOutput)
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
    # 1: each start shrinks all ranges by a factor of its own; None: none does; 0: none, where others of a batch do
    nested: chex.Array | None = None


def physics(vehicle: Vehicle) -> Physics:
    """The parameters of a vehicle file."""
    principal = len(vehicle.inertia_kg_m2) == 3
    inertia = vehicle.inertia_kg_m2 if principal else vehicle.inertia_matrix_kg_m2
    return Physics(
        mass_kg=jnp.float32(vehicle.mass_kg),
        inertia_kg_m2=jnp.asarray(inertia, jnp.float32),
        motor_axis=None if vehicle.upright else jnp.asarray(vehicle.motor_axes, jnp.float32),
        motor_torque_m=jnp.asarray(vehicle.torques_m, jnp.float32),
        motor_min_N=jnp.asarray([m.min_N for m in vehicle.motors], jnp.float32),
        motor_max_N=jnp.asarray([m.max_N for m in vehicle.motors], jnp.float32),
        hover_thrust_N=jnp.asarray(vehicle.hover_thrusts_N, jnp.float32),
        action_scale_N=jnp.float32(vehicle.action_scale_N),
        gravity_m_s2=jnp.float32(STANDARD_GRAVITY_M_S2),
    )


def start(ranges: FlightStart) -> Start:
    """The start ranges of a task file."""
    values = [jnp.float32(getattr(ranges, field)) for field in Start._fields[:-1]]
    return Start(*values, nested=jnp.float32(1.0) if ranges.nested else None)


def thrust_N(physics: Physics, action: chex.Array) -> chex.Array:
    """F = clip(F_o + action_scale·a, min, max) of each motor [N], for an action clipped to [−1, 1]; [N] -> [N]."""
    command = physics.hover_thrust_N + physics.action_scale_N * jnp.clip(action, -1.0, 1.0)
    return jnp.clip(command, physics.motor_min_N, physics.motor_max_N)


def applied_action(physics: Physics, thrust: chex.Array) -> chex.Array:
    """The action of rewards: a = (F − F_o)/action_scale for the applied thrust F [N]; [N] -> [N]."""
    return (thrust - physics.hover_thrust_N) / physics.action_scale_N


class Disturbance(NamedTuple):
    """What acts on the body beside gravity and motors."""

    drag_N_s_m: chex.Array  # [3] linear, along body x, y, z
    wind_m_s: chex.Array  # [3] world
    force_N: chex.Array  # [3] world
    torque_N_m: chex.Array  # [3] body
    drag_height_m: chex.Array  # [] of where drag acts above the center of mass, along body z


def derivative(physics: Physics, body: Body, thrust: chex.Array, disturbance: Disturbance | None = None) -> Body:
    """d(body)/dt under gravity and motor thrust [N] [N], by the Newton–Euler equations."""
    omega = body.twist.body_rate_rad_s
    torque = stored(_product(physics.motor_torque_m, thrust))
    rotation_matrix = rotation.matrix(body.pose.attitude)
    if physics.motor_axis is None:
        acceleration = jnp.unstack(rotation_matrix, axis=1)[2] * (sum(jnp.unstack(thrust)) / physics.mass_kg)
    else:
        acceleration = _product(rotation_matrix, _product(physics.motor_axis, thrust) / physics.mass_kg)
    if disturbance is not None:
        air_speed = _product(
            jnp.swapaxes(rotation_matrix, 0, 1), body.twist.velocity_m_s - disturbance.wind_m_s
        )  # body
        body_drag = stored(disturbance.drag_N_s_m * air_speed)
        drag = _product(rotation_matrix, body_drag)
        acceleration = acceleration + (disturbance.force_N - drag) / physics.mass_kg
        x, y, z = jnp.unstack(disturbance.drag_height_m * body_drag)  # torque about the center of mass: height × −drag
        torque = torque + disturbance.torque_N_m + jnp.stack([y, -x, jnp.zeros_like(z)])
    gravity = jnp.stack([jnp.zeros_like(physics.gravity_m_s2)] * 2 + [physics.gravity_m_s2])
    inertia = physics.inertia_kg_m2
    if inertia.ndim == omega.ndim:
        angular = (torque - rotation.cross(omega, inertia * omega)) / inertia
    else:
        angular = _solve(inertia, torque - rotation.cross(omega, _product(inertia, omega)))
    return Body(
        pose=Pose(body.twist.velocity_m_s, rotation.derivative(body.pose.attitude, omega)),
        twist=Twist(velocity_m_s=acceleration - gravity, body_rate_rad_s=angular),
    )


def _product(matrix: chex.Array, vector: chex.Array) -> chex.Array:
    """[3, n], [n] -> [3], exact on a GPU too, unlike a matrix product.

    Term by term: a CPU takes half as long again for sums over an axis as short as this.
    """
    first, *others = zip(jnp.unstack(matrix, axis=1), jnp.unstack(vector), strict=True)
    return sum((column * x for column, x in others), first[0] * first[1])


def _solve(matrix: chex.Array, vector: chex.Array) -> chex.Array:
    """matrix⁻¹·vector of a symmetric [3, 3], by Cramer's rule; [3]."""
    a, b, c = matrix
    adjugate = jnp.stack([rotation.cross(b, c), rotation.cross(c, a), rotation.cross(a, b)])
    return _product(adjugate, vector) / jnp.sum(a * adjugate[0], axis=0)


def step(physics: Physics, body: Body, thrust: chex.Array, dt_s: float) -> Body:
    """One control period under constant thrust [4] [N], by semi-implicit Euler: twist first, then pose."""
    body = integrate.semi_implicit_euler(lambda b: derivative(physics, b, thrust), body, dt_s)
    return body._replace(pose=body.pose._replace(attitude=rotation.normalize(body.pose.attitude)))


def observe(body: Body) -> chex.Array:
    """The observation [18]: rotation matrix body -> world row-major, position [m] and
    velocity [m/s] (world), body rates [rad/s].
    """
    return jnp.concatenate([*jnp.unstack(rotation.matrix(body.pose.attitude)), body.pose.position_m, *body.twist])


class BodyView(NamedTuple):
    """What a policy is given in the body frame."""

    heading: bool  # the world's x axis, too
    vectors: int  # vectors of the world that follow the 18 numbers
    last: int  # numbers at the end that are a vector of the world, too: x, y, z, or x and y of one that is horizontal


def in_body_frame(observation: chex.Array, view: BodyView) -> chex.Array:
    """An observation as it is in the body frame: the world's x axis [3], if `heading`, and its z axis [3], position
    [3], velocity [3], body rates [3], the vectors that follow; what is neither; the vector at the end [3].
    """
    numbers = jnp.unstack(observation, axis=-1)
    rows = numbers[0:3], numbers[3:6], numbers[6:9]

    def rotated(vector: Sequence[chex.Array]) -> list[chex.Array]:
        return [
            sum(row[j] * x for row, x in zip(rows[1:], vector[1:], strict=False)) + rows[0][j] * vector[0]
            for j in range(3)
        ]

    first = [*rows[0], *rows[2]] if view.heading else [*rows[2]]
    middle, end = 18 + 3 * view.vectors, len(numbers) - view.last
    vectors = [x for at in range(18, middle, 3) for x in rotated(numbers[at : at + 3])]
    last = rotated(numbers[end:]) if view.last else []
    body = [*first, *rotated(numbers[9:12]), *rotated(numbers[12:15]), *numbers[15:18], *vectors]
    return jnp.stack([*body, *numbers[middle:end], *last], axis=-1)


def draw(start: Start, key: chex.PRNGKey) -> Body:
    """A random start: attitude uniform within the tilt, every other coordinate uniform within ± its range."""
    u = jax.random.uniform(key, (4, 3))  # one draw, because random draws dominate the compile time of a reset
    position, velocity, rate = 2.0 * u[1:] - 1.0
    if start.nested is not None:
        shrunk = 1.0 - start.nested * jax.random.uniform(jax.random.fold_in(key, 1))
        start = Start(*(shrunk * x for x in start[:-1]))
    return Body(
        Pose(start.position_m * position, rotation.uniform(u[0], start.tilt_rad)),
        Twist(start.velocity_m_s * velocity, start.body_rate_rad_s * rate),
    )

"""Linear quadratic regulators of hover and circle, in discrete time.

The simulator's own step is linearized about a trim: hover or, on the circle, the steady turn. The turn is constant in
a frame that rotates with the vehicle about the circle's axis: constant roll, body x along the circle. The error is
position [m], velocity [m/s], attitude (the rotation vector from the trim attitude, body) [rad] and body rates [rad/s];
on the circle the position along it is left out. The constant gain solves the discrete algebraic Riccati equation
(Anderson and Moore, Optimal Control, 1990, Sec. 2.4).

Position, and on the circle chi, have the weights of the evaluation's reward, on squares instead of norms. Attitude and
action follow Bryson's rule: half a turn, and a motor's full action, cost as much as the farthest start. (The reward's
own weights of these ask for actions beyond the motors' limits, and fail from more starts.)

The controller is linear: nothing is guaranteed far from the trim.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from qrl_envs import quadrotor, rotation
from qrl_envs.quadrotor import Body, Pose, Twist
from qrl_envs.task import CircleReward, HoverReward, QuadrotorTask
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2

Array = Any  # NumPy's in the design, JAX's in the controller

NEWTON_STEPS = 8
ERRORS = 12
ALONG_TRACK = 1  # index of the position error along the circle


class Trim(NamedTuple):
    """The motion to regulate about, constant in its frame."""

    position_m: Array  # [3]
    velocity_m_s: Array  # [3]
    attitude: Array  # [4] quaternion, body -> frame
    body_rate_rad_s: Array  # [3]
    action: Array  # [A], one of each motor


class LinearModel(NamedTuple):
    """error[k+1] = a · error[k] + b · (action[k] − trim.action). NumPy, float64; n is 12, on the circle 11."""

    trim: Trim
    a: np.ndarray  # [n, n]
    b: np.ndarray  # [n, A]


def controller(task: QuadrotorTask) -> Callable[[chex.Array], chex.Array]:
    """The regulator of a task's training reward: observation [..., 18 or more] -> action [..., A] in [−1, 1].

    Raises NumPy's LinAlgError if the motors cannot stabilize the vehicle.
    """
    model = linearize(task)
    return state_feedback(model.trim, gain(model, *weights(task)).astype(np.float32))


def state_feedback(trim: Trim, gain: np.ndarray) -> Callable[[chex.Array], chex.Array]:
    """The controller trim.action − gain · error, with a gain [A, 12] or, on the circle, [A, 11]."""
    on_circle = gain.shape[1] < ERRORS

    def control(observation: chex.Array) -> chex.Array:
        error = _error(trim, observation, on_circle)
        return jnp.clip(
            trim.action - jnp.sum(gain * (_drop_along_track(error) if on_circle else error), axis=1), -1.0, 1.0
        )

    return jnp.vectorize(control, signature="(n)->(m)")


def gain(model: LinearModel, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The LQR gain [A, n] for weights `q` [n, n] of the error and `r` [A, A] of the action."""
    a, b = model.a, model.b
    cost = scipy.linalg.solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)


def weights(task: QuadrotorTask) -> tuple[np.ndarray, np.ndarray]:
    """The weights q [n, n] of the error and r [A, A] of the action."""
    reward, far_m = task.evaluation.reward, max(task.evaluation.start.position_m, task.evaluation.distance_m)
    if isinstance(reward, CircleReward):
        position, axes = reward.w4_distance_1_m, 2  # radius and height
    else:
        position, axes = reward.w2_position_1_m if isinstance(reward, HoverReward) else reward.w_position_1_m, 3
    half_turn = position * far_m**2 / np.pi**2
    q = np.diag([position] * axes + [0.0] * 3 + [half_turn] * 3 + [0.0] * 3)
    if isinstance(reward, CircleReward):
        chi = np.zeros(len(q))  # gradient of x·vy − y·vx: by the radius, and by the velocity along the circle
        chi[0], chi[3] = reward.speed_m_s, reward.radius_m
        q += reward.w5_direction_s_m2 * np.outer(chi, chi)
    return q, position * far_m**2 * np.eye(len(task.vehicle.motors))


def linearize(task: QuadrotorTask) -> LinearModel:
    """The trim of a task, which a simulator step leaves unchanged, and the step's linearization about it.

    Newton's method from the continuous-time trim. On the circle radius, height and speed are given; attitude, thrusts
    and the small outward velocity that a step of 10 ms leaves are solved for.
    """
    physics, reward, dt_s = quadrotor.physics(task.vehicle), task.reward, task.control_period_s
    on_circle, motors = isinstance(reward, CircleReward), len(task.vehicle.motors)

    def next_error(trim: Trim, delta: chex.Array) -> chex.Array:
        """The error [12] after a step from the error delta[:12] under trim.action + delta[12:]."""
        body, action = _perturbed(trim, delta)
        # Not clipped: a motor whose trim thrust is at a limit still needs a derivative.
        thrust = physics.hover_thrust_N + physics.action_scale_N * action
        return _error(trim, quadrotor.observe(quadrotor.step(physics, body, thrust, dt_s)), on_circle)

    @functools.partial(jax.jit, compiler_options=_fast_compile())
    def newton_step(trim: Trim, delta: chex.Array) -> tuple[Trim, chex.Array, chex.Array]:
        body, action = _perturbed(trim, delta)
        (position, attitude), (velocity, rate) = body
        trim, zero = Trim(position, velocity, attitude, rate, action), jnp.zeros(ERRORS + motors)
        return trim, next_error(trim, zero), jax.jacfwd(next_error, argnums=1)(trim, zero)

    index = np.arange(ERRORS + motors)
    # Unknowns: all but position, speed along the circle, and heading; in hover the thrusts alone.
    free = ~np.isin(index, [0, 1, 2, 4]) if on_circle else index >= ERRORS
    kept = index[:ERRORS] != ALONG_TRACK if on_circle else index[:ERRORS] >= 0
    trim, delta, jacobian = _initial_trim(task), np.zeros(len(index)), np.zeros((ERRORS, len(index)))
    for _ in range(NEWTON_STEPS):
        trim, residual, jacobian = newton_step(trim, delta.astype(np.float32))
        jacobian = np.asarray(jacobian, np.float64)
        residual_jacobian = (jacobian - np.eye(ERRORS, len(index)))[kept][:, free]
        delta = np.zeros(len(index))
        delta[free] = -np.linalg.lstsq(residual_jacobian, np.asarray(residual, np.float64)[kept], rcond=1e-5)[0]
    return LinearModel(trim, jacobian[kept][:, :ERRORS][:, kept], jacobian[kept][:, ERRORS:])


def _fast_compile() -> dict[str, int]:
    """Compiler options: the program runs a few times for microseconds, so compilation dominates."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}


def _initial_trim(task: QuadrotorTask) -> Trim:
    """The continuous-time trim, without the torque that turning takes: the initial guess of Newton's method."""
    level, zero = np.array([1.0, 0.0, 0.0, 0.0], np.float32), np.zeros(3, np.float32)
    if not isinstance(reward := task.reward, CircleReward):
        return Trim(zero, zero, level, zero, np.zeros(len(task.vehicle.motors), np.float32))
    turn_rate = reward.speed_m_s / reward.radius_m
    roll = -np.arctan2(turn_rate * reward.speed_m_s, STANDARD_GRAVITY_M_S2)  # about body x, which is along the circle
    c, s = np.cos(roll / 2) * np.sqrt(0.5), np.sin(roll / 2) * np.sqrt(0.5)
    return Trim(
        np.array([reward.radius_m, 0.0, 0.0], np.float32),
        np.array([0.0, reward.speed_m_s, 0.0], np.float32),
        np.array([c, s, s, c], np.float32),
        np.array([0.0, turn_rate * np.sin(roll), turn_rate * np.cos(roll)], np.float32),
        np.float32((1.0 / np.cos(roll) - 1.0) * task.vehicle.hover_thrusts_N / task.vehicle.action_scale_N),
    )


def _perturbed(trim: Trim, delta: chex.Array) -> tuple[Body, chex.Array]:
    """The state with the error delta[:12], and trim.action + delta[12:]."""
    position, velocity, rotation_vector, rate = jnp.split(delta[:ERRORS], 4)
    small = rotation.normalize(jnp.concatenate([jnp.ones(1), rotation_vector / 2.0]))
    body = Body(
        Pose(jnp.asarray(trim.position_m) + position, rotation.product(trim.attitude, small)),
        Twist(trim.velocity_m_s + velocity, trim.body_rate_rad_s + rate),
    )
    return body, trim.action + delta[ERRORS:]


def _error(trim: Trim, observation: chex.Array, on_circle: bool) -> chex.Array:
    """The error [12] of an observation [18]."""
    attitude, position, velocity, rate = _in_rotating_frame(observation) if on_circle else _split(observation)
    attitude_error = _rotation_vector(rotation.matrix(trim.attitude).T @ attitude)
    return jnp.concatenate(
        [position - trim.position_m, velocity - trim.velocity_m_s, attitude_error, rate - trim.body_rate_rad_s]
    )


def _split(observation: chex.Array) -> tuple[chex.Array, chex.Array, chex.Array, chex.Array]:
    """Attitude [3, 3], position, velocity and body rates [3] of an observation [18]."""
    return observation[:9].reshape(3, 3), observation[9:12], observation[12:15], observation[15:18]


def _in_rotating_frame(observation: chex.Array) -> tuple[chex.Array, chex.Array, chex.Array, chex.Array]:
    """`_split` in the frame about world z in which the vehicle is at x > 0, y = 0."""
    attitude, position, velocity, rate = _split(observation)
    x, y, z = position
    radius = jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12))
    c, s = x / radius, y / radius
    to_frame = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return to_frame @ attitude, jnp.stack([radius, jnp.zeros_like(z), z]), to_frame @ velocity, rate


def _drop_along_track(error: chex.Array) -> chex.Array:
    """The error without its position along the circle; [12] -> [11]."""
    return jnp.concatenate([error[:ALONG_TRACK], error[ALONG_TRACK + 1 :]])


def _rotation_vector(matrix: chex.Array) -> chex.Array:
    """Angle times axis [rad] of a rotation matrix; [3, 3] -> [3]. The axis of a half turn is not recovered."""
    sine = 0.5 * jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    cosine = 0.5 * (jnp.trace(matrix) - 1.0)
    square = jnp.sum(sine**2)
    size = jnp.sqrt(jnp.where(square > 1e-8, square, 1.0))
    return sine * jnp.where(square > 1e-8, jnp.arctan2(size, cosine) / size, 1.0)

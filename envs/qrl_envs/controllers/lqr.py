"""Linear quadratic regulators of hover and circle, in discrete time.

The world's own step is linearised about the motion that is wanted: about hover, and about the steady turn as it looks
from a frame that turns with the vehicle about the circle's axis, where it stands still at a constant tilt, body x along
the circle. The state's error is position [m], velocity [m/s], attitude (the rotation vector of the turn from the wanted
one, body) [rad] and body rates [rad/s]; on the circle there is no error along it. The gain is the algebraic Riccati
equation's (Anderson and Moore, Optimal Control, 1990, Sec. 2.4), and constant.

Distances, and on the circle chi, weigh as in the reward that the task is judged by, on squares where that has norms.
Attitude and action weigh by Bryson's rule beside them: half a turn, and a motor's whole action, as much as the farthest
start. (The reward's own weights of these ask for actions that the motors do not have, and lose more starts.)

It is linear: far from the wanted motion it promises nothing.
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
from qrl_envs.task import STANDARD_GRAVITY_M_S2, CircleReward, HoverReward, QuadrotorTask

Array = Any  # NumPy's where the gain is found, JAX's where it acts

NEWTON_STEPS = 8
ERRORS = 12
ALONG = 1  # of an error's parts that along the circle, which is left out


class Wanted(NamedTuple):
    """The motion to regulate about, as it stands still in its frame."""

    position_m: Array  # [3]
    velocity_m_s: Array  # [3]
    attitude: Array  # [4] quaternion, body -> frame
    body_rate_rad_s: Array  # [3]
    action: Array  # [4]


class Linear(NamedTuple):
    """error after a step = a · error before + b · (action − wanted.action). NumPy, float64; on the circle n is 11."""

    wanted: Wanted
    a: np.ndarray  # [n, n]
    b: np.ndarray  # [n, 4]


def controller(task: QuadrotorTask) -> Callable[[chex.Array], chex.Array]:
    """Hover or circle, as the task's reward says: observation [..., 18] -> action [..., 4] in [−1, 1].

    NumPy's LinAlgError where the motors cannot stabilise the vehicle.
    """
    motion = linearised(task)
    return following(motion.wanted, gain(motion, *weights(task)).astype(np.float32))


def following(wanted: Wanted, gain: np.ndarray) -> Callable[[chex.Array], chex.Array]:
    """The controller wanted.action − gain · error, with a gain [4, 12] or, on the circle, [4, 11]."""
    circling = gain.shape[1] < ERRORS

    def control(observation: chex.Array) -> chex.Array:
        error = _error(wanted, observation, circling)
        return jnp.clip(wanted.action - jnp.sum(gain * (_across(error) if circling else error), axis=1), -1.0, 1.0)

    return jnp.vectorize(control, signature="(n)->(m)")


def gain(motion: Linear, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """[4, n], for weights `q` [n, n] of the error's squares and `r` [4, 4] of the action's."""
    a, b = motion.a, motion.b
    cost = scipy.linalg.solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)


def weights(task: QuadrotorTask) -> tuple[np.ndarray, np.ndarray]:
    """Of the error's squares [n, n], and of the action's [4, 4]."""
    judged, far_m = task.evaluation.reward, max(task.evaluation.start.position_m, task.evaluation.distance_m)
    if isinstance(judged, HoverReward):
        position, places = judged.w2_position_1_m, 3
    else:
        position, places = judged.w4_distance_1_m, 2  # radius and height
    half_turn = position * far_m**2 / np.pi**2
    q = np.diag([position] * places + [0.0] * 3 + [half_turn] * 3 + [0.0] * 3)
    if not isinstance(judged, HoverReward):
        chi = np.zeros(len(q))  # of x·vy − y·vx: by the radius, and by the velocity along the circle
        chi[0], chi[3] = judged.speed_m_s, judged.radius_m
        q += judged.w5_direction_s_m2 * np.outer(chi, chi)
    return q, position * far_m**2 * np.eye(4)


def linearised(task: QuadrotorTask) -> Linear:
    """A task's wanted motion, which a step leaves as it is, and the world's step about it.

    By Newton's method from the motion of continuous time. On the circle radius, height and speed are wanted, and the
    rest follows: attitude, thrusts, and that a step of 10 ms leaves a velocity a little outward.
    """
    physics, reward, dt_s = quadrotor.physics(task.vehicle), task.reward, task.control_period_s
    circling = isinstance(reward, CircleReward)

    def error(wanted: Wanted, by: chex.Array) -> chex.Array:
        """[12] after a step that begins with the error by[:12] under wanted.action + by[12:]."""
        body, action = _moved(wanted, by)
        # Not clipped: a motor whose wanted thrust is at an end has a derivative still.
        thrust = quadrotor.hover_thrust_N(physics) + physics.action_scale_N * action
        return _error(wanted, quadrotor.observe(quadrotor.step(physics, body, thrust, dt_s)), circling)

    @functools.partial(jax.jit, compiler_options=_quickly())
    def look(wanted: Wanted, change: chex.Array) -> tuple[Wanted, chex.Array, chex.Array]:
        body, action = _moved(wanted, change)
        (position, attitude), (velocity, rate) = body
        wanted = Wanted(position, velocity, attitude, rate, action)
        return wanted, error(wanted, jnp.zeros(ERRORS + 4)), jax.jacfwd(error, argnums=1)(wanted, jnp.zeros(ERRORS + 4))

    parts = np.arange(ERRORS + 4)
    # What may give way: all but the place, speed along the circle, and heading; or the thrusts alone.
    free = ~np.isin(parts, [0, 1, 2, 4]) if circling else parts >= ERRORS
    kept = parts[:ERRORS] != ALONG if circling else parts[:ERRORS] >= 0
    wanted, change, by = _turning(task), np.zeros(len(parts)), np.zeros((ERRORS, len(parts)))
    for _ in range(NEWTON_STEPS):
        wanted, off, by = look(wanted, change.astype(np.float32))
        by = np.asarray(by, np.float64)
        steady = by - np.eye(ERRORS, len(parts))  # what of a change is not there before the step too
        change = np.zeros(len(parts))
        change[free] = -np.linalg.lstsq(steady[kept][:, free], np.asarray(off, np.float64)[kept], rcond=1e-5)[0]
    return Linear(wanted, by[kept][:, :ERRORS][:, kept], by[kept][:, ERRORS:])


def _quickly() -> dict[str, int]:
    """It runs a few times for microseconds; compiling is what takes time."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}


def _turning(task: QuadrotorTask) -> Wanted:
    """The wanted motion of continuous time, and of a vehicle whose motors are alike: Newton's first guess."""
    level, zero = np.array([1.0, 0.0, 0.0, 0.0], np.float32), np.zeros(3, np.float32)
    if not isinstance(wanted := task.reward, CircleReward):
        return Wanted(zero, zero, level, zero, np.zeros(4, np.float32))
    spin = wanted.speed_m_s / wanted.radius_m
    lean = -np.arctan2(spin * wanted.speed_m_s, STANDARD_GRAVITY_M_S2)  # about body x, which is along the circle
    c, s = np.cos(lean / 2) * np.sqrt(0.5), np.sin(lean / 2) * np.sqrt(0.5)
    return Wanted(
        np.array([wanted.radius_m, 0.0, 0.0], np.float32),
        np.array([0.0, wanted.speed_m_s, 0.0], np.float32),
        np.array([c, s, s, c], np.float32),
        np.array([0.0, spin * np.sin(lean), spin * np.cos(lean)], np.float32),
        np.full(4, (1.0 / np.cos(lean) - 1.0) * task.vehicle.mass_kg * STANDARD_GRAVITY_M_S2 / 4.0, np.float32)
        / np.float32(task.vehicle.action_scale_N),
    )


def _moved(wanted: Wanted, by: chex.Array) -> tuple[Body, chex.Array]:
    """The state with the error by[:12], and wanted.action + by[12:]."""
    position, velocity, turn, rate = jnp.split(by[:ERRORS], 4)
    small = rotation.normalise(jnp.concatenate([jnp.ones(1), turn / 2.0]))
    body = Body(
        Pose(jnp.asarray(wanted.position_m) + position, rotation.product(wanted.attitude, small)),
        Twist(wanted.velocity_m_s + velocity, wanted.body_rate_rad_s + rate),
    )
    return body, wanted.action + by[ERRORS:]


def _error(wanted: Wanted, observation: chex.Array, circling: bool) -> chex.Array:
    """[12] of an observation [18]."""
    attitude, position, velocity, rate = _in_frame(observation) if circling else _parts(observation)
    turn = _rotation_vector(rotation.matrix(wanted.attitude).T @ attitude)
    return jnp.concatenate(
        [position - wanted.position_m, velocity - wanted.velocity_m_s, turn, rate - wanted.body_rate_rad_s]
    )


def _parts(observation: chex.Array) -> tuple[chex.Array, chex.Array, chex.Array, chex.Array]:
    """Attitude [3, 3], position, velocity and body rates [3] of an observation [18]."""
    return observation[:9].reshape(3, 3), observation[9:12], observation[12:15], observation[15:18]


def _in_frame(observation: chex.Array) -> tuple[chex.Array, chex.Array, chex.Array, chex.Array]:
    """The same seen from the frame about world z in which the vehicle is at x > 0, y = 0."""
    attitude, position, velocity, rate = _parts(observation)
    x, y, z = position
    radius = jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12))
    c, s = x / radius, y / radius
    into = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return into @ attitude, jnp.stack([radius, jnp.zeros_like(z), z]), into @ velocity, rate


def _across(error: chex.Array) -> chex.Array:
    """Without the part along the circle; [12] -> [11]."""
    return jnp.concatenate([error[:ALONG], error[ALONG + 1 :]])


def _rotation_vector(turn: chex.Array) -> chex.Array:
    """Angle times axis [rad] of a rotation matrix; [3, 3] -> [3]. (Of half a turn, about which axis it is not seen.)"""
    sine = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    cosine = 0.5 * (jnp.trace(turn) - 1.0)
    square = jnp.sum(sine**2)
    size = jnp.sqrt(jnp.where(square > 1e-8, square, 1.0))
    return sine * jnp.where(square > 1e-8, jnp.arctan2(size, cosine) / size, 1.0)

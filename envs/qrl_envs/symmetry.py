"""Symmetries of the tasks: maps of observations and actions that commute with a step and keep reward and end.

A transformed trajectory is one of the transformed behavior policy, with the same log-densities, so an off-policy
learner may train on it too (data augmentation). The distribution of starts need not be symmetric: it weights
the objective, and no target depends on it.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs.quadrotor import Physics

SAME_M = 1e-6  # greatest difference of torque per thrust between a transformed motor and the one it coincides with
SAME_INERTIA = 1e-6  # likewise, of the moments of inertia, as a fraction of the largest


class Symmetry(NamedTuple):
    """Orthogonal matrices; step(G·s, P·a) = G·step(s, a), with the same reward and end."""

    observation: chex.Array  # G [F, F]
    action: chex.Array  # P [A, A]


def _square() -> np.ndarray:
    """[8, 3, 3]: the symmetries of a square about z, rotations first, then reflections."""
    rotations = [np.linalg.matrix_power([[0, -1], [1, 0]], k) for k in range(4)]
    flat = [*rotations, *(rotation @ [[1, 0], [0, -1]] for rotation in rotations)]
    return np.stack([np.block([[m, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]]) for m in flat])


SQUARE = _square().astype(np.float32)
ROTATIONS = SQUARE[:4]


def hover(physics: Physics, u: chex.Array) -> Symmetry:
    """A rotation or reflection of world and body alike, which keeps the attitude error; u: [2] in [0, 1)."""
    body, motors = _sample_vehicle_symmetry(physics, SQUARE, u[0])
    return Symmetry(_observation(body, body), motors)


def circle(physics: Physics, u: chex.Array) -> Symmetry:
    """A rotation of the world about z by any angle, of the body by a symmetry of the vehicle; u: [2] in [0, 1)."""
    body, motors = _sample_vehicle_symmetry(physics, ROTATIONS, u[0])
    c, s = jnp.cos(2.0 * jnp.pi * u[1]), jnp.sin(2.0 * jnp.pi * u[1])
    world = jnp.eye(3).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
    return Symmetry(_observation(world, body), motors)


def pendulum(u: chex.Array) -> Symmetry:
    """Identity or reflection θ -> −θ; u: [2] in [0, 1)."""
    sign = jnp.where(u[0] < 0.5, 1.0, -1.0)
    return Symmetry(jnp.diag(jnp.stack([1.0, sign, sign])), sign[None, None])


def _sample_vehicle_symmetry(physics: Physics, candidates: np.ndarray, u: chex.Array) -> tuple[chex.Array, chex.Array]:
    """A random symmetry of the vehicle among candidate maps of the body [3, 3], and its motor permutation [A, A]."""
    bodies = jnp.asarray(candidates)
    motors, valid = jax.vmap(lambda body: _motor_permutation(physics, body))(bodies)
    nth = jnp.floor(u * jnp.sum(valid)) + 1.0
    index = jnp.argmax(jnp.cumsum(valid) == nth)  # 0, the identity, if none is valid: two motors coincide
    return bodies[index], jnp.where(valid[index], motors[index], jnp.eye(motors.shape[-1]))


def _motor_permutation(physics: Physics, body: chex.Array) -> tuple[chex.Array, chex.Array]:
    """The permutation [A, A] of motors under a map of the body, and whether the map is a symmetry of the vehicle.

    A motor is where another was if it has the other's force (a vector) and torque (a pseudovector).
    """
    torque = physics.motor_torque_m
    moved = _determinant(body) * jnp.sum(body[:, :, None] * torque[None], axis=1)  # exact, unlike a matrix product
    distance = jnp.abs(torque[:, :, None] - moved[:, None]).max(axis=0)
    if physics.motor_axis is not None:
        axes = jnp.sum(body[:, :, None] * physics.motor_axis[None], axis=1)
        distance = jnp.maximum(distance, jnp.abs(physics.motor_axis[:, :, None] - axes[:, None]).max(axis=0))
    equal = physics.motor_max_N[:, None] == physics.motor_max_N
    motors = ((distance < SAME_M) & equal).astype(jnp.float32)
    bijective = jnp.all(motors.sum(axis=0) == 1.0) & jnp.all(motors.sum(axis=1) == 1.0)
    inertia = physics.inertia_kg_m2
    matrix = jnp.diag(inertia) if inertia.ndim == 1 else inertia
    half = jnp.sum(body[:, :, None] * matrix[None], axis=1)
    turned = jnp.sum(half[:, None] * body[None], axis=-1)
    return motors, bijective & jnp.all(jnp.abs(turned - matrix) <= SAME_INERTIA * jnp.max(matrix))


def _observation(world: chex.Array, body: chex.Array) -> chex.Array:
    """G [18, 18] of R' = world·R·bodyᵀ, p' = world·p, v' = world·v; body rates are a pseudovector."""
    parts = (jnp.kron(world, body), world, world, _determinant(body) * body)
    return jax.scipy.linalg.block_diag(*parts)


def _determinant(matrix: chex.Array) -> chex.Array:
    """The determinant of a [3, 3] that maps z to itself."""
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]

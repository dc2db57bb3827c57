"""Maps of observations and actions under which a task is the same: its steps, rewards and starts.

A trajectory that such a map turns is one that the turned behaviour policy would have flown, with the same
log-densities: a learner that takes any behaviour policy may learn from it too.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs.quadrotor import Physics

SAME_M = 1e-6  # between a motor's place and the one that it is turned to


class Symmetry(NamedTuple):
    """Orthogonal matrices; step(G·s, P·a) = G·step(s, a), with the same reward and end."""

    observation: chex.Array  # G [F, F]
    action: chex.Array  # P [A, A]


def _square() -> np.ndarray:
    """[8, 3, 3]: the symmetries of a square about z, quarter turns first, then the mirrored ones."""
    turns = [np.linalg.matrix_power([[0, -1], [1, 0]], k) for k in range(4)]
    flat = [*turns, *(turn @ [[1, 0], [0, -1]] for turn in turns)]
    return np.stack([np.block([[m, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]]) for m in flat])


SQUARE = _square().astype(np.float32)
PROPER = SQUARE[:4]


def hover(physics: Physics, u: chex.Array) -> Symmetry:
    """World and body turned or mirrored alike, so that the attitude's error stays what it is; u: [2] in [0, 1)."""
    body, motors = _of_vehicle(physics, SQUARE, u[0])
    return Symmetry(_observation(body, body), motors)


def circle(physics: Physics, u: chex.Array) -> Symmetry:
    """The world turned about z by any angle, the body by one that the vehicle allows; u: [2] in [0, 1)."""
    body, motors = _of_vehicle(physics, PROPER, u[0])
    c, s = jnp.cos(2.0 * jnp.pi * u[1]), jnp.sin(2.0 * jnp.pi * u[1])
    world = jnp.eye(3).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
    return Symmetry(_observation(world, body), motors)


def pendulum(u: chex.Array) -> Symmetry:
    """Left and right; u: [2] in [0, 1)."""
    sign = jnp.where(u[0] < 0.5, 1.0, -1.0)
    return Symmetry(jnp.diag(jnp.stack([1.0, sign, sign])), sign[None, None])


def _of_vehicle(physics: Physics, candidates: np.ndarray, u: chex.Array) -> tuple[chex.Array, chex.Array]:
    """One of the turns of the body [3, 3] that leave the vehicle as it is, and what it makes of the motors [A, A]."""
    bodies = jnp.asarray(candidates)
    motors, same = jax.vmap(lambda body: _motors(physics, body))(bodies)
    nth = jnp.floor(u * jnp.sum(same)) + 1.0
    index = jnp.argmax(jnp.cumsum(same) == nth)  # 0, the identity, where none is the same: two motors in one place
    return bodies[index], jnp.where(same[index], motors[index], jnp.eye(motors.shape[-1]))


def _motors(physics: Physics, body: chex.Array) -> tuple[chex.Array, chex.Array]:
    """Which motor [A, A] comes to be where another was, and whether the turned vehicle is the same."""
    moved = jnp.sum(physics.motor_position_m[:, None] * body[:2, :2], axis=-1)  # exact, as a GPU's product is not
    apart = jnp.abs(physics.motor_position_m[:, None] - moved[None]).max(axis=-1)
    spin = _determinant(body) * physics.motor_spin
    alike = (physics.motor_spin[:, None] == spin) & (physics.motor_max_N[:, None] == physics.motor_max_N)
    motors = ((apart < SAME_M) & alike).astype(jnp.float32)
    onto = jnp.all(motors.sum(axis=0) == 1.0) & jnp.all(motors.sum(axis=1) == 1.0)
    return motors, onto & jnp.all(jnp.sum(body**2 * physics.inertia_kg_m2, axis=-1) == physics.inertia_kg_m2)


def _observation(world: chex.Array, body: chex.Array) -> chex.Array:
    """G [18, 18] of R' = world·R·bodyᵀ, p' = world·p, v' = world·v; body rates are a pseudovector."""
    parts = (jnp.kron(world, body), world, world, _determinant(body) * body)
    return jax.scipy.linalg.block_diag(*parts)


def _determinant(turn: chex.Array) -> chex.Array:
    """Of a [3, 3] that keeps z."""
    return turn[0, 0] * turn[1, 1] - turn[0, 1] * turn[1, 0]

"""Unit quaternions [w, x, y, z], body -> world. For one quaternion; the caller vmaps."""

import chex
import jax
import jax.numpy as jnp


def product(p: chex.Array, q: chex.Array) -> chex.Array:
    """Hamilton product p ⊗ q; [4], [4] -> [4]."""
    pw, px, py, pz = p[0], p[1], p[2], p[3]
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def derivative(q: chex.Array, body_rate: chex.Array) -> chex.Array:
    """dq/dt = ½ q ⊗ [0, ω] for a body rate ω [rad/s] in the body frame; [4], [3] -> [4]."""
    return 0.5 * product(q, jnp.concatenate([jnp.zeros_like(body_rate[:1]), body_rate]))


def normalize(q: chex.Array) -> chex.Array:
    """q/‖q‖; [4] -> [4]."""
    return q * jax.lax.rsqrt(jnp.sum(jnp.square(q)))


def matrix(q: chex.Array) -> chex.Array:
    """Rotation matrix body -> world of a unit quaternion; [4] -> [3, 3]. Its columns are the body axes in the world."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def uniform(u: chex.Array, tilt_rad: chex.Array | float = jnp.pi) -> chex.Array:
    """A rotation uniform over those that tilt z by at most `tilt_rad` (π: all of SO(3)), as a unit quaternion [4], from
    u [3] uniform in [0, 1) (Shoemake 1992; the tilt θ has sin²(θ/2) uniform).
    """
    a, b = 2.0 * jnp.pi * u[1], 2.0 * jnp.pi * u[2]
    squared = jnp.sin(tilt_rad / 2.0) ** 2 * u[0]
    s, c = jnp.sqrt(squared), jnp.sqrt(1.0 - squared)
    return jnp.stack([c * jnp.cos(b), s * jnp.sin(a), s * jnp.cos(a), c * jnp.sin(b)])

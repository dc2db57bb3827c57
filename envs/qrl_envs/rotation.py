"""Unit quaternions [w, x, y, z], body -> world. For one quaternion, or for many that lie along trailing axes."""

import chex
import jax
import jax.numpy as jnp


def product(p: chex.Array, q: chex.Array) -> chex.Array:
    """Hamilton product p ⊗ q; [4], [4] -> [4]."""
    # Taken apart by unstack, here and elsewhere: the gradient of an index is an addition of a padded vector.
    pw, px, py, pz = jnp.unstack(p)
    qw, qx, qy, qz = jnp.unstack(q)
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def cross(a: chex.Array, b: chex.Array) -> chex.Array:
    """a × b; [3], [3] -> [3]."""
    ax, ay, az = jnp.unstack(a)
    bx, by, bz = jnp.unstack(b)
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def derivative(q: chex.Array, body_rate: chex.Array) -> chex.Array:
    """dq/dt = ½ q ⊗ [0, ω] for a body rate ω [rad/s] in the body frame; [4], [3] -> [4]."""
    w, x, y, z = jnp.unstack(q)
    a, b, c = jnp.unstack(0.5 * body_rate)
    return jnp.stack([-x * a - y * b - z * c, w * a + y * c - z * b, w * b - x * c + z * a, w * c + x * b - y * a])


def normalize(q: chex.Array) -> chex.Array:
    """q/‖q‖; [4] -> [4]."""
    return q * jax.lax.rsqrt(jnp.sum(jnp.square(q), axis=0))


def matrix(q: chex.Array) -> chex.Array:
    """Rotation matrix body -> world of a unit quaternion; [4] -> [3, 3]. Its columns are the body axes in the world."""
    w, x, y, z = jnp.unstack(q)
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

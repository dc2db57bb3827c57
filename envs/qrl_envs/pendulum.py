"""The torque-limited pendulum of Gymnasium's Pendulum-v1. For one pendulum; the caller vmaps.

A uniform rod turns about its end; the angle θ is zero upright and positive counter-clockwise.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import integrate
from qrl_envs.task import PendulumStart, Rod


class Physics(NamedTuple):
    """Parameters as float32 scalars, so that they batch and differentiate."""

    mass_kg: chex.Array
    length_m: chex.Array
    gravity_m_s2: chex.Array
    max_torque_N_m: chex.Array
    max_rate_rad_s: chex.Array


class Pendulum(NamedTuple):
    pose: chex.Array  # [] θ [rad]
    twist: chex.Array  # [] θ̇ [rad/s]


class Start(NamedTuple):
    """Half-widths of the uniform start ranges, about zero; scalars."""

    angle_rad: chex.Array
    rate_rad_s: chex.Array


def physics(rod: Rod) -> Physics:
    """The parameters of a task file."""
    return Physics(*(jnp.float32(getattr(rod, field)) for field in Physics._fields))


def start(ranges: PendulumStart) -> Start:
    """The start ranges of a task file."""
    return Start(*(jnp.float32(getattr(ranges, field)) for field in Start._fields))


def torque_N_m(physics: Physics, action: chex.Array) -> chex.Array:
    """The applied torque [N m] for an action [1], clipped to [−1, 1]; []."""
    return physics.max_torque_N_m * jnp.clip(action[0], -1.0, 1.0)


def derivative(physics: Physics, x: Pendulum, torque: chex.Array) -> Pendulum:
    """dx/dt under gravity and a torque [N m] about the pivot."""
    gravity = 3.0 * physics.gravity_m_s2 / (2.0 * physics.length_m) * jnp.sin(x.pose)
    return Pendulum(pose=x.twist, twist=gravity + 3.0 / (physics.mass_kg * physics.length_m**2) * torque)


def step(physics: Physics, x: Pendulum, torque: chex.Array, dt_s: float) -> Pendulum:
    """One control period under constant torque [N m], as in Pendulum-v1: the rate is limited before the angle moves."""
    return integrate.semi_implicit_euler(
        lambda x: derivative(physics, x, torque),
        x,
        dt_s,
        limit=lambda rate: jnp.clip(rate, -physics.max_rate_rad_s, physics.max_rate_rad_s),
    )


def observe(x: Pendulum) -> chex.Array:
    """The observation [3]: cos θ, sin θ, θ̇ [rad/s]."""
    return jnp.stack([jnp.cos(x.pose), jnp.sin(x.pose), x.twist])


def draw(start: Start, key: chex.PRNGKey) -> Pendulum:
    """A random start, uniform within ± the ranges."""
    u = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
    return Pendulum(pose=start.angle_rad * u[0], twist=start.rate_rad_s * u[1])

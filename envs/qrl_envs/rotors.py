"""Rotors: speed that follows its set-point late, and thrust as a curve of speed. For one vehicle; the caller vmaps.

A rotor's speed w is a fraction of its greatest. It follows its set-point with a first-order lag, exactly, with one time
constant to rise and another to fall; thrust/max = c·w + (1 − c)·w².
"""

from typing import NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs.vehicle import Vehicle

TINY = 1e-6


class Rotors(NamedTuple):
    """Parameters; scalars."""

    rise_s: chex.Array
    fall_s: chex.Array
    curve: chex.Array  # c


def rotors(vehicle: Vehicle) -> Rotors:
    """The parameters of a vehicle file."""
    return Rotors(*(jnp.float32(x) for x in (vehicle.rotor_rise_s, vehicle.rotor_fall_s, vehicle.thrust_curve)))


def thrust_fraction(curve: chex.Array, speed: chex.Array) -> chex.Array:
    """thrust/max of speeds in [0, 1]; any shape."""
    return speed * (curve + (1.0 - curve) * speed)


def speed_of(curve: chex.Array, fraction: chex.Array) -> chex.Array:
    """The speed whose thrust/max is `fraction`, in [0, 1]; any shape."""
    # The rationalized root of (1 − c)·w² + c·w = f, which holds for c = 1 too. At f = 0 its slope would be infinite.
    root = jnp.sqrt(curve**2 + 4.0 * (1.0 - curve) * jnp.maximum(fraction, TINY))
    return jnp.clip(2.0 * fraction / jnp.maximum(curve + root, TINY), 0.0, 1.0)


def after(parameters: Rotors, speed: chex.Array, set_point: chex.Array, time_s: chex.Array) -> chex.Array:
    """Speeds after `time_s` [] at a constant set-point; [N], [N] -> [N]. With a time constant of 0 they follow at once,
    but not before any time has passed.
    """

    def left_of(lag_s: chex.Array) -> chex.Array:  # not of each rotor: constant during a flight
        at_once = jnp.where(time_s > 0.0, 0.0, 1.0)
        return jnp.where(lag_s > TINY, jnp.exp(-time_s / jnp.maximum(lag_s, TINY)), at_once)

    left = jnp.where(set_point > speed, left_of(parameters.rise_s), left_of(parameters.fall_s))
    return set_point + (speed - set_point) * left

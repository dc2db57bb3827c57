"""A flight's own vehicle, drawn from a distribution. For one flight; the caller vmaps."""

from typing import NamedTuple

import chex
import jax.numpy as jnp
import numpy as np

from qrl_envs.distribution import VehicleDistribution
from qrl_envs.quadrotor import Physics
from qrl_envs.rotors import Rotors
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2

DRAWS = 9  # uniform numbers of a draw


class Drawn(NamedTuple):
    """A flight's own vehicle."""

    physics: Physics
    rotors: Rotors
    drag_N_s_m: chex.Array  # [3]
    surplus_weights: chex.Array  # []: what a constant force may be, of the weight


def draw(spec: VehicleDistribution, base: Physics, u: chex.Array) -> Drawn:
    """A vehicle of the mass and the motors' places of `base`, from u [DRAWS] uniform in [0, 1)."""

    def within(pair: tuple[float, float], u: chex.Array) -> chex.Array:
        return pair[0] + (pair[1] - pair[0]) * u

    def log_within(pair: tuple[float, float], u: chex.Array) -> chex.Array:
        return jnp.exp(within((float(np.log(pair[0])), float(np.log(pair[1]))), u))

    arm_m = jnp.mean(jnp.linalg.norm(base.motor_torque_m[:2], axis=0))  # torques about x and y per thrust are lengths
    spin = jnp.sign(base.motor_torque_m[2])
    ratio, agility = log_within(spec.thrust_per_weight, u[0]), log_within(spec.torque_per_inertia_1_s2, u[1])
    thrust_N = ratio * base.mass_kg * STANDARD_GRAVITY_M_S2 / base.motor_max_N.shape[0]
    moment = arm_m * thrust_N / agility
    moments = jnp.stack([moment, moment / within(spec.pitch_factor, u[2]), spec.moment_z_factor * moment])
    yaw_m = log_within(spec.yaw_per_roll, u[3]) * agility * moments[2] / thrust_N
    rise_s = log_within(spec.rotor_rise_s, u[4])
    physics = base._replace(
        inertia_kg_m2=moments,
        motor_torque_m=jnp.concatenate([base.motor_torque_m[:2], yaw_m * spin[None]]),
        motor_min_N=jnp.zeros_like(base.motor_max_N),
        motor_max_N=jnp.ones_like(base.motor_max_N) * thrust_N,
    )
    return Drawn(
        physics,
        Rotors(rise_s, rise_s * within(spec.fall_per_rise, u[5]), within(spec.thrust_curve, u[6])),
        within(spec.drag_1_s, u[7]) * base.mass_kg * jnp.ones(3),
        spec.force_surplus * jnp.minimum(ratio - 1.0, 1.5) * u[8] ** 2,
    )

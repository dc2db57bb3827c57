"""Distributions of vehicles: each flight has a vehicle of its own, which the policy is not told."""

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import chex
import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator

from qrl_envs import specfile
from qrl_envs.rotors import Rotors
from qrl_envs.specfile import NonNegative, Positive, Spec
from qrl_envs.uncertainty import Factor, Range, ascending
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle

if TYPE_CHECKING:  # it imports tasks, which have distributions
    from qrl_envs.quadrotor import Physics

Curve = Annotated[tuple[float, float], AfterValidator(ascending)]


class VehicleDistribution(Spec):
    """Ranges [least, greatest] of quadrotors of one geometry, up to its size, which a policy of rotor speeds does not
    see: log-uniform but for what says otherwise. Its vehicle gives the places and spins of the motors.
    """

    thrust_per_weight: Factor = (1.35, 11.0)
    # Arm times the greatest thrust of a motor, over the moment of inertia about x; that about y differs by a factor.
    torque_per_inertia_1_s2: Factor = (50.0, 1200.0)
    pitch_factor: Factor = (0.85, 1.15)  # uniform
    yaw_per_roll: Factor = (0.04, 0.45)  # angular acceleration of a motor about z over that about x, times √2
    rotor_rise_s: Factor = (0.001, 0.15)
    fall_per_rise: Factor = (0.8, 2.0)  # uniform
    thrust_curve: Curve = (-0.15, 0.4)  # uniform
    drag_1_s: Range = (0.0, 0.7)  # uniform; linear drag over mass
    force_surplus: NonNegative = 0.3  # constant force at most, of the thrust beyond the weight up to half of that
    moment_z_factor: Positive = 1.7  # moment of inertia about z over that about x


DRAWS = 9  # uniform numbers of a draw


class Drawn(NamedTuple):
    """A flight's own vehicle."""

    physics: "Physics"
    rotors: Rotors
    drag_N_s_m: chex.Array  # [3]
    surplus_weights: chex.Array  # []: what a constant force may be, of the weight


def draw(spec: VehicleDistribution, base: "Physics", vehicle: Vehicle, u: chex.Array) -> Drawn:
    """A vehicle of the mass and the motors' places of `base`, from u [DRAWS] uniform in [0, 1)."""

    def within(pair: tuple[float, float], u: chex.Array) -> chex.Array:
        return pair[0] + (pair[1] - pair[0]) * u

    def log_within(pair: tuple[float, float], u: chex.Array) -> chex.Array:
        return jnp.exp(within((float(np.log(pair[0])), float(np.log(pair[1]))), u))

    arm_m = float(np.mean(np.linalg.norm(vehicle.motor_positions_m[:2], axis=0)))
    spin = np.array([motor.spin for motor in vehicle.motors], np.float32)
    ratio, agility = log_within(spec.thrust_per_weight, u[0]), log_within(spec.torque_per_inertia_1_s2, u[1])
    thrust_N = ratio * base.mass_kg * STANDARD_GRAVITY_M_S2 / len(vehicle.motors)
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


def shipped_distributions() -> list[str]:
    """Names of the shipped distributions."""
    return specfile.shipped("distributions")


def distribution_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped distribution's file or of a `.json`; BadInput with one line if there is none."""
    return specfile.named("distribution", "distributions", name_or_path)

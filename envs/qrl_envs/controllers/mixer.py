"""From a wanted lift and torque to the motors' actions, by where the motors are and what they can."""

from typing import NamedTuple

import chex
import jax.numpy as jnp
import numpy as np

from qrl_envs.task import STANDARD_GRAVITY_M_S2, Vehicle


class Mixer(NamedTuple):
    """A vehicle's motors, NumPy in float32. Forces in N, torques in N m about body x, y, z."""

    thrust_per_wrench: np.ndarray  # [4 motors, 4]: of lift, and of torque about x, y, z
    low_N: np.ndarray  # [4] what an action can command
    high_N: np.ndarray  # [4]
    hover_N: np.ndarray  # []
    action_scale_N: np.ndarray  # []

    @property
    def lift_N(self) -> float:
        """The greatest of all motors together."""
        return float(self.high_N.sum())

    @property
    def torque_N_m(self) -> np.ndarray:
        """The greatest torque [3]: about x and y with all motors at their ends, about z while they lift the vehicle."""
        wrench_per_thrust = np.abs(np.linalg.pinv(self.thrust_per_wrench))
        tilting = wrench_per_thrust[1:3] @ (self.high_N - self.low_N) / 2.0
        spare_N = np.minimum(self.hover_N - self.low_N, self.high_N - self.hover_N)
        return np.append(tilting, wrench_per_thrust[3] @ np.maximum(spare_N, 0.0))


def mixer(vehicle: Vehicle) -> Mixer:
    """That of a vehicle: the pseudo-inverse of what its motors' thrusts add up to."""
    x, y = np.array([motor.position_m for motor in vehicle.motors]).T
    spin, most = np.array([(motor.spin, motor.max_N) for motor in vehicle.motors]).T
    wrench_per_thrust = np.stack([np.ones(4), y, -x, vehicle.yaw_moment_m * spin])
    hover = vehicle.mass_kg * STANDARD_GRAVITY_M_S2 / 4.0
    numbers = (
        np.linalg.pinv(wrench_per_thrust),
        np.full(4, max(hover - vehicle.action_scale_N, 0.0)),
        np.minimum(hover + vehicle.action_scale_N, most),
        hover,
        vehicle.action_scale_N,
    )
    return Mixer(*(np.asarray(number, np.float32) for number in numbers))


def action(mixer: Mixer, lift_N: chex.Array, torque_N_m: chex.Array, leeway_N: float) -> chex.Array:
    """The action [4] in [−1, 1] for a lift [] above the hover thrust and a torque [3]; N, N m.

    Where the motors cannot do all of it, torque about x and y comes first, as far as it costs no more than `leeway_N`
    of lift too much or too little; then lift; then torque about z, for which the motors are weakest and the need is
    least.
    """
    per_lift = jnp.maximum(mixer.thrust_per_wrench[:, 0], 1e-3)  # positive wherever the vehicle can hover
    low, high = (mixer.low_N - mixer.hover_N) / per_lift, (mixer.high_N - mixer.hover_N) / per_lift
    tilt = jnp.sum(mixer.thrust_per_wrench[:, 1:3] * torque_N_m[:2], axis=1) / per_lift
    room = jnp.where(tilt > 0, high - lift_N + leeway_N, lift_N + leeway_N - low)
    tilt *= _share(jnp.abs(tilt), jnp.maximum(room, 0.0))
    # And some lift has to go with it: no motor's need is farther above another's than the ends of both allow.
    tilt *= _share(tilt[:, None] - tilt[None], high[:, None] - low[None])
    least, most = jnp.max(low - tilt), jnp.min(high - tilt)
    thrust = (tilt + jnp.clip(lift_N, least, jnp.maximum(least, most))) * per_lift
    yaw = mixer.thrust_per_wrench[:, 3] * torque_N_m[2]
    room = jnp.where(yaw > 0, mixer.high_N - mixer.hover_N - thrust, thrust + mixer.hover_N - mixer.low_N)
    yaw *= _share(jnp.abs(yaw), jnp.maximum(room, 0.0))
    return jnp.clip((thrust + yaw) / mixer.action_scale_N, -1.0, 1.0)


def _share(needs: chex.Array, has: chex.Array | np.ndarray) -> chex.Array:
    """How much of `needs` can be had, in (0, 1], if all are to be cut alike; []."""
    short = needs > has
    return jnp.min(jnp.where(short, has / jnp.where(short, needs, 1.0), 1.0))

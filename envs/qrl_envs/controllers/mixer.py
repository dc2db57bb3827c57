"""Control allocation: from lift and torque to the motors' actions, within the motors' limits."""

from typing import NamedTuple

import chex
import jax.numpy as jnp
import numpy as np

from qrl_envs.vehicle import Vehicle


class Mixer(NamedTuple):
    """A vehicle's motors, NumPy in float32. Forces in N, torques in N m about body x, y, z."""

    thrust_per_wrench: np.ndarray  # [motors, 4]: per lift, and per torque about x, y, z
    low_N: np.ndarray  # [motors] limits of the thrust that actions command
    high_N: np.ndarray  # [motors]
    hover_N: np.ndarray  # [motors] thrusts of hover
    action_scale_N: np.ndarray  # []

    @property
    def lift_N(self) -> float:
        """The maximum lift of all motors together."""
        return float(self.high_N.sum())

    @property
    def torque_N_m(self) -> np.ndarray:
        """The maximum torque [3]: about x and y with all motors at their limits, about z at hover lift."""
        wrench_per_thrust = np.abs(np.linalg.pinv(self.thrust_per_wrench))
        tilt = wrench_per_thrust[1:3] @ (self.high_N - self.low_N) / 2.0
        margin_N = np.minimum(self.hover_N - self.low_N, self.high_N - self.hover_N)
        return np.append(tilt, wrench_per_thrust[3] @ np.maximum(margin_N, 0.0))


def mixer(vehicle: Vehicle) -> Mixer:
    """The mixer of a vehicle: the pseudo-inverse of the map from motor thrusts to lift and torque."""
    min_N, max_N = np.array([(motor.min_N, motor.max_N) for motor in vehicle.motors]).T
    wrench_per_thrust = np.concatenate([vehicle.motor_axes[2:], vehicle.torques_m])
    hover = vehicle.hover_thrusts_N
    numbers = (
        np.linalg.pinv(wrench_per_thrust),
        np.maximum(hover - vehicle.action_scale_N, min_N),
        np.minimum(hover + vehicle.action_scale_N, max_N),
        hover,
        vehicle.action_scale_N,
    )
    return Mixer(*(np.asarray(number, np.float32) for number in numbers))


def action(mixer: Mixer, lift_N: chex.Array, torque_N_m: chex.Array, lift_error_N: float) -> chex.Array:
    """The action [motors] in [−1, 1] for a lift [] [N] above the hover thrust and a torque [3] [N m].

    When motors saturate, torque about x and y comes first, as long as it changes the lift by at most `lift_error_N`;
    then lift; then torque about z, for which the motors are weakest and the need is least.
    """
    per_lift = jnp.maximum(mixer.thrust_per_wrench[:, 0], 1e-3)  # positive for every vehicle that can hover
    low, high = (mixer.low_N - mixer.hover_N) / per_lift, (mixer.high_N - mixer.hover_N) / per_lift
    tilt = jnp.sum(mixer.thrust_per_wrench[:, 1:3] * torque_N_m[:2], axis=1) / per_lift
    margin = jnp.where(tilt > 0, high - lift_N + lift_error_N, lift_N + lift_error_N - low)
    tilt *= _feasible_share(jnp.abs(tilt), jnp.maximum(margin, 0.0))
    # Some lift must fit all motors: no two of them may differ by more than their limits allow.
    tilt *= _feasible_share(tilt[:, None] - tilt[None], high[:, None] - low[None])
    min_lift, max_lift = jnp.max(low - tilt), jnp.min(high - tilt)
    thrust = (tilt + jnp.clip(lift_N, min_lift, jnp.maximum(min_lift, max_lift))) * per_lift
    yaw = mixer.thrust_per_wrench[:, 3] * torque_N_m[2]
    margin = jnp.where(yaw > 0, mixer.high_N - mixer.hover_N - thrust, thrust + mixer.hover_N - mixer.low_N)
    yaw *= _feasible_share(jnp.abs(yaw), jnp.maximum(margin, 0.0))
    return jnp.clip((thrust + yaw) / mixer.action_scale_N, -1.0, 1.0)


def _feasible_share(demand: chex.Array, limit: chex.Array | np.ndarray) -> chex.Array:
    """The greatest common factor in (0, 1] that brings every `demand` within its `limit`; []."""
    exceeds = demand > limit
    return jnp.min(jnp.where(exceeds, limit / jnp.where(exceeds, demand, 1.0), 1.0))

"""Vehicle files: what flies, whether it can, and what it can do. Body frame: x forward, y left, z up; SI units."""

from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from qrl_envs import specfile
from qrl_envs.specfile import BadInput, Positive, Real, Spec

STANDARD_GRAVITY_M_S2 = 9.81
INERTIA_TOLERANCE = 0.05  # measured inertias are rounded: excess over a rigid body's bound that is accepted
MOST_ARM_PER_GYRATION = 30.0  # distance of a motor per radius of gyration, above which a length has a wrong unit
LEAST_ANGULAR_ACCELERATION_RAD_S2 = 3.0  # about x and y, below which a vehicle can only just be rotated
LEAST_YAW_ACCELERATION_RAD_S2 = 0.3
RECOVERY_M = 2.0
LEAST_THRUST_PER_WEIGHT = 1.3  # below, a vehicle can only just hover


class Motor(Spec):
    position_m: tuple[Real, Real]  # x, y from the center of mass, body frame
    spin: Literal[1, -1]  # +1: the motor's reaction torque is positive about body z
    max_N: Positive


class Vehicle(Spec):
    """A quadrotor; a file that cannot fly is refused with the reason. `warnings` tells what can only just fly."""

    mass_kg: Positive
    inertia_kg_m2: tuple[Positive, Positive, Positive]  # principal, about body x, y, z
    motors: tuple[Motor, Motor, Motor, Motor]
    yaw_moment_m: Positive  # reaction torque per thrust: N m per N
    action_scale_N: Positive  # F_pi = action_scale_N · a

    @model_validator(mode="after")
    def _can_fly(self) -> "Vehicle":
        x, y, z = self.inertia_kg_m2
        greatest = max(x, y, z)
        if greatest > (x + y + z - greatest) * (1 + INERTIA_TOLERANCE):  # equal: a flat plate
            raise ValueError(
                f"expected inertia_kg_m2 of a rigid body: no moment above the sum of the other two, found {x}, {y}, {z}"
            )
        weight = self.mass_kg * STANDARD_GRAVITY_M_S2
        if self.total_thrust_N <= weight:
            raise ValueError(
                f"expected motors that can lift the vehicle, found {self.total_thrust_N:.4g} N of thrust"
                f" for {weight:.4g} N of weight"
            )
        arm, gyration = np.abs(self._wrenches[1:3]).max(), np.sqrt(max(x, y, z) / self.mass_kg)
        if arm > MOST_ARM_PER_GYRATION * gyration:
            raise ValueError(
                f"expected motors.position_m in meters: a motor at {arm:.4g} m does not fit a vehicle whose inertia is"
                f" that of its mass at {gyration:.2g} m"
            )
        for axis, torques in zip("xyz", self._wrenches[1:], strict=True):
            if np.all(torques == 0.0) or (axis != "z" and np.ptp(torques) == 0.0):
                raise ValueError(f"expected motors that can turn the vehicle about body {axis}; these have no torque")
        hover = self.hover_thrusts_N
        if not np.allclose(self._wrenches @ hover, [weight, 0, 0, 0], atol=1e-6 * weight) or hover.min() < 0.0:
            raise ValueError(
                "expected motors around the center of mass: level hover would take"
                f" {', '.join(f'{f:.3g}' for f in hover)} N, and no motor can pull down"
            )
        over = [i for i, motor in enumerate(self.motors) if hover[i] > motor.max_N]
        if over:
            raise ValueError(
                f"expected motors that can hover level: motor {over[0] + 1} would need {hover[over[0]]:.3g} N, and has"
                f" {self.motors[over[0]].max_N:.3g} N"
            )
        roll, pitch, _ = self.angular_acceleration_rad_s2
        if min(roll, pitch) < LEAST_ANGULAR_ACCELERATION_RAD_S2:
            raise ValueError(
                f"expected an action_scale_N in newtons that can turn the vehicle: {self.action_scale_N:g} N"
                f" accelerates it by {min(roll, pitch):.2g} rad/s² about body {'x' if roll < pitch else 'y'}"
            )
        return self

    @property
    def total_thrust_N(self) -> float:
        return sum(motor.max_N for motor in self.motors)

    @property
    def _wrenches(self) -> np.ndarray:
        """Lift and torque about x, y, z per thrust of each motor; [4, motors]."""
        x, y = np.array([motor.position_m for motor in self.motors]).T
        spin = np.array([motor.spin for motor in self.motors])
        return np.stack([np.ones(len(self.motors)), y, -x, self.yaw_moment_m * spin])

    @property
    def hover_thrusts_N(self) -> np.ndarray:
        """F_o of each motor: the thrusts of least norm that carry the weight without torque; mg/4 where the center of
        mass is in the middle (paper, equ:forceOutput). [motors], float64.
        """
        wrenches = self._wrenches
        scale = np.abs(wrenches).max(axis=1, keepdims=True)
        scaled = wrenches / np.where(scale > 0, scale, 1.0)
        return np.linalg.pinv(scaled) @ np.array([self.mass_kg * STANDARD_GRAVITY_M_S2, 0.0, 0.0, 0.0])

    @property
    def angular_acceleration_rad_s2(self) -> np.ndarray:
        """The greatest angular acceleration about body x, y, z by actions in [−1, 1] from hover; [3]."""
        hover = self.hover_thrusts_N
        high = np.array([motor.max_N for motor in self.motors])
        up, down = np.minimum(self.action_scale_N, high - hover), np.minimum(self.action_scale_N, hover)
        torques = self._wrenches[1:]
        torque = np.where(torques > 0, torques * up, -torques * down).sum(axis=1)
        return torque / np.array(self.inertia_kg_m2)

    @property
    def recovery_s(self) -> float:
        """Estimated time to turn upright from upside down, then to move RECOVERY_M and stop: its time scale."""
        high = np.minimum(self.hover_thrusts_N + self.action_scale_N, [motor.max_N for motor in self.motors])
        surplus = high.sum() / self.mass_kg - STANDARD_GRAVITY_M_S2
        turn = 2.0 * (np.pi / self.angular_acceleration_rad_s2[:2].min()) ** 0.5
        return float(turn + 2.0 * (RECOVERY_M / max(surplus, 0.05 * STANDARD_GRAVITY_M_S2)) ** 0.5)

    def warnings(self) -> list[str]:
        """What this vehicle can only just do, in one line each."""
        found = []
        ratio = self.total_thrust_N / (self.mass_kg * STANDARD_GRAVITY_M_S2)
        if ratio < LEAST_THRUST_PER_WEIGHT:
            found.append(
                f"thrust is {ratio:.2f} of the weight: it can only just hover, and cannot recover from most attitudes;"
                " start.tilt_rad limits those of the starts"
            )
        if np.linalg.matrix_rank(self._wrenches[1:] / np.abs(self._wrenches[1:]).max(axis=1, keepdims=True)) < 3:
            found.append("its motors cannot turn it about all axes independently: check motors.spin")
        if (yaw := self.angular_acceleration_rad_s2[2]) < LEAST_YAW_ACCELERATION_RAD_S2:
            found.append(f"it can hardly turn about body z ({yaw:.2g} rad/s²): check yaw_moment_m, N m per N of thrust")
        return found


def with_default_scale(data: Any) -> Any:
    """A vehicle object with `action_scale_N`: by default from hover thrust to the farther of a motor's limits."""
    if not isinstance(data, dict) or data.get("action_scale_N") is not None:
        return data
    try:
        hover = data["mass_kg"] * STANDARD_GRAVITY_M_S2 / len(data["motors"])
        return {**data, "action_scale_N": max(hover, max(motor["max_N"] for motor in data["motors"]) - hover)}
    except (KeyError, TypeError, ZeroDivisionError):  # the validation of the fields says what is wrong
        return data


def _folder() -> Any:
    return resources.files("qrl_envs").joinpath("vehicles")


def shipped_vehicles() -> list[str]:
    """Names of the shipped vehicles."""
    return sorted(entry.name.removesuffix(".json") for entry in _folder().iterdir() if entry.name.endswith(".json"))


def vehicle_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped vehicle's file or of a `.json`; BadInput with one line if there is none.

    A `.json` that holds a task is read for its key 'vehicle'.
    """
    if name_or_path in shipped_vehicles():
        return specfile.read(Path(str(_folder().joinpath(f"{name_or_path}.json"))))
    if not name_or_path.endswith(".json"):
        raise BadInput(f"unknown vehicle '{name_or_path}'{specfile.nearest(name_or_path, shipped_vehicles())}")
    data = specfile.read(Path(name_or_path))
    return data["vehicle"] if isinstance(data.get("vehicle"), dict) else data

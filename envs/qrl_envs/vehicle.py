"""Vehicle files: what flies, whether it can, and what it can do. Body frame: x forward, y left, z up; SI units."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import NonNegative, Positive, Real, Spec, later

STANDARD_GRAVITY_M_S2 = 9.81
INERTIA_TOLERANCE = 0.05  # measured inertias are rounded: excess over a rigid body's bound that is accepted
MOST_ARM_PER_GYRATION = 30.0  # distance of a motor per radius of gyration, above which a length has a wrong unit
LEAST_ANGULAR_ACCELERATION_RAD_S2 = 3.0  # about x and y, below which a vehicle can only just be rotated
LEAST_YAW_ACCELERATION_RAD_S2 = 0.3
RECOVERY_M = 2.0
LEAST_AXIS = 1e-3  # length
MOST_SCALE_PER_THRUST = 2.0  # action_scale_N per greatest thrust of a motor, above which actions hardly grade thrusts
LEAST_HOVER_SHARE = 0.2  # of the thrust of the motor that carries most in hover, below which a file is likely wrong
LEAST_THRUST_PER_WEIGHT = 1.3  # below, a vehicle can only just hover


def _moments(inertia: tuple[float, ...]) -> tuple[float, ...]:
    if len(inertia) not in (3, 6):
        raise ValueError(f"expected 3 moments, or 3 moments and 3 products of inertia, found {len(inertia)} numbers")
    if min(inertia[:3]) <= 0.0:
        raise ValueError(f"expected moments greater than 0, found {min(inertia[:3]):g}")
    return inertia


class Motor(Spec):
    position_m: Annotated[
        tuple[Real, ...], Field(min_length=2, max_length=3)
    ]  # x, y (, z) from the center of mass, body frame
    axis: tuple[Real, Real, Real] = later((0.0, 0.0, 1.0))  # direction of its thrust, body frame, of any length
    spin: Literal[1, -1]  # +1: the motor's reaction torque is positive about its axis
    max_N: Positive
    min_N: NonNegative = later(0.0)

    @model_validator(mode="after")
    def _limits(self) -> "Motor":
        if self.min_N >= self.max_N:
            raise ValueError(f"expected min_N below max_N, found {self.min_N:g} and {self.max_N:g}")
        if np.linalg.norm(self.axis) < LEAST_AXIS:
            raise ValueError(f"expected an axis that points somewhere, found {self.axis}")
        return self


class Vehicle(Spec):
    """A multirotor; a file that cannot fly is refused with the reason. `warnings` tells what can only just fly.

    With `rotor_rise_s` and `rotor_fall_s` 0 thrust follows its command at once, as in the paper; else each rotor's
    speed follows its set-point with that time constant, and thrust is a curve of speed.
    """

    source: str = later("")  # where the numbers are from
    mass_kg: Positive
    # About the center of mass, body axes: xx, yy, zz, or xx, yy, zz, xy, xz, yz (the products as they stand in the
    # matrix, so xy is −∫xy dm).
    inertia_kg_m2: Annotated[tuple[Real, ...], AfterValidator(_moments)]
    motors: Annotated[tuple[Motor, ...], Field(min_length=3, max_length=8)]
    yaw_moment_m: Positive  # reaction torque per thrust: N m per N
    action_scale_N: Positive  # F_pi = action_scale_N · a
    rotor_rise_s: NonNegative = later(0.0)  # time constant of a rotor's speed when it is to rise
    rotor_fall_s: NonNegative = later(0.0)
    thrust_curve: Annotated[float, Field(ge=-0.9, le=1.0)] = later(
        0.0
    )  # c of thrust/max_N = c·w + (1 − c)·w², w the speed
    drag_N_s_m: tuple[NonNegative, NonNegative, NonNegative] = later((0.0, 0.0, 0.0))  # linear, along body x, y, z
    drag_height_m: Real = later(0.0)  # of where it acts above the center of mass, along body z

    @model_validator(mode="after")
    def _can_fly(self) -> "Vehicle":
        if (self.rotor_rise_s == 0.0) != (self.rotor_fall_s == 0.0):
            raise ValueError(
                "expected rotor_rise_s and rotor_fall_s above 0, or both 0 for rotors without lag, found"
                f" {self.rotor_rise_s:g} and {self.rotor_fall_s:g}"
            )
        moments = np.linalg.eigvalsh(self.inertia_matrix_kg_m2)
        if moments[0] <= 0.0:
            raise ValueError("expected inertia_kg_m2 of a rigid body: its matrix is not positive definite")
        x, y, z = self.inertia_kg_m2[:3] if len(self.inertia_kg_m2) == 3 else map(float, moments)
        greatest = max(x, y, z)
        if greatest > (x + y + z - greatest) * (1 + INERTIA_TOLERANCE):  # equal: a flat plate
            raise ValueError(
                "expected inertia_kg_m2 of a rigid body: no principal moment above the sum of the other two, found"
                f" {x:.6g}, {y:.6g}, {z:.6g}"
            )
        weight = self.mass_kg * STANDARD_GRAVITY_M_S2
        if self.total_thrust_N <= weight:
            raise ValueError(
                f"expected motors that can lift the vehicle, found {self.total_thrust_N:.4g} N of thrust"
                f" for {weight:.4g} N of weight"
            )
        arm, gyration = np.linalg.norm(self.motor_positions_m, axis=0).max(), np.sqrt(max(x, y, z) / self.mass_kg)
        if arm > MOST_ARM_PER_GYRATION * gyration:
            raise ValueError(
                f"expected motors.position_m in meters: a motor at {arm:.4g} m does not fit a vehicle whose inertia is"
                f" that of its mass at {gyration:.2g} m"
            )
        for axis, torques in zip("xyz", self.torques_m, strict=True):
            if np.all(torques == 0.0) or (axis != "z" and np.ptp(torques) == 0.0):
                raise ValueError(f"expected motors that can turn the vehicle about body {axis}; these have no torque")
        hover = self.hover_thrusts_N
        force = np.linalg.norm(self.motor_axes @ hover)
        torque = np.abs(self.torques_m @ hover).max()
        if abs(force - weight) > 1e-6 * weight or torque > 1e-6 * weight * arm or hover.min() < 0.0:
            raise ValueError(
                "expected motors around the center of mass, and spins that balance: hover would take"
                f" {', '.join(f'{f:.3g}' for f in hover)} N, and no motor can pull down"
            )
        over = [i for i, motor in enumerate(self.motors) if hover[i] > motor.max_N]
        if over:
            raise ValueError(
                f"expected motors that can hover: motor {over[0] + 1} would need {hover[over[0]]:.3g} N, and has"
                f" {self.motors[over[0]].max_N:.3g} N"
            )
        under = [i for i, motor in enumerate(self.motors) if hover[i] < motor.min_N]
        if under:
            raise ValueError(
                f"expected motors that can hover: motor {under[0] + 1} would need {hover[under[0]]:.3g} N, and its"
                f" min_N is {self.motors[under[0]].min_N:.3g} N"
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
    def ideal(self) -> bool:
        """Whether thrust follows its command at once, without drag: the paper's world."""
        return self.rotor_rise_s == 0.0 and not any(self.drag_N_s_m)

    @property
    def inertia_matrix_kg_m2(self) -> np.ndarray:
        """[3, 3], float64."""
        xx, yy, zz, xy, xz, yz = (*self.inertia_kg_m2, 0.0, 0.0, 0.0)[:6]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    @property
    def motor_positions_m(self) -> np.ndarray:
        """[3, motors], body frame."""
        return np.array([(*motor.position_m, 0.0)[:3] for motor in self.motors]).T

    @property
    def upright(self) -> bool:
        """Whether all motors push along body z."""
        return bool(np.allclose(self.motor_axes[:2], 0.0, atol=1e-9))

    @property
    def motor_axes(self) -> np.ndarray:
        """Unit vectors along which thrust acts, body frame; [3, motors]."""
        axes = np.array([motor.axis for motor in self.motors]).T
        return axes / np.linalg.norm(axes, axis=0)

    @property
    def torques_m(self) -> np.ndarray:
        """Torque about body x, y, z per thrust of each motor; [3, motors]."""
        spin = np.array([motor.spin for motor in self.motors])
        axes = self.motor_axes
        return np.cross(self.motor_positions_m, axes, axis=0) + self.yaw_moment_m * spin * axes

    @property
    def hover_thrusts_N(self) -> np.ndarray:
        """F_o of each motor: the thrusts of least norm that carry the weight without torque; mg/4 where the center of
        mass is in the middle (paper, equ:forceOutput). [motors], float64.

        Along body z where the motors can; else along their mean axis, about which the vehicle then hovers tilted.
        """
        weight = self.mass_kg * STANDARD_GRAVITY_M_S2
        wrenches = np.concatenate([self.motor_axes, self.torques_m])
        scale = np.abs(wrenches).max(axis=1, keepdims=True)
        rows = scale[:, 0] > 0
        inverse = np.linalg.pinv(wrenches[rows] / scale[rows])
        mean_axis = self.motor_axes.sum(axis=1)
        for direction in (np.array([0.0, 0.0, 1.0]), mean_axis / max(np.linalg.norm(mean_axis), LEAST_AXIS)):
            wanted = np.concatenate([weight * direction, np.zeros(3)])[rows] / scale[rows, 0]
            thrusts = inverse @ wanted
            if np.allclose(self.motor_axes @ thrusts, weight * direction, atol=1e-6 * weight):
                break
        return np.where(np.abs(thrusts) < 1e-9 * weight, 0.0, thrusts)  # rounding, which may be below 0

    @property
    def hover_speeds(self) -> np.ndarray:
        """The rotors' speeds in hover, of their greatest; [motors], float64."""
        return self._speeds(self.hover_thrusts_N)

    @property
    def least_speeds(self) -> np.ndarray:
        """The rotors' speeds at `min_N`, of their greatest; [motors], float64."""
        return self._speeds(np.array([motor.min_N for motor in self.motors]))

    def _speeds(self, thrusts_N: np.ndarray) -> np.ndarray:
        """w with c·w + (1 − c)·w² = thrust/max, and 0 without thrust."""
        share, c = thrusts_N / [motor.max_N for motor in self.motors], self.thrust_curve
        some = np.maximum(share, 1e-12)
        return np.where(share > 0.0, 2.0 * some / (c + np.sqrt(c * c + 4.0 * (1.0 - c) * some)), 0.0)

    @property
    def angular_acceleration_rad_s2(self) -> np.ndarray:
        """The greatest angular acceleration about body x, y, z by actions in [−1, 1] from hover; [3]."""
        hover = self.hover_thrusts_N
        high, low = (np.array([getattr(motor, name) for motor in self.motors]) for name in ("max_N", "min_N"))
        up, down = np.minimum(self.action_scale_N, high - hover), np.minimum(self.action_scale_N, hover - low)
        rotations = np.linalg.solve(self.inertia_matrix_kg_m2, self.torques_m)
        return np.where(rotations > 0, rotations * up, -rotations * down).sum(axis=1)

    @property
    def recovery_s(self) -> float:
        """Estimated time to turn upright from upside down, then to move RECOVERY_M and stop: its time scale."""
        high = np.minimum(self.hover_thrusts_N + self.action_scale_N, [motor.max_N for motor in self.motors])
        surplus = high.sum() / self.mass_kg - STANDARD_GRAVITY_M_S2
        turn = 2.0 * (np.pi / self.angular_acceleration_rad_s2[:2].min()) ** 0.5 + self.rotor_rise_s + self.rotor_fall_s
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
        if np.linalg.matrix_rank(self.torques_m / np.abs(self.torques_m).max(axis=1, keepdims=True)) < 3:
            found.append("its motors cannot turn it about all axes independently: check motors.spin")
        if (yaw := self.angular_acceleration_rad_s2[2]) < LEAST_YAW_ACCELERATION_RAD_S2:
            found.append(f"it can hardly turn about body z ({yaw:.2g} rad/s²): check yaw_moment_m, N m per N of thrust")
        hover, most_N = self.hover_thrusts_N, [motor.max_N for motor in self.motors]
        if hover.min() < LEAST_HOVER_SHARE * hover.max():
            found.append(
                f"in hover motor {hover.argmin() + 1} carries {hover.min():.2g} N and motor {hover.argmax() + 1}"
                f" {hover.max():.2g} N: check motors.position_m and motors.spin"
            )
        reach = np.minimum(hover + self.action_scale_N, most_N).sum() / (self.mass_kg * STANDARD_GRAVITY_M_S2)
        if reach < LEAST_THRUST_PER_WEIGHT <= ratio:
            found.append(
                f"actions reach {reach:.2f} of the weight, and its motors {ratio:.2f}: check action_scale_N"
                f" ({self.action_scale_N:g} N); a file that extends a task has its vehicle's unless it gives one"
            )
        if self.action_scale_N > MOST_SCALE_PER_THRUST * (most := max(motor.max_N for motor in self.motors)):
            found.append(
                f"action_scale_N is {self.action_scale_N:g} N and no motor has more than {most:g} N, so nearly every"
                " action is a motor's limit; a file that extends a task has its vehicle's unless it gives one"
            )
        return found


def with_default_scale(data: Any) -> Any:
    """A vehicle object with `action_scale_N`: by default from a quarter of the weight (of four motors) to the farther
    of a motor's limits.
    """
    if not isinstance(data, dict) or data.get("action_scale_N") is not None:
        return data
    try:
        hover = data["mass_kg"] * STANDARD_GRAVITY_M_S2 / len(data["motors"])
        return {**data, "action_scale_N": max(hover, max(motor["max_N"] for motor in data["motors"]) - hover)}
    except (KeyError, TypeError, ZeroDivisionError):  # the validation of the fields says what is wrong
        return data


def shipped_vehicles() -> list[str]:
    """Names of the shipped vehicles."""
    return specfile.shipped("vehicles")


def vehicle_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped vehicle's file or of a `.json`; BadInput with one line if there is none.

    A `.json` that holds a task is read for its key 'vehicle'.
    """
    data = specfile.named("vehicle", "vehicles", name_or_path)
    if isinstance(of_task := data.get("vehicle"), str):
        return specfile.named("vehicle", "vehicles", of_task)
    return of_task if isinstance(of_task, dict) else data

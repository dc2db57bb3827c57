"""Tasks as data: vehicle, start ranges, bounds, reward and evaluation.

`load` reads a shipped task by name, or a `.json` that may `extend` one. Units are in the names. World and body frames:
x forward, y left, z up.
"""

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import BadInput, Count, NonNegative, Positive, Real, Spec


class Motor(Spec):
    position_m: tuple[Real, Real]  # x, y in the body frame
    spin: Literal[1, -1]  # +1: the motor's reaction torque is positive about body z
    max_N: Positive


class Vehicle(Spec):
    mass_kg: Positive
    inertia_kg_m2: tuple[Positive, Positive, Positive]  # principal, about body x, y, z
    motors: tuple[Motor, Motor, Motor, Motor]
    yaw_moment_m: Positive  # reaction torque per thrust: N m per N
    action_scale_N: Positive  # F_pi = action_scale_N · a

    @model_validator(mode="after")
    def _possible(self) -> "Vehicle":
        x, y, z = self.inertia_kg_m2
        if 2 * max(x, y, z) > (x + y + z) * (1 + 1e-9):  # equality: a flat plate
            raise ValueError(
                f"expected inertia_kg_m2 of a rigid body: no moment above the sum of the other two, found {x}, {y}, {z}"
            )
        if self.total_thrust_N <= self.mass_kg * STANDARD_GRAVITY_M_S2:
            raise ValueError(
                f"expected motors that can lift the vehicle, found {self.total_thrust_N:.4g} N of thrust"
                f" for {self.mass_kg * STANDARD_GRAVITY_M_S2:.4g} N of weight"
            )
        return self

    @property
    def total_thrust_N(self) -> float:
        return sum(motor.max_N for motor in self.motors)


STANDARD_GRAVITY_M_S2 = 9.81


class FlightStart(Spec):
    """Start ranges: each coordinate is uniform in ±range, the attitude uniform over SO(3)."""

    position_m: NonNegative  # from the hover point or the circle's centre
    velocity_m_s: NonNegative
    body_rate_rad_s: NonNegative


# Includes the paper's trial, which started at 6.7 m/s (its figure of a hovering trial).
ENVELOPE = FlightStart(position_m=2.0, velocity_m_s=7.0, body_rate_rad_s=1.0)


class Bounds(Spec):
    """An episode beyond these bounds ends early, as a truncation."""

    distance_m: Positive
    body_rate_rad_s: Positive


class HoverReward(Spec):
    """constant − (w1·‖q_e‖ + w2·‖p_e‖ + w3·‖a‖) (paper, Sec. 5)."""

    form: Literal["hover"]
    constant: Real = 0.0
    w1_attitude: NonNegative
    w2_position_1_m: NonNegative
    w3_action: NonNegative


class CircleReward(Spec):
    """constant − (w4·d + w5·|chi| + w6·‖a‖) (paper, Sec. 5.3)."""

    form: Literal["circle"]
    constant: Real = 0.0
    w4_distance_1_m: NonNegative
    w5_direction_s_m2: NonNegative
    w6_action: NonNegative
    radius_m: Positive
    speed_m_s: Positive


FlightReward = Annotated[HoverReward | CircleReward, Field(discriminator="form")]


class FlightEvaluation(Spec):
    """Success: every tolerance holds throughout the last `tail_s` of a flight of `duration_s`."""

    duration_s: Positive
    tail_s: Positive
    return_steps: Count
    distance_m: Positive  # from the hover point, or from the circle
    speed_m_s: Positive | None = None  # circle only: |tangential speed − reward's speed|
    start: FlightStart
    reward: FlightReward  # added up over the first `return_steps` of the flight

    @model_validator(mode="after")
    def _consistent(self) -> "FlightEvaluation":
        if (self.speed_m_s is None) != (self.reward.form == "hover"):
            raise ValueError("expected speed_m_s for the circle and for the circle alone")
        return self


T = TypeVar("T", bound="QuadrotorTask | PendulumTask")


def _periods_fit(task: T) -> T:
    if not task.control_period_s <= task.evaluation.tail_s <= task.evaluation.duration_s:
        raise ValueError(
            "expected control_period_s ≤ evaluation.tail_s ≤ evaluation.duration_s, found "
            f"{task.control_period_s}, {task.evaluation.tail_s}, {task.evaluation.duration_s}"
        )
    if task.evaluation.duration_s / task.control_period_s > 1e6:
        raise ValueError(f"expected evaluation.duration_s of at most a million periods of {task.control_period_s} s")
    return task


class QuadrotorTask(Spec):
    world: Literal["quadrotor"]
    description: str
    preset: str  # the learner's defaults for this task
    control_period_s: Positive
    episode_steps: Count
    vehicle: Vehicle
    start: FlightStart
    envelope: FlightStart = ENVELOPE  # starts that an exported policy is calibrated for
    bounds: Bounds
    reward: FlightReward
    evaluation: FlightEvaluation

    @model_validator(mode="after")
    def _consistent(self) -> "QuadrotorTask":
        train, evaluation = self.reward, self.evaluation.reward
        for name in ("form", "radius_m", "speed_m_s"):
            if getattr(train, name, None) != getattr(evaluation, name, None):
                raise ValueError(f"expected reward.{name} and evaluation.reward.{name} to be the same")
        return _periods_fit(self)


class PendulumStart(Spec):
    angle_rad: NonNegative
    rate_rad_s: NonNegative


class PendulumReward(Spec):
    """−(w_angle·θ² + w_rate·θ̇² + w_torque·u²) of the state before the step, as in Pendulum-v1."""

    form: Literal["pendulum"]
    w_angle_1_rad2: NonNegative
    w_rate_s2_rad2: NonNegative
    w_torque_1_N2m2: NonNegative


class Rod(Spec):
    mass_kg: Positive
    length_m: Positive
    gravity_m_s2: Positive
    max_torque_N_m: Positive
    max_rate_rad_s: Positive


class PendulumEvaluation(Spec):
    """Success: |θ| and |θ̇| within tolerance throughout the last `tail_s` of a flight of `duration_s`."""

    duration_s: Positive
    tail_s: Positive
    angle_rad: Positive
    rate_rad_s: Positive
    start: PendulumStart | None = None  # null: as in training
    reward: PendulumReward | None = None  # added up over the flight; null: as in training


class PendulumTask(Spec):
    world: Literal["pendulum"]
    description: str
    preset: str
    control_period_s: Positive
    episode_steps: Count
    rod: Rod
    start: PendulumStart
    reward: PendulumReward
    evaluation: PendulumEvaluation

    @model_validator(mode="after")
    def _consistent(self) -> "PendulumTask":
        return _periods_fit(self)


Task = QuadrotorTask | PendulumTask

# The fields whose numbers are arguments of a compiled program (env.Params); the other fields shape the program.
TRACED = ("vehicle", "rod", "start", "bounds", "reward")
_ANY_TASK = Annotated[Task, Field(discriminator="world")]


def shipped() -> list[str]:
    """Names of the shipped tasks."""
    return sorted(
        entry.name.removesuffix(".json")
        for entry in resources.files("qrl_envs").joinpath("tasks").iterdir()
        if entry.name.endswith(".json")
    )


def _shipped(name: str) -> dict[str, Any]:
    return extended(specfile.read(Path(str(resources.files("qrl_envs").joinpath("tasks", f"{name}.json")))), name)


def load(name_or_path: str) -> Task:
    """The task of a shipped name or of a `.json` file; raises BadInput with a message of one line."""
    if name_or_path in shipped():
        return specfile.build(_ANY_TASK, _shipped(name_or_path), name_or_path)
    if name_or_path.endswith(".json"):
        return from_data(specfile.read(Path(name_or_path)), name_or_path)
    raise BadInput(f"unknown task '{name_or_path}'{specfile.nearest(name_or_path, shipped())}")


def from_data(data: dict[str, Any], where: str) -> Task:
    """The task of a JSON object, which may `extend` a shipped task; error messages begin with `where`."""
    return specfile.build(_ANY_TASK, extended(data, where), where)


def extended(data: dict[str, Any], where: str) -> dict[str, Any]:
    """`data` merged over the shipped task that its key `extend` names, if any."""
    if "extend" not in data:
        return data
    base = data["extend"]
    if base not in shipped():
        raise BadInput(f"{where}: key 'extend': no shipped task '{base}'{specfile.nearest(str(base), shipped())}")
    return specfile.merge(_shipped(base), {key: value for key, value in data.items() if key != "extend"})

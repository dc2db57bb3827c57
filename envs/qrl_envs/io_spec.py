"""What each number of an observation and an action means: name, unit, frame, and for actions the way to SI units."""

from typing import NamedTuple

from qrl_envs.task import STANDARD_GRAVITY_M_S2, QuadrotorTask, Task


class ObservationPort(NamedTuple):
    name: str
    unit: str
    frame: str


class ActionPort(NamedTuple):
    """clip(offset + scale·a, low, high), in `unit`, for a in [−1, 1]."""

    name: str
    unit: str
    frame: str
    offset: float
    scale: float
    low: float
    high: float
    safe: float  # hover thrust, no torque
    position_m: tuple[float, float] | None = None  # motors: x, y in the body frame
    spin: int | None = None  # motors: +1 where the reaction torque is positive about body z


def observations(task: Task) -> list[ObservationPort]:
    """In the order of DESIGN.md, "Frames, units, order"."""
    if not isinstance(task, QuadrotorTask):
        angle = "angle from upright, positive counter-clockwise"
        return [
            ObservationPort("cos_theta", "1", angle),
            ObservationPort("sin_theta", "1", angle),
            ObservationPort("theta_dot", "rad/s", angle),
        ]
    what = "the hover point" if task.reward.form == "hover" else "the circle's centre"
    rotation = [
        ObservationPort(f"r{i}{j}", "1", f"rotation matrix body -> world: world {axis} part of the body {other} axis")
        for i, axis in enumerate("xyz", 1)
        for j, other in enumerate("xyz", 1)
    ]
    return [
        *rotation,
        *(ObservationPort(f"p{axis}", "m", f"world: position from {what}") for axis in "xyz"),
        *(ObservationPort(f"v{axis}", "m/s", "world: velocity") for axis in "xyz"),
        *(ObservationPort(f"w{axis}", "rad/s", "body: angular rate") for axis in "xyz"),
    ]


def actions(task: Task) -> list[ActionPort]:
    """In the order of the task's motors."""
    if not isinstance(task, QuadrotorTask):
        most = task.rod.max_torque_N_m
        return [ActionPort("torque", "N m", "about the pivot, positive counter-clockwise", 0.0, most, -most, most, 0.0)]
    vehicle = task.vehicle
    hover = vehicle.mass_kg * STANDARD_GRAVITY_M_S2 / 4.0
    return [
        ActionPort(
            name=f"f{i}",
            unit="N",
            frame="thrust along body z",
            offset=hover,
            scale=vehicle.action_scale_N,
            low=0.0,
            high=motor.max_N,
            safe=min(hover, motor.max_N),
            position_m=motor.position_m,
            spin=motor.spin,
        )
        for i, motor in enumerate(vehicle.motors, 1)
    ]

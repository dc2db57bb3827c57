"""Names, units and frames of a task's observations and actions, and the map from actions to SI units."""

from typing import Any, NamedTuple

from qrl_envs.task import QuadrotorTask, Task

UP = (0.0, 0.0, 1.0)


class ObservationPort(NamedTuple):
    """One number of the observation."""

    name: str
    unit: str  # SI; "1": dimensionless
    frame: str
    ahead_s: float | None = None  # of the preview of a reference: how far ahead


class ActionPort(NamedTuple):
    """One number of the action: clip(offset + scale·a, low, high) in `unit`, for a in [−1, 1]."""

    name: str
    unit: str  # SI
    frame: str
    offset: float  # in `unit`, like the next four
    scale: float
    low: float
    high: float
    safe: float  # command when an input is invalid: that of hover, zero torque
    position_m: tuple[float, ...] | None = None  # of a motor: x, y or x, y, z in the body frame
    spin: int | None = None  # of a motor: +1 if its reaction torque is positive about body z
    quantity: str | None = None  # where `unit` does not say it
    axis: tuple[float, float, float] = UP  # of a motor: the direction of its thrust in the body frame
    thrust_curve: float = 0.0  # of a motor, c: thrust is c·w + (1 − c)·w² of its greatest, w its speed of its greatest


def observations(task: Task) -> list[ObservationPort]:
    """The observation's numbers in order: 18 of a quadrotor (`env.QuadrotorEnv`), 3 of the pendulum."""
    if not isinstance(task, QuadrotorTask):
        angle = "angle from upright, positive counter-clockwise"
        return [
            ObservationPort("cos_theta", "1", angle),
            ObservationPort("sin_theta", "1", angle),
            ObservationPort("theta_dot", "rad/s", angle),
        ]
    origin = {"hover": "the hover point", "circle": "the circle's center", "track": "the reference now"}[
        task.reward.form
    ]
    relative = " relative to that of the reference now" if task.reference else ""
    rotation = [
        ObservationPort(f"r{i}{j}", "1", f"rotation matrix body -> world: world {axis} part of the body {other} axis")
        for i, axis in enumerate("xyz", 1)
        for j, other in enumerate("xyz", 1)
    ]
    return [
        *rotation,
        *(ObservationPort(f"p{axis}", "m", f"world: position from {origin}") for axis in "xyz"),
        *(ObservationPort(f"v{axis}", "m/s", f"world: velocity{relative}") for axis in "xyz"),
        *(ObservationPort(f"w{axis}", "rad/s", "body: angular rate") for axis in "xyz"),
        *(
            ObservationPort(
                f"d{i}{axis}",
                "m/s",
                f"world: the reference's velocity in {ahead_s:g} s minus its velocity now",
                ahead_s=ahead_s,
            )
            for i, ahead_s in enumerate(task.preview_s, 1)
            for axis in "xyz"
        ),
    ]


def actions(task: Task) -> list[ActionPort]:
    """The action's numbers: a quadrotor's motors in the order of its vehicle file, or the pendulum's torque."""
    if not isinstance(task, QuadrotorTask):
        limit, frame = task.rod.max_torque_N_m, "about the pivot, positive counter-clockwise"
        return [ActionPort("torque", "N m", frame, offset=0.0, scale=limit, low=-limit, high=limit, safe=0.0)]
    vehicle = task.vehicle
    axes: list[Any] = [tuple(map(float, axis)) for axis in vehicle.motor_axes.T]
    if task.action == "rotor_speed":
        return [
            ActionPort(
                name=f"f{i}",
                unit="1",
                frame="rotor speed, of its greatest; safe: that of the vehicle of the task's file in hover",
                offset=0.5,
                scale=0.5,
                low=round(float(least), 4),
                high=1.0,
                safe=round(float(speed), 4),
                position_m=motor.position_m,
                spin=motor.spin,
                axis=axes[i - 1],
                quantity="rotor speed fraction",
            )
            for i, (motor, speed, least) in enumerate(
                zip(vehicle.motors, vehicle.hover_speeds, vehicle.least_speeds, strict=True), 1
            )
        ]
    hover = [float(thrust) for thrust in vehicle.hover_thrusts_N]
    return [
        ActionPort(
            name=f"f{i}",
            unit="N",
            frame="thrust along body z" if axes[i - 1] == UP else "thrust along its axis",
            offset=hover[i - 1],
            scale=vehicle.action_scale_N,
            low=motor.min_N,
            high=motor.max_N,
            safe=hover[i - 1],
            position_m=motor.position_m,
            spin=motor.spin,
            axis=axes[i - 1],
            thrust_curve=vehicle.thrust_curve,
        )
        for i, motor in enumerate(vehicle.motors, 1)
    ]

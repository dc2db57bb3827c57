"""Tasks as data: vehicle, start ranges, bounds, reward and evaluation.

`load` reads a shipped task by name, or a `.json` that may `extend` one. Units are in the names. World and body frames:
x forward, y left, z up.
"""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from qrl_envs import reference as references
from qrl_envs import specfile
from qrl_envs.distribution import VehicleDistribution, distribution_data, shipped_distributions
from qrl_envs.reference import FixedReference, Reference, reference_data, shipped_references
from qrl_envs.specfile import BadInput, NonNegative, Positive, Real, Spec, later
from qrl_envs.uncertainty import Uncertainty, shipped_uncertainties, uncertainty_data
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle, shipped_vehicles, vehicle_data, with_default_scale


class FlightStart(Spec):
    """Start ranges: each coordinate is uniform in ±range, the attitude uniform within a tilt from upright. With
    `nested` a flight has ranges of its own: these, times a factor that is uniform in [0, 1].
    """

    position_m: NonNegative  # from the hover point or the circle's center
    velocity_m_s: NonNegative
    body_rate_rad_s: NonNegative
    tilt_rad: Annotated[float, Field(gt=0.0, le=3.141592653589793)] = 3.141592653589793  # the default is all of SO(3)
    nested: bool = later(default=False)


# Includes the paper's trial, which started at 6.7 m/s (its figure of a hovering trial).
ENVELOPE = FlightStart(position_m=2.0, velocity_m_s=7.0, body_rate_rad_s=1.0)


class Bounds(Spec):
    """An episode beyond these bounds ends early, as a truncation."""

    distance_m: Positive
    body_rate_rad_s: Positive


class Integral(Spec):
    """The integral of the position error as an observation; far from the target, where it would wind up, it stands.

    dI/dt = e·max(0, 1 − |e|²/radius_m²)², within ±limit_m_s for each component. In hover e is the position; on a circle
    of radius R, [E, z, E·x/R, E·y/R] with E = (x² + y² − R²)/(2R), near the circle the distance to its radius: a wrong
    thrust moves E, a constant force along the world moves the circle's center. There |e|² is E² + z².
    """

    radius_m: Positive = 0.5
    limit_m_s: Positive = 0.6


class Memory(Spec):
    """What a policy observes beside measurements; the environment keeps it, and in flight the exported kernel."""

    previous_action: bool = False
    integral: Integral | None = None


class Near(Spec):
    """A cost of the distance d that is steep near the point: weight·d/(d + distance_m)."""

    weight: NonNegative
    distance_m: Positive


class HoverReward(Spec):
    """constant − (w1·‖q_e‖ + w2·‖p_e‖ + near + w3·‖a‖ + w_change·‖Δa‖²) (paper, Sec. 5, which has neither `near` nor
    the change Δa of the action).
    """

    form: Literal["hover"]
    constant: Real = 0.0
    w1_attitude: NonNegative
    w2_position_1_m: NonNegative
    w3_action: NonNegative
    near: Near | None = later(None)
    w_change: NonNegative = later(0.0)


class CircleReward(Spec):
    """constant − (w4·d + w5·|chi| + w6·‖a‖ + w_change·‖Δa‖²) (paper, Sec. 5.3, without the change Δa of the action)."""

    form: Literal["circle"]
    constant: Real = 0.0
    w4_distance_1_m: NonNegative
    w5_direction_s_m2: NonNegative  # in a file by default W5_RADIUS_S_M / radius_m: a speed error costs the same
    w6_action: NonNegative
    radius_m: Positive
    speed_m_s: Real  # above 0: counter-clockwise seen from above
    w_change: NonNegative = later(0.0)

    @model_validator(mode="after")
    def _moves(self) -> "CircleReward":
        if self.speed_m_s == 0.0:
            raise ValueError("expected a speed_m_s above 0, or below 0 for a clockwise circle, found 0")
        return self


class TrackReward(Spec):
    """constant − (w_position·d + near + w_velocity·‖ė‖ + w_body_rate·‖ω‖² + w_heading·sin²(ψ/2) + w_change·‖Δa‖²) of
    the error e to a reference, its d = √(‖e‖² + rounding_m²) − rounding_m, the heading ψ and the change of action Δa.
    """

    form: Literal["track"]
    constant: Real = 0.0
    w_position_1_m: NonNegative
    rounding_m: Positive  # of the position's cost, which is quadratic below and linear above
    w_velocity_s_m: NonNegative
    w_body_rate_s2_rad2: NonNegative
    w_heading: NonNegative
    w_change: NonNegative
    near: Near | None = later(None)


MOST_PREVIEW_S = 2.0
# Key of a task file: what else it says where its vehicle has rotors that lag, or drag, or where it is uncertain.
LAGGED = "with_lag"
W5_RADIUS_S_M = 0.5  # w5 of the 1 m circle

FlightReward = Annotated[HoverReward | CircleReward | TrackReward, Field(discriminator="form")]


class FlightEvaluation(Spec):
    """Success: every tolerance holds throughout the last `tail_s` of a flight of `duration_s`. To track, the root mean
    square of the distance is within its tolerance; by default `tail_s` begins when the first lap is over, or after 2 s.
    """

    duration_s: Positive
    tail_s: Positive
    return_s: Positive
    distance_m: Positive  # from the hover point, the circle, or the reference
    speed_m_s: Positive | None = None  # circle only: |tangential speed − reward's speed|
    start: FlightStart
    reward: FlightReward  # added up over the first `return_s` of the flight
    reference: Annotated[FixedReference | None, Field(exclude_if=lambda x: x is None)] = None  # to track

    @model_validator(mode="after")
    def _consistent(self) -> "FlightEvaluation":
        if (self.speed_m_s is None) != (self.reward.form != "circle"):
            raise ValueError("expected speed_m_s for the circle and for the circle alone")
        if (self.reference is None) != (self.reward.form != "track"):
            raise ValueError("expected a reference for a task that tracks one, and for that alone")
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
    episode_s: Positive  # maximum duration of a training episode
    vehicle: Vehicle
    uncertainty: Uncertainty | None = None
    # Each flight has a vehicle of its own, with the places of the motors of `vehicle`. As `specfile.later`.
    distribution: Annotated[VehicleDistribution | None, Field(exclude_if=lambda x: x is None)] = None
    # What an action in [−1, 1] stands for: thrusts about hover, or the rotors' speeds from 0 to their greatest.
    action: Annotated[Literal["thrust", "rotor_speed"], Field(exclude_if=lambda x: x == "thrust")] = "thrust"
    memory: Annotated[Memory, Field(exclude_if=lambda x: x == Memory())] = Memory()  # as `specfile.later`
    # The frame of what a policy network is given: the world's, or the body's without the heading. As `specfile.later`.
    policy_frame: Annotated[Literal["world", "body"], Field(exclude_if=lambda x: x == "world")] = "world"
    reference: Annotated[Reference | None, Field(exclude_if=lambda x: x is None)] = None  # to track, in training
    # Times ahead at which the policy is given the reference's velocity. As `specfile.later`.
    preview_s: Annotated[tuple[Positive, ...], Field(max_length=8, exclude_if=lambda x: x == ())] = ()
    start: FlightStart  # from the hover point, the circle's center, or the reference
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
        if isinstance(train, CircleReward):
            self._check_circle(train)
        if (self.reference is None) != (train.form != "track"):
            raise ValueError("expected a reference with a reward of form 'track', and with that alone")
        self._check_references()
        self._check_distribution()
        for where, start in (("start", self.start), ("evaluation.start", self.evaluation.start)):
            reach = 3**0.5 * start.position_m
            if reach >= self.bounds.distance_m:
                raise ValueError(
                    f"expected bounds.distance_m beyond the starts, which reach {reach:.3g} m ({where}.position_m ="
                    f" {start.position_m:g} along each axis), found {self.bounds.distance_m:g}"
                )
            fastest = 3**0.5 * start.body_rate_rad_s
            if fastest >= self.bounds.body_rate_rad_s:
                raise ValueError(
                    f"expected bounds.body_rate_rad_s beyond the starts, which reach {fastest:.3g} rad/s"
                    f" ({where}.body_rate_rad_s = {start.body_rate_rad_s:g} about each axis), found"
                    f" {self.bounds.body_rate_rad_s:g}"
                )
        return _periods_fit(self)

    def _check_distribution(self) -> None:
        if self.distribution is None:
            return
        if self.action != "rotor_speed":
            raise ValueError("expected action 'rotor_speed' with a distribution of vehicles: their thrusts differ")
        uncertainty = self.uncertainty or Uncertainty()
        if uncertainty.rotor_lag_s is not None or uncertainty.rotor_lag_factor != (1.0, 1.0):
            raise ValueError(
                "expected no rotor_lag in the uncertainty of a distribution of vehicles, which has its own"
            )
        if len(self.vehicle.motors) != 4 or not self.vehicle.upright:
            raise ValueError("expected a vehicle of four motors along z with a distribution of vehicles")

    def _check_references(self) -> None:
        if self.preview_s and self.reference is None:
            raise ValueError("expected no preview_s without a reference")
        if self.preview_s and not self.control_period_s <= min(self.preview_s) <= max(self.preview_s) <= MOST_PREVIEW_S:
            raise ValueError(
                f"expected preview_s from control_period_s to {MOST_PREVIEW_S:g} s, found {list(self.preview_s)}"
            )
        for key, found in (("reference", self.reference), ("evaluation.reference", self.evaluation.reference)):
            if found is not None and not isinstance(found, references.Random):
                try:
                    references.check(found, self.vehicle)
                except ValueError as error:
                    raise ValueError(f"{key}: {error}") from None

    def _check_circle(self, circle: CircleReward) -> None:
        needed = circle.speed_m_s**2 / circle.radius_m
        lift = self.vehicle.total_thrust_N / self.vehicle.mass_kg
        can = (lift**2 - STANDARD_GRAVITY_M_S2**2) ** 0.5
        if needed > can:
            raise ValueError(
                f"expected a circle that the vehicle can fly: {abs(circle.speed_m_s):g} m/s on {circle.radius_m:g} m"
                f" takes {needed:.3g} m/s² toward the center, and its thrust allows {can:.3g}"
            )
        if circle.radius_m >= self.bounds.distance_m:
            raise ValueError(
                f"expected bounds.distance_m beyond the circle's radius of {circle.radius_m:g} m,"
                f" found {self.bounds.distance_m:g}"
            )

    @property
    def episode_steps(self) -> int:
        return max(1, round(self.episode_s / self.control_period_s))

    @property
    def ideal(self) -> bool:
        """Whether this is the paper's world: thrust at once, no drag, nothing uncertain, no memory."""
        plain = self.memory == Memory() and self.policy_frame == "world" and self.reference is None
        plain = plain and self.action == "thrust"
        return self.vehicle.ideal and self.uncertainty is None and plain

    def warnings(self) -> list[str]:
        """What is accepted and may not work, in one line each."""
        lag = self.lag_not_trained
        return [
            *(f"vehicle: {text}" for text in self.vehicle.warnings()),
            *([f"{lag}: no policy that is trained so has met it"] if lag else []),
        ]

    @property
    def lag_not_trained(self) -> str | None:
        """Why a policy trained on this task has not met its vehicle's own lag, in one line; None: it has."""
        own_s = self.vehicle.rotor_rise_s, self.vehicle.rotor_fall_s
        return self.uncertainty.excludes_lag(own_s) if self.uncertainty else None


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
    episode_s: Positive
    rod: Rod
    start: PendulumStart
    reward: PendulumReward
    evaluation: PendulumEvaluation

    @model_validator(mode="after")
    def _consistent(self) -> "PendulumTask":
        return _periods_fit(self)

    @property
    def episode_steps(self) -> int:
        return max(1, round(self.episode_s / self.control_period_s))

    def warnings(self) -> list[str]:
        """What is accepted and may not work, in one line each."""
        return []


Task = QuadrotorTask | PendulumTask

# The fields whose numbers are arguments of a compiled program (task_env.Params); the other fields shape the program.
TRACED = ("vehicle", "uncertainty", "rod", "start", "bounds", "reward")
_ANY_TASK = Annotated[Task, Field(discriminator="world")]


def shipped() -> list[str]:
    """Names of the shipped tasks."""
    return sorted(
        entry.name.removesuffix(".json")
        for entry in resources.files("qrl_envs").joinpath("tasks").iterdir()
        if entry.name.endswith(".json")
    )


# Parts of a task that may be a file of their own: what reads them, and the names of those that are shipped.
_PARTS = {
    "vehicle": (vehicle_data, shipped_vehicles),
    "uncertainty": (uncertainty_data, shipped_uncertainties),
    "reference": (reference_data, shipped_references),
    "distribution": (distribution_data, shipped_distributions),
}


def _shipped(name: str) -> dict[str, Any]:
    data = extended(specfile.read(Path(str(resources.files("qrl_envs").joinpath("tasks", f"{name}.json")))), name)
    return data | {"vehicle": vehicle_data(named)} if isinstance(named := data.get("vehicle"), str) else data


def load(
    name_or_path: str, vehicle: str | None = None, uncertainty: str | None = None, reference: str | None = None
) -> Task:
    """The task of a shipped name or of a `.json` file, with the `vehicle`, the `uncertainty` and the `reference` of
    that name or file where one is given.

    Raises BadInput with a message of one line.
    """
    parts = {"vehicle": vehicle, "uncertainty": uncertainty, "reference": reference}
    if name_or_path in shipped():
        return from_data(_shipped(name_or_path), name_or_path, parts=parts)
    if name_or_path.endswith(".json"):
        path = Path(name_or_path)
        return from_data(specfile.read(path), name_or_path, path.parent, parts)
    raise BadInput(f"unknown task '{name_or_path}'{specfile.nearest(name_or_path, shipped())}")


def from_data(
    data: dict[str, Any], where: str, folder: Path = Path(), parts: Mapping[str, str | None] = MappingProxyType({})
) -> Task:
    """The task of a JSON object, which may `extend` a shipped task; error messages begin with `where`.

    Its keys `vehicle`, `uncertainty` and `reference`, and that of its evaluation, may each be an object, a shipped name
    or a path, from `folder` on; `parts`, names or paths by key, replace them, a reference that of the evaluation too.
    """
    data = extended(data, where)
    lagged = data.pop(LAGGED, {})
    data = _with_parts(data, where, folder, parts)
    where += "".join(f" with {key} {asked}" for key, asked in parts.items() if asked is not None)
    if _lags(data.get("vehicle")) or data.get("uncertainty"):
        left = {key: value for key, value in lagged.items() if parts.get(key) is None}
        data = _with_parts(specfile.merge(data, left), where, folder, {})
    return specfile.build(_ANY_TASK, _completed(data, where), where)


def _with_parts(data: dict[str, Any], where: str, folder: Path, parts: Mapping[str, str | None]) -> dict[str, Any]:
    """`data` with its parts read from their files."""
    for key, (read, known) in _PARTS.items():
        if (asked := parts.get(key)) is not None:
            if data.get("world") != "quadrotor" or (key == "reference" and key not in data):
                raise BadInput(f"{where}: has no {key} to replace by '{asked}'")
            data = {**data, key: read(asked)}
            if key == "reference":
                data = with_reference(data, data[key])
        elif isinstance(named := data.get(key), str):
            try:
                data = {**data, key: read(named if named in known() else str(folder / named))}
            except BadInput as error:
                raise BadInput(f"{where}: key '{key}': {error}") from None
    evaluation = data.get("evaluation")
    if isinstance(evaluation, dict) and isinstance(named := evaluation.get("reference"), str):
        try:
            read = reference_data(named if named in shipped_references() else str(folder / named))
        except BadInput as error:
            raise BadInput(f"{where}: key 'evaluation.reference': {error}") from None
        data = {**data, "evaluation": {**evaluation, "reference": read}}
    return data


def with_reference(data: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """A task object whose evaluation follows `reference`, for as long as that takes."""
    if not isinstance(given := data.get("evaluation", {}), dict):
        return data
    evaluation = {k: v for k, v in given.items() if k not in ("duration_s", "tail_s")}
    return {**data, "evaluation": {**evaluation, "reference": reference}}


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and 0 < value < 1e9


def _completed(data: dict[str, Any], where: str) -> dict[str, Any]:
    """A task object with the values that follow from others, and its durations, which the first version counted in
    steps, in seconds.
    """
    evaluation = dict(part) if isinstance(part := data.get("evaluation"), dict) else part
    data = data | {"evaluation": evaluation} if "evaluation" in data else dict(data)
    if isinstance(evaluation, dict) and isinstance(followed := evaluation.get("reference"), dict):
        duration_s, tail_s = references.evaluation_s(specfile.build(FixedReference, followed, f"{where}: reference"))
        evaluation |= {"duration_s": duration_s, "tail_s": tail_s} | evaluation
    period = data.get("control_period_s")
    for part, former, name in ((data, "episode_steps", "episode_s"), (evaluation, "return_steps", "return_s")):
        if isinstance(part, dict) and isinstance(period, int | float) and _positive(part.get(former)):
            part[name] = part.pop(former) * period
    for part in (data, evaluation):
        reward: Any = part.get("reward") if isinstance(part, dict) else None
        if isinstance(part, dict) and isinstance(reward, dict) and _positive(reward.get("radius_m")):
            part["reward"] = {"w5_direction_s_m2": W5_RADIUS_S_M / reward["radius_m"]} | reward
    return data | {"vehicle": with_default_scale(data["vehicle"])} if "vehicle" in data else data


def _lags(vehicle: Any) -> bool:
    """Whether a vehicle object has rotors that lag, or drag."""
    if not isinstance(vehicle, dict):
        return False
    drag = vehicle.get("drag_N_s_m")
    return bool(vehicle.get("rotor_rise_s")) or (isinstance(drag, list) and any(drag))


def _without(lagged: dict[str, Any], given: dict[str, Any], form: str | None) -> dict[str, Any]:
    """`lagged` without what a file that extends the task gives itself; of a reward of the task's `form`, weight by
    weight.
    """
    left = {key: value for key, value in lagged.items() if key not in given or key == "reward"}
    if isinstance(reward := given.get("reward"), dict) and "reward" in left:
        own = {key: value for key, value in left.pop("reward").items() if key not in reward}
        if reward.get("form") in (None, form):
            left["reward"] = own
    return left


def _described(reward: Any) -> dict[str, str]:
    """The description of a circle of another size, speed or sense, which is that of the shipped one else."""
    radius_m, speed_m_s = (reward.get(key) if isinstance(reward, dict) else None for key in ("radius_m", "speed_m_s"))
    if not (_positive(radius_m) and isinstance(speed_m_s, int | float)):
        return {}  # what is wrong with them is said later
    sense = "counter-clockwise" if speed_m_s > 0.0 else "clockwise"
    return {"description": f"fly a {radius_m:g} m circle at {abs(speed_m_s):g} m/s, {sense}, from any attitude"}


def extended(data: dict[str, Any], where: str) -> dict[str, Any]:
    """`data` merged over the shipped task that its key `extend` names, if any."""
    if "extend" not in data:
        return data
    base = data["extend"]
    if base not in shipped():
        raise BadInput(f"{where}: key 'extend': no shipped task '{base}'{specfile.nearest(str(base), shipped())}")
    shipped_base = _shipped(base)
    given = {key: value for key, value in data.items() if key != "extend"}
    if not isinstance(given.get(LAGGED, {}), dict):
        raise BadInput(f"{where}: key '{LAGGED}': expected an object")
    form = shipped_base["reward"].get("form") if "reward" in shipped_base else None
    lagged = specfile.merge(_without(shipped_base.get(LAGGED, {}), given, form), given.get(LAGGED, {}))
    merged = specfile.merge(shipped_base, given) | {LAGGED: lagged}
    return merged | _described(merged.get("reward")) if base == "circle" and "description" not in given else merged

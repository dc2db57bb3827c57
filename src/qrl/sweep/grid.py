"""From a grid file to its points, each a run that can start; BadInput if one cannot."""

import itertools
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from qrl import tasks
from qrl.config import Config, current_names
from qrl.runs.record import TaskRecord
from qrl.sweep.axes import Axis, check_names, parse_axis, put, settable
from qrl_envs import specfile
from qrl_envs import task as task_spec
from qrl_envs.specfile import BadInput, Count, CountOrZero, Spec
from qrl_envs.uncertainty import Uncertainty

POINT_BYTES = 20_000  # of host memory for each point: read (6 kB measured), its arrays, its record in grid.json
REPORT_BYTES = 3_000  # and for each report of a member: a row of some twenty numbers, once more as text


class Sample(Spec):
    count: Count
    seed: CountOrZero = 0


def _seeds(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**20 and value % 1 == 0:
        return tuple(range(int(value)))
    return tuple(value) if isinstance(value, list) else value


class GridFile(Spec):
    """Content of a grid file. `seeds`: their number, counted from 0, or a list."""

    task: str
    fixed: dict[str, Any] = Field(default_factory=dict)
    axes: dict[str, Any] = Field(min_length=1)
    sample: Sample | None = None
    seeds: Annotated[tuple[CountOrZero, ...], BeforeValidator(_seeds), Field(min_length=1)] = (0,)


@dataclass(frozen=True)
class GridPoint:
    """One point: its coordinates on the axes, its task and its hyperparameters."""

    coordinates: dict[str, Any]  # axis -> value, or the name of an axis's settings
    task: TaskRecord
    learner: Config

    @property
    def static(self) -> str:
        """The same for points that share a compiled program."""
        spec = self.task.spec or {}
        fixed = {key: value for key, value in spec.items() if key not in (*task_spec.TRACED, "description", "preset")}
        form = spec.get("reward", {}).get("form")
        layout = None
        if (uncertainty := spec.get("uncertainty")) is not None:
            layout = specfile.build(Uncertainty, uncertainty, "uncertainty").layout(spec["control_period_s"])
        return json.dumps([self.task.name, fixed, form, layout, self.learner.static], sort_keys=True)

    @property
    def evaluation_key(self) -> dict[str, Any]:
        """All that determines how a report evaluates this point; equal for all points of a grid."""
        flights = {"number of flights (num_eval_envs)": self.learner.num_eval_envs}
        spec = self.task.spec
        if spec is None:
            return flights | {"length of a flight (episode_length)": self.learner.episode_length}
        plan = spec["evaluation"]
        return flights | {
            "control period of its flights": spec["control_period_s"],
            "duration of its return": plan.get("return_s", spec["episode_s"]),
            "start of its flights": plan.get("start", spec["start"]),
            "reward of its return": plan.get("reward", spec["reward"]),
            "evaluation": plan,
        }


@dataclass(frozen=True)
class Grid:
    """A sweep: every point is trained with every seed."""

    file: GridFile
    points: list[GridPoint]

    @property
    def seeds(self) -> tuple[int, ...]:
        return self.file.seeds

    @property
    def record(self) -> dict[str, Any]:
        """All that determines the results, for grid.json."""
        points = [
            {"at": p.coordinates, "task": p.task.model_dump(mode="json"), "learner": p.learner.model_dump(mode="json")}
            for p in self.points
        ]
        return {"format": 1, "grid": self.file.model_dump(mode="json"), "points": points}

    def groups(self) -> list[list[int]]:
        groups: dict[str, list[int]] = {}
        for i, point in enumerate(self.points):
            groups.setdefault(point.static, []).append(i)
        return list(groups.values())


def load(path: Path, budget_bytes: float) -> Grid:
    """The grid in the file at `path`; refused where its points alone do not fit into the memory budget."""
    where = str(path)
    file = _with_current_names(specfile.build(GridFile, specfile.read(path), where), where)
    if len(set(file.seeds)) < len(file.seeds):
        raise BadInput(f"{path}: key 'seeds': expected each seed once, found {list(file.seeds)}")
    task = tasks.task_named(file.task, path)
    known = settable(task)
    axes = [parse_axis(name, value, known, where, sampled=file.sample is not None) for name, value in file.axes.items()]
    check_names(file.fixed, axes, known, where)
    _check_size(file, axes, tasks.task_preset(task, where)["num_evals"], budget_bytes, where)
    points: dict[str, GridPoint] = {}
    for values in _sampled(axes, file.sample, where) if file.sample else itertools.product(*[a.values() for a in axes]):
        point = _point(task, file.fixed, axes, values, where)
        key = _in_single([point.task.spec, point.learner.model_dump(mode="json")])
        if key in points:
            raise BadInput(
                f"{path}: expected each point once, found {describe(point.coordinates)} and"
                f" {describe(points[key].coordinates)}, the same in single precision"
            )
        points[key] = point
        _check_comparable(next(iter(points.values())), point, where)
    return Grid(file, list(points.values()))


def _with_current_names(file: GridFile, where: str) -> GridFile:
    def current(value: Any, key: str) -> Any:
        return current_names(value, f"{where}: {key}") if isinstance(value, dict) else value

    axes = current(file.axes, "axes")
    for name, choices in axes.items():
        if isinstance(choices, dict):  # named settings, or a range, whose own keys stay
            axes[name] = {label: current(settings, f"axes.{name}.{label}") for label, settings in choices.items()}
    return file.model_copy(update={"fixed": current(file.fixed, "fixed"), "axes": axes})


def _check_size(file: GridFile, axes: list[Axis], num_evals: int, budget_bytes: float, where: str) -> None:
    """BadInput if the points and reports do not fit into the budget; before any is made."""
    count = file.sample.count if file.sample else math.prod(a.size for a in axes)
    reports = file.fixed.get("num_evals", num_evals)
    if not (isinstance(reports, int | float) and 1 <= reports < 2**31):
        reports = 1  # refused later, with its key
    need = count * (POINT_BYTES + len(file.seeds) * REPORT_BYTES * int(reports))
    if need > budget_bytes:
        raise BadInput(
            f"{where}: expected a grid that fits into {budget_bytes / 1e9:g} GB of memory, found {count:,} points"
            f" × {len(file.seeds):,} seeds, which need {need / 1e9:,.1f} GB"
        )


def _in_single(value: Any) -> str:
    """A JSON value with its numbers in single precision, as the program has them."""
    return json.dumps(json.loads(json.dumps(value), parse_float=lambda text: float(np.float32(text))), sort_keys=True)


def _check_comparable(first: GridPoint, point: GridPoint, where: str) -> None:
    """BadInput if two points are evaluated differently: their results would not be comparable."""
    for name, value in first.evaluation_key.items():
        if point.evaluation_key[name] != value:
            raise BadInput(
                f"{where}: expected points that are evaluated alike, found another {name}"
                f" at {describe(first.coordinates)} and at {describe(point.coordinates)}"
            )


def describe(coordinates: dict[str, Any]) -> str:
    return ", ".join(f"{name} {text(value)}" for name, value in coordinates.items())


def text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _sampled(axes: list[Axis], sample: Sample, where: str) -> list[list[Any]]:
    """Values of points drawn at random, each different from those before it."""
    rng = np.random.default_rng(sample.seed)
    drawn: dict[str, list[Any]] = {}
    idle = 0  # draws since the last that was new; where one of n + 1 points is left, n draws in a row on average
    while idle < 20 * len(drawn) + 1000:
        values = [axis.draw(rng) for axis in axes]
        idle = 0 if drawn.setdefault(json.dumps(values), values) is values else idle + 1
        if len(drawn) == sample.count:
            return list(drawn.values())
    raise BadInput(
        f"{where}: key 'sample.count': expected no more points than the axes hold, found {sample.count:,};"
        f" {len(drawn):,} different ones were drawn"
    )


def _point(task: TaskRecord, fixed: dict[str, Any], axes: list[Axis], values: Iterable[Any], where: str) -> GridPoint:
    coordinates, settings = {}, dict(fixed)
    for axis, value in zip(axes, values, strict=True):
        coordinates[axis.name] = value
        settings |= axis.settings(value)
    where = f"{where}: at {describe(coordinates)}"
    spec: Any = task.spec
    learner = tasks.task_preset(task, where)
    for name, value in settings.items():
        if name.startswith("task."):
            spec = put(spec, name.split(".")[1:], value)
        elif name.endswith("_layer_sizes") and not isinstance(value, list):
            raise BadInput(f"{where}: key '{name}': expected a list of layer sizes such as [64], found {value}")
        else:
            learner[name] = value
    if spec is not task.spec:
        checked = task_spec.from_data(spec, f"{where}: task").model_dump(mode="json", exclude_none=True)
        task = TaskRecord(name=task.name, spec=checked)
    return GridPoint(coordinates, task, specfile.build(Config, learner, where))

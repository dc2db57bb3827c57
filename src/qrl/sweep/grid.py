"""From a grid file to its points, each a run that can start; BadInput if one cannot."""

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from qrl import tasks
from qrl.config import Config, current_names
from qrl.runs.record import TaskRecord
from qrl.sweep.axes import Axis, Range, axis, check_conflicts, put, settable
from qrl_envs import specfile
from qrl_envs import task as task_spec
from qrl_envs.specfile import BadInput, Count, CountOrZero, Spec

POINT_BYTES = 20_000  # of host memory for each point: read (6 kB measured), its arrays, its record in grid.json
REPORT_BYTES = 3_000  # and for each report of a member: a row of some twenty numbers, once more as text


class Sample(Spec):
    """Random points, in place of the full grid."""

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
        return json.dumps([self.task.name, fixed, form, self.learner.static], sort_keys=True)

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
            "number of steps of its return": plan.get("return_steps", spec["episode_steps"]),
            "start of its flights": plan.get("start", spec["start"]),
            "reward of its return": plan.get("reward", spec["reward"]),
            "evaluation": plan,
        }


@dataclass(frozen=True)
class Grid:
    """A whole sweep: every point is trained with every seed."""

    file: GridFile
    axes: dict[str, Axis | Range]
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
        """Indices of the points of each compiled program."""
        groups: dict[str, list[int]] = {}
        for i, point in enumerate(self.points):
            groups.setdefault(point.static, []).append(i)
        return list(groups.values())


def load(path: Path, budget_bytes: float) -> Grid:
    """The grid in the file at `path`; refused where its points alone do not fit into the memory budget."""
    file = specfile.build(GridFile, _with_current_names(specfile.read(path), str(path)), str(path))
    if len(set(file.seeds)) < len(file.seeds):
        raise BadInput(f"{path}: key 'seeds': expected each seed once, found {list(file.seeds)}")
    task = tasks.task_named(file.task, path)
    known = settable(task)
    axes = {
        name: axis(name, value, known, str(path), sampled=file.sample is not None) for name, value in file.axes.items()
    }
    check_conflicts(file.fixed, axes, known, str(path))
    count = file.sample.count if file.sample else math.prod(a.size for a in axes.values())
    reports = file.fixed.get("num_evals", tasks.task_preset(task, str(path))["num_evals"])
    kept = (
        len(file.seeds)
        * REPORT_BYTES
        * (int(reports) if isinstance(reports, int | float) and 1 <= reports < 2**31 else 1)
    )
    need = count * (POINT_BYTES + kept)
    if need > budget_bytes:
        raise BadInput(
            f"{path}: expected a grid that fits into {budget_bytes / 1e9:g} GB of memory, found {count:,} points"
            f" × {len(file.seeds):,} seeds, which need {need / 1e9:,.1f} GB"
        )
    all_coordinates = _sampled(axes, file.sample, str(path)) if file.sample else _product(axes)
    points: dict[str, GridPoint] = {}
    for coordinates in all_coordinates:
        point = _point(task, file.fixed, axes, coordinates, str(path))
        key = _in_single([point.task.spec, point.learner.model_dump(mode="json")])
        if key in points:
            raise BadInput(
                f"{path}: expected each point once, found {describe(coordinates)} and"
                f" {describe(points[key].coordinates)}, the same in single precision"
            )
        points[key] = point
        _check_comparable(next(iter(points.values())), point, str(path))
    return Grid(file, axes, list(points.values()))


def _with_current_names(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The content of a grid file with hyperparameters under their current names."""

    def renamed(value: Any, key: str) -> Any:
        return current_names(value, f"{where}: {key}") if isinstance(value, dict) else value

    data = {key: renamed(value, key) if key in ("fixed", "axes") else value for key, value in data.items()}
    if isinstance(axes := data.get("axes"), dict):
        for name, settings in axes.items():
            if isinstance(settings, dict):  # a range keeps its own keys: none of them is a former name
                axes[name] = {key: renamed(value, f"axes.{name}.{key}") for key, value in settings.items()}
    return data


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
    """The coordinates as one line."""
    return ", ".join(
        f"{name} {value if isinstance(value, str) else json.dumps(value)}" for name, value in coordinates.items()
    )


def _product(axes: dict[str, Any]) -> list[dict[str, Any]]:
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*[a.values for a in axes.values()])]


def _sampled(axes: dict[str, Axis | Range], sample: Sample, where: str) -> list[dict[str, Any]]:
    """Points drawn at random, each different from those before it."""
    rng = np.random.default_rng(sample.seed)
    all_coordinates: dict[str, dict[str, Any]] = {}
    idle = 0  # draws since the last that was new; where one of n + 1 points is left, n draws in a row on average
    while idle < 20 * len(all_coordinates) + 1000:
        coordinates = {name: axis.draw(rng) for name, axis in axes.items()}
        idle = 0 if all_coordinates.setdefault(json.dumps(coordinates), coordinates) is coordinates else idle + 1
        if len(all_coordinates) == sample.count:
            return list(all_coordinates.values())
    raise BadInput(
        f"{where}: key 'sample.count': expected no more points than the axes hold, found {sample.count:,};"
        f" {len(all_coordinates):,} different ones were drawn"
    )


def _point(
    task: TaskRecord, fixed: dict[str, Any], axes: dict[str, Axis | Range], coordinates: dict[str, Any], where: str
) -> GridPoint:
    settings = dict(fixed)
    for name, value in coordinates.items():
        settings |= axes[name].settings(name, value)
    learner = {name: value for name, value in settings.items() if not name.startswith("task.")}
    where = f"{where}: at {describe(coordinates)}"
    spec: Any = task.spec
    for name, value in settings.items():
        if name.startswith("task."):
            spec = put(spec, name.split(".")[1:], value)
    if spec is not task.spec:
        checked = task_spec.from_data(spec, f"{where}: task").model_dump(mode="json", exclude_none=True)
        task = TaskRecord(name=task.name, spec=checked)
    return GridPoint(coordinates, task, specfile.build(Config, tasks.task_preset(task, where) | learner, where))

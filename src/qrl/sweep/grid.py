"""From a grid file to its points, each a run that can start; BadInput if one cannot."""

import importlib.util
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from qrl import tasks
from qrl.config import Config, current_names
from qrl.runs.record import TaskRecord
from qrl.sweep.axes import PARTS, Axis, Range, check_names, parse_axis, put, settable
from qrl_envs import specfile
from qrl_envs import task as task_spec
from qrl_envs.specfile import BadInput, Count, CountOrZero, Spec
from qrl_envs.uncertainty import Uncertainty

POINT_BYTES = 20_000  # of host memory for each point: read (6 kB measured), its arrays, its record in grid.json
REPORT_BYTES = 3_000  # and for each report of a member: a row of some twenty numbers, once more as text


class Sample(Spec):
    count: Count
    seed: CountOrZero = 0


class Search(Spec):
    """Points proposed one batch after the other, each from the results of those before it."""

    trials: Count
    batch: Count = 8  # points proposed together, and trained side by side
    seed: CountOrZero = 0
    maximize: Literal["return_mean", "success"] = "return_mean"
    prune: bool = True  # stop a trial that falls behind


def _seeds(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**20 and value % 1 == 0:
        return tuple(range(int(value)))
    return tuple(value) if isinstance(value, list) else value


class GridFile(Spec):
    """Content of a grid file. `seeds`: their number, counted from 0, or a list."""

    task: str = ""  # or else an axis, or a fixed setting
    fixed: dict[str, Any] = Field(default_factory=dict)
    axes: dict[str, Any] = Field(min_length=1)
    sample: Sample | None = None
    search: Search | None = Field(default=None, exclude_if=lambda x: x is None)  # older sweeps' records have none
    seeds: Annotated[tuple[CountOrZero, ...], BeforeValidator(_seeds), Field(min_length=1)] = (0,)


@dataclass(frozen=True)
class GridPoint:
    """One point: its coordinates on the axes, its task and its hyperparameters."""

    coordinates: dict[str, Any]  # axis -> value, or the name of an axis's settings
    task: TaskRecord
    learner: Config
    asked: str = ""  # the task as the grid names it; points of one are compared

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
class Space:
    """What a grid file spans: its axes, and the task of each combination of task, vehicle and other parts."""

    file: GridFile
    axes: list[Axis]
    records: dict[tuple[str | None, ...], TaskRecord]
    where: str

    def point(self, values: Iterable[Any]) -> GridPoint:
        """The point at these values, one of each axis."""
        coordinates, settings = {}, dict(self.file.fixed)
        for axis, value in zip(self.axes, values, strict=True):
            coordinates[axis.name] = value
            settings |= axis.settings(value)
        where = f"{self.where}: at {describe(coordinates)}"
        parts = _parts(self.file, settings)
        task = self.records[parts]
        spec: Any = task.spec
        learner = tasks.task_preset(task, where)
        for name, value in settings.items():
            if name in PARTS:
                continue
            if name.startswith("task."):
                if len(self.records) > 1 and name not in settable(task):
                    raise BadInput(f"{where}: key '{name}': task '{task.name}' has none")
                spec = put(spec, name.split(".")[1:], value)
            elif name.endswith("_layer_sizes") and not isinstance(value, list):
                raise BadInput(f"{where}: key '{name}': expected a list of layer sizes such as [64], found {value}")
            else:
                learner[name] = value
        if spec is not task.spec:
            checked = task_spec.from_data(spec, f"{where}: task").model_dump(mode="json", exclude_none=True)
            task = TaskRecord(name=task.name, spec=checked)
        return GridPoint(coordinates, task, specfile.build(Config, learner, where), parts[0] or "")

    def probes(self) -> list[list[Any]]:
        """Each value of a list, and the ends and an odd place of each range, with the first values of other axes."""
        values = [
            [a.choices.at(x) for x in (0, 0.382, 1)] if isinstance(a.choices, Range) else a.values() for a in self.axes
        ]
        first = [each[0] for each in values]
        others = [[*first[:i], value, *first[i + 1 :]] for i, each in enumerate(values) for value in each[1:]]
        return [first, *others]


@dataclass(frozen=True)
class Grid:
    """A sweep: every point is trained with every seed."""

    file: GridFile
    points: list[GridPoint]  # of a search: some that stand for all
    space: Space | None = None

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
        optuna = {"optuna": metadata.version("optuna")} if self.file.search else {}
        return {"format": 1, "grid": self.file.model_dump(mode="json"), "points": points, **optuna}

    def pruned(self, point: int, results: Sequence[Any]) -> bool:
        """Whether a point's training was ended before its last step; `results`: of its seeds, with `rows`."""
        learner = self.points[point].learner
        steps = learner.num_unrolls * learner.steps_per_unroll
        return any(row["env_steps"] < steps for result in results for row in result.rows[-1:])

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
    if file.sample and file.search:
        raise BadInput(f"{path}: expected 'sample' or 'search', found both")
    drawn = bool(file.sample or file.search)
    axes = [parse_axis(name, value, where, sampled=drawn) for name, value in file.axes.items()]
    records = _records(file, axes, path)
    known = list(dict.fromkeys(name for record in records.values() for name in settable(record)))
    check_names(file.task, file.fixed, axes, known, where)
    reports = max(tasks.task_preset(record, where)["num_evals"] for record in records.values())
    _check_size(file, axes, reports, budget_bytes, where)
    space = Space(file, axes, records, where)
    if file.search:
        _check_search(file.search, space)
        values: Iterable[Any] = space.probes()
    else:
        values = _sampled(axes, file.sample, where) if file.sample else itertools.product(*[a.values() for a in axes])
    points: dict[str, GridPoint] = {}
    compared: dict[str, GridPoint] = {}
    for each in values:
        point = space.point(each)
        key = _in_single([point.asked, point.task.model_dump(), point.learner.model_dump(mode="json")])
        if key in points:
            raise BadInput(
                f"{path}: expected each point once, found {describe(point.coordinates)} and"
                f" {describe(points[key].coordinates)}, the same in single precision"
            )
        points[key] = point
        _check_comparable(compared.setdefault(point.asked, point), point, where)
    return Grid(file, list(points.values()), space)


def _records(file: GridFile, axes: list[Axis], path: Path) -> dict[tuple[str | None, ...], TaskRecord]:
    """The task of each combination of parts that the grid names."""
    choosing = [axis for axis in axes if {*PARTS} & {*axis.names()}]
    records: dict[tuple[str | None, ...], TaskRecord] = {}
    for values in itertools.product(*[axis.values() for axis in choosing]):
        settings = dict(file.fixed)
        at = {axis.name: value for axis, value in zip(choosing, values, strict=True)}
        for axis, value in zip(choosing, values, strict=True):
            settings |= axis.settings(value)
        where = f"{path}: at {describe(at)}" if at else f"{path}: key 'task'"
        parts = _parts(file, settings)
        if wrong := [part for part in parts if not isinstance(part, str | None)]:
            raise BadInput(f"{where}: expected a name or a file, found {json.dumps(wrong[0])[:57]}")
        if not parts[0]:
            raise BadInput(f"{path}: key 'task' is missing")
        if parts not in records:
            try:
                records[parts] = tasks.task_record(parts[0], dict(zip(PARTS[1:], parts[1:], strict=True)))
            except BadInput as error:
                raise BadInput(f"{where}: {error}") from None
    return records


def _parts(file: GridFile, settings: dict[str, Any]) -> tuple[Any, ...]:
    """Task, vehicle, uncertainty and reference; None: the task's own."""
    return (settings.get("task", file.task), *(settings.get(name) for name in PARTS[1:]))


def _check_search(search: Search, space: Space) -> None:
    """BadInput if a search cannot be what it says."""
    if not importlib.util.find_spec("optuna"):
        raise BadInput(f"{space.where}: key 'search': needs Optuna: pip install 'qrl[search]'")
    if len({parts[0] for parts in space.records}) > 1:
        raise BadInput(f"{space.where}: expected one task for a search, whose trials are compared")
    if not any(isinstance(axis.choices, Range) for axis in space.axes):
        most = math.prod(axis.size for axis in space.axes)
        if search.trials > most:
            raise BadInput(
                f"{space.where}: key 'search.trials': expected no more trials than the axes hold points,"
                f" found {search.trials:,}; they hold {most:,}"
            )


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
    count = math.prod(a.size for a in axes)
    if file.sample:
        count = file.sample.count
    elif file.search:
        count = max(file.search.trials, sum(a.size for a in axes))
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

"""Axes of a grid: their names, their values, and the settings of a run that they change."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from qrl.algorithm.learner import UpdateMetrics
from qrl.config import Config
from qrl.runs.record import TaskRecord
from qrl_envs import specfile
from qrl_envs.specfile import BadInput, Count, Real, Spec
from qrl_envs.uncertainty import Uncertainty

DIGITS = 6  # significant digits of the values of a range
# Columns of results.csv, and prefixes of others: no axis may have such a name.
COLUMNS = (
    *("point", "seed", "seeds", "diverged", "pruned", "env_steps", "updates", "return_mean", "return_min", "success"),
    *("train_seconds", "steps_per_second", "reward_mean", "ended_early", "apg_skipped", *UpdateMetrics._fields),
)
MEASURES = ("settle_", "rms_")
PARTS = ("task", "vehicle", "uncertainty", "reference")  # settings that are whole tasks, or whole parts of one, by name
EVALUATION = "task.evaluation"  # the same for all points, else they could not be compared


class Range(Spec):
    """Numbers from an interval: `count` of them, evenly spaced (linear or logarithmic), or drawn at random."""

    from_: Real = Field(alias="from")
    to: Real
    count: Count | None = None
    spacing: Literal["lin", "log"] = "lin"

    @model_validator(mode="after")
    def _check(self) -> "Range":
        if not self.from_ < self.to:
            raise ValueError(f"expected from < to, found {self.from_} and {self.to}")
        if self.spacing == "log" and self.from_ <= 0:
            raise ValueError(f"expected from > 0 with log spacing, found {self.from_}")
        return self

    def at(self, share: float) -> float:
        """The number a fraction `share` of the way from `from` to `to`."""
        if self.spacing == "log":
            value = math.exp(math.log(self.from_) + share * (math.log(self.to) - math.log(self.from_)))
        else:
            value = self.from_ + share * (self.to - self.from_)
        return float(f"{value:.{DIGITS}g}")


@dataclass(frozen=True)
class Axis:
    """Values of one setting, or named settings of several."""

    name: str
    choices: list[Any] | Range | dict[str, dict[str, Any]]

    def settings(self, value: Any) -> dict[str, Any]:
        return self.choices[value] if isinstance(self.choices, dict) else {self.name: value}

    def names(self) -> list[str]:
        if isinstance(self.choices, dict):
            return list(dict.fromkeys(key for settings in self.choices.values() for key in settings))
        return [self.name]

    @property
    def size(self) -> int:
        return (self.choices.count or 1) if isinstance(self.choices, Range) else len(self.choices)

    def values(self) -> list[Any]:
        if isinstance(self.choices, Range):
            return [self.choices.at(i / (self.size - 1)) for i in range(self.size)]
        return list(self.choices)

    def draw(self, rng: np.random.Generator) -> Any:
        if isinstance(self.choices, Range):
            return self.choices.at(rng.random())
        return list(self.choices)[rng.integers(self.size)]


def settable(task: TaskRecord) -> list[str]:
    """Settings that a grid may name: hyperparameters, parts of the task, and paths into its record."""
    spec = task.spec or {}
    paths = [path for path in _paths(spec, "task") if path != "task.description"]
    if "uncertainty" in spec:  # its record leaves out the ranges that came later and say nothing
        added = (f"task.uncertainty.{name}" for name in Uncertainty.model_fields)
        paths = list(dict.fromkeys((*paths, *added)))
    return [*Config.model_fields, *PARTS, *(path for path in paths if not path.startswith(EVALUATION))]


def _paths(value: Any, path: str) -> Iterable[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _paths(inner, f"{path}.{key}")
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for index in ("*", *range(len(value))):
            yield from _paths(value[0], f"{path}.{index}")
    else:
        yield path


def put(spec: Any, path: list[str], value: Any) -> Any:
    """A copy of the JSON value `spec` with `value` at `path`; "*" is every element of a list."""
    if not path:
        return value
    first, *rest = path
    if isinstance(spec, list):
        return [put(inner, rest, value) if first in ("*", str(i)) else inner for i, inner in enumerate(spec)]
    return {**spec, first: put(spec.get(first), rest, value)}


def parse_axis(name: str, value: Any, where: str, *, sampled: bool) -> Axis:
    """One axis as the grid file writes it: a list, a range, or an object of named settings."""
    key = f"{where}: key 'axes.{name}'"
    if value in ([], {}):
        raise BadInput(f"{key}: expected at least one value, found none")
    if isinstance(value, list):
        return Axis(name, value)
    if not isinstance(value, dict):
        raise BadInput(f"{key}: expected a list of values, a range or named settings, found {json.dumps(value)[:57]}")
    if all(isinstance(inner, dict) for inner in value.values()):
        if not name or "" in value:
            raise BadInput(f'{key}: expected a name for {"each of its settings" if name else "the axis"}, found ""')
        if name in (*Config.model_fields, *PARTS, *COLUMNS) or name.startswith((*MEASURES, "task.")):
            raise BadInput(f"{key}: expected another name than that of a setting or a column of results.csv")
        return Axis(name, value)
    span = specfile.build(Range, value, f"{where}: axes.{name}")
    if (span.count is None) != sampled:
        expected = "no count where points are sampled" if sampled else "a count, or else 'sample' or 'search'"
        raise BadInput(f"{key}: expected {expected}, found {json.dumps(value)}")
    if name in PARTS:
        raise BadInput(f"{key}: expected a list of names or files, found {json.dumps(value)}")
    if span.count == 1:
        raise BadInput(f"{key}: expected a range of at least 2 values, found count 1")
    return Axis(name, span)


def check_names(task: str, fixed: dict[str, Any], axes: list[Axis], known: list[str], where: str) -> None:
    """BadInput if a setting is unknown, or set twice; `task` is the grid's own, "" for none."""
    setters: dict[str, str] = {"task": "task"} if task else {}
    for setter, names in [("fixed", list(fixed)), *((f"axes.{axis.name}", axis.names()) for axis in axes)]:
        for name in names:
            if name.startswith(EVALUATION):
                raise BadInput(f"{where}: key '{name}': all points of a grid have the same evaluation")
            if name not in known:
                raise BadInput(f"{where}: {setter}: unknown key '{name}'{specfile.nearest(name, known)}")
            if name in setters:
                raise BadInput(f"{where}: key '{setter}': '{name}' is set in '{setters[name]}' too")
            setters[name] = setter

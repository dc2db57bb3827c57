"""Adaptive search by Optuna: a tree-structured Parzen estimator proposes, a median rule ends trials early.

Trials are proposed in batches, each from the results of the batches before it, and a running trial is compared with
those alone. So all follows from the grid file: a search that was interrupted is gone through again from its recorded
results, and where and in which order trials ended does not matter.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qrl.runs.files import Row
from qrl.sweep.axes import Axis, Range
from qrl.sweep.grid import Search

Curve = dict[int, float]  # environment steps -> score of a report


def score(rows: Sequence[Row], diverged: Sequence[str], name: str) -> float:
    """The median over a trial's seeds of one report's number; a seed that diverged or has none counts as −infinity."""
    values = [
        row[name] if math.isfinite(row[name]) and not bad else -math.inf
        for row, bad in zip(rows, diverged, strict=True)
    ]
    return float(np.median(values))


@dataclass(frozen=True)
class Pruning:
    """What decides whether a trial goes on: the curves of the trials that are compared with it."""

    name: str
    curves: list[Curve]

    def rule(self) -> Callable[[Sequence[Row], Sequence[str]], bool]:
        """Optuna's median rule for one trial: given a report of each seed, and what diverged, whether it ends here."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(direction="maximize", pruner=optuna.pruners.MedianPruner())
        study.add_trials(
            [
                optuna.trial.create_trial(value=list(curve.values())[-1], intermediate_values=curve)
                for curve in self.curves
            ]
        )
        trial = study.ask()

        def ends(rows: Sequence[Row], diverged: Sequence[str]) -> bool:
            trial.report(score(rows, diverged, self.name), int(rows[0]["env_steps"]))
            return trial.should_prune()

        return ends


class Proposals:
    """The trials of a search, batch by batch."""

    def __init__(self, search: Search, axes: list[Axis]) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._optuna = optuna
        self._search, self._axes = search, axes
        sampler = optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)
        self._study = optuna.create_study(direction="maximize", sampler=sampler)
        self._asked: list[Any] = []
        self._curves: list[Curve] = []  # of the trials that were told of and not pruned

    def ask(self) -> list[list[Any]]:
        """Values of the next batch's trials, one of each axis; none where the search is over."""
        self._asked = [
            self._study.ask()
            for _ in range(min(self._search.batch, self._search.trials - len(self._study.get_trials(deepcopy=False))))
        ]
        return [[_value(trial, axis) for axis in self._axes] for trial in self._asked]

    def pruning(self) -> Pruning | None:
        """For the trials of this batch."""
        return Pruning(self._search.maximize, self._curves) if self._search.prune else None

    def tell(self, results: Sequence[Sequence[tuple[list[Row], str]]], pruned: Sequence[bool]) -> None:
        """Results of this batch: of each trial each seed's reports, and what diverged; and whether it was pruned.

        One without reports could not be trained: it failed.
        """
        curves = [self._curve(seeds) for seeds in results]
        for trial, curve, early in zip(self._asked, curves, pruned, strict=True):
            for step, value in curve.items():
                trial.report(value, step)
            if early or not curve:
                states = self._optuna.trial.TrialState
                self._study.tell(trial, state=states.PRUNED if curve else states.FAIL)
            else:
                self._study.tell(trial, list(curve.values())[-1])
        whole = [curve for curve, early in zip(curves, pruned, strict=True) if curve and not early]
        self._curves = self._curves + whole

    def _curve(self, seeds: Sequence[tuple[list[Row], str]]) -> Curve:
        reports = zip(*(rows for rows, _ in seeds), strict=True)
        diverged = [text for _, text in seeds]
        last = len(seeds[0][0]) - 1
        return {
            int(rows[0]["env_steps"]): score(rows, diverged if i == last else [""] * len(seeds), self._search.maximize)
            for i, rows in enumerate(reports)
        }


def _value(trial: Any, axis: Axis) -> Any:
    if isinstance(axis.choices, Range):
        return axis.choices.at(trial.suggest_float(axis.name, 0.0, 1.0))  # evenly over the interval, or its logarithm
    return axis.values()[trial.suggest_categorical(axis.name, list(range(axis.size)))]

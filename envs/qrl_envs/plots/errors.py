"""The errors of all flights over time, and how many of them have settled."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qrl_envs import measures
from qrl_envs.measures import Measured
from qrl_envs.plots.frame import COLORS, ERRORS, Panel, empty, finish, legend, logarithmic, over_time, save, successes
from qrl_envs.task import Task

LINES: tuple[dict[str, Any], ...] = (  # distinguishable without color
    {"color": COLORS[1], "linestyle": "-"},
    {"color": COLORS[2], "linestyle": (0, (5, 1.5))},
    {"color": COLORS[3], "linestyle": (0, (1, 1))},
    {"color": "black", "linestyle": (0, (5, 1.5, 1, 1.5))},
)
Others = Mapping[str, np.ndarray]  # name -> observations [n, K + 1, F] of another policy from the same starts


def draw(path: Path, task: Task, observations: np.ndarray, others: Others = MappingProxyType({})) -> None:
    save(path, figure(task, observations, others))


def figure(task: Task, observations: np.ndarray, others: Others = MappingProxyType({})) -> Figure:
    """Errors and settled share over time of flights with `observations` [n, K + 1, F], in SI units.

    Axes: the spread of each error, and last the share that has settled; with the medians of the first few `others`.
    """
    found = measures.of_flights(task, observations)
    shown = list(others)[: len(LINES)]
    compared = {
        label: measures.of_flights(task, others[name]) for name, label in zip(shown, _labels(shown), strict=True)
    }
    names = [name for name in ERRORS if name in found.errors]
    rows = len(names) // 2 + 1
    figure = empty(task, height_in=2.0 + 2.0 * rows)
    grid = list(figure.subplots(rows, 2, sharex=True).flat)
    for axes, name in zip(grid, names, strict=False):
        label, unit, tolerance = ERRORS[name]
        label = label.replace("target", "reference") if getattr(task.evaluation, "reference", None) else label
        panel = logarithmic(label, unit, _ranks(found.errors[name]), getattr(task.evaluation, tolerance))
        times = over_time(axes, task, panel)
        low, median, high = panel.values
        axes.fill_between(times, low, high, color=COLORS[0], alpha=0.3, linewidth=0, label="5 % to 95 % of flights")
        axes.plot(times, median, color=COLORS[0], linewidth=2, label="median flight")
        for (other, there), looks in zip(compared.items(), LINES, strict=False):
            line = np.clip(_ranks(there.errors[name])[1], *panel.limits)
            axes.plot(times, line, linewidth=1.1, label=f"median of {other}", **looks)
    _settled(grid[len(names)], task, found, compared, observations.shape[1])
    for axes, title in zip(grid, (f"all {len(observations):,} flights", successes(found)), strict=False):
        finish(axes, title)
    for axes in grid[2:]:
        finish(axes)
    legend(figure)
    return figure


def _labels(names: Sequence[str]) -> list[str]:
    """Of paths the last parts, as few as tell them apart."""

    def end(name: str, count: int) -> str:
        return "/".join(name.split("/")[-count:])

    return [
        next((end(name, n) for n in range(1, 20) if sum(end(other, n) == end(name, n) for other in names) == 1), name)
        for name in names
    ]


def _ranks(errors: np.ndarray) -> np.ndarray:
    """The 5 %, 50 % and 95 % quantiles of |errors| [n, K + 1] over time: [3, K + 1]. Non-finite numbers count as ∞."""
    ranked = np.sort(np.where(np.isfinite(errors), np.abs(errors), np.inf), axis=0)
    return ranked[[round(share * (len(errors) - 1)) for share in (0.05, 0.5, 0.95)]]


def _settled(axes: Axes, task: Task, found: Measured, compared: dict[str, Measured], samples: int) -> None:
    times = np.arange(samples) * task.control_period_s

    def share(settle_s: np.ndarray) -> np.ndarray:
        return 100.0 * np.mean(settle_s[:, None] <= times + 0.5 * task.control_period_s, axis=0)

    over_time(axes, task, Panel("flights settled", "%", share(found.settle_s)[None], (0.0, 103.0)))
    axes.plot(times, share(found.settle_s), color=COLORS[0], linewidth=2)
    for (other, there), looks in zip(compared.items(), LINES, strict=False):
        axes.plot(times, share(there.settle_s), linewidth=1.1, label=f"median of {other}", **looks)

"""One quantity over time: its axis, its tolerance and the tail that success is evaluated on."""

from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MultipleLocator, NullFormatter

from qrl_envs.plots.frame import GOOD, INK, SHADE, in_pi
from qrl_envs.task import Task

MIN, MAX = 0.01, 200.0  # limits of a logarithmic axis, in tolerances


class Panel(NamedTuple):
    """One quantity over time, and its target."""

    label: str
    unit: str
    values: np.ndarray  # [lines, K + 1]
    limits: tuple[float, float]
    target: float = 0.0
    tolerance: float | None = None  # ± about `target`; on a logarithmic axis an upper bound
    scale: Literal["linear", "log", "angle"] = "linear"


def logarithmic(label: str, unit: str, values: np.ndarray, tolerance: float) -> Panel:
    """A panel of values ≥ 0, clipped to the axis; NaN is not drawn."""
    largest = np.max(values, initial=0.0, where=np.isfinite(values))
    limits = MIN * tolerance, 1.2 * tolerance * min(max(largest / tolerance, 10.0), MAX)
    return Panel(label, unit, np.clip(values, *limits), limits, 0.0, tolerance, "log")


def over_time(axes: Axes, task: Task, panel: Panel) -> np.ndarray:
    """Prepare `axes` for the panel's lines and return the times [s] of its samples [K + 1]."""
    times = np.arange(panel.values.shape[1]) * task.control_period_s
    tail_s, end_s = task.evaluation.tail_s, max(times[-1], task.control_period_s)
    axes.axvspan(max(end_s - tail_s, 0.0), end_s, color=SHADE, zorder=0, label=f"evaluated: the last {tail_s:g} s")
    axes.set_yscale("log" if panel.scale == "log" else "linear")
    if panel.scale == "log":
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif panel.scale == "angle":
        in_pi(axes.yaxis)
    elif panel.unit == "°":
        axes.yaxis.set_major_locator(MultipleLocator(45.0))
    if panel.tolerance is not None:
        _tolerance(axes, panel, panel.tolerance)
    axes.set(xlabel="time [s]", ylabel=f"{panel.label} [{panel.unit}]", xlim=(0.0, end_s), ylim=panel.limits)
    place = axes.get_subplotspec()
    if place is not None and not place.is_last_row():
        axes.set_xlabel("")
        axes.tick_params(labelbottom=False)
    return times


def _tolerance(axes: Axes, panel: Panel, tolerance: float) -> None:
    """The tolerance band, with dashed edges and its size as a label."""
    low, high = panel.target - tolerance, panel.target + tolerance
    if panel.scale == "log":
        low = panel.limits[0]
    axes.axhspan(low, high, color=GOOD, alpha=0.13, zorder=0.5, linewidth=0)
    for edge in (high,) if panel.scale == "log" else (low, high):
        axes.axhline(edge, color=INK, linewidth=1, linestyle=(0, (4, 3)), zorder=3, label="tolerance")
    size = f"{'' if panel.scale == 'log' else '± '}{tolerance:g} {panel.unit}"
    axes.annotate(
        size, (1, high), (-4, 3), axes.get_yaxis_transform(), "offset points", ha="right", color=INK, fontsize=10
    )

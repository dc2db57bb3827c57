"""Shared parts of the plots: an empty figure, axes style, legend, colors, and the axes of a quantity over time."""

import textwrap
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MultipleLocator, NullFormatter

from qrl_envs.measures import Measured
from qrl_envs.task import Task

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")  # Okabe and Ito: safe for color-blind readers
INK, SHADE, GOOD = "#333333", "#EEEEEE", "#009E73"
PIXELS_PER_INCH = 150
LEAST, MIN, MAX = 1e-4, 0.01, 200.0  # limits of a logarithmic axis, in tolerances; LEAST to MIN are of its lower end
ERRORS = {  # name in measures.py -> label; unit; name of its tolerance in the task's `evaluation`
    "position_m": ("distance to target", "m", "distance_m"),
    "radius_m": ("radius error", "m", "distance_m"),
    "height_m": ("height error", "m", "distance_m"),
    "speed_m_s": ("speed error", "m/s", "speed_m_s"),
    "angle_rad": ("angle error", "rad", "angle_rad"),
}


def empty(task: Task, height_in: float) -> Figure:
    figure = Figure(figsize=(10.0, height_in), dpi=PIXELS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    title = textwrap.shorten(f"{task.reward.form}: {task.description}", 90, placeholder=" …")
    figure.suptitle(title, fontsize=13, fontweight="bold", color=INK, parse_math=False)
    return figure


def save(path: Path, figure: Figure) -> None:
    """As PNG, drawn once: `savefig` draws all twice, the first time only to lay it out."""
    FigureCanvasAgg(figure).print_png(path)


def finish(axes: Axes, title: str = "") -> None:
    axes.set_title(title, fontsize=11.5, color=INK)
    axes.set_xlabel(axes.get_xlabel(), fontsize=11)
    axes.set_ylabel(axes.get_ylabel(), fontsize=11)
    axes.tick_params(labelsize=10.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def legend(figure: Figure) -> None:
    """One legend below all axes, each label once."""
    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    rows = 1 if len(handles) < 5 else 2
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=-(-len(handles) // rows),
        frameon=False,
        fontsize=10.5,
    )


def in_pi(axis: Axis) -> None:
    names = {-2: "−π", -1: "−π/2", 0: "0", 1: "π/2", 2: "π"}
    axis.set_major_locator(MultipleLocator(np.pi / 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: names.get(round(value / (np.pi / 2)), "")))


def successes(found: Measured) -> str:
    return f"{np.sum(found.success):,} of {len(found.success):,} flights succeed"


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
    """A panel of values ≥ 0 [lines, K + 1], clipped to the axis, which shows what they come to in the second half; NaN
    is not drawn.
    """
    finite = np.isfinite(values)
    largest = np.max(values, initial=0.0, where=finite)
    late = values[:, values.shape[1] // 2 :][finite[:, values.shape[1] // 2 :]]
    low = np.clip(np.median(late) / 3.0 / tolerance, LEAST, MIN) if late.size else MIN
    limits = tolerance * low, 1.2 * tolerance * min(max(largest / tolerance, 10.0), MAX)
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

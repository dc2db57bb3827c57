"""Pictures of flights as PNG: a few of them in full (`flights`), the errors of all of them (`errors`).

What is measured is what measures.py measures, and every tolerance drawn is the task's. A figure is made apart
from being saved, of matplotlib's objects alone: no pyplot, so no state is left behind.
"""

import textwrap
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MultipleLocator, NullFormatter

from qrl_envs import measures
from qrl_envs.measures import Measured
from qrl_envs.task import CircleReward, PendulumTask, QuadrotorTask, Task

SHOWN = 5  # flights drawn in full
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")  # of Okabe and Ito's, for any eye
INK, SHADE, GOOD = "#333333", "#EEEEEE", "#009E73"
LEAST, MOST = 0.01, 200.0  # what a logarithmic axis shows at most, in tolerances
PIXELS_PER_INCH = 150

ERRORS = {  # name in measures.py -> label; unit; name of its tolerance in the task's `evaluation`
    "position_m": ("distance to target", "m", "distance_m"),
    "radius_m": ("radius error", "m", "distance_m"),
    "height_m": ("height error", "m", "distance_m"),
    "speed_m_s": ("speed error", "m/s", "speed_m_s"),
    "angle_rad": ("angle error", "rad", "angle_rad"),
}


class Panel(NamedTuple):
    """One quantity over time, and what is asked of it."""

    label: str
    unit: str
    values: np.ndarray  # [lines, K + 1]
    limits: tuple[float, float]
    wanted: float = 0.0
    tolerance: float | None = None  # ± about `wanted`; on a logarithmic axis an upper bound
    scale: Literal["linear", "log", "angle"] = "linear"


def flights(path: Path, task: Task, observations: np.ndarray) -> None:
    """Draw the first few flights of `observations` [n, K + 1, F], SI units, at times 0, dt, … K·dt."""
    flights_figure(task, observations).savefig(path, format="png")


def errors(path: Path, task: Task, observations: np.ndarray) -> None:
    """Draw the errors and settle times of all of `observations` [n, K + 1, F], SI units, at times 0, dt, … K·dt."""
    errors_figure(task, observations).savefig(path, format="png")


def flights_figure(task: Task, observations: np.ndarray) -> Figure:
    """What `flights` saves. Axes: where the first few went, and two quantities over time."""
    found = measures.of_flights(task, observations)
    shown = np.where(np.isfinite(observations), observations, np.nan)[:SHOWN]
    figure = _figure(task, height_in=5.0)
    left, upper, lower = figure.subplot_mosaic("AB;AC", width_ratios=(1.0, 1.2)).values()
    if isinstance(task, PendulumTask):
        _phase_portrait(left, task, shown)
        panels = _pendulum_panels(task, shown)
    else:
        _seen_from_above(left, task, shown)
        panels = _quadrotor_panels(task, shown, found.errors)
    for axes, panel in zip((upper, lower), panels, strict=True):
        times = _over_time(axes, task, panel)
        for colour, values in zip(COLOURS, panel.values, strict=False):
            for line in _turns(values) if panel.scale == "angle" else [values]:
                axes.plot(times, line, color=colour, linewidth=1.4)
    _finish(left, f"the first {len(shown)} of {len(observations):,} flights")
    _finish(upper, _successes(found))
    _finish(lower)
    _legend(figure)
    return figure


def errors_figure(task: Task, observations: np.ndarray) -> Figure:
    """What `errors` saves. Axes: the spread of each error over time, and last the share that has settled."""
    found = measures.of_flights(task, observations)
    names = [name for name in ERRORS if name in found.errors]
    rows = len(names) // 2 + 1
    figure = _figure(task, height_in=2.0 + 2.0 * rows)
    grid = list(figure.subplots(rows, 2, sharex=True).flat)
    for axes, name in zip(grid, names, strict=False):
        label, unit, tolerance = ERRORS[name]
        panel = _logarithmic(label, unit, _ranks(found.errors[name]), getattr(task.evaluation, tolerance))
        times = _over_time(axes, task, panel)
        low, median, high = panel.values
        axes.fill_between(times, low, high, color=COLOURS[0], alpha=0.3, linewidth=0, label="5 % to 95 % of flights")
        axes.plot(times, median, color=COLOURS[0], linewidth=2, label="median flight")
    _settled(grid[len(names)], task, found.settle_s, observations.shape[1])
    for axes, title in zip(grid, (f"all {len(observations):,} flights", _successes(found)), strict=False):
        _finish(axes, title)
    for axes in grid[2:]:
        _finish(axes)
    _legend(figure)
    return figure


# Where flights went


def _seen_from_above(axes: Axes, task: QuadrotorTask, shown: np.ndarray) -> None:
    """Paths of `shown` [few, K + 1, 18] over the ground; the triangle at a start points as the vehicle's top does."""
    wanted, reach = task.evaluation.reward, 0.0
    for colour, path in zip(COLOURS, shown[:, :, 9:11], strict=False):
        axes.plot(*path.T, color=colour, linewidth=1.4)
    starts, up = shown[:, 0, 9:11], shown[:, 0, 8]  # r33: the body's z axis along the world's
    for marker, label, among in (("^", "start upright", up >= 0), ("v", "start upside down", up < 0)):
        colours = np.array(COLOURS)[: len(among)][among]
        axes.scatter(*starts[among].T, c=colours, marker=marker, s=90, edgecolors="white", zorder=4)
        if among.any():
            axes.plot([], [], marker, color=INK, markersize=8, label=label)
    if isinstance(wanted, CircleReward):
        _circle(axes, wanted)
        reach = wanted.radius_m
    else:
        axes.plot(0, 0, "+", color="black", markersize=15, markeredgewidth=2, zorder=5, label="wanted position")
    half = _half_width(shown[:, :, 9:11], reach, task.evaluation.start.position_m)
    axes.set(xlabel="x [m], seen from above", ylabel="y [m]", aspect="equal", xlim=(-half, half), ylim=(-half, half))


def _circle(axes: Axes, wanted: CircleReward) -> None:
    """The circle to fly, dashed, and which way round."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    x, y = wanted.radius_m * np.cos(angle), wanted.radius_m * np.sin(angle)
    axes.plot(x, y, "--", color="black", linewidth=1.5, zorder=5, label="wanted path")
    arrow = {"arrowstyle": "-|>", "color": "black", "mutation_scale": 22, "shrinkA": 0, "shrinkB": 0}
    for k in (22, 112):
        axes.annotate("", xy=(x[k + 3], y[k + 3]), xytext=(x[k], y[k]), arrowprops=arrow, zorder=6)
    axes.text(0, 0, f"{wanted.speed_m_s:g} m/s", ha="center", va="center", color=INK, fontsize=11)


def _half_width(paths: np.ndarray, reach_m: float, start_m: float) -> float:
    """Of a window on `paths` [n, K + 1, 2] that shows the target and the starts; what flees farther leaves it."""
    extent = np.max(np.abs(paths), initial=0.0, where=np.isfinite(paths))
    return 1.12 * max(min(extent, 2.0 * (start_m + reach_m)), reach_m, 0.1)


def _phase_portrait(axes: Axes, task: PendulumTask, shown: np.ndarray) -> None:
    """Rate over angle of `shown` [few, K + 1, 3]."""
    for colour, theta, rate in zip(COLOURS, _angle(shown), shown[:, :, 2], strict=False):
        for line in _turns(theta):
            axes.plot(line, rate, color=colour, linewidth=1.4)
        axes.plot(theta[0], rate[0], "o", color=colour, markeredgecolor="white", markersize=10, zorder=4)
    axes.plot([], [], "o", color=INK, markersize=8, label="start")
    axes.plot(0, 0, "+", color="black", markersize=15, markeredgewidth=2, zorder=5, label="upright, at rest")
    top = 1.1 * task.rod.max_rate_rad_s
    axes.set(xlabel="angle from upright [rad]", ylabel="rate [rad/s]", xlim=(-np.pi, np.pi), ylim=(-top, top))
    _in_pi(axes.xaxis)


def _angle(shown: np.ndarray) -> np.ndarray:
    """From upright, in ±π, of `shown` [n, K + 1, 3]: [n, K + 1]."""
    return np.arctan2(shown[:, :, 1], shown[:, :, 0])


def _turns(angle: np.ndarray) -> list[np.ndarray]:
    """Lines for an axis of ±π: the unwrapped `angle` [K + 1] shifted by each whole turn that brings a part into view.

    So no line jumps across the axis, and none stops short of its edge.
    """
    whole = np.unwrap(angle)
    turns = np.round(whole[np.isfinite(whole)] / (2.0 * np.pi))
    return [whole - 2.0 * np.pi * turn for turn in np.unique(turns)]


# Quantities over time


def _quadrotor_panels(task: QuadrotorTask, shown: np.ndarray, errors: dict[str, np.ndarray]) -> tuple[Panel, Panel]:
    spec, wanted = task.evaluation, task.evaluation.reward
    few = {name: np.where(np.isfinite(error), error, np.nan)[: len(shown)] for name, error in errors.items()}
    if isinstance(wanted, CircleReward) and spec.speed_m_s is not None:
        distance, speed = np.hypot(few["radius_m"], few["height_m"]), few["speed_m_s"] + wanted.speed_m_s
        return (
            _logarithmic("distance to circle", "m", distance, spec.distance_m),
            Panel("tangential speed", "m/s", speed, _limits(speed, wanted.speed_m_s), wanted.speed_m_s, spec.speed_m_s),
        )
    tilt = np.degrees(np.arccos(np.clip(shown[:, :, 8], -1.0, 1.0)))
    return (
        _logarithmic("distance to target", "m", few["position_m"], spec.distance_m),
        Panel("tilt", "°", tilt, (0.0, 180.0)),
    )


def _pendulum_panels(task: PendulumTask, shown: np.ndarray) -> tuple[Panel, Panel]:
    spec, top = task.evaluation, 1.1 * task.rod.max_rate_rad_s
    return (
        Panel("angle", "rad", _angle(shown), (-np.pi, np.pi), 0.0, spec.angle_rad, "angle"),
        Panel("rate", "rad/s", shown[:, :, 2], (-top, top), 0.0, spec.rate_rad_s),
    )


def _limits(speed: np.ndarray, wanted: float) -> tuple[float, float]:
    """Of an axis that shows `speed` as far as it lies between −1 and 3 times the one that is wanted."""
    seen = np.isfinite(speed)
    low = np.min(speed, initial=0.5 * wanted, where=seen)
    high = np.max(speed, initial=1.5 * wanted, where=seen)
    return max(low - 0.1 * wanted, -wanted), min(high + 0.1 * wanted, 3.0 * wanted)


def _logarithmic(label: str, unit: str, values: np.ndarray, tolerance: float) -> Panel:
    """A panel of sizes ≥ 0, drawn along the axis' edge where they lie beyond it; a NaN is not drawn."""
    largest = np.max(values, initial=0.0, where=np.isfinite(values))
    limits = LEAST * tolerance, 1.2 * tolerance * min(max(largest / tolerance, 10.0), MOST)
    return Panel(label, unit, np.clip(values, *limits), limits, 0.0, tolerance, "log")


def _ranks(errors: np.ndarray) -> np.ndarray:
    """Of |errors| [n, K + 1] at each time the one 5 %, 50 % and 95 % up the ranks: [3, K + 1].

    A number that is not finite ranks last, as infinite: to measures.py it is a failure too.
    """
    ranked = np.sort(np.where(np.isfinite(errors), np.abs(errors), np.inf), axis=0)
    return ranked[[round(share * (len(errors) - 1)) for share in (0.05, 0.5, 0.95)]]


def _settled(axes: Axes, task: Task, settle_s: np.ndarray, samples: int) -> None:
    """The share of flights that have settled, over time; `settle_s` [n]."""
    times = np.arange(samples) * task.control_period_s
    share = np.mean(settle_s[:, None] <= times + 0.5 * task.control_period_s, axis=0)
    _over_time(axes, task, Panel("flights settled", "%", 100.0 * share[None], (0.0, 103.0)))
    axes.plot(times, 100.0 * share, color=COLOURS[1], linewidth=2, label="settled for good")


def _over_time(axes: Axes, task: Task, panel: Panel) -> np.ndarray:
    """Make `axes` ready for the panel's lines; the times [s] of its samples, [K + 1]."""
    times = np.arange(panel.values.shape[1]) * task.control_period_s
    tail_s, end_s = task.evaluation.tail_s, max(times[-1], task.control_period_s)
    axes.axvspan(max(end_s - tail_s, 0.0), end_s, color=SHADE, zorder=0, label=f"judged: the last {tail_s:g} s")
    axes.set_yscale("log" if panel.scale == "log" else "linear")
    if panel.scale == "log":
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif panel.scale == "angle":
        _in_pi(axes.yaxis)
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
    """The band to be in, its edges dashed and its size written beside it."""
    low, high = panel.wanted - tolerance, panel.wanted + tolerance
    if panel.scale == "log":
        low = panel.limits[0]
    axes.axhspan(low, high, color=GOOD, alpha=0.13, zorder=0.5, linewidth=0)
    for edge in (high,) if panel.scale == "log" else (low, high):
        axes.axhline(edge, color=INK, linewidth=1, linestyle=(0, (4, 3)), zorder=3, label="tolerance")
    size = f"{'' if panel.scale == 'log' else '± '}{tolerance:g} {panel.unit}"
    axes.annotate(
        size, (1, high), (-4, 3), axes.get_yaxis_transform(), "offset points", ha="right", color=INK, fontsize=10
    )


# What all of them share


def _in_pi(axis: Axis) -> None:
    """Ticks at multiples of π/2."""
    names = {-2: "−π", -1: "−π/2", 0: "0", 1: "π/2", 2: "π"}
    axis.set_major_locator(MultipleLocator(np.pi / 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: names.get(round(value / (np.pi / 2)), "")))


def _figure(task: Task, height_in: float) -> Figure:
    """An empty figure, titled with the task."""
    figure = Figure(figsize=(10.0, height_in), dpi=PIXELS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    what = textwrap.shorten(f"{task.reward.form}: {task.description}", 90, placeholder=" …")
    figure.suptitle(what, fontsize=13, fontweight="bold", color=INK, parse_math=False)
    return figure


def _successes(found: Measured) -> str:
    return f"{np.sum(found.success):,} of {len(found.success):,} flights succeed"


def _finish(axes: Axes, title: str = "") -> None:
    axes.set_title(title, fontsize=11.5, color=INK)
    axes.set_xlabel(axes.get_xlabel(), fontsize=11)
    axes.set_ylabel(axes.get_ylabel(), fontsize=11)
    axes.tick_params(labelsize=10.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend(figure: Figure) -> None:
    """One legend below all axes, each label once."""
    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), frameon=False, fontsize=10.5
    )

"""The paper's six figures, of one column's width; matplotlib objects, without pyplot."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from experiments.figures.flights import PolicyFlights
from experiments.output import atomic_write
from experiments.statistics import interquartile_mean
from qrl_envs.plots.frame import COLORS, INK
from qrl_envs.task import CircleReward

WIDTH_IN = 3.4  # a column
PIXELS_PER_INCH = 200
POINTS = 8.0  # font size
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # lines differ in dash as well as color
PUBLISHED = ((2e6, 151.0), (3e6, 158.0), (5e6, 160.6), (10e6, 162.9))  # authors' checkpoints, flown: steps, return
SHOWN = 5

_STYLE = {
    "font.size": POINTS,
    "axes.titlesize": POINTS,
    "axes.labelsize": POINTS,
    "xtick.labelsize": POINTS,
    "ytick.labelsize": POINTS,
    "legend.fontsize": POINTS,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.borderaxespad": 0.2,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.3,
    "svg.hashsalt": "qrl",  # the same figure is the same file
}


class Curves(NamedTuple):
    """One setting's learning curves: its reports over environment steps."""

    label: str
    steps: np.ndarray  # [x]
    returns: np.ndarray  # [seeds, x]
    success: np.ndarray  # [seeds, x], a fraction; NaN where it is not measured

    @property
    def seeds(self) -> int:
        return len(self.returns)


class Rate(NamedTuple):
    """The pendulum at one learning rate: the method, and PPO."""

    title: str
    ours: Curves
    ppo: Curves


def intervals(values: np.ndarray) -> np.ndarray:
    """Of the finite among `values` [seeds, x] the interquartile mean and the ends of its interval, [3, x]; else NaN."""
    return np.array([interquartile_mean(column[np.isfinite(column)]) for column in values.T]).T


@contextmanager
def style() -> Iterator[None]:
    """Matplotlib's settings for creating and saving figures."""
    with matplotlib.rc_context(_STYLE):  # pyright: ignore[reportArgumentType]  of literals alone
        yield


def save(figure: Figure, path: Path) -> None:
    """Write PATH.png and PATH.svg, each atomically; `path` has no suffix."""
    with style():
        for form, metadata in (("png", None), ("svg", {"Date": None})):
            atomic_write(
                path.with_name(f"{path.name}.{form}"),
                partial(figure.savefig, format=form, dpi=PIXELS_PER_INCH, metadata=metadata),
            )


def _figure(height_in: float, rows: int = 1, **more: Any) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, 1, squeeze=False, **more)[:, 0])


# Learning curves


def pendulum(rates: list[Rate]) -> Figure:
    """A panel for each pair of rates: {"the paper's rates": [high, low], …} by the first word of their titles."""
    groups: dict[str, list[Rate]] = {}
    for rate in rates:
        groups.setdefault(rate.title.split(":")[0], []).append(rate)
    with style():
        figure, panels = _figure(0.4 + 2.2 * len(groups), len(groups), sharex=True, sharey=True)
        for axes, (title, pair) in zip(panels, groups.items(), strict=True):
            colors = iter(COLORS)
            for rate in pair:
                for curves, dash in ((rate.ours, DASHES[0]), (rate.ppo, DASHES[1])):
                    _draw(axes, curves.steps, curves.returns, next(colors), dash, curves.label)
            axes.set(ylabel="return of 200 steps [1]")
            axes.legend(title=title, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, labelspacing=0.25)
        _steps(panels[-1])
        return figure


def hover(curves: Curves) -> Figure:
    """Return, with the published checkpoints' for reference, and success."""
    with style():
        figure, (upper, lower) = _figure(3.4, 2, sharex=True, height_ratios=(1.5, 1.0))
        _draw(upper, curves.steps, curves.returns, COLORS[0], DASHES[0], curves.label)
        upper.plot(*zip(*PUBLISHED, strict=True), "s--", color=COLORS[1], markersize=3.5, label="published checkpoints")
        upper.set(ylabel="return of 200 steps [1]", ylim=(min(_floor(curves.returns), 90.0), 170.0))
        upper.legend(loc="lower right")
        _share(lower, curves)
        lower.set_xscale("log")
        _steps(lower)
        return figure


def circle(curves: Curves) -> Figure:
    """Return and success."""
    with style():
        figure, (upper, lower) = _figure(3.2, 2, sharex=True, height_ratios=(1.4, 1.0))
        _draw(upper, curves.steps, curves.returns, COLORS[0], DASHES[0], curves.label)
        upper.set(ylabel="return of 200 steps [1]")
        upper.legend(loc="lower right")
        _share(lower, curves)
        _steps(lower)
        return figure


def _draw(axes: Axes, steps: np.ndarray, values: np.ndarray, color: str, dash: Any, label: str) -> None:
    """The interquartile mean of `values` [seeds, x], and a band: its bootstrap interval of 95 %."""
    mean, low, high = intervals(values)
    axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
    axes.plot(steps, mean, color=color, linestyle=dash, label=label)


def _share(axes: Axes, curves: Curves) -> None:
    _draw(axes, curves.steps, 100.0 * curves.success, COLORS[2], DASHES[0], "")
    axes.set(ylabel="success [%]", ylim=(-4.0, 104.0))


def _floor(values: np.ndarray) -> float:
    """Of an axis for `values` [seeds, x]: low enough to show the mean after its first sixth."""
    mean = intervals(values)[0]
    return float(np.nanmin(mean[len(mean) // 6 :])) - 10.0


def _steps(axes: Axes) -> None:
    axes.set_xlabel("environment steps [1]")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value)))


def thousands(value: float) -> str:
    """200k, 1.5M."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:g}"


# Flights


def trial(flown: PolicyFlights) -> Figure:
    """x, y and z of the first flight over time, thin behind them those of the next."""
    with style():
        figure, (axes,) = _figure(2.3)
        for i, (name, dash) in enumerate(zip("xyz", DASHES, strict=True)):
            first, *others = flown.observations[:SHOWN, :, 9 + i]
            for other in others:
                axes.plot(flown.times_s, other, color=COLORS[i], linewidth=0.7, alpha=0.35)
            axes.plot(flown.times_s, first, color=COLORS[i], linestyle=dash, label=name, zorder=3)
        # The window has all of the thick lines, below the legend; a diverging flight leaves it.
        drawn = flown.observations[0, :, 9:12]
        low, high = np.nanmin(drawn), np.nanmax(drawn)
        limits = low - 0.2 * (high - low), high + 0.3 * (high - low)
        axes.set(xlabel="time [s]", ylabel="position [m]", xlim=(0.0, flown.times_s[-1]), ylim=limits)
        axes.legend(loc="upper right", ncols=3)
        return figure


def from_above(flown: PolicyFlights) -> Figure:
    """Paths of the first five flights on the x-y plane, and the reference circle."""
    with style():
        figure, (axes,) = _figure(3.5)
        angle, r = np.linspace(0.0, 2.0 * np.pi, 181), _target(flown).radius_m
        x, y = r * np.cos(angle), r * np.sin(angle)
        for color, path in zip(COLORS, flown.observations[:SHOWN, :, 9:11], strict=False):
            axes.plot(*path.T, color=color, linewidth=1.0)
            axes.plot(*path[0], "o", color=color, markeredgecolor="white", markersize=6, zorder=4)
        axes.plot([], [], "o", color=INK, markersize=5, label="start")
        axes.plot(x, y, "--", color="black", linewidth=1.2, zorder=5, label=f"{r:g} m reference")
        paths = flown.observations[:SHOWN, :, 9:11]
        half = 1.08 * np.max(np.abs(paths), initial=r, where=np.isfinite(paths))
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(-half, half), ylim=(-half, half))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
        return figure


def velocity(flown: PolicyFlights) -> Figure:
    """vx and vy of the first flight over time, and ± the reference speed."""
    with style():
        figure, (axes,) = _figure(2.3)
        reference = _target(flown).speed_m_s
        for i, (name, dash) in enumerate(zip(("vx", "vy"), DASHES, strict=False)):
            values = flown.observations[0, :, 12 + i]
            axes.plot(flown.times_s, values, color=COLORS[i], linestyle=dash, label=name)
        for k, level in enumerate((reference, -reference)):
            axes.axhline(level, color="black", linestyle=":", linewidth=1.0, label="" if k else f"±{reference:g} m/s")
        axes.set(xlabel="time [s]", ylabel="velocity [m/s]", xlim=(0.0, flown.times_s[-1]))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return figure


def _target(flown: PolicyFlights) -> CircleReward:
    reward = flown.task.evaluation.reward
    assert isinstance(reward, CircleReward)
    return reward

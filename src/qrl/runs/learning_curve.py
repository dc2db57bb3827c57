"""The learning curve of one or several seeds, as PNG; drawn without pyplot, which is slow to import."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

Rows = list[dict[str, float | str]]  # of metrics.csv: column -> number, or its text; "" if not measured

BLUE, GREEN, INK = "#0072B2", "#009E73", "#333333"  # Okabe and Ito's palette for color blindness
PIXELS_PER_INCH = 150


def learning_curve(path: Path, runs: list[Rows], title: str) -> None:
    """Draw return and success over environment steps; `runs` holds one list of metrics.csv's rows for each seed."""
    FigureCanvasAgg(learning_curve_figure(runs, title)).print_png(path)  # draws once, where `savefig` does twice


def learning_curve_figure(runs: list[Rows], title: str) -> Figure:
    """The figure of `learning_curve`. Axes: the return and, if any row has it, the success."""
    steps, success = aligned(runs, "success")
    has_success = bool(np.isfinite(success).any())
    figure = empty_figure(title, 8.0, 5.4 if has_success else 3.6)
    upper, *rest = figure.subplots(1 + has_success, 1, sharex=True, squeeze=False)[:, 0]
    if len(runs) == 1:
        worst = aligned(runs, "return_min")[1][0]
        upper.plot(steps, worst, color=BLUE, alpha=0.45, linewidth=1.2, marker=_marker(steps), label="worst flight")
    _draw(upper, steps, aligned(runs, "return_mean")[1], BLUE, "mean of flights")
    _finish(upper, "return", steps)
    for lower in rest:
        _draw(lower, steps, success, GREEN)
        lower.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
        lower.set_ylim(-0.04, 1.04)
        _finish(lower, "success", steps)
    (rest or [upper])[-1].set_xlabel("environment steps", fontsize=11)
    return figure


def empty_figure(title: str, width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(width_in, height_in), dpi=PIXELS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13, fontweight="bold", color=INK, parse_math=False)
    return figure


def plain_style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)


def aligned(runs: list[Rows], key: str) -> tuple[np.ndarray, np.ndarray]:
    """The union of environment steps of `runs`, [x], and column `key` of each run at these steps, [runs, x].

    Values between the rows of a run are interpolated; before its first finite value and after its last they are NaN.
    """
    tables = [np.array([(number(row, "env_steps"), number(row, key)) for row in rows]).reshape(-1, 2) for rows in runs]
    steps = np.unique(np.concatenate([np.empty((0, 2)), *tables])[:, 0])
    steps = steps[np.isfinite(steps)]
    values = np.full((len(runs), len(steps)), np.nan)
    for table, value in zip(tables, values, strict=True):
        points = table[np.isfinite(table).all(axis=1)]
        if len(points):
            value[:] = np.interp(steps, *points[np.argsort(points[:, 0])].T, left=np.nan, right=np.nan)
    return steps, values


def number(row: dict[str, float | str], key: str) -> float:
    """A cell of metrics.csv; NaN if it is absent, empty or no number."""
    try:
        return float(row.get(key, "nan"))
    except ValueError:
        return float("nan")


def _draw(axes: Axes, steps: np.ndarray, values: np.ndarray, color: str, label: str = "") -> None:
    """Draw one run as a line, several as their median and a band of their range; `values` [runs, x]."""
    quantiles = np.full((3, values.shape[1]), np.nan)
    finite = np.isfinite(values).any(axis=0)
    quantiles[:, finite] = np.nanquantile(values[:, finite], [0.0, 0.5, 1.0], axis=0)
    low, median, high = quantiles
    if len(values) > 1:
        axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0, label="range")
        axes.plot(steps, values.T, color=color, alpha=0.35, linewidth=0.8)
        label = f"median of {len(values)} seeds"
    axes.plot(steps, median, color=color, linewidth=2, marker=_marker(steps), label=label)


def _marker(steps: np.ndarray) -> str:
    return "o" if len(steps) == 1 else ""  # a line needs two


def _finish(axes: Axes, label: str, steps: np.ndarray) -> None:
    axes.set_ylabel(label, fontsize=11)
    plain_style(axes)
    axes.tick_params(labelsize=10.5)
    axes.xaxis.set_major_formatter(EngFormatter())
    if steps.max(initial=0.0) > 0.0:
        axes.set_xlim(0.0, 1.02 * steps.max())
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="best", frameon=False, fontsize=10.5)

"""A sweep as a picture: a curve over one numeric axis, a heat map over two axes, else a panel for each axis."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qrl.runs.learning_curve import BLUE, GREEN, INK, empty_figure, plain_style

LOG_ABOVE = 20.0  # ratio of the greatest to the least value from which an axis is logarithmic
LABELED = 120  # cells of a heat map that still have room for their numbers
COLORS = {"return_mean": BLUE, "success": GREEN}
NAMES = {"return_mean": "return", "success": "success"}
Summary = dict[str, Any]  # {"at": {axis: value}, metric: {"median", "q1", "q3"}}


def sweep(path: Path, found: Sequence[Summary], title: str) -> None:
    """Draw median return and, where it is measured, success of every point."""
    sweep_figure(found, title).savefig(path, format="png")


def sweep_figure(found: Sequence[Summary], title: str) -> Figure:
    """What `sweep` saves. Axes: a row for each metric."""
    names = list(found[0]["at"])
    metrics = [m for m in COLORS if any(np.isfinite(f[m]["median"]) for f in found)] or ["return_mean"]
    grid = len(names) == 2 and len(found) == len(_labels(found, names[0])) * len(_labels(found, names[1]))
    columns = 1 if grid or len(names) == 1 else len(names)
    figure = empty_figure(title, max(6.0, 3.4 * columns), 3.4 * len(metrics))
    for row, metric in zip(figure.subplots(len(metrics), columns, squeeze=False), metrics, strict=True):
        if grid:
            _heat_map(row[0], found, names, metric)
        else:
            for axes, name in zip(row, names, strict=True):
                _panel(axes, found, name, metric, band=len(names) == 1)
    return figure


def _panel(axes: Axes, found: Sequence[Summary], name: str, metric: str, *, band: bool) -> None:
    """Median of each point over its coordinate on one axis; for a single axis with the quartiles over seeds."""
    x, color = _positions(found, name), COLORS[metric]
    median, low, high = (np.array([f[metric][q] for f in found], float) for q in ("median", "q1", "q3"))
    median, low, high = (np.where(np.isfinite(v), v, np.nan) for v in (median, low, high))
    order = np.argsort(x, kind="stable")
    if band and _numeric(found, name):
        axes.fill_between(x[order], low[order], high[order], color=color, alpha=0.2, linewidth=0, label="quartiles")
        axes.plot(x[order], median[order], color=color, linewidth=2, marker="o", label="median over seeds")
        axes.legend(frameon=False, fontsize=9)
    elif band:
        axes.errorbar(x, median, np.array([median - low, high - median]), color=color, fmt="o", capsize=4)
    else:
        axes.plot(x, median, "o", color=color, alpha=0.5, markersize=4)
        unique = np.unique(x)
        if len(unique) < len(x):
            middles = [np.nanmedian(m) if np.isfinite(m := median[x == p]).any() else np.nan for p in unique]
            axes.plot(unique, middles, color=color, linewidth=2)
    _finish(axes, found, name, metric)


def _finish(axes: Axes, found: Sequence[Summary], name: str, metric: str) -> None:
    if not _numeric(found, name):
        labels = _labels(found, name)
        axes.set_xticks(range(len(labels)), labels, rotation=20 if len(labels) > 3 else 0, parse_math=False)
        axes.set_xlim(-0.5, len(labels) - 0.5)
    else:
        x = _positions(found, name)
        if x.min() > 0 and x.max() / x.min() >= LOG_ABOVE:
            axes.set_xscale("log")
    axes.set_xlabel(name, parse_math=False)
    axes.set_ylabel(NAMES[metric])
    plain_style(axes)


def _heat_map(axes: Axes, found: Sequence[Summary], names: list[str], metric: str) -> None:
    down, across = (_labels(found, name) for name in names)
    cells = np.full((len(down), len(across)), np.nan)
    for f in found:
        value = f[metric]["median"]
        cell = down.index(_label(f["at"][names[0]])), across.index(_label(f["at"][names[1]]))
        cells[cell] = value if np.isfinite(value) else np.nan
    axes.set_facecolor("#BBBBBB")
    low, high = (0.0, 1.0) if metric == "success" else (None, None)
    image = axes.imshow(cells, aspect="auto", cmap="viridis", origin="lower", vmin=low, vmax=high)
    axes.figure.colorbar(image, ax=axes, label=NAMES[metric])
    axes.set_yticks(range(len(down)), down, parse_math=False)
    axes.set_xticks(range(len(across)), across, parse_math=False)
    axes.set_ylabel(names[0], parse_math=False)
    axes.set_xlabel(names[1], parse_math=False)
    if cells.size <= LABELED:
        for (i, j), value in np.ndenumerate(cells):
            light = np.asarray(image.norm(np.array([value]))).item() > 0.6  # of viridis' two ends
            color = INK if light else "white"
            axes.text(j, i, f"{value:.4g}", ha="center", va="center", fontsize=8, color=color)


def _numeric(found: Sequence[Summary], name: str) -> bool:
    return all(isinstance(v := f["at"][name], int | float) and not isinstance(v, bool) for f in found)


def _positions(found: Sequence[Summary], name: str) -> np.ndarray:
    """Positions of the points on an axis: its numbers, or the indices of its values in their order."""
    if _numeric(found, name):
        return np.array([f["at"][name] for f in found], float)
    labels = _labels(found, name)
    return np.array([labels.index(_label(f["at"][name])) for f in found], float)


def _labels(found: Sequence[Summary], name: str) -> list[str]:
    return list(dict.fromkeys(_label(f["at"][name]) for f in found))


def _label(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else json.dumps(value)

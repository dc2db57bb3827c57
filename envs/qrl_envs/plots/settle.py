"""Settle times as a map over the start's tilt and speed."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MultipleLocator

from qrl_envs import measures
from qrl_envs.measures import speed_m_s, tilt_deg
from qrl_envs.plots.frame import INK, SHADE, empty, finish, legend, save, successes
from qrl_envs.task import QuadrotorTask

TILT_EDGES_DEG = np.linspace(0.0, 180.0, 13)
SPEEDS = 8  # cells
MIN_FLIGHTS = 3  # in a cell, for its median
FAILED = "#D55E00"
MANY = 50  # failures; more are drawn with smaller crosses


def draw(path: Path, task: QuadrotorTask, observations: np.ndarray) -> None:
    save(path, figure(task, observations))


def figure(task: QuadrotorTask, observations: np.ndarray) -> Figure:
    """Settle times of flights with `observations` [n, K + 1, 18], in SI units. Axes: the map, and its color bar."""
    found = measures.of_flights(task, observations)
    tilt, speed = tilt_deg(observations[:, 0]), speed_m_s(observations[:, 0])
    figure = empty(task, height_in=5.6)
    axes = figure.subplots()
    most = max(float(np.max(speed, initial=0.0, where=np.isfinite(speed))), 1e-3)
    edges = np.linspace(0.0, most * (1 + 1e-6), SPEEDS + 1)
    cells = medians(tilt, speed, np.where(found.success, found.settle_s, np.inf), edges)
    _map(figure, axes, cells, edges)
    failed = ~found.success
    if failed.any():
        size, width = (9, 2.2) if failed.sum() <= MANY else (5, 1.2)
        crosses = {"color": FAILED, "markersize": size, "markeredgewidth": width, "clip_on": False}
        axes.plot(tilt[failed], speed[failed], "x", label="failed start", **crosses)
    axes.fill_between([], [], color=SHADE, label=f"fewer than {MIN_FLIGHTS} flights")
    axes.set(
        xlabel="tilt at the start [°]", ylabel="speed at the start [m/s]", xlim=(0.0, 180.0), ylim=(0.0, edges[-1])
    )
    axes.xaxis.set_major_locator(MultipleLocator(30.0))
    finish(axes, f"time to settle over the start; {successes(found)}")
    axes.grid(visible=False)
    axes.set_facecolor(SHADE)
    legend(figure)
    return figure


def medians(tilt: np.ndarray, speed: np.ndarray, settle_s: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The median settle time [s] of each cell [speeds, tilts], for tilt [°], speed [m/s] and settle_s [n] of n flights.

    NaN for fewer than MIN_FLIGHTS flights; infinite if half of them or more never settle.
    """
    column, row = np.digitize(tilt, TILT_EDGES_DEG) - 1, np.digitize(speed, edges) - 1
    column = np.minimum(column, len(TILT_EDGES_DEG) - 2)  # exactly upside down
    cells = np.full((len(edges) - 1, len(TILT_EDGES_DEG) - 1), np.nan)
    for i, j in np.ndindex(cells.shape):
        here = settle_s[(row == i) & (column == j)]
        if len(here) >= MIN_FLIGHTS:
            cells[i, j] = np.sort(here)[len(here) // 2]
    return cells


def _map(figure: Figure, axes: Axes, cells: np.ndarray, edges: np.ndarray) -> None:
    settled = cells[np.isfinite(cells)]
    low, high = (settled.min(), settled.max()) if len(settled) else (0.0, 1.0)
    high = max(high, low + 0.1)
    shown = np.ma.masked_invalid(cells)
    colors = axes.pcolormesh(
        TILT_EDGES_DEG, edges, shown, cmap="cividis", vmin=low, vmax=high, edgecolors="white", linewidth=0.8
    )
    bar = figure.colorbar(colors, ax=axes, pad=0.02)
    bar.set_label("median time to settle [s]", fontsize=11)
    bar.ax.tick_params(labelsize=10.5)
    for (i, j), value in np.ndenumerate(cells):
        if np.isnan(value):
            continue
        x, y = TILT_EDGES_DEG[j : j + 2].mean(), edges[i : i + 2].mean()
        color = "white" if value < (low + high) / 2 else INK
        text = axes.text(
            x,
            y,
            f"{value:.2f}" if value < 1 else f"{value:.1f}" if value < 10 else f"{value:.0f}",
            color=color,
            fontsize=9.5,
            zorder=5,
        )
        text.set(ha="center", va="center")
        if np.isinf(value):
            text.set(text="never", path_effects=[withStroke(linewidth=3, foreground="white")])  # over the crosses

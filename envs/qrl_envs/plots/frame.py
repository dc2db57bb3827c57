"""Shared parts of the plots: an empty figure, axes style, legend, and colors for color-blind readers."""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MultipleLocator

from qrl_envs.task import Task

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")  # Okabe and Ito: safe for color-blind readers
INK, SHADE, GOOD = "#333333", "#EEEEEE", "#009E73"
PIXELS_PER_INCH = 150


def empty(task: Task, height_in: float) -> Figure:
    """An empty figure, titled with the task."""
    figure = Figure(figsize=(10.0, height_in), dpi=PIXELS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    title = textwrap.shorten(f"{task.reward.form}: {task.description}", 90, placeholder=" …")
    figure.suptitle(title, fontsize=13, fontweight="bold", color=INK, parse_math=False)
    return figure


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
    """Ticks at multiples of π/2."""
    names = {-2: "−π", -1: "−π/2", 0: "0", 1: "π/2", 2: "π"}
    axis.set_major_locator(MultipleLocator(np.pi / 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: names.get(round(value / (np.pi / 2)), "")))

"""A picture of a fit: parameters with their intervals, held-out errors over time, and one flight beside its log."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from qrl.identification.fit import HeldOut
from qrl.identification.report import Row

START, FITTED, LOG = "#D55E00", "#0072B2", "#333333"  # Okabe and Ito
SHOWN = 8  # segments of the flight in the third axes


def draw(path: Path, title: str, rows: list[Row], found: HeldOut) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(14.0, 4.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.1, 1.0, 1.2))
    _parameters(left, [row for row in rows if row.start > 0.0 and row.name != "thrust_curve"])
    for distance, color, name in ((found.start_m, START, "starting vehicle"), (found.fitted_m, FITTED, "fitted")):
        low, median, high = 1e3 * np.quantile(distance, (0.05, 0.5, 0.95), axis=0)
        middle.fill_between(found.lead_s, low, high, color=color, alpha=0.2, linewidth=0)
        middle.plot(found.lead_s, median, color=color, linewidth=2, label=f"{name}: median, 5 to 95 %")
    still = 1e3 * np.median(found.constant_velocity_m, axis=0)
    middle.plot(found.lead_s, still, color=LOG, linestyle=":", label="constant velocity: median")
    middle.set(
        xlabel="time ahead [s]", ylabel="position error [mm]", yscale="log", title="held-out segments, open loop"
    )
    _flight(right, found)
    for axes in (left, middle, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#DDDDDD", linewidth=0.6)
    for axes in (middle, right):
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, format="png")


def _parameters(axes, rows: list[Row]) -> None:
    for y, row in enumerate(reversed(rows)):
        value, low, high = (x / row.start for x in (row.value, row.low, row.high))
        color = "#999999" if row.kept else FITTED
        axes.errorbar(
            value, y, xerr=[[max(value - low, 0.0)], [max(high - value, 0.0)]], fmt="o", color=color, capsize=3
        )
    axes.axvline(1.0, color=START, linewidth=1)
    axes.set_yticks(range(len(rows)), [row.name for row in reversed(rows)], fontsize=8)
    axes.set(xlabel="over the starting vehicle's; grey: kept", title="parameters, 95 % intervals")


def _flight(axes, found: HeldOut) -> None:
    """The velocity along x of consecutive segments of the first held-out flight."""
    for i in range(min(SHOWN, len(found.measured))):
        times = i * found.lead_s[-1] + found.lead_s
        for states, color, style in (
            (found.start, START, "-"),
            (found.fitted, FITTED, "-"),
            (found.measured, LOG, "--"),
        ):
            axes.plot(times, states[i, :, 7], color=color, linestyle=style, linewidth=1.5)
    for color, name in ((START, "starting vehicle"), (FITTED, "fitted"), (LOG, "log")):
        axes.plot([], [], color=color, label=name)
    speed = np.abs(found.measured[:SHOWN, :, 7]).max() + 0.5
    axes.set(
        xlabel="time [s]", ylabel="velocity x [m/s]", ylim=(-speed, speed), title="a held-out flight, anew every 0.5 s"
    )

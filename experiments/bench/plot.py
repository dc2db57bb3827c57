"""The ratios as one plot: each contestant's time over qrl's, and qrl's rate over each contestant's."""

import math
import textwrap
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from experiments.bench.tables import BARS, QRL, Run, Spread, by_seed, figures, number, ratios, strip_device_suffix

COLORS = {"training": "#0072B2", "total": "#E69F00", "speed": "#009E73"}  # of Okabe and Ito
NAMES = {
    "training": "training seconds, contestant / qrl",
    "total": "seconds from start to solved, contestant / qrl",
    "speed": "steps a second, qrl / contestant",
}


class Bar(NamedTuple):
    label: str
    kind: str
    ratio: Spread
    bound: bool  # not solved: the ratio is a lower bound


def bars(runs: list[Run]) -> list[Bar]:
    """A bar for each ratio that is there; for one that mostly failed, a lower bound from its budget."""
    found: list[Bar] = []
    for group in BARS:
        selected = [run for run in runs if run["group"] == group]
        for contestant in dict.fromkeys(run["contestant"] for run in selected if run["contestant"] != QRL):
            for kind, clock in (("training", "train_seconds"), ("total", "total_seconds")):
                other, ours = by_seed(selected, contestant, clock), by_seed(selected, QRL, clock)
                spent = {
                    r["seed"]: r["lines"][-1][clock] for r in selected if r["contestant"] == contestant and r["lines"]
                }
                ratio = ratios(other, ours)
                bound = ratio is not None and not math.isfinite(ratio.median)
                if ratio and not math.isfinite(ratio.max):
                    ratio = ratios(
                        {s: v if math.isfinite(v) else spent.get(s, math.nan) for s, v in other.items()}, ours
                    )
                if ratio and math.isfinite(ratio.median):
                    found.append(Bar(f"{group}: {contestant}", kind, ratio, bound))
    rates = figures([run for run in runs if run["group"] == "speed"])
    for figure, values in rates.items():
        ours = rates.get(strip_device_suffix(figure), {}).get(QRL, {})
        for contestant in values:
            if contestant != QRL and (ratio := ratios(ours, values[contestant])):
                found.append(Bar(f"{figure}: {contestant}", "speed", ratio, False))
    return found


def plot(path: Path, runs: list[Run]) -> None:
    """Horizontal bars on a logarithmic axis, whiskers from min to max; no file where there is no ratio."""
    found = bars(runs)
    if not found:
        return
    figure, axes = plt.subplots(figsize=(9.0, 1.4 + 0.3 * len(found)), layout="constrained")
    for y, bar in enumerate(found):
        low, high = bar.ratio.median - bar.ratio.min, bar.ratio.max - bar.ratio.median
        axes.barh(
            y,
            bar.ratio.median - 1.0,
            left=1.0,
            height=0.7,
            color="white" if bar.bound else COLORS[bar.kind],
            edgecolor=COLORS[bar.kind],
            hatch="///" if bar.bound else None,
            xerr=[[low], [high]],
            ecolor="#333333",
            capsize=2,
        )
        text = f"{'> ' if bar.bound else ''}{number(bar.ratio.median)}×"
        axes.annotate(text, (max(bar.ratio.max, 1.0), y), (5, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_xscale("log")
    axes.axvline(1.0, color="#333333", linewidth=1.0)
    axes.set_yticks(range(len(found)), [textwrap.fill(bar.label, 62) for bar in found], fontsize=8)
    axes.invert_yaxis()
    axes.margins(x=0.12, y=0.01)
    axes.set_xlabel(
        "times qrl (median, range over seeds)\nhatched: not solved within the budget, so at least this", fontsize=9
    )
    kinds = [kind for kind in COLORS if any(bar.kind == kind for bar in found)]
    patches = [plt.Rectangle((0, 0), 1, 1, color=COLORS[kind]) for kind in kinds]
    axes.legend(
        patches,
        [NAMES[kind] for kind in kinds],
        fontsize=8,
        loc="upper center",
        bbox_to_anchor=(0.4, -1.1 / (0.3 * len(found))),
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    plt.close(figure)

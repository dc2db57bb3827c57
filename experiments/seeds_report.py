"""What many seeds have in common and how they spread: seeds.csv, summary.json, a table and a picture."""

import math
import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import EngFormatter, PercentFormatter

from experiments.output import atomic_write, table
from experiments.statistics import interquartile_mean
from qrl.evaluation.starts import STARTS
from qrl.runs import files, record
from qrl.runs.learning_curve import BLUE, GREEN, empty_figure, plain_style

FLIES = 0.99  # share of starts that succeed
FINISHED, UNFINISHED = "done", "unfinished"  # a status; that of a seed that failed says why
Row = dict[str, Any]  # of seeds.csv: seed, status, and measures; NaN: not measured


def name(seed: int) -> str:
    """Of a seed's run folder."""
    return f"{seed:03d}"


def report(rows: list[Row], out: Path, title: str) -> None:
    """seeds.csv, summary.json, seeds.png and a table, of the seeds that have ended; nothing if none has."""
    ended = [row for row in rows if row["status"] != UNFINISHED]
    if not ended:
        return
    files.replace_text(out / "seeds.csv", files.csv_text(rows))
    failing = {
        row["seed"]: f"success {100 * row['success']:.1f} %" if "success" in row else row["status"]
        for row in ended
        if row.get("success", 0.0) < FLIES
    }
    measures = statistics(ended)
    found = {"title": title, "first": rows[0]["seed"], "seeds": len(rows), "ended": len(ended), "starts": STARTS}
    succeed = sum(row.get("success", 0.0) >= FLIES for row in ended)
    found |= {"succeed": succeed, "failing": failing, "measures": measures}
    files.write_json(out / "summary.json", found | {"versions": record.versions()})
    atomic_write(out / "seeds.png", partial(draw, ended, measures, out, title))
    cells = [
        [key, number(m["median"]), f"{number(m['worst'])} (seed {m['worst_seed']})"]
        + [f"{number(m['iqm'])} [{number(m['low'])}, {number(m['high'])}]"]
        for key, m in measures.items()
    ]
    print(table(["measure", "median", "worst", "interquartile mean [95 %]"], cells))
    print(f"{title}: {succeed} of {len(ended)} seeds succeed from {100 * FLIES:g} % of {STARTS:,} starts or more")
    for seed, why in failing.items():
        print(f"  seed {seed} does not: {why}")
    print(f"{out / 'seeds.csv'}, summary.json, seeds.png", flush=True)


def statistics(rows: list[Row]) -> dict[str, Row]:
    """Measure -> median, worst, and interquartile mean with a bootstrap interval of 95 %, over seeds.

    A seed that failed is infinitely bad, its success 0; it has no part in clocks. What is not measured is left out.
    """
    found = {}
    for key in dict.fromkeys(key for row in rows for key in row if key not in ("seed", "status")):
        sign = -1.0 if key in ("success", "return_mean") else 1.0  # of what is bad
        failed = math.nan if key.endswith("_seconds") else 0.0 if key == "success" else sign * math.inf
        values = {row["seed"]: float(value) for row in rows if not math.isnan(value := row.get(key, failed))}
        if values:
            worst = max(values, key=lambda seed: sign * values[seed])
            found[key] = {"median": float(np.median([*values.values()])), "worst": values[worst], "worst_seed": worst}
            found[key] |= interquartile_mean(np.array([*values.values()]))._asdict()
    return found


def number(value: float) -> str:
    """As text; infinite is what a seed never did, or has none of."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "never" if value > 0 else "none"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def share_that_flies(rows: list[Row], out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps of all reports [x], and the share of seeds whose last report until then flies [x]; none flies on failed."""
    found = [(row["status"], files.read_metrics(out / name(row["seed"]))) for row in rows]
    steps = np.unique([report["env_steps"] for _, reports in found for report in reports])
    flying = np.zeros((len(rows), len(steps)))
    for flies, (status, reports) in zip(flying, found, strict=True):
        for report in reports:
            flies[steps >= report["env_steps"]] = report["success"] >= FLIES
        if status != FINISHED and reports:
            flies[steps > reports[-1]["env_steps"]] = 0.0
    return steps, flying.mean(axis=0)


def draw(rows: list[Row], measures: dict[str, Row], out: Path, title: str, path: Path) -> None:
    """The share of seeds that fly over environment steps; below, each measure of each seed, and a box of them."""
    lines = math.ceil(len(measures) / 4)
    figure = empty_figure(textwrap.shorten(f"{len(rows)} seeds of {title}", 90), 11.0, 3.2 + 1.8 * lines)
    grid = figure.add_gridspec(1 + lines, 4, height_ratios=[1.6] + [1.0] * lines)
    axes = figure.add_subplot(grid[0, :])
    axes.step(*share_that_flies(rows, out), where="post", color=GREEN, linewidth=2, marker="o", markersize=4)
    axes.set(
        xlabel="environment steps", ylabel=f"seeds with success ≥ {100 * FLIES:g} %", xscale="log", ylim=(-0.04, 1.04)
    )
    axes.xaxis.set_major_formatter(EngFormatter())
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    plain_style(axes)
    for i, key in enumerate(measures):
        axes = figure.add_subplot(grid[1 + i // 4, i % 4])
        values = np.array([row[key] for row in rows if math.isfinite(row.get(key, math.nan))])
        if len(values):
            axes.boxplot(values, orientation="horizontal", widths=0.6, showfliers=False, medianprops={"color": BLUE})
            height = np.random.default_rng(0).uniform(0.8, 1.2, len(values))
            axes.scatter(values, height, s=9, color=BLUE, alpha=0.5, linewidths=0)
        axes.set_title(f"{key} ({len(values)} of {len(rows)})" if len(values) < len(rows) else key, fontsize=9)
        axes.set_yticks([])
        axes.locator_params(axis="x", nbins=5)
        axes.tick_params(axis="x", labelsize=8)
        plain_style(axes)
    figure.savefig(path, format="png")

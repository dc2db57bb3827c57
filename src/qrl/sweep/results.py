"""Results of a sweep: tables, medians and quartiles over seeds, the best point, and a run that repeats it."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from qrl.runs import files, record
from qrl.runs.files import rank_key
from qrl.runs.record import RunConfig
from qrl.sweep.grid import Grid
from qrl.sweep.runner import Result
from qrl.training import devices

CURVE = ("env_steps", "updates", "return_mean", "return_min", "success")
# Of one point: coordinates, seeds, number diverged, quartiles of each number of the last report.
Summary = dict[str, Any]


def table(grid: Grid, results: dict[int, Result]) -> list[dict[str, Any]]:
    """A row for each point and seed: the point's coordinates, the seed, and its last report."""
    return [
        {
            **_label(grid, index),
            "diverged": result.diverged,
            **_pruned(grid, index // len(grid.seeds), [result]),
            **result.rows[-1],
        }
        for index, result in sorted(results.items())
    ]


def _pruned(grid: Grid, point: int, results: list[Result]) -> dict[str, bool]:
    """For a search, whether the point's training was ended early."""
    return {"pruned": grid.pruned(point, results)} if grid.file.search else {}


def curves(grid: Grid, results: dict[int, Result]) -> list[dict[str, Any]]:
    return [
        {**_label(grid, index), **{name: row[name] for name in CURVE}}
        for index, result in sorted(results.items())
        for row in result.rows
    ]


def _label(grid: Grid, index: int) -> dict[str, Any]:
    point, seed = divmod(index, len(grid.seeds))
    coordinates = {name: _cell(value) for name, value in grid.points[point].coordinates.items()}
    return {"point": point, **coordinates, "seed": grid.seeds[seed]}


def _cell(value: Any) -> Any:
    return value if isinstance(value, str | int | float) and not isinstance(value, bool) else json.dumps(value)


def summaries(grid: Grid, results: dict[int, Result]) -> list[Summary]:
    """For each point with results the quartiles over its seeds; a seed that diverged counts as the worst possible."""
    measured = any(math.isfinite(row["success"]) for result in results.values() for row in result.rows[-1:])
    found = []
    for i in sorted({index // len(grid.seeds) for index in results}):
        seeds = [results[i * len(grid.seeds) + j] for j in range(len(grid.seeds))]
        numbers = {
            name: _quartiles([_worst(name, measured) if seed.diverged else seed.rows[-1][name] for seed in seeds])
            for name in seeds[0].rows[-1]
            if name not in ("env_steps", "updates")
        }
        num_diverged = sum(bool(seed.diverged) for seed in seeds)
        about = {"seeds": len(seeds), "diverged": num_diverged, **_pruned(grid, i, seeds)}
        found.append({"point": i, "at": grid.points[i].coordinates, **about, **numbers})
    return found


def _worst(name: str, measured: bool) -> float:
    if name.startswith(("settle_", "rms_")):
        return math.inf
    if name in ("return_mean", "return_min"):
        return -math.inf
    return 0.0 if name == "success" and measured else math.nan


def _quartiles(values: list[float]) -> dict[str, float]:
    ordered = np.sort(np.asarray(values, np.float64))  # NaN last
    return {name: _quantile(ordered, share) for name, share in (("median", 0.5), ("q1", 0.25), ("q3", 0.75))}


def _quantile(ordered: Any, share: float) -> float:
    """NumPy's linear quantile, defined for infinities too: between an infinity and a number lies that infinity."""
    position = share * (len(ordered) - 1)
    low, high = float(ordered[math.floor(position)]), float(ordered[math.ceil(position)])
    if np.isnan(ordered[-1]):
        return math.nan
    fraction = position % 1
    return low if low == high else low * (1 - fraction) + high * fraction


def best(found: list[Summary]) -> int | None:
    """The point of the highest median success and, among equals, median return; None if all diverged."""
    first = ranked(found)[0]
    return first["point"] if first["diverged"] < first["seeds"] else None


def _rank(summary: Summary) -> tuple[bool, float, float]:
    whole = summary["diverged"] < summary["seeds"] and not summary.get("pruned")
    return whole, rank_key(summary["success"]["median"]), rank_key(summary["return_mean"]["median"])


def ranked(found: list[Summary]) -> list[Summary]:
    return sorted(found, key=_rank, reverse=True)


def best_run_config(grid: Grid, results: dict[int, Result], point: int) -> RunConfig:
    """The run of a point with its middle seed: the lower median, of those that did not diverge."""
    first = point * len(grid.seeds)
    last = {j: results[first + j].rows[-1] for j in range(len(grid.seeds)) if not results[first + j].diverged}
    order = sorted(last, key=lambda j: (rank_key(last[j]["success"]), rank_key(last[j]["return_mean"])))
    return RunConfig(
        task=grid.points[point].task,
        learner=grid.points[point].learner,
        seed=grid.seeds[order[(len(order) - 1) // 2]],
        seeds=1,
        versions=record.versions(),
        devices=sorted({str(device) for device in devices.workers()}),
    )


def by_task(grid: Grid, found: list[Summary]) -> dict[str, list[Summary]]:
    """Results of each task: those of different tasks are not compared."""
    tasks: dict[str, list[Summary]] = {}
    for summary in found:
        tasks.setdefault(grid.points[summary["point"]].asked, []).append(summary)
    return tasks


def write(out: Path, grid: Grid, results: dict[int, Result], found: list[Summary], seconds: float) -> None:
    files.replace_text(out / "results.csv", files.csv_text(table(grid, results)))
    files.replace_text(out / "curves.csv", files.csv_text(curves(grid, results)))
    of_tasks = {task: best(these) for task, these in by_task(grid, found).items()}
    for winner in of_tasks.values():
        name = "best.json" if len(of_tasks) == 1 else f"best-{winner}.json"
        if winner is not None:
            files.write_json(out / name, best_run_config(grid, results, winner).model_dump(mode="json"))
    winners = of_tasks if len(of_tasks) > 1 else next(iter(of_tasks.values()))
    summary = {"best": winners, "programs": len(grid.groups()), "points": found, "command_seconds": round(seconds, 1)}
    files.write_json(out / "summary.json", summary)

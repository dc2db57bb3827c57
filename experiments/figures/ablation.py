"""The paper's objectives side by side, on the pendulum and in hover, as one table: `make ablation`.

    .venv/bin/python -m experiments.figures.ablation [--out experiments/out] [--only pendulum] [--fresh]

Runs `qrl sweep` on experiments/grids/ablation_TASK.json into OUT/ablation/TASK and writes OUT/ablation.md. A finished
sweep of the same code is kept; an interrupted one is resumed.
"""

import csv
import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.arguments import Parser, run_main
from experiments.figures import runs as figure_runs
from experiments.figures.runs import CODE, ROOT, Failed
from experiments.output import table
from experiments.statistics import format_interval
from qrl.config import load_preset
from qrl.runs import files, record

TASKS = ("pendulum", "hover")
# What each row is. A grid's objective that is not here is an error.
ROWS = {
    "ours": "the paper's choice: condition 4, (π/μ − 1)·A^π ≥ ε|A^π|, A^π by V-trace, replayed trajectories",
    "condition 3": "(π − μ)·A^π in place of the ratio; ε|A| is then a margin of densities, not of ratios",
    "condition 2, V-trace off": "(π/μ − 1)·A^μ: uncorrected returns of replayed trajectories (GAE with λ = 1) in the"
    " updates of policy and critic, as if they were the current policy's; so this is V-trace off, too",
    "condition 1": "(π − μ)·A^μ, from the same uncorrected returns",
    "constant margin": "ξ in place of ε|A|, with ξ = ε: A has a root mean square of 1",
    "PPO": "whole passes over the last unroll, advantages fixed at their start, GAE(0.95), no symmetries",
    "V-trace's clips off": "importance ratios without clipping, ρ̄ and c̄ = 10⁶",
    "no symmetries": "ours, without the augmentation by symmetries (which the paper does not have)",
}


class Row(NamedTuple):
    """One objective on one task: the last report of each seed; one that diverged has return −∞ and success 0."""

    returns: np.ndarray  # [seeds]
    success: np.ndarray  # [seeds], a fraction
    diverged: int


def main(argv: list[str] | None = None) -> int:
    parser = Parser("ablation", __doc__)
    parser.add_argument("--out", type=Path, default=Path("experiments/out"), metavar="FOLDER")
    parser.add_argument("--only", choices=TASKS, help="one task only")
    parser.add_argument("--fresh", action="store_true", help="run the sweeps again")
    args = parser.parse_args(argv)
    parser.check_folder("--out", args.out)
    tasks = [args.only] if args.only else TASKS
    try:
        for task in tasks:
            sweep(grid(task), args.out / "ablation" / task, fresh=args.fresh)
        found = {task: rows(args.out / "ablation" / task) for task in tasks}
        files.replace_text(args.out / "ablation.md", page(found))
    except (OSError, Failed) as error:
        print(f"ablation: {error}", file=sys.stderr)
        return 1
    print(f"{args.out / 'ablation.md'}")
    return 0


def grid(task: str) -> Path:
    return ROOT / "experiments" / "grids" / f"ablation_{task}.json"


def sweep(path: Path, out: Path, *, fresh: bool) -> None:
    """Run the grid's sweep into `out` unless it is there, finished, of this code and these versions."""
    if fresh or not (out / CODE).exists() or (out / CODE).read_text() != stamp(path):
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        (out / CODE).write_text(stamp(path))
    figure_runs.qrl(["sweep", str(path), "--out", str(out)])


def stamp(path: Path) -> str:
    """A hash of all that decides the results of the grid at `path`."""
    versions = {name: version for name, version in record.versions().items() if name not in ("commit", "qrl")}
    deciding = [json.loads(path.read_text()), versions, figure_runs.sha256()]
    return hashlib.sha256(json.dumps(deciding, sort_keys=True).encode()).hexdigest()


def rows(out: Path) -> dict[str, Row]:
    """A row for each objective of a sweep's results.csv, in the grid's order."""
    with (out / "results.csv").open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    found = {}
    for name in dict.fromkeys(line["objective"] for line in lines):
        selected = [line for line in lines if line["objective"] == name]
        diverged = [bool(line["diverged"]) for line in selected]
        returns = [-np.inf if bad else float(line["return_mean"]) for bad, line in zip(diverged, selected, strict=True)]
        success = [
            0.0 if bad else float(line["success"] or "nan") for bad, line in zip(diverged, selected, strict=True)
        ]
        found[name] = Row(np.array(returns), np.array(success), sum(diverged))
    return found


def page(found: dict[str, dict[str, Row]]) -> str:
    """The table as Markdown; `found` maps task -> objective -> row."""
    names = list(dict.fromkeys(name for task in found.values() for name in task))
    heads = [f"{task}: {what}" for task in found for what in ("return", "success, %")]
    cells = [[name, *(cell for task in found.values() for cell in cells_of(task.get(name)))] for name in names]
    lines = ["# The paper's objectives side by side", "", table(["objective", *heads], cells)]
    lines += ["", *(f"- *{name}*: {ROWS[name]}." for name in names), ""]
    for task in found:
        file = json.loads(grid(task).read_text())
        steps = file["fixed"].get("num_timesteps") or load_preset(task)["num_timesteps"]
        seeds, command = file["seeds"], f"qrl sweep experiments/grids/{grid(task).name}"
        lines.append(
            f"{task}: {steps:,} steps, seeds {seeds[0]}–{seeds[-1]}, `{command}`, evaluated from the starts of a run's"
            " reports after the last step."
        )
    versions = ", ".join(f"{name} {version}" for name, version in record.versions().items())
    lines += ["", f"Interquartile mean [its bootstrap interval of 95 %] over seeds. Versions: {versions}.", ""]
    return "\n".join(lines)


def cells_of(row: Row | None) -> tuple[str, str]:
    if row is None:
        return "–", "–"
    diverged = f"; {row.diverged} of {len(row.returns)} diverged" if row.diverged else ""
    return format_interval(row.returns) + diverged, format_interval(100.0 * row.success, ".0f")


if __name__ == "__main__":
    run_main("ablation", main)

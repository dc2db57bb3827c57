"""The numbers of README's tables: docs/results.json, from runs of the shipped presets with seeds 100 to 102.

    .venv/bin/python -m experiments.results [--out FILE] [--runs FOLDER] [--fresh] [--list]
    .venv/bin/python -m experiments.results --check README.md …
    .venv/bin/python -m experiments.results --write README.md …

Each seed is one `qrl train` and one `qrl evaluate` from 1,000 starts; a finished run of the same code is kept.
--check and --write compare or replace the tables between `<!-- results:NAME -->` and `<!-- /results -->`.
"""

import json
import math
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.arguments import Parser, run_main
from experiments.bench.run import machine
from experiments.figures import runs
from experiments.figures.runs import Failed, RunSpec
from experiments.output import table
from qrl import tasks
from qrl.runs import files
from qrl.runs.record import RunConfig
from qrl_envs.specfile import BadInput

RESULTS, RUNS = Path("docs/results.json"), Path("experiments/out/results")
SEEDS = (100, 101, 102)
NO_APG = {"apg_fraction": 0.0, "num_timesteps": 4_500_000}
WITHOUT_APG, WITH_APG = "without APG (the paper's learner, with symmetries)", "with APG"
STEADY = (  # measure, label, factor, format, unit
    ("rms_position_m", "", 1e3, ".1f", " mm"),
    ("rms_radius_m", "radius ", 1e3, ".1f", " mm"),
    ("rms_height_m", "height ", 1e3, ".1f", " mm"),
    ("rms_speed_m_s", "speed ", 1.0, ".3f", " m/s"),
)
MARKED = re.compile(r"(<!-- results:(\w+) -->\n)(.*?)(<!-- /results -->)", re.DOTALL)


class Row(NamedTuple):
    """One row of the tables: a task's preset, as shipped or with `flags`."""

    task: str
    method: str
    flags: dict[str, Any]

    def run(self, seed: int) -> RunSpec:
        return RunSpec(f"{self.task}{'-paper' * bool(self.flags)}/{seed}", self.task, self.task, self.flags, seed=seed)


ROWS = (
    Row("hover", WITHOUT_APG, NO_APG),
    Row("hover", WITH_APG, {}),
    Row("circle", WITHOUT_APG, NO_APG),
    Row("circle", WITH_APG, {}),
    Row("pendulum", WITHOUT_APG, {}),  # its preset has no APG
)


def main(argv: list[str] | None = None) -> int:
    parser = Parser("results", __doc__)
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"file of the results ({RESULTS})", metavar="FILE")
    parser.add_argument("--runs", type=Path, default=RUNS, help=f"folder of the runs ({RUNS})", metavar="FOLDER")
    parser.add_argument("--fresh", action="store_true", help="train all runs again")
    parser.add_argument("--list", action="store_true", help="print the commands and exit")
    parser.add_argument("--check", type=Path, nargs="+", help="exit with 1 if a table differs", metavar="FILE")
    parser.add_argument("--write", type=Path, nargs="+", help="replace the tables", metavar="FILE")
    args = parser.parse_args(argv)
    try:
        if args.list:
            print("\n".join(f"qrl {' '.join(row.run(seed).words)}" for row in ROWS for seed in SEEDS))
        elif args.check or args.write:
            return fill([*(args.check or ()), *(args.write or ())], tables(args.out), write=bool(args.write))
        else:
            files.write_json(args.out, measure(args.runs, fresh=args.fresh))
            print(f"results: {args.out}", flush=True)
    except (OSError, ValueError, Failed, BadInput) as error:
        print(f"results: {error}", file=sys.stderr)
        return 1
    return 0


# Measure


def measure(folder: Path, *, fresh: bool) -> dict[str, Any]:
    """Train what is not current, evaluate all, and return what docs/results.json holds."""
    here = {name: value for name, value in machine().items() if name in ("CPU", "cores")}
    found: dict[str, Any] = {"machine": here, "seeds": list(SEEDS), "rows": [], "baselines": {}}
    for row in ROWS:
        evaluations, seconds, configs = [], [], []
        for seed in SEEDS:
            out = folder / row.run(seed).name
            seconds.append(train(row.run(seed), out, fresh=fresh))
            runs.qrl(["evaluate", str(out)])
            evaluations.append(json.loads((out / "evaluation.json").read_text(encoding="utf-8")))
            configs.append(tasks.load_run_config(out))
            if (commit := configs[-1].versions["commit"]).endswith("+"):
                print(f"results: warning: {out}: trained by changed files of commit {commit}", file=sys.stderr)
        found["rows"].append(summary(row, evaluations, seconds, configs))
        found["starts"] = evaluations[0]["starts"]
        if "baselines" in evaluations[0]:
            found["baselines"][row.task] = evaluations[0]["baselines"]
    return found


def train(run: RunSpec, out: Path, *, fresh: bool) -> float:
    """Train unless the run is current; the wall seconds of the command, with an empty compile cache."""
    seconds, cache = out / "command_seconds", out.with_name(f"{out.name}-cache")
    if fresh or not seconds.exists() or not runs.is_current(out, run.config()):
        shutil.rmtree(out, ignore_errors=True)
        print(f"results: qrl {' '.join(run.words)}", flush=True)
        took = runs.train(run, out, {"JAX_COMPILATION_CACHE_DIR": str(cache.absolute())})
        shutil.rmtree(cache, ignore_errors=True)
        files.replace_text(seconds, f"{took:.1f}\n")
    return float(seconds.read_text())


def summary(
    row: Row, evaluations: list[dict[str, Any]], seconds: list[float], configs: list[RunConfig]
) -> dict[str, Any]:
    """A row of docs/results.json: each measure's median and worst over seeds; versions and devices of the runs."""
    measures = [name for name in evaluations[0] if name.startswith(("return_", "success", "settle_", "rms_"))]
    return {
        "task": row.task,
        "method": row.method,
        "command": f"qrl {' '.join(row.run(SEEDS[0]).words)}",
        "preset": row.task,
        "versions": joined([config.versions for config in configs]),
        "devices": " or ".join(sorted({", ".join(config.devices) for config in configs})),
        "steps": evaluations[0]["env_steps"],
        "command_seconds": spread("command_seconds", seconds),
        **{name: spread(name, [each[name] for each in evaluations]) for name in measures},
    }


def joined(versions: list[dict[str, str]]) -> dict[str, str]:
    """The version of each package, or all of them where runs differ."""
    names = dict.fromkeys(name for each in versions for name in each)
    return {name: " or ".join(sorted({each.get(name, "none") for each in versions})) for name in names}


def spread(name: str, values: Sequence[float | None]) -> dict[str, float | None]:
    """Median and worst; null is infinitely bad (a settle time) or not measured by the task."""
    worst = min if name.startswith(("return_", "success")) else max
    bad = -math.inf if worst is min else math.inf
    numbers = [bad if value is None else value for value in values]
    return {
        key: x if math.isfinite(x) else None
        for key, x in (("median", float(np.median(numbers))), ("worst", worst(numbers)))
    }


# Tables


def tables(path: Path = RESULTS) -> dict[str, str]:
    """The Markdown tables of docs/results.json by name: `summary` (the worst seed of each row) and `controllers`."""
    found = json.loads(path.read_text(encoding="utf-8"))
    summaries = [
        [row["task"], row["method"], f"{row['steps'] / 1e6:.1f}M", *cells(worst(row))] for row in found["rows"]
    ]
    controllers = [
        [task, name, *cells(measures)]
        for task, baselines in found["baselines"].items()
        for name, measures in baselines.items()
    ]
    heads = ["return", "success", "settle, median", "settle, p95", "steady state"]
    return {
        "summary": table(["task", "method", "steps", *heads], summaries),
        "controllers": table(["task", "controller", *heads], controllers),
    }


def worst(row: dict[str, Any]) -> dict[str, float | None]:
    return {name: value["worst"] for name, value in row.items() if isinstance(value, dict) and "worst" in value}


def cells(measures: dict[str, float | None]) -> list[str]:
    """Return, success, settle times and steady-state errors."""

    def cell(name: str, factor: float, form: str, unit: str) -> str:
        value = measures.get(name)
        if value is None:
            return "never" if name.startswith("settle") and name in measures else "–"
        return f"{factor * value:{form}}{unit}"

    steady = [label + cell(name, factor, form, unit) for name, label, factor, form, unit in STEADY if name in measures]
    return [
        cell("return_mean", 1.0, ".1f", ""),
        cell("success", 100.0, ".1f", " %"),
        cell("settle_median_s", 1.0, ".2f", " s"),
        cell("settle_p95_s", 1.0, ".2f", " s"),
        ", ".join(steady) or "–",
    ]


def fill(paths: list[Path], expected: dict[str, str], *, write: bool) -> int:
    """Compare the marked tables of files with `expected`, or replace them; 1 if one differs."""
    differ = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        for _, name, body, _ in MARKED.findall(text):
            if name not in expected:
                raise ValueError(f"{path}: no table '{name}' (known: {', '.join(expected)})")
            if body.strip() != expected[name] and not write:
                print(f"results: {path}: table '{name}' differs from docs/results.json", file=sys.stderr)
                differ = 1
        if write:
            files.replace_text(path, MARKED.sub(lambda match: f"{match[1]}{expected[match[2]]}\n{match[4]}", text))
    return differ


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    run_main("results", main)

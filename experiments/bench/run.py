"""Timings of qrl beside other trainers and simulators, one at a time: `make bench`.

    .venv/bin/python -m experiments.bench.run [--out experiments/out/bench] [--only pendulum hover/qrl …] [--seeds 5]
                                          [--budget-seconds 150] [--fresh] [--list]
                                          [--starts 10] [--runs crazyflie=runs/hover_crazyflie …]

Seed by seed, all contestants of a seed before the next one, each run a process of its own. Finished runs are kept in
OUT/runs (unless --fresh); an interrupted benchmark is resumed. Writes bench.json (every run), bench.md (tables) and
bench.png (ratios). Each baseline has a virtual environment of its own; one that cannot be installed is reported and
skipped. The group `judges` is no timing: `experiments.bench.judges`.
"""

import argparse
import hashlib
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

from experiments.arguments import Parser, run_main
from experiments.bench.contestants import CONTESTANTS, JUDGES, Contestant, chosen, key
from experiments.bench.install import NotInstalled, fingerprint, python_of
from experiments.bench.judges import VEHICLES, judge
from experiments.bench.plot import plot
from experiments.bench.process import OUT_OF_TIME, run_with_timeout
from experiments.bench.tables import Run, page
from experiments.figures import runs as figure_runs
from qrl.config import load_preset, preset_names
from qrl.runs import files
from qrl.runs import record as records

ROOT = Path(__file__).resolve().parents[2]
BASELINES = ROOT / "experiments" / "baselines"
GRACE_SECONDS = 120.0  # beyond a run's budget, for its checks
MARK = "BENCH "  # prefix of a result line
FIRST_SEED = 100  # none that presets were tuned on
FINISHED = ("done", OUT_OF_TIME)


def main(argv: list[str] | None = None) -> int:
    parser = Parser("bench", __doc__)
    parser.add_argument("--out", type=Path, default=Path("experiments/out/bench"), metavar="FOLDER")
    parser.add_argument("--environments", type=Path, default=Path("experiments/out/baselines"), metavar="FOLDER")
    parser.add_argument(
        "--only", nargs="+", default=[], help="groups or contestants, as --list has them", metavar="NAME"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N")
    parser.add_argument("--budget-seconds", type=float, default=150.0, help="time limit of one run", metavar="S")
    parser.add_argument("--starts", type=int, default=10, help="flights a cell of the judges", metavar="N")
    parser.add_argument("--task", choices=("hover", "track", "any"), default="hover", help="of the judges' policies")
    parser.add_argument(
        "--runs",
        nargs="+",
        default=[],
        metavar="VEHICLE=FOLDER",
        help="policies for the judges, in place of training them",
    )
    parser.add_argument("--fresh", action="store_true", help="repeat finished runs")
    parser.add_argument("--list", action="store_true", help="print the contestants and exit")
    args = parser.parse_args(argv)
    if args.list:
        print("\n".join(key(contestant) for contestant in CONTESTANTS))
        return 0
    if args.seeds < 1 or not args.budget_seconds > 0:
        parser.error("expected --seeds of at least 1 and --budget-seconds above 0")
    parser.check_folder("--out", args.out)
    args.runs = dict(word.split("=", 1) if "=" in word else (word, "") for word in args.runs)
    for vehicle, run in args.runs.items():
        if vehicle not in VEHICLES.values() or not (Path(run) / "config.json").exists():
            known = ", ".join(VEHICLES.values())
            parser.error(f"--runs: expected VEHICLE=FOLDER, a run folder of {known}, found '{vehicle}={run}'")
    if args.starts < 1:
        parser.error("expected --starts of at least 1")
    try:
        contestants = chosen(args.only)
    except ValueError as error:
        parser.error(str(error))
    try:
        bench(contestants, args)
    except OSError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    return 0


def bench(contestants: list[Contestant], args: argparse.Namespace) -> None:
    """Run what is missing or stale; write the three files after each seed."""
    folder = args.out / "runs"
    folder.mkdir(parents=True, exist_ok=True)
    pythons, absent = installed(contestants, BASELINES, args.environments)
    timed = [contestant for contestant in contestants if contestant.group != JUDGES]
    for seed in range(FIRST_SEED, FIRST_SEED + (args.seeds if timed else 0)):
        for contestant in timed:
            path = folder / f"{key(contestant).replace('/', '-')}-{seed}.json"
            if contestant.environment in pythons and (
                args.fresh or not is_current(path, contestant, args.budget_seconds)
            ):
                run = run_contestant(
                    contestant, pythons[contestant.environment], seed, args.budget_seconds, args.out / "cache"
                )
                print_run(run)
                files.replace_text(path, json.dumps(run, indent=1) + "\n")
        runs = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
        write_report(args.out, in_order(runs), absent)
    if timed:
        print(f"{args.out}/bench.json, bench.md, bench.png")
    if judges := [contestant for contestant in contestants if contestant.group == JUDGES]:
        runs = {vehicle: Path(run) for vehicle, run in args.runs.items()}
        judge(judges, pythons, args.out, args.starts, runs, args.fresh, args.task)


def installed(
    contestants: list[Contestant], requirements: Path, folder: Path
) -> tuple[dict[str | None, Path], dict[str, str]]:
    """The interpreter of each environment, and the error of each that cannot be installed."""
    pythons: dict[str | None, Path] = {None: Path(sys.executable)}
    absent: dict[str, str] = {}
    for name in dict.fromkeys(c.environment for c in contestants if c.environment):
        print(f"environment {name}", flush=True)
        try:
            pythons[name] = python_of(requirements / f"{name}.txt", (folder / name).absolute())
        except NotInstalled as error:
            absent[name] = str(error)
            print(f"{name}: not installed, and skipped: {error}", flush=True)
    return pythons, absent


def is_current(path: Path, contestant: Contestant, budget_seconds: float) -> bool:
    """Whether this run is there, did not fail, and is of this machine, these versions and, for qrl, this code.

    The commit may differ; the page lists it.
    """
    if not path.exists():
        return False
    run = json.loads(path.read_text())
    same = run["command"] == command(contestant) and run["budget_seconds"] == budget_seconds
    return same and run.get("fingerprint") == run_fingerprint(contestant) and run["outcome"] in FINISHED


def command(contestant: Contestant) -> list[str]:
    return [contestant.script, *contestant.words]


def run_fingerprint(contestant: Contestant) -> dict[str, Any]:
    """What decides whether a run is current: machine and versions; for qrl the code that trains and its presets, for
    others their requirements."""
    here = {name: value for name, value in machine().items() if name != "commit"}
    if contestant.environment is None:
        presets = json.dumps([load_preset(name) for name in preset_names()])
        rates = ROOT / "experiments" / "profiling" / "throughput.py"  # what other scripts run
        scripts = [BASELINES / contestant.script, rates, ROOT / "src" / "qrl" / "training" / "devices.py"]
        parts = [figure_runs.sha256(), presets, f"{contestant.devices}", *(path.read_text() for path in scripts)]
        return here | {"code": hashlib.sha256(json.dumps(parts).encode()).hexdigest()}
    return here | {"requirements": fingerprint(BASELINES / f"{contestant.environment}.txt")}


def run_contestant(contestant: Contestant, python: Path, seed: int, budget_seconds: float, cache: Path) -> Run:
    """One run in its own process group, killed at the end of its budget.

    The compile cache is empty, except for rates, which exclude compilation and may use `cache`.
    """
    env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PJRT_", "NPROC", "PYTHON"))}
    env |= {
        "BENCH_SPAWNED": str(time.time()),
        "BENCH_BUDGET_SECONDS": str(budget_seconds),
        "JAX_PLATFORMS": "cpu",
        "PYTHONNOUSERSITE": "1",
        "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT / 'envs'}",
    }
    if contestant.devices:
        env["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={contestant.devices}"
    if contestant.group == "speed":
        env["JAX_COMPILATION_CACHE_DIR"] = str(cache.absolute())
    load = round(os.getloadavg()[0], 2)  # other work on the machine
    script = [str(python), str(BASELINES / contestant.script), *contestant.words, "--seed", str(seed)]
    out, err, outcome = run_with_timeout(script, env, budget_seconds + GRACE_SECONDS)
    lines = [json.loads(line.removeprefix(MARK)) for line in out.splitlines() if line.startswith(MARK)]
    error = (err.strip().splitlines() or [""])[-1][:300] if outcome.startswith("exit") else ""
    identity = {"contestant": contestant.name, "group": contestant.group, "seed": seed}
    origin = {
        "command": command(contestant),
        "budget_seconds": budget_seconds,
        "commit": records.commit(),
        "load": load,
    }
    origin["fingerprint"] = run_fingerprint(contestant)
    return {**identity, **origin, "outcome": outcome, "error": error, "lines": lines}


def print_run(run: Run) -> None:
    last = {k: round(v, 3) if isinstance(v, float) else v for k, v in (run["lines"] or [{}])[-1].items()}
    print(
        f"{run['group']}/{run['contestant']}, seed {run['seed']}: {run['outcome']} {run['error']} {last}",
        flush=True,
    )


def in_order(runs: list[Run]) -> list[Run]:
    """In the order of CONTESTANTS, without runs of former contestants."""
    order = {(c.group, c.name): i for i, c in enumerate(CONTESTANTS)}
    known = [run for run in runs if (run["group"], run["contestant"]) in order]
    return sorted(known, key=lambda run: (order[run["group"], run["contestant"]], run["seed"]))


def write_report(out: Path, runs: list[Run], absent: dict[str, str]) -> None:
    """Write bench.json, bench.md and bench.png."""
    here = machine()
    files.replace_text(
        out / "bench.json", json.dumps({"machine": here, "absent": absent, "runs": runs}, indent=1) + "\n"
    )
    files.replace_text(out / "bench.md", page(runs, absent, here))
    plot(out / "bench.png", runs)


def machine() -> dict[str, Any]:
    """The machine of the figures."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    kept = ("qrl", "commit", "jax", "brax")
    versions = {name: value for name, value in records.versions().items() if name in kept}
    return {"CPU": model, "cores": cores, "Python": platform.python_version(), **versions}


if __name__ == "__main__":
    run_main("bench", main)

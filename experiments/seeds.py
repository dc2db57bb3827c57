"""Many seeds of one task, each a `qrl train` of its own on a core of its own: how many fly, how soon, how alike.

    .venv/bin/python -m experiments.seeds TASK [--seeds 100] [--first 100] [--out FOLDER] [flags of `qrl train`]

Leaves OUT/NNN, the run folder of seed NNN; seeds.csv, a row a seed, failed ones too; summary.json and seeds.png. Each
policy flies the 1,000 starts of `qrl evaluate`. The same command resumes; what is finished is kept.
"""

import json
import math
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any

from experiments.arguments import Parser, run_main
from experiments.figures import runs
from experiments.seeds_report import FINISHED, FLIES, UNFINISHED, Row, name, report
from qrl import tasks
from qrl.algorithm.flights import summarize
from qrl.cli.arguments import count, whole_number
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.evaluation.starts import STARTS, evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import files
from qrl_envs.specfile import BadInput

QRL = (sys.executable, "-m", "qrl")
ONE_CORE = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "1", "PJRT_NPROC": "1"}
MEASURES = ("success", "return_mean", "settle_", "rms_")  # of evaluation.json, by how they begin


def main(argv: list[str] | None = None) -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser = Parser("seeds", __doc__)
    parser.add_argument("task", metavar="TASK", help="as of `qrl train`")
    parser.add_argument("--seeds", type=count, default=100, help="how many (100)", metavar="N")
    parser.add_argument("--first", type=whole_number, default=100, help="the first seed (100)", metavar="N")
    parser.add_argument("--out", type=Path, help="folder of all (runs/seeds_TASK)", metavar="FOLDER")
    parser.add_argument("--jobs", type=count, default=cores, help=f"runs side by side (all cores: {cores})")
    parser.add_argument("--retry", action="store_true", help="resume seeds whose training failed, too")
    args, flags = parser.parse_known_args(argv)
    if any(word.split("=")[0] == "--seed" for word in flags):
        parser.error("--seed: expected --first, the first of all seeds (FIRST=)")
    try:
        task = tasks.task_record(args.task)
        out = args.out or Path("runs") / f"seeds_{tasks.folder_name(task)}"
        parser.check_folder("--out", out)
        out.mkdir(parents=True, exist_ok=True)
        with files.locked(out / "lock", f"{out}: in use by another process"):
            begin(out, {"task": task.model_dump(mode="json"), "flags": flags, "code": runs.sha256()})
            rows = {seed: {"seed": seed, "status": UNFINISHED} for seed in range(args.first, args.first + args.seeds)}
            try:
                run(rows, out, [args.task, *flags], args.jobs, retry=args.retry)
            finally:
                report(list(rows.values()), out, f"{tasks.folder_name(task)} {shlex.join(flags)}".strip())
    except (BadInput, OSError) as error:
        print(f"seeds: {error}", file=sys.stderr)
        return WRONG_INPUT if isinstance(error, BadInput) else FAILED
    return DONE if all(row["status"] == FINISHED for row in rows.values()) else FAILED


def begin(out: Path, campaign: dict[str, Any]) -> None:
    """Write down what all runs in `out` have in common; BadInput if there are runs that differ in it."""
    path = out / "campaign.json"
    if any(out.glob("*/config.json")) and (not path.exists() or json.loads(path.read_text()) != campaign):
        raise BadInput(f"{out}: holds runs of another task, of other flags or of other code; give another OUT")
    files.write_json(path, campaign)


# Run


def run(rows: dict[int, Row], out: Path, words: list[str], jobs: int, *, retry: bool) -> None:
    """Train and evaluate what is not, and keep `rows` and seeds.csv up to date; BadInput if `qrl train` says so."""
    programs: list[FlightPrograms] = []

    def ended(seed: int, status: str) -> None:
        try:
            rows[seed] = row(seed, status, out / name(seed), programs)
        except (BadInput, OSError) as error:
            rows[seed] = {"seed": seed, "status": f"not evaluated: {error}"}
        files.replace_text(out / "seeds.csv", files.csv_text(list(rows.values())))
        flies = f", success {100 * rows[seed]['success']:.1f} %" if "success" in rows[seed] else ""
        left = sum(each["status"] == UNFINISHED for each in rows.values())
        print(f"seeds: {seed}: {rows[seed]['status']}{flies}; {len(rows) - left} of {len(rows)}", flush=True)

    for folder, seed in [(out / name(seed), seed) for seed in rows]:
        if (folder / "summary.json").exists():
            ended(seed, FINISHED)
        elif (folder / "failed.txt").exists() and not retry:
            ended(seed, (folder / "failed.txt").read_text())
    waiting = [seed for seed in rows if rows[seed]["status"] == UNFINISHED]
    with closing(train(waiting, out, words, jobs)) as processes:
        for seed, code in processes:
            log = out / name(seed) / "log.txt"
            said = [line for line in log.read_text().splitlines() if line.startswith("qrl: ")] or [f"see {log}"]
            if code == WRONG_INPUT:
                raise BadInput(said[-1].removeprefix("qrl: "))
            if code:
                files.replace_text(log.with_name("failed.txt"), f"failed with exit code {code}: {said[-1]}")
            ended(seed, f"failed with exit code {code}: {said[-1]}" if code else FINISHED)


def train(waiting: list[int], out: Path, words: list[str], jobs: int) -> Generator[tuple[int, int], None, None]:
    """Train `jobs` seeds at a time; yields a seed and its exit code as it ends. To close it saves and ends the rest."""
    running: dict[int, subprocess.Popen[Any]] = {}
    env = runs.environment() | ONE_CORE
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                seed, *waiting = waiting
                folder = out / name(seed)
                folder.mkdir(exist_ok=True)
                command = ["train", *words, "--seed", str(seed), "--out", str(folder)]
                command += ["--resume"] * (folder / "config.json").exists()
                with (folder / "log.txt").open("a") as log:
                    print(f"$ qrl {shlex.join(command)}", file=log, flush=True)
                    streams: Any = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log}
                    # In a session of its own, so that Ctrl-C reaches it once: through us.
                    running[seed] = subprocess.Popen([*QRL, *command], env=env, start_new_session=True, **streams)
            time.sleep(0.1)
            for seed in [seed for seed, process in running.items() if process.poll() is not None]:
                yield seed, running.pop(seed).returncode
    finally:
        for process in running.values():
            process.terminate()  # it saves, and then ends
        for process in running.values():
            process.wait()


def row(seed: int, status: str, folder: Path, programs: list[FlightPrograms]) -> Row:
    """A row of seeds.csv. A settle time that is null is infinite; a resumed command has no time of the whole."""
    found: Row = {"seed": seed, "status": status}
    reports = files.read_metrics(folder)
    if status == FINISHED:
        for key, value in evaluate(folder, programs).items():
            if key.startswith(MEASURES):
                found[key] = value if value is not None else math.inf if key.startswith("settle_") else math.nan
        log, summary = folder / "log.txt", json.loads((folder / "summary.json").read_text())
        resumed = log.exists() and " --resume" in log.read_text()
        found["train_seconds"] = reports[-1]["train_seconds"]
        found["command_seconds"] = math.nan if resumed else summary["command_seconds"]
    return found | {"steps_until_it_flies": flies_from(reports)}


def evaluate(folder: Path, programs: list[FlightPrograms]) -> dict[str, Any]:
    """evaluation.json, once the evaluation's starts are flown; `programs` holds those of the seeds before, or none."""
    path = folder / "evaluation.json"
    if not path.exists() or json.loads(path.read_text())["starts"] != STARTS:
        config = tasks.load_run_config(folder)
        programs[:] = programs or [FlightPrograms(tasks.environment(config.task), config.learner)]
        trained = TrainedRun.load(folder, programs=programs[0])
        found = {"seed": config.seed, "starts": STARTS, "env_steps": trained.env_steps}
        files.write_json(path, found | summarize(trained.fly(evaluation_starts())))
    return json.loads(path.read_text())


def flies_from(reports: list[files.Row]) -> float:
    """Environment steps of the first report from which success stays at FLIES or more; infinite if there is none."""
    if reports and all(math.isnan(each["success"]) for each in reports):
        return math.nan  # not measured
    found = math.inf
    for each in reports:
        found = min(found, each["env_steps"]) if each["success"] >= FLIES else math.inf
    return found


if __name__ == "__main__":
    os.environ.update(ONE_CORE)
    configure_jax()
    run_main("seeds", main)

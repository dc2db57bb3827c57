"""`qrl view`: flights of a run's policies as one self-contained HTML page."""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qrl import tasks
from qrl.cli.export import fly_kernel, integer_kernel
from qrl.cli.terminal import DONE, console
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.evaluation.starts import STARTS, evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import files, record
from qrl_envs import viewer
from qrl_envs.specfile import BadInput
from qrl_envs.viewer import Recording

SHOWN = 8  # flights by default
FAILURES = 6  # of these, at most, from starts that failed in the last evaluation
MOST = 50  # flights per page
LANES = 8  # the number of starts is a multiple, so that few numbers of starts are compiled for


def view(args: argparse.Namespace) -> int:
    """Fly a few starts of `qrl evaluate` with every seed of a run; write view.html to each folder."""
    config = tasks.load_run_config(args.run)
    config = config.model_copy(update={"task": tasks.following(config.task, args.reference, args.vehicle)})
    if not config.task.spec:
        raise BadInput(
            f"{args.run}: expected a run of one of our own tasks, found another environment, '{config.task.name}'"
        )
    folders = record.member_folders(args.run, config)
    if args.out and len(folders) > 1:
        raise BadInput(f"{args.run}: --out: holds {config.seeds} seeds; name one of them, such as {folders[0]}")
    if args.out:
        files.check_output(args.out, "--out")
    requested = _requested(args.starts) if args.starts else None
    task = tasks.spec(config.task)
    programs = FlightPrograms(tasks.environment(config.task), config.learner)
    for folder in folders:
        run, starts = TrainedRun.load(folder, programs=programs), requested or _varied(folder)
        padded = np.resize(starts, -(-len(starts) // LANES) * LANES)
        flights = run.fly(evaluation_starts()[padded])
        observations, actions = (np.asarray(x[: len(starts)]) for x in (flights.observations, flights.actions))
        flown = "".join(f", {given}" for given in (args.vehicle, args.reference) if given is not None)
        title = f"{config.task.name}{flown}, seed {run.config.seed}, step {run.env_steps:,}"
        beside = _kernel_observations(folder, run, padded)[: len(starts)] if args.kernel else None
        page = viewer.page(task, title, Recording(starts, observations, actions, beside))
        path = args.out or folder / "view.html"
        files.replace_text(path, page)
        console.print(f"{path}: {len(starts)} flights, {len(page.encode()) / 1e6:.1f} MB; open it in a browser")
    return DONE


def _kernel_observations(folder: Path, run: TrainedRun, starts: NDArray[np.integer]) -> NDArray[np.floating]:
    """The observations of its exported kernel's flights; [n, K + 1, F].

    Its numbers are those of `qrl export`, also where another vehicle or reference is flown here.
    """
    own = TrainedRun.load(folder)
    policy = own.policy()
    flights = fly_kernel(run, policy, integer_kernel(own, policy), evaluation_starts()[starts])
    return np.asarray(flights.observations)


def _requested(starts: list[int]) -> list[int]:
    if max(starts) >= STARTS:
        raise BadInput(f"--starts: expected indices below {STARTS:,}, found {max(starts)}")
    unique = list(dict.fromkeys(starts))
    if len(unique) > MOST:
        raise BadInput(f"--starts: expected at most {MOST} of them, found {len(unique)}")
    return unique


def _varied(folder: Path) -> list[int]:
    """Starts that failed in the last `qrl evaluate`, if any, then the first ones."""
    try:
        found = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))["failures"]
        failed = [start for each in found if 0 <= (start := int(each["start"])) < STARTS]
    except (OSError, ValueError, TypeError, KeyError):  # not evaluated, or by another version
        failed = []
    return list(dict.fromkeys([*failed[:FAILURES], *range(STARTS)]))[:SHOWN]

"""`qrl view`: a few flights of a run's policies as one HTML page to open from disk."""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

from qrl import tasks
from qrl.algorithm.flights import Flights
from qrl.cli.terminal import DONE, console
from qrl.evaluation.trained_run import EVALUATION_STARTS_SEED, STARTS
from qrl.runs import files, record
from qrl.runs.record import RunConfig
from qrl.training import restore
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer
from qrl_envs import viewer
from qrl_envs.specfile import BadInput
from qrl_envs.viewer import Recording

SHOWN = 8  # unless asked for others
FAILURES = 6  # of them, at most, that are known to fail
MOST = 50  # what a page can hold
LANES = 8  # starts are flown in multiples of so many: one compiled program serves any few


def view(args: argparse.Namespace) -> int:
    """Fly a few starts of `qrl evaluate` with every seed of a run; leave view.html in each folder."""
    config = tasks.load_run_config(args.run)
    if not config.task.spec:
        raise BadInput(f"{args.run}: expected a run of one of our own tasks, found Brax's '{config.task.name}'")
    folders = record.member_folders(args.run, config)
    if args.out and len(folders) > 1:
        raise BadInput(f"{args.run}: --out: holds {config.seeds} seeds; name one of them, such as {folders[0]}")
    asked = _asked(args.starts) if args.starts else None
    task = tasks.spec(config.task)
    trainer = make_trainer(tasks.environment(config.task), config.learner)
    for i, folder in enumerate(folders):
        member, starts = config.member(i), asked or _varied(folder)
        env_steps, flights = _flown(trainer, member, folder, starts)
        title = f"{member.task.name}, seed {member.seed}, step {env_steps:,}"
        recording = Recording(starts, np.asarray(flights.observations), np.asarray(flights.actions))
        page = viewer.page(task, title, recording)
        path = args.out or folder / "view.html"
        files.replace_text(path, page)
        console.print(f"{path}: {len(starts)} flights, {len(page.encode()) / 1e6:.1f} MB; open it in a browser")
    return DONE


def _asked(starts: list[int]) -> list[int]:
    """The starts asked for, each once."""
    if max(starts) >= STARTS:
        raise BadInput(f"--starts: expected indices below {STARTS:,}, found {max(starts)}")
    once = list(dict.fromkeys(starts))
    if len(once) > MOST:
        raise BadInput(f"--starts: expected at most {MOST} of them, found {len(once)}")
    return once


def _varied(folder: Path) -> list[int]:
    """Some that `qrl evaluate` found to fail, if it did, and then the first ones."""
    try:
        found = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))["failures"]
        failed = [start for each in found if 0 <= (start := int(each["start"])) < STARTS]
    except (OSError, ValueError, TypeError, KeyError):  # not evaluated, or by another version
        failed = []
    return list(dict.fromkeys([*failed[:FAILURES], *range(STARTS)]))[:SHOWN]


def _flown(trainer: Trainer, config: RunConfig, folder: Path, starts: list[int]) -> tuple[int, Flights]:
    """Environment steps of a seed's last checkpoint, and its flights in NumPy; leading axis: starts."""
    keys = jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), STARTS)
    even = np.resize(starts, -(-len(starts) // LANES) * LANES)
    points = stack([member_inputs(trainer.setup.env, config.learner)])
    try:
        learner, env_steps = next(restore.iter_learners(trainer.setup.spec, config, folder, 1))
    except OSError as error:
        raise BadInput(str(error)) from None
    flights = trainer.fly(learner, points, keys[even])
    return env_steps, jax.tree.map(lambda x: np.asarray(x[0])[: len(starts)], flights)

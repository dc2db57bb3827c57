"""`qrl evaluate`: a run's policies flown from fresh starts, beside classical controllers and other runs."""

import argparse
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from qrl import tasks
from qrl.algorithm.flights import Flights, summarize
from qrl.algorithm.learner import LearnerState
from qrl.cli import tables
from qrl.cli.terminal import DONE, console
from qrl.evaluation.baselines import CONTROLLERS, NOMINAL, Baselines, Policies, Worlds
from qrl.evaluation.trained_run import EVALUATION_STARTS_SEED
from qrl.runs import checkpoint, files, record
from qrl.runs.record import RunConfig
from qrl.training import restore
from qrl_envs import measures
from qrl_envs.perturbations import Condition, OffNominal, conditions
from qrl_envs.plots import errors, settle
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask, Task

MOST_FAILURES = 50  # that evaluation.json lists


class Run(NamedTuple):
    """A run folder, and who flies its policies."""

    folder: Path
    config: RunConfig
    policies: Policies


@dataclass(frozen=True)
class Flown:
    """What was flown beside a policy: what evaluation.json says of it, and its nominal flights."""

    baselines: dict[str, dict[str, Any]]
    beside: dict[str, dict[str, Any]]
    flights: dict[str, Flights]  # of all of these, by name


def evaluate(args: argparse.Namespace) -> int:
    """Fly every seed of a run from fresh starts; print a table, leave evaluation.json and plots in each folder."""
    config = tasks.load_run_config(args.run)
    others = [(folder, _of_same_task(folder, args.run, config)) for folder in dict.fromkeys(args.beside)]
    task = tasks.spec(config.task) if config.task.spec else None
    named = _conditions(args.run, config, task) if args.off_nominal else {}
    worlds = Worlds(
        nominal=tasks.environment(config.task),
        off_nominal={name: OffNominal(task, condition) for name, condition in named.items()}  # pyright: ignore[reportArgumentType]
        if named
        else {},
        starts=jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), args.starts),
    )
    with ThreadPoolExecutor() as aside:
        run = Run(args.run, config, Policies(worlds, config.learner, aside))
        others = [Run(folder, other, Policies(worlds, other.learner, aside)) for folder, other in others]
        baselines = Baselines(worlds, task, aside) if isinstance(task, QuadrotorTask) else None
        results = [_evaluated(run, i, args.checkpoints, task) for i in range(config.seeds)]
        flown = _flown(baselines, others)
    table = [{**result, **_beside(flown)} for result, _ in results]
    for folder, result, (_, flights) in zip(record.member_folders(args.run, config), table, results, strict=True):
        files.write_json(folder / "evaluation.json", result)
        if task:
            _draw(folder, task, flights, flown)
    if config.seeds > 1:
        files.write_json(args.run / "evaluation.json", table)
    console.print(f"{config.task.name}: {args.starts:,} fresh starts, deterministic policy")
    _print(table, flown, named)
    for name in CONTROLLERS if baselines else ():
        if name not in flown.baselines:
            console.print(f"{name}: there is none for this vehicle")
    return DONE


def _conditions(folder: Path, config: RunConfig, task: Task | None) -> dict[str, Condition]:
    """The off-nominal conditions of a run's task."""
    if not isinstance(task, QuadrotorTask):
        raise BadInput(
            f"{folder}: --off-nominal: expected a run of hover, circle or another quadrotor, found '{config.task.name}'"
        )
    return conditions(task)


def _of_same_task(folder: Path, run: Path, config: RunConfig) -> RunConfig:
    """The run in `folder`, if what it flies and how that is judged are as in `run`, whatever it trained on."""
    other = tasks.load_run_config(folder)
    if other.task.name != config.task.name or _judged(other) != _judged(config):
        raise BadInput(
            f"{folder}: --beside: expected a run of the same task as {run}, '{config.task.name}', found one of"
            f" '{other.task.name}'{' that differs' if other.task.name == config.task.name else ''}"
        )
    for member in record.member_folders(folder, other):
        if not checkpoint.saved_steps(member):
            raise BadInput(f"{member}: --beside: no checkpoint")
    return other


def _judged(config: RunConfig) -> dict[str, Any]:
    """What of a task all pilots share; how it trained, and by what name, is each run's own."""
    own = ("description", "preset", "start", "envelope", "episode_steps", "reward")
    return {key: value for key, value in (config.task.spec or {}).items() if key not in own}


def _saved(run: Run, seed: int, most: int) -> Iterator[tuple[LearnerState, int]]:
    """Learner and environment steps of a seed's checkpoints, newest first."""
    folder = record.member_folders(run.folder, run.config)[seed]
    try:
        yield from restore.iter_learners(run.policies.trainer.setup.spec, run.config.member(seed), folder, most)
    except OSError as error:
        raise BadInput(str(error)) from None


def _evaluated(run: Run, seed: int, most: int, task: Task | None) -> tuple[dict[str, Any], Flights]:
    """What evaluation.json says of one seed, and the nominal flights of its last checkpoint."""
    saved = _saved(run, seed, most)
    learner, env_steps = next(saved)
    flights = run.policies.fly(learner)
    last = {"env_steps": env_steps, **summarize(flights)}
    earlier = [{"env_steps": steps, **summarize(run.policies.fly(learner))} for learner, steps in saved]
    result: dict[str, Any] = {"seed": run.config.seed + seed, "starts": len(flights.returns), **last}
    if task:
        success, observations = np.asarray(flights.measures["success"]), np.asarray(flights.observations)
        result["failed"] = len(measures.failed_starts(success))
        result["failures"] = measures.list_failures(task, observations, success, MOST_FAILURES)
    if most > 1:
        result["checkpoints"] = [last, *earlier]
    if off := run.policies.off_nominal(learner):
        result["off_nominal"] = {name: summarize(there) for name, there in off.items()}
    return result, flights


def _flown(baselines: Baselines | None, others: list[Run]) -> Flown:
    flown = Flown({}, {}, {})
    for name, there in (baselines.fly() if baselines else {}).items():
        flown.flights[name] = there.pop(NOMINAL)
        flown.baselines[name] = summarize(flown.flights[name])
        if there:
            flown.baselines[name]["off_nominal"] = {world: summarize(flights) for world, flights in there.items()}
    for run in others:
        for i, folder in enumerate(record.member_folders(run.folder, run.config)):
            result, flown.flights[str(folder)] = _evaluated(run, i, 1, None)
            flown.beside[str(folder)] = result
    return flown


def _beside(flown: Flown) -> dict[str, Any]:
    """Their part of evaluation.json."""
    both = {"baselines": flown.baselines, "beside": flown.beside}
    return {name: results for name, results in both.items() if results}


def _draw(folder: Path, task: Task, flights: Flights, flown: Flown) -> None:
    observations = np.asarray(flights.observations)
    others = {name: np.asarray(there.observations) for name, there in flown.flights.items()}
    with files.writing(folder / "evaluation.png"):
        errors.draw(folder / "evaluation.png", task, observations, others)
    if isinstance(task, QuadrotorTask):
        with files.writing(folder / "settle.png"):
            settle.draw(folder / "settle.png", task, observations)


def _print(table: list[dict[str, Any]], flown: Flown, named: dict[str, Condition]) -> None:
    """All tables, and last which starts failed."""
    policies = {"policy" if len(table) == 1 else f"seed {result['seed']}": result for result in table}
    for result in table:
        if "checkpoints" in result:
            tables.checkpoints(result)
    pilots = {**policies, **flown.baselines, **flown.beside}
    tables.table(pilots)
    if named:
        console.print("\noff nominal:")
        for name, condition in named.items():
            console.print(f"  {name}: {condition.description}")
        for name, result in pilots.items():
            said = f"seed {result['seed']}, step {result['env_steps']:,}" if "seed" in result else ""
            tables.off_nominal(", ".join(filter(None, (name if name not in policies else "policy", said))), result)
    if len(flown.flights) > len(errors.LINES):
        console.print(f"evaluation.png shows the first {len(errors.LINES)} of {len(flown.flights)} beside the policy")
    for name, result in policies.items():
        if "failures" in result:
            tables.failures(name, result)

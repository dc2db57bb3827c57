"""`qrl evaluate`: a run's policies flown from fresh starts, with classical controllers and other runs as baselines."""

import argparse
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from qrl import tasks
from qrl.algorithm.flights import Flights, summarize
from qrl.cli import tables
from qrl.cli.terminal import DONE, console
from qrl.cli.verdict import verdict
from qrl.evaluation.baselines import CONTROLLERS, NOMINAL, Baselines, EvalEnvs
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.evaluation.starts import evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import checkpoint, files, record
from qrl.runs.record import RunConfig
from qrl_envs import measures
from qrl_envs.off_nominal import Condition, OffNominal, conditions
from qrl_envs.plots import errors, off_nominal, settle
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask, Task

MOST_FAILURES = 50  # listed in evaluation.json


class SeedRun(NamedTuple):
    """One seed of a run, with the compiled programs that all its seeds share."""

    folder: Path
    programs: FlightPrograms


class Comparison(NamedTuple):
    """Results of baselines and other runs for evaluation.json, and their nominal flights."""

    baselines: dict[str, dict[str, Any]]
    beside: dict[str, dict[str, Any]]
    flights: dict[str, Flights]  # of all of these, by name


def evaluate(args: argparse.Namespace) -> int:
    """Fly every seed of a run from fresh starts; print a table, write evaluation.json and plots to each folder."""
    config = _following(args.run, args)
    others = [(folder, _of_same_task(folder, args.run, config, args)) for folder in dict.fromkeys(args.beside)]
    task = tasks.spec(config.task) if config.task.spec else None
    named = _conditions(args.run, config, task) if args.off_nominal else {}
    envs = {NOMINAL: tasks.environment(config.task)}
    envs |= {name: OffNominal(task, condition) for name, condition in named.items()}  # pyright: ignore[reportArgumentType]
    eval_envs = EvalEnvs(envs, evaluation_starts(args.starts))
    with ThreadPoolExecutor() as executor:
        seeds = _seed_runs(args.run, config, eval_envs, executor)
        others = [seed for folder, other in others for seed in _seed_runs(folder, other, eval_envs, executor)]
        baselines = Baselines(eval_envs, task, executor) if isinstance(task, QuadrotorTask) else None
        results = [_evaluated(seed, eval_envs, args.checkpoints, task) for seed in seeds]
        comparison = _comparison(baselines, others, eval_envs)
    parts = {"baselines": comparison.baselines, "beside": comparison.beside}
    flown = {key: value for key in ("vehicle", "reference") if (value := getattr(args, key)) is not None}
    table = [{**result, **flown, **{name: part for name, part in parts.items() if part}} for result, _ in results]
    for seed, result, (_, flights) in zip(seeds, table, results, strict=True):
        result |= verdict(config.task, result["success"]).entry
        files.write_json(seed.folder / "evaluation.json", result)
        if task:
            _draw(seed.folder, task, flights, comparison)
        if task and named:
            by_pilot = {"policy": result, **comparison.baselines}
            with files.writing(seed.folder / "off_nominal.png"):
                off_nominal.draw(seed.folder / "off_nominal.png", task, by_pilot)
    if config.seeds > 1:
        files.write_json(args.run / "evaluation.json", table)
    what = "".join(f", {key} {value}" for key, value in flown.items())
    console.print(f"{config.task.name}{what}: {args.starts:,} fresh starts, deterministic policy")
    _print(table, comparison, named)
    for name in CONTROLLERS if baselines else ():
        if name not in comparison.baselines:
            console.print(f"{name}: not available for this task and vehicle")
    return DONE


def _seed_runs(folder: Path, config: RunConfig, eval_envs: EvalEnvs, executor: Executor) -> list[SeedRun]:
    """The seeds of a run; compilation of their programs starts in `executor`."""
    programs = FlightPrograms(eval_envs.envs[NOMINAL], config.learner)
    for env in eval_envs.kinds.values():
        programs.compile(env, eval_envs.starts, executor)
    return [SeedRun(member, programs) for member in record.member_folders(folder, config)]


def _conditions(folder: Path, config: RunConfig, task: Task | None) -> dict[str, Condition]:
    """The off-nominal conditions of a run's task."""
    if not isinstance(task, QuadrotorTask):
        raise BadInput(
            f"{folder}: --off-nominal: expected a run of hover, circle or another quadrotor, found '{config.task.name}'"
        )
    if task.distribution:
        raise BadInput(f"{folder}: --off-nominal: expected --vehicle too, for a policy of any vehicle")
    return conditions(task)


def _following(folder: Path, args: argparse.Namespace) -> RunConfig:
    config = tasks.load_run_config(folder)
    return config.model_copy(update={"task": tasks.following(config.task, args.reference, args.vehicle)})


def _of_same_task(folder: Path, run: Path, config: RunConfig, args: argparse.Namespace) -> RunConfig:
    """The run in `folder`; BadInput unless it has the task of `run`. Training settings may differ."""
    other = _following(folder, args)
    if other.task.name != config.task.name or _evaluation_spec(other) != _evaluation_spec(config):
        raise BadInput(
            f"{folder}: --beside: expected a run of the same task as {run}, '{config.task.name}', found one of"
            f" '{other.task.name}'{' that differs' if other.task.name == config.task.name else ''}"
        )
    for member in record.member_folders(folder, other):
        if not checkpoint.saved_steps(member):
            raise BadInput(f"{member}: --beside: no checkpoint")
    return other


def _evaluation_spec(config: RunConfig) -> dict[str, Any]:
    """The part of a task that evaluation depends on, without settings of training and names."""
    own = ("description", "preset", "start", "envelope", "episode_steps", "reward", "reference")
    return {key: value for key, value in (config.task.spec or {}).items() if key not in own}


def _evaluated(seed: SeedRun, eval_envs: EvalEnvs, most: int, task: Task | None) -> tuple[dict[str, Any], Flights]:
    """The entry of evaluation.json for one seed, and the nominal flights of its last checkpoint."""

    runs = TrainedRun.checkpoints(seed.folder, most, seed.programs)
    run = next(runs)
    flights = run.fly(eval_envs.starts)
    last = {"env_steps": run.env_steps, **summarize(flights)}
    earlier = [{"env_steps": one.env_steps, **summarize(one.fly(eval_envs.starts))} for one in runs]
    result: dict[str, Any] = {"seed": run.config.seed, "starts": len(flights.returns), **last}
    if task:
        success, observations = np.asarray(flights.measures["success"]), np.asarray(flights.observations)
        result["failed"] = len(measures.failed_starts(success))
        result["failures"] = measures.list_failures(task, observations, success, MOST_FAILURES)
    if most > 1:
        result["checkpoints"] = [last, *earlier]
    off_nominal = {name: env for name, env in eval_envs.envs.items() if name != NOMINAL}
    if off_nominal:
        result["off_nominal"] = {n: summarize(run.fly(eval_envs.starts, env)) for n, env in off_nominal.items()}
    return result, flights


def _comparison(baselines: Baselines | None, others: list[SeedRun], eval_envs: EvalEnvs) -> Comparison:
    found = Comparison({}, {}, {})
    for name, by_env in (baselines.fly() if baselines else {}).items():
        found.flights[name] = by_env.pop(NOMINAL)
        found.baselines[name] = summarize(found.flights[name])
        if by_env:
            found.baselines[name]["off_nominal"] = {env: summarize(flights) for env, flights in by_env.items()}
    for seed in others:
        name = str(seed.folder)
        found.beside[name], found.flights[name] = _evaluated(seed, eval_envs, 1, None)
    return found


def _draw(folder: Path, task: Task, flights: Flights, comparison: Comparison) -> None:
    observations = np.asarray(flights.observations)
    others = {name: np.asarray(there.observations) for name, there in comparison.flights.items()}
    with files.writing(folder / "evaluation.png"):
        errors.draw(folder / "evaluation.png", task, observations, others)
    if isinstance(task, QuadrotorTask):
        with files.writing(folder / "settle.png"):
            settle.draw(folder / "settle.png", task, observations)


def _print(table: list[dict[str, Any]], comparison: Comparison, named: dict[str, Condition]) -> None:
    """All tables, then the failed starts."""
    policies = {"policy" if len(table) == 1 else f"seed {result['seed']}": result for result in table}
    for result in table:
        if "checkpoints" in result:
            tables.checkpoints(result)
    columns = {**policies, **comparison.baselines, **comparison.beside}
    tables.table(columns)
    if named:
        console.print("\noff nominal:")
        for name, condition in named.items():
            console.print(f"  {name}: {condition.description}")
        for name, result in columns.items():
            checkpoint_of = f", seed {result['seed']}, step {result['env_steps']:,}" if "seed" in result else ""
            tables.off_nominal(f"{'policy' if name in policies else name}{checkpoint_of}", result)
    if len(comparison.flights) > len(errors.LINES):
        console.print(
            f"evaluation.png shows the first {len(errors.LINES)} of {len(comparison.flights)} beside the policy"
        )
    for name, result in policies.items():
        if "failures" in result:
            tables.failures(name, result)
        if reason := result.get("reason"):
            console.print(f"{name} does not do its task: {reason}")

"""`qrl evaluate`: a run's policies flown from fresh starts; also off nominal, and those of its last checkpoints."""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from qrl import request, restore, runs
from qrl.deploy import EVALUATION_STARTS_SEED
from qrl.evaluate import Flights, summarise
from qrl.exits import DONE
from qrl.learner import LearnerState
from qrl.runs import RunConfig
from qrl.terminal import console
from qrl.train import Trainer, point, stack
from qrl_envs.conditions import Condition, OffNominal, conditions
from qrl_envs.pictures import errors
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask


class Asked(NamedTuple):
    """What to fly, and how."""

    nominal: Trainer
    off_nominal: dict[str, Trainer]  # by condition
    starts: chex.PRNGKey
    checkpoints: int  # at most so many, from the last


def evaluate(args: argparse.Namespace) -> int:
    """Fly every seed of a run from fresh starts; print a table, leave evaluation.json and a plot in each folder."""
    config = request.stored(args.run)
    off = _conditions(args.run, config) if args.off_nominal else {}
    asked = Asked(
        nominal=Trainer(request.environment(config.task), config.learner),
        off_nominal={name: Trainer(env, config.learner) for name, (_, env) in off.items()},
        starts=jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), args.starts),
        checkpoints=args.checkpoints,
    )
    table: list[dict[str, Any]] = []
    for i, folder in enumerate(runs.members(args.run, config)):
        result, flights = _flown(folder, config.member(i), asked)
        runs.write_json(folder / "evaluation.json", result)
        if config.task.spec:
            errors.draw(folder / "evaluation.png", request.spec(config.task), np.asarray(flights.observations))
        table.append(result)
    if config.seeds > 1:
        runs.write_json(args.run / "evaluation.json", table)
    console.print(f"{config.task.name}: {args.starts:,} fresh starts, deterministic policy")
    if args.checkpoints > 1:
        for result in table:
            _print_checkpoints(result)
    if off:
        console.print("\noff nominal:")
        for name, (condition, _) in off.items():
            console.print(f"  {name}: {condition.says}")
        for result in table:
            _print_off_nominal(result)
    if args.checkpoints == 1 and not off:
        _print_table("seed", {str(result["seed"]): result for result in table})
    return DONE


def _conditions(folder: Path, config: RunConfig) -> dict[str, tuple[Condition, OffNominal]]:
    """The off-nominal conditions of a run's task, and its environment under each."""
    task = request.spec(config.task) if config.task.spec else None
    if not isinstance(task, QuadrotorTask):
        raise BadInput(
            f"{folder}: --off-nominal: expected a run of hover, circle or another quadrotor, found '{config.task.name}'"
        )
    return {name: (condition, OffNominal(task, condition)) for name, condition in conditions(task).items()}


def _flown(folder: Path, config: RunConfig, asked: Asked) -> tuple[dict[str, Any], Flights]:
    """What evaluation.json says of one seed, and the nominal flights of its last checkpoint."""

    def fly(trainer: Trainer, learner: LearnerState) -> Flights:
        points = stack([point(trainer.env, config.learner)])
        return jax.tree.map(lambda x: x[0], trainer.fly(learner, points, asked.starts))

    try:
        saved = restore.newest(asked.nominal, config, folder, asked.checkpoints)
        state, env_steps = next(saved)
        flights, learner = fly(asked.nominal, state.learner), state.learner
        last = {"env_steps": env_steps, **summarise(flights)}
        earlier = [{"env_steps": steps, **summarise(fly(asked.nominal, state.learner))} for state, steps in saved]
    except OSError as error:
        raise BadInput(str(error)) from None
    result: dict[str, Any] = {"seed": config.seed, "starts": len(asked.starts), **last}
    if asked.checkpoints > 1:
        result["checkpoints"] = [last, *earlier]
    if asked.off_nominal:
        result["off_nominal"] = {name: summarise(fly(there, learner)) for name, there in asked.off_nominal.items()}
    return result, flights


def _print_checkpoints(result: dict[str, Any]) -> None:
    columns = {f"{one['env_steps']:,}": one for one in result["checkpoints"]}
    console.print(f"\nseed {result['seed']}, its last {len(columns)} checkpoints by environment steps")
    _print_table("", {head: {k: v for k, v in one.items() if k != "env_steps"} for head, one in columns.items()})


def _print_off_nominal(result: dict[str, Any]) -> None:
    console.print(f"\nseed {result['seed']}, step {result['env_steps']:,}")
    nominal = {name: result[name] for name in next(iter(result["off_nominal"].values()))}
    _print_table("", {"nominal": nominal, **result["off_nominal"]})


def _print_table(corner: str, columns: dict[str, dict[str, Any]]) -> None:
    """One column for each of `columns`, one row for each number that they have."""
    first = next(iter(columns.values()))
    names = [name for name, x in first.items() if isinstance(x, int | float) and name not in ("seed", "starts")]
    names = [name for name in names if not np.isnan(first[name])]
    width = max(len(name) for name in names)
    console.print(f"{corner:<{width}} " + " ".join(f"{head:>11}" for head in columns))
    for name in names:
        console.print(f"{name:<{width}} " + " ".join(f"{_cell(name, one[name]):>11}" for one in columns.values()))


def _cell(name: str, value: float) -> str:
    if name == "env_steps":
        return f"{value:,}"
    return f"{value:.2f}" if name.startswith("return") else f"{value:.4f}"

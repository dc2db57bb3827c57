"""A run of a second or two, in this process."""

import csv
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
from brax.envs.base import Env

from qrl.config import Config, load_preset
from qrl.runs import record
from qrl.runs.record import RunConfig, TaskRecord
from qrl.training import driver, loop
from qrl.training.traced import Store
from qrl.training.trainer import Trainer, make_trainer
from qrl_envs import env as worlds

SMALL = {
    "num_timesteps": 1200,
    "num_envs": 4,
    "unroll_length": 10,
    "replay_unrolls": 3,
    "warmup_unrolls": 2,
    "updates_per_unroll": 2,
    "batch_size": 2,
    "policy_hidden_layer_sizes": [8],
    "critic_hidden_layer_sizes": [8],
    "num_evals": 6,
    "num_eval_envs": 3,
    "normalize_observations": True,
}


def run_config(seed: int = 0, seeds: int = 1, **changes: object) -> RunConfig:
    learner = Config.model_validate(load_preset("default") | SMALL | changes, strict=False)
    return RunConfig(
        task=TaskRecord(name="pendulum", spec=None), learner=learner, seed=seed, seeds=seeds, versions={}, devices=[]
    )


@functools.cache
def pendulum() -> Env:
    """One for all runs of a session, for its programs are compiled once."""
    return worlds.make("pendulum")


_make_once = functools.cache(make_trainer)


def trainer_of(env: Env, config: Config, mesh: Any = None) -> Trainer:
    """One for an environment, by its identity, and a configuration, but for the number of reports."""
    return _make_once(env, config.model_copy(update={"num_evals": 1}), mesh)


_programs: dict[Any, Any] = {}


_lower = driver.lower


def lower_once(trainer: Trainer, name: str, states: Any, inputs: Any, store: Store | None = None) -> Callable[[], Any]:
    if store:
        return _lower(trainer, name, states, inputs, store)
    key = name, trainer, len(states.unrolls), jax.config.read("jax_disable_most_optimizations")
    if key not in _programs:
        _programs[key] = _lower(trainer, name, states, inputs)()
    return lambda: _programs[key]


def train(
    out: Path,
    run: RunConfig,
    env: Env,
    *,
    resume: bool = False,
    stop_after: int | None = None,
    store: Store | None = None,
) -> list[loop.Event]:
    """Run to the end, or until `stop_after` events beyond compilation; runs of one environment share their programs."""
    for folder in record.member_folders(out, run):
        folder.mkdir(parents=True, exist_ok=True)
    seen: list[loop.Event] = []

    def stopped() -> bool:
        return (
            stop_after is not None and sum(not isinstance(e, loop.Compiling | loop.Resumed) for e in seen) >= stop_after
        )

    with mock.patch.object(loop, "make_trainer", trainer_of), mock.patch.object(driver, "lower", lower_once):
        for event in loop.train(env, run, out, resume=resume, stopped=stopped, store=store):
            seen.append(event)
    return seen


def comparable_metrics(folder: Path) -> list[dict[str, str]]:
    """metrics.csv without its clocks."""
    with (folder / "metrics.csv").open() as file:
        return [
            {k: v for k, v in row.items() if not k.endswith(("train_seconds", "_per_second"))}
            for row in csv.DictReader(file)
        ]

"""A run of a second or two, in this process."""

import csv
from pathlib import Path

from brax.envs.base import Env

from qrl.config import Config, load_preset
from qrl.runs import record
from qrl.runs.record import RunConfig, TaskRecord
from qrl.training import loop

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


def train(
    out: Path, run: RunConfig, env: Env, *, resume: bool = False, stop_after: int | None = None
) -> list[loop.Event]:
    """Run to the end, or until `stop_after` events beyond compilation."""
    for folder in record.member_folders(out, run):
        folder.mkdir(parents=True, exist_ok=True)
    seen: list[loop.Event] = []

    def stopped() -> bool:
        return (
            stop_after is not None and sum(not isinstance(e, loop.Compiling | loop.Resumed) for e in seen) >= stop_after
        )

    for event in loop.train(env, run, out, resume=resume, stopped=stopped):
        seen.append(event)
    return seen


def comparable_metrics(folder: Path) -> list[dict[str, str]]:
    """metrics.csv without its clocks."""
    with (folder / "metrics.csv").open() as file:
        return [
            {k: v for k, v in row.items() if not k.endswith(("train_seconds", "_per_second"))}
            for row in csv.DictReader(file)
        ]

"""The command line, called as a user would, and a run that is over in a moment."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from qrl import tasks
from qrl.cli import train
from qrl.cli.arguments import build_parser
from qrl.cli.main import main
from qrl.runs import record
from qrl.training import driver, loop
from qrl.training.driver import Clock
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer

TINY_VALUES: dict[str, Any] = {
    "num_timesteps": 400,
    "num_envs": 4,
    "unroll_length": 10,
    "batch_size": 2,
    "updates_per_unroll": 1,
    "num_evals": 2,
    "num_eval_envs": 3,
    "warmup_unrolls": 2,
    "replay_unrolls": 2,
    "policy_hidden_layer_sizes": [4],
    "critic_hidden_layer_sizes": [4],
}
TINY = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in TINY_VALUES.items())


def qrl(*words: str | Path) -> int:
    try:
        return main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)


def untrained(out: Path, *words: str | Path) -> Path:
    """The run folder `out` of the random policies that `qrl train words` begins with, for what only flies them: to
    compile a program that trains takes most of a tiny run's time.
    """
    args = build_parser().parse_args(["train", str(words[0]), *TINY.split(), "--out", str(out), *map(str, words[1:])])
    with ExitStack() as locks, ThreadPoolExecutor(1) as saving:
        plan = train.make_plan(args, locks)
        assert plan
        run, env = plan.config, tasks.environment(plan.config.task)
        trainer, inputs = make_trainer(env, run.learner), stack([member_inputs(env, run.learner)] * run.seeds)
        states = trainer.init(driver.seeds(run.seed, run.seeds), inputs)
        for i, folder in enumerate(record.member_folders(out, run)):
            member = loop.Member(folder, run.member(i), 0, [], saving)
            member.save(run.learner.steps_per_unroll, list(trainer.members(states))[i], Clock())
            member.close()
    return out


def complaint(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """The one line on stderr of a command whose input is wrong."""
    capsys.readouterr()
    assert qrl(*words) == 2
    error = capsys.readouterr().err
    assert error.startswith("qrl: ")
    assert error.count("\n") == 1
    return error

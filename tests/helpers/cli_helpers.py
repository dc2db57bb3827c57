"""The command line, called as a user would, and a run that is over in a moment."""

from pathlib import Path
from typing import Any

import pytest

from qrl.cli.main import main

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


def complaint(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """The one line on stderr of a command whose input is wrong."""
    capsys.readouterr()
    assert qrl(*words) == 2
    error = capsys.readouterr().err
    assert error.startswith("qrl: ")
    assert error.count("\n") == 1
    return error

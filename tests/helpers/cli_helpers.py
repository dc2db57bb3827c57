"""The command line, called as a user would, and a run that is over in a moment."""

from pathlib import Path

import pytest

from qrl.cli.main import main

TINY = "--num-timesteps 400 --num-envs 4 --unroll-length 10 --batch-size 2 --updates-per-unroll 1 --num-evals 2"
TINY += " --num-eval-envs 3 --warmup-unrolls 2 --replay-unrolls 2"
TINY += " --policy-hidden-layer-sizes [4] --critic-hidden-layer-sizes [4]"


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

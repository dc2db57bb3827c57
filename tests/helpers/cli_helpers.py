"""The command line, called as a user would, and a run that is over in a moment."""

from pathlib import Path

import pytest

from qrl.cli.main import main

TINY = (
    "--steps 400 --lanes 4 --unroll-steps 10 --minibatch-lanes 2 --updates-per-unroll 1 --reports 2 --report-flights 3"
)
TINY += " --warmup-unrolls 2 --ring-unrolls 2 --policy-hidden [4] --critic-hidden [4]"


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

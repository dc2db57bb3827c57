"""`make` takes what a run is from its command line alone; no recipe is run here."""

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "Makefile").read_text(encoding="utf-8")
OWN = {"ARGS", "CURDIR", "HELP", "MAKE", "MAKECMDGOALS", *re.findall(r"^([A-Z]+) *[?:+]?=", TEXT, re.MULTILINE)}
NAMES = {*re.findall(r"\$\(([A-Z]+)\)", TEXT)} - OWN  # what a user may set


def recipe(*words: str, **environment: str) -> str:
    """What `make words` would do."""
    kept = {name: x for name, x in os.environ.items() if name not in NAMES | {"MAKEFLAGS", "MFLAGS", "MAKELEVEL"}}
    command = ["make", "-n", *words]
    return subprocess.run(command, cwd=ROOT, env=kept | environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    "words",
    [
        ["train", "TASK=hover"],
        ["identify", "LOG=a.csv", "VEHICLE=b.json"],
        ["evaluate", "RUN=a"],
        ["export", "RUN=a"],
        ["fly", "VEHICLE=b.json"],
        ["sweep", "GRID=c.json"],
        ["seeds", "TASK=hover"],
        ["gallery"],
    ],
    ids=lambda words: words[0],
)
def test_the_environment_says_nothing_of_a_run(words: list[str]) -> None:
    """NAME, say, is the machine's on some systems."""
    assert {"TASK", "NAME", "OUT", "SEED", "FAST"} < NAMES
    assert recipe(*words, **dict.fromkeys(NAMES, "other")) == recipe(*words)


def test_the_command_line_says_it() -> None:
    said = recipe("export", "RUN=a", "NAME=mine", "ARGS=--vectors 500", NAME="other")
    assert "export 'a' --name 'mine' --vectors 500" in said

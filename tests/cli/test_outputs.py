"""Where a command is to write is checked before it works, in one line."""

import json
from pathlib import Path

import pytest

from cli_helpers import complaint
from qrl import request
from qrl.runs import files
from qrl.runs.record import ConfigFile
from qrl_envs.vehicle import vehicle_data


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--out", "."], "--out: expected the name of a file, found the folder ."),
        (["--plot", "sub"], "--plot: expected the name of a file, found the folder sub"),
        (["--out", "none/a.json"], "--out: expected a file in a folder that is there and can be written to, found"),
        (["--out", "mine.json/a.json"], "--out: expected a file in a folder that is there"),
        (["--out", "log.csv"], "--out: log.csv is read, or written too: expected another name"),
        (["--out", "a.json", "--plot", "sub/../log.csv"], "--plot: sub/../log.csv is read"),
        (["--out", "a.json", "--hold-out", "other.csv", "--plot", "other.csv"], "--plot: other.csv is read"),
        (["--out", "mine.json"], "--out: mine.json is read"),
        (["--out", "a.png"], "--out: a.png is read, or written too"),
        (["--out", "a.json", "--plot", "a_report.json"], "--plot: a_report.json is read, or written too"),
        (["--hold-out", "sub/../log.csv"], "sub/../log.csv: stands twice among the logs"),
    ],
)
def test_identify_writes_over_nothing(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Said before the log, which is not there, is read."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    (tmp_path / "mine.json").write_text(json.dumps(vehicle_data("crazyflie")))
    assert says in complaint(capsys, "identify", "log.csv", "--vehicle", "mine.json", *words)


def test_view_writes_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Said before the checkpoint, which is not there, is read."""
    run = request.run_config("pendulum", None, ConfigFile(), {}, None, None)
    files.write_json(tmp_path / "config.json", run.model_dump(mode="json"))
    said = complaint(capsys, "view", tmp_path, "--out", ".")
    assert "--out: expected the name of a file, found the folder ." in said

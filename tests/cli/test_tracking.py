"""Tasks that track, and policies of any vehicle, on the command line."""

import json
from pathlib import Path

import pytest

from cli_helpers import TINY, complaint, qrl


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of any vehicle, hardly trained."""
    folder = tmp_path_factory.mktemp("any") / "run"
    assert qrl("train", "any", "--out", folder, *TINY.split()) == 0
    return folder


def test_a_policy_of_any_vehicle_flies_another_along_a_file(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the motors of the file in another order; the page shows the reference and rotor speeds."""
    figure = tmp_path / "mine.csv"
    figure.write_text("time_s,x_m,y_m,z_m\n" + "".join(f"{t / 10},{t / 50},{t / 70},0.1\n" for t in range(12)))
    where = ["--reference", figure, "--vehicle", "cf21_brushless"]
    assert qrl("evaluate", run, *where, "--starts", "3") == 0
    assert "rms_position_m" in capsys.readouterr().out
    assert json.loads((run / "evaluation.json").read_text())["starts"] == 3
    assert qrl("view", run, *where, "--starts", "0") == 0
    page = (run / "view.html").read_text()
    data = json.loads(page.split('id="data"', 1)[1].split(">", 1)[1].split("</script>", 1)[0])
    assert data["acted"]["name"] == "speed"
    assert data["wanted"]["path_m"][0][:3] == [0.0, 0.002, 0.004]
    assert data["panels"][1]["label"] == "distance to the reference"
    assert data["vehicle"]["motors"][0]["position_m"] == [0.035355, 0.035355]  # front left, the file's last


def test_what_cannot_be_flown_is_said_in_a_line(run: Path, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "expected one along body z in each quarter" in complaint(capsys, "evaluate", run, "--vehicle", "hexa")
    assert "did you mean 'eight'" in complaint(capsys, "evaluate", run, "--reference", "eigth")
    assert "--vehicle: expected a policy of any vehicle" in complaint(capsys, "evaluate", trained, "--vehicle", "hexa")
    assert "--reference: expected a task that tracks" in complaint(capsys, "view", trained, "--reference", "eight")
    assert "has no reference" in complaint(capsys, "train", "hover", "--reference", "eight", "--out", run.parent / "no")
    assert "in each quarter" in complaint(capsys, "train", "any", "--vehicle", "hexa", "--out", run.parent / "no")

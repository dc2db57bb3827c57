"""docs/results.json and the tables filled in from it."""

import json
from pathlib import Path

import pytest

from experiments import results
from experiments.figures.runs import RunSpec
from qrl.runs import files
from qrl.runs.record import RunConfig

EVALUATION = {
    "env_steps": 4_500_000,
    "return_mean": 160.0,
    "success": 1.0,
    "settle_p95_s": 0.9,
    "rms_position_m": 0.001,
}
LQR = {"return_mean": 120.0, "success": 0.9, "settle_p95_s": None}


def config(commit: str) -> RunConfig:
    """Of a run that was trained at `commit`, on one device."""
    versions = {"jax": "0.10.2", "commit": commit}
    return results.ROWS[0].run(100).config().model_copy(update={"versions": versions, "devices": ["TFRT_CPU_0"]})


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    evaluations = [
        EVALUATION,
        EVALUATION | {"success": 0.5, "settle_p95_s": None},
        EVALUATION | {"rms_position_m": 0.003},
    ]
    row = results.summary(results.ROWS[0], evaluations, [30.0, 10.0, 20.0], [config("a"), config("a"), config("b+")])
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"rows": [row], "baselines": {"hover": {"lqr": LQR}}}))
    return path


def test_a_row_has_median_and_worst_seed(stored: Path) -> None:
    row = json.loads(stored.read_text())["rows"][0]
    assert row["success"] == {"median": 1.0, "worst": 0.5}
    assert row["settle_p95_s"] == {"median": 0.9, "worst": None}
    assert row["rms_position_m"] == {"median": 0.001, "worst": 0.003}
    assert row["command_seconds"] == {"median": 20.0, "worst": 30.0}
    assert row["versions"] == {"jax": "0.10.2", "commit": "a or b+"}
    assert row["devices"] == "TFRT_CPU_0"
    made = results.tables(stored)
    assert (
        "| hover | without APG (the paper's learner, with symmetries) | 4.5M | 160.0 | 50.0 % | – | never | 3.0 mm |"
        in made["summary"]
    )
    assert "| hover | lqr | 120.0 | 90.0 % | – | never | – |" in made["controllers"]


def test_the_commit_is_that_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of its config.json, not of the code that measures; one with changed files gets a warning."""
    commits = iter(["aaa", "bbb+"])

    def train(run: RunSpec, out: Path, **_: bool) -> float:
        out.mkdir(parents=True)
        stored = run.config().model_copy(update={"versions": {"commit": next(commits)}, "devices": ["TFRT_CPU_0"]})
        files.write_json(out / "config.json", stored.model_dump(mode="json"))
        files.write_json(out / "evaluation.json", EVALUATION | {"starts": 1000})
        return 1.0

    monkeypatch.setattr(results, "ROWS", results.ROWS[:2])
    monkeypatch.setattr(results, "SEEDS", (100,))
    monkeypatch.setattr(results, "train", train)
    monkeypatch.setattr(results.runs, "qrl", lambda *_: None)
    found = results.measure(tmp_path, fresh=False)
    assert [row["versions"]["commit"] for row in found["rows"]] == ["aaa", "bbb+"]
    said = capsys.readouterr().err
    assert said == f"results: warning: {tmp_path}/hover/100: trained by changed files of commit bbb+\n"


def test_tables_are_filled_in_and_checked(stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "README.md"
    page.write_text("before\n<!-- results:summary -->\n<!-- /results -->\nafter\n")
    words = ["--out", str(stored)]
    assert results.main([*words, "--check", str(page)]) == 1
    assert results.main([*words, "--write", str(page)]) == 0
    assert results.tables(stored)["summary"] in page.read_text()
    assert page.read_text().endswith("<!-- /results -->\nafter\n")
    assert results.main([*words, "--check", str(page)]) == 0
    page.write_text(page.read_text().replace("50.0 %", "51.0 %"))
    assert results.main([*words, "--check", str(page)]) == 1
    page.write_text("<!-- results:none -->\n<!-- /results -->\n")
    assert results.main([*words, "--check", str(page)]) == 1
    assert "no table 'none'" in capsys.readouterr().err

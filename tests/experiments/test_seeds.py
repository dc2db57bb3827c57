"""Many seeds of one task: what is trained, kept, resumed and counted."""

import csv
import itertools
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli_helpers import TINY, qrl
from experiments import seeds, seeds_report
from experiments.statistics import interquartile_mean
from qrl.runs import files

# Stands for qrl: writes what a run does. It fails, or waits to be ended or for another seed, as its task's flags say.
STAND_IN = """
import json, os, signal, sys, time
from pathlib import Path

words = sys.argv[1:]
value = lambda flag: words[words.index(flag) + 1] if flag in words else ""
seed, out, resumed = value("--seed"), Path(value("--out")), "--resume" in words

def stop(*_):
    (out / "saved").touch()
    sys.exit(1)

signal.signal(signal.SIGTERM, stop)
(out / "config.json").write_text("{}")
rows = [(1000, 0.5), (2000, 0.995), (3000, 1.0)]
if value("--fails") == seed:
    rows = rows[:2]
text = "env_steps,updates,return_mean,return_min,success,train_seconds\\n"
(out / "metrics.csv").write_text(text + "".join(f"{steps},1,-5.0,-9.0,{share},1.5\\n" for steps, share in rows))
if value("--fails") == seed and not (resumed and "mended" in os.environ):
    sys.exit("qrl: update 7: not finite")
end = time.monotonic() + 60
while value("--waits") == seed and not resumed and time.monotonic() < end:
    time.sleep(0.01)
while "--together" in words and len(list(out.parent.glob("*/config.json"))) < 2 and time.monotonic() < end:
    time.sleep(0.01)
if time.monotonic() >= end:
    sys.exit("nothing came")
evaluation = {"starts": 1000, "success": 1.0, "return_mean": -float(seed), "return_min": -9.0, "settle_p95_s": None}
(out / "evaluation.json").write_text(json.dumps(evaluation))
environment = {name: os.environ.get(name) for name in ("PJRT_NPROC", "JAX_NUM_CPU_DEVICES", "JAX_PLATFORMS")}
(out / "summary.json").write_text(json.dumps({"command_seconds": 2.5, "environment": environment}))
"""


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a campaign whose runs are made by STAND_IN."""
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    monkeypatch.setattr(seeds, "QRL", (sys.executable, str(script)))
    return tmp_path / "out"


def campaign(out: Path, *words: str) -> int:
    try:
        return seeds.main(["pendulum", "--out", str(out), *words])
    except SystemExit as stop:
        return int(stop.code or 0)


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "seeds.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def statuses(out: Path) -> dict[int, str]:
    return {int(row["seed"]): row["status"] for row in rows_of(out)}


def log(out: Path, seed: int) -> str:
    return (out / f"{seed}" / "log.txt").read_text()


# A campaign


def test_two_seeds_are_trained_and_fly_the_starts_of_evaluate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--seeds", "2", *TINY.split()]
    assert campaign(tmp_path, *words) == 0
    assert statuses(tmp_path) == {100: "done", 101: "done"}
    first = json.loads((tmp_path / "100" / "evaluation.json").read_text())
    assert json.loads((tmp_path / "101" / "config.json").read_text())["seed"] == 101
    assert "0 of 2 seeds succeed" in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["failing"].keys() == {"100", "101"}
    assert (tmp_path / "seeds.png").read_bytes().startswith(b"\x89PNG")

    monkeypatch.setattr(seeds, "QRL", ("false",))  # nothing is trained again
    (tmp_path / "101" / "evaluation.json").unlink()
    before = rows_of(tmp_path)
    assert campaign(tmp_path, *words) == 0
    assert rows_of(tmp_path) == before

    assert qrl("evaluate", tmp_path / "100") == 0
    flown = json.loads((tmp_path / "100" / "evaluation.json").read_text())
    for name, value in first.items():
        assert flown[name] == (value if value is None else pytest.approx(value, rel=1e-6)), name
    assert first["starts"] == 1000
    assert float(before[0]["return_mean"]) == first["return_mean"]


def test_runs_are_side_by_side_and_each_has_a_core(stand_in: Path) -> None:
    assert campaign(stand_in, "--seeds", "2", "--first", "7", "--jobs", "2", "--together", "1") == 0
    said = json.loads((stand_in / "008" / "summary.json").read_text())["environment"]
    assert said == {"PJRT_NPROC": "1", "JAX_NUM_CPU_DEVICES": "1", "JAX_PLATFORMS": "cpu"}
    assert [row["settle_p95_s"] for row in rows_of(stand_in)] == ["inf", "inf"]
    assert [row["command_seconds"] for row in rows_of(stand_in)] == ["2.5", "2.5"]


def test_more_seeds_join_those_that_are_there(stand_in: Path) -> None:
    assert campaign(stand_in, "--seeds", "1") == 0
    assert campaign(stand_in, "--seeds", "2") == 0
    assert statuses(stand_in) == {100: "done", 101: "done"}
    assert log(stand_in, 100).count("$ qrl") == 1


def test_an_interrupted_campaign_keeps_what_is_there_and_resumes(
    stand_in: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: float) -> None:
        if (stand_in / "101" / "metrics.csv").exists():
            raise KeyboardInterrupt
        wait(0.01)

    wait = time.sleep
    words = ["--seeds", "3", "--jobs", "1", "--waits", "101"]
    with monkeypatch.context() as patch:
        patch.setattr(seeds.time, "sleep", interrupted)
        with pytest.raises(KeyboardInterrupt):
            campaign(stand_in, *words)
    assert (stand_in / "101" / "saved").exists()
    assert statuses(stand_in) == {100: "done", 101: "unfinished", 102: "unfinished"}
    summary = json.loads((stand_in / "summary.json").read_text())
    assert (summary["seeds"], summary["ended"], summary["succeed"]) == (3, 1, 1)

    assert campaign(stand_in, *words) == 0
    assert statuses(stand_in) == dict.fromkeys((100, 101, 102), "done")
    assert "--resume" in log(stand_in, 101)
    assert "--resume" not in log(stand_in, 100) + log(stand_in, 102)
    assert [row["command_seconds"] for row in rows_of(stand_in)] == ["2.5", "", "2.5"]


def test_a_seed_that_fails_is_a_row_and_counts(
    stand_in: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--seeds", "3", "--fails", "101"]
    assert campaign(stand_in, *words) == 1
    assert statuses(stand_in)[101] == "failed with exit code 1: qrl: update 7: not finite"
    summary = json.loads((stand_in / "summary.json").read_text())
    assert (summary["ended"], summary["succeed"]) == (3, 2)
    assert summary["failing"] == {"101": statuses(stand_in)[101]}
    assert (summary["measures"]["success"]["worst"], summary["measures"]["success"]["worst_seed"]) == (0.0, 101)
    assert "seed 101 does not: failed with exit code 1: qrl: update 7: not finite" in capsys.readouterr().out

    assert campaign(stand_in, *words) == 1  # again, without training
    assert log(stand_in, 101).count("$ qrl") == 1
    monkeypatch.setenv("mended", "1")
    assert campaign(stand_in, *words, "--retry") == 0
    assert statuses(stand_in)[101] == "done"


def complaint(capsys: pytest.CaptureFixture[str], out: Path, *words: str) -> str:
    """The one line on stderr of a campaign whose input is wrong."""
    capsys.readouterr()
    assert campaign(out, *words) == 2
    said = capsys.readouterr().err
    assert said.startswith("seeds: ")
    assert said.count("\n") == 1
    return said


def test_wrong_input_is_one_line(stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--seeds" in complaint(capsys, stand_in, "--seeds", "0")
    assert "--first" in complaint(capsys, stand_in, "--seed", "3")
    assert "is a file" in complaint(capsys, Path(__file__))
    assert campaign(stand_in, "--seeds", "1") == 0
    assert "give another OUT" in complaint(capsys, stand_in, "--seeds", "1", "--gamma", "0.9")
    assert seeds.main(["pendulumm", "--out", str(stand_in)]) == 2
    assert "'pendulum'" in capsys.readouterr().err


def test_what_train_refuses_ends_the_campaign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--gama" in complaint(capsys, tmp_path, "--seeds", "2", "--gama", "0.9", "--jobs", "1")
    assert not (tmp_path / "seeds.csv").exists()
    assert not (tmp_path / "101").exists()


# What is counted


def test_it_flies_from_the_report_from_which_success_stays() -> None:
    def reports(*shares: float) -> list[files.Row]:
        return [{"env_steps": 10 * i, "success": share} for i, share in enumerate(shares, 1)]

    assert seeds.flies_from(reports(0.0, 0.99, 1.0)) == 20
    assert seeds.flies_from(reports(1.0, 0.989, 1.0)) == 30
    assert seeds.flies_from(reports(1.0, 1.0, 0.5)) == math.inf
    assert seeds.flies_from([]) == math.inf
    assert math.isnan(seeds.flies_from(reports(math.nan, math.nan)))  # not measured


def finished(seed: int, **measures: float) -> dict[str, Any]:
    return {"seed": seed, "status": "done", **measures}


def test_statistics_are_those_by_hand() -> None:
    """Of 1 … 8 the middle half is 3, 4, 5, 6."""
    order = (3, 8, 1, 5, 2, 7, 4, 6)
    rows = [
        finished(100 + i, settle_p95_s=x, return_mean=-x, train_seconds=2.0, rms_m=math.nan)
        for i, x in enumerate(order)
    ]
    found = seeds_report.statistics(rows)
    assert found.keys() == {"settle_p95_s", "return_mean", "train_seconds"}
    settle, back = found["settle_p95_s"], found["return_mean"]
    assert (settle["median"], settle["iqm"], settle["worst"], settle["worst_seed"]) == (4.5, 4.5, 8.0, 101)
    assert (back["median"], back["iqm"], back["worst"], back["worst_seed"]) == (-4.5, -4.5, -8.0, 101)
    assert found["train_seconds"]["low"] == found["train_seconds"]["high"] == 2.0


def test_a_failed_seed_is_worst_in_every_measure() -> None:
    rows = [finished(100 + i, success=1.0, settle_p95_s=1.0, return_mean=5.0, train_seconds=2.0) for i in range(4)]
    rows.append({"seed": 104, "status": "failed", "steps_until_it_flies": 7.0})
    found = seeds_report.statistics(rows)
    worst = {name: (measure["worst"], measure["worst_seed"]) for name, measure in found.items()}
    assert worst["success"] == (0.0, 104)
    assert worst["settle_p95_s"] == (math.inf, 104)
    assert worst["return_mean"] == (-math.inf, 104)
    assert worst["train_seconds"] == (2.0, 100)  # it has none
    assert found["settle_p95_s"]["iqm"] == 1.0


def test_the_interval_is_that_of_all_resamples() -> None:
    """Of four values there are 256 resamples; the middle half of each are its middle two."""
    values = np.array([0.0, 1.0, 2.0, 10.0])
    every = sorted(np.mean(sorted(draw)[1:3]) for draw in itertools.product(values, repeat=4))
    found = interquartile_mean(values)
    assert found.iqm == 1.5
    assert (found.low, found.high) == (every[round(0.025 * 255)], every[round(0.975 * 255)])
    one = interquartile_mean(np.array([3.0]))
    assert (one.iqm, math.isnan(one.low)) == (3.0, True)


def test_the_share_that_flies_holds_the_last_report(tmp_path: Path) -> None:
    """Seed 101 reports at other steps; 102 flew, and then its training failed."""
    reported = {100: {10: 0.0, 20: 1.0, 30: 1.0}, 101: {15: 1.0, 25: 0.0}, 102: {10: 1.0}, 103: {}}
    for seed, reports in reported.items():
        (tmp_path / f"{seed}").mkdir()
        rows: list[files.Row] = [
            {"env_steps": steps, "success": share} | dict.fromkeys(set(files.REPORTED) - {"env_steps", "success"}, 0.0)
            for steps, share in reports.items()
        ]
        files.write_metrics(tmp_path / f"{seed}", rows)
    status = {100: "done", 101: "done", 102: "failed", 103: "failed"}
    ended = [{"seed": seed, "status": status[seed]} for seed in reported]
    steps, share = seeds_report.share_that_flies(ended, tmp_path)
    assert steps.tolist() == [10, 15, 20, 25, 30]
    assert share.tolist() == [0.25, 0.25, 0.5, 0.25, 0.25]

"""The command line as a user meets it: what it leaves behind, and one clear line for every wrong input."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cli_helpers import TINY, complaint, qrl, untrained
from fault_injection import STRESS
from qrl.evaluation.baselines import CONTROLLERS
from qrl_envs.plots import errors


def test_training_leaves_the_run_folder(trained: Path) -> None:
    """What other tools find in a run folder."""
    present = {path.name for path in trained.iterdir()}
    assert {"config.json", "metrics.csv", "checkpoints", "tensorboard", "summary.json"} <= present
    assert {"learning_curve.png", "flight.png"} <= present
    header = (trained / "metrics.csv").read_text().splitlines()[0]
    assert header.startswith("env_steps,updates,return_mean,return_min,success,train_seconds,")
    config = json.loads((trained / "config.json").read_text())
    assert config["task"]["spec"]["rod"]["mass_kg"] == 1.0
    assert config["learner"]["num_timesteps"] == 400
    assert config["versions"]["jax"]


def test_evaluate_writes_its_table(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert qrl("evaluate", trained, "--starts", "5") == 0
    result = json.loads((trained / "evaluation.json").read_text())
    assert result["starts"] == 5
    assert {"return_mean", "success", "settle_median_s", "settle_p95_s", "rms_angle_rad"} <= set(result)
    assert "return_mean" in capsys.readouterr().out
    assert (trained / "evaluation.png").exists()


def test_evaluate_flies_the_last_checkpoints(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A column for each, newest first, as many as asked for; one of them that is damaged is said so."""
    run = shutil.copytree(trained, tmp_path / "run")
    kept = sorted((int(path.name) for path in (run / "checkpoints").iterdir()), reverse=True)
    assert len(kept) > 1
    assert qrl("evaluate", run, "--starts", "5", "--checkpoints", "9") == 0
    result = json.loads((run / "evaluation.json").read_text())
    assert [each["env_steps"] for each in result["checkpoints"]] == kept
    assert result["checkpoints"][0].items() <= result.items()
    assert result["checkpoints"][1]["return_mean"] != result["return_mean"]
    assert all(f"{env_steps:,}" in capsys.readouterr().out for env_steps in kept[:1])
    victim = next(path for path in (run / "checkpoints" / str(kept[1])).rglob("*") if path.name == "_METADATA")
    victim.write_bytes(victim.read_bytes() + b" ")
    assert f"checkpoints/{kept[1]}" in complaint(capsys, "evaluate", run, "--starts", "5", "--checkpoints", "2")
    assert qrl("evaluate", run, "--starts", "5") == 0


def test_brax_is_imported_for_its_own_tasks_alone() -> None:
    """It takes longer than all else that a command begins with."""
    program = (
        "import sys; from qrl import tasks; from qrl.cli import export, sweep, train, view;"
        "assert 'orbax' not in sys.modules;"
        "print([(name, tasks.environment(tasks.task_record(name)).action_size, 'brax' in sys.modules)"
        " for name in ('hover', 'pendulum', 'fast')])"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said == "[('hover', 4, False), ('pendulum', 1, False), ('fast', 1, True)]\n"


def test_evaluate_flies_off_nominal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every seed, with a table for each, and a controller; exact, on the plant of real vehicles, is as nominal."""
    monkeypatch.delitem(CONTROLLERS, "geometric")  # one is enough: each is a large program
    task = tmp_path / "short.json"
    task.write_text('{"extend": "circle", "evaluation": {"duration_s": 0.3, "tail_s": 0.1}}')
    run = untrained(tmp_path / "run", task, "--seeds", "2")
    capsys.readouterr()
    assert qrl("evaluate", run, "--starts", "5", "--off-nominal") == 0
    said = capsys.readouterr().out
    for i in range(2):
        result = json.loads((run / f"seed-{i}" / "evaluation.json").read_text())
        assert result["baselines"].keys() == {"lqr"}
        for each in (result, result["baselines"]["lqr"]):
            off = each["off_nominal"]
            assert {"exact", "lag_72ms", "latency", "mass_x1.3", "noise", "together"} < off.keys()
            assert off["exact"]["return_mean"] == pytest.approx(each["return_mean"], rel=5e-3)
            assert len({one["return_mean"] for one in (each, *off.values())}) > 10
        assert f"seed {i}," in said
    assert said.count("\nlag_72ms ") == 3  # two seeds, a controller
    assert "seed 0      seed 1         lqr" in said
    for picture in ("settle.png", "off_nominal.png"):
        assert (run / "seed-0" / picture).exists()


def test_evaluate_flies_other_runs_beside(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the same starts, a column each: a run beside itself flies the same; what fails is said by its start, and how
    many are drawn where not all are."""
    run = shutil.copytree(trained, tmp_path / "run")
    monkeypatch.setattr(errors, "LINES", ())
    assert qrl("evaluate", run, "--starts", "5", "--beside", trained, trained) == 0
    result = json.loads((run / "evaluation.json").read_text())
    beside = result["beside"][str(trained)]
    assert {name: result[name] for name in beside} == beside
    said = capsys.readouterr().out
    assert said.count(str(trained)) == 1
    assert "evaluation.png shows the first 0 of 1 beside the policy" in said
    assert result["failed"] == len(result["failures"]) == round(5 * (1 - result["success"]))
    assert [each.keys() for each in result["failures"]] == [{"start", "angle_rad", "rate_rad_s", "reason"}] * 5
    assert "5 of 5 starts failed: 0 1 2 3 4 (qrl view RUN --starts 0 replays one)" in said


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"name": "hover", "spec": {"extend": "hover"}}, "found one of 'hover'"),
        ({"evaluation": {"tail_s": 1.0}}, "'pendulum' that differs"),
        (None, "not a run folder"),
    ],
)
def test_beside_refuses_another_task(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict | None, says: str
) -> None:
    """By its name, and by how it is judged; before anything is flown."""
    other = tmp_path / "other"
    other.mkdir()
    if change:
        config = json.loads((trained / "config.json").read_text())
        if "name" in change:
            config["task"] = change
        else:
            config["task"]["spec"]["evaluation"] |= change["evaluation"]
        (other / "config.json").write_text(json.dumps(config))
    line = complaint(capsys, "evaluate", trained, "--starts", "5", "--beside", other)
    assert says in line
    assert str(other) in line


def test_beside_needs_a_checkpoint(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = shutil.copytree(trained, tmp_path / "other")
    shutil.rmtree(other / "checkpoints")
    line = complaint(capsys, "evaluate", trained, "--starts", "5", "--beside", other)
    assert line.rstrip().endswith(f"{other}: --beside: no checkpoint")


def test_off_nominal_is_for_quadrotors(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--off-nominal: expected" in complaint(capsys, "evaluate", trained, "--off-nominal")


def test_resume_of_a_finished_run_changes_nothing(trained: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in trained.rglob("*")}
    assert qrl("train", "pendulum", "--out", trained, "--resume") == 0
    assert {path: path.stat().st_mtime_ns for path in trained.rglob("*")} == before


def test_run_that_exists_is_refused(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "holds a run already" in complaint(capsys, "train", "pendulum", "--out", trained)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["hover"], "not the same task"),
        (["pendulum", "--seed", "3"], "key 'seed' is 0, found 3"),
        (["pendulum", "--gamma", "0.5"], "key 'learner.gamma' is 0.9"),
        (["pendulum", "--preset", "circle"], "key 'learner.num_timesteps' is"),
    ],
)
def test_resume_of_another_run_is_refused(
    trained: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    assert says in complaint(capsys, "train", *words, "--out", trained, "--resume")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["hoverr"], "unknown task 'hoverr' (did you mean 'hover'?)"),
        (["inverted_pendulun"], "did you mean 'inverted_pendulum'?"),
        ([], "no task given"),
        (["nowhere.json"], "nowhere.json: cannot be read"),
        (["hover", "--num-timestepz", "3"], "unknown flag --num-timestepz (did you mean --num-timesteps?)"),
        (["hover", "--step", "3"], "unknown flag --step (did you mean --num-timesteps?)"),  # near the former --steps
        (
            ["hover", "--num-timesteps", "many"],
            "command line: key 'num_timesteps': expected a valid integer, found \"many\"",
        ),
        (
            ["hover", "--num-timesteps", "-5"],
            "command line: key 'num_timesteps': expected greater than or equal to 1, found -5",
        ),
        (["hover", "--gamma", "1.5"], "key 'gamma': expected less than or equal to 1, found 1.5"),
        (["hover", "--preset", "hovr"], "--preset: no preset 'hovr' (did you mean 'hover'?)"),
        (["hover", "--seed", "x"], "--seed: invalid whole_number value: 'x'"),
        (["hover", "--form", "quotient"], "key 'form': expected 'ratio' or 'difference', found \"quotient\""),
        (["hover", "--observation-scale", "[1,2]"], "expected 18 numbers"),
        (["hover", "--num-timesteps", "100"], "expected num_timesteps of at least"),
        (["hover", "--config", "nowhere.json"], "nowhere.json: cannot be read"),
        (["hover", "--num-timesteps", "1e20"], "key 'num_timesteps': expected less than 2147483648"),
        (["hover", "--seed", "1e20"], "--seed: invalid whole_number value: '1e20'"),
    ],
)
def test_wrong_input_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    """Exit code 2, the flag or file and what was expected; nothing is left behind."""
    assert says in complaint(capsys, "train", *words, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"learner": {"gama": 0.9}}', "learner: unknown key 'gama' (did you mean 'gamma'?)"),
        ('{"learnr": {}}', "unknown key 'learnr' (did you mean 'learner'?)"),
        ('{"learner": {"num_envs": "four"}}', "key 'num_envs': expected a valid integer, found \"four\""),
        ('{"task": "circle"}', "expected the task asked for, 'hover', found 'circle'"),
        ('{"seed": -1}', "key 'seed': expected greater than or equal to 0, found -1"),
        ("[1, 2]", "expected a JSON object, found list"),
    ],
)
def test_wrong_config_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, says: str
) -> None:
    """The line names the file."""
    file = tmp_path / "mine.json"
    file.write_text(content)
    line = complaint(capsys, "train", "hover", "--config", file, "--out", tmp_path / "run")
    assert says in line
    assert "mine.json" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"seed": 3}', "key 'seed' is 0, found 3"),
        ('{"learner": {"lam": 0.5}}', "key 'learner.lam' is 1.0, asked for 0.5"),
    ],
)
def test_resume_with_another_config_is_refused(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, says: str
) -> None:
    """What CONFIG says counts as asked for; what it leaves out does not."""
    file = tmp_path / "mine.json"
    file.write_text(content)
    assert says in complaint(capsys, "train", "pendulum", "--config", file, "--out", trained, "--resume")
    file.write_text('{"seed": 0}')
    assert qrl("train", "pendulum", "--config", file, "--out", trained, "--resume") == 0


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"task": {"name": "x", "spec": {"extend": "hoverr"}}}', "did you mean 'hover'?"),
        ('{"task": {"name": "nope", "spec": null}}', "unknown task 'nope'"),
    ],
)
def test_wrong_task_in_a_config_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, says: str
) -> None:
    file = tmp_path / "mine.json"
    file.write_text(content)
    line = complaint(capsys, "train", "--config", file, "--out", tmp_path / "run")
    assert says in line
    assert "mine.json" in line


def test_run_folder_named_from_here(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in runs/circle: evaluated, and gone on with."""
    shutil.copytree(trained, tmp_path / "runs" / "mine")
    monkeypatch.chdir(tmp_path)
    assert qrl("evaluate", "runs/mine", "--starts", "5") == 0
    (tmp_path / "runs" / "mine" / "summary.json").unlink()
    assert qrl("train", "pendulum", "--out", "runs/mine", "--resume") == 0
    assert (tmp_path / "runs" / "mine" / "summary.json").exists()


def test_out_that_is_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert "expected a folder" in complaint(capsys, "train", "hover", "--out", tmp_path / "file")


def test_evaluate_of_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not a run folder" in complaint(capsys, "evaluate", tmp_path)


@pytest.mark.skipif(not STRESS, reason="part of make stress: Brax's own physics take a minute to compile")
def test_foreign_environment_trains(tmp_path: Path) -> None:
    """Our learner on one of Brax's own environments, which measures no success."""
    assert qrl("train", "inverted_pendulum", "--out", tmp_path / "run", "--episode-length", "20", *TINY.split()) == 0
    rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    assert rows[1].split(",")[4] == ""  # success
    assert not (tmp_path / "run" / "flight.png").exists()


def test_foreign_environment_resumes(trained_foreign: Path, tmp_path: Path) -> None:
    """Its rows have empty cells: a run that lost its end goes on all the same."""
    run = shutil.copytree(trained_foreign, tmp_path / "run")
    rows = (run / "metrics.csv").read_text().splitlines()[1:]
    assert [row.split(",")[4] for row in rows] == ["", ""]  # success
    (run / "summary.json").unlink()
    shutil.rmtree(run / "checkpoints" / "400")
    assert qrl("train", "fast", "--out", run, "--resume") == 0
    assert (run / "metrics.csv").read_text().count("\n") == 3

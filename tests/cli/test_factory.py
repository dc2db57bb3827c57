"""TASK=module:factory end to end: an environment of the user's own, from a module in the current folder."""

import json
import shutil
import sys
from pathlib import Path

import pytest

from cli_helpers import TINY, complaint, qrl

MODULE = '''
import jax.numpy as jnp
from jax import random
from qrl_envs.task_env import State


class Slider:
    """A point on a line, moved by its action; the reward is highest at 0."""

    observation_size, action_size, dt = 1, 1, 0.1

    def reset(self, rng):
        x = random.uniform(rng, (1,), minval=-1.0)
        return State(x, x, jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state, action):
        x = state.pipeline_state + self.dt * action
        return state.replace(pipeline_state=x, obs=x, reward=-jnp.sum(x**2))


def slider():
    return Slider()


def exits():
    raise SystemExit(3)
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with the module `user_envs`, and `broken_envs`, which cannot be imported."""
    (tmp_path / "user_envs.py").write_text(MODULE)
    (tmp_path / "broken_envs.py").write_text("1 / 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # taken off sys.path again at the end
    monkeypatch.delitem(sys.modules, "user_envs", raising=False)
    return tmp_path


def test_it_trains_resumes_and_is_evaluated(folder: Path) -> None:
    """The run folder is named after the factory; config.json has the task's full name."""
    assert qrl("train", "user_envs:slider", "--episode-length", "20", *TINY.split()) == 0
    run = folder / "runs" / "slider"
    assert json.loads((run / "config.json").read_text())["task"] == {"name": "user_envs:slider", "spec": None}
    assert qrl("evaluate", run, "--starts", "5") == 0
    assert json.loads((run / "evaluation.json").read_text())["starts"] == 5
    metrics = (run / "metrics.csv").read_text()
    (run / "summary.json").unlink()
    shutil.rmtree(run / "checkpoints" / "400")
    assert qrl("train", "user_envs:slider", "--resume") == 0
    again = (run / "metrics.csv").read_text()
    assert [row.split(",")[:4] for row in again.splitlines()] == [row.split(",")[:4] for row in metrics.splitlines()]
    assert qrl("train", "--config", run / "config.json", "--out", folder / "again") == 0


@pytest.mark.parametrize(
    ("task", "says"),
    [
        ("broken_envs:slider", "module 'broken_envs' cannot be imported: ZeroDivisionError"),
        (":slider", "module '' cannot be imported"),
        ("user_envs:", "module 'user_envs' has no function ''"),
        ("user_envs:exits", "exits() failed: SystemExit: 3"),
    ],
)
def test_one_that_cannot_be_made_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], task: str, says: str
) -> None:
    assert f"task '{task}': {says}" in complaint(capsys, "train", task)
    assert not (folder / "runs").exists()


@pytest.mark.parametrize("task", ["user_envs:slidr", {"name": "user_envs:slidr", "spec": None}])
def test_a_wrong_one_in_a_file_is_refused_by_the_files_name(
    folder: Path, capsys: pytest.CaptureFixture[str], task: str | dict
) -> None:
    (folder / "mine.json").write_text(json.dumps({"task": task}))
    line = complaint(capsys, "train", "--config", folder / "mine.json")
    assert "mine.json: key 'task" in line
    assert "did you mean 'slider'?" in line

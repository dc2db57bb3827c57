"""It learns: two presets that ship, to a bar each."""

from pathlib import Path

import pytest

from qrl.config import Config
from qrl.runs import files
from qrl.runs.record import RunConfig, TaskRecord
from qrl_envs import env as worlds
from small_run import train


@pytest.mark.parametrize(("task", "measure", "bar"), [("pendulum", "return_mean", -160.0), ("hover", "success", 0.9)])
def test_the_fast_preset_reaches_its_bar(tmp_path: Path, task: str, measure: str, bar: float) -> None:
    """On a seed that nobody tuned on."""
    config = Config.preset(f"{task}_fast").model_copy(update={"num_evals": 1})
    run = RunConfig(task=TaskRecord(name=task, spec=None), learner=config, seed=1000, seeds=1, versions={}, devices=[])
    train(tmp_path, run, worlds.make(task))
    (row,) = files.read_metrics(tmp_path)
    assert row[measure] >= bar

"""The command line before JAX is loaded, and environments of the user's own."""

import gc
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import pytest
from pydantic import ValidationError

from qrl import request, tasks
from qrl.cli import main as cli
from qrl.cli.arguments import parse
from qrl.cli.main import RARE_COLLECTIONS, _note_former_names, limit_size, main
from qrl.config import FORMER_NAMES, Config, load_preset, preset_names
from qrl.request import config_file
from qrl.runs import files
from qrl.runs.record import ConfigFile
from qrl_envs.specfile import BadInput


@pytest.mark.parametrize("code", [0, 2])
def test_garbage_is_collected_rarely_in_a_command(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """And as before after it, whether it ends well or is told that its input is wrong."""
    before, within = gc.get_threshold(), []
    monkeypatch.setattr(cli, "configure_jax", lambda: within.append((gc.isenabled(), gc.get_threshold())))
    assert main(["tasks"] if code == 0 else ["view", "no such run"]) == code
    assert within == [(True, RARE_COLLECTIONS)]
    assert gc.get_threshold() == before


def test_ctrl_c_in_an_import_is_said_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):  # which would end the tests
        patch.setattr(cli, "configure_jax", lambda: None)
        patch.setitem(sys.modules, "qrl.training.driver", Interrupted("driver"))
        assert main(["view", "no such run"]) == 1
    assert capsys.readouterr().err == "qrl: interrupted\n"


@pytest.mark.parametrize(("former", "name"), FORMER_NAMES.items())
def test_a_former_flag_sets_what_it_is_called_now(former: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """And says so; the flag of today says nothing."""
    assert name in Config.model_fields
    flags = [f"--{each.replace('_', '-')}" for each in (former, name)]
    given = [vars(parse(["train", "hover", flag, "7"]))[f"learner.{name}"] for flag in flags]
    assert given == ["7", "7"]
    assert capsys.readouterr().out == f"note: {flags[0]} is now {flags[1]}\n"


def test_former_names_in_a_file_are_those_of_today(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text('{"learner": {"lanes": 8, "gamma": 0.9}}')
    assert config_file(path).learner == {"num_envs": 8, "gamma": 0.9}
    path.write_text('{"learner": {"lanes": 8, "num_envs": 8}}')
    with pytest.raises(BadInput, match=r"config\.json: learner: key 'lanes': is called 'num_envs' now"):
        config_file(path)


def test_a_whole_record_repeats_its_run(tmp_path: Path) -> None:
    """Also where it has a default, which is not written, and its task's preset has not; a part is laid over that."""
    plain = {"policy_gru_size": None, "apg_split": 1, "apg_split_fraction": 0.0, "apg_cotangent_norm": None}
    run = request.run_config("track", None, ConfigFile(), plain, None, None)
    path = tmp_path / "config.json"
    files.write_json(path, run.model_dump(mode="json"))
    assert not plain.keys() & json.loads(path.read_text())["learner"].keys()
    again = request.run_config(None, path, config_file(path), {}, None, None)
    assert again.learner == run.learner
    path.write_text('{"task": "track", "learner": {"gamma": 0.5}}')
    part = request.run_config(None, path, config_file(path), {}, None, None)
    assert (part.learner.gamma, part.learner.policy_gru_size) == (0.5, load_preset("track")["policy_gru_size"])


@pytest.mark.parametrize(("split", "fraction"), [(4, 0.0), (1, 0.5)])
def test_half_of_a_split_is_refused(split: int, fraction: float) -> None:
    """It would do nothing. The presets that ship have both or neither."""
    for name in preset_names():
        Config.preset(name)
    values = load_preset("default") | {"apg_split": split, "apg_split_fraction": fraction}
    with pytest.raises(ValidationError, match="expected apg_split above 1 and apg_split_fraction above 0, or neither"):
        Config.model_validate(values, strict=False)


def test_a_file_with_a_former_name_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a flag is; in a task, `episode_steps` is today's name."""
    path = tmp_path / "file.json"
    path.write_text(
        '{"task": {"spec": {"episode_steps": 1}}, "learner": {"lanes": 8}, "axes": {"m": {"a": {"steps": 1}}}}'
    )
    _note_former_names(path)
    notes = {f"note: {path}: lanes is now num_envs", f"note: {path}: steps is now num_timesteps"}
    assert set(capsys.readouterr().out.splitlines()) == notes
    _note_former_names(tmp_path / "nowhere.json")
    _note_former_names(None)
    assert not capsys.readouterr().out


def test_help_gives_type_and_default_of_each_hyperparameter(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(["train", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "--num-envs INT environments stepped in parallel (lanes) (default 64)" in text
    assert "--form ratio|difference" in text
    assert "--observation-scale [FLOAT,…]" in text
    assert "--lanes" not in text


def test_the_compile_cache_keeps_the_newest(tmp_path: Path) -> None:
    for age in range(4):
        file = tmp_path / str(age)
        file.write_bytes(b"x" * 10)
        os.utime(file, (1000 - age, 1000 - age))
    limit_size(tmp_path, 25)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0", "1"]
    limit_size(tmp_path / "nowhere", 25)


MODULE = """
from brax.envs.fast import Fast

def make():
    return Fast()

def number():
    return 3

def fails():
    raise RuntimeError("no license")
"""


def test_a_task_is_a_function_of_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_worlds.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    record = tasks.task_record("my_worlds:make")
    assert (record.name, record.spec, tasks.folder_name(record)) == ("my_worlds:make", None, "make")
    assert tasks.environment(record).action_size == 1
    for name, why in {
        "my_worlds:fails": "no license",
        "my_worlds:number": "found int without reset, step",
        "my_worlds:mak": "did you mean 'make'",
        "my_world:make": "No module named 'my_world'",
    }.items():
        with pytest.raises(BadInput, match=f"task '{name}': .*{why}"):
            tasks.task_record(name)


@pytest.mark.parametrize("task", ["track", "any"])
@pytest.mark.parametrize("period_s", [0.003, 0.007, 0.012, 0.02])
def test_flights_that_are_split_carry_over_to_other_periods(task: str, period_s: float, tmp_path: Path) -> None:
    """Their seconds stay, to a part's step, and the parts are of one length."""
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"extend": task, "control_period_s": period_s, "preview_s": []}))
    values = tasks.task_preset(tasks.task_record(str(path)), "here")
    config = Config.model_validate_json(json.dumps(values))
    flight_s = {"track": 8.0, "any": 4.0}[task]
    assert abs(config.apg_episode_length * period_s - flight_s) <= config.apg_split * period_s

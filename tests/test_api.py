"""The Python API: what it takes, what it refuses, and what it leaves of the process as it was."""

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import qrl
from cli_helpers import TINY_VALUES
from qrl import api
from qrl.cli import train as command
from qrl_envs.specfile import BadInput

TINY: dict[str, Any] = TINY_VALUES | {"quiet": True}


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


class Asked(Exception):
    """Instead of training: what would be trained."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The plans that `train` would run; each call ends by Asked."""
    plans: list[Any] = []

    def run(plan: Any, _: Any) -> None:
        plans.append(plan)
        raise Asked

    monkeypatch.setattr(command, "run", run)
    return plans


def planned(asked: list[Any], *args: Any, **more: Any) -> Any:
    """The learner that `train` would run with."""
    with pytest.raises(Asked):
        qrl.train(*args, **more, quiet=True)
    return asked[-1].config


def test_a_finished_run_is_returned_with_the_default_folder(tmp_path: Path) -> None:
    """runs/TASK; without `resume` it is refused in the words of Python."""
    first = qrl.train("pendulum", **TINY)
    assert first.folder == Path("runs/pendulum")
    metrics = (tmp_path / "runs/pendulum/metrics.csv").read_bytes()
    again = qrl.train("pendulum", resume=True, quiet=True)
    assert again.folder == first.folder
    np.testing.assert_array_equal(again.policy([1.0, 0.0, 0.0]), first.policy([1.0, 0.0, 0.0]))
    assert (tmp_path / "runs/pendulum/metrics.csv").read_bytes() == metrics
    with pytest.raises(BadInput, match=r"^runs/pendulum: holds a run already; give another out, or resume=True"):
        qrl.train("pendulum", **TINY)
    memory, action = again.policy.apply(again.policy.init_memory(), jnp.array([1.0, 0.0, 0.0]))
    assert memory == ()
    assert action.shape == (1,)
    assert again.evaluate(starts=3).keys() >= {"return_mean", "success"}


@pytest.mark.parametrize("before", [None, "2"])
def test_threads_are_not_taken_for_the_users_choice(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch, before: str | None
) -> None:
    """A small run sets PJRT_NPROC while it is made, unless the user has; afterwards it is as it was."""
    seen: list[str | None] = []
    original = command.make_plan
    monkeypatch.setattr(
        command, "make_plan", lambda *words: (original(*words), seen.append(os.environ.get("PJRT_NPROC")))[0]
    )
    monkeypatch.delenv("NPROC", raising=False)
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    if before:
        monkeypatch.setenv("PJRT_NPROC", before)
    for folder in ("a", "b"):
        planned(asked, "pendulum", out=folder, preset="pendulum_fast", num_shards=1)
        assert os.environ.get("PJRT_NPROC") == before
    assert seen == [before or "1"] * 2


def test_task_vehicle_config_seed_and_out_are_positional(asked: list[Any]) -> None:
    config = qrl.Config.preset("pendulum").model_copy(update={"gamma": 0.5})
    run = planned(asked, "pendulum", None, config, np.int64(7), "here")
    assert (run.learner, run.seed, asked[-1].out) == (config, 7, Path("here"))


def test_a_config_is_all_there_is(asked: list[Any], tmp_path: Path) -> None:
    """Also where it has a default, which is not written to files, and the task's preset has not."""
    (tmp_path / "mine.json").write_text('{"extend": "pendulum", "preset": "track"}')
    config = qrl.Config.preset("pendulum")
    assert planned(asked, "mine.json", config=config).learner == config


def test_without_a_seed_it_is_that_of_the_file_or_of_the_run(asked: list[Any], tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text('{"seed": 7}')
    assert planned(asked, "pendulum", config="mine.json", out="a").seed == 7
    assert planned(asked, "pendulum", out="a", resume=True).seed == 7
    assert planned(asked, "pendulum", out="b").seed == 0


def test_a_share_too_small_for_apg_is_said(asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    """Of 250 unrolls of 800 steps, for flights of 64 × 200."""
    for fraction, said in ((0.05, 1), (0.1, 0)):
        planned(asked, "pendulum", apg_fraction=fraction, out=str(fraction))
        line = f"warning: apg_fraction {fraction}: no update of APG, which takes 12,800 steps, fits into that share of"
        assert capsys.readouterr().err.count(f"qrl: {line} 200,000\n") == said


def test_a_vehicle_flies_the_task(asked: list[Any]) -> None:
    assert planned(asked, "circle", "crazyflie").task.spec["vehicle"]["mass_kg"] == 0.03
    assert asked[-1].out == Path("runs/circle_crazyflie")


def test_a_file_gives_hyperparameters_too(asked: list[Any], tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text('{"learner": {"gamma": 0.5, "lam": 0.25}}')
    learner = planned(asked, "pendulum", config="mine.json", lam=0.75).learner
    assert (learner.gamma, learner.lam) == (0.5, 0.75)


def test_numpy_values_are_welcome(asked: list[Any]) -> None:
    given: dict[str, Any] = {
        "gamma": np.float32(0.9),
        "lam": jnp.float32(0.5),
        "epsilon": np.array(0.3),
        "num_envs": np.int64(32),
        "num_timesteps": np.float64(2e5),
        "symmetries": np.bool_(False),
        "policy_hidden_layer_sizes": np.array([8, 8]),
        "critic_hidden_layer_sizes": [np.int32(16)],
        "observation_scale": jnp.array([1.0, 1.0, 0.5]),
        "xi": None,
        "form": "difference",
    }
    learner = planned(asked, "pendulum", **given).learner
    assert learner.gamma == float(np.float32(0.9))
    assert (learner.lam, learner.epsilon, learner.num_envs, learner.num_timesteps) == (0.5, 0.3, 32, 200_000)
    assert (learner.symmetries, learner.xi, learner.form) == (False, None, "difference")
    assert (learner.policy_hidden_layer_sizes, learner.critic_hidden_layer_sizes) == ((8, 8), (16,))
    assert learner.observation_scale == (1.0, 1.0, 0.5)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"gamma": "0.9"}, "qrl.train: gamma: expected a valid number, found '0.9'"),
        ({"gamma": np.float32(1.5)}, "qrl.train: gamma: expected less than or equal to 1"),
        ({"gamma": float("nan")}, "qrl.train: gamma: expected a finite number"),
        ({"gamma": object()}, "qrl.train: gamma: expected a valid number"),
        ({"gamma": np.array([0.9])}, "qrl.train: gamma: expected a valid number"),
        ({"num_envs": 2.5}, "qrl.train: num_envs: expected a valid integer"),
        ({"num_envs": True}, "qrl.train: num_envs: expected a valid integer"),
        ({"num_envs": None}, "qrl.train: num_envs: expected a valid integer"),
        ({"learning_rate": 1e-40}, "qrl.train: learning_rate: expected a magnitude that single precision holds"),
        ({"policy_hidden_layer_sizes": 64}, "qrl.train: policy_hidden_layer_sizes: expected a valid tuple"),
        ({"form": "sum"}, "qrl.train: form: expected 'ratio' or 'difference', found 'sum'"),
        ({"batch_siz": 4}, "qrl.train: unknown argument 'batch_siz' (did you mean 'batch_size'?)"),
        ({"resum": True}, "qrl.train: unknown argument 'resum' (did you mean 'resume'?)"),
        ({"seed": -1}, "qrl.train: seed: expected greater than or equal to 0, found -1"),
        ({"seed": "1"}, "qrl.train: seed: expected a valid integer, found '1'"),
        ({"task": "hoover"}, "unknown task 'hoover' (did you mean 'hover'?)"),
        ({"preset": "hoover"}, "--preset: no preset 'hoover'"),
    ],
)
def test_wrong_input_gets_one_line(asked: list[Any], tmp_path: Path, given: dict[str, Any], says: str) -> None:
    with pytest.raises(BadInput) as error:
        qrl.train(**({"task": "pendulum", "quiet": True} | given))
    assert str(error.value).startswith(says)
    assert "\n" not in str(error.value)
    assert not asked
    assert not (tmp_path / "runs").exists()


def test_a_preset_and_a_config_are_refused_together(asked: list[Any]) -> None:
    with pytest.raises(BadInput, match="expected preset or a Config, found both"):
        qrl.train("pendulum", config=qrl.Config.preset("pendulum"), preset="pendulum_fast")
    assert not asked


def test_former_names_are_read_with_a_warning(asked: list[Any]) -> None:
    with pytest.warns(FutureWarning, match="lanes is now num_envs") as warned:
        learner = planned(asked, "pendulum", lanes=32).learner
    assert learner.num_envs == 32
    assert warned[0].filename == __file__
    with (
        pytest.warns(FutureWarning),
        pytest.raises(BadInput, match="'lanes': is called 'num_envs' now, and both are given"),
    ):
        qrl.train("pendulum", lanes=32, num_envs=32)


def test_a_former_name_overrides_a_config(asked: list[Any]) -> None:
    with pytest.warns(FutureWarning, match="lanes is now num_envs"):
        assert planned(asked, "pendulum", config=qrl.Config.preset("pendulum"), lanes=32).learner.num_envs == 32


def test_a_configured_compilation_cache_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One that the program has set; without one, qrl's own."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = getattr(jax.config, api.CACHE)
    try:
        for folder, expected in ((tmp_path / "mine", tmp_path / "mine"), (None, tmp_path / "qrl" / "xla")):
            jax.config.update(api.CACHE, folder and str(folder))
            with pytest.raises(BadInput, match="not a run folder"):
                qrl.load(tmp_path / "none")
            assert getattr(jax.config, api.CACHE) == str(expected)
    finally:
        jax.config.update(api.CACHE, before)


def test_names_are_imported_lazily() -> None:
    assert set(qrl.__all__) <= set(dir(qrl))
    assert qrl.Run is api.Run
    with pytest.raises(AttributeError, match="no attribute 'tarin'"):
        _ = qrl.tarin

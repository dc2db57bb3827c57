"""`qrl train --init`: a run that begins with the policy of another."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from cli_helpers import complaint, qrl
from qrl import tasks
from qrl.evaluation import initial
from qrl_envs.uncertainty import uncertainty_data
from qrl_envs.vehicle import vehicle_data

# One update of APG whose step is too small to change a float32.
STILL = [
    "--num-timesteps",
    "20",
    "--num-envs",
    "2",
    "--unroll-length",
    "10",
    "--apg-num-envs",
    "2",
    "--apg-episode-length",
    "10",
    "--num-evals",
    "1",
    "--num-eval-envs",
    "2",
    "--critic-hidden-layer-sizes",
    "[4]",
    "--apg-learning-rate",
    "1e-30",
]


@pytest.fixture(scope="module")
def source(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a run of policies of 4 tanh units."""
    return shutil.copytree(trained, tmp_path_factory.mktemp("source") / "pendulum")


@pytest.fixture(scope="module")
def begun(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("begun") / "run"
    assert qrl("train", "pendulum", "--init", source, "--seed", 3, "--out", out, *STILL) == 0
    return out


def config(folder: Path) -> dict:
    return json.loads((folder / "config.json").read_text())


def test_it_begins_with_that_policy_and_its_network(source: Path, begun: Path) -> None:
    expected, found = (initial.load(str(folder)) for folder in (source, begun))
    jax.tree.map(np.testing.assert_array_equal, found.policy, expected.policy)
    assert found.init.sha256 == expected.init.sha256
    values, theirs = config(begun)["learner"], config(source)["learner"]
    for key in tasks.NETWORK:
        assert values.get(key) == theirs.get(key)  # what is null by default is left out
    assert values["apg_fraction"] == 1.0


def test_its_config_repeats_it(source: Path, begun: Path, tmp_path: Path) -> None:
    assert config(begun)["init"] == {"run": str(source), "sha256": initial.load(str(source)).init.sha256}
    assert qrl("train", "--config", begun / "config.json", "--out", tmp_path / "again") == 0
    first, again = (initial.load(str(folder)) for folder in (begun, tmp_path / "again"))
    jax.tree.map(np.testing.assert_array_equal, again.policy, first.policy)


def test_another_policy_in_its_place_is_refused(
    begun: Path, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = config(begun)
    given["init"]["sha256"] = "0" * 64
    file = tmp_path / "config.json"
    file.write_text(json.dumps(given))
    said = complaint(capsys, "train", "--config", file, "--out", tmp_path / "run")
    assert str(source) in said
    assert "expected the policy that the run begins with" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["hover"], "world"),
        (["pendulum", "--policy-hidden-layer-sizes", "[8]"], "policy_hidden_layer_sizes"),
        (["pendulum", "--observation-scale", "[1, 1, 1]"], "observation_scale"),
        (["pendulum", "--observation-limit", "[null, 0.5]"], "observation_limit"),
    ],
)
def test_what_its_network_does_not_fit_is_refused(
    words: list[str], key: str, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = complaint(capsys, "train", *words, "--init", source, "--out", tmp_path / "run", *STILL)
    assert f"key '{key}'" in said
    assert not (tmp_path / "run").exists()


def test_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not a run folder" in complaint(capsys, "train", "pendulum", "--init", tmp_path / "nothing")


def test_any_vehicle_with_one_is_of_that_one() -> None:
    spec = tasks.task_record("any", {"vehicle": "hummingbird"}).spec
    assert spec is not None
    assert "distribution" not in spec
    assert spec["vehicle"]["mass_kg"] == vehicle_data("hummingbird")["mass_kg"]
    ranges = uncertainty_data("default")
    assert {key: spec["uncertainty"][key] for key in ranges} == ranges
    # Its motors in the order that a policy of any vehicle knows.
    known = tasks.task_record("any").spec
    assert known is not None
    for own, theirs in zip(spec["vehicle"]["motors"], known["vehicle"]["motors"], strict=True):
        assert np.sign(own["position_m"][:2]).tolist() == np.sign(theirs["position_m"][:2]).tolist()
        assert own["spin"] == theirs["spin"]


def test_its_uncertainty_may_be_another() -> None:
    spec = tasks.task_record("any", {"vehicle": "hummingbird", "uncertainty": "none"}).spec
    assert spec is not None
    assert spec["uncertainty"] == tasks.task_record("hover", {"uncertainty": "none"}).spec["uncertainty"]  # type: ignore[index]

"""Programs that are traced once on a machine, and when they are traced again."""

from pathlib import Path
from typing import Any

import jax
import pytest
from brax.envs.base import State

from fault_injection import assert_same_leaves, leaves
from qrl.runs.record import TaskRecord
from qrl.training import traced
from qrl.training.traced import Store
from qrl_envs import task
from qrl_envs.pendulum_env import PendulumEnv
from small_run import comparable_metrics, run_config, train

APG = {"apg_fraction": 0.4, "apg_num_envs": 4, "apg_episode_length": 20}


class Counting(PendulumEnv):
    """Counts how often it is traced."""

    def __init__(self) -> None:
        super().__init__(task.load("pendulum"))
        self.traces = 0

    def step(self, state: State, action: jax.Array) -> State:
        self.traces += 1
        return super().step(state, action)

    def reset(self, rng: jax.Array) -> State:
        self.traces += 1
        return super().reset(rng)


def flown(out: Path, store: Store | None, **changes: object) -> int:
    """How often a run's environment was traced."""
    env = Counting()
    train(out, run_config(**APG, **changes), env, store=store)
    return env.traces


def assert_same_runs(ours: Path, expected: Path) -> None:
    assert_same_leaves(leaves(ours), leaves(expected))
    assert comparable_metrics(ours) == comparable_metrics(expected)


def test_a_second_run_traces_nothing_and_has_the_bits_of_the_first(tmp_path: Path) -> None:
    """And of a run that keeps no program; another seed, too, is the same program."""
    store = Store(tmp_path / "store", "these settings")
    assert flown(tmp_path / "first", store) > 0
    assert flown(tmp_path / "second", store) == 0
    assert flown(tmp_path / "without", None) > 0
    assert_same_runs(tmp_path / "second", tmp_path / "first")
    assert_same_runs(tmp_path / "second", tmp_path / "without")
    assert flown(tmp_path / "other seed", store, seed=1) == 0


@pytest.mark.parametrize("damage", ["cut short", "one bit", "empty"])
def test_what_was_damaged_is_traced_again(tmp_path: Path, damage: str) -> None:
    def double(x: jax.Array) -> dict[str, jax.Array]:
        calls.append(x)
        return {"twice": 2.0 * x}

    calls: list[Any] = []
    store, args = Store(tmp_path, "these settings"), (jax.numpy.ones(3),)
    traced.trace(store, "double", double, args)
    (path,) = tmp_path.glob("qrl-double-*")
    whole = path.read_bytes()
    damaged = {"cut short": whole[:-1], "one bit": whole[:-1] + bytes([whole[-1] ^ 1]), "empty": b""}
    path.write_bytes(damaged[damage])
    program = traced.trace(store, "double", double, args).compile(args, {}, donated=False)
    assert program(jax.numpy.full(3, 4.0))["twice"].tolist() == [8.0] * 3
    assert len(calls) == 2
    assert path.read_bytes()[32:] != damaged[damage][32:]
    traced.trace(store, "double", double, args)
    assert len(calls) == 2


def test_programs_are_kept_apart_by_all_that_they_are_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings, sources, versions, devices; not the seed, of which no program knows."""
    run = run_config().model_copy(update={"task": TaskRecord(name="pendulum", spec={"world": "pendulum"})})

    def of(**changes: Any) -> str:
        found = Store.of_run(run.model_copy(update=changes))
        assert found is not None
        return found.of

    known = {of()}
    assert of(seed=7) in known
    for changes in (
        {"seeds": 2},
        {"task": TaskRecord(name="pendulum", spec={"world": "pendulum", "episode_s": 1.0})},
        {"learner": run.learner.model_copy(update={"gamma": 0.5})},
    ):
        known.add(of(**changes))
    with jax.enable_x64(True):
        known.add(of())
    with monkeypatch.context() as patch:
        patch.setattr(traced, "_sources", lambda: "edited")
        known.add(of())
    with monkeypatch.context() as patch:
        patch.setattr(traced.importlib.metadata, "version", lambda name: "0")
        known.add(of())
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX")
        known.add(of())
    assert len(known) == 8
    assert Store.of_run(run_config()) is None  # an environment whose source is not known
    with jax.debug_nans(True):
        assert Store.of_run(run) is None


def test_sources_are_every_module_and_data_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An edit, another name and a new file each make another fingerprint."""
    package = tmp_path / "made_up"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "table.json").write_text("1")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(traced, "PACKAGES", ("made_up",))
    known = {traced._sources()}
    (package / "table.json").write_text("2")
    known.add(traced._sources())
    (package / "table.json").rename(package / "other.json")
    known.add(traced._sources())
    (package / "new.py").write_text("")
    known.add(traced._sources())
    assert len(known) == 4


def test_a_full_disk_costs_a_run_nothing(tmp_path: Path) -> None:
    """The folder cannot be made: the program is traced and used."""
    (tmp_path / "file").write_text("")
    store, args = Store(tmp_path / "file" / "store", "these settings"), (jax.numpy.ones(3),)
    program = traced.trace(store, "double", lambda x: 2.0 * x, args).compile(args, {}, donated=True)
    assert program(jax.numpy.full(3, 4.0)).tolist() == [8.0] * 3

"""Programs that are traced once on a machine, and when they are traced again."""

from pathlib import Path
from typing import Any, NamedTuple

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
    """Counts how often it is traced, copies of it with other parameters too."""

    def __init__(self) -> None:
        super().__init__(task.load("pendulum"))
        self.traces: list[str] = []  # shared by copies

    def step(self, state: State, action: jax.Array) -> State:
        self.traces.append("step")
        return super().step(state, action)

    def reset(self, rng: jax.Array) -> State:
        self.traces.append("reset")
        return super().reset(rng)


def flown(out: Path, store: Store | None, **changes: object) -> int:
    """How often a run's environment was traced."""
    env = Counting()
    train(out, run_config(**APG, **changes), env, store=store)
    return len(env.traces)


def assert_same_runs(ours: Path, expected: Path) -> None:
    assert_same_leaves(leaves(ours), leaves(expected))
    assert comparable_metrics(ours) == comparable_metrics(expected)


@pytest.mark.parametrize("changes", [{}, {"policy_gru_size": 4, "symmetries": False}], ids=["plain", "recurrent"])
def test_a_second_run_traces_nothing_and_has_the_bits_of_the_first(tmp_path: Path, changes: dict[str, Any]) -> None:
    """And of a run that keeps no program; another seed, too, is the same program."""
    store = Store(tmp_path / "store", "these settings")
    assert flown(tmp_path / "first", store, **changes) > 0
    assert flown(tmp_path / "second", store, **changes) == 0
    assert flown(tmp_path / "without", None, **changes) > 0
    assert_same_runs(tmp_path / "second", tmp_path / "first")
    assert_same_runs(tmp_path / "second", tmp_path / "without")
    assert flown(tmp_path / "other seed", store, seed=1, **changes) == 0


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
    program = traced.trace(store, "double", double, args)
    assert program is not None
    assert program.lower(args, {})()(jax.numpy.full(3, 4.0))["twice"].tolist() == [8.0] * 3
    assert len(calls) == 2
    assert path.read_bytes()[32:] != damaged[damage][32:]
    traced.trace(store, "double", double, args)
    assert len(calls) == 2


def test_programs_are_kept_apart_by_all_that_they_are_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings, sources, versions, devices; not the seed, of which no program knows."""
    run = run_config().model_copy(update={"task": TaskRecord(name="pendulum", spec={"world": "pendulum"})})

    long_after = 1e12

    def of(**changes: Any) -> str:
        found = Store.of_run(run.model_copy(update=changes), long_after)
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
        patch.setattr(traced.Sources, "read", lambda: traced.Sources("other", 0.0))
        known.add(of())
    with monkeypatch.context() as patch:
        patch.setattr(traced.importlib.metadata, "version", lambda name: "0")
        known.add(of())
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX")
        known.add(of())
    assert len(known) == 8
    assert Store.of_run(run_config(), long_after) is None  # an environment whose source is not known
    assert Store.of_run(run, since=0.0) is None  # sources are newer than what the process has read
    with jax.debug_nans(True):
        assert Store.of_run(run, long_after) is None
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert Store.of_run(run, long_after) is None
    finally:
        jax.config.update("jax_enable_compilation_cache", True)


def test_sources_are_every_module_and_data_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An edit, another name and a new file each make another fingerprint."""
    package = tmp_path / "made_up"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "table.json").write_text("1")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(traced, "PACKAGES", ("made_up",))
    known = {traced.Sources.read().digest}
    (package / "table.json").write_text("2")
    known.add(traced.Sources.read().digest)
    (package / "table.json").rename(package / "other.json")
    known.add(traced.Sources.read().digest)
    (package / "new.py").write_text("")
    known.add(traced.Sources.read().digest)
    assert len(known) == 4


def test_a_full_disk_costs_a_run_nothing(tmp_path: Path) -> None:
    """The folder cannot be made: the program is traced and used."""
    (tmp_path / "file").write_text("")
    store, args = Store(tmp_path / "file" / "store", "these settings"), (jax.numpy.ones(3),)
    program = traced.trace(store, "double", lambda x: 2.0 * x, args)
    assert program is not None
    assert program.lower(args, {}, donated=0)()(jax.numpy.full(3, 4.0)).tolist() == [8.0] * 3


def test_what_cannot_be_kept_is_left_to_jax(tmp_path: Path) -> None:
    """A callback; a result of a type that is local to a function."""

    class Local(NamedTuple):
        x: jax.Array

    def calls(x: jax.Array) -> jax.Array:
        jax.debug.print("{}", x)
        return x

    store, args = Store(tmp_path, "these settings"), (jax.numpy.ones(3),)
    assert traced.trace(store, "calls", calls, args) is None
    assert traced.trace(store, "local", lambda x: Local(x), args) is None
    assert not list(tmp_path.glob("qrl-*"))

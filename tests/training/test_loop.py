"""A run on the host: it can stop anywhere and go on to the same bits, and seeds side by side do not mix."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

import haste
import small_run
from fault_injection import assert_same_leaves, leaves
from qrl.algorithm.types import Transition
from qrl.runs import checkpoint, files
from qrl.training import driver, loop, restore, sharding, trainer
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds
from small_run import comparable_metrics, run_config, train


@pytest.fixture(autouse=True)
def _quick_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "CHUNK_SECONDS", 1e-4)  # pause after every unroll or two


@pytest.fixture(scope="module")
def pendulum() -> Env:
    return small_run.pendulum()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, pendulum: Env) -> Path:
    out = tmp_path_factory.mktemp("whole")
    train(out, run_config(), pendulum)
    return out


def test_run_ends_at_its_steps_with_a_row_a_report(whole: Path) -> None:
    """Every report is a row; the last row is the last step; learning waited for the warm-up."""
    rows = files.read_metrics(whole)
    assert [row["env_steps"] for row in rows] == [200, 400, 600, 800, 1000, 1200]
    assert rows[-1]["updates"] == (30 - 2 + 1) * 2
    assert {"env_steps", "updates", "return_mean", "return_min", "success", "train_seconds"} <= set(rows[0])


@pytest.mark.parametrize("stop_after", [1, 3, 4])
def test_resumed_run_equals_one_never_stopped(tmp_path: Path, pendulum: Env, whole: Path, stop_after: int) -> None:
    """Stopped between or at reports and resumed: the same last state and metrics, bit for bit, clocks aside."""
    events = train(tmp_path, run_config(), pendulum, stop_after=stop_after)
    assert not any(isinstance(e, loop.Reported) and e.rows[0]["env_steps"] == 1200 for e in events)
    train(tmp_path, run_config(), pendulum, resume=True)
    assert_same_leaves(leaves(tmp_path), leaves(whole))
    assert comparable_metrics(tmp_path) == comparable_metrics(whole)


@pytest.mark.parametrize("task", ["pendulum", "hover"])
def test_a_restored_state_runs_the_program_of_a_first_one(task: str) -> None:
    """The same to the last letter: so a resumed run finds it compiled, and cannot differ by what XLA makes of it."""
    env, config = worlds.make(task), run_config().learner
    trainer, points = make_trainer(env, config), stack([member_inputs(env, config)])
    first = restore.abstract_states(trainer, points)
    restored = sharding.device_put(None, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), first))
    programs = [trainer.train.lower(states, points, np.int32(0)).as_text() for states in (first, restored)]
    assert programs[0] == programs[1]


def test_rows_after_the_checkpoint_are_cut(tmp_path: Path, pendulum: Env, whole: Path) -> None:
    """Killed before the last checkpoint was made: its row is made again, once, and the run then ends."""
    train(tmp_path, run_config(), pendulum)
    checkpoint.discard_after(tmp_path, 1000)
    train(tmp_path, run_config(), pendulum, resume=True)
    assert comparable_metrics(tmp_path) == comparable_metrics(whole)


def test_seeds_side_by_side_equal_single_runs(tmp_path: Path) -> None:
    """On a CPU a member's state equals, bit for bit, that of the single run of its seed."""
    env = worlds.make("pendulum")  # not that of the others, whose programs are compiled
    with haste.fusions_of_a_user():
        train(tmp_path / "pair", run_config(seeds=2), env)
        for seed in (0, 1):
            folder, single = tmp_path / "pair" / f"seed-{seed}", tmp_path / f"{seed}"
            train(single, run_config(seed=seed), env)
            assert_same_leaves(leaves(folder), leaves(single))
            assert comparable_metrics(folder) == comparable_metrics(single)


def test_saving_several_seeds_takes_a_share_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pendulum: Env
) -> None:
    """Reports that come sooner than that are not saved, the end is, and nothing else changes."""
    monkeypatch.setattr(checkpoint.Writer, "seconds", 1e6, raising=False)  # that a save took
    monkeypatch.setattr(checkpoint.Writer, "__setattr__", _without_seconds)
    train(tmp_path / "few", run_config(seeds=2), pendulum)
    train(tmp_path / "one", run_config(), pendulum)
    monkeypatch.setattr(loop._Recorder, "_too_soon", lambda *_: False)
    train(tmp_path / "all", run_config(seeds=2), pendulum)
    for seed in ("seed-0", "seed-1"):
        assert checkpoint.saved_steps(tmp_path / "few" / seed) == [1200]
        assert checkpoint.saved_steps(tmp_path / "all" / seed)[0] == 1200
        assert len(checkpoint.saved_steps(tmp_path / "all" / seed)) >= checkpoint.KEEP
        assert_same_leaves(leaves(tmp_path / "few" / seed), leaves(tmp_path / "all" / seed))
    assert len(checkpoint.saved_steps(tmp_path / "one")) >= checkpoint.KEEP  # one is saved at each report


def _without_seconds(writer: checkpoint.Writer, name: str, value: object) -> None:
    if name != "seconds":
        object.__setattr__(writer, name, value)


@pytest.mark.parametrize("task", ["pendulum", "circle"])
def test_the_same_seed_gives_the_same_bits_twice(tmp_path: Path, task: str) -> None:
    """State, ring, lanes and metrics."""
    env, run = worlds.make(task), run_config(num_timesteps=400, num_evals=2)
    for name in ("first", "again"):
        train(tmp_path / name, run, env)
    assert_same_leaves(leaves(tmp_path / "first"), leaves(tmp_path / "again"))
    assert comparable_metrics(tmp_path / "first") == comparable_metrics(tmp_path / "again")


class Poisoned(Env):
    """Counts steps; from step `bad` on the reward is not a number."""

    observation_size, action_size, backend = 2, 1, "test"  # pyright: ignore[reportAssignmentType]
    episode_steps = 1000

    def __init__(self, bad: float) -> None:
        self.bad = bad

    def reset(self, rng: jax.Array) -> State:
        obs = jax.random.normal(rng, (2,)).at[0].set(0.0)
        return State(None, obs, jnp.float32(0), jnp.float32(0))

    def step(self, state: State, action: jax.Array) -> State:
        obs = state.obs.at[0].add(1.0)
        return state.replace(obs=obs, reward=jnp.where(obs[0] > self.bad, jnp.nan, action[0]))


def test_nan_stops_the_run_and_keeps_the_last_good_checkpoint(tmp_path: Path) -> None:
    """The message names term, update and checkpoint; the checkpoint holds only finite numbers."""
    env = Poisoned(bad=100.0)
    with pytest.raises(
        driver.NotFinite, match=r"reward is not finite in update 18; the checkpoint at step 400 is kept"
    ):
        train(tmp_path, run_config(), env)
    assert all(np.isfinite(leaf).all() for leaf in leaves(tmp_path).values())
    assert [row["env_steps"] for row in files.read_metrics(tmp_path)] == [200, 400]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["reward", "observation", "final_observation"])
def test_what_is_not_finite_in_an_unroll_is_counted_as_its_own(name: str, bad: float, pendulum: Env) -> None:
    """Rewards, and observations: those before steps, and the final ones."""
    ones = {field: np.ones((4, 3)) for field in Transition._fields if field != "memory"}
    data = Transition(**ones | {"observation": np.ones((4, 3, 5)), "final_observation": np.ones((4, 2, 5))})
    setup = trainer.Setup(trainer.adapt(pendulum), run_config().learner)
    sums = jax.jit(lambda data: trainer._sums(setup, data, jnp.zeros(4)))
    assert sums(data)[3:].tolist() == [0.0, 0.0]
    poisoned = np.array(getattr(data, name))
    poisoned.flat[-1] = bad
    counts = np.asarray(sums(data._replace(**{name: poisoned}))[3:])
    np.testing.assert_array_equal(counts > 0, [name == "reward", name != "reward"])


def test_fault_in_the_learner_is_named(tmp_path: Path, pendulum: Env) -> None:
    """A step size that blows the networks up is found in the learner's own terms, not in the world."""
    with pytest.raises(
        driver.NotFinite, match=r"(log_rho|value|a_trace|_loss|_gradient|reward|observation) is not finite"
    ):
        train(tmp_path, run_config(learning_rate=1e30, learning_rate_end=1e30), pendulum)


def test_row_without_its_checkpoint_is_cut_and_made_again(tmp_path: Path, pendulum: Env, whole: Path) -> None:
    """Killed between the row and the checkpoint of a report: the resumed run has every row, once."""
    train(tmp_path, run_config(), pendulum, stop_after=8)
    rows = files.read_metrics(tmp_path)
    files.write_metrics(tmp_path, [*rows, {**rows[-1], "env_steps": rows[-1]["env_steps"] + 200}])
    train(tmp_path, run_config(), pendulum, resume=True)
    assert comparable_metrics(tmp_path) == comparable_metrics(whole)


def test_no_checkpoint_is_said(tmp_path: Path, pendulum: Env) -> None:
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        next(restore.iter_learners(make_trainer(pendulum, run_config().learner).setup.spec, run_config(), tmp_path, 1))


def test_stop_before_the_first_step_saves_nothing(tmp_path: Path, pendulum: Env) -> None:
    train(tmp_path, run_config(), pendulum, stop_after=0)
    assert files.read_metrics(tmp_path) == []

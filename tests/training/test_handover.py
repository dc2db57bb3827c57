"""Learning hands over to APG where the policy flies, and goes on where it does not."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

import small_run
from fault_injection import assert_same_leaves, leaves
from qrl.runs import checkpoint, files
from qrl.training import driver, loop, restore
from qrl.training.driver import Chunk, Clock, Programs
from qrl.training.state import MemberInputs, TrainState, stack
from qrl.training.trainer import Trainer, make_trainer
from small_run import comparable_metrics, run_config, train

# 30 unrolls: 12 to learn, or 24, or 26, where a quarter of the 9 APG updates, of two unrolls each, is left.
RUN = run_config(
    apg_fraction=0.6,
    apg_num_envs=4,
    apg_episode_length=20,
    num_evals=3,
    normalize_observations=False,
    updates_per_unroll=1,
)
CONFIG = RUN.learner


class Walled(Env):
    """A point that is pushed; a wall, its parameter, ends the flight out of bounds."""

    observation_size, action_size, backend = 2, 1, "test"  # pyright: ignore[reportAssignmentType]
    episode_steps = 20

    def __init__(self, wall: jax.Array | float) -> None:
        self.params = jnp.float32(wall)

    def with_params(self, params: jax.Array) -> "Walled":
        return Walled(params)

    def reset(self, rng: jax.Array) -> State:
        return self._at(self.params, jax.random.uniform(rng, (2,), minval=-0.5, maxval=0.5))

    def restart(self, state: State, rng: jax.Array) -> State:
        return self.with_params(state.pipeline_state).reset(rng)

    def step(self, state: State, action: jax.Array) -> State:
        x, v = state.obs
        v = 0.9 * v + 0.1 * action[0]
        return self._at(state.pipeline_state, jnp.stack([x + 0.1 * v, v]))

    def _at(self, wall: jax.Array, obs: jax.Array) -> State:
        done = (jnp.abs(obs[0]) > wall).astype(jnp.float32)
        return State(wall, obs, -jnp.abs(obs[0]) - 0.5 * done, done, {}, {"out_of_bounds": done})


ENV = Walled(1e9)
CRASHES, FLIES = 0.01, 1e9


def start(walls: list[float], trainer: Trainer | None = None) -> tuple[TrainState, MemberInputs, Programs]:
    """By the programs that runs share, or those of `trainer`."""
    shared, trainer = trainer is None, trainer or small_run.trainer_of(ENV, CONFIG)
    inputs = stack([MemberInputs(CONFIG.hyperparameters, np.float32(wall)) for wall in walls])
    states = trainer.init(driver.seeds(0, len(walls)), inputs)
    train, apg, fly = trainer.train, trainer.apg, driver.report_flights(trainer)
    if shared:
        abstract = restore.abstract_states(trainer, inputs)
        train, apg, fly = (small_run.lower_once(trainer, name, abstract, inputs)() for name in ("train", "apg", "fly"))
    return states, inputs, Programs(lambda: train, lambda: apg, lambda: fly, trainer.gather)


def chunks(
    walls: list[float], trainer: Trainer | None = None, stopped: Callable[[int], bool] = lambda _: False
) -> tuple[list[Chunk], TrainState]:
    """To the end or until `stopped(unrolls)`; and the last states, in NumPy."""
    return go_on(*start(walls, trainer), stopped)


def go_on(
    states: TrainState, inputs: MemberInputs, programs: Programs, stopped: Callable[[int], bool] = lambda _: False
) -> tuple[list[Chunk], TrainState]:
    done = [0]
    made = []
    for chunk in driver.run_chunks(states, inputs, programs, CONFIG, Clock(), lambda: stopped(done[0])):
        made.append(chunk)
        done[0] = chunk.env_steps // CONFIG.steps_per_unroll
        states = chunk.states
    return made, jax.tree.map(np.array, states)


@pytest.fixture(autouse=True)
def _quick_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "CHUNK_SECONDS", 1e-4)


@pytest.fixture(scope="module")
def pair() -> tuple[list[Chunk], TrainState]:
    """One that crashes beside one that flies, one after the other."""
    return chunks([CRASHES, FLIES])


def test_what_does_not_fly_learns_on_and_another_beside_it_does_not(pair: tuple[list[Chunk], TrainState]) -> None:
    assert (CONFIG.num_unrolls, CONFIG.learning_unrolls, CONFIG.unrolls_per_apg_update) == (30, 12, 2)
    made, states = pair
    extended = {chunk.env_steps // CONFIG.steps_per_unroll: chunk.extended for chunk in made if chunk.extended}
    assert extended == {n: {0: m * CONFIG.steps_per_unroll} for n, m in ((12, 24), (24, 26))}
    assert states.learning_unrolls.tolist() == [26, 12]
    minibatches = [(n - CONFIG.warmup_unrolls + 1) * CONFIG.updates_per_unroll for n in (26, 12)]
    assert states.learner.planned_updates.tolist() == minibatches
    assert states.learner.updates.tolist() == [minibatches[0] + 2, minibatches[1] + 9]
    assert states.unrolls.tolist() == [30, 30]
    assert states.buffer.inserted.tolist() == [26, 12]


def test_a_bounded_gradient_takes_over_from_what_does_not_fly() -> None:
    """It learns from flights that go wrong, so nothing is waited for."""
    bounded = CONFIG.model_copy(update={"apg_cotangent_norm": 10.0})
    states, inputs, programs = start([CRASHES, CRASHES])  # by the programs of `pair`
    made = list(driver.run_chunks(states, inputs, programs, bounded, Clock(), lambda: False))
    assert made[-1].env_steps == CONFIG.num_timesteps
    assert not any(chunk.extended for chunk in made)


def assert_close(ours: TrainState, expected: TrainState) -> None:
    for (path, x), y in zip(jax.tree.leaves_with_path(ours), jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        if x.dtype.kind in "iub":
            np.testing.assert_array_equal(x, y, err_msg=name)
        else:
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5, err_msg=name)


def whenever_drawn(states: TrainState) -> TrainState:
    """`states` without what says how early each lane's next start was drawn, which members at once decide together."""
    lanes = states.lanes
    started = lanes.reset_count + lanes.next_state_used
    return states._replace(lanes=lanes._replace(next_state=(), reset_count=started, next_state_used=None))  # pyright: ignore[reportArgumentType]


def test_members_at_once_are_those_one_after_the_other(
    pair: tuple[list[Chunk], TrainState], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vmapped, as on a GPU, where the two are in different phases."""
    monkeypatch.setattr("qrl.training.sharding.sequential_members", lambda count: count == 1)
    made, states = chunks([CRASHES, FLIES], make_trainer(ENV, CONFIG))
    assert [chunk.extended for chunk in made if chunk.extended] == [c.extended for c in pair[0] if c.extended]
    assert_close(whenever_drawn(states), whenever_drawn(pair[1]))


@pytest.mark.parametrize("at", [11, 12, 13, 24])
def test_stopped_about_a_handover_it_goes_on_to_the_same_bits(pair: tuple[list[Chunk], TrainState], at: int) -> None:
    made, states = chunks([CRASHES, FLIES], stopped=lambda unrolls: unrolls >= at)
    assert made[-1].env_steps < CONFIG.num_unrolls * CONFIG.steps_per_unroll
    _, inputs, programs = start([CRASHES, FLIES])
    _, last = go_on(jax.tree.map(jnp.array, states), inputs, programs)
    for ours, expected in zip(jax.tree.leaves(last), jax.tree.leaves(pair[1]), strict=True):
        np.testing.assert_array_equal(ours, expected)


def test_a_run_says_that_it_learns_on_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its checkpoints, too, to the same bits."""
    monkeypatch.setattr(ENV, "params", jnp.float32(CRASHES))
    run = RUN.model_copy(update={"seeds": 2})
    events = train(tmp_path / "whole", run, ENV)
    first, second = (event for event in events if isinstance(event, loop.LearningExtended))
    assert first.until == dict.fromkeys((0, 1), 24 * CONFIG.steps_per_unroll)
    assert second.until == dict.fromkeys((0, 1), 26 * CONFIG.steps_per_unroll)
    train(tmp_path / "again", run, ENV, stop_after=sum(not quiet(e) for e in events[: events.index(first)]))
    assert checkpoint.saved_steps(tmp_path / "again" / "seed-1")[0] == 12 * CONFIG.steps_per_unroll
    resumed = train(tmp_path / "again", run, ENV, resume=True)
    assert [event for event in resumed if isinstance(event, loop.LearningExtended)] == [second]
    for seed in ("seed-0", "seed-1"):
        whole, again = tmp_path / "whole" / seed, tmp_path / "again" / seed
        assert files.read_metrics(whole)[-1]["ended_early"] == 1.0
        assert_same_leaves(leaves(again), leaves(whole))
        assert comparable_metrics(again) == comparable_metrics(whole)


def quiet(event: loop.Event) -> bool:
    return isinstance(event, loop.Compiling | loop.Resumed)

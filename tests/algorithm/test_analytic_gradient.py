"""Flights whose return is differentiated, and the updates that follow them."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from bound_learner import BoundLearner
from fault_injection import assert_same_leaves, leaves
from qrl import tasks
from qrl.algorithm import analytic_gradient
from qrl.algorithm.learner import LearnerState
from qrl.config import Config, load_preset, preset_names
from qrl.runs import checkpoint, files
from qrl.training import driver
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds
from qrl_envs.specfile import BadInput
from small_run import comparable_metrics, run_config, train

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")

CLIMBING = {
    "apg_fraction": 0.4,
    "apg_num_envs": 4,
    "apg_episode_length": 20,
}  # 6, the last 12 of 30 unrolls


@pytest.fixture(autouse=True)
def _quick_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "CHUNK_SECONDS", 1e-4)  # pause after every unroll or two


class Pushed(Env):
    """A point on a line, pushed; ends beyond `edge`. Reward −x²."""

    observation_size, action_size, backend = 2, 1, "test"  # pyright: ignore[reportAssignmentType]
    episode_steps = 20

    def __init__(self, edge: float = 1e9) -> None:
        self.edge = edge

    def reset(self, rng: jax.Array) -> State:
        return self._at(jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: jax.Array) -> State:
        x, v = state.obs
        v = v + 0.3 * action[0]
        return self._at(jnp.stack([x + 0.3 * v, v]))

    def _at(self, obs: jax.Array) -> State:
        done = (jnp.abs(obs[0]) > self.edge).astype(jnp.float32)
        return State(None, obs, -(obs[0] ** 2), done)


def linear(gain: jax.Array) -> analytic_gradient.Mean:
    return lambda observation: observation @ gain[:, None]


def literal(env: Env, gain: np.ndarray, sigma: float, keys: jax.Array, steps: int) -> np.ndarray:
    """One flight after the other, step by step."""
    found = []
    for key in keys:
        start, noise = jax.random.split(key)
        noise = np.asarray(jax.random.normal(noise, (steps, 1)))
        state, total, ended = env.reset(start), 0.0, False
        for t in range(steps):
            action = np.clip(np.asarray(state.obs) @ gain + sigma * noise[t], -1.0, 1.0)
            state = env.step(state, jnp.asarray(action))
            total += float(state.reward)
            ended |= bool(state.done)
        found.append(0.0 if ended else total)
    return np.array(found)


KEYS = jax.random.split(jax.random.PRNGKey(3), 6)


def test_returns_are_those_of_flights_step_by_step() -> None:
    """With noise, clipped actions, and flights that end early among them."""
    env, gain = Pushed(edge=1.5), np.array([-0.5, 0.3], np.float32)
    expected = literal(env, gain, 0.3, KEYS, 8)
    assert 0 < (expected == 0.0).sum() < len(KEYS)
    found, whole = analytic_gradient.returns(env, linear(jnp.asarray(gain)), jnp.float32(0.3), KEYS, 8)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_array_equal(whole, expected != 0.0)


def test_the_gradient_is_that_of_finite_differences() -> None:
    """Of the mean return in the policy's gain, through environment and noise; ended flights have none."""
    env, gain, sigma = Pushed(edge=1.5), np.array([-0.3, 0.4]), 0.1

    def mean_return(gain: jax.Array) -> jax.Array:
        return jnp.mean(analytic_gradient.returns(env, linear(gain), jnp.float32(sigma), KEYS, 8)[0])

    step = 1e-2
    expected = [
        (
            float(mean_return(jnp.asarray(gain + d, jnp.float32)))
            - float(mean_return(jnp.asarray(gain - d, jnp.float32)))
        )
        / (2 * step)
        for d in step * np.eye(2)
    ]
    np.testing.assert_allclose(jax.grad(mean_return)(jnp.asarray(gain, jnp.float32)), expected, rtol=2e-2)
    outward = jnp.array([50.0, 50.0])  # every flight ends
    np.testing.assert_array_equal(jax.grad(mean_return)(outward), 0.0)


def learner(**changes: object) -> BoundLearner:
    preset = load_preset("default") | {
        "normalize_observations": False,
        "policy_hidden_layer_sizes": [8],
        "critic_hidden_layer_sizes": [8],
    }
    return BoundLearner(Config.model_validate(preset | {"apg_fraction": 0.5} | changes, strict=False), 2, 1)


def policy_of(state: LearnerState) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.params.policy)])


def test_climbs_raise_the_return_and_move_the_policy_alone() -> None:
    """Thirty steps on the pushed point; the critic and its optimiser stay."""
    env, ours = Pushed(), learner(apg_learning_rate=0.01)
    keys = jax.random.split(jax.random.PRNGKey(0), 32)

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        return analytic_gradient.returns(env, lambda o: ours.mean(now, o), jnp.float32(0.0), keys, 20)

    climb = jax.jit(lambda now, i: ours.apg_update(now, flown, i))
    state = first = ours.init(jax.random.PRNGKey(1))
    for i in range(29):
        state, _, _ = climb(state, i)
    state, _, sums = climb(state, 29)
    assert float(jnp.mean(flown(state)[0])) > 0.5 * float(jnp.mean(flown(first)[0]))  # both below 0
    assert sums[1] == ours.config.apg_num_envs
    assert state.updates == 30
    jax.tree.map(np.testing.assert_array_equal, state.params.critic, first.params.critic)
    jax.tree.map(np.testing.assert_array_equal, state.optimizer.critic, first.optimizer.critic)
    jax.tree.map(np.testing.assert_array_equal, state.average, state.params.policy)


def test_the_first_climb_begins_with_what_ships_and_a_fresh_optimiser() -> None:
    """Adam's first step is the sign of the gradient, whatever it had seen before; the last one's size is near 0."""
    ours = learner(average_fraction=0.5, max_grad_norm=1e9)
    state = ours.init(jax.random.PRNGKey(1))
    seen = jax.tree.map(lambda x: x + jnp.ones_like(x), state.optimizer.policy)
    average = jax.tree.map(lambda x: x + 1.0, state.params.policy)
    state = state._replace(
        optimizer=state.optimizer._replace(policy=seen), average=average, updates=jnp.int32(ours.total_updates)
    )

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        return sum(jnp.sum(3.0 * x) for x in jax.tree.leaves(now.params.policy))[None], jnp.ones(1)

    after, terms, _ = ours.apg_update(state, flown, jnp.int32(0))
    ships = policy_of(state._replace(params=state.params._replace(policy=average)))
    np.testing.assert_allclose(policy_of(after) - ships, ours.config.apg_learning_rate, rtol=1e-3)
    np.testing.assert_allclose(terms.policy_gradient, 3.0 * np.sqrt(len(ships)), rtol=1e-5)
    last, _, _ = ours.apg_update(after, flown, jnp.int32(ours.config.num_apg_updates - 1))
    expected = ours.config.apg_learning_rate * ours.config.num_apg_updates**-1.5
    np.testing.assert_allclose(policy_of(last) - policy_of(after), expected, rtol=0.05, atol=1e-7)


def test_a_gradient_that_is_not_finite_is_not_followed() -> None:
    ours = learner()
    state = ours.init(jax.random.PRNGKey(1))

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        slopes = [jnp.sum(jnp.sqrt(x - x)) for x in jax.tree.leaves(now.params.policy)]  # infinite
        return jnp.stack(slopes), jnp.ones(1)

    state = state._replace(optimizer=jax.tree.map(lambda x: x + jnp.ones_like(x), state.optimizer))  # a momentum
    after, terms, _ = ours.apg_update(state, flown, jnp.int32(1))
    np.testing.assert_array_equal(policy_of(after), policy_of(state))
    jax.tree.map(np.testing.assert_array_equal, after.optimizer, state.optimizer)
    assert terms.policy_gradient == 0.0


@given(
    steps=st.integers(5_000, 200_000),
    lanes=st.sampled_from([8, 16, 64]),
    fraction=st.floats(0.01, 0.9),
    apg_num_envs=st.sampled_from([8, 40, 64]),
    apg_episode_length=st.integers(1, 600),
)
def test_a_run_is_learning_and_then_climbs(
    steps: int, lanes: int, fraction: float, apg_num_envs: int, apg_episode_length: int
) -> None:
    """Together they make its unrolls; climbs take no more than their share, and no fewer steps than they fly."""
    changes = {
        "apg_fraction": fraction,
        "apg_num_envs": apg_num_envs,
        "apg_episode_length": apg_episode_length,
        "warmup_unrolls": 1,
    }
    base = load_preset("default") | {"num_timesteps": steps, "num_envs": lanes, "unroll_length": 5, "batch_size": 8}
    ours = Config.model_validate(base | changes, strict=False)
    climbing = ours.num_unrolls - ours.learning_unrolls
    assert climbing == ours.num_apg_updates * ours.unrolls_per_apg_update <= fraction * ours.num_unrolls
    assert ours.unrolls_per_apg_update * ours.steps_per_unroll >= apg_num_envs * apg_episode_length
    assert climbing + ours.unrolls_per_apg_update > fraction * ours.num_unrolls - 1


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"apg_fraction": 0.99, "apg_episode_length": 10}, "before APG"),
        ({"apg_fraction": 0.4, "apg_num_envs": 5}, "apg_num_envs to be a multiple of num_shards"),
        ({"apg_fraction": 1.1}, "apg_fraction"),
    ],
)
def test_what_cannot_be_is_said(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        run_config(**CLIMBING | changes)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    train(out, run_config(**CLIMBING), worlds.make("pendulum"))
    return out


def test_a_run_ends_with_its_climbs(whole: Path) -> None:
    """Each is an update, and stands for two unrolls of steps; what only minibatches have is 0."""
    run = run_config(**CLIMBING).learner
    assert (run.learning_unrolls, run.num_apg_updates) == (18, 6)
    rows = files.read_metrics(whole)
    assert [row["env_steps"] for row in rows] == [200, 400, 600, 800, 1040, 1200]  # not within a climb
    assert [row["updates"] for row in rows[-3:]] == [34 + 1, 34 + 4, 34 + 6]
    assert rows[-1]["value_loss"] == 0.0 < rows[-1]["policy_gradient"]


def test_reports_among_the_climbs_wait_for_one(tmp_path: Path) -> None:
    """Asked for oftener than there are climbs: no row is without numbers, and none without a climb."""
    train(tmp_path, run_config(**CLIMBING, num_evals=30), worlds.make("pendulum"))
    rows = files.read_metrics(tmp_path)
    assert [row["env_steps"] for row in rows] == [*range(40, 721, 40), *range(800, 1201, 80)]
    assert all(np.isfinite([row["reward_mean"], row["steps_per_second"]]).all() for row in rows)
    assert [row["updates"] for row in rows[-6:]] == [34 + i for i in range(1, 7)]


class Fleeing(Pushed):
    """Every flight ends at once."""

    def __init__(self) -> None:
        super().__init__(edge=0.0)


def test_flights_that_end_early_are_counted(tmp_path: Path) -> None:
    """And are no part of the mean reward, which would be at its best."""
    train(tmp_path, run_config(**CLIMBING), Fleeing())
    assert [row["ended_early"] for row in files.read_metrics(tmp_path)[-2:]] == [1.0, 1.0]


class Nowhere(Pushed):
    """Its rewards are not numbers once it is flown for a while."""

    def step(self, state: State, action: jax.Array) -> State:
        return super().step(state, action).replace(reward=jnp.where(jnp.abs(state.obs[0]) > 0.0, jnp.nan, 0.0))


def test_rewards_that_are_no_numbers_stop_the_climbs() -> None:
    """The fault is the run's, as it is while it learns."""
    config = run_config(**CLIMBING).learner
    trainer, points = make_trainer(Nowhere(), config), stack([member_inputs(Nowhere(), config)])
    states = trainer.init(driver.seeds(0, 1), points)
    states = states._replace(unrolls=jnp.full(1, config.learning_unrolls, jnp.int32))
    after = trainer.apg(states, points, np.int32(config.num_unrolls))
    assert (after.fault_update, after.fault_term) == (0, 0)


class Looping(Pushed):
    """Its step cannot be differentiated."""

    def step(self, state: State, action: jax.Array) -> State:
        pushed = jax.lax.while_loop(lambda a: jnp.abs(a[0]) > 1.0, lambda a: a / 2.0, action)
        return super().step(state, pushed)


def test_an_environment_without_a_gradient_is_told_before_training() -> None:
    """One line that names the key; without climbs it is welcome."""
    with pytest.raises(BadInput, match="inverted: key 'apg_fraction': expected 0"):
        tasks.check(Looping(), run_config(**CLIMBING).learner, "inverted")
    tasks.check(Looping(), run_config().learner, "inverted")
    tasks.check(Pushed(), run_config(**CLIMBING).learner, "inverted")


@pytest.mark.parametrize("stop_after", [21, 22])
def test_stopped_among_the_climbs_it_goes_on_to_the_same_bits(tmp_path: Path, whole: Path, stop_after: int) -> None:
    env, run = worlds.make("pendulum"), run_config(**CLIMBING)
    train(tmp_path, run, env, stop_after=stop_after)
    reached = checkpoint.saved_steps(tmp_path)[0]
    assert 720 < reached < 1200
    train(tmp_path, run, env, resume=True)
    assert_same_leaves(leaves(tmp_path), leaves(whole))
    assert comparable_metrics(tmp_path) == comparable_metrics(whole)


def test_members_do_not_mix(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Vmapped beside another, a seed's climbs are its own."""
    env, config = worlds.make("pendulum"), run_config(**CLIMBING).learner
    trainer = make_trainer(env, config)
    learning, all_of_it = np.int32(config.learning_unrolls), np.int32(config.num_unrolls)

    def climbed(count: int) -> list[np.ndarray]:
        points = stack([member_inputs(env, config)] * count)
        states = trainer.train(trainer.init(driver.seeds(0, count), points), points, learning)
        return [np.asarray(x)[:1] for x in jax.tree.leaves(trainer.apg(states, points, all_of_it).learner.params)]

    one = climbed(1)
    monkeypatch.setattr("qrl.training.sharding.sequential_members", lambda count: count == 1)
    trainer = make_trainer(env, config)
    for ours, theirs in zip(climbed(2), one, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)


def test_presets_that_climb_say_so_in_whole_unrolls() -> None:
    """What ships: the flights fit the steps that they are counted as."""
    for name in preset_names():
        config = Config.model_validate_json(json.dumps(load_preset("default") | load_preset(name)))
        if config.num_apg_updates:
            assert (
                config.apg_num_envs * config.apg_episode_length
                == config.unrolls_per_apg_update * config.steps_per_unroll
            )

"""Flights whose return is differentiated, and the updates that follow them."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import small_run
from bound_learner import BoundLearner
from fault_injection import assert_same_leaves, leaves
from qrl import tasks
from qrl.algorithm import analytic_gradient
from qrl.algorithm.carried import Carry
from qrl.algorithm.learner import LearnerState
from qrl.config import Config, load_preset, preset_names
from qrl.runs import checkpoint, files
from qrl.training import driver, trainer
from qrl.training.state import FAULT_TERMS, MemberInputs, TrainState, stack
from qrl.training.trainer import Trainer
from qrl_envs.specfile import BadInput
from small_run import comparable_metrics, run_config, train

WITH_APG = {
    "apg_fraction": 0.4,
    "apg_num_envs": 4,
    "apg_episode_length": 20,
}  # 6, the last 12 of 30 unrolls


@pytest.fixture(autouse=True)
def _quick_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "CHUNK_SECONDS", 1e-4)  # pause after every unroll or two


class Pushed(Env):
    """A point on a line, pushed; ends beyond `edge`, out of bounds where it went left. Reward `constant` − x²."""

    observation_size, action_size, backend = 2, 1, "test"  # pyright: ignore[reportAssignmentType]
    episode_steps = 20

    def __init__(self, edge: float = 1e9, constant: float = 0.0) -> None:
        self.edge = edge
        self.constant = constant

    def reset(self, rng: jax.Array) -> State:
        return self._at(jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: jax.Array) -> State:
        x, v = state.obs
        v = v + 0.3 * action[0]
        return self._at(jnp.stack([x + 0.3 * v, v]))

    def _at(self, obs: jax.Array) -> State:
        done = (jnp.abs(obs[0]) > self.edge).astype(jnp.float32)
        return State(None, obs, self.constant - obs[0] ** 2, done, info={"out_of_bounds": done * (obs[0] < 0.0)})


def linear(gain: jax.Array) -> analytic_gradient.Act:
    return lambda memory, observation: (memory, observation @ gain[:, None])


def literal(env: Env, gain: jax.Array, sigma: float, key: jax.Array, steps: int) -> tuple[jax.Array, bool]:
    """One flight step by step, up to its end; what is left of it is charged at once. Also whether it is complete."""
    start, noise = jax.random.split(key)
    noise = jax.random.normal(noise, (steps, 1))
    state, total = env.reset(start), jnp.zeros(())
    for t in range(steps):
        state = env.step(state, jnp.clip(state.obs @ gain[:, None] + sigma * noise[t], -1.0, 1.0))
        total = total + state.reward
        if state.done:
            forever = state.info["out_of_bounds"] > 0 or state.reward < 0
            return total + (steps - 1 - t) * (state.reward if forever else 0.0), False
    return total, True


KEYS = jax.random.split(jax.random.PRNGKey(3), 6)
EDGE, SIGMA, STEPS = 1.1, 0.3, 8


def flights(env: Env, gain: jax.Array, keys: jax.Array = KEYS) -> tuple[jax.Array, jax.Array]:
    return jax.jit(lambda gain: analytic_gradient.returns(env, linear(gain), (), jnp.float32(SIGMA), keys, STEPS))(gain)


@pytest.mark.parametrize("constant", [0.0, 5.0])
def test_returns_are_those_of_flights_step_by_step(constant: float) -> None:
    """With noise, clipped actions, and flights that end early among them: their last reward goes on to the last step,
    but where it is above 0 and the flight was within the bounds.
    """
    env, gain = Pushed(EDGE, constant), jnp.array([-0.1, 0.3])
    expected = [literal(env, gain, SIGMA, key, STEPS) for key in KEYS]
    found, complete = flights(env, gain)
    np.testing.assert_allclose(found, [float(total) for total, _ in expected], rtol=1e-5)
    assert complete.tolist() == [whole for _, whole in expected]
    assert 2 <= sum(complete) <= len(KEYS) - 2
    sides = {float(env_end(env, gain, key)) for key in KEYS} - {0.0}
    assert sides == {-1.0, 1.0}, "some end out of bounds, some terminate"


def env_end(env: Env, gain: jax.Array, key: jax.Array) -> float:
    """The side on which the flight ends; 0: it does not."""
    start, noise = jax.random.split(key)
    noise = jax.random.normal(noise, (STEPS, 1))
    state = env.reset(start)
    for t in range(STEPS):
        state = env.step(state, jnp.clip(state.obs @ gain[:, None] + SIGMA * noise[t], -1.0, 1.0))
        if state.done:
            return float(jnp.sign(state.obs[0]))
    return 0.0


def mean_slope(env: Env, gain: jax.Array, keys: jax.Array = KEYS) -> jax.Array:
    return jax.grad(lambda gain: jnp.mean(flights(env, gain, keys)[0]))(gain)


@pytest.mark.parametrize("constant", [0.0, 5.0])
def test_every_flight_has_its_share_of_the_gradient(constant: float) -> None:
    """Also one that ends: up to its end, and through the charge for what is left."""
    env, gain = Pushed(EDGE, constant), jnp.array([-0.1, 0.3])
    each = [jax.grad(lambda gain, key=key: literal(env, gain, SIGMA, key, STEPS)[0])(gain) for key in KEYS]
    assert all(np.abs(slope).min() > 0.0 for slope in each)
    np.testing.assert_allclose(mean_slope(env, gain), np.mean(each, axis=0), rtol=1e-4)


class Bursting(Pushed):
    """Beyond the edge it runs away so fast that it overflows in a few steps."""

    def step(self, state: State, action: jax.Array) -> State:
        burst = jnp.where(jnp.abs(state.obs) > self.edge, 1e9 * state.obs**5, state.obs)
        return super().step(state.replace(obs=burst), action)


def test_a_flight_that_would_overflow_spoils_no_other() -> None:
    """It is held where it ended: the gradient is finite, and that of the flights each for its share."""
    gain = jnp.array([-0.1, 0.3])
    state = Bursting(EDGE).step(State(None, jnp.full(2, 2.0), jnp.zeros(()), jnp.zeros(())), jnp.zeros(1))
    assert not np.isfinite(Bursting(EDGE).step(state, jnp.zeros(1)).reward)
    np.testing.assert_array_equal(mean_slope(Bursting(EDGE), gain), mean_slope(Pushed(EDGE), gain))


def learner(**changes: object) -> BoundLearner:
    preset = load_preset("default") | {
        "normalize_observations": False,
        "policy_hidden_layer_sizes": [8],
        "critic_hidden_layer_sizes": [8],
    }
    return BoundLearner(Config.model_validate(preset | {"apg_fraction": 0.5} | changes, strict=False), 2, 1)


def policy_of(state: LearnerState) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.params.policy)])


def test_updates_raise_the_return_and_move_the_policy_alone() -> None:
    """Thirty steps on the pushed point; the critic and its optimizer stay."""
    env, ours = Pushed(), learner(apg_learning_rate=0.01)
    keys = jax.random.split(jax.random.PRNGKey(0), 32)

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        return analytic_gradient.returns(env, lambda m, o: (m, ours.mean(now, o)), (), jnp.float32(0.0), keys, 20)

    update = jax.jit(lambda now, i: ours.apg_update(now, flown, i / ours.config.num_apg_updates))
    state = first = ours.init(jax.random.PRNGKey(1))
    sums = jnp.zeros(2)
    for i in range(30):
        state, _, sums, skipped = update(state, i)
        assert not skipped
    assert float(jnp.mean(flown(state)[0])) > 0.5 * float(jnp.mean(flown(first)[0]))  # both below 0
    assert sums[1] == ours.config.apg_num_envs
    assert state.updates == 30
    jax.tree.map(np.testing.assert_array_equal, state.params.critic, first.params.critic)
    jax.tree.map(np.testing.assert_array_equal, state.optimizer.critic, first.optimizer.critic)
    jax.tree.map(np.testing.assert_array_equal, state.average, state.params.policy)


def test_the_first_update_begins_with_the_deployed_policy_and_a_new_optimizer() -> None:
    """Adam's first step is the sign of the gradient, whatever it had seen before; its size decays as 1.5th power."""
    ours = learner(average_fraction=0.5, max_grad_norm=1e9)
    state = ours.init(jax.random.PRNGKey(1))
    seen = jax.tree.map(lambda x: x + jnp.ones_like(x), state.optimizer.policy)
    average = jax.tree.map(lambda x: x + 1.0, state.params.policy)
    state = state._replace(
        optimizer=state.optimizer._replace(policy=seen), average=average, updates=jnp.int32(ours.planned_updates)
    )

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        return sum(jnp.sum(3.0 * x) for x in jax.tree.leaves(now.params.policy))[None], jnp.ones(1)

    planned = jnp.int32(300)
    after, terms, _, _ = ours.apg_update(state, flown, jnp.int32(0) / planned)
    ships = policy_of(state._replace(params=state.params._replace(policy=average)))
    np.testing.assert_allclose(policy_of(after) - ships, ours.config.apg_learning_rate, rtol=1e-3)
    np.testing.assert_allclose(terms.policy_gradient, 3.0 * np.sqrt(len(ships)), rtol=1e-5)
    for step, share in ((75, 0.75), (150, 0.5), (299, 1 / 300)):
        later, *_ = ours.apg_update(after, flown, jnp.int32(step) / planned)
        expected = ours.config.apg_learning_rate * share**1.5
        np.testing.assert_allclose(policy_of(later) - policy_of(after), expected, rtol=0.05, atol=3e-7)


def test_a_gradient_that_is_not_finite_is_not_followed() -> None:
    ours = learner()
    state = ours.init(jax.random.PRNGKey(1))

    def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
        slopes = [jnp.sum(jnp.sqrt(x - x)) for x in jax.tree.leaves(now.params.policy)]  # infinite
        return jnp.stack(slopes), jnp.ones(1)

    state = state._replace(optimizer=jax.tree.map(lambda x: x + jnp.ones_like(x), state.optimizer))  # a momentum
    after, terms, _, skipped = ours.apg_update(state, flown, jnp.int32(1) / 9)
    assert skipped
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
def test_a_run_is_learning_and_then_apg(
    steps: int, lanes: int, fraction: float, apg_num_envs: int, apg_episode_length: int
) -> None:
    """Together they make its unrolls; APG takes no more than its share, and no fewer steps than it flies."""
    changes = {
        "apg_fraction": fraction,
        "apg_num_envs": apg_num_envs,
        "apg_episode_length": apg_episode_length,
        "warmup_unrolls": 1,
    }
    base = load_preset("default") | {"num_timesteps": steps, "num_envs": lanes, "unroll_length": 5, "batch_size": 8}
    ours = Config.model_validate(base | changes, strict=False)
    polishing = ours.num_unrolls - ours.learning_unrolls
    assert polishing == ours.num_apg_updates * ours.unrolls_per_apg_update <= fraction * ours.num_unrolls
    assert ours.unrolls_per_apg_update * ours.steps_per_unroll >= apg_num_envs * apg_episode_length
    assert polishing + ours.unrolls_per_apg_update > fraction * ours.num_unrolls - 1


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
        run_config(**WITH_APG | changes)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    train(out, run_config(**WITH_APG), small_run.pendulum())
    return out


def test_a_run_ends_with_its_apg_updates(whole: Path) -> None:
    """Each is an update, and stands for two unrolls of steps; what only minibatches have is 0."""
    run = run_config(**WITH_APG).learner
    assert (run.learning_unrolls, run.num_apg_updates) == (18, 6)
    rows = files.read_metrics(whole)
    assert [row["env_steps"] for row in rows] == [200, 400, 600, 800, 1040, 1200]  # not within an APG update
    assert [row["updates"] for row in rows[-3:]] == [34 + 1, 34 + 4, 34 + 6]
    assert rows[-1]["value_loss"] == 0.0 < rows[-1]["policy_gradient"]


def test_reports_during_apg_wait_for_an_update(tmp_path: Path) -> None:
    """Asked for oftener than there are updates: no row is without numbers, and none without an update."""
    train(tmp_path, run_config(**WITH_APG, num_evals=30), small_run.pendulum())
    rows = files.read_metrics(tmp_path)
    assert [row["env_steps"] for row in rows] == [*range(40, 721, 40), *range(800, 1201, 80)]
    assert all(np.isfinite([row["reward_mean"], row["steps_per_second"]]).all() for row in rows)
    assert [row["updates"] for row in rows[-6:]] == [34 + i for i in range(1, 7)]


class Odd(Pushed):
    """Its flights, rewards or gradients fail, as its parameters say: one environment, whose programs fit all."""

    def __init__(self) -> None:
        super().__init__()
        self.params = self.but()

    @staticmethod
    def but(edge: float = 1e9, nan: float = 0.0, sharp: float = 0.0) -> dict[str, jax.Array]:
        """Where flights end; whether rewards are no numbers; whether the rewards' gradients are none."""
        return {"edge": jnp.float32(edge), "nan": jnp.float32(nan), "sharp": jnp.float32(sharp)}

    def with_params(self, params: dict[str, jax.Array]) -> "Odd":
        other = Odd()
        other.params = params
        return other

    def reset(self, rng: jax.Array) -> State:
        return super().reset(rng).replace(pipeline_state=self.params)

    def restart(self, state: State, rng: jax.Array) -> State:
        return self.with_params(state.pipeline_state).reset(rng)

    def step(self, state: State, action: jax.Array) -> State:
        params, after = state.pipeline_state, super().step(state, action)
        zero = jnp.where(params["sharp"] > 0, after.obs[0] - after.obs[0], 1.0)
        spoiled = jnp.where(params["nan"] > 0, jnp.nan, after.reward) - params["sharp"] * jnp.sqrt(zero)
        done = (jnp.abs(after.obs[0]) > params["edge"]).astype(jnp.float32)
        return after.replace(pipeline_state=params, reward=spoiled, done=done, info={"out_of_bounds": done})


ODD = Odd()
MANY_UPDATES = run_config(**WITH_APG | {"num_timesteps": 4800, "num_evals": 5})


def at_apg(**odd: float) -> tuple[Trainer, MemberInputs, TrainState]:
    """A trainer and a state at the end of learning, without having learned."""
    config = MANY_UPDATES.learner
    assert config.num_apg_updates == 24
    trainer = small_run.trainer_of(ODD, config)
    inputs = stack([MemberInputs(config.hyperparameters, jax.tree.map(np.asarray, Odd.but(**odd)))])
    states = trainer.init(driver.seeds(0, 1), inputs)
    return trainer, inputs, states._replace(unrolls=jnp.full(1, config.learning_unrolls, jnp.int32))


def after(updates: int, trainer: Trainer, inputs: MemberInputs, states: TrainState) -> TrainState:
    until = int(states.unrolls[0]) + updates * trainer.config.unrolls_per_apg_update
    return trainer.apg(states, inputs, np.int32(until))


def test_flights_that_end_early_are_counted() -> None:
    """And are charged in the mean reward, so that it is not at its best."""
    totals = after(2, *at_apg(edge=0.0)).totals
    assert (totals.episodes, totals.early, totals.steps) == (8, 8, 2 * 4 * 20)
    assert totals.rewards / totals.steps < -0.1


def test_rewards_that_are_no_numbers_stop_apg() -> None:
    """The fault is the run's, as it is while it learns."""
    stopped = after(2, *at_apg(nan=1.0))
    assert (stopped.fault_update, FAULT_TERMS[int(stopped.fault_term[0])]) == (0, "reward")


def test_skipped_updates_are_counted_and_twenty_in_a_row_are_a_fault() -> None:
    """They are not in a row where one in between is not skipped."""
    trainer, inputs, states = at_apg(sharp=1.0)
    kind = at_apg()[1]

    def seen(states: TrainState) -> tuple[int, int, int]:
        return int(states.totals.skipped[0]), int(states.skipped_in_a_row[0]), int(states.fault_update[0])

    states = after(15, trainer, inputs, states)
    assert seen(states) == (15, 15, -1)
    states = after(1, trainer, kind, states)
    assert seen(states) == (15, 0, -1)
    states = after(8, trainer, inputs, states)
    assert seen(states) == (23, 8, -1)
    states = states._replace(skipped_in_a_row=jnp.full(1, 18, jnp.int32), unrolls=states.unrolls - 8)
    states = after(1, trainer, inputs, states)
    assert seen(states) == (24, 19, -1)
    states = after(1, trainer, inputs, states)
    assert seen(states) == (25, 20, 25)
    assert FAULT_TERMS[int(states.fault_term[0])] == "policy_gradient"


def test_a_run_whose_updates_are_skipped_on_and_on_is_at_fault() -> None:
    """The fault names the gradient; the rows before have the number of skipped ones."""
    trainer, inputs, states = at_apg(sharp=1.0)
    fly = driver.report_flights(trainer)
    programs = driver.Programs(lambda: trainer.train, lambda: trainer.apg, lambda: fly, trainer.gather)
    config = MANY_UPDATES.learner
    made = list(driver.run_chunks(states, inputs, programs, config, driver.Clock(), lambda: False))
    rows = [row for chunk in made for row in chunk.rows]
    assert [row["apg_skipped"] for row in rows] == [12.0, 12.0]
    first = next(i for i, chunk in enumerate(made) if any(chunk.faults))
    unrolls = made[first].env_steps // config.steps_per_unroll - config.learning_unrolls
    assert 20 <= unrolls // config.unrolls_per_apg_update <= 22
    assert made[first].faults == ["policy_gradient is not finite in update 19"]


def test_every_update_flies_starts_of_its_own() -> None:
    """Without noise and with a policy that does not move: yet each has another mean return."""
    trainer, inputs, states = at_apg()
    nothing = np.full(1, 1e-20, np.float32)
    hyper = inputs.hyper._replace(apg_learning_rate=nothing, sigma=nothing, sigma_end=nothing)
    slow = inputs._replace(hyper=hyper)
    found = []
    for _ in range(4):
        states = after(1, trainer, slow, states._replace(totals=jax.tree.map(jnp.zeros_like, states.totals)))
        found.append(float(states.totals.rewards[0]))
    assert len(set(found)) == 4


class Looping(Pushed):
    """Its step cannot be differentiated."""

    def step(self, state: State, action: jax.Array) -> State:
        pushed = jax.lax.while_loop(lambda a: jnp.abs(a[0]) > 1.0, lambda a: a / 2.0, action)
        return super().step(state, pushed)


def test_an_environment_without_a_gradient_is_told_before_training() -> None:
    """One line that names the key; without APG it is welcome."""
    with pytest.raises(BadInput, match="inverted: key 'apg_fraction': expected 0"):
        tasks.check(Looping(), run_config(**WITH_APG).learner, "inverted")
    tasks.check(Looping(), run_config().learner, "inverted")
    tasks.check(Pushed(), run_config(**WITH_APG).learner, "inverted")


@pytest.mark.parametrize("stop_after", [21, 22])
def test_stopped_during_apg_it_goes_on_to_the_same_bits(tmp_path: Path, whole: Path, stop_after: int) -> None:
    env, run = small_run.pendulum(), run_config(**WITH_APG)
    train(tmp_path, run, env, stop_after=stop_after)
    reached = checkpoint.saved_steps(tmp_path)[0]
    assert 720 < reached < 1200
    train(tmp_path, run, env, resume=True)
    assert_same_leaves(leaves(tmp_path), leaves(whole))
    assert comparable_metrics(tmp_path) == comparable_metrics(whole)


def test_presets_with_apg_say_so_in_whole_unrolls() -> None:
    """What ships: the flights fit the steps that they are counted as."""
    for name in preset_names():
        config = Config.model_validate_json(json.dumps(load_preset("default") | load_preset(name)))
        if config.num_apg_updates:
            assert (
                config.apg_num_envs * config.apg_episode_length
                == config.unrolls_per_apg_update * config.steps_per_unroll
            )


class Growing(Env):
    """A number that grows by half at each step, and is pushed. Reward −x²."""

    observation_size, action_size, backend = 1, 1, "test"  # pyright: ignore[reportAssignmentType]

    def reset(self, rng: jax.Array) -> State:
        return self._at(0.01 * jax.random.normal(rng))

    def step(self, state: State, action: jax.Array) -> State:
        return self._at(1.5 * state.pipeline_state + 0.3 * action[0])

    def _at(self, x: jax.Array) -> State:
        return State(x, x[None], -(x**2), jnp.zeros(()))


@pytest.mark.parametrize("limit", [1e-3, 0.1, 1e9])
def test_the_gradient_with_respect_to_a_state_is_cut(limit: float) -> None:
    """That of state and observation together, at each step and for each flight by itself, as in a literal reverse pass;
    what is not above the limit stays.
    """
    steps, gain, keys = 8, 0.4, jax.random.split(jax.random.PRNGKey(0), 5)

    def total(k: jax.Array) -> jax.Array:
        values, _ = analytic_gradient.returns(
            Growing(), linear(k[None]), (), jnp.float32(0.0), keys, steps, jnp.float32(limit)
        )
        return values.sum()

    ours = float(jax.grad(total)(jnp.float32(gain)))
    expected = 0.0
    for key in keys:
        x = [float(Growing().reset(jax.random.split(key)[0]).pipeline_state)]
        for _ in range(steps):
            x.append(1.5 * x[-1] + 0.3 * gain * x[-1])
        assert max(map(abs, x)) * gain < 1.0  # no action is clipped
        of_state = of_observation = 0.0
        for t in range(steps, 0, -1):
            share = min(1.0, limit / max((of_state**2 + of_observation**2) ** 0.5, 1e-12))
            raw = share * (of_state + of_observation) - 2.0 * x[t]
            expected += raw * 0.3 * x[t - 1]
            of_state, of_observation = 1.5 * raw, 0.3 * gain * raw
    assert ours == pytest.approx(expected, rel=1e-4)


def test_the_cut_of_a_flights_gradient_does_not_depend_on_how_many_fly() -> None:
    """The same flights twice: the same mean gradient, where the bound is at work."""
    ours, keys = learner(), jax.random.split(jax.random.PRNGKey(0), 3)
    state = ours.init(jax.random.PRNGKey(1))

    def gradient(keys: jax.Array, limit: float | None) -> float:
        def flown(now: LearnerState) -> tuple[jax.Array, jax.Array]:
            def act(memory: Any, x: jax.Array) -> tuple[Any, jax.Array]:
                return memory, ours.mean(now, jnp.concatenate([x, x], axis=-1))

            return analytic_gradient.returns(Growing(), act, (), jnp.float32(0.1), keys, 6, limit)

        return float(ours.apg_update(state, flown, jnp.float32(0.0))[1].policy_gradient)

    once, free = gradient(keys, 0.01), gradient(keys, None)
    assert gradient(jnp.concatenate([keys, keys]), 0.01) == pytest.approx(once, rel=1e-5)
    assert once < 0.9 * free


def test_the_first_updates_are_split_into_shorter_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as the fraction says, rounded up, each with a key, a progress and flights of its own.

    A run that is stopped among them, or between them and the rest, goes on to the same bits.
    """
    split = {**WITH_APG, "apg_split": 4, "apg_split_fraction": 0.4}
    env, run, seen = small_run.pendulum(), run_config(**split), []
    config = run.learner
    original = trainer._apg_update

    def update(setup: Any, inputs: Any, key: Any, progress: Any, length: int, state: TrainState) -> TrainState:
        jax.debug.callback(lambda k, p: seen.append((p.item(), length, *k.tolist())), key, progress)
        return original(setup, inputs, key, progress, length, state)

    monkeypatch.setattr(trainer, "_apg_update", update)
    (tmp_path / "whole").mkdir()
    train(tmp_path / "whole", run, env)
    jax.effects_barrier()
    assert (config.num_apg_updates, int(trainer.split_apg_updates(config, config.learning_unrolls))) == (6, 3)
    assert [length for _, length, *_ in seen] == [5] * 12 + [20] * 3
    np.testing.assert_allclose([p for p, *_ in seen], [*np.arange(12) / 24, 3 / 6, 4 / 6, 5 / 6], rtol=1e-6)
    assert len({tuple(key) for *_, key in ((p, n, k) for p, n, *k in seen)}) == 15
    for stop_after in (19, 23):
        folder = tmp_path / str(stop_after)
        folder.mkdir()
        train(folder, run, env, stop_after=stop_after)
        train(folder, run, env, resume=True)
        assert_same_leaves(leaves(folder), leaves(tmp_path / "whole"))


def test_what_cannot_be_split_is_refused() -> None:
    with pytest.raises(ValidationError, match="expected apg_episode_length to be a multiple of apg_split = 3"):
        run_config(**WITH_APG, apg_split=3)


@pytest.mark.parametrize("recurrent", [True, False])
def test_the_bound_is_on_the_norm_of_all_that_a_flight_carries(recurrent: bool) -> None:
    """NumPy's norm over observation, numbers and memory of each flight; those below it, and integers, as they are."""
    rng, size = np.random.default_rng(0), np.array([[0.01], [0.1], [0.5], [10.0], [100.0], [np.inf]])
    parts = [(size * rng.normal(size=(6, k))).astype(np.float32) for k in (5, 4, *([3] if recurrent else []))]
    carry = Carry(jnp.zeros((6, 5)), jnp.zeros((4, 6)), jnp.zeros((0, 6)), [jnp.zeros(6, jnp.int32)])
    memory = jnp.zeros((6, 3)) if recurrent else ()
    _, back = jax.vjp(lambda *x: analytic_gradient._bounded(*x, jnp.float32(2.0)), carry, memory)
    none = [np.zeros(6, jax.dtypes.float0)]
    cotangent = Carry(jnp.asarray(parts[0]), jnp.asarray(parts[1].T), carry.drawn, none)
    found, found_memory = back((cotangent, jnp.asarray(parts[2]) if recurrent else ()))
    norm = np.sqrt(sum((x.astype(float) ** 2).sum(axis=1) for x in parts))
    assert (norm < 2.0).sum() in (2, 3)
    for ours, x in zip([found.observation, found.moving.T, *jax.tree.leaves(found_memory)], parts, strict=True):
        np.testing.assert_allclose(ours[:5], (x * np.minimum(1.0, 2.0 / norm)[:, None])[:5], rtol=1e-4)
        np.testing.assert_array_equal(ours[5], 0.0)

"""The update: what it minimizes, and what its options mean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bound_learner import BoundLearner
from qrl.algorithm import learner as algorithm
from qrl.algorithm.learner import LearnerSpec, LearnerState, UpdateMetrics
from qrl.algorithm.types import Transition
from qrl.config import Config, Hyperparameters, load_preset

B, T, F, A = 3, 7, 5, 2


def config(**changes: object) -> Config:
    return Config.model_validate(load_preset("default") | {"normalize_observations": False} | changes, strict=False)


def random_ends() -> np.ndarray:
    return np.random.default_rng(0).random((B, T)) < 0.4  # more than one in a trajectory


def ends_at(*steps: int) -> np.ndarray:
    """[B, T]: trajectory i ends at the i-th of `steps`; T: not at all."""
    return np.arange(T) == np.asarray(steps)[:, None]


# Where trajectories end: at more steps than one, at one or at none before the last.
ENDS = {
    "ends within": random_ends(),
    "one end within": ends_at(0, T - 2, 3),
    "one end within, one at the end": ends_at(2, T, 4) | ends_at(T - 1, T - 1, T),
    "ends at the end": ends_at(T, T - 1, T - 1),
}


def batch(seed: int = 0, ended: np.ndarray = ENDS["ends within"]) -> Transition:
    """Trajectories, with final observations of their own."""
    rng = np.random.default_rng(seed)
    count, steps = ended.shape
    terminated = ended & (np.cumsum(ended).reshape(ended.shape) % 3 == 0)
    truncated = ended & ~terminated
    values = Transition(
        observation=rng.normal(size=(count, steps, F)),
        action=rng.normal(size=(count, steps, A)),
        log_mu=rng.normal(size=ended.shape) - 2.0,
        reward=rng.normal(size=ended.shape),
        final_observation=rng.normal(size=(count, 2, F)),
        terminated=terminated,
        truncated=truncated,
        out_of_bounds=truncated & (np.cumsum(truncated) % 3 == 2).reshape(ended.shape),
    )
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), values)


def begin(learner: BoundLearner, data: Transition) -> LearnerState:
    """A first state that has seen the rewards, which bound V."""
    return learner.update_statistics(learner.init(jax.random.PRNGKey(1)), data.observation, data.reward)


def losses(learner: BoundLearner, data: Transition) -> tuple[float, float]:
    _, terms = jax.jit(learner.update)(begin(learner, data), data)
    return float(terms.policy_loss), float(terms.value_loss)


def test_members_side_by_side_have_their_own_ends() -> None:
    """Under vmap, as on a GPU, a member changes no other."""
    learner = BoundLearner(config(), F, A)
    each = [batch(0, ENDS["ends within"]), batch(1, ENDS["one end within"])]
    state = begin(learner, each[0])
    both = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _, terms = jax.jit(jax.vmap(learner.update, in_axes=(None, 0)))(state, both)
    for i, data in enumerate(each):
        _, alone = jax.jit(learner.update)(state, data)
        ours = terms.policy_loss[i], terms.value_loss[i]
        np.testing.assert_allclose(ours, (alone.policy_loss, alone.value_loss), rtol=1e-5)


def test_update_ascends_both_losses() -> None:
    """Repeated updates on one batch lower the value loss and raise the objective."""
    learner = BoundLearner(config(learning_rate=1e-2, num_timesteps=1_000_000), F, A)
    data, update = batch(), jax.jit(learner.update)
    state, first = update(begin(learner, data), data)
    last = first
    for _ in range(30):
        state, last = update(state, data)
    assert last.policy_loss < first.policy_loss
    assert last.value_loss < first.value_loss


def test_normalized_the_policy_gradient_is_divided_by_the_deviation_of_a() -> None:
    """The objective with xi = epsilon·|A| is proportional to A; the critic's is not concerned."""
    data = batch()
    data = data._replace(reward=5.0 * data.reward)
    plain, normal = (
        jax.jit(learner.update)(begin(learner, data), data)[1]
        for learner in (BoundLearner(config(normalize_advantage=on), F, A) for on in (False, True))
    )
    assert plain.a_trace > 2.0
    np.testing.assert_allclose(normal.policy_gradient, plain.policy_gradient / plain.a_trace, rtol=1e-5)
    np.testing.assert_allclose(normal.value_gradient, plain.value_gradient, rtol=1e-5)


@pytest.mark.parametrize("xi", [None, 0.3])
def test_a_minibatch_in_parts_is_the_whole(xi: float | None) -> None:
    """A trajectory on each of three devices: A is normalized by its deviation over all."""
    data = batch()
    data = data._replace(reward=data.reward * jnp.array([0.2, 1.0, 5.0])[:, None])  # parts differ
    learner = BoundLearner(config(xi=xi), F, A)
    whole = jax.jit(learner.update)(begin(learner, data), data)
    shared = BoundLearner(config(xi=xi), F, A, "device")
    parts = jax.tree.map(lambda x: x[:, None], data)
    each = jax.jit(jax.vmap(shared.update, in_axes=(None, 0), axis_name="device"))(begin(learner, data), parts)
    for device in range(B):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x[device], y, rtol=2e-4, atol=2e-6), each, whole)  # noqa: B023


def test_the_range_of_rewards_is_all_that_was_seen_and_zero() -> None:
    learner, data = BoundLearner(config(), F, A), batch()
    state = learner.init(jax.random.PRNGKey(0))
    found = []
    for rewards in ([0.5, 2.0], [1.0, 1.0], [-3.0, 0.0], [7.0, -1.0]):
        state = learner.update_statistics(state, data.observation, jnp.array(rewards))
        found.append(state.reward_range.tolist())
    assert found == [[0.0, 2.0], [0.0, 2.0], [-3.0, 2.0], [-3.0, 7.0]]


def test_sigma_is_log_linear_and_ends_where_it_should() -> None:
    """sigma at the start, sigma_end after the last update, the geometric mean half-way."""
    learner = BoundLearner(config(sigma=0.4, sigma_end=0.1), F, A)
    state = learner.init(jax.random.PRNGKey(0))
    at = lambda share: float(learner.sigma(state._replace(updates=jnp.int32(round(share * learner.planned_updates)))))  # noqa: E731
    np.testing.assert_allclose([at(0.0), at(0.5), at(1.0)], [0.4, 0.2, 0.1], rtol=1e-4)


def test_average_is_the_mean_of_the_last_policies() -> None:
    """With averaging on, what ships is the arithmetic mean of the policies of the run's last part."""
    learner = BoundLearner(
        config(num_timesteps=64 * 50 * 5, warmup_unrolls=1, updates_per_unroll=4, average_fraction=0.5), F, A
    )
    data, update = batch(), jax.jit(learner.update)
    state = begin(learner, data)
    policies = []
    for _ in range(learner.planned_updates):
        state, _ = update(state, data)
        policies.append(state.params.policy)
    last = policies[learner.planned_updates // 2 :]
    expected = jax.tree.map(lambda *p: np.mean(p, axis=0), *last)
    shipped = learner.deployed(state).params.policy
    jax.tree.map(lambda s, e: np.testing.assert_allclose(s, e, rtol=1e-5, atol=1e-6), shipped, expected)


def test_observation_statistics_standardize() -> None:
    """With normalize_observations the networks see zero mean and unit deviation."""
    learner = BoundLearner(config(normalize_observations=True), F, A)
    data = 3.0 + 2.0 * jax.random.normal(jax.random.PRNGKey(2), (4000, F))
    state = learner.update_statistics(learner.init(jax.random.PRNGKey(0)), data, jnp.zeros(4000))
    seen = learner.preprocess(state, data)
    np.testing.assert_allclose(np.mean(seen, 0), 0.0, atol=1e-2)
    np.testing.assert_allclose(np.std(seen, 0), 1.0, atol=1e-2)


@pytest.fixture(scope="module")
def traced() -> tuple[Hyperparameters, object]:
    """Every hyperparameter that travels, and one compiled program of what they decide, half-way through a run."""
    here = config(observation_scale=[1.0] * F, num_timesteps=64 * 50 * 4, max_grad_norm=0.1, sigma=1.0, sigma_end=1.0)
    learner, data = BoundLearner(here, F, A), batch()
    state = begin(learner, data)._replace(updates=jnp.int32(learner.planned_updates // 2))

    @jax.jit
    def decided(values: Hyperparameters) -> tuple[LearnerState, UpdateMetrics, jax.Array, LearnerState]:
        other = learner.with_hyper(values)
        apg, *_ = other.apg_update(
            state, lambda now: (other.mean(now, data.observation).sum(axis=(1, 2)), jnp.ones(B)), jnp.float32(0.0)
        )
        return *other.update(state, data), other.sigma(state), apg

    return here.hyperparameters, decided


# The bound on cotangents is an argument of the flights (test_analytic_gradient).
@pytest.mark.parametrize("name", [name for name in Hyperparameters._fields if name != "apg_cotangent_norm"])
def test_a_traced_hyperparameter_is_an_argument_of_the_program(traced: tuple, name: str) -> None:
    """One compiled program, another value: another result. (None that is declared traced is a constant in it.)"""
    values, decided = traced
    if name == "xi":  # whether it is there at all is static
        values = values._replace(xi=np.float32(0.01))
    first, second = (
        decided(values),
        decided(values._replace(**{name: np.float32(0.5) * getattr(values, name) + np.float32(1e-4)})),
    )
    assert any(
        np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(*map(jax.tree.leaves, (first, second)), strict=True)
    )


def test_other_values_make_the_learner_that_has_them(traced: tuple) -> None:
    """Under another configuration's values a learner does what one of that configuration does."""
    changes = {"gamma": 0.9, "epsilon": 0.05, "sigma": 0.5, "learning_rate": 1e-3, "reward_scaling": 0.3}
    there, data = BoundLearner(config(**changes), F, A), batch()
    here = BoundLearner(config(), F, A).with_hyper(there.config.hyperparameters)
    np.testing.assert_array_equal(losses(here, data), losses(there, data))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize(("hidden", "gru"), [((7, 6), None), ((7,), 6)], ids=["MLP", "GRU"])
@pytest.mark.parametrize("seen", [None, 3])
def test_weights_that_have_the_scale_act_alike(
    hidden: tuple[int, ...], gru: int | None, seen: int | None, normalize: bool
) -> None:
    """Without a scale of observations; with the policy that has it in its weights, not with the same."""
    networks = {"policy_hidden_layer_sizes": hidden, "policy_gru_size": gru, "symmetries": not gru}
    scale = [0.5, 2.0, 3.0, 0.1, 5.0]
    here = config(observation_scale=scale, normalize_observations=normalize, **networks)
    spec = LearnerSpec(here, F, A, policy_observation_size=seen)
    state = algorithm.init(spec, here.hyperparameters, jax.random.PRNGKey(1))
    hyper, scaled = algorithm.with_scale_in_weights(spec, here.hyperparameters, state)
    assert hyper.observation_scale is None
    observation, memory = jax.random.normal(jax.random.PRNGKey(2), (9, F)), algorithm.initial_memory(spec, 9)
    expected = algorithm.act(spec, here.hyperparameters, state, memory, observation)
    found = algorithm.act(spec, hyper, scaled, memory, observation)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), found, expected)
    assert not np.allclose(algorithm.act(spec, hyper, state, memory, observation)[1], expected[1], rtol=1e-2)


def test_a_scale_stays_where_the_policy_has_a_view_of_its_own() -> None:
    """Or where there is none."""
    here = config(observation_scale=[2.0] * F)
    spec = LearnerSpec(here, F, A, policy_view=lambda observation: observation[..., ::-1])
    state = algorithm.init(spec, here.hyperparameters, jax.random.PRNGKey(1))
    unchanged = algorithm.with_scale_in_weights(spec, here.hyperparameters, state)
    assert unchanged[0].observation_scale is not None
    assert unchanged[1] is state
    plain = config().hyperparameters
    assert plain.observation_scale is None
    assert algorithm.with_scale_in_weights(LearnerSpec(config(), F, A), plain, state)[1] is state


@pytest.mark.parametrize("normalize", [False, True])
def test_the_policy_sees_the_first_numbers_and_the_critic_all(normalize: bool) -> None:
    """A change of what only a critic may see changes values and targets, not the mean; the policy is as wide as what it
    sees, and a deployed one needs no more.
    """
    scale = [1.0, 2.0, 3.0, 4.0, 5.0]
    learner = BoundLearner(config(normalize_observations=normalize, observation_scale=scale), F, A, None, 3)
    data = batch()
    state = begin(learner, data)
    assert state.params.policy["params"]["Dense_0"]["kernel"].shape[0] == 3
    assert state.params.critic["params"]["Dense_0"]["kernel"].shape[0] == F
    hidden = data._replace(observation=data.observation.at[..., 3:].add(1.0))
    mean = learner.mean(state, data.observation)
    np.testing.assert_array_equal(learner.mean(state, hidden.observation), mean)
    np.testing.assert_array_equal(learner.mean(state, data.observation[..., :3]), mean)
    assert np.abs(learner.mean(state, data.observation.at[..., :3].add(1.0)) - mean).max() > 1e-4
    values = [losses(learner, x) for x in (data, hidden)]
    assert values[0][1] != values[1][1]


def test_observations_are_clipped_at_their_limits_before_their_factor() -> None:
    """Those that have one, of the critic's input, too; of the policy's, which is shorter, likewise."""
    learner = BoundLearner(config(observation_scale=[3.0] * F, observation_limit=[None, 0.5, 0.25]), F, A, None, 2)
    data = batch()
    state = begin(learner, data)
    literal = np.array(data.observation)
    assert np.abs(literal[..., 1:3]).max() > 1.0
    for i, most in ((1, 0.5), (2, 0.25)):
        literal[..., i] = np.minimum(np.maximum(literal[..., i], -most), most)
    np.testing.assert_allclose(learner.preprocess(state, data.observation), 3.0 * literal, rtol=1e-6)
    np.testing.assert_array_equal(learner.mean(state, data.observation), learner.mean(state, jnp.asarray(literal)))
    np.testing.assert_array_equal(
        learner.preprocess(state, data.observation[..., :2]), learner.preprocess(state, jnp.asarray(literal[..., :2]))
    )
    with pytest.raises(ValueError, match="expected normalize_observations false with observation_limit"):
        config(normalize_observations=True, observation_limit=[1.0])

"""What an update does to both networks, against a literal surrogate of its loss in float64.

The surrogate's targets, weights and advantages are constants: Algorithm 1 in NumPy, sample by sample. No trace, density
or objective of qrl is in it.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from bound_learner import BoundLearner
from qrl.algorithm import learner as algorithm
from qrl.algorithm import replay_buffer
from qrl.algorithm.adapter import adapt
from qrl.algorithm.learner import LearnerState, UpdateMetrics
from qrl.algorithm.replay_buffer import ReplayBuffer
from qrl.algorithm.types import Networks, Transition
from qrl.config import Config, Hyperparameters, load_preset
from qrl.training import trainer
from qrl.training.state import MemberInputs
from qrl.training.trainer import Setup

Array = np.ndarray

B, T, F, A = 4, 7, 5, 2
CHANGES = {
    "num_timesteps": 64 * 50 * 12,
    "normalize_observations": False,
    "observation_scale": [1.0, 0.5, 2.0, 1.0, 0.7],
    "policy_hidden_layer_sizes": [6],
    "critic_hidden_layer_sizes": [7],
    "max_grad_norm": 1e9,  # no clip
    "sigma": 0.9,
    "sigma_end": 0.5,
    "learning_rate": 0.004,
    "learning_rate_end": 0.001,
    "gamma": 0.9,
}
UNNORMALIZED = [("mu", "difference", True), ("pi", "difference", False)]


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


def doubles(tree: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else x, tree)


def learner_of(advantage: str = "pi", form: str = "ratio", xi: float | None = None, **changes: object) -> BoundLearner:
    """Two of the eight leave the advantage as it is."""
    changes |= {"advantage": advantage, "form": form, "xi": xi}
    changes["normalize_advantage"] = (advantage, form, xi is None) not in UNNORMALIZED
    config = Config.model_validate(load_preset("default") | CHANGES | changes, strict=False)
    return BoundLearner(config, F, A).with_hyper(doubles(config.hyperparameters))


@functools.cache
def update_of(advantage: str, form: str, epsilon: bool) -> Callable[..., tuple[LearnerState, UpdateMetrics]]:
    """Compiled once for each condition and margin, of any hyperparameters."""
    learner = learner_of(advantage, form, None if epsilon else 0.02)
    return jax.jit(lambda hyper, state, data: learner.with_hyper(hyper).update(state, data))


# Where trajectories end: in more than one place (V of all that follows is computed anew), in one, at the last step.
rng = np.random.default_rng(0)
WHERE = {
    "many": rng.random((B, T)) < 0.4,
    "one": np.arange(T) == np.array([0, 2, T - 2, T])[:, None],
    "last": np.arange(T) == np.array([T - 1, T, T - 1, T])[:, None],
}
WHY = ("terminated", "truncated", "out of bounds", "all")


def batch(where: Array, why: str, seed: int = 0) -> Transition:
    """Trajectories [B, T] that end `where`, with final observations of their own."""
    rng = np.random.default_rng(seed)
    count, steps = where.shape
    kind = np.cumsum(where).reshape(where.shape) % 3 if why == "all" else np.full(where.shape, WHY.index(why))
    return Transition(
        observation=rng.normal(size=(count, steps, F)),
        action=0.8 * rng.normal(size=(count, steps, A)),
        log_mu=np.zeros(where.shape),
        reward=rng.normal(size=where.shape) - 0.3,
        final_observation=rng.normal(size=(count, 2, F)),
        terminated=1.0 * (where & (kind == 0)),
        truncated=1.0 * (where & (kind > 0)),
        out_of_bounds=1.0 * (where & (kind == 2)),
    )


@functools.cache
def first_state() -> LearnerState:
    return learner_of().init(jax.random.PRNGKey(1))


def begin(learner: BoundLearner, data: Transition, progress: float, critic: float = 1.0) -> LearnerState:
    """A state that has seen the rewards, and whose networks are lively; the critic's output times `critic`."""
    state = first_state()._replace(planned_updates=jnp.int32(learner.planned_updates))
    noise = np.random.default_rng(2)
    params = jax.tree.map(lambda x: x + 0.3 * noise.normal(size=x.shape), doubles(state.params))
    *_, last = params.critic["params"]
    params.critic["params"][last] = jax.tree.map(lambda x: critic * x, params.critic["params"][last])
    state = learner.update_statistics(state, data.observation, data.reward)
    return state._replace(
        params=params,
        optimizer=doubles(state.optimizer),
        updates=jnp.int32(round(progress * learner.planned_updates)),
    )


def mlp(params: Any, x: Any) -> Any:
    layers = [params["params"][f"Dense_{i}"] for i in range(len(params["params"]))]
    for i, layer in enumerate(layers):
        x = x @ layer["kernel"] + layer["bias"]
        x = x * (x > 0) if i < len(layers) - 1 else x
    return x


def log_pi(hyper: Hyperparameters, progress: float, policy: Any, d: Transition) -> Any:
    sigma = hyper.sigma ** (1 - progress) * hyper.sigma_end**progress
    z = (d.action - mlp(policy, d.observation * hyper.observation_scale)) / sigma
    return (-(z**2) / 2 - jnp.log(sigma * np.sqrt(2 * np.pi))).sum(-1)


def next_observations(d: Transition) -> Array:
    """[B, T, F] what V is bootstrapped from after each step: the next step's own, but the final observations at the
    last step and at the first truncation within bounds before it; at further ones, the observation before the step.
    """
    after = np.roll(d.observation, -1, axis=1)
    for b in range(len(after)):
        cut = [i for i in range(after.shape[1] - 1) if d.truncated[b, i] and not d.out_of_bounds[b, i]]
        for i in cut[1:]:
            after[b, i] = d.observation[b, i]
        if cut:
            after[b, cut[0]] = d.final_observation[b, 0]
        after[b, -1] = d.final_observation[b, 1]
    return after


class Constants(NamedTuple):
    advantage: Array  # [B, T]
    target: Array  # [B, T]


def constants(learner: BoundLearner, progress: float, params: Networks, d: Transition) -> Constants:
    """Algorithm 1, one sample after the other."""
    c, hyper = learner.config, jax.tree.map(float, learner.hyper._replace(observation_scale=None))
    scale, horizon = learner.hyper.observation_scale, 1.0 / (1.0 - hyper.gamma)
    low, high = (hyper.reward_scaling * horizon * x for x in (min(d.reward.min(), 0.0), max(d.reward.max(), 0.0)))
    states = (d.observation, next_observations(d))
    v, v_next = (np.clip(mlp(params.critic, x * scale)[..., 0], low, high) for x in states)
    ratio = np.exp(log_pi(learner.hyper, progress, params.policy, d) - d.log_mu)
    off_policy = c.advantage == "pi"
    advantage, target = np.zeros(d.reward.shape), np.zeros(d.reward.shape)
    for b in range(len(d.reward)):
        error = 0.0
        for i in reversed(range(d.reward.shape[1])):
            reward = hyper.reward_scaling * d.reward[b, i]
            if d.terminated[b, i]:
                after, error = 0.0, 0.0
            elif d.out_of_bounds[b, i]:
                after, error = reward * horizon, 0.0
            elif d.truncated[b, i]:
                after, error = v_next[b, i], 0.0
            else:
                after = v_next[b, i]
            delta = reward + hyper.gamma * after - v[b, i]
            advantage[b, i] = delta + hyper.gamma * hyper.lam * error
            rho, trace = (min(x, ratio[b, i]) if off_policy else 1.0 for x in (hyper.rho_bar, hyper.c_bar))
            error = rho * delta + trace * hyper.gamma * hyper.lam * error
            target[b, i] = v[b, i] + error
    return Constants(advantage, target)


def normalized(known: Constants) -> Constants:
    """A divided by its root mean square."""
    return known._replace(advantage=known.advantage / (np.sqrt((known.advantage**2).mean()) + 1e-8))


def surrogate(
    form: str, params: Networks, hyper: Hyperparameters, progress: float, d: Transition, known: Constants
) -> Networks:
    """The policy's loss and the critic's."""
    a = known.advantage
    log_density = log_pi(hyper, progress, params.policy, d)
    gain = jnp.exp(log_density - d.log_mu) - 1 if form == "ratio" else jnp.exp(log_density) - jnp.exp(d.log_mu)
    limit = hyper.epsilon * jnp.abs(a) if hyper.xi is None else hyper.xi
    v = mlp(params.critic, d.observation * hyper.observation_scale)[..., 0]
    return Networks(-jnp.mean(jnp.minimum(gain * a, limit)), jnp.mean((v - known.target) ** 2))


@functools.partial(jax.jit, static_argnums=0)
def surrogate_gradient(form: str, params: Networks, *given: Any) -> tuple[tuple[jax.Array, Networks], Networks]:
    """((sum of losses, each), gradient)."""

    def losses(params: Networks) -> tuple[jax.Array, Networks]:
        each = surrogate(form, params, *given)
        return each.policy + each.critic, each

    return jax.value_and_grad(losses, has_aux=True)(params)


def assert_literal(learner: BoundLearner, data: Transition, critic: float = 1.0) -> float:
    """Losses, gradients of both networks and their step are the surrogate's; the share of samples at their margin."""
    planned = learner.planned_updates
    progress = round(0.25 * planned) / planned
    state = begin(learner, data, progress, critic)
    noise = np.random.default_rng(5).normal(size=data.reward.shape)
    data = data._replace(log_mu=np.asarray(log_pi(learner.hyper, progress, state.params.policy, data)) + 0.4 * noise)
    known = constants(learner, progress, state.params, data)
    known = normalized(known) if learner.config.normalize_advantage else known
    (_, each), slope = surrogate_gradient(learner.config.form, state.params, learner.hyper, progress, data, known)
    after, terms = update_of(learner.config.advantage, learner.config.form, learner.hyper.xi is None)(
        learner.hyper, state, data
    )
    np.testing.assert_allclose((terms.policy_loss, terms.value_loss), each, rtol=1e-9)
    for before, ours, adam, expected in zip(state.params, after.params, after.optimizer, slope, strict=True):
        flat, _ = ravel_pytree(expected)
        assert np.abs(flat).max() > 1e-3
        found = adam[1].mu / (1.0 - 0.9)  # Adam's first moment after one step
        np.testing.assert_allclose(found, flat, rtol=1e-8, atol=1e-10 * float(np.abs(flat).max()))
        rate = learner.config.learning_rate * (1 - progress) + learner.config.learning_rate_end * progress
        step = ravel_pytree(before)[0] - ravel_pytree(ours)[0]
        np.testing.assert_allclose(step, rate * found / (np.abs(found) + 1e-8), rtol=1e-6, atol=1e-12)
    ratio = np.exp(log_pi(learner.hyper, progress, state.params.policy, data) - data.log_mu)
    return float(np.mean((ratio - 1) * known.advantage > 0.2 * np.abs(known.advantage)))


@pytest.mark.parametrize("xi", [None, 0.02], ids=["epsilon", "xi"])
@pytest.mark.parametrize("form", ["ratio", "difference"])
@pytest.mark.parametrize("advantage", ["mu", "pi"])
def test_update_follows_the_literal_gradient(advantage: str, form: str, xi: float | None) -> None:
    """For each condition and margin, and every place and reason of ends: of both losses in both networks.

    So nothing flows through targets, importance weights and advantages. Also with clips, lambda and a critic whose
    values are beyond what the rewards can pay.
    """
    learner = learner_of(advantage, form, xi)
    clipped = [
        assert_literal(learner, batch(where, why, seed)) for seed, where in enumerate(WHERE.values()) for why in WHY
    ]
    assert 0.1 < np.mean(clipped) < 0.9, "some are clipped, some are not"
    assert_literal(learner, batch(WHERE["many"], "all"), critic=30.0)
    other = learner_of(advantage, form, xi, lam=0.8, rho_bar=0.9, c_bar=1.1, reward_scaling=0.5)
    assert_literal(other, batch(WHERE["many"], "all"))


@pytest.mark.parametrize("steps", [1, 2])
def test_unrolls_may_be_short(steps: int) -> None:
    """Of one step there is none within; of two, one."""
    assert_literal(learner_of(), batch(WHERE["one"][:, :steps], "all"))


@pytest.mark.parametrize("planned", [1.0, 2.0])
def test_the_step_size_is_linear_in_the_planned_updates(planned: float) -> None:
    """Adam's first step is as large as the step size: at the start, within, at the end, and beyond it.

    A learning phase that was extended has a schedule of its new length.
    """
    learner, data = learner_of(), batch(WHERE["many"], "all")
    update = functools.partial(update_of("pi", "ratio", True), learner.hyper)
    state = begin(learner, data, 0.0)
    state = state._replace(planned_updates=jnp.int32(planned * learner.planned_updates))
    sizes = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0, 1.5):
        after, _ = update(state._replace(updates=jnp.int32(round(share * int(state.planned_updates)))), data)
        sizes.append(np.abs(ravel_pytree(after.params.policy)[0] - ravel_pytree(state.params.policy)[0]).max())
    np.testing.assert_allclose(sizes, [0.004, 0.00325, 0.0025, 0.00175, 0.001, 0.001], rtol=1e-3)


def test_targets_are_within_what_the_rewards_can_pay() -> None:
    """Rewards in [−1, 0] at gamma 0.99: targets in [−100, 0], however large a critic has grown, either way.

    Seen through the loss (V − target)² of critics that are constant.
    """
    learner = learner_of(gamma=0.99, reward_scaling=1.0)
    data = batch(WHERE["many"], "all")
    data = data._replace(reward=-np.random.default_rng(3).uniform(size=(B, T)))
    data.reward[0, 0] = -1.0
    state = begin(learner, data, 0.0, critic=0.0)
    data = data._replace(log_mu=np.asarray(log_pi(learner.hyper, 0.0, state.params.policy, data)))
    *_, last = state.params.critic["params"]
    for v in (-1e6, -300.0, 300.0, 1e6):
        state.params.critic["params"][last]["bias"] = np.array([v])
        _, terms = update_of("pi", "ratio", True)(learner.hyper, state, data)
        error = np.sqrt(terms.value_loss)  # root mean square
        nearest, farthest = sorted((abs(v), abs(v + 100.0)))
        assert nearest - 1e-6 <= error <= farthest + 1e-6


PASSES = 3
PPO = {
    "sampling": "epochs",
    "symmetries": False,
    "num_timesteps": B * T * 10,
    "num_envs": B,
    "unroll_length": T,
    "replay_unrolls": 1,
    "warmup_unrolls": 1,
    "batch_size": 2,
    "updates_per_unroll": PASSES * B // 2,
    "learning_rate": 0.03,
    "lam": 0.8,
    "epsilon": 0.1,
}


def test_ppos_targets_are_gae() -> None:
    """Whatever the present policy is: of the critic alone, over every place and reason of ends, not normalized."""
    learner = learner_of("mu", **PPO)
    targets_of = jax.jit(functools.partial(algorithm.targets_of, learner.spec, learner.hyper))
    for seed, where in enumerate(WHERE.values()):
        for why in WHY:
            data = batch(where, why, seed)
            state = begin(learner, data, 0.0)
            found, known = targets_of(state, data), constants(learner, 0.0, state.params, data)
            np.testing.assert_allclose(found.a_trace, known.advantage, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(found.v_trace, known.target, rtol=1e-9, atol=1e-12)


def ppo_losses(params: Networks, hyper: Hyperparameters, progress: float, d: Transition, known: Constants) -> Any:
    """-(PPO's clipped surrogate, Schulman et al. 2017, eq. 7) + the critic's; and the share of ratios out of bounds."""
    ratio = jnp.exp(log_pi(hyper, progress, params.policy, d) - d.log_mu)
    low, high = 1.0 - hyper.epsilon, 1.0 + hyper.epsilon
    gain = jnp.minimum(ratio * known.advantage, jnp.clip(ratio, low, high) * known.advantage)
    v = mlp(params.critic, d.observation * hyper.observation_scale)[..., 0]
    return jnp.mean((v - known.target) ** 2) - jnp.mean(gain), jnp.mean((ratio < low) | (ratio > high))


@jax.jit
def ppo_slope(params: Networks, *given: Any) -> tuple[tuple[jax.Array, jax.Array], Networks]:
    return jax.value_and_grad(ppo_losses, has_aux=True)(params, *given)


class Sized:
    """An environment of which nothing is asked but its sizes."""

    observation_size, action_size = F, A


def test_ppos_passes_are_a_literal_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three passes, minibatch after minibatch: GAE of the networks before the first of them, A divided by its root mean
    square over the minibatch, the clipped surrogate's gradient, and Adam, in NumPy.

    The objective is the clip less A, so that both have the same gradient.
    """
    learner = learner_of("mu", **PPO)
    data, planned = batch(WHERE["many"], "all"), learner.planned_updates
    state = begin(learner, data, 0.25)
    data = data._replace(log_mu=np.asarray(log_pi(learner.hyper, 0.25, state.params.policy, data)))
    order = np.random.default_rng(8).permuted(np.tile(np.arange(B), (PASSES, 1)), axis=1).reshape(-1, 2)
    monkeypatch.setattr(replay_buffer, "epochs", lambda *_: jnp.asarray(order))
    buffer = ReplayBuffer(jax.tree.map(lambda x: jnp.asarray(x)[None], data), jnp.int32(1))
    setup, inputs = Setup(adapt(Sized()), learner.config), MemberInputs(learner.hyper, ())
    updates = jax.jit(lambda state, key: trainer._updates(setup, inputs, state, buffer, key))
    after, metrics = updates(state, jax.random.PRNGKey(0))

    fixed = constants(learner, 0.25, state.params, data)
    params, outside = state.params, []
    first, second = (jax.tree.map(np.zeros_like, params) for _ in range(2))
    for i, index in enumerate(order):
        progress = (int(state.updates) + i) / planned
        part, known = (jax.tree.map(lambda x, index=index: x[index], x) for x in (data, fixed))
        known = normalized(known)
        (loss, share), slope = ppo_slope(params, learner.hyper, progress, part, known)
        slope, terms = jax.tree.map(np.asarray, slope), UpdateMetrics(*np.asarray(metrics[i]))
        found = terms.policy_loss + terms.value_loss
        np.testing.assert_allclose(found, loss + known.advantage.mean(), rtol=1e-6)
        first, second = (
            jax.tree.map(lambda m, g, k=k, b=b: b * m + (1 - b) * g**k, moment, slope)
            for moment, k, b in ((first, 1, 0.9), (second, 2, 0.999))
        )
        rate = learner.config.learning_rate * (1 - progress) + learner.config.learning_rate_end * progress
        unbiased = 1 - 0.9 ** (i + 1), 1 - 0.999 ** (i + 1)
        params = jax.tree.map(
            lambda p, m, v, rate=rate, u=unbiased: p - rate * (m / u[0]) / (np.sqrt(v / u[1]) + 1e-8),
            *(params, first, second),
        )
        outside.append(float(share))
    assert outside[0] == 0.0
    assert 0.1 < outside[-1] < 0.9
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-8), after.params, params)

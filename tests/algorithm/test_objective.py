"""The perceptron objective against the PPO clip, and against the paper's formulas written out (Sec. 2.2 and 3.2)."""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from qrl.algorithm.objective import Form, dominance, margin, perceptron

Params = dict[str, jax.Array]
LogDensity = Callable[[Params, jax.Array, jax.Array], jax.Array]

N = 500  # samples of a batch
each_form = pytest.mark.parametrize("form", ["ratio", "difference"])
each_margin = pytest.mark.parametrize("xi", [None, 0.07], ids=["xi=epsilon|A|", "xi=0.07"])
examples = settings(max_examples=200, deadline=None, derandomize=True)

logs = st.floats(-8, 2)  # of probabilities, or of densities, which may exceed one
advantages = st.floats(-20, 20)
epsilons = st.floats(0.01, 0.5)

left_side = jax.jit(dominance, static_argnames="form")
objective = jax.jit(perceptron, static_argnames="form")
slope = jax.jit(jax.grad(perceptron), static_argnames="form")  # in log_pi


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


class Batch(NamedTuple):
    log_pi: Callable[[Params], jax.Array]  # [N] as a function of pi's parameters
    params: Params
    log_mu: jax.Array  # [N]
    advantage: jax.Array  # [N]


def gaussian(params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Log-density [N] of a linear Gaussian policy over two continuous actions."""
    z = (action - observation @ params["weight"]) * jnp.exp(-params["bias"])
    return jnp.sum(-0.5 * z**2 - params["bias"] - 0.5 * math.log(2 * math.pi), -1)


def categorical(params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Log-probability [N] of a linear softmax policy over two discrete actions."""
    log_probability = jax.nn.log_softmax(observation @ params["weight"] + params["bias"])
    return jnp.where(action[:, 0] > 0, log_probability[:, 0], log_probability[:, 1])


def batch(log_density: LogDensity) -> Batch:
    """A random batch, with pi near enough to mu that some samples are clipped and some are not."""
    rng = np.random.default_rng(0)
    observation, action = jnp.asarray(rng.normal(size=(N, 3))), jnp.asarray(rng.normal(size=(N, 2)))
    mu = {"weight": jnp.asarray(rng.normal(size=(3, 2))), "bias": jnp.asarray(rng.normal(size=2))}
    pi = {name: array + 0.1 * rng.normal(size=array.shape) for name, array in mu.items()}
    log_mu = log_density(mu, observation, action)
    return Batch(lambda params: log_density(params, observation, action), pi, log_mu, jnp.asarray(rng.normal(size=N)))


def ppo_clip(log_pi: chex.Numeric, log_mu: chex.Numeric, advantage: chex.Numeric, epsilon: float) -> jax.Array:
    """L^CLIP, written from PPOclipping."""
    ratio = jnp.exp(log_pi) / jnp.exp(log_mu)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - epsilon, 1 + epsilon) * advantage)


def left_side_and_margin(
    log_pi: float, log_mu: float, advantage: float, form: str, epsilon: float, xi: float | None
) -> tuple[float, float]:
    """Both arguments of the min in equ:perceptronLike for one sample, in plain Python."""
    pi, mu = math.exp(log_pi), math.exp(log_mu)
    left = (pi / mu - 1) * advantage if form == "ratio" else (pi - mu) * advantage
    return left, epsilon * abs(advantage) if xi is None else xi


@given(logs, logs, advantages, epsilons)
@examples
def test_clip_minus_objective_is_advantage(log_pi: float, log_mu: float, advantage: float, epsilon: float) -> None:
    """PPOclipping less equ:perceptronLike with xi = epsilon|A| is A (Sec. 3.2), to float64 rounding."""
    rest = ppo_clip(log_pi, log_mu, advantage, epsilon) - objective(log_pi, log_mu, advantage, epsilon=epsilon)
    rounding = 1e-14 * (1 + math.exp(log_pi - log_mu)) * abs(advantage) + 1e-300
    assert abs(rest - advantage) <= rounding


@pytest.mark.parametrize("log_density", [gaussian, categorical])
def test_clip_and_objective_have_equal_gradients(log_density: LogDensity) -> None:
    """Sec. 3.2: the two differ by a constant, so ascent on either is the same, through any policy's parameters."""
    sample, epsilon = batch(log_density), 0.2

    def gradient(loss: Callable[..., jax.Array]) -> Params:
        def total(params: Params) -> jax.Array:
            return loss(sample.log_pi(params), sample.log_mu, sample.advantage, epsilon=epsilon).sum()

        return jax.jit(jax.grad(total))(sample.params)

    values = objective(sample.log_pi(sample.params), sample.log_mu, sample.advantage, epsilon=epsilon)
    assert 0.1 < (values == margin(sample.advantage, epsilon, None)).mean() < 0.9, "some are clipped, some are not"
    expected, actual = gradient(ppo_clip), gradient(perceptron)
    for name, array in expected.items():
        assert jnp.abs(array).min() > 0.1
        np.testing.assert_allclose(actual[name], array, rtol=1e-11)


@each_margin
@each_form
def test_objective_is_the_papers_formula_sample_by_sample(form: Form, xi: float | None) -> None:
    """equ:perceptronLike with conditions 1 and 3 (difference) or 2 and 4 (ratio), against a scalar loop."""
    rng = np.random.default_rng(0)
    log_pi, log_mu, advantage = rng.normal(size=(3, N))
    expected = [
        min(left_side_and_margin(*sample, form, 0.2, xi)) for sample in zip(log_pi, log_mu, advantage, strict=True)
    ]
    actual = perceptron(*map(jnp.asarray, (log_pi, log_mu, advantage)), form=form, epsilon=0.2, xi=xi)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-14)


@each_margin
@each_form
@given(log_pi=logs, log_mu=logs, advantage=advantages, epsilon=epsilons)
@examples
def test_gradient_vanishes_beyond_the_margin_and_only_there(
    form: Form, xi: float | None, log_pi: float, log_mu: float, advantage: float, epsilon: float
) -> None:
    """Sec. 3.2, the perceptron rule: a sample beyond its margin teaches exactly nothing, one before it does."""
    left, edge = left_side_and_margin(log_pi, log_mu, advantage, form, epsilon, xi)
    assume(abs(advantage) > 1e-6 and abs(left - edge) > 1e-9)
    gradient = slope(log_pi, log_mu, advantage, form=form, epsilon=epsilon, xi=xi)
    if left > edge:
        assert gradient == 0.0
    else:
        weight = math.exp(log_pi - log_mu) if form == "ratio" else math.exp(log_pi)
        assert float(gradient) == pytest.approx(weight * advantage, rel=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("sign", "slope_at"), [(-1.0, math.exp), (1.0, lambda _: 0.0)], ids=["A < 0", "A > 0"])
@pytest.mark.parametrize("log_ratio", [19.0, 20.5, 50.0, 200.0, 1e4])
def test_far_too_likely_bad_actions_teach_the_most(
    log_ratio: float, sign: float, slope_at: Callable[[float], float], dtype: type
) -> None:
    """Beyond a log ratio of 20, where the exponential is held: for A < 0 its gradient stays, finite in float32."""
    a = dtype(0.3 * sign)
    found = slope(dtype(log_ratio), dtype(0.0), a, form="ratio")
    assert found.dtype == dtype
    np.testing.assert_allclose(found, slope_at(min(log_ratio, 20.0)) * a, rtol=1e-5)


@each_margin
@each_form
@given(log_mu=logs, advantage=advantages)
@examples
def test_objective_at_mu_is_zero(form: Form, xi: float | None, log_mu: float, advantage: float) -> None:
    """equ:perceptronLike is exactly 0 where pi = mu, below any positive margin."""
    assert objective(log_mu, log_mu, advantage, form=form, xi=xi) == 0.0


@given(logs, logs, advantages)
@examples
def test_ratio_and_difference_agree_on_what_dominates(log_pi: float, log_mu: float, advantage: float) -> None:
    """Sec. 3.2: where mu > 0, conditions 1 and 2 are the same condition, and so are 3 and 4."""
    assume(abs(advantage) > 1e-6)
    moved = jnp.sign(log_pi - log_mu) * jnp.sign(advantage)
    assume(abs(log_pi - log_mu) > 1e-9 or moved == 0)
    sides = [left_side(log_pi, log_mu, advantage, form=form) for form in ("ratio", "difference")]
    assert [jnp.sign(side) for side in sides] == [moved, moved]


@given(logs, logs, advantages, st.floats(0.1, 10))
@examples
def test_scaling_the_advantage_scales_the_objective(
    log_pi: float, log_mu: float, advantage: float, factor: float
) -> None:
    """Sec. 3.2: with xi = epsilon|A| only the sign of A decides which samples teach; its size weighs them."""
    once, scaled = (objective(log_pi, log_mu, x) for x in (advantage, factor * advantage))
    np.testing.assert_allclose(scaled, factor * once, rtol=1e-12, atol=1e-300)

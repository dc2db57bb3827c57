"""The paper's theory (Sec. 3) on random tabular MDPs, where every quantity is exact in float64.

The oracle is NumPy (`tabular_mdp.py`, written from the paper); the objective is qrl's own. The mathematics behind it:
docs/theory.md.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tabular_mdp
from qrl.algorithm.objective import Form, dominance, perceptron
from tabular_mdp import MDP, Array

Whose = Literal["mu", "pi"]  # whose advantage: A^mu or A^pi
FORMS: tuple[Form, ...] = ("difference", "ratio")
CONDITIONS = [("difference", "mu"), ("ratio", "mu"), ("difference", "pi"), ("ratio", "pi")]  # the paper's 1 to 4
MARGINS = {"xi=epsilon|A|": None, "xi=0.1": 0.1}

each_condition = pytest.mark.parametrize(("form", "whose"), CONDITIONS)
each_form = pytest.mark.parametrize("form", FORMS)
each_margin = pytest.mark.parametrize("xi", MARGINS.values(), ids=MARGINS.keys())


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    """The same numbers in every run."""
    return np.random.default_rng(0)


def trio(rng: np.random.Generator, batch: int = 300, states: int = 5, actions: int = 4) -> tuple[MDP, Array, Array]:
    """Random MDPs with unrelated random policies mu and pi."""
    mdp = tabular_mdp.random_mdp(rng, batch, states, actions)
    return mdp, tabular_mdp.random_policy(rng, mdp), tabular_mdp.random_policy(rng, mdp)


def gain(mdp: MDP, pi: Array, mu: Array) -> Array:
    """eta(pi) − eta(mu) [batch]."""
    return tabular_mdp.eta(mdp, pi) - tabular_mdp.eta(mdp, mu)


def weighted(rho: Array, term: Array) -> Array:
    """sum_s rho(s) sum_a term(s, a) [batch]."""
    return (rho[..., None] * term).sum((-1, -2))


def dominates(mdp: MDP, pi: Array, mu: Array, form: Form, whose: Whose) -> Array:
    """Whether a dominating inequality, as qrl writes it, holds at every (s, a) [batch]."""
    advantage = tabular_mdp.advantage(mdp, mu if whose == "mu" else pi)
    left_side = dominance(jnp.log(pi), jnp.log(mu), jnp.asarray(advantage), form)
    return (np.asarray(left_side) >= 0).all((-1, -2))


# Sec. 3.2: the four dominating inequalities


def shift(rng: np.random.Generator, policy: Array, advantage: Array) -> Array:
    """Move a random part of each bad action's probability to the good ones, split among them at random."""
    good = advantage > 0
    kept = np.where(good, 1.0, rng.uniform(size=policy.shape)) * policy
    share = rng.exponential(size=policy.shape) * good
    return kept + (1.0 - kept.sum(-1, keepdims=True)) * share / share.sum(-1, keepdims=True)


@each_condition
def test_policy_built_to_dominate_has_the_greater_return(rng: np.random.Generator, form: Form, whose: Whose) -> None:
    """Sec. 3.2: pi made from mu by the sign of A^mu; for A^pi, mu made from pi against the sign of A^pi."""
    mdp, given, _ = trio(rng)
    advantage = tabular_mdp.advantage(mdp, given)
    pi, mu = (shift(rng, given, advantage), given) if whose == "mu" else (given, shift(rng, given, -advantage))
    assert dominates(mdp, pi, mu, form, whose).all()
    assert np.abs(pi - mu).sum(-1).max(-1).min() > 0.2, "far from mu: the claim needs no trust region"
    assert (gain(mdp, pi, mu) > 0).all()


@each_condition
def test_random_policy_that_dominates_has_the_greater_return(
    rng: np.random.Generator, form: Form, whose: Whose
) -> None:
    """Sec. 3.2: of random policies near and far from mu, those that satisfy the inequality improve on mu."""
    mdp, mu, other = trio(rng, batch=4000, states=2, actions=3)
    pi = mu + rng.uniform(size=(4000, 1, 1)) * (other - mu)
    held, gained = dominates(mdp, pi, mu, form, whose), gain(mdp, pi, mu)
    assert held.sum() > 100
    assert (gained[held] > 0).all()
    assert (gained[~held] < 0).sum() > 1000, "the condition tells good from bad"


def ascend(logits: Array, mu: Array, advantage: Array, form: Form, xi: float | None) -> Array:
    """One gradient step on the perceptron objective, a ~ mu: ratios are averaged under mu, differences summed."""
    weight = mu if form == "ratio" else np.ones_like(mu)
    return logits + 10.0 * np.asarray(objective_gradient(logits, np.log(mu), advantage, weight, form, xi))


@partial(jax.jit, static_argnames=("form", "xi"))
def objective_gradient(
    logits: jax.Array, log_mu: jax.Array, advantage: jax.Array, weight: jax.Array, form: Form, xi: float | None
) -> jax.Array:
    """Gradient in the logits of the weighted sum of the objective over (s, a), the advantage held constant."""

    def total(logits: jax.Array) -> jax.Array:
        return jnp.sum(weight * perceptron(jax.nn.log_softmax(logits), log_mu, advantage, form=form, xi=xi))

    return jax.grad(total)(logits)


def train(mdp: MDP, form: Form, whose: Whose, xi: float | None, rounds: int = 100, steps: int = 5) -> Iterator[Array]:
    """Policies of successive rounds, from uniform; mu is refreshed to pi between rounds, A^pi between steps."""
    logits = np.zeros(mdp.reward.shape)
    yield (mu := tabular_mdp.softmax(logits))
    for _ in range(rounds):
        advantage = tabular_mdp.advantage(mdp, mu)
        for _ in range(steps):
            logits = ascend(logits, mu, advantage, form, xi)
            if whose == "pi":
                advantage = tabular_mdp.advantage(mdp, tabular_mdp.softmax(logits))
        yield (mu := tabular_mdp.softmax(logits))


@each_margin
@each_condition
def test_ascent_on_the_objective_reaches_the_optimal_policy(
    rng: np.random.Generator, form: Form, whose: Whose, xi: float | None
) -> None:
    """Sec. 3.2, equ:perceptronLike with each of the four conditions: the gap to value iteration closes to 1 %."""
    mdp = tabular_mdp.random_mdp(rng, 32, 4, 3)
    policies = list(train(mdp, form, whose, xi))
    gaps = [(tabular_mdp.optimal_value(mdp) - tabular_mdp.value(mdp, pi)).max(-1) for pi in (policies[0], policies[-1])]
    assert (gaps[-1] < 0.01 * gaps[0]).all()


@each_condition
def test_every_round_of_ascent_that_dominates_improves(rng: np.random.Generator, form: Form, whose: Whose) -> None:
    """Sec. 3.2: ascent finds policies that satisfy the inequality at every (s, a), and those improve on mu."""
    mdp = tabular_mdp.random_mdp(rng, 32, 4, 3)
    policies = list(train(mdp, form, whose, xi=None, rounds=20))
    pairs = list(zip(policies[1:], policies, strict=False))
    held = np.stack([dominates(mdp, pi, mu, form, whose) for pi, mu in pairs])
    gained = np.stack([gain(mdp, pi, mu) for pi, mu in pairs])
    assert held.mean() > 0.5
    assert (gained[held] > 0).all()


# Sec. 3.1: the ideal update of TRPO


def trust_region(mdp: MDP, mu: Array) -> tuple[Array, Array]:
    """rho^mu A^mu [batch, S, A] and beta [batch, 1, 1] = 4 max|A^mu| gamma/(1 − gamma)^2 (paper, Sec. 2.2)."""
    advantage = tabular_mdp.advantage(mdp, mu)
    beta = 4 * np.abs(advantage).max((-1, -2)) * mdp.gamma / (1 - mdp.gamma) ** 2
    return tabular_mdp.visitation(mdp, mu)[..., None] * advantage, beta[:, None, None]


def closed_form_delta(mdp: MDP, mu: Array) -> Array:
    """equ:deltaClosedForm."""
    slope, beta = trust_region(mdp, mu)
    return slope * mu / beta


@each_form
def test_closed_form_delta_dominates_and_improves(rng: np.random.Generator, form: Form) -> None:
    """Sec. 3.1 and 3.2: mu + delta is a policy where gamma ≥ 1/5, satisfies conditions 1 and 2, and beats mu."""
    mdp, mu, _ = trio(rng)
    pi = mu + closed_form_delta(mdp, mu)
    assert (pi > 0).all()
    assert dominates(mdp, pi, mu, form, "mu").all()
    assert (gain(mdp, pi, mu) > 0).all()


@each_margin
@each_form
def test_one_transition_moves_its_action_by_the_sign_of_a(
    rng: np.random.Generator, form: Form, xi: float | None
) -> None:
    """equ:deltaPolicyGradient, at the end of Sec. 3.1: one sample encourages a where A^mu > 0, else discourages it."""
    mdp, mu, _ = trio(rng, batch=20)
    advantage = tabular_mdp.advantage(mdp, mu)
    one_action = np.eye(4)[None, None]  # [1, 1, sampled action, action]
    logits, log_mu = (np.broadcast_to(np.log(mu)[..., None, :], (20, 5, 4, 4)) for _ in range(2))
    gradient = objective_gradient(logits, log_mu, advantage[..., None] * np.ones(4), one_action, form, xi)
    delta = np.einsum("bsaa->bsa", tabular_mdp.softmax(logits + 1e-3 * np.asarray(gradient))) - mu
    assert (np.sign(delta) == np.sign(advantage)).all()


# The end of Sec. 3.2: the on/off-policy policy gradient


def slopes(function: Callable[[Array], Array], logits: Array, step: float = 1e-5) -> Array:
    """Central differences of function(logits) along each logit of the table, stacked on a new last axis."""
    nudges = step * np.eye(logits[0].size).reshape(-1, *logits[0].shape)
    return np.stack([(function(logits + nudge) - function(logits - nudge)) / (2 * step) for nudge in nudges], -1)


def eta_slope(mdp: MDP, logits: Array) -> Array:
    """The derivative of eta(pi) by central differences [batch, S·A]."""
    return slopes(lambda x: tabular_mdp.eta(mdp, tabular_mdp.softmax(x)), logits)


@each_margin
@each_form
def test_objective_gradient_at_mu_is_the_policy_gradient(
    rng: np.random.Generator, form: Form, xi: float | None
) -> None:
    """Sec. 3.2: at pi = mu no sample has reached its margin, and rho^mu-weighted ascent is the policy gradient."""
    mdp, mu, _ = trio(rng, batch=50)
    weight = tabular_mdp.visitation(mdp, mu)[..., None] * (mu if form == "ratio" else np.ones_like(mu))
    gradient = objective_gradient(np.log(mu), np.log(mu), tabular_mdp.advantage(mdp, mu), weight, form, xi)
    np.testing.assert_allclose(np.asarray(gradient).reshape(50, -1), eta_slope(mdp, np.log(mu)), atol=1e-7)

"""Exact tabular Markov decision processes in NumPy float64, written from the paper's Sec. 2.1 and not from our code.

Every function works on a stack of MDPs at once.  Shapes, with any leading batch dimensions [...]:
transition [..., S, A, S], reward [..., S, A], start [..., S], gamma [...], policy [..., S, A].
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class MDP(NamedTuple):
    transition: Array  # P^a_{ss'}, rows sum to one
    reward: Array  # R^a_s, the expected reward
    start: Array  # rho_0
    gamma: Array


def random_mdp(rng: np.random.Generator, batch: int, states: int, actions: int) -> MDP:
    """`batch` MDPs with sparse-ish random transitions, normal rewards and gamma in [0.5, 0.95]."""
    return MDP(
        transition=rng.dirichlet(np.full(states, 0.5), size=(batch, states, actions)),
        reward=rng.normal(size=(batch, states, actions)),
        start=rng.dirichlet(np.ones(states), size=batch),
        gamma=rng.uniform(0.5, 0.95, size=batch),
    )


def random_policy(rng: np.random.Generator, mdp: MDP) -> Array:
    """One policy for each MDP, every probability above zero."""
    *batch, states, actions = mdp.reward.shape
    return softmax(rng.normal(size=(*batch, states, actions)))


def softmax(logits: Array) -> Array:
    """Policy [..., S, A] of a table of logits."""
    weight = np.exp(logits - logits.max(-1, keepdims=True))
    return weight / weight.sum(-1, keepdims=True)


def resolvent(mdp: MDP, pi: Array) -> Array:
    """I − gamma·P_pi, with P_pi[s, s'] = sum_a pi(a|s) P^a_{ss'}."""
    under_pi = np.einsum("...sa,...sat->...st", pi, mdp.transition)
    return np.eye(pi.shape[-2]) - mdp.gamma[..., None, None] * under_pi


def value(mdp: MDP, pi: Array) -> Array:
    """V^pi [..., S] (paper, equ:valueDefinition), from Bellman's linear system."""
    return np.linalg.solve(resolvent(mdp, pi), (pi * mdp.reward).sum(-1)[..., None])[..., 0]


def q_value(mdp: MDP, pi: Array) -> Array:
    """Q^pi [..., S, A] (paper, equ:qDefinition)."""
    return lookahead(mdp, value(mdp, pi))


def lookahead(mdp: MDP, next_value: Array) -> Array:
    """R + gamma·P·V [..., S, A]."""
    return mdp.reward + mdp.gamma[..., None, None] * np.einsum("...sat,...t->...sa", mdp.transition, next_value)


def advantage(mdp: MDP, pi: Array) -> Array:
    """A^pi [..., S, A] (paper, equ:advantageDefinition)."""
    return q_value(mdp, pi) - value(mdp, pi)[..., None]


def visitation(mdp: MDP, pi: Array) -> Array:
    """rho^pi [..., S] = sum_t gamma^t Pr(s_t = s | pi), which sums to 1/(1 − gamma) (paper, below etaForPi&Mu)."""
    return np.linalg.solve(np.swapaxes(resolvent(mdp, pi), -1, -2), mdp.start[..., None])[..., 0]


def eta(mdp: MDP, pi: Array) -> Array:
    """eta(pi) [...], the expected discounted return (paper, equ:etaDefinition)."""
    return (mdp.start * value(mdp, pi)).sum(-1)


def optimal_value(mdp: MDP) -> Array:
    """V* [..., S] by value iteration."""
    best = np.zeros(mdp.start.shape)
    while True:
        last, best = best, lookahead(mdp, best).max(-1)
        if np.abs(best - last).max() < 1e-12:
            return best

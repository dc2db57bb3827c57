"""The perceptron objective: ascend min[(pi/mu − 1)·A, xi] (paper, Sec. 3.2).

Each function is written for samples of any one shape; nothing here knows of time or lanes.
"""

from typing import Literal

import chex
import jax
import jax.numpy as jnp

Form = Literal["ratio", "difference"]

# exp overflows float32 at 88; 0·inf would then make the gradient of a clipped sample NaN instead of 0.
MAX_LOG_RATIO = 20.0


def dominance(log_pi: chex.Array, log_mu: chex.Array, advantage: chex.Array, form: Form) -> chex.Array:
    """Left-hand side of a dominating inequality; pi improves on mu where it is ≥ 0 at every (s, a).

    form "ratio":       (pi/mu − 1)·A   conditions 2 and 4
    form "difference":  (pi − mu)·A     conditions 1 and 3

    `advantage` is A^mu (conditions 1 and 2) or A^pi (3 and 4). All arrays have one shape [...];
    `log_pi` and `log_mu` are log-probabilities (or log-densities) of the action that was taken. Nothing here
    stops gradients: whoever holds the advantage constant says so.
    """
    chex.assert_equal_shape((log_pi, log_mu, advantage))
    if form == "ratio":
        log_ratio = log_pi - log_mu
        # The clamp passes the gradient on: the samples that pi makes far too likely are those that must teach.
        clamped = log_ratio + jax.lax.stop_gradient(jnp.minimum(log_ratio, MAX_LOG_RATIO) - log_ratio)
        return jnp.expm1(clamped) * advantage
    return (jnp.exp(log_pi) - jnp.exp(log_mu)) * advantage


def margin(advantage: chex.Array, epsilon: float | chex.Array, xi: float | chex.Array | None) -> chex.Array:
    """The margin [...]: the constant `xi` where one is given, else epsilon·|A|, which is PPO's clip."""
    return epsilon * jnp.abs(advantage) if xi is None else jnp.full_like(advantage, xi)


def perceptron(
    log_pi: chex.Array,
    log_mu: chex.Array,
    advantage: chex.Array,
    *,
    form: Form = "ratio",
    epsilon: float | chex.Array = 0.2,
    xi: float | chex.Array | None = None,
) -> chex.Array:
    """min[dominance, margin] for each sample, to be maximized (paper, equ:perceptronLike); shape [...]."""
    return jnp.minimum(dominance(log_pi, log_mu, advantage, form), margin(advantage, epsilon, xi))

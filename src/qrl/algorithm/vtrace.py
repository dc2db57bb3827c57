"""V-trace and, with every importance ratio at one, GAE(lambda).  For one trajectory; the caller vmaps."""

from typing import NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs.fusion import stored


class Trace(NamedTuple):
    a_trace: chex.Array  # [T] advantage estimate A^trace
    v_trace: chex.Array  # [T] value target V^trace


def vtrace(
    reward: chex.Array,
    value: chex.Array,
    next_value: chex.Array,
    terminated: chex.Array,
    truncated: chex.Array,
    rho: chex.Array,
    *,
    gamma: float | chex.Array,
    lam: float | chex.Array = 1.0,
    rho_bar: float | chex.Array = 1.0,
    c_bar: float | chex.Array = 1.0,
) -> Trace:
    """Algorithm 1 of the paper, its clipping levels as parameters (the paper's: 1).

    delta_i   = r_i + gamma·(1 − terminated_i)·V(s'_i) − V(s_i)
    A^trace_i = delta_i + gamma·lam·(1 − ended_i)·E_{i+1}
    E_i       = min(rho_bar, rho_i)·delta_i + gamma·lam·min(c_bar, rho_i)·(1 − ended_i)·E_{i+1}
    V^trace_i = V(s_i) + E_i

    with ended = terminated or truncated. A termination zeroes the bootstrap; a truncation bootstraps
    from V of the observation before reset and cuts the trace (partial-episode bootstrapping, Pardo et
    al. 2018). With rho = 1 both outputs are GAE(lam)'s (Schulman et al. 2015, eq. 16).

    reward, value, next_value, terminated, truncated, rho: [T]. `value` is V(s_i), `next_value` V(s'_i)
    with s' the observation before any reset, and `rho` = pi(a_i|s_i)/mu(a_i|s_i). Source: IMPALA
    (Espeholt et al. 2018), eq. 1; the paper's Sec. 4.
    """
    chex.assert_rank(reward, 1)
    chex.assert_equal_shape((reward, value, next_value, terminated, truncated, rho))
    terminated, truncated = terminated.astype(value.dtype), truncated.astype(value.dtype)
    delta = reward + gamma * (1.0 - terminated) * next_value - value
    carry_on = gamma * lam * (1.0 - terminated) * (1.0 - truncated)

    error = linear_recurrence(jnp.minimum(c_bar, rho) * carry_on, jnp.minimum(rho_bar, rho) * delta)
    a_trace = delta + _product(carry_on, jnp.append(error[1:], jnp.zeros_like(error[:1])))
    return Trace(a_trace, value + error)


def linear_recurrence(a: chex.Array, b: chex.Array) -> chex.Array:
    """x_i = b_i + a_i·x_{i+1} for i from T − 1 down to 0, with x_T = 0; a ≥ 0 [T] and b [T] -> x [T].

    By doubling (Hillis and Steele 1986): round k gives each x_i in terms of x_{i + 2^k}, so that six rounds do for 50
    steps; a loop over the steps would be 50 launches on a GPU.
    """
    most = jnp.finfo(a.dtype).max  # a product that overflows stays a number, for it may be multiplied by 0
    steps, reach = len(b), 1
    while reach < steps:
        b = jnp.concatenate([b[:-reach] + _product(a[: steps - reach], b[reach:]), b[-reach:]])
        a = jnp.minimum(a[:-reach] * a[reach:], most)  # of those that more than `reach` steps follow
        a, b = stored((a, b))
        reach *= 2
    return b


def _product(a: chex.Array, b: chex.Array) -> chex.Array:
    """a·b, and 0 where a is: what lies beyond an end stays there even where it overflows."""
    return jnp.where(a == 0.0, 0.0, a * b)

"""V-trace and, with every importance ratio at one, GAE(lambda).  For one trajectory; the caller vmaps."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


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

    def backward(error: chex.Array, x: tuple[chex.Array, ...]) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
        delta_i, carry_on_i, rho_i = x
        a_trace_i = delta_i + carry_on_i * error
        error = jnp.minimum(rho_bar, rho_i) * delta_i + jnp.minimum(c_bar, rho_i) * carry_on_i * error
        return error, (a_trace_i, error)

    _, (a_trace, error) = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on, rho), reverse=True)
    return Trace(a_trace, value + error)

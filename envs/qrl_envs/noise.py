"""Random numbers of a flight, from tables: drawn anew at each step they would take longer than the physics.

A flight begins at a row of its own and goes on by an odd stride of its own, so that flights do not share pairs of rows
at the same distance. For one flight; the caller vmaps.
"""

import chex
import jax.numpy as jnp
import numpy as np

ROWS = 4096


def _table(columns: int, seed: int) -> np.ndarray:
    """Standard normal numbers [ROWS, columns]."""
    return np.random.default_rng(seed).standard_normal((ROWS, columns)).astype(np.float32)


SENSOR_TABLE = _table(12, 2026)  # position, velocity, attitude, body rate: an axis a column
DRIFT_TABLE = _table(5, 2027)  # what moves a wandering bias [3] and a gust [2]
# Of mean 0 and variance 1 exactly: a slow process makes much of a mean (at 5 s and 100 Hz 32 times as much).
DRIFT_TABLE = (DRIFT_TABLE - DRIFT_TABLE.mean(axis=0)) / DRIFT_TABLE.std(axis=0)


def row(table: np.ndarray, first: chex.Array, stride: chex.Array, index: chex.Array) -> chex.Array:
    """The numbers [columns] at an int32 `index` [] of the sequence of `first` and `stride`, both in [0, 1)."""
    start = (first * ROWS).astype(jnp.int32)
    odd = 2 * (stride * 1000).astype(jnp.int32) + 1
    return jnp.moveaxis(jnp.asarray(table)[(start + index * odd) % ROWS], -1, 0)


def ornstein_uhlenbeck(x: chex.Array, normal: chex.Array, correlation_s: chex.Array, dt_s: float) -> chex.Array:
    """A stationary process of variance 1 and autocorrelation exp(−t/correlation_s), `dt_s` after it was `x` [k], by
    standard normal numbers [k]; exact whatever the step.
    """
    kept = jnp.exp(-dt_s / correlation_s)
    return kept * x + jnp.sqrt(1.0 - kept * kept) * normal

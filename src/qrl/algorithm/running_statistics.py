"""Running mean and variance of observations, merged batch by batch (Chan, Golub and LeVeque 1979, eq. 2.1)."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

MIN_STD = 1e-6  # of a feature that does not vary


class RunningStatistics(NamedTuple):
    """Of all observations so far. float32: after some 10¹⁰ of them, new ones hardly count."""

    n: chex.Array  # [] number of observations
    mean: chex.Array  # [F]
    variance: chex.Array  # [F] about `mean`; 1 before the first


def init(size: int) -> RunningStatistics:
    """Of no observations: mean 0, variance 1."""
    return RunningStatistics(jnp.float32(0.0), jnp.zeros(size), jnp.ones(size))


def update(before: RunningStatistics, batch: chex.Array, axis: str | None = None) -> RunningStatistics:
    """`before` merged with a batch [B, F], of which each device of the mesh axis `axis` has an equal part."""

    def over_devices(x: chex.Array) -> chex.Array:
        return jax.lax.pmean(x, axis) if axis else x

    size = batch.shape[0] * (jax.lax.axis_size(axis) if axis else 1)
    mean = over_devices(batch.mean(axis=0))
    variance = over_devices(jnp.square(batch - mean).mean(axis=0))
    share = size / (before.n + size)  # of the batch in all
    delta = mean - before.mean
    return RunningStatistics(
        n=before.n + size,
        mean=before.mean + share * delta,
        variance=(1.0 - share) * before.variance + share * (variance + (1.0 - share) * jnp.square(delta)),
    )


def std(statistics: RunningStatistics) -> chex.Array:
    """Standard deviations [F], at least MIN_STD."""
    return jnp.maximum(jnp.sqrt(statistics.variance), MIN_STD)

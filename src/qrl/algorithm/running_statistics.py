"""Running mean and variance of observations, merged batch by batch (Chan, Golub and LeVeque 1979, eq. 2.1)."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

LEAST_STD = 1e-6  # of a feature that does not vary


class Statistics(NamedTuple):
    """Of all observations so far. float32 throughout: after some 10¹⁰ of them the next ones hardly count."""

    n: chex.Array  # [] how many
    mean: chex.Array  # [F]
    variance: chex.Array  # [F] about `mean`; 1 before the first


def none_yet(size: int) -> Statistics:
    """Of no observations: mean 0, variance 1."""
    return Statistics(jnp.float32(0.0), jnp.zeros(size), jnp.ones(size))


def merged(before: Statistics, batch: chex.Array, axis: str | None = None) -> Statistics:
    """`before` with a batch [B, F], of which each device of the mesh axis `axis` has a part of equal size."""

    def over_devices(x: chex.Array) -> chex.Array:
        return jax.lax.pmean(x, axis) if axis else x

    size = batch.shape[0] * (jax.lax.axis_size(axis) if axis else 1)
    mean = over_devices(batch.mean(axis=0))
    variance = over_devices(jnp.square(batch - mean).mean(axis=0))
    share = size / (before.n + size)  # of the batch in the whole
    apart = mean - before.mean
    return Statistics(
        n=before.n + size,
        mean=before.mean + share * apart,
        variance=(1.0 - share) * before.variance + share * (variance + (1.0 - share) * jnp.square(apart)),
    )


def deviation(of: Statistics) -> chex.Array:
    """Standard deviations [F], at least LEAST_STD."""
    return jnp.maximum(jnp.sqrt(of.variance), LEAST_STD)

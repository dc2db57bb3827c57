"""Starts of evaluation and calibration flights; training and its reports use others."""

import chex
import jax

STARTS = 1000  # of an evaluation; the index of a start is its position among them
EVALUATION_STARTS_SEED = 1_000_003
CALIBRATION_STARTS_SEED = 7_000_003


def evaluation_starts(n: int = STARTS) -> chex.PRNGKey:
    """PRNG keys [n, 2], the first n of any larger number."""
    return jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), n)


def calibration_starts(n: int) -> chex.PRNGKey:
    """PRNG keys [n, 2]."""
    return jax.random.split(jax.random.PRNGKey(CALIBRATION_STARTS_SEED), n)

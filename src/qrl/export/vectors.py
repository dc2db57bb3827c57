"""Observations to hold the C against: what the policy meets, and what nobody should send it."""

import numpy as np
from numpy.typing import NDArray

from qrl.export.kernel import INT16, Kernel
from qrl.export.policy import Policy

EXTREME = (0.0, -0.0, 1e-45, 1e-38, 1e-7, 1e7, 1e20, 3.4028235e38, np.inf, np.nan)  # each with either sign


def observations(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> NDArray[np.float32]:
    """n float32 vectors [n, F]: the first half from the policy's flights; then every corner of the ranges, beyond them,
    at random within, at steps and half-steps, denormal, infinite, not a number, and random bits.
    """
    rng = np.random.default_rng(seed)
    reach = np.maximum(-kernel.least, kernel.most) * kernel.lsb
    low, high = kernel.least * kernel.lsb, kernel.most * kernel.lsb
    size = len(reach)
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2)]
    fixed = [
        np.stack([np.zeros(size), high, low, 2 * reach, -2 * reach]),
        reach * np.concatenate([np.eye(size), -np.eye(size), 1 - 2 * np.eye(size)]),
        np.stack([np.full(size, sign * value) for value in EXTREME for sign in (1, -1)]),
        np.where(np.eye(size) > 0, np.nan, 0.0),
        np.where(np.eye(size) > 0, -np.inf, reach),
    ]
    each = max(n - n // 2 - sum(map(len, fixed)), 0) // 4
    drawn = [
        rng.uniform(-reach, reach, (each, size)),
        rng.uniform(-3 * reach, 3 * reach, (each, size)),
        rng.integers(2 * kernel.least, 2 * kernel.most + 1, (each, size)) / 2 * kernel.lsb,
        rng.integers(0, 2**32, (n, size), dtype=np.uint32).view(np.float32),
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # signalling NaNs among the bits
        return np.concatenate([flights, *fixed, *drawn])[:n].astype(np.float32)


def observations_i16(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> NDArray[np.int16]:
    """n int16 vectors [n, F]: the first half from the policy's flights; then all least, all greatest, every corner of
    the ranges at random, within the ranges, and anything.
    """
    rng = np.random.default_rng(seed)
    size = len(kernel.most)
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2)] / kernel.lsb
    fixed = np.stack([np.full(size, value) for value in (0, 1, -1, INT16, -INT16, -INT16 - 1)])
    each = n // 8
    drawn = [
        np.where(rng.random((each, size)) < 0.5, kernel.least, kernel.most),
        rng.integers(kernel.least, kernel.most + 1, (each, size)),
        rng.integers(-INT16 - 1, INT16 + 1, (n, size)),
    ]
    return np.concatenate([np.clip(np.round(flights), -INT16, INT16), fixed, *drawn])[:n].astype(np.int16)

"""Test vectors for the C kernel: in-distribution and adversarial observations, with the reference's outputs."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as reference
from qrl.export.kernel import INT16, Kernel
from qrl.export.policy import Policy

EXTREMES = (0.0, -0.0, 1e-45, 1e-38, 1e-7, 1e7, 1e20, 3.4028235e38, np.inf, np.nan)  # each with either sign
EMBEDDED = 2  # golden vectors inside the C, for the self-test


class Outputs(NamedTuple):
    """Outputs of a kernel for n float and m fixed-point observations."""

    status: NDArray[np.integer]  # [n]
    act: NDArray[np.floating]  # float32 [n, A], SI units
    status_i16: NDArray[np.integer]  # [m]
    act_i16: NDArray[np.integer]  # int16 [m, A], steps of act_lsb
    selftest: int = 0


class Vectors(NamedTuple):
    """Observations for both entry points, and the reference's outputs for them."""

    obs: NDArray[np.float32]  # [n, F] SI units
    obs_i16: NDArray[np.int16]  # [m, F] steps of lsb
    outputs: Outputs


def with_outputs(kernel: Kernel, obs: NDArray[np.float32], obs_i16: NDArray[np.int16]) -> Vectors:
    outputs = Outputs(*reference.step(kernel, obs), *reference.step_i16(kernel, obs_i16))
    return Vectors(obs, obs_i16, outputs)


def draw(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> Vectors:
    return with_outputs(kernel, observations(policy, kernel, n, seed), observations_i16(policy, kernel, n, seed))


def golden(policy: Policy, kernel: Kernel, n: int = 256) -> Vectors:
    """n finite vectors, the same for both entry points.

    Of the first EMBEDDED, which the C embeds, all but the last are of a flight, and the last is clipped.
    """
    obs = observations(policy, kernel, 2 * n)
    obs = obs[np.isfinite(obs).all(axis=1)]
    clipped = int(np.argmax(reference.step(kernel, obs)[0]))
    order = [*range(EMBEDDED - 1), clipped, *(i for i in range(EMBEDDED - 1, len(obs)) if i != clipped)]
    obs = obs[[*order[:EMBEDDED], *order[EMBEDDED :: max(1, (len(order) - EMBEDDED) // (n - EMBEDDED))]][:n]]
    obs_i16 = np.clip(reference.quantized(kernel, obs)[0], -INT16, INT16).astype(np.int16)
    return with_outputs(kernel, obs, obs_i16)


def observations(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> NDArray[np.float32]:
    """n float32 vectors [n, F]: half from the policy's flights; then the corners of the ranges, values beyond them,
    random values within, whole and half steps, denormals, infinities, NaN, and random bits.
    """
    rng = np.random.default_rng(seed)
    largest = np.maximum(-kernel.obs_min, kernel.obs_max) * kernel.lsb
    low, high = kernel.obs_min * kernel.lsb, kernel.obs_max * kernel.lsb
    size = len(largest)
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2)]
    fixed = [
        np.stack([np.zeros(size), high, low, 2 * largest, -2 * largest]),
        largest * np.concatenate([np.eye(size), -np.eye(size), 1 - 2 * np.eye(size)]),
        np.stack([np.full(size, sign * value) for value in EXTREMES for sign in (1, -1)]),
        np.where(np.eye(size) > 0, np.nan, 0.0),
        np.where(np.eye(size) > 0, -np.inf, largest),
    ]
    each = max(n - n // 2 - sum(map(len, fixed)), 0) // 4
    drawn = [
        rng.uniform(-largest, largest, (each, size)),
        rng.uniform(-3 * largest, 3 * largest, (each, size)),
        rng.integers(2 * kernel.obs_min, 2 * kernel.obs_max + 1, (each, size)) / 2 * kernel.lsb,
        rng.integers(0, 2**32, (n, size), dtype=np.uint32).view(np.float32),
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # signaling NaNs among the bits
        return np.concatenate([flights, *fixed, *drawn])[:n].astype(np.float32)


def observations_i16(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> NDArray[np.int16]:
    """n int16 vectors [n, F]: half from the policy's flights; then the extremes of the type, random corners of the
    ranges, random values within them, and any values.
    """
    rng = np.random.default_rng(seed)
    size = len(kernel.obs_max)
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2)] / kernel.lsb
    fixed = np.stack([np.full(size, value) for value in (0, 1, -1, INT16, -INT16, -INT16 - 1)])
    each = n // 8
    drawn = [
        np.where(rng.random((each, size)) < 0.5, kernel.obs_min, kernel.obs_max),
        rng.integers(kernel.obs_min, kernel.obs_max + 1, (each, size)),
        rng.integers(-INT16 - 1, INT16 + 1, (n, size)),
    ]
    return np.concatenate([np.clip(np.round(flights), -INT16, INT16), fixed, *drawn])[:n].astype(np.int16)

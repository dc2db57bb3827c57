"""Test vectors for the C kernel: in-distribution and adversarial observations, with the reference's outputs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as reference
from qrl.export.kernel import INT16, Kernel
from qrl.export.policy import Policy

EXTREMES = (0.0, -0.0, 1e-45, 1e-38, 1e-7, 1e7, 1e20, 3.4028235e38, np.inf, np.nan)  # each with either sign
LENGTH = 100  # of the sequences of test vectors for a policy with memory
WAYPOINT_STEPS = 40  # on average, between two of a sequence's observations from flights


def embedded(kernel: Kernel) -> int:
    """Golden vectors inside the C, for the self-test."""
    return 2 if kernel.memory is None else 3


class Outputs(NamedTuple):
    """Outputs of a kernel for n float and m fixed-point observations, and its states after each."""

    status: NDArray[np.integer]  # [n]
    act: NDArray[np.floating]  # float32 [n, A], SI units
    state: NDArray[np.uint8]  # [n, bytes] NAME_state, here without padding
    status_i16: NDArray[np.integer]  # [m]
    act_i16: NDArray[np.integer]  # int16 [m, A], steps of act_lsb
    state_i16: NDArray[np.uint8]  # [m, bytes]
    selftest: int = 0


class Observations(NamedTuple):
    """Observations for both entry points, as sequences with a reset before each."""

    obs: NDArray[np.floating]  # float32 [n, F], SI units
    obs_i16: NDArray[np.integer]  # int16 [m, F], steps of lsb
    length: int = 1  # of each sequence but the last, which may be shorter


class Vectors(NamedTuple):
    """Observations, and the reference's outputs."""

    obs: NDArray[np.float32]
    obs_i16: NDArray[np.int16]
    length: int
    outputs: Outputs

    @property
    def observations(self) -> Observations:
        return Observations(self.obs, self.obs_i16, self.length)


def with_outputs(kernel: Kernel, obs: NDArray[np.float32], obs_i16: NDArray[np.int16], length: int) -> Vectors:
    state, status, act = _stepped(kernel, reference.step, obs, length)
    state_i16, status_i16, act_i16 = _stepped(kernel, reference.step_i16, obs_i16, length)
    return Vectors(obs, obs_i16, length, Outputs(status, act, state, status_i16, act_i16, state_i16))


def _stepped(kernel: Kernel, step: Callable[..., Any], obs: NDArray[Any], length: int) -> list[NDArray[Any]]:
    """State, status and action after each observation [n, F], all sequences side by side."""
    n, each = len(obs), []
    padded = np.pad(obs, ((0, -n % length), (0, 0))).reshape(-1, length, obs.shape[1])
    state = reference.initial_state(kernel, len(padded))
    for t in range(length):
        state, status, act = step(kernel, state, padded[:, t])
        each.append((state, status, act))
    states, *rest = (
        np.stack(part, axis=1).reshape(len(padded) * length, *part[0].shape[1:])[:n] for part in zip(*each, strict=True)
    )
    return [packed(kernel, states), *rest]


def packed(kernel: Kernel, state: NDArray[np.int64]) -> NDArray[np.uint8]:
    """States [n, S] as bytes: the fields of NAME_state in their order; of a policy without memory, its unused byte."""
    if kernel.memory is None:
        return np.zeros((len(state), 1), np.uint8)
    memory = kernel.memory
    previous, total, h = np.split(state, [memory.actions, len(memory.shift)], axis=1)
    parts = total.astype("<i4"), previous.astype("<i2"), h.astype("<i2")
    return np.concatenate([np.ascontiguousarray(part).view(np.uint8) for part in parts], axis=1)


def draw(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> Vectors:
    """Observations of every kind; of a policy with memory, in sequences."""
    obs, obs_i16 = observations(policy, kernel, n, seed), observations_i16(policy, kernel, n, seed)
    if kernel.memory is None:
        return with_outputs(kernel, obs, obs_i16, 1)
    # Flights within each sequence as outside: states in between those of flights and the farthest.
    order = np.random.default_rng(seed).permutation(n)
    return with_outputs(kernel, obs[order], obs_i16[order], LENGTH)


def draw_sequences(policy: Policy, kernel: Kernel, n: int, length: int, seed: int = 0) -> Vectors:
    """n smooth sequences of finite observations, long enough to fill an integral; the last one stays in its place."""
    rng = np.random.default_rng(seed)
    measured = policy.calibration[:, : len(policy.observations)].astype(np.float64)
    knots = 2 + length // WAYPOINT_STEPS
    rows = measured[rng.integers(len(measured), size=(n, knots))]
    if policy.memory and (integral := policy.memory.integral):
        # Within the radius; of the last sequence where the gate passes most, until the integral is at its limit.
        axes = len(integral.position)
        inside = rng.uniform(-0.6, 0.6, (n, knots, axes)) * integral.radius_m
        inside[-1] = np.array([0.25, -0.25, 0.0])[:axes] * integral.radius_m
        if integral.circle_m is not None:
            inside[-1] = np.array([0.25, 0.0, -0.25]) * integral.radius_m
            inside[:, :, 0] += integral.circle_m
        rows[:, :, list(integral.position)] = inside
    times = np.arange(length) * (knots - 1) / max(length - 1, 1)
    at = np.minimum(times.astype(int), knots - 2)
    part = (times - at)[:, None]
    obs = ((1 - part) * rows[:, at] + part * rows[:, at + 1]).reshape(n * length, -1).astype(np.float32)
    obs_i16 = np.clip(reference.quantized(kernel, obs)[0], -INT16, INT16).astype(np.int16)
    return with_outputs(kernel, obs, obs_i16, length)


def golden(policy: Policy, kernel: Kernel, n: int = 256) -> Vectors:
    """n finite vectors, the same for both entry points; of a policy with memory, one sequence.

    Of the first `embedded`, which the C embeds, all but the last are of a flight, and the last is clipped.
    """
    first = embedded(kernel)
    obs = observations(policy, kernel, 2 * n)
    obs = obs[np.isfinite(obs).all(axis=1)]
    _, status, act = reference.step(kernel, reference.initial_state(kernel, len(obs)), obs)
    if kernel.memory:  # first of all, where it shows: no action at a limit, and the integral moves
        at_limit = np.isin(np.round(act[: n // 2] / kernel.act_lsb), [kernel.act_min, kernel.act_max]).sum(axis=1)
        moves = np.zeros(n // 2)
        if policy.memory and (integral := policy.memory.integral):
            distance = np.linalg.norm(integral.error(obs[: n // 2, list(integral.position)]), axis=1)
            moves = (distance < 0.8 * integral.radius_m) & (distance > 0.0)
        order = np.lexsort((at_limit, ~moves.astype(bool)))
        obs[: n // 2], status[: n // 2] = obs[order], status[order]
    clipped = int(np.argmax(status))
    order = [*range(first - 1), clipped, *(i for i in range(first - 1, len(obs)) if i != clipped)]
    obs = obs[[*order[:first], *order[first :: max(1, (len(order) - first) // (n - first))]][:n]]
    obs_i16 = np.clip(reference.quantized(kernel, obs)[0], -INT16, INT16).astype(np.int16)
    return with_outputs(kernel, obs, obs_i16, 1 if kernel.memory is None else n)


def least(size: int) -> int:
    """As many vectors of so many numbers as `observations` needs to have ten of each kind that is random."""
    return 2 * (5 + 5 * size + 2 * len(EXTREMES) + 40)


def observations(policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> NDArray[np.float32]:
    """n float32 vectors [n, F]: half from the policy's flights; then the corners of the ranges, values beyond them,
    random values within, whole and half steps, denormals, infinities, NaN, and random bits.
    """
    rng = np.random.default_rng(seed)
    largest = np.maximum(-kernel.obs_min, kernel.obs_max) * kernel.lsb
    low, high = kernel.obs_min * kernel.lsb, kernel.obs_max * kernel.lsb
    size = len(largest)
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2), :size]
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
    flights = policy.calibration[rng.integers(len(policy.calibration), size=n // 2), :size] / kernel.lsb
    fixed = np.stack([np.full(size, value) for value in (0, 1, -1, INT16, -INT16, -INT16 - 1)])
    each = n // 8
    drawn = [
        np.where(rng.random((each, size)) < 0.5, kernel.obs_min, kernel.obs_max),
        rng.integers(kernel.obs_min, kernel.obs_max + 1, (each, size)),
        rng.integers(-INT16 - 1, INT16 + 1, (n, size)),
    ]
    return np.concatenate([np.clip(np.round(flights), -INT16, INT16), fixed, *drawn])[:n].astype(np.int16)

"""The integer policy and its arithmetic in NumPy: the reference for the emitted C."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

INT16 = 32767
TANH_RANGE = 6.0  # the table covers [−6, 6], in 256 intervals; tanh(6) = 1 − 1.2e-5


@dataclass(frozen=True, eq=False)
class Dense:
    """y = saturate(⌊(weight·x + bias)·multiplier / 2^(16 + shift)⌋); the bias includes the rounding half."""

    weight: Ints  # [outputs, inputs], int8
    bias: Ints  # [outputs], int32
    multiplier: Ints  # [outputs], in [0, 2¹⁵)
    shift: int  # in [0, 15]


@dataclass(frozen=True, eq=False)
class Kernel:
    """Observation i is x_i·lsb_i with 1/lsb_i = scale_i·2^(142 − exponent_i); action j is y_j·act_lsb_j."""

    scale: Ints  # [F] in [2¹⁵, 2¹⁶)
    exponent: Ints  # [F]
    obs_min: Ints  # [F] x saturates at obs_min and obs_max
    obs_max: Ints  # [F]
    layers: tuple[Dense, ...]
    activation: str
    act_lsb: NDArray[np.float32]  # [A]
    act_min: Ints  # [A]
    act_max: Ints  # [A]
    act_safe: NDArray[np.float32]  # [A] in SI units

    @property
    def lsb(self) -> NDArray[np.float64]:
        """The step of each observation, in its unit; [F]."""
        return 2.0 ** (self.exponent - 142) / self.scale

    @property
    def widths(self) -> list[int]:
        """Numbers of observations, of each hidden layer's units and of actions."""
        return [len(self.scale), *(len(layer.bias) for layer in self.layers)]


class AccumulatorOverflow(ArithmeticError):
    """An accumulator or a field of the kernel could exceed its type in C."""


def accumulator_bound(kernel: Kernel) -> int:
    """Upper bound of |accumulator| over all observations; AccumulatorOverflow if it is 2³¹ or more."""
    _check_fields(kernel)
    largest, size = 0, np.maximum(-kernel.obs_min, kernel.obs_max)
    for i, layer in enumerate(kernel.layers):
        bounds = np.abs(layer.weight) @ size + np.abs(layer.bias)
        row = int(np.argmax(bounds))
        if bounds[row] >= 2**31:
            raise AccumulatorOverflow(f"layer {i}, output {row}: the accumulator can reach {bounds[row]:,} > 2^31")
        largest, size = max(largest, int(bounds[row])), np.full(len(layer.bias), INT16 + 1)
    return largest


def _check_fields(kernel: Kernel) -> None:
    ranges = [
        ("an input's scale", kernel.scale, 2**15, 2**16 - 1),
        ("an input's exponent", kernel.exponent, -(2**15), INT16),
        ("an input's range", kernel.obs_min, -INT16, 0),
        ("an input's range", kernel.obs_max, 0, INT16),
        ("an action's range", np.concatenate([kernel.act_min, kernel.act_max]), -INT16, INT16),
    ]
    for layer in kernel.layers:
        ranges += [
            ("a weight", layer.weight, -127, 127),
            ("a bias", layer.bias, -(2**31) + 1, 2**31 - 1),
            ("a multiplier", layer.multiplier, 0, INT16),
            ("a shift", np.array(layer.shift), 0, 15),
        ]
    for name, values, low, high in ranges:
        if values.min() < low or values.max() > high:
            raise AccumulatorOverflow(f"{name} is outside [{low}, {high}]")


def tanh_table() -> Ints:
    """tanh at 257 points from −TANH_RANGE to TANH_RANGE, in 1/32767; [257]."""
    return np.round(np.tanh(np.linspace(-TANH_RANGE, TANH_RANGE, 257)) * INT16).astype(np.int64)


def quantized(kernel: Kernel, observation: NDArray[np.float32]) -> tuple[Ints, NDArray[np.bool_]]:
    """Integers [n, F] before saturation, and which rows [n] are finite, for float32 observations [n, F].

    Works on the bits like the C: the 16 leading bits of the significand times `scale`, rounded half away from zero.
    """
    bits = np.ascontiguousarray(observation, np.float32).view(np.uint32).astype(np.int64)
    biased = bits >> 23 & 255
    product = ((bits & 0x7FFFFF) | 0x800000) // 256 * kernel.scale
    right = kernel.exponent - biased
    size = np.where(right > 32, 0, ((product >> np.clip(right - 1, 14, 31)) + 1) // 2)
    return np.where(bits >> 31, -size, size), np.all(biased != 255, axis=-1)


def dense(layer: Dense, x: Ints, low: int) -> Ints:
    """The layer's outputs [n, outputs] from inputs [n, inputs], saturated to [low, 2¹⁵)."""
    # float64 sums the products exactly (each partial sum is an integer below 2³¹), and uses BLAS.
    acc = (x.astype(np.float64) @ layer.weight.T.astype(np.float64)).astype(np.int64) + layer.bias
    return np.clip(acc * layer.multiplier >> 16 + layer.shift, low, INT16)


def hidden(layer: Dense, activation: str, x: Ints) -> Ints:
    """Activations [n, outputs] of a hidden layer."""
    return dense(layer, x, 0) if activation == "relu" else _tanh(dense(layer, x, -INT16 - 1))


def network(kernel: Kernel, x: Ints) -> Ints:
    """Actions [n, A], in steps of act_lsb, for saturated observations x [n, F]."""
    for layer in kernel.layers[:-1]:
        x = hidden(layer, kernel.activation, x)
    return np.clip(dense(kernel.layers[-1], x, -INT16 - 1), kernel.act_min, kernel.act_max)


def _tanh(z: Ints) -> Ints:
    table, (at, part) = tanh_table(), np.divmod(z + INT16 + 1, 256)
    return table[at] + ((table[at + 1] - table[at]) * part + 128 >> 8)


def step_i16(kernel: Kernel, observation: NDArray[np.int16]) -> tuple[Ints, NDArray[np.int16]]:
    """Status [n] and action [n, A] for observations [n, F], in steps of the lsb: qrl_policy_step_i16."""
    unclipped = observation.astype(np.int64)
    x = np.clip(unclipped, kernel.obs_min, kernel.obs_max)
    return np.any(x != unclipped, axis=-1).astype(np.int64), network(kernel, x).astype(np.int16)


def step(kernel: Kernel, observation: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
    """Status [n] and action [n, A] for observations [n, F], in SI units: qrl_policy_step."""
    unclipped, finite = quantized(kernel, observation)
    x = np.clip(unclipped, kernel.obs_min, kernel.obs_max)
    action = network(kernel, x).astype(np.float32) * kernel.act_lsb
    status = np.where(finite, np.any(x != unclipped, axis=-1), 2)
    return status, np.where(finite[:, None], action, kernel.act_safe)

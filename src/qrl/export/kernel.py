"""The integer policy, and its arithmetic in NumPy: what the emitted C is held to, bit by bit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

INT16 = 32767
TANH_RANGE = 6.0  # the table covers [−6, 6], in 256 intervals; tanh(6) = 1 − 1.2e-5


@dataclass(frozen=True, eq=False)
class Dense:
    """y = saturate(⌊(weight·x + bias)·multiplier / 2^(16 + shift)⌋); the half that rounds is part of the bias."""

    weight: Ints  # [outputs, inputs], int8
    bias: Ints  # [outputs], int32
    multiplier: Ints  # [outputs], in [0, 2¹⁵)
    shift: int  # in [0, 15]


@dataclass(frozen=True, eq=False)
class Kernel:
    """Observation i is x_i·lsb_i with 1/lsb_i = scale_i·2^(142 − exponent_i); action j is y_j·act_lsb_j."""

    scale: Ints  # [F] in [2¹⁵, 2¹⁶)
    exponent: Ints  # [F]
    least: Ints  # [F] x saturates at least and most
    most: Ints  # [F]
    layers: tuple[Dense, ...]
    activation: str
    act_lsb: NDArray[np.float32]  # [A]
    act_least: Ints  # [A]
    act_most: Ints  # [A]
    act_safe: NDArray[np.float32]  # [A] in SI units

    @property
    def lsb(self) -> NDArray[np.float64]:
        """The step of each observation, in its unit; [F]."""
        return 2.0 ** (self.exponent - 142) / self.scale


class PossibleOverflow(ArithmeticError):
    """An accumulator could leave 32 bits."""


def accumulator_bound(kernel: Kernel) -> int:
    """The largest size that any accumulator can reach, whatever is observed; PossibleOverflow from 2³¹ on."""
    _check_fields(kernel)
    most, size = 0, np.maximum(-kernel.least, kernel.most)
    for i, layer in enumerate(kernel.layers):
        bounds = np.abs(layer.weight) @ size + np.abs(layer.bias)
        row = int(np.argmax(bounds))
        if bounds[row] >= 2**31:
            raise PossibleOverflow(f"layer {i}, output {row}: the sum of products can reach {bounds[row]:,}, past 2^31")
        most, size = max(most, int(bounds[row])), np.full(len(layer.bias), INT16 + 1)
    return most


def _check_fields(kernel: Kernel) -> None:
    """PossibleOverflow where a number does not fit the type that holds it in C."""
    ranges = [
        ("an input's scale", kernel.scale, 2**15, 2**16 - 1),
        ("an input's exponent", kernel.exponent, -(2**15), INT16),
        ("an input's range", kernel.least, -INT16, 0),
        ("an input's range", kernel.most, 0, INT16),
        ("an action's range", np.concatenate([kernel.act_least, kernel.act_most]), -INT16, INT16),
    ]
    for layer in kernel.layers:
        ranges += [
            ("a weight", layer.weight, -127, 127),
            ("a bias", layer.bias, -(2**31) + 1, 2**31 - 1),
            ("a multiplier", layer.multiplier, 0, INT16),
            ("a shift", np.array(layer.shift), 0, 15),
        ]
    for what, values, low, high in ranges:
        if values.min() < low or values.max() > high:
            raise PossibleOverflow(f"{what} is outside [{low}, {high}]")


def tanh_table() -> Ints:
    """tanh at 257 points from −TANH_RANGE to TANH_RANGE, in 1/32767; [257]."""
    return np.round(np.tanh(np.linspace(-TANH_RANGE, TANH_RANGE, 257)) * INT16).astype(np.int64)


def quantised(kernel: Kernel, observation: NDArray[np.float32]) -> tuple[Ints, NDArray[np.bool_]]:
    """Integers [n, F] before saturation and which rows [n] are finite, of float32 observations [n, F].

    Works on the bits as the C does: the 16 leading bits of the significand times `scale`, rounded half away
    from zero.
    """
    bits = np.ascontiguousarray(observation, np.float32).view(np.uint32).astype(np.int64)
    biased = bits >> 23 & 255
    product = ((bits & 0x7FFFFF) | 0x800000) // 256 * kernel.scale
    right = kernel.exponent - biased
    size = np.where(right > 32, 0, ((product >> np.clip(right - 1, 14, 31)) + 1) // 2)
    return np.where(bits >> 31, -size, size), np.all(biased != 255, axis=-1)


def dense(layer: Dense, x: Ints, least: int) -> Ints:
    """The layer's outputs [n, outputs] from inputs [n, inputs], saturated to [least, 2¹⁵)."""
    # In float64 the products are summed exactly (every partial sum is an integer below 2³¹), and by BLAS.
    acc = (x.astype(np.float64) @ layer.weight.T.astype(np.float64)).astype(np.int64) + layer.bias
    return np.clip(acc * layer.multiplier >> 16 + layer.shift, least, INT16)


def hidden(layer: Dense, activation: str, x: Ints) -> Ints:
    """Activations [n, outputs] of a layer that is not the last."""
    return dense(layer, x, 0) if activation == "relu" else _squashed(dense(layer, x, -INT16 - 1))


def network(kernel: Kernel, x: Ints) -> Ints:
    """Actions [n, A] in their steps of saturated observations x [n, F]."""
    for layer in kernel.layers[:-1]:
        x = hidden(layer, kernel.activation, x)
    return np.clip(dense(kernel.layers[-1], x, -INT16 - 1), kernel.act_least, kernel.act_most)


def _squashed(z: Ints) -> Ints:
    table, (at, part) = tanh_table(), np.divmod(z + INT16 + 1, 256)
    return table[at] + ((table[at + 1] - table[at]) * part + 128 >> 8)


def step_i16(kernel: Kernel, observation: NDArray[np.int16]) -> tuple[Ints, NDArray[np.int16]]:
    """Status [n] and action [n, A] of observations [n, F], both in steps: qrl_policy_step_i16."""
    wanted = observation.astype(np.int64)
    x = np.clip(wanted, kernel.least, kernel.most)
    return np.any(x != wanted, axis=-1).astype(np.int64), network(kernel, x).astype(np.int16)


def step(kernel: Kernel, observation: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
    """Status [n] and action [n, A] of observations [n, F], both in SI units: qrl_policy_step."""
    wanted, finite = quantised(kernel, observation)
    x = np.clip(wanted, kernel.least, kernel.most)
    action = network(kernel, x).astype(np.float32) * kernel.act_lsb
    status = np.where(finite, np.any(x != wanted, axis=-1), 2)
    return status, np.where(finite[:, None], action, kernel.act_safe)

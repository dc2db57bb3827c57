"""Layers of integers near a float policy's: each fitted to what the float layer gives, and rounded weight by weight.

Errors are weighted by the square of the action's derivative by each sum, of the same step.
"""

import numpy as np
from numpy.typing import NDArray

from qrl.export.kernel import Dense, Ints
from qrl.export.policy import ACTIVATIONS, Layer, Policy

Floats = NDArray[np.float64]

INT8 = 127
UNITS = np.linspace(1.0, 1.4, 24)  # relative weight steps tried per row: the error depends erratically on the step
MIN_SENSITIVITY = 0.05  # of a sample, relative to the mean: the action may be sensitive to the unit elsewhere
CLIPPED = 0.1  # sensitivity of a clipped action, relative to an unclipped one


class UnsupportedNetwork(ValueError):
    """The kernel cannot represent this network."""


def fitted_layer(weight: Floats, target: Floats, x: Ints, sensitivity: Floats, out: Floats, ridge: float) -> Dense:
    """The layer whose outputs, in steps of `out`, are nearest to `target` [n, outputs] for inputs x [n, inputs].

    `weight` [inputs, outputs] is the float layer's for inputs in steps; `sensitivity` [n, outputs] weights the samples.
    """
    # A row of tiny weights keeps a coarse unit, so that its multiplier and its bias keep their precision.
    ratios = np.abs(weight).max(axis=0) / INT8 / out
    floor = np.maximum(out * max(ratios.max() / 256.0, 2.0**-20), np.abs(target).max(axis=0) / 2.0**28)
    x_real = x.astype(np.float64)
    rows = [_row(weight[:, o], target[:, o], x_real, sensitivity[:, o], ridge, floor[o]) for o in range(len(out))]
    integers, biases, units = (np.array(column) for column in zip(*rows, strict=True))
    ratio = units / out
    shift = int(np.clip(np.floor(np.log2(32767.0 / ratio.max())) - 16, 0, 15))
    multiplier = np.maximum(np.round(ratio * 2.0 ** (16 + shift)), 1.0)
    if multiplier.max() > 32767:
        raise UnsupportedNetwork("a layer amplifies more than its 16-bit outputs can hold")
    bias = np.round(biases + 2.0 ** (15 + shift) / multiplier)
    return Dense(integers.astype(np.int64), bias.astype(np.int64), multiplier.astype(np.int64), shift)


def _row(
    weight: Floats, target: Floats, x: Floats, sensitivity: Floats, ridge: float, floor: float
) -> tuple[Floats, float, float]:
    """Integers [inputs], bias and unit >= `floor` with unit·(integers·x + bias) near `target` [n].

    The fit is about the mean: the bias absorbs the mean error.
    """
    share = sensitivity / max(sensitivity.mean(), 1e-30) + MIN_SENSITIVITY
    share /= share.sum()
    mean = share @ x
    centered = x - mean
    weighted = centered * share[:, None]
    second = weighted.T @ centered
    diagonal = np.diag(second)
    second += np.diag(ridge * diagonal + 1e-5 * diagonal.mean() + 1e-12)
    middle = share @ target
    nearest = weight + np.linalg.solve(second, weighted.T @ (target - middle - centered @ weight))
    finest = max(float(np.abs(nearest).max()) / INT8, floor)
    integers = _rounded(nearest / (finest * UNITS[:, None]), second)
    error = integers * (finest * UNITS[:, None]) - nearest
    best = int(np.argmin(np.einsum("ui,ij,uj->u", error, second, error)))
    unit, integers = finest * UNITS[best], integers[best]
    return integers, (middle - mean @ (integers * unit)) / unit, unit


def _rounded(weight: Floats, second: Floats) -> Floats:
    """Integers in ±127 near each row of `weight` [n, inputs] that keep x·weight; `second`: the second moment of x."""
    order = np.argsort(-np.diag(second))
    remaining = weight[:, order]
    factor = np.linalg.cholesky(np.linalg.inv(second[np.ix_(order, order)])).T
    result = np.empty_like(weight)
    for i, place in enumerate(order):
        result[:, place] = np.clip(np.round(remaining[:, i]), -INT8, INT8)
        remaining[:, i + 1 :] -= np.outer((remaining[:, i] - result[:, place]) / factor[i, i], factor[i, i + 1 :])
    return result


def sensitivity(policy: Policy, layers: list[Layer], x: Floats, h: Floats) -> tuple[list[Floats], list[Floats]]:
    """Per layer: squared derivative [n, outputs] of the action, in full scales, by its outputs before activation; and
    the same of a recurrent unit's sums.
    """
    slopes: list[Floats] = []
    for weight, bias in layers[:-1]:
        z = x @ weight + bias
        x = ACTIVATIONS[policy.activation](z)
        slopes.append((z > 0).astype(np.float64) if policy.activation == "relu" else 1.0 - x**2)
    weight, bias = layers[-1]
    action = (policy.unit(x, h) if policy.unit else x) @ weight + bias
    low, high = policy.limits
    gain = np.where((action >= low) & (action <= high), 1.0, CLIPPED) / (high - low)
    of_layers = [gain**2]
    by_action = [gain[:, [k]] * np.eye(len(low))[k] @ weight.T for k in range(len(low))]  # of the last layer's inputs
    of_unit: list[Floats] = []
    if unit := policy.unit:
        r, z, n, own = unit.parts(x, h)
        of_candidate = (1.0 - z) * (1.0 - n**2)
        # Of r, z and n, given by the inputs; the memory's part of n is scaled by r.
        by_sums = [
            np.concatenate(
                [d * of_candidate * own * r * (1.0 - r), d * (h - n) * z * (1.0 - z), d * of_candidate], axis=1
            )
            for d in by_action
        ]
        square = sum(part**2 for part in by_sums) + np.zeros(())
        of_unit = [square, square * np.concatenate([np.ones_like(z), np.ones_like(z), r**2], axis=1)]
        by_action = [part @ unit.of_input[0].T for part in by_sums]
    for i in range(len(slopes) - 1, -1, -1):
        by_action = [derivative * slopes[i] for derivative in by_action]
        of_layers.insert(0, sum(derivative**2 for derivative in by_action) + np.zeros_like(slopes[i]))
        by_action = [derivative @ layers[i][0].T for derivative in by_action]
    return of_layers, of_unit

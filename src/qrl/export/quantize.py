"""Quantization of a float policy to integers, calibrated on the policy's own flights.

Four measures keep int8 weights close to the float policy:

- the steps of inputs and activations equalize the sizes of the weights of one layer (Nagel et al. 2019, "Data-Free
  Quantization Through Weight Equalization and Bias Correction");
- each layer is fitted to the float layer's outputs, given the outputs of the quantized layers before it;
- weights are rounded one by one, and each rounding error is compensated by the remaining weights (Frantar et al. 2022,
  "GPTQ");
- all errors are weighted by the action's sensitivity to the layer's output, sample by sample (a diagonal Fisher
  information).
"""

import numpy as np
from numpy.typing import NDArray

from qrl.export.accuracy import accuracy
from qrl.export.kernel import INT16, TANH_RANGE, Dense, Ints, Kernel, accumulator_bound, hidden, step
from qrl.export.policy import ACTIVATIONS, Layer, Policy

Floats = NDArray[np.float64]

INT8 = 127
RANGE_MARGIN = 1.05  # range of an observation over its maximum in calibration
ACTIVATION_MARGIN = 1.2
MIN_LEVELS = 511  # steps within the range of an input or activation, however small its weights
MIN_INPUT = 1e-3  # an input that is zero throughout calibration may move later
MIN_RANGE = 0.05  # of an activation, relative to its layer's largest: a unit inactive in calibration may activate later
RIDGES = (0.01, 0.03, 0.3)  # pull of the fitted weights towards the float ones, in the order tried
GOOD_ENOUGH = 0.03  # maximum action error on the calibration, as a fraction of full scale, that ends the trials
UNITS = np.linspace(1.0, 1.4, 24)  # relative weight steps tried per row: the error depends erratically on the step
FIT_SAMPLES = 8_192
MIN_SENSITIVITY = 0.05  # of a sample, relative to the mean: the action may be sensitive to the unit elsewhere
CLIPPED = 0.1  # sensitivity of a clipped action, relative to an unclipped one


class UnsupportedNetwork(ValueError):
    """The kernel cannot represent this network."""


def quantize(policy: Policy) -> Kernel:
    """The integer policy. Raises UnsupportedNetwork or AccumulatorOverflow.

    Of a few ridges, the one with the smallest maximum error on the calibration: the maximum is noisy, the RMS error
    hardly depends on the ridge.
    """
    _check(policy)
    best, smallest = None, np.inf
    for ridge in RIDGES:
        kernel = _quantized(policy, ridge)
        error = accuracy(policy, lambda observations, k=kernel: step(k, observations)[1], policy.calibration).maximum
        if best is None or error < smallest:
            best, smallest = kernel, error
        if smallest <= GOOD_ENOUGH:
            break
    assert best is not None
    return best


def _quantized(policy: Policy, ridge: float) -> Kernel:
    layers = si_layers(policy)
    clip = policy.observation_clip / policy.observation_gain
    floor, ceiling = policy.observation_offset - clip, policy.observation_offset + clip
    x_float = np.clip(policy.calibration.astype(np.float64), floor, ceiling)
    largest = np.abs(x_float).max(axis=0)
    obs_range = RANGE_MARGIN * np.where(largest > 0.0, largest, MIN_INPUT)
    scale, exponent = _as_scale(_steps(obs_range, layers[0][0], MIN_LEVELS))
    step = 2.0 ** (exponent - 142) / scale
    most = np.minimum(np.floor(obs_range / step), INT16)
    obs_min = np.clip(np.round(floor / step), -most, 0).astype(np.int64)
    obs_max = np.clip(np.round(ceiling / step), 0, most).astype(np.int64)
    low, high = policy.limits
    act_lsb = (np.maximum(np.abs(low), np.abs(high)) / INT16).astype(np.float32)

    subset = slice(None, None, max(1, len(x_float) // FIT_SAMPLES))
    ranges = _activation_ranges(layers, policy.activation, x_float)
    x_float = x_float[subset]
    sensitivity = _sensitivity(policy, layers, x_float)
    x = np.clip(np.round(x_float / step), obs_min, obs_max).astype(np.int64)
    dense: list[Dense] = []
    for i, (weight, bias) in enumerate(layers):
        target = x_float @ weight + bias
        last = i == len(layers) - 1
        if last:
            out = act_lsb.astype(np.float64)
        elif policy.activation == "relu":
            out = _steps(ranges[i], layers[i + 1][0], MIN_LEVELS)
        else:
            out = np.full(len(bias), TANH_RANGE / (INT16 + 1))
        dense.append(_dense(weight * step[:, None], target, x, sensitivity[i], out, ridge))
        if last:
            break
        x = hidden(dense[-1], policy.activation, x)
        x_float = ACTIVATIONS[policy.activation](target)
        step = out if policy.activation == "relu" else np.full(len(bias), 1.0 / INT16)

    act_min, act_max = (np.round(bound / act_lsb.astype(np.float64)).astype(np.int64) for bound in (low, high))
    kernel = Kernel(
        scale=scale,
        exponent=exponent,
        obs_min=obs_min,
        obs_max=obs_max,
        layers=tuple(dense),
        activation=policy.activation,
        act_lsb=act_lsb,
        act_min=act_min,
        act_max=act_max,
        act_safe=np.array([action.safe for action in policy.actions], np.float32),
    )
    accumulator_bound(kernel)
    return kernel


def _check(policy: Policy) -> None:
    if policy.activation not in ACTIVATIONS:
        raise UnsupportedNetwork(f"activation '{policy.activation}': expected one of {', '.join(ACTIVATIONS)}")
    for i, (weight, bias) in enumerate(policy.layers):
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise UnsupportedNetwork(f"layer {i}: a weight is not finite")
    if not np.isfinite(policy.calibration).all() or not len(policy.calibration):
        raise UnsupportedNetwork("no finite flight to calibrate on")


def si_layers(policy: Policy) -> list[Layer]:
    """Layers with observations and actions in SI units: normalization, offset and action scale folded in."""
    layers = [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in policy.layers]
    weight, bias = layers[0]
    weight = weight * (policy.observation_gain * policy.observation_scale)[:, None]
    layers[0] = weight, bias - policy.observation_offset @ weight
    weight, bias = layers[-1]
    layers[-1] = weight * policy.scale, bias * policy.scale + policy.offset
    return layers


def _activation_ranges(layers: list[Layer], activation: str, x: Floats) -> list[Floats]:
    """Range [outputs] of the activations of each hidden layer."""
    ranges: list[Floats] = []
    for weight, bias in layers[:-1]:
        z = x @ weight + bias
        x = ACTIVATIONS[activation](z)
        largest = np.abs(x).max(axis=0)
        ranges.append(ACTIVATION_MARGIN * np.maximum(largest, MIN_RANGE * max(np.abs(z).max(), 1e-6)))
    return ranges


def _sensitivity(policy: Policy, layers: list[Layer], x: Floats) -> list[Floats]:
    """Per layer: squared derivative [n, outputs] of the action, in full scales, by its outputs before activation."""
    slopes: list[Floats] = []
    for weight, bias in layers[:-1]:
        z = x @ weight + bias
        x = ACTIVATIONS[policy.activation](z)
        slopes.append((z > 0).astype(np.float64) if policy.activation == "relu" else 1.0 - x**2)
    weight, bias = layers[-1]
    action = x @ weight + bias
    low, high = policy.limits
    gain = np.where((action >= low) & (action <= high), 1.0, CLIPPED) / (high - low)
    sensitivity = [gain**2]
    by_action = [gain[:, [k]] * np.eye(len(low))[k] for k in range(len(low))]
    for (weight, _), slope in zip(layers[:0:-1], slopes[::-1], strict=True):
        by_action = [derivative @ weight.T * slope for derivative in by_action]
        sensitivity.insert(0, sum(derivative**2 for derivative in by_action) + np.zeros_like(slope))
    return sensitivity


def _steps(ranges: Floats, weight: Floats, levels: int) -> Floats:
    """Steps [inputs] that equalize the rows of `weight` [inputs, outputs], with at least `levels` in each range."""
    finest = ranges / INT16
    size = np.abs(weight).max(axis=1)
    size = np.maximum(size, 1e-9 * max(size.max(), 1e-30))
    return np.maximum(finest, np.minimum((finest * size).max() / size, ranges / levels))


def _as_scale(step: Floats) -> tuple[Ints, Ints]:
    """`scale` in [2¹⁵, 2¹⁶) and `exponent` with 1/step ≈ scale·2^(142 − exponent), never a finer step."""
    fraction, power = np.frexp(1.0 / step)  # 1/step = fraction·2^power, fraction in [1/2, 1)
    return np.floor(fraction * 65536).astype(np.int64), (142 + 16 - power).astype(np.int64)


def _dense(weight: Floats, target: Floats, x: Ints, sensitivity: Floats, out: Floats, ridge: float) -> Dense:
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
    fitted = weight + np.linalg.solve(second, weighted.T @ (target - middle - centered @ weight))
    finest = max(float(np.abs(fitted).max()) / INT8, floor)
    integers = _rounded(fitted / (finest * UNITS[:, None]), second)
    error = integers * (finest * UNITS[:, None]) - fitted
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

"""From a float policy to integers, calibrated on the policy's own flights.

What keeps int8 weights close to the float policy, each in a few lines of linear algebra:

- the steps of inputs and activations are chosen so that weights of one row have like sizes (Nagel et al. 2019,
  "Data-Free Quantization Through Weight Equalization and Bias Correction");
- each layer is fitted to the float layer's outputs from the inputs that the quantised layers before it really give;
- each weight is rounded in turn and its error taken up by those still to come (Frantar et al. 2022, "GPTQ");
- all of it weighted by how much the action feels the output at hand, sample by sample (a diagonal Fisher information).
"""

import numpy as np
from numpy.typing import NDArray

from qrl.export.accuracy import accuracy
from qrl.export.kernel import INT16, TANH_RANGE, Dense, Ints, Kernel, accumulator_bound, hidden, step
from qrl.export.policy import ACTIVATIONS, Layer, Policy

Floats = NDArray[np.float64]

INT8 = 127
RANGE_MARGIN = 1.05  # of an observation beyond what was met
ACTIVATION_MARGIN = 1.2
LEAST_LEVELS = 511  # steps that an input or activation keeps in its range, however little its weights say
LEAST_INPUT = 1e-3  # an input that was always zero may move one day
LEAST_RANGE = 0.05  # of an activation, against its layer's largest: one that slept in every flight may wake
RIDGES = (0.01, 0.03, 0.3)  # how strongly the fitted weights are held to the float ones, in the order of trial
GOOD_ENOUGH = 0.03  # worst error of the action on the calibration, in full scales, at which no other ridge is tried
UNITS = np.linspace(1.0, 1.4, 24)  # tried for each row, in its finest: which grid its weights fall well on is luck
FIT_SAMPLES = 8_192
LEAST_SENSITIVITY = 0.05  # of a sample, against the mean: what no action feels now it may feel elsewhere
CLIPPED = 0.1  # what the action feels, against its full gain, where it is clipped


class Inexpressible(ValueError):
    """The kernel has no form for this network."""


def quantise(policy: Policy) -> Kernel:
    """The integer policy; Inexpressible or PossibleOverflow if there is none.

    Of the few tried, the one whose worst error on the calibration is least: the worst is luck, the rest hardly differs.
    """
    _check(policy)
    best, least = None, np.inf
    for ridge in RIDGES:
        kernel = _quantised(policy, ridge)
        worst = accuracy(policy, lambda observations, k=kernel: step(k, observations)[1], policy.calibration).worst
        if best is None or worst < least:
            best, least = kernel, worst
        if least <= GOOD_ENOUGH:
            break
    assert best is not None
    return best


def _quantised(policy: Policy, ridge: float) -> Kernel:
    layers = si_layers(policy)
    clip = policy.observation_clip / policy.observation_gain
    floor, ceiling = policy.observation_offset - clip, policy.observation_offset + clip
    x_float = np.clip(policy.calibration.astype(np.float64), floor, ceiling)
    envelope = np.abs(x_float).max(axis=0)
    envelope = RANGE_MARGIN * np.where(envelope > 0.0, envelope, LEAST_INPUT)
    scale, exponent = _as_scale(_steps(envelope, layers[0][0], LEAST_LEVELS))
    step = 2.0 ** (exponent - 142) / scale
    reach = np.minimum(np.floor(envelope / step), INT16)
    least = np.clip(np.round(floor / step), -reach, 0).astype(np.int64)
    most = np.clip(np.round(ceiling / step), 0, reach).astype(np.int64)
    low, high = policy.limits
    act_lsb = (np.maximum(np.abs(low), np.abs(high)) / INT16).astype(np.float32)

    thin = slice(None, None, max(1, len(x_float) // FIT_SAMPLES))
    reaches = _reaches(layers, policy.activation, x_float)
    x_float = x_float[thin]
    felt = _sensitivities(policy, layers, x_float)
    x = np.clip(np.round(x_float / step), least, most).astype(np.int64)
    dense: list[Dense] = []
    for i, (weight, bias) in enumerate(layers):
        wanted = x_float @ weight + bias
        last = i == len(layers) - 1
        if last:
            out = act_lsb.astype(np.float64)
        elif policy.activation == "relu":
            out = _steps(reaches[i], layers[i + 1][0], LEAST_LEVELS)
        else:
            out = np.full(len(bias), TANH_RANGE / (INT16 + 1))
        dense.append(_dense(weight * step[:, None], wanted, x, felt[i], out, ridge))
        if last:
            break
        x = hidden(dense[-1], policy.activation, x)
        x_float = ACTIVATIONS[policy.activation](wanted)
        step = out if policy.activation == "relu" else np.full(len(bias), 1.0 / INT16)

    safe = np.array([port.safe for port in policy.acted], np.float32)
    act_least, act_most = (np.round(bound / act_lsb.astype(np.float64)).astype(np.int64) for bound in (low, high))
    kernel = Kernel(scale, exponent, least, most, tuple(dense), policy.activation, act_lsb, act_least, act_most, safe)
    accumulator_bound(kernel)
    return kernel


def _check(policy: Policy) -> None:
    if policy.activation not in ACTIVATIONS:
        raise Inexpressible(f"activation '{policy.activation}': the kernel knows {', '.join(ACTIVATIONS)}")
    for i, (weight, bias) in enumerate(policy.layers):
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise Inexpressible(f"layer {i}: a weight is not finite")
    if not np.isfinite(policy.calibration).all() or not len(policy.calibration):
        raise Inexpressible("no finite flight to calibrate on")


def si_layers(policy: Policy) -> list[Layer]:
    """Layers with observations and actions in SI units: normalisation, offset and action scale folded in."""
    layers = [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in policy.layers]
    weight, bias = layers[0]
    weight = weight * (policy.observation_gain * policy.observation_scale)[:, None]
    layers[0] = weight, bias - policy.observation_offset @ weight
    weight, bias = layers[-1]
    layers[-1] = weight * policy.scale, bias * policy.scale + policy.offset
    return layers


def _reaches(layers: list[Layer], activation: str, x: Floats) -> list[Floats]:
    """How far the activations [outputs] of each hidden layer must reach."""
    reaches: list[Floats] = []
    for weight, bias in layers[:-1]:
        z = x @ weight + bias
        x = ACTIVATIONS[activation](z)
        largest = np.abs(x).max(axis=0)
        reaches.append(ACTIVATION_MARGIN * np.maximum(largest, LEAST_RANGE * max(np.abs(z).max(), 1e-6)))
    return reaches


def _sensitivities(policy: Policy, layers: list[Layer], x: Floats) -> list[Floats]:
    """Squared derivatives [n, outputs] of the action, in full scales, by each layer's outputs before activation."""
    slopes: list[Floats] = []
    for weight, bias in layers[:-1]:
        z = x @ weight + bias
        x = ACTIVATIONS[policy.activation](z)
        slopes.append((z > 0).astype(np.float64) if policy.activation == "relu" else 1.0 - x**2)
    weight, bias = layers[-1]
    action = x @ weight + bias
    low, high = policy.limits
    gain = np.where((action >= low) & (action <= high), 1.0, CLIPPED) / (high - low)
    felt = [gain**2]
    by_action = [gain[:, [k]] * np.eye(len(low))[k] for k in range(len(low))]
    for (weight, _), slope in zip(layers[:0:-1], slopes[::-1], strict=True):
        by_action = [derivative @ weight.T * slope for derivative in by_action]
        felt.insert(0, sum(derivative**2 for derivative in by_action) + np.zeros_like(slope))
    return felt


def _steps(reach: Floats, weight: Floats, levels: int) -> Floats:
    """Steps [inputs] that make the rows of `weight` [inputs, outputs] alike, with `levels` or more to a reach."""
    finest = reach / INT16
    size = np.abs(weight).max(axis=1)
    size = np.maximum(size, 1e-9 * max(size.max(), 1e-30))
    return np.maximum(finest, np.minimum((finest * size).max() / size, reach / levels))


def _as_scale(step: Floats) -> tuple[Ints, Ints]:
    """`scale` in [2¹⁵, 2¹⁶) and `exponent` with 1/step ≈ scale·2^(142 − exponent), never a finer step."""
    fraction, power = np.frexp(1.0 / step)  # 1/step = fraction·2^power, fraction in [1/2, 1)
    return np.floor(fraction * 65536).astype(np.int64), (142 + 16 - power).astype(np.int64)


def _dense(weight: Floats, wanted: Floats, x: Ints, felt: Floats, out: Floats, ridge: float) -> Dense:
    """The layer whose outputs, in steps of `out`, come nearest to `wanted` [n, outputs] from inputs x [n, inputs].

    `weight` [inputs, outputs] is the float layer's for inputs in steps; `felt` [n, outputs] weighs the samples.
    """
    # A row of tiny weights keeps a coarse unit, so that its multiplier and its bias keep their precision.
    ratios = np.abs(weight).max(axis=0) / INT8 / out
    floor = np.maximum(out * max(ratios.max() / 256.0, 2.0**-20), np.abs(wanted).max(axis=0) / 2.0**28)
    x_real = x.astype(np.float64)
    rows = [_row(weight[:, o], wanted[:, o], x_real, felt[:, o], ridge, floor[o]) for o in range(len(out))]
    integers, biases, units = (np.array(column) for column in zip(*rows, strict=True))
    ratio = units / out
    shift = int(np.clip(np.floor(np.log2(32767.0 / ratio.max())) - 16, 0, 15))
    multiplier = np.maximum(np.round(ratio * 2.0 ** (16 + shift)), 1.0)
    if multiplier.max() > 32767:
        raise Inexpressible("a layer magnifies more than its 16-bit outputs can hold")
    bias = np.round(biases + 2.0 ** (15 + shift) / multiplier)
    return Dense(integers.astype(np.int64), bias.astype(np.int64), multiplier.astype(np.int64), shift)


def _row(
    weight: Floats, wanted: Floats, x: Floats, felt: Floats, ridge: float, floor: float
) -> tuple[Floats, float, float]:
    """Integers [inputs] and bias with unit·(integers·x + bias) near `wanted` [n], and that unit, at least `floor`.

    The bias takes up the mean of what is left, so all else is done about the mean.
    """
    share = felt / max(felt.mean(), 1e-30) + LEAST_SENSITIVITY
    share /= share.sum()
    mean = share @ x
    centred = x - mean
    weighted = centred * share[:, None]
    second = weighted.T @ centred
    diagonal = np.diag(second)
    second += np.diag(ridge * diagonal + 1e-5 * diagonal.mean() + 1e-12)
    middle = share @ wanted
    fitted = weight + np.linalg.solve(second, weighted.T @ (wanted - middle - centred @ weight))
    finest = max(float(np.abs(fitted).max()) / INT8, floor)
    integers = _rounded(fitted / (finest * UNITS[:, None]), second)
    error = integers * (finest * UNITS[:, None]) - fitted
    best = int(np.argmin(np.einsum("ui,ij,uj->u", error, second, error)))
    unit, integers = finest * UNITS[best], integers[best]
    return integers, (middle - mean @ (integers * unit)) / unit, unit


def _rounded(weight: Floats, second: Floats) -> Floats:
    """Integers in ±127 near each row of `weight` [n, inputs] with little error in x·weight, given x's moment."""
    order = np.argsort(-np.diag(second))
    left = weight[:, order]
    factor = np.linalg.cholesky(np.linalg.inv(second[np.ix_(order, order)])).T
    result = np.empty_like(weight)
    for i, place in enumerate(order):
        result[:, place] = np.clip(np.round(left[:, i]), -INT8, INT8)
        left[:, i + 1 :] -= np.outer((left[:, i] - result[:, place]) / factor[i, i], factor[i, i + 1 :])
    return result

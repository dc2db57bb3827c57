"""Quantization of a float policy to integers, calibrated on the policy's own flights.

Four measures keep int8 weights close to the float policy:

- the steps of inputs and activations equalize the sizes of the weights of one layer (Nagel et al. 2019, "Data-Free
  Quantization Through Weight Equalization and Bias Correction");
- each layer is fitted to the float layer's outputs, given the outputs of the quantized layers before it;
- weights are rounded one by one, and each rounding error is compensated by the remaining weights (Frantar et al. 2022,
  "GPTQ");
- all errors are weighted by the action's sensitivity to the layer's output, sample by sample (a diagonal Fisher
  information); of a recurrent unit that is the action of the same step, not of later ones.
"""

from dataclasses import astuple, replace

import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as integers
from qrl.export.accuracy import accuracy
from qrl.export.fit import Floats, UnsupportedNetwork, fitted_layer, sensitivity
from qrl.export.kernel import INT16, TANH_RANGE, Dense, Ints, Kernel, accumulator_bound, hidden
from qrl.export.policy import ACTIVATIONS, BodyFrame, GatedUnit, Layer, Policy

RANGE_MARGIN = 1.05  # range of an observation over its maximum in calibration
ACTIVATION_MARGIN = 1.2
MIN_LEVELS = 511  # steps within the range of an input or activation, however small its weights
MIN_INPUT = 1e-3  # an input that is zero throughout calibration may move later
MIN_RANGE = 0.05  # of an activation, relative to its layer's largest: a unit inactive in calibration may activate later
RIDGES = (0.01, 0.03, 0.3)  # pull of the fitted weights towards the float ones, in the order tried
GOOD_ENOUGH = 0.03  # maximum action error on the calibration, as a fraction of full scale, that ends the trials
INTEGRAL_BITS = 15  # by which the integral's unit is finer, at most, than the finest step of its input
FIT_SAMPLES = 8_192


def quantize(policy: Policy) -> Kernel:
    """The integer policy. Raises UnsupportedNetwork or AccumulatorOverflow.

    Of a few ridges, the one with the smallest maximum error on the calibration: the maximum is noisy, the RMS error
    hardly depends on the ridge.
    """
    _check(policy)
    best, smallest = None, np.inf
    for ridge in RIDGES:
        kernel = _quantized(policy, ridge)
        error = accuracy(policy, lambda inputs, k=kernel: respond(k, inputs), policy.calibration).maximum
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
    inputs, h = np.split(policy.calibration.astype(np.float64), [len(floor)], axis=-1)
    inputs = np.clip(inputs, floor, ceiling)
    x_float = policy.seen(inputs)
    measured = len(policy.observations)
    low, high = policy.limits
    act_lsb = (np.maximum(np.abs(low), np.abs(high)) / INT16).astype(np.float32)
    act_min, act_max = (np.round(bound / act_lsb.astype(np.float64)).astype(np.int64) for bound in (low, high))
    ranges = _ranges(inputs[:, :measured], policy.body_frame)
    wanted, obs_shift, remembered_shift, steps = _input_steps(policy, layers[0][0], x_float, ranges, act_lsb)
    scale, exponent = _as_scale(steps)
    lsb = 2.0 ** (exponent - 142) / scale
    most = np.minimum(np.floor(ranges / lsb), INT16)
    first_step, turn = lsb * 2.0**obs_shift, None
    last_step = _memory_lsb(policy, act_lsb) * 2.0**remembered_shift
    if frame := policy.body_frame:
        turn, first_step = _turn(frame, lsb, wanted)
        if frame.last:
            last_step = np.concatenate([last_step[: -frame.last], np.full(3, 2.0**16 * lsb[0] * last_step[-1])])
    step = np.concatenate([first_step, last_step])
    kernel = Kernel(
        scale=scale,
        exponent=exponent,
        obs_min=np.clip(np.round(floor[:measured] / lsb), -most, most).astype(np.int64),
        obs_max=np.clip(np.round(ceiling[:measured] / lsb), -most, most).astype(np.int64),
        layers=(),
        activation=policy.activation,
        act_lsb=act_lsb,
        act_min=act_min,
        act_max=act_max,
        act_safe=np.array([action.safe for action in policy.actions], np.float32),
        obs_shift=obs_shift,
        turn=turn,
    )
    if policy.memory:
        kernel = replace(kernel, memory=_memory(policy, kernel, remembered_shift, floor[measured:], ceiling[measured:]))

    subset = slice(None, None, max(1, len(x_float) // FIT_SAMPLES))
    activation_ranges = _activation_ranges(layers, policy.activation, x_float)
    x_float, h = x_float[subset], h[subset]
    slopes, of_unit = sensitivity(policy, layers, x_float, h)
    x = np.clip(np.round(x_float / step), *kernel.input_limits).astype(np.int64)
    dense: list[Dense] = []
    for i, (weight, bias) in enumerate(layers):
        last = i == len(layers) - 1
        if last and policy.unit:
            unit, x = _gated_unit(policy.unit, x_float, h, x, step, of_unit, ridge)
            kernel = replace(kernel, unit=unit)
            x_float, step = policy.unit(x_float, h), np.full(unit.units, 1.0 / INT16)
        target = x_float @ weight + bias
        if last:
            out = act_lsb.astype(np.float64)
        elif policy.activation == "relu":
            out = _steps(activation_ranges[i], _following(policy, layers, i), MIN_LEVELS)
        else:
            out = np.full(len(bias), TANH_RANGE / (INT16 + 1))
        dense.append(fitted_layer(weight * step[:, None], target, x, slopes[i], out, ridge))
        if last:
            break
        x = hidden(dense[-1], policy.activation, x)
        x_float = ACTIVATIONS[policy.activation](target)
        step = out if policy.activation == "relu" else np.full(len(bias), 1.0 / INT16)

    kernel = replace(kernel, layers=tuple(dense))
    accumulator_bound(kernel)
    return kernel


def _following(policy: Policy, layers: list[Layer], i: int) -> Floats:
    """The weights [outputs of hidden layer i, n] of what comes after it."""
    return policy.unit.of_input[0] if policy.unit and i == len(layers) - 2 else layers[i + 1][0]


def _gated_unit(
    unit: GatedUnit, x_float: Floats, h_float: Floats, x: Ints, step: Floats, of_sums: list[Floats], ridge: float
) -> tuple[integers.GatedUnit, Ints]:
    """The recurrent unit in integers, and its next h [n, H]; for its inputs in float, and x [n, D] in `step`."""
    h, units = np.round(h_float * INT16).astype(np.int64), h_float.shape[1]
    weight, own = unit.of_input[0], unit.of_memory[0]
    i, m = unit.sums(x_float, h_float)
    gates, candidate = slice(0, 2 * units), slice(2 * units, None)
    # The candidate's sums are added up after they were saturated, the memory's scaled by r: they need more than the
    # tanh's range.
    largest = ACTIVATION_MARGIN * max(np.abs(part[:, candidate]).max() for part in (i, m)) / TANH_RANGE
    shift = int(np.clip(np.ceil(np.log2(max(largest, 1e-9))), 0, 8))
    # h in steps as coarse as make its weights as large as those of x, which share a scale.
    size = np.abs(weight[:, gates] * step[:, None]).max() / max(np.abs(own[:, gates]).max(), 1e-9) * INT16
    memory_shift = int(np.clip(np.round(np.log2(max(size, 1e-9))), 0, np.floor(np.log2(INT16 / MIN_LEVELS))))
    out, lsb, g = TANH_RANGE / (INT16 + 1), np.full(units, 2.0**memory_shift / INT16), integers.shifted(h, memory_shift)
    of_gates, of_input, of_memory = (
        fitted_layer(weight * lsb[:, None], target, q, slope, np.full(target.shape[1], out), ridge)
        for weight, target, lsb, q, slope, out in (
            (
                np.concatenate([weight, own])[:, gates],
                (i + m)[:, gates],
                np.concatenate([step, lsb]),
                np.concatenate([x, g], axis=1),
                of_sums[0][:, gates],
                2.0 * out,  # a gate is a tanh of half of its sum
            ),
            (weight[:, candidate], i[:, candidate], step, x, of_sums[0][:, candidate], out * 2.0**shift),
            (own[:, candidate], m[:, candidate], lsb, g, of_sums[1][:, candidate], out * 2.0**shift),
        )
    )
    made = integers.GatedUnit(of_gates, of_input, of_memory, shift, memory_shift)
    return made, integers.remember(made, x, h)


def _input_steps(
    policy: Policy, weight: Floats, x_float: Floats, ranges: Floats, act_lsb: NDArray[np.float32]
) -> tuple[Floats, Ints, Ints, Floats]:
    """The steps wanted of the network's inputs, the shifts of the observations [F] and of the memory's inputs [M] to
    them, and the steps [F] of the observations; `ranges` [F], and `x_float` [n, inputs] in SI units.

    What is integrated, remembered or rotated has the finest step; a coarser one of the network's input is a shift.
    """
    remembered = _memory_lsb(policy, act_lsb) * INT16
    finest, measured, frame = ranges / INT16, len(ranges), policy.body_frame
    if frame is None:
        wanted = _steps(np.concatenate([ranges, remembered]), weight, MIN_LEVELS)
        shift = _shift(wanted, np.concatenate([finest, remembered / INT16]))
        integral = policy.memory and policy.memory.integral
        integrated = np.isin(np.arange(measured), integral.position if integral else ())
        steps = np.where(integrated, finest, wanted[:measured])
        return wanted, np.where(integrated, shift[:measured], 0), shift[measured:], steps
    seen = _ranges(x_float[:, : frame.size], None)
    wanted = _steps(np.concatenate([seen, remembered, np.repeat(remembered[-1:], frame.added)]), weight, MIN_LEVELS)
    own = wanted[frame.size : frame.size + len(remembered)].copy()
    if frame.last:
        own[-frame.last :] = wanted[-3:].min()
    rates = slice(frame.size - 3 * frame.vectors - 3, frame.size - 3 * frame.vectors)
    steps = np.concatenate([finest[:15], wanted[rates], finest[18:]])
    return wanted, np.zeros(measured, np.int64), _shift(own, remembered / INT16), steps


def _shift(wanted: Floats, finest: Floats) -> Ints:
    return np.floor(np.log2(wanted / finest) + 1e-9).astype(np.int64)


def _ranges(x: Floats, frame: BodyFrame | None) -> Floats:
    """Range of each observation [n, F]; with a `frame`, of a vehicle's rotation and of each vector's axes alike."""
    largest = np.abs(x).max(axis=0)
    if frame:
        for part in (slice(0, 9), slice(9, 12), slice(12, 15), slice(18, None)):
            largest[part] = largest[part].max(initial=0.0)
    return RANGE_MARGIN * np.where(largest > 0.0, largest, MIN_INPUT)


def _turn(frame: BodyFrame, lsb: Floats, wanted: Floats) -> tuple[integers.Turn, Floats]:
    """The shifts into the body frame, and the steps of the network's first inputs, at most those wanted where the
    products allow it.
    """
    axes = 3 + 3 * frame.heading
    ahead = slice(axes + 9, frame.size)
    groups = [wanted[:axes], wanted[axes : axes + 3], wanted[axes + 3 : axes + 6], wanted[ahead]]
    finest = [lsb[6], *(2.0 * lsb[0] * lsb[at] for at in (9, 12, 18 if frame.vectors else 12))]
    shifts, steps = [], []
    for group, fine, (least, most) in zip(groups, finest, [(0, 15), *[(14, 29)] * 3], strict=True):
        shifts.append(int(np.clip(np.floor(np.log2(group.min(initial=1e30) / fine)), least, most)))
        steps.append(np.full(len(group), fine * 2.0 ** shifts[-1]))
    turn = integers.Turn(frame.heading, frame.vectors, frame.last, *shifts)
    return turn, np.concatenate([*steps[:3], lsb[15:18], steps[3]])


def respond(kernel: Kernel, x: NDArray[np.floating]) -> NDArray[np.float32]:
    """Actions [n, A] of the kernel for the network's inputs [n, I] in SI units."""
    measured = len(kernel.scale)
    unclipped, _ = integers.quantized(kernel, x[:, :measured].astype(np.float32))
    saturated = np.clip(unclipped, kernel.obs_min, kernel.obs_max)
    q = integers.measured(kernel, saturated)
    h = None
    if kernel.memory:
        kept, h = np.split(x[:, measured:], [len(kernel.memory.shift)], axis=-1)
        kept, h = np.round(kept / kernel.memory_steps), np.round(h * INT16).astype(np.int64)
        kept = np.clip(kept, kernel.memory.low, kernel.memory.high).astype(np.int64)
        q = np.concatenate([q, integers.remembered(kernel, kept, saturated)], axis=-1)
    return integers.network(kernel, q, h)[1].astype(np.float32) * kernel.act_lsb


def _memory_lsb(policy: Policy, act_lsb: NDArray[np.float32]) -> Floats:
    """The finest steps [M] of the memory's inputs: an action's own, and limit / 32767 of the integral."""
    memory = policy.memory
    if memory is None:
        return np.zeros(0)
    action = act_lsb.astype(np.float64) if memory.previous_action else np.zeros(0)
    integral = np.full(memory.integral.size, memory.integral.limit_m_s / INT16) if memory.integral else []
    return np.concatenate([action, integral])


def _memory(policy: Policy, kernel: Kernel, shift: Ints, floor: Floats, ceiling: Floats) -> integers.Memory:
    """The memory's integers. Its inputs have steps of the finest·2^shift and are clipped at floor and ceiling; [M]."""
    assert policy.memory
    actions = len(kernel.act_lsb) if policy.memory.previous_action else 0
    integral, bits = _integral(policy, kernel.lsb) if policy.memory.integral else (None, 0)
    full = np.full(len(shift) - actions, INT16)
    low = integers.shifted(np.concatenate([kernel.act_min[:actions], -full]), shift)
    high = integers.shifted(np.concatenate([kernel.act_max[:actions], full]), shift)
    step = _memory_lsb(policy, kernel.act_lsb) * 2.0**shift
    first = np.round(policy.to_si(np.zeros(len(kernel.act_lsb))) / kernel.act_lsb.astype(np.float64))
    return integers.Memory(
        initial_action=np.clip(first, kernel.act_min, kernel.act_max).astype(np.int64) if actions else None,
        integral=integral,
        shift=shift + np.where(np.arange(len(shift)) < actions, 0, bits),
        low=np.clip(np.round(floor / step), low, high).astype(np.int64),
        high=np.clip(np.round(ceiling / step), low, high).astype(np.int64),
        units=policy.memory.units,
    )


def _integral(policy: Policy, lsb: Floats) -> tuple[integers.Integral, int]:
    """The integral in integers, and by how many bits its unit is finer than limit / 32767."""
    assert policy.memory
    assert policy.memory.integral
    position, radius, limit, circle_m = astuple(policy.memory.integral)
    if not (0.0 < radius < np.inf and 0.0 < limit < np.inf):
        raise UnsupportedNetwork(f"an integral within {radius:g} m and {limit:g} m s: expected finite limits above 0")
    steps, circle = lsb[list(position)], None
    if circle_m is not None:
        circle = integers.Circle(*_as_factor(steps[:2] / (2.0 * circle_m) * 2.0**15))
        steps = np.array([circle_m / 2.0**14, steps[2], *[circle_m / 2.0**14] * 2])
    increment = policy.control_period_s * steps / (limit / INT16)  # at one step of the position, ungated
    bits = int(np.clip(np.ceil(13.0 - np.log2(increment.max())) - 1.0, 0, INTEGRAL_BITS))
    if increment.max() >= 2.0**13 or increment.min() * 2.0**bits < 1.0:
        raise UnsupportedNetwork(f"an integral within {limit:g} m s: expected a limit nearer to position and period")
    gain, gain_shift = _as_factor(2.0 * increment * 2.0**bits)
    inverse_radius, radius_shift = _as_factor(steps / radius * 2.0**15)
    if circle_m is not None and 1.5 * circle_m < radius:  # beyond two radii along an axis the error saturates
        raise UnsupportedNetwork(
            f"an integral within {radius:g} m of a circle of {circle_m:g} m: expected at most {1.5 * circle_m:g} m"
        )
    if radius_shift.min() < 1 or radius_shift.max() > 29:
        raise UnsupportedNetwork(f"an integral within {radius:g} m: expected a radius nearer to the range of positions")
    unit = limit / INT16 / 2.0**bits
    return (
        integers.Integral(
            position=position,
            inverse_radius=inverse_radius,
            inverse_radius_shift=radius_shift,
            gain=gain,
            gain_shift=gain_shift,
            limit=INT16 << bits,
            unit_m_s=unit,
            circle=circle,
        ),
        bits,
    )


def _as_factor(value: Floats) -> tuple[Ints, Ints]:
    """Factor in [2¹⁴, 2¹⁵) and shift with value ≈ factor / 2^shift."""
    fraction, power = np.frexp(value)
    return np.minimum(np.round(fraction * 2**15), INT16).astype(np.int64), (15 - power).astype(np.int64)


def _check(policy: Policy) -> None:
    if policy.activation not in ACTIVATIONS:
        raise UnsupportedNetwork(f"activation '{policy.activation}': expected one of {', '.join(ACTIVATIONS)}")
    for i, (weight, bias) in enumerate(policy.layers):
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise UnsupportedNetwork(f"layer {i}: a weight is not finite")
    if policy.memory and not policy.memory_size:
        raise UnsupportedNetwork("a memory that holds nothing")
    units = policy.memory.units if policy.memory else 0
    if units != (policy.unit.of_memory[0].shape[0] if policy.unit else 0) or (units and len(policy.layers) < 2):
        raise UnsupportedNetwork("a recurrent unit: expected a hidden layer before it, and its numbers in the memory")
    if policy.unit:
        layers = policy.unit.of_input, policy.unit.of_memory
        if not all(np.isfinite(x).all() for layer in layers for x in layer):
            raise UnsupportedNetwork("the recurrent unit: a weight is not finite")
    expected = len(policy.observations) + policy.memory_size - units
    if frame := policy.body_frame:
        expected = frame.size + policy.memory_size - units + frame.added
        if len(policy.observations) != frame.measured or np.any(policy.observation_offset[: frame.measured]):
            raise UnsupportedNetwork(
                f"the body frame: expected {frame.measured} observations of a vehicle, not standardized"
            )
    if len(policy.layers[0][0]) != expected:
        raise UnsupportedNetwork(f"layer 0: expected {expected} inputs, found {len(policy.layers[0][0])}")
    if not np.isfinite(policy.calibration).all() or not len(policy.calibration):
        raise UnsupportedNetwork("no finite flight to calibrate on")


def si_layers(policy: Policy) -> list[Layer]:
    """Layers with observations and actions in SI units: normalization, offset and action scale folded in."""
    layers = [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in policy.layers]
    weight, bias = layers[0]
    weight = weight * policy.input_gain[:, None]
    offset = policy.observation_offset
    if policy.body_frame:
        offset = policy.body_frame.ordered(offset)
    layers[0] = weight, bias - offset @ weight
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

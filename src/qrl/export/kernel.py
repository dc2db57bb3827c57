"""The integer policy and its arithmetic in NumPy: the reference for the emitted C."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

INT16 = 32767
MOST_ERROR = 57344  # of a position on a circle, in steps: above every E, and its product with an open gate is below 2³¹
TANH_RANGE = 6.0  # the table covers [−6, 6], in 256 intervals; tanh(6) = 1 − 1.2e-5


@dataclass(frozen=True, eq=False)
class Dense:
    """y = saturate(⌊(weight·x + bias)·multiplier / 2^(16 + shift)⌋); the bias includes the rounding half."""

    weight: Ints  # [outputs, inputs], int8
    bias: Ints  # [outputs], int32
    multiplier: Ints  # [outputs], in [0, 2¹⁵)
    shift: int  # in [0, 15]


@dataclass(frozen=True, eq=False)
class Circle:
    """The position's error on a circle about z, e = [E, z, ⌊E·q_x / 2¹⁴⌉, ⌊E·q_y / 2¹⁴⌉], the last two within ±57344:
    E = ⌊(q_x² + q_y² − 2²⁸) / 2¹⁵⌉ in steps of circle_m/2¹⁴. The gate is that of E and z.

    q_i = ⌊p_i·factor_i / 2^shift_i⌉ within ±32767: x and y, in steps of the observation's lsb, over the circle's
    diameter in 1/2¹⁵.
    """

    factor: Ints  # [2] in [2¹⁴, 2¹⁵)
    shift: Ints  # [2] in [1, 30]


@dataclass(frozen=True, eq=False)
class Integral:
    """I += ⌊e·gate·gain / 2^(16 + gain_shift)⌉ per component, within ±limit, in units of `unit_m_s`.

    e [k]: the error in steps: of the observation's lsb, or of `Circle`. With v = ⌊e·inverse_radius /
    2^inverse_radius_shift⌉, which is e/radius in 1/2¹⁵, and w = max(0, 2³⁰ − |v|²) / 2¹⁵, gate = w² / 2¹⁵, both rounded
    down. ⌊⌉: half is rounded up.
    """

    position: tuple[int, ...]  # indices into the observation
    inverse_radius: Ints  # [k] in [2¹⁴, 2¹⁵)
    inverse_radius_shift: Ints  # [k] in [1, 29]
    gain: Ints  # [k] in [0, 2¹⁵)
    gain_shift: Ints  # [k] in [1, 30]
    limit: int  # below 2³⁰
    unit_m_s: float
    circle: Circle | None = None

    @property
    def size(self) -> int:
        """k, the number of components."""
        return len(self.gain)


@dataclass(frozen=True, eq=False)
class Memory:
    """The network's inputs [M] after the observation, from the state: the previous action, then the integral. After
    these the state has the numbers [H] of a recurrent network.

    An input is ⌊value / 2^shift⌉ of the state's integer, saturated at low and high.
    """

    initial_action: Ints | None  # [A] after a reset, in steps of act_lsb; None: the previous action is no input
    integral: Integral | None
    shift: Ints  # [M] in [0, 30]
    low: Ints  # [M]
    high: Ints  # [M]
    units: int = 0  # H

    @property
    def actions(self) -> int:
        """How many numbers of the state are a previous action."""
        return 0 if self.initial_action is None else len(self.initial_action)


@dataclass(frozen=True, eq=False)
class GatedUnit:
    """A gated recurrent unit (`policy.GatedUnit`) of inputs x and h, in 1/32767.

    With g = ⌊h / 2^memory_shift⌉, r and z are (t + 32768) >> 1, t the tanh of half of the gate's sum; n is the tanh of
    (i + ⌊r·m / 2¹⁵⌉)·2^shift; the next h is n + ⌊(h − n)·z / 2¹⁵⌉. The arguments of tanh are saturated, and so are i
    and m, which the shift keeps within 16 bits.
    """

    gates: Dense  # half of the sums of r and z, of x and g
    of_input: Dense  # i, of x
    of_memory: Dense  # m, of g
    shift: int  # in [0, 8]
    memory_shift: int  # in [0, 8]

    @property
    def units(self) -> int:
        """H."""
        return self.of_memory.weight.shape[1]


@dataclass(frozen=True, eq=False)
class Turn:
    """The first inputs of a network in the body frame, of a vehicle's measurements x: ⌊x_i / 2^up⌉ of the first row of
    the rotation matrix, if `heading`, and of the third; ⌊Σ_i ⌊r_ij·p_i / 2⌋ / 2^position⌉ of the position, likewise of
    the velocity, each within ±32767; the body rates; likewise the vectors that follow, by 2^ahead. At the end
    ⌊Σ_i ⌊r_ij·I_i / 2⌋ / 2¹⁵⌉ for the last inputs I, where these are a vector.
    """

    heading: bool
    vectors: int  # how many follow the 18 measurements
    last: int  # numbers of the vector at the end: 3, or 2 of a horizontal one; 0: there is none
    up: int  # in [0, 15]
    position: int  # in [14, 29]
    velocity: int  # in [14, 29]
    ahead: int  # in [14, 29]


@dataclass(frozen=True, eq=False)
class Kernel:
    """Observation i is x_i·lsb_i with 1/lsb_i = scale_i·2^(142 − exponent_i); action j is y_j·act_lsb_j.

    The network's input i is ⌊x_i / 2^obs_shift_i⌉: a position that is integrated has finer steps than its input.
    """

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
    obs_shift: Ints  # [F] in [0, 15]; 0 but for a position that is integrated
    memory: Memory | None = None
    turn: Turn | None = None  # None: the network is given the observation as it is
    unit: GatedUnit | None = None  # before the last layer

    @property
    def lsb(self) -> NDArray[np.float64]:
        """The step of each observation, in its unit; [F]."""
        return 2.0 ** (self.exponent - 142) / self.scale

    @property
    def memory_steps(self) -> NDArray[np.float64]:
        """The step of each of the memory's inputs, in N or m·s; [M]."""
        parts = [np.zeros(0)]
        if self.memory is None:
            return parts[0]
        if self.memory.initial_action is not None:
            parts.append(self.act_lsb.astype(np.float64))
        if self.memory.integral:
            parts.append(np.full(self.memory.integral.size, self.memory.integral.unit_m_s))
        return np.concatenate(parts) * 2.0**self.memory.shift

    @property
    def input_limits(self) -> tuple[Ints, Ints]:
        """Smallest and largest of each of the network's inputs."""
        low, high = (shifted(limit, self.obs_shift) for limit in (self.obs_min, self.obs_max))
        if turn := self.turn:
            full, more = np.full(6, INT16), np.full(3 * turn.vectors, INT16)
            axes = [slice(0, 3 * turn.heading), slice(6, 9)]
            low = np.concatenate([*(shifted(low[a], turn.up) for a in axes), -full, low[15:18], -more])
            high = np.concatenate([*(shifted(high[a], turn.up) for a in axes), full, high[15:18], more])
        if self.memory is None:
            return low, high
        low, high = np.concatenate([low, self.memory.low]), np.concatenate([high, self.memory.high])
        if self.turn and (last := self.turn.last):
            full = np.full(3, INT16)
            low, high = np.concatenate([low[:-last], -full]), np.concatenate([high[:-last], full])
        return low, high

    @property
    def widths(self) -> list[int]:
        """Numbers of the network's inputs, of each hidden layer's units, a recurrent one's too, and of actions."""
        hidden = [len(layer.bias) for layer in self.layers[:-1]] + ([self.unit.units] if self.unit else [])
        return [self.layers[0].weight.shape[1], *hidden, len(self.layers[-1].bias)]

    @property
    def products(self) -> list[Dense]:
        """All layers in their order; a recurrent one is three."""
        unit = [self.unit.gates, self.unit.of_input, self.unit.of_memory] if self.unit else []
        return [*self.layers[:-1], *unit, self.layers[-1]]


class AccumulatorOverflow(ArithmeticError):
    """An accumulator or a field of the kernel could exceed its type in C."""


def accumulator_bound(kernel: Kernel) -> int:
    """Upper bound of |accumulator| over all observations and states; AccumulatorOverflow if it is 2³¹ or more."""
    _check_fields(kernel)
    low, high = kernel.input_limits
    largest, size = 0, np.maximum(np.abs(low), np.abs(high))

    def bound(name: str, layer: Dense, size: Ints) -> None:
        nonlocal largest
        bounds = np.abs(layer.weight) @ size + np.abs(layer.bias)
        row = int(np.argmax(bounds))
        if bounds[row] >= 2**31:
            raise AccumulatorOverflow(f"{name}, output {row}: the accumulator can reach {bounds[row]:,} > 2^31")
        largest = max(largest, int(bounds[row]))

    for i, layer in enumerate(kernel.layers):
        if kernel.unit and i == len(kernel.layers) - 1:
            h = np.full(kernel.unit.units, INT16 + 1)
            g = shifted(h, kernel.unit.memory_shift)
            bound("the recurrent unit's gates", kernel.unit.gates, np.concatenate([size, g]))
            bound("the recurrent unit's inputs", kernel.unit.of_input, size)
            bound("the recurrent unit's memory", kernel.unit.of_memory, g)
            size = h
        bound(f"layer {i}", layer, size)
        size = np.full(len(layer.bias), INT16 + 1)
    return largest


def _check_fields(kernel: Kernel) -> None:
    ranges: list[tuple[str, Ints, Ints | int, Ints | int]] = [
        ("an input's scale", kernel.scale, 2**15, 2**16 - 1),
        ("an input's exponent", kernel.exponent, -(2**15), INT16),
        ("an input's range", kernel.obs_min, -INT16, kernel.obs_max),
        ("an input's range", kernel.obs_max, kernel.obs_min, INT16),
        ("an input's shift", kernel.obs_shift, 0, 15),
        ("an action's range", np.concatenate([kernel.act_min, kernel.act_max]), -INT16, INT16),
    ]
    if turn := kernel.turn:
        ranges += [
            ("an input's shift", np.array(turn.up), 0, 15),
            ("an input's shift", np.array([turn.position, turn.velocity, turn.ahead]), 14, 29),
        ]
    if memory := kernel.memory:
        ranges += [
            ("an input's shift", memory.shift, 0, 30),
            ("an input's range", np.concatenate([memory.low, memory.high]), -INT16, INT16),
        ]
        if memory.initial_action is not None:
            ranges.append(("the first action", memory.initial_action, kernel.act_min, kernel.act_max))
        if integral := memory.integral:
            ranges += [
                ("the integral's radius", integral.inverse_radius, 2**14, INT16),
                ("the integral's radius", integral.inverse_radius_shift, 1, 29),
                ("the integral's gain", integral.gain, 0, INT16),
                ("the integral's gain", integral.gain_shift, 1, 30),
                ("the integral's limit", np.array(integral.limit), 1, 2**30 - 1),
            ]
            if circle := integral.circle:
                ranges += [
                    ("the circle's radius", circle.factor, 2**14, INT16),
                    ("the circle's radius", circle.shift, 1, 30),
                ]
    if kernel.unit:
        ranges.append(("the recurrent unit's shift", np.array([kernel.unit.shift, kernel.unit.memory_shift]), 0, 8))
    for layer in kernel.products:
        ranges += [
            ("a weight", layer.weight, -127, 127),
            ("a bias", layer.bias, -(2**31) + 1, 2**31 - 1),
            ("a multiplier", layer.multiplier, 0, INT16),
            ("a shift", np.array(layer.shift), 0, 15),
        ]
    for name, values, low, high in ranges:
        if np.any(values < low) or np.any(values > high):
            raise AccumulatorOverflow(f"{name} is outside [{low}, {high}]")


@cache
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


def network(kernel: Kernel, x: Ints, h: Ints | None = None) -> tuple[Ints, Ints]:
    """Next h [n, H], of a feed-forward network [n, 0], and actions [n, A] in steps of act_lsb, for the network's inputs
    x and h.
    """
    h = np.zeros((len(x), 0), np.int64) if h is None else h
    for layer in kernel.layers[:-1]:
        x = hidden(layer, kernel.activation, x)
    if kernel.unit:
        x = h = remember(kernel.unit, x, h)
    return h, np.clip(dense(kernel.layers[-1], x, -INT16 - 1), kernel.act_min, kernel.act_max)


def remember(unit: GatedUnit, x: Ints, h: Ints) -> Ints:
    """The next h [n, H] for inputs x [n, D] and h."""
    low, g = -INT16 - 1, shifted(h, unit.memory_shift)
    r, z = np.split(_tanh(dense(unit.gates, np.concatenate([x, g], axis=-1), low)) + INT16 + 1 >> 1, 2, axis=-1)
    total = dense(unit.of_input, x, low) + shifted(r * dense(unit.of_memory, g, low), 15)
    n = _tanh(np.clip(total << unit.shift, low, INT16))
    return n + shifted((h - n) * z, 15)


def _tanh(z: Ints) -> Ints:
    table, (at, part) = tanh_table(), np.divmod(z + INT16 + 1, 256)
    return table[at] + ((table[at + 1] - table[at]) * part + 128 >> 8)


def shifted(x: Ints, shift: Ints | int) -> Ints:
    """x / 2^shift, rounded; half is rounded up."""
    return x + (1 << np.asarray(shift) >> 1) >> shift


def initial_state(kernel: Kernel, n: int) -> Ints:
    """State [n, S] after a reset: the previous action [A], if it is an input, then the integral [k], if there is one,
    then h [H] of a recurrent policy.

    A policy without memory has no columns.
    """
    if kernel.memory is None:
        return np.zeros((n, 0), np.int64)
    first, integral = kernel.memory.initial_action, kernel.memory.integral
    axes = integral.size if integral else 0
    parts = [np.zeros(0, np.int64) if first is None else first, np.zeros(axes + kernel.memory.units, np.int64)]
    return np.tile(np.concatenate(parts), (n, 1))


def integrated(integral: Integral, total: Ints, position: Ints) -> Ints:
    """The next integral [n, k] for positions [n, 3] in steps."""
    error = position
    if circle := integral.circle:
        q = np.clip(shifted(position[:, :2] * circle.factor, circle.shift), -INT16, INT16)
        along = shifted((q * q).sum(axis=-1) - 2**28, 15)
        moved = np.clip(shifted(along[:, None] * q, 14), -MOST_ERROR, MOST_ERROR)
        error = np.concatenate([along[:, None], position[:, 2:], moved], axis=-1)
    gating = slice(0, 2 if integral.circle else None)
    v = shifted(error * integral.inverse_radius, integral.inverse_radius_shift)[:, gating]
    w = np.maximum(2**30 - np.minimum(v * v, 2**30).sum(axis=-1, keepdims=True), 0) >> 15
    gate = w * w >> 15
    more = shifted(error * gate * integral.gain >> 16, integral.gain_shift)
    return np.clip(total + more, -integral.limit, integral.limit)


def measured(kernel: Kernel, x: Ints) -> Ints:
    """The network's first inputs, for saturated observations x [n, F]."""
    turn = kernel.turn
    if turn is None:
        return shifted(x, kernel.obs_shift)
    rotation = x[:, :9].reshape(-1, 3, 3)

    def rotated(at: int, shift: int) -> Ints:
        vector = x[:, at : at + 3, None]
        return np.clip(shifted((rotation * vector >> 1).sum(axis=1), shift), -INT16, INT16)

    axes = [shifted(x[:, : 3 * turn.heading], turn.up), shifted(x[:, 6:9], turn.up)]
    vectors = [rotated(at, turn.ahead) for at in range(18, 18 + 3 * turn.vectors, 3)]
    return np.concatenate(
        [*axes, rotated(9, turn.position), rotated(12, turn.velocity), x[:, 15:18], *vectors], axis=-1
    )


def inputs(kernel: Kernel, state: Ints, x: Ints) -> Ints:
    """The network's inputs for the state [n, S] and saturated observations x [n, F]."""
    first = measured(kernel, x)
    if kernel.memory is None:
        return first
    kept = state[:, : len(kernel.memory.shift)]
    kept = np.clip(shifted(kept, kernel.memory.shift), kernel.memory.low, kernel.memory.high)
    return np.concatenate([first, remembered(kernel, kept, x)], axis=-1)


def remembered(kernel: Kernel, kept: Ints, x: Ints) -> Ints:
    """The network's last inputs, for those of the memory [n, M] and saturated observations x [n, F]."""
    if kernel.turn is None or not (last := kernel.turn.last):
        return kept
    rotation = x[:, : 3 * last].reshape(-1, last, 3)
    vector = np.clip(shifted((rotation * kept[:, -last:, None] >> 1).sum(axis=1), 15), -INT16, INT16)
    return np.concatenate([kept[:, :-last], vector], axis=-1)


def _act(kernel: Kernel, state: Ints, x: Ints) -> tuple[Ints, Ints]:
    """Next state and action [n, A] in steps of act_lsb, for saturated observations x [n, F]."""
    if (memory := kernel.memory) is None:
        return state, network(kernel, inputs(kernel, state, x))[1]
    previous, total, h = np.split(state, [memory.actions, len(memory.shift)], axis=-1)
    if memory.integral:
        total = integrated(memory.integral, total, x[:, list(memory.integral.position)])
    h, action = network(kernel, inputs(kernel, np.concatenate([previous, total], axis=-1), x), h)
    return np.concatenate([action[:, : memory.actions], total, h], axis=-1), action


def step_i16(kernel: Kernel, state: Ints, observation: NDArray[np.int16]) -> tuple[Ints, Ints, NDArray[np.int16]]:
    """Next state [n, S], status [n] and action [n, A] for observations [n, F], in steps of the lsb: NAME_step_i16."""
    unclipped = observation.astype(np.int64)
    x = np.clip(unclipped, kernel.obs_min, kernel.obs_max)
    state, action = _act(kernel, state, x)
    return state, np.any(x != unclipped, axis=-1).astype(np.int64), action.astype(np.int16)


def step(kernel: Kernel, state: Ints, observation: NDArray[np.float32]) -> tuple[Ints, Ints, NDArray[np.float32]]:
    """Next state [n, S], status [n] and action [n, A] for observations [n, F], in SI units: NAME_step."""
    unclipped, finite = quantized(kernel, observation)
    x = np.clip(unclipped, kernel.obs_min, kernel.obs_max)
    after, action = _act(kernel, state, x)
    status = np.where(finite, np.any(x != unclipped, axis=-1), 2)
    finite = finite[:, None]
    return (
        np.where(finite, after, state),
        status,
        np.where(finite, action.astype(np.float32) * kernel.act_lsb, kernel.act_safe),
    )

"""The NumPy reference against the arithmetic that it documents, written out in Python's own integers and fractions."""

import math
import struct
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import policies
from literal_network import limited, literal_network
from policies import FLAT, HOVER, ODD, PENDULUM
from qrl.export import kernel as reference
from qrl.export import vectors
from qrl.export.kernel import INT16, AccumulatorOverflow, Dense, Kernel, accumulator_bound

SHAPES = pytest.mark.parametrize("sizes", [HOVER, PENDULUM, ODD, FLAT], ids=str)
ACTIVATIONS = pytest.mark.parametrize("activation", ["relu", "tanh"])


def bits_of(real: float) -> int:
    return struct.unpack("<I", struct.pack("<f", real))[0]


def literal_inputs(kernel: Kernel, observation: list[int]) -> list[int] | None:
    """Steps before saturation of floats given by their bits; None where one of them is not finite."""
    found = []
    for i, bits in enumerate(observation):
        exponent, fraction = bits // 2**23 % 2**8, bits % 2**23
        if exponent == 255:
            return None
        leading = (fraction + (2**23 if exponent else 0)) // 2**8  # 16 bits of the significand
        power = max(exponent, 1) - int(kernel.exponent[i])
        steps = leading * int(kernel.scale[i]) * Fraction(2) ** power
        rounded = math.floor(steps + Fraction(1, 2))  # half away from zero: of the size
        found.append(-rounded if bits >= 2**31 else rounded)
    return found


def literal(kernel: Kernel, wanted: list[int]) -> tuple[int, list[int]]:
    """Status and action in steps."""
    limits = zip(wanted, kernel.obs_min, kernel.obs_max, strict=True)
    x = [limited(q, int(low), int(high)) for q, low, high in limits]
    return int(x != wanted), literal_network(kernel, x, [])[1]


def some(sizes: tuple[int, ...], activation: str, n: int, seed: int = 1) -> np.ndarray:
    """Float vectors of every kind: every n-th of many, and one with an infinity in its last place."""
    many = vectors.observations(policies.policy(sizes, activation), policies.kernel(sizes, activation), 1000, seed)
    infinite = many[:1].copy()
    infinite[0, -1] = -np.inf
    return np.concatenate([many[:: 1000 // n], infinite])


@SHAPES
@ACTIVATIONS
def test_the_float_entry_is_the_literal_arithmetic(sizes: tuple[int, ...], activation: str) -> None:
    kernel, observations = policies.kernel(sizes, activation), some(sizes, activation, 40)
    status, action = policies.step(kernel, observations)
    for i, row in enumerate(observations.view(np.uint32).tolist()):
        wanted = literal_inputs(kernel, row)
        if wanted is None:
            assert status[i] == 2
            assert action[i].view(np.uint32).tolist() == [bits_of(float(safe)) for safe in kernel.act_safe]
            continue
        says, steps = literal(kernel, wanted)
        assert status[i] == says
        # A 16-bit integer times a float is exact in double: rounded once.
        found = [bits_of(y * float(lsb)) for y, lsb in zip(steps, kernel.act_lsb, strict=True)]
        assert action[i].view(np.uint32).tolist() == found
    assert set(status) == {0, 1, 2}


@SHAPES
@ACTIVATIONS
def test_the_fixed_point_entry_is_the_literal_arithmetic(sizes: tuple[int, ...], activation: str) -> None:
    kernel = policies.kernel(sizes, activation)
    observations = vectors.observations_i16(policies.policy(sizes, activation), kernel, 1000, 1)[::25]
    status, action = policies.step_i16(kernel, observations)
    for i, row in enumerate(observations.tolist()):
        assert (status[i], action[i].tolist()) == literal(kernel, row)
    assert set(status) == {0, 1}


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_inputs_round_half_away_from_zero(data: st.DataObject) -> None:
    """Around every step and half-step, and anywhere."""
    kernel = policies.kernel(ODD)
    i = data.draw(st.integers(0, len(kernel.obs_max) - 1))
    halves, nudge = data.draw(st.integers(-65534, 65534)), data.draw(st.integers(-300, 300))
    exact = data.draw(st.booleans())
    bits = bits_of(halves / 2 * float(kernel.lsb[i])) if exact else data.draw(st.integers(0, 2**32 - 1))
    bits = limited(bits + nudge, 0, 2**32 - 1)
    row = [0] * len(kernel.obs_max)
    row[i] = bits
    found, finite = reference.quantized(kernel, np.array([row], np.uint32).view(np.float32))
    wanted = literal_inputs(kernel, row)
    assert bool(finite[0]) == (wanted is not None)
    if wanted is not None:
        assert limited(int(found[0, i]), -INT16 - 1, INT16 + 1) == limited(wanted[i], -INT16 - 1, INT16 + 1)
        true = np.uint32(bits).view(np.float32).astype(float) / float(kernel.lsb[i])
        if abs(true) < INT16:
            assert abs(found[0, i] - true) <= 0.5 + 2.0**-15 * abs(true) + 1e-9  # 16 bits of the significand


def test_extreme_floats_have_their_places() -> None:
    kernel = policies.kernel(PENDULUM)
    reals = np.array([0.0, -0.0, 1e-45, -1e-45, 1.1e-38, 3.4e38, -3.4e38], np.float32)
    found, finite = reference.quantized(kernel, np.stack([reals, 0 * reals, 0 * reals], axis=1))
    assert finite.all()
    assert found[:5, 0].tolist() == [0] * 5
    assert found[5, 0] > INT16
    assert found[6, 0] < -INT16


def layered(rng: np.random.Generator, sizes: tuple[int, ...], activation: str = "relu") -> Kernel:
    """Any integers at all that a kernel may hold."""
    layers = tuple(
        Dense(
            rng.integers(-127, 128, (o, i)),
            rng.integers(-(2**27), 2**27, o),
            rng.integers(1, 2**15, o),
            int(rng.integers(0, 16)),
        )
        for i, o in pairwise(sizes)
    )
    inputs, outputs = sizes[0], sizes[-1]
    low, high = np.sort(rng.integers(-INT16, INT16 + 1, (2, inputs)), axis=0)
    return Kernel(
        scale=rng.integers(2**15, 2**16, inputs),
        exponent=rng.integers(130, 160, inputs),
        obs_min=low,
        obs_max=high,
        layers=layers,
        activation=activation,
        act_lsb=np.full(outputs, 1e-3, np.float32),
        act_min=np.full(outputs, -INT16),
        act_max=np.full(outputs, INT16),
        act_safe=np.zeros(outputs, np.float32),
        obs_shift=np.zeros(inputs, int),
    )


@ACTIVATIONS
@pytest.mark.parametrize("seed", range(5))
def test_any_integers_are_the_literal_arithmetic(activation: str, seed: int) -> None:
    """Not only those of a quantizer: saturation in every layer."""
    rng = np.random.default_rng(seed)
    kernel = layered(rng, (6, 9, 5, 3), activation)
    x = rng.integers(-INT16 - 1, INT16 + 1, (30, 6)).astype(np.int16)
    status, action = policies.step_i16(kernel, x)
    for i, row in enumerate(x.tolist()):
        assert (status[i], action[i].tolist()) == literal(kernel, row)


@pytest.mark.parametrize("seed", range(20))
def test_the_bound_is_attained_and_never_passed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kernel = layered(rng, (int(rng.integers(1, 40)), 8))
    (layer,) = kernel.layers
    kernel = replace(kernel, obs_min=-abs(kernel.obs_max), obs_max=abs(kernel.obs_max))
    bound = accumulator_bound(kernel)
    worst = [np.sign(w) * kernel.obs_max * (1 if b >= 0 else -1) for w, b in zip(layer.weight, layer.bias, strict=True)]
    accumulated = np.array(worst) @ layer.weight.T + layer.bias
    assert np.abs(accumulated).max() == bound
    anything = rng.integers(kernel.obs_min, kernel.obs_max + 1, (200, len(kernel.obs_max)))
    assert np.abs(anything @ layer.weight.T + layer.bias).max() <= bound


def test_the_bound_takes_later_layers_at_their_fullest() -> None:
    """Whatever the first layer gives, the second one gets at most 2^15 of it."""
    rng = np.random.default_rng(0)
    first, second = layered(rng, (2, 30, 4)).layers
    kernel = layered(rng, (2, 30, 4))
    kernel = replace(kernel, layers=(Dense(0 * first.weight, 0 * first.bias, first.multiplier, 0), second))
    full = np.abs(second.weight).sum(axis=1) * INT16 + np.abs(second.bias)
    assert full.max() <= accumulator_bound(kernel) <= full.max() + 127 * 30


@pytest.mark.parametrize(("over", "refused"), [(-1, False), (0, True), (1, True)])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("at", [0, 1])
def test_a_possible_overflow_is_refused_from_2_to_the_31_on(over: int, refused: bool, sign: int, at: int) -> None:
    size = (INT16, INT16 + 1)[at]
    bias = sign * (2**31 + over - 400 * 127 * size)
    wide = Dense(np.full((1, 400), -127), np.array([bias]), np.array([1]), 0)
    before = Dense(np.zeros((400, 3), int), np.zeros(400, int), np.ones(400, int), 0)
    layers = (wide,) if at == 0 else (before, wide)
    kernel = layered(np.random.default_rng(0), (400 if at == 0 else 3, 1))
    full = np.full(len(kernel.obs_max), INT16)
    kernel = replace(kernel, layers=layers, obs_min=-full, obs_max=full)
    if refused:
        with pytest.raises(AccumulatorOverflow, match=f"layer {at}, output 0: the accumulator can reach 2,147,483,6"):
            accumulator_bound(kernel)
    else:
        assert accumulator_bound(kernel) == 2**31 - 1


def test_too_many_weights_are_refused() -> None:
    kernel = layered(np.random.default_rng(0), (1200, 2))
    with pytest.raises(AccumulatorOverflow, match="layer 0"):
        accumulator_bound(replace(kernel, obs_min=np.full(1200, -INT16)))


def test_products_are_summed_exactly() -> None:
    """By float64: at the largest sums that there may be, every last bit, and in whatever order BLAS adds."""
    rng = np.random.default_rng(0)
    weight = rng.choice([-127, 127, 126], (7, 516))
    x = rng.choice([-INT16, INT16, INT16 - 1], (50, 516))
    x[0] = INT16 * np.sign(weight[0])
    layer = Dense(weight, np.array([3, -3, 1, 0, 5, 7, 9]), np.full(7, 32767), 15)
    wanted = (x @ weight.T + layer.bias) * 32767 >> 31
    np.testing.assert_array_equal(reference.dense(layer, x, -INT16 - 1), np.clip(wanted, -INT16 - 1, INT16))
    assert wanted[0, 0] > 32000

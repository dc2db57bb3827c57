"""The kernel's memory: its semantics in float and in integers, its C, and any number of policies in one firmware."""

import json
import math
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import policies
from cross_targets import BODIES, EACH, EITHER, RV32EC, RV32IMC, need
from literal_network import limited, literal_network
from policies import HOVER, ODD, REMEMBERING, TRACK
from qrl.export import emit, targets, vectors
from qrl.export import kernel as reference
from qrl.export.kernel import INT16, Kernel, accumulator_bound
from qrl.export.policy import Memory, Policy
from qrl.export.quantize import UnsupportedNetwork, quantize, respond
from qrl.export.targets import FIRMWARE, RELEASE, STRICT, Core, VerificationFailed
from qrl.export.vectors import Observations, Vectors
from qrl.export.verify import CORE_STEPS, HOST_STEPS, compare, verify

WHICH = pytest.mark.parametrize("which", REMEMBERING)
TANH = ("both", "track", "odd", "recurrent")  # the activation and what is remembered are apart in the source
EITHER_ACTIVATION = pytest.mark.parametrize(
    ("which", "activation"), [*((which, "relu") for which in REMEMBERING), *((which, "tanh") for which in TANH)]
)
MANY, SOME, FEW = 10_000, 2_000, 600
SANITIZED = (*STRICT, "-g", "-fsanitize=undefined,address", "-fno-sanitize-recover=all")


@cache
def drawn(which: str, activation: str, n: int) -> Vectors:
    return vectors.draw(policies.remembering(which, activation), policies.remembering_kernel(which, activation), n)


@cache
def sequences(which: str, activation: str, steps: int) -> Vectors:
    policy, kernel = policies.remembering(which, activation), policies.remembering_kernel(which, activation)
    return vectors.draw_sequences(policy, kernel, 2, steps)


@pytest.fixture(scope="module")
def source_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """The emitted C of a policy with memory."""

    @cache
    def source(which: str, activation: str) -> Path:
        policy, kernel = policies.remembering(which, activation), policies.remembering_kernel(which, activation)
        return policies.emitted(tmp_path_factory.mktemp("export"), policy, kernel)

    return source


SourceOf = Callable[[str, str], Path]


def wandering(policy: Policy, steps: int, seed: int = 0) -> np.ndarray:
    """A sequence [steps, F] within the flights, positions within 1.3 radii; a few numbers are not finite."""
    rng = np.random.default_rng(seed)
    size = len(policy.observations)
    rows = policy.calibration[rng.integers(len(policy.calibration), size=steps), :size].copy()
    if policy.memory and policy.memory.integral:
        limit = np.abs(policy.calibration[:, list(policy.memory.integral.position)]).max(axis=0)
        walk = np.minimum(limit, 1.3 * policy.memory.integral.radius_m) * np.sin(np.linspace(0, 40, steps))[:, None]
        rows[:, list(policy.memory.integral.position)] = walk * [0.3, 0.6, 1.0] + circle_center(policy)
    rows[steps // 3, 0], rows[steps // 2, size - 1] = np.nan, -np.inf
    return rows


def circle_center(policy: Policy) -> np.ndarray:
    """Where the error is 0 [3]: a point of the circle, if there is one."""
    circle_m = policy.memory and policy.memory.integral and policy.memory.integral.circle_m
    return np.array([0.6, -0.8, 0.0]) * (circle_m or 0.0)


# -- float ---------------------------------------------------------------------------------------------------


def literal_steps(policy: Policy, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Actions and memories of one flight, number by number in Python's floats."""
    assert policy.memory
    integral = policy.memory.integral
    total, h = [0.0] * (integral.size if integral else 0), [0.0] * policy.memory.units
    action = [min(max(a.offset, a.limits[0]), a.limits[1]) for a in policy.actions]
    actions, memories = [], []
    for row in observations.astype(float).tolist():
        if all(math.isfinite(x) for x in row):
            if integral:
                e = [row[i] for i in integral.position]
                r = integral.circle_m
                if r:
                    x, y, z = e
                    outside = (x * x + y * y - r * r) / (2 * r)
                    e = [outside, z, outside * x / r, outside * y / r]
                gate = max(0.0, 1.0 - sum(x * x for x in (e[:2] if r else e)) / integral.radius_m**2) ** 2
                for i in range(len(e)):
                    total[i] += policy.control_period_s * e[i] * gate
                    total[i] = min(max(total[i], -integral.limit_m_s), integral.limit_m_s)
            inputs = row + (action if policy.memory.previous_action else []) + (total if integral else []) + h
            a, h = (found[0].tolist() for found in policies.outputs_and_unit(policy, np.array([inputs])))
            action = [
                min(max(port.offset + port.scale * x, port.limits[0]), port.limits[1])
                for port, x in zip(policy.actions, a, strict=True)
            ]
            actions.append(action)
        else:
            actions.append([port.safe for port in policy.actions])
        memories.append((action if policy.memory.previous_action else []) + (list(total) if integral else []) + h)
    return np.array(actions), np.array(memories)


@WHICH
def test_the_float_policy_is_the_literal_loop(which: str) -> None:
    """Beside another flight, which it must not mix with."""
    policy = policies.remembering(which)
    flights = [wandering(policy, 400, seed) for seed in (0, 1)]
    wanted = [literal_steps(policy, flight) for flight in flights]
    memory = policy.initial_memory(2)
    for t in range(400):
        memory, action = policy.step(memory, np.stack([flight[t] for flight in flights]))
        for i, (actions, memories) in enumerate(wanted):
            np.testing.assert_allclose(action[i], actions[t], rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(memory[i], memories[t], rtol=1e-9, atol=1e-12)
    if policy.memory and policy.memory.integral:
        last = wanted[0][1].shape[1] - policy.memory.units
        assert np.abs(wanted[0][1][:, last - 2 : last]).max() > 0.01 * policy.memory.integral.limit_m_s


def test_the_integral_stands_still_far_away_and_stays_within_its_limit() -> None:
    policy = policies.remembering("both")
    assert policy.memory
    assert policy.memory.integral
    far, near = np.zeros((1, 18)), np.zeros((1, 18))
    far[0, 9:12], near[0, 9] = [0.7, 0.7, 0.2], 0.4
    memory = policy.initial_memory(1)
    np.testing.assert_allclose(memory[0, :4], 0.667 * 9.81 / 4, rtol=1e-3)
    assert not memory[0, 4:].any()
    for _ in range(50):
        memory, _ = policy.step(memory, far)
    assert not memory[0, 4:].any()
    memory, _ = policy.step(memory, near)
    np.testing.assert_allclose(memory[0, 4:], [0.01 * 0.4 * 0.84**2, 0, 0])
    for _ in range(400):
        memory, _ = policy.step(memory, near)
    np.testing.assert_allclose(memory[0, 4:], [0.4, 0, 0])


# -- integers ------------------------------------------------------------------------------------------------


def rounded(x: int, shift: int) -> int:
    return (x + 2**shift // 2) // 2**shift


def literal_integers(kernel: Kernel, x: list[int] | None, action: list[int], total: list[int], h: list[int]) -> None:
    """One step in Python's integers; changes action, total and h, unless an input is not finite."""
    assert kernel.memory
    if x is None:
        return
    x = [limited(q, low, high) for q, low, high in zip(x, kernel.obs_min, kernel.obs_max, strict=True)]
    if integral := kernel.memory.integral:
        e = [x[i] for i in integral.position]
        if circle := integral.circle:
            parts = zip(e[:2], circle.factor.tolist(), circle.shift.tolist(), strict=True)
            q = [limited(rounded(one * factor, shift), -32767, 32767) for one, factor, shift in parts]
            outside = rounded(q[0] * q[0] + q[1] * q[1] - 2**28, 15)
            e = [outside, e[2], *(limited(rounded(outside * one, 14), -57344, 57344) for one in q)]
        k = range(integral.size)
        v = [rounded(e[i] * int(integral.inverse_radius[i]), int(integral.inverse_radius_shift[i])) for i in k]
        w = max(0, 2**30 - sum(one * one for one in (v[:2] if integral.circle else v))) // 2**15
        gate = w * w // 2**15
        for i in k:
            more = rounded(e[i] * gate * int(integral.gain[i]) // 2**16, int(integral.gain_shift[i]))
            total[i] = limited(total[i] + more, -integral.limit, integral.limit)
    kept = (action if kernel.memory.initial_action is not None else []) + (total if kernel.memory.integral else [])
    columns = zip(kept, kernel.memory.shift, kernel.memory.low, kernel.memory.high, strict=True)
    if turn := kernel.turn:

        def rotated(at: int, shift: int) -> list[int]:
            sums = [sum(x[3 * i + j] * x[at + i] // 2 for i in range(3)) for j in range(3)]
            return [limited(rounded(one, shift), -32767, 32767) for one in sums]

        inputs = [rounded(q, turn.up) for q in (x[:3] if turn.heading else []) + x[6:9]]
        inputs += rotated(9, turn.position) + rotated(12, turn.velocity) + x[15:18]
        for k in range(turn.vectors):
            inputs += rotated(18 + 3 * k, turn.ahead)
    else:
        inputs = [rounded(q, int(shift)) for q, shift in zip(x, kernel.obs_shift, strict=True)]
    inputs += [limited(rounded(q, int(shift)), low, high) for q, shift, low, high in columns]
    if kernel.turn and (n := kernel.turn.last):
        inputs, vector = inputs[:-n], inputs[-n:]
        sums = [sum(x[3 * i + j] * vector[i] // 2 for i in range(n)) for j in range(3)]
        inputs += [limited(rounded(one, 15), -32767, 32767) for one in sums]
    h[:], action[:] = literal_network(kernel, inputs, h)


@WHICH
def test_the_integer_policy_is_the_literal_loop(which: str) -> None:
    """Both entries, through observations of every kind."""
    n = 2 * vectors.LENGTH
    kernel, wanted = policies.remembering_kernel(which), drawn(which, "relu", n)
    assert kernel.memory
    for entry in ("step", "step_i16"):
        observations = wanted.obs if entry == "step" else wanted.obs_i16
        finite = np.isfinite(observations).all(axis=1)
        quantized = reference.quantized(kernel, wanted.obs)[0] if entry == "step" else observations
        for first in range(0, n, wanted.length):
            state = reference.initial_state(kernel, 1)
            start = kernel.memory.initial_action
            action = [0] * len(kernel.act_lsb) if start is None else start.tolist()
            total = [0] * (kernel.memory.integral.size if kernel.memory.integral else 0)
            h = [0] * kernel.memory.units
            for i in range(first, first + wanted.length):
                state, _, act = getattr(reference, entry)(kernel, state, observations[i : i + 1])
                literal_integers(kernel, quantized[i].tolist() if finite[i] else None, action, total, h)
                kept = (action if start is not None else []) + (total if kernel.memory.integral else []) + h
                assert state[0].tolist() == kept
                if finite[i]:
                    unit = kernel.act_lsb if entry == "step" else np.float32(1)
                    np.testing.assert_array_equal(act[0], np.array(action, np.float32) * unit)
                else:
                    np.testing.assert_array_equal(act[0], kernel.act_safe)


@EITHER_ACTIVATION
def test_integers_are_close_to_float(which: str, activation: str) -> None:
    """On inputs not calibrated on, of all memory."""
    policy, kernel = policies.remembering(which, activation), policies.remembering_kernel(which, activation)
    inputs = 0.9 * policy.calibration + 0.1 * policy.calibration[::-1]
    low, high = policy.limits
    error = (respond(kernel, inputs) - policy(inputs.astype(float))) / (high - low)
    assert (error**2).mean() ** 0.5 <= 0.004
    assert np.abs(error).max() <= 0.03


def test_a_candidate_beyond_the_tanhs_range_is_close_to_float() -> None:
    """Of sums many times as large, of which r leaves a part: they are not cut before it does."""
    policy = policies.remembering("recurrent")
    assert policy.unit
    weight, bias = policy.unit.of_memory
    policy = replace(policy, unit=replace(policy.unit, of_memory=(6.0 * weight, 6.0 * bias)))
    kernel = quantize(policy)
    assert kernel.unit
    assert kernel.unit.shift > 0
    low, high = policy.limits
    error = (respond(kernel, policy.calibration) - policy(policy.calibration.astype(float))) / (high - low)
    assert (error**2).mean() ** 0.5 <= 0.006
    assert np.abs(error).max() <= 0.05


def remembered(kernel: Kernel, state: np.ndarray) -> np.ndarray:
    """The state in SI units."""
    assert kernel.memory
    unit = [] if kernel.memory.initial_action is None else [kernel.act_lsb]
    integral = kernel.memory.integral
    return state[:, : state.shape[1] - kernel.memory.units] * np.concatenate(
        [*unit, np.full(integral.size if integral else 0, integral.unit_m_s if integral else 0)]
    )


def test_a_minute_of_integers_does_not_drift() -> None:
    """The integral is the float one to a thousandth of its limit, whatever the actions are, and so to the last step."""
    policy, kernel, given = policies.remembering(), policies.remembering_kernel(), sequences("both", "relu", HOST_STEPS)
    assert kernel.memory
    assert kernel.memory.integral
    state = np.ascontiguousarray(given.outputs.state[:, :12]).view("<i4").reshape(2, HOST_STEPS, 3)
    found = state * kernel.memory.integral.unit_m_s
    memory, observations = policy.initial_memory(2), given.obs.reshape(2, HOST_STEPS, 18)
    for t in range(HOST_STEPS):
        memory, _ = policy.step(memory, observations[:, t])
        np.testing.assert_allclose(found[:, t], memory[:, 4:], rtol=0, atol=1e-3 * 0.4)
    np.testing.assert_allclose(memory[1, 4:6], [0.4, -0.4])


@WHICH
def test_a_tenth_of_a_millimeter_counts(which: str) -> None:
    """At one step of the position, or 0.1 mm where that is more, 1000 steps add up to what they should within 1 %."""
    policy, kernel = policies.remembering(which), policies.remembering_kernel(which)
    if not (policy.memory and policy.memory.integral and kernel.memory and kernel.memory.integral):
        return
    if policy.memory.integral.circle_m:
        return  # `test_a_millimeter_from_the_circle_counts`
    axes = [(axis, i) for axis, i in enumerate(policy.memory.integral.position) if kernel.obs_min[i] < 0]
    each = [(axis, i, sign) for axis, i in axes for sign in (1, -1)]
    obs = np.zeros((len(each), len(kernel.scale)), np.int16)
    for row, (_, i, sign) in zip(obs, each, strict=True):
        row[i] = sign * max(round(1e-4 / kernel.lsb[i]), 1)
    state = reference.initial_state(kernel, len(each))
    for _ in range(1000):
        state, _, _ = reference.step_i16(kernel, state, obs)
    for total, row, (axis, i, _) in zip(remembered(kernel, state)[:, -3:], obs, each, strict=True):
        wanted = min(1000 * policy.control_period_s * row[i] * kernel.lsb[i], policy.memory.integral.limit_m_s)
        np.testing.assert_allclose(total[axis], wanted, rtol=0.01)
        assert not total[[other for other, _ in axes if other != axis]].any()


def test_a_millimeter_from_the_circle_counts() -> None:
    """Wherever on the circle: 1000 steps at 1 mm outside or inside add up to that, to two steps of the error."""
    policy, kernel = policies.remembering("circle"), policies.remembering_kernel("circle")
    assert policy.memory
    assert policy.memory.integral
    radius_m = policy.memory.integral.circle_m
    assert radius_m
    turn, away_m = (x.ravel() for x in np.meshgrid([0.0, 1.0, 2.5, 4.0], [1e-3, -1e-3]))
    obs = np.zeros((len(turn), 18), np.float32)
    obs[:, 9], obs[:, 10] = (radius_m + away_m) * np.cos(turn), (radius_m + away_m) * np.sin(turn)
    state = reference.initial_state(kernel, len(turn))
    for _ in range(1000):
        state, _, _ = reference.step(kernel, state, obs)
    each_m = remembered(kernel, state)[:, -4:-2] / (1000 * policy.control_period_s)
    wanted_m = np.stack([away_m, 0.0 * away_m], axis=1)
    np.testing.assert_allclose(each_m, wanted_m, rtol=0, atol=radius_m / 2**13)


def test_a_position_has_the_finest_steps() -> None:
    """Whatever the network's own steps for it are: these would hide an offset of millimeters from the integral."""
    kernel, plain = policies.remembering_kernel(), policies.kernel(HOVER)
    reach = np.maximum(-kernel.obs_min, kernel.obs_max)
    assert (reach[9:12] >= INT16 - 1).all()
    assert kernel.obs_shift[9:12].any()
    assert not np.delete(kernel.obs_shift, [9, 10, 11]).any()
    assert not plain.obs_shift.any()


@WHICH
def test_the_bound_covers_what_is_remembered(which: str) -> None:
    """It is attained by the extremes that the state can reach, and by nothing less."""
    kernel = policies.remembering_kernel(which)
    low, high = kernel.input_limits
    rng = np.random.default_rng(0)
    layer = kernel.layers[0]
    size = np.maximum(-low, high)
    worst = (np.sign(layer.weight) * size) @ layer.weight.T
    largest = int((np.diag(worst) + np.abs(layer.bias)).max())
    kernel = replace(kernel, unit=None)
    assert accumulator_bound(replace(kernel, layers=(layer,))) == largest
    x = rng.integers(kernel.obs_min, kernel.obs_max + 1, (500, len(kernel.obs_max)))
    state = reference.initial_state(kernel, 500)
    for end in (-(2**30), 2**30):
        inputs = reference.inputs(kernel, 0 * state + end, x)
        assert (inputs >= low).all()
        assert (inputs <= high).all()
        assert np.abs(inputs @ layer.weight.T + layer.bias).max() <= largest
    seen = len(reference.measured(kernel, x)[0])
    if seen == len(low):
        return
    forgetful = replace(kernel, layers=(replace(layer, weight=layer.weight * (np.arange(len(low)) < seen)),))
    assert accumulator_bound(forgetful) < largest


def test_a_memory_that_cannot_be_kept_is_refused() -> None:
    policy = policies.remembering("odd")
    memory = policy.memory
    assert memory
    assert memory.integral
    wrong = {
        "expected finite limits": Memory(True, replace(memory.integral, radius_m=0.0)),
        "a limit nearer": Memory(True, replace(memory.integral, limit_m_s=1e12)),
        "a limit nearer to": Memory(True, replace(memory.integral, limit_m_s=1e-9)),
        "a radius nearer": Memory(True, replace(memory.integral, radius_m=1e12)),
        "expected 7 inputs, found 10": Memory(True, None),
        "holds nothing": Memory(False, None),
    }
    for says, other in wrong.items():
        with pytest.raises(UnsupportedNetwork, match=says):
            quantize(replace(policy, memory=other))


# -- the C ---------------------------------------------------------------------------------------------------


def assert_same(found: vectors.Outputs, wanted: vectors.Outputs) -> None:
    """Written apart from verify.compare."""
    for name in ("status", "act", "state", "status_i16", "act_i16", "state_i16"):
        value, known = getattr(found, name), getattr(wanted, name)
        if "state" in name:
            value = value[:, : known.shape[1]]  # without padding
        if name == "act":
            value, known = (np.ascontiguousarray(x).view(np.uint32) for x in (value, known))
        np.testing.assert_array_equal(value, known, err_msg=name)
    assert found.selftest == 0


def test_the_sequences_are_of_every_kind() -> None:
    """The tests below rely on it."""
    for which in REMEMBERING:
        wanted = drawn(which, "relu", MANY)
        assert (len(wanted.obs), wanted.length) == (MANY, vectors.LENGTH)
        assert min(np.bincount(wanted.outputs.status, minlength=3)) > 10
        assert len(np.unique(wanted.outputs.state, axis=0)) > MANY // 5
    given, limit = sequences("both", "relu", HOST_STEPS), policies.remembering_kernel().memory
    assert limit
    assert limit.integral
    total = np.ascontiguousarray(given.outputs.state[:, :12]).view("<i4")
    assert np.abs(total).max() == limit.integral.limit
    assert len(np.unique(np.ascontiguousarray(given.outputs.state[:, 12:]), axis=0)) > HOST_STEPS // 20


@pytest.mark.usefixtures("host")
@EITHER_ACTIVATION
def test_the_host_gives_the_references_bits(which: str, activation: str, source_of: SourceOf, tmp_path: Path) -> None:
    each = [(SANITIZED, drawn(which, activation, MANY if activation == "relu" else FEW))]
    if (which, activation) == ("both", "relu"):
        each += [(flags, sequences(which, activation, HOST_STEPS)) for flags in (SANITIZED, FIRMWARE)]
    for flags, wanted in each:
        found = targets.run_host(source_of(which, activation), tmp_path, flags, wanted.observations)
        assert_same(found, wanted.outputs)


@EITHER
def test_each_memory_alone_gives_the_references_bits(core: Core | None, source_of: SourceOf, tmp_path: Path) -> None:
    for which in ("action", "integral", "one action", "odd", "track", "world circle"):
        wanted, source = drawn(which, "tanh", FEW), source_of(which, "tanh")
        if core is None:
            found = targets.run_host(source, tmp_path, STRICT, wanted.observations)
        else:
            found, _ = targets.run_core(core, source, tmp_path, FIRMWARE, wanted.observations)
        assert_same(found, wanted.outputs)


BARS = {"M0": (27_000, 26_000), "M3": (18_500, 18_000), "M4F": (9_000, 8_600), "M7": (9_000, 8_600)}
BARS |= {"M33": BARS["M4F"], "M55": (4_000, 3_700), "RV32IMC": (25_500, 24_700), "RV32EC": (440_000, 440_000)}
GATED_BARS = {
    "M0": 15_500,
    "M3": 10_500,
    "M4F": 6_000,
    "M7": 6_000,
    "M33": 6_000,
    "M55": 3_700,
    "RV32IMC": 14_000,
    "RV32EC": 320_000,
}


@EACH
def test_every_core_gives_the_references_bits_and_memory_costs_little(
    core: Core, source_of: SourceOf, tmp_path: Path
) -> None:
    """Seven inputs more, their memory and the integral: a tenth of the instructions, 1.5 KB of flash, 20 B of state."""
    source, long = source_of("both", "relu"), sequences("both", "relu", CORE_STEPS // core.share)
    assert_same(targets.run_core(core, source, tmp_path, RELEASE, long.observations)[0], long.outputs)
    wanted = drawn("both", "relu", MANY if core in BODIES else SOME // core.share)
    found, counts = targets.run_core(core, source, tmp_path, RELEASE, wanted.observations)
    assert_same(found, wanted.outputs)
    size = targets.size(core, source, tmp_path)
    for count, bar in zip((counts.f32, counts.i16), BARS[core.name], strict=True):
        assert 2_000 < count[wanted.outputs.status == 0].mean() <= bar
    assert size.text + size.data <= (9_984 if core is RV32EC else 9_728)
    assert (size.data, size.bss, found.state.shape[1]) == (0, 0, 20)
    assert max(counts.stack_f32, counts.stack_i16) <= 416
    assert counts.stack_selftest <= (544 if core in (RV32IMC, RV32EC) else 512)


@EITHER
def test_no_number_leaves_the_state_as_it_was(core: Core | None, source_of: SourceOf, tmp_path: Path) -> None:
    """Wherever it stands: status 2, the safe action, and the next step goes on from the one before."""
    policy, kernel = policies.remembering(), policies.remembering_kernel()
    good = wandering(policy, 38)[:18]
    good[np.isnan(good)] = 0.0
    obs = good.repeat(2, axis=0)
    rows = np.arange(18)
    obs[2 * rows + 1, rows] = np.where(rows % 2, np.nan, np.inf)
    given = Observations(obs, np.zeros((1, 18), np.int16), len(obs))
    if core is None:
        found = targets.run_host(source_of("both", "relu"), tmp_path, FIRMWARE, given)
    else:
        found, _ = targets.run_core(core, source_of("both", "relu"), tmp_path, FIRMWARE, given)
    np.testing.assert_array_equal(found.status[1::2], 2)
    np.testing.assert_array_equal(found.act[1::2], np.broadcast_to(kernel.act_safe, (18, 4)))
    np.testing.assert_array_equal(found.state[1::2], found.state[::2])
    without = vectors.with_outputs(kernel, good, given.obs_i16, len(good))
    np.testing.assert_array_equal(found.act[::2], without.outputs.act)


# -- verification is able to fail ----------------------------------------------------------------------------


def changed(kernel: Kernel, **values: object) -> Kernel:
    """Of the memory, or of the integral in it."""
    assert kernel.memory
    assert kernel.memory.integral
    own = {name: value for name, value in values.items() if hasattr(kernel.memory, name)}
    integral = replace(kernel.memory.integral, **{n: value for n, value in values.items() if n not in own})
    return replace(kernel, memory=replace(kernel.memory, integral=integral, **own))


def faults(kernel: Kernel) -> dict[str, Kernel]:
    assert kernel.memory
    assert kernel.memory.integral
    assert kernel.memory.initial_action is not None
    memory, integral, first = kernel.memory, kernel.memory.integral, kernel.memory.initial_action
    return {
        "a gain": changed(kernel, gain=integral.gain + 1),
        "a gain's shift": changed(kernel, gain_shift=integral.gain_shift + 1),
        "a radius": changed(kernel, inverse_radius=integral.inverse_radius - 1),
        "the limit": changed(kernel, limit=integral.limit - 1),
        "an axis": changed(kernel, position=integral.position[::-1]),
        "the first action": changed(kernel, initial_action=first + 2 ** memory.shift[:2]),
        "an input's shift": changed(kernel, shift=memory.shift + 1),
        "an input's range": changed(kernel, low=memory.low + (np.arange(len(memory.low)) == 0) * 300),
        "a position's shift": replace(kernel, obs_shift=kernel.obs_shift ^ (kernel.obs_shift > 0)),
    }


def short_then_long(name: str, which: str, source: Path, work: Path) -> None:
    """Compare `source` on the host with the reference: on the long sequences only what the short ones do not tell."""
    for wanted in (drawn(which, "relu", FEW), sequences(which, "relu", HOST_STEPS)):
        compare(name, targets.run_host(source, work, ("-O0",), wanted.observations), wanted.outputs)


@pytest.mark.usefixtures("host")
def test_one_step_of_a_difference_fails_verification(tmp_path: Path) -> None:
    """Emitted from another kernel than the reference; its golden vectors do not reveal it."""
    policy, kernel = policies.remembering("odd"), policies.remembering_kernel("odd")
    for name, other in faults(kernel).items():
        (tmp_path / name).mkdir()
        source = policies.emitted(tmp_path / name, policy, other)
        with pytest.raises(VerificationFailed, match=rf"^{name}: .* differs from the reference"):
            short_then_long(name, "odd", source, tmp_path)


SOURCE_FAULTS = {
    "the action is not kept": ("        state->previous_action[i] = steps;\n", ""),
    "the gate is always open": ("inside * inside >> 15", "32768"),
    "no limit": ("limited(integral[i] + more, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)", "integral[i] + more"),
    "rounded down": ("(x + ((int32_t)1 << shift >> 1)) >> shift", "x >> shift"),
    "a reset of two axes": (
        "for (int i = 0; i < INTEGRAL; ++i) {\n        state->integral[i] = 0;",
        "for (int i = 0; i < INTEGRAL - 1; ++i) {\n        state->integral[i] = 0;",
    ),
    "integrated before it is complete": (
        "        status |= put(a.one + i, inputs + i, quantised",
        "        state->integral[0] += 1;\n        status |= put(a.one + i, inputs + i, quantised",
    ),
}


FRAME_FAULTS = {  # of a policy in the body frame, with heading, previews and the integral
    "to the world": ("(r[j] * v0 >> 1) + (r[3 + j] * v1 >> 1)", "(r[3 * j] * v0 >> 1) + (r[3 * j + 1] * v1 >> 1)"),
    "the wrong row": ("for (int i = 6; i < 9; ++i)", "for (int i = 3; i < 6; ++i)"),
    "a preview left in the world": ("i < 3 * VECTORS", "i < 3 * VECTORS - 3"),
    "a preview's step": ("x->one + 18 + i, 3, AHEAD_SHIFT", "x->one + 18 + i, 3, AHEAD_SHIFT - 1"),
    "the integral left in the world": ("    rotated(x->one + i - LAST, r, last, LAST, 15);\n", "    (void)last;\n"),
    "two axes of the integral": ("r, last, LAST, 15)", "r, last, LAST - 1, 15)"),
}


UNIT_FAULTS = {  # of a recurrent policy
    "no reset": ("        state->recurrent[i] = 0;\n", "        (void)state;\n"),
    "r and z swapped": (
        "r = sigmoid(y[k]), z = sigmoid(y[k + UNITS])",
        "z = sigmoid(y[k]), r = sigmoid(y[k + UNITS])",
    ),
    "no sigmoid": ("return tanh_of(z) >> 1;", "return (tanh_of(z) - 1) >> 1;"),
    "the memory's shift": ("shifted(h[k], MEMORY_SHIFT)", "shifted(h[k], MEMORY_SHIFT + 1)"),
    "the candidate's shift": ("* (1 << CANDIDATE_SHIFT) + OFFSET", "* (2 << CANDIDATE_SHIFT) + OFFSET"),
    "a candidate beyond the table": ("(sum < 0 ? -32768 : 32767) + OFFSET", "sum & 32767"),
    "h is not kept": ("        h[k] = (int16_t)next;\n", ""),
    "the inputs for h": ("dense(l + 2, g, of_g,", "dense(l + 2, a, of_g,"),
}


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize(
    ("which", "fault"),
    [
        *(("both", each) for each in SOURCE_FAULTS.values()),
        *(("track", each) for each in FRAME_FAULTS.values()),
        *(("recurrent", each) for each in UNIT_FAULTS.values()),
    ],
    ids=[*SOURCE_FAULTS, *FRAME_FAULTS, *UNIT_FAULTS],
)
def test_a_slip_in_the_source_shows(which: str, fault: tuple[str, str], tmp_path: Path) -> None:
    source = policies.emitted(tmp_path, policies.remembering(which), policies.remembering_kernel(which))
    text = source.read_text()
    assert fault[0] in text
    source.write_text(text.replace(*fault))
    with pytest.raises(VerificationFailed, match=r"^here: .* differs from the reference"):
        short_then_long("here", which, source, tmp_path)


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize(
    ("fault", "by", "which"),
    [
        ("golden_state", 1, "both"),
        ("act_first", 2000, "both"),
        ("errors", 1, "both"),
        ("positions", 1, "both"),
        ("golden_state", 1, "recurrent alone"),
    ],
)
def test_the_self_test_sees_the_memory(fault: str, by: int, which: str, tmp_path: Path) -> None:
    source = policies.emitted(tmp_path, policies.remembering(which), policies.remembering_kernel(which))
    text = source.read_text()
    at = text.index("= {", text.index(f" {fault}")) + 3
    first = next(number for number in text[at:].replace("{", " ").replace(",", " ").split())
    start = text.index(first, at)
    source.write_text(text[:start] + str(int(first) + by) + text[start + len(first) :])
    wanted = drawn(which, "relu", FEW)
    assert targets.run_host(source, tmp_path, ("-O0",), wanted.observations).selftest > 0


@pytest.mark.usefixtures("host")
def test_a_sound_kernel_is_verified_over_sequences(source_of: SourceOf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "missing_tools", lambda _: ["the cross compiler"])
    policy, kernel = policies.remembering("odd"), policies.remembering_kernel("odd")
    report = verify(policy, kernel, source_of("odd", "relu"), FEW)
    assert report.passed == ["host, -O2", "host, -O3 -ffast-math"]
    assert report.steps == (HOST_STEPS, CORE_STEPS)


@pytest.mark.usefixtures("host")
def test_a_fault_that_only_long_sequences_show_fails_verification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit of the integral, which a second of flight does not reach."""
    monkeypatch.setattr(targets, "missing_tools", lambda _: ["the cross compiler"])
    policy, kernel = policies.remembering(), policies.remembering_kernel()
    assert kernel.memory
    assert kernel.memory.integral
    source = policies.emitted(tmp_path, policy, changed(kernel, limit=kernel.memory.integral.limit - 1))
    wanted = drawn("both", "relu", FEW)
    compare("short", targets.run_host(source, tmp_path, ("-O1",), wanted.observations), wanted.outputs)
    with pytest.raises(VerificationFailed, match="host, -O2: state after step differs"):
        verify(policy, kernel, source, FEW)


# -- several policies, several states ------------------------------------------------------------------------


def build(folder: Path, *command: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


MAIN = """\
#include <stdio.h>
#include "inner.h"
#include "outer.h"

int main(void) {
    static const float obs[INNER_OBS_SIZE] = {0.1F, 0.2F};
    inner_state first, second;
    float act[INNER_ACT_SIZE];
    inner_reset(&first);
    inner_reset(&second);
    for (int i = 0; i < 5; ++i) {
        inner_step(&first, obs, act);
    }
    inner_step(&second, obs, act); /* as if `first` had never been */
    for (int i = 0; i < INNER_ACT_SIZE; ++i) {
        printf("%.9g ", (double)act[i]);
    }
    printf("%d %d %d\\n", inner_selftest(), outer_selftest(), INNER_OBS_SIZE + OUTER_OBS_SIZE);
    return 0;
}
"""


@pytest.mark.usefixtures("host")
def test_two_policies_link_into_one_firmware(tmp_path: Path) -> None:
    """As static libraries, in either order: each is itself, and so is each state."""
    need([] if shutil.which("ar") else ["ar"])
    compiler = targets.host_compiler()
    assert compiler
    policies.emitted(tmp_path, policies.remembering("odd"), policies.remembering_kernel("odd"), name="inner")
    policies.emitted(tmp_path, policies.policy(HOVER), policies.kernel(HOVER), name="outer")
    (tmp_path / "main.c").write_text(MAIN)
    for name in ("inner", "outer"):
        build(tmp_path, compiler, *STRICT, "-c", f"{name}.c")
        build(tmp_path, "ar", "rcs", f"lib{name}.a", f"{name}.o")
    kernel = policies.remembering_kernel("odd")
    obs = np.array([[0.1, 0.2, 0, 0, 0]], np.float32)
    wanted = policies.step(kernel, obs)[1][0]
    for order in (("-linner", "-louter"), ("-louter", "-linner")):
        build(tmp_path, compiler, *STRICT, "main.c", "-L.", *order, "-o", "main")
        done = subprocess.run(["./main"], cwd=tmp_path, capture_output=True, text=True, check=True)
        *act, inner, outer, sizes = done.stdout.split()
        assert [np.float32(value) for value in act] == wanted.tolist()
        assert (inner, outer, sizes) == ("0", "0", "23")


@pytest.mark.usefixtures("host")
def test_every_name_begins_with_the_prefix(tmp_path: Path) -> None:
    """Whatever another translation unit can see: symbols, macros, the types and constants of the header."""
    compiler = targets.host_compiler()
    assert compiler
    need([] if shutil.which("nm") else ["nm"])
    source = policies.emitted(tmp_path, policies.remembering(), policies.remembering_kernel(), name="ours")
    build(tmp_path, compiler, "-std=c99", "-c", source.name)
    listed = subprocess.run(["nm", "-g", "ours.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-1] for line in listed.splitlines() if line.split()[-2] != "U"]
    assert sorted(symbols) == ["ours_reset", "ours_selftest", "ours_step", "ours_step_i16"]
    (tmp_path / "plain.h").write_text("#include <stdint.h>\n")
    macros = [
        set(
            subprocess.run(
                [compiler, "-dM", "-E", name], cwd=tmp_path, capture_output=True, text=True
            ).stdout.splitlines()
        )
        for name in ("ours.h", "plain.h")
    ]
    defined = [line.split()[1] for line in macros[0] - macros[1]]
    assert len(defined) >= 8
    assert all(name.startswith("OURS_") for name in defined)
    for path in tmp_path.rglob("*"):
        if path.is_file() and path.suffix not in (".o", ".csv") and path.name != "plain.h":
            assert "qrl_policy" not in path.read_text().lower(), path


# -- what is emitted says ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "valid"),
    [("hover", True), ("_x9", True), ("Hover", True), ("x" * 64, True), ("qrl_hover", True)]
    + [(name, False) for name in ("", "9x", "a-b", "a b", "é", "x" * 65, "a.b", "../a", "stdint", "Math", "a\n")]
    + [(name, False) for name in ("nn_controller", "log", "Param", "task", "golden", "last")]
    + [(name, True) for name in ("policy", "all", "_2d", "app_2")],
)
def test_a_name_is_a_c_identifier(name: str, valid: bool) -> None:
    assert emit.is_name(name) == valid


@pytest.mark.parametrize("task", ["hover", "my task", "hover-2", "höhe", "9", "*/", "x" * 300, "cf21_brushless"])
def test_any_task_has_a_default_name(task: str) -> None:
    name = emit.default_name(task)
    assert emit.is_name(name)
    assert name.startswith("qrl_")
    if task == "hover":
        assert name == "qrl_hover"


@WHICH
def test_the_manifest_says_what_the_state_holds(which: str) -> None:
    policy, kernel = policies.remembering(which), policies.remembering_kernel(which)
    found = json.loads(emit.files(policy, kernel, vectors.golden(policy, kernel), "ours")["manifest.json"])
    sizes, memory = REMEMBERING[which]
    assert (found["format"], found["name"], found["vehicle"]) == (2, "ours", None)
    sizes_bytes = {
        "circle": 24,
        "body": 8,
        "world circle": 16,
        "action": 8,
        "integral": 12,
        "one action": 16,
        "odd": 16,
        "recurrent": 40,
        "recurrent alone": 14,
    }
    assert found["state_bytes"] == sizes_bytes.get(which, 20)
    units = [memory.units] if memory.units else []
    assert found["network"] == [len(policy.layers[0][0]), *sizes[1:-1], *units, sizes[-1]]
    cell = {"cell": "gru", "units": memory.units, "lsb": 1 / 32767} if memory.units else None
    assert found["memory"]["recurrent"] == cell
    if sizes == TRACK:
        assert [port.get("ahead_s") for port in found["obs"]] == [None] * 18 + [0.1] * 3 + [0.5] * 3
    assert len(found["obs"]) == sizes[0]
    assert (found["memory"]["previous_action"] is not None) == memory.previous_action
    if memory.previous_action and sizes == HOVER:
        np.testing.assert_allclose(found["memory"]["previous_action"]["after_reset"], 0.667 * 9.81 / 4, rtol=1e-3)
    if memory.integral and kernel.memory and kernel.memory.integral:
        integral = found["memory"]["integral"]
        assert integral["of"] == [policy.observations[i].name for i in memory.integral.position]
        assert (integral["radius_m"], integral["limit_m_s"]) == (memory.integral.radius_m, memory.integral.limit_m_s)
        np.testing.assert_allclose(integral["lsb"] * kernel.memory.integral.limit, memory.integral.limit_m_s)
    else:
        assert found["memory"]["integral"] is None


def test_without_memory_the_state_is_a_byte() -> None:
    policy, kernel = policies.policy(ODD), policies.kernel(ODD)
    found = json.loads(emit.files(policy, kernel, vectors.golden(policy, kernel), "ours")["manifest.json"])
    assert (found["state_bytes"], found["memory"]) == (1, None)


@pytest.mark.usefixtures("host")
def test_the_example_builds_and_runs(source_of: SourceOf, tmp_path: Path) -> None:
    need([tool for tool in ("make", "cc") if not shutil.which(tool)])
    folder = shutil.copytree(source_of("both", "relu").parent, tmp_path / "export")
    done = subprocess.run(
        ["make", "-s"], cwd=folder / "examples/bare_metal", capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("f1 f2 f3 f4: ")

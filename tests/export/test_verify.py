"""The emitted C equals the NumPy reference bit for bit on the host and on each core, within the limits of its costs.

Where it does not, verification fails. Without the cross tools the cores are skipped, or fail with QRL_REQUIRE_CROSS=1.
"""

import re
import shutil
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import policies
from cross_targets import BODIES, EITHER, M0, M4F, M55, RV32EC, RV32IMC, need
from policies import FLAT, HOVER, ODD, PENDULUM
from qrl.export import targets, vectors
from qrl.export.kernel import Dense, Kernel
from qrl.export.quantize import quantize
from qrl.export.targets import CORES, FIRMWARE, RELEASE, STRICT, Core, Counts, VerificationFailed
from qrl.export.vectors import Observations, Outputs, Vectors
from qrl.export.verify import compare, verify

TOOLCHAINS = targets.CORTEX_M, targets.RISC_V
MANY, SOME, FEW = 10_000, 2_000, 600
SANITIZED = (*STRICT, "-g", "-fsanitize=undefined,address", "-fno-sanitize-recover=all")
SMALL = [PENDULUM, ODD, FLAT]
BOTH = pytest.mark.parametrize("activation", ["relu", "tanh"])


@cache
def expected(sizes: tuple[int, ...], activation: str, n: int) -> Vectors:
    return vectors.draw(policies.policy(sizes, activation), policies.kernel(sizes, activation), n)


@pytest.fixture(scope="module")
def kernel_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[tuple[int, ...], str], Path]:
    """The emitted C of a policy of policies.py."""

    @cache
    def folder(sizes: tuple[int, ...], activation: str) -> Path:
        policy, kernel = policies.policy(sizes, activation), policies.kernel(sizes, activation)
        return policies.emitted(tmp_path_factory.mktemp("export"), policy, kernel)

    return folder


KernelOf = Callable[[tuple[int, ...], str], Path]


def assert_same(found: Outputs, wanted: Outputs) -> None:
    """Written apart from verify.compare."""
    np.testing.assert_array_equal(found.status, wanted.status)
    np.testing.assert_array_equal(found.status_i16, wanted.status_i16)
    np.testing.assert_array_equal(found.act_i16, wanted.act_i16)
    for state, known in ((found.state, wanted.state), (found.state_i16, wanted.state_i16)):
        np.testing.assert_array_equal(state[:, : known.shape[1]], known)
        assert state.shape[1] - known.shape[1] < 4  # padding
    np.testing.assert_array_equal(np.ascontiguousarray(found.act).view(np.uint32), wanted.act.view(np.uint32))
    assert found.selftest == 0


def test_the_vectors_are_of_every_kind() -> None:
    """The tests below rely on it."""
    wanted, kernel = expected(HOVER, "relu", MANY), policies.kernel(HOVER)
    assert len(wanted.obs) == len(wanted.obs_i16) == MANY
    assert min(np.bincount(wanted.outputs.status, minlength=3)) > 100
    assert min(np.bincount(wanted.outputs.status_i16, minlength=2)) > 500
    low, high = ((steps * kernel.lsb).astype(np.float32) for steps in (kernel.obs_min, kernel.obs_max))
    for vector in (low, high, 0 * high):
        assert (wanted.obs == vector).all(axis=1).any()
    for value in (0, 32767, -32767, -32768):
        assert (wanted.obs_i16 == value).all(axis=1).any()
    assert ((wanted.obs_i16 == kernel.obs_min) | (wanted.obs_i16 == kernel.obs_max)).all(axis=1).sum() > 100
    size = np.abs(wanted.obs)
    assert ((size > 0) & (size < 1.17e-38)).any()
    assert np.isnan(wanted.obs).any(axis=0).all()
    assert np.isinf(wanted.obs).any(axis=0).all()
    act = wanted.outputs.act_i16
    assert ((act == kernel.act_min).any(axis=0) & (act == kernel.act_max).any(axis=0)).all()
    assert len(np.unique(act, axis=0)) > MANY // 4


def test_the_least_number_leaves_some_of_each_random_kind() -> None:
    """By what another seed changes; half are of flights."""
    policy, kernel, n = policies.remembering("recurrent"), policies.remembering_kernel("recurrent"), vectors.least(24)
    one, other = (vectors.observations(policy, kernel, n, seed)[n // 2 :].view(np.uint32) for seed in (0, 1))
    assert (one != other).any(axis=1).sum() == 40


# -- on this machine -----------------------------------------------------------------------------------------

HOST_FLAGS = {
    "strict": STRICT,
    "firmware": FIRMWARE,
    "-O0": ("-std=c99", "-O0"),
    "-O3 fast": ("-std=c99", "-O3", "-ffast-math", "-ffp-contract=fast", "-march=native"),
    "-Os": ("-std=gnu17", "-Os", "-fno-strict-aliasing", "-funsigned-char"),
    "sanitized": SANITIZED,
    "x87": ("-std=c99", "-O2", "-mfpmath=387"),
    "32 bits, x87": ("-std=c99", "-O2", "-m32", "-mfpmath=387"),
}


def builds(flags: tuple[str, ...], folder: Path) -> bool:
    """Whether programs can be compiled and run so here."""
    compiler = targets.host_compiler()
    (folder / "probe.c").write_text("#include <stdio.h>\n#include <stdint.h>\nint main(void) { return 0; }\n")
    command = [str(compiler), *flags, "probe.c", "-o", "probe"]
    built = subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0
    return built and subprocess.run(["./probe"], cwd=folder, check=False).returncode == 0


@pytest.mark.usefixtures("host")
@BOTH
@pytest.mark.parametrize("how", HOST_FLAGS)
def test_the_host_gives_the_references_bits(how: str, activation: str, kernel_of: KernelOf, tmp_path: Path) -> None:
    flags = HOST_FLAGS[how]
    if how not in ("strict", "firmware", "-O0") and not builds(flags, tmp_path):
        pytest.skip(f"this compiler cannot do {' '.join(flags)}")
    wanted = expected(HOVER, activation, MANY)
    found = targets.run_host(kernel_of(HOVER, activation), tmp_path, flags, wanted.observations)
    assert_same(found, wanted.outputs)


@EITHER
@pytest.mark.parametrize("sizes", SMALL, ids=str)
def test_odd_shapes_give_the_references_bits(
    sizes: tuple[int, ...], core: Core | None, kernel_of: KernelOf, tmp_path: Path
) -> None:
    """Sizes that are no multiple of four, one input layer alone, one output."""
    for activation in ("relu", "tanh"):
        wanted, source = expected(sizes, activation, FEW), kernel_of(sizes, activation)
        if core is None:
            found = targets.run_host(source, tmp_path, SANITIZED, wanted.observations)
        else:
            found, _ = targets.run_core(core, source, tmp_path, RELEASE, wanted.observations)
        assert_same(found, wanted.outputs)


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("sign", [1, -1])
def test_a_range_may_be_without_zero(sign: int, tmp_path: Path) -> None:
    """Of an input of mean ±1.3 and deviation 0.05, standardized and clipped at ten deviations."""
    policy = policies.policy(ODD)
    calibration, offset, gain = (
        x.copy() for x in (policy.calibration, policy.observation_offset, policy.observation_gain)
    )
    calibration[:, 3] = sign * (1.3 + calibration[:, 3] - offset[3])
    offset[3], gain[3] = sign * 1.3, 20.0
    policy = replace(policy, calibration=calibration, observation_offset=offset, observation_gain=gain)
    kernel = quantize(policy)
    edges = np.array([kernel.obs_min[3], kernel.obs_max[3]]) * kernel.lsb[3]
    np.testing.assert_allclose(np.abs(edges).min(), 0.8, atol=kernel.lsb[3])
    wanted = vectors.draw(policy, kernel, FEW)
    found = targets.run_host(policies.emitted(tmp_path, policy, kernel), tmp_path, SANITIZED, wanted.observations)
    assert_same(found, wanted.outputs)
    obs = calibration[:1].repeat(3, axis=0)
    obs[:, 3] = [0.0, sign * 0.7, sign * 0.79]
    status, action = policies.step(kernel, obs)
    np.testing.assert_array_equal(status, 1)
    np.testing.assert_array_equal(action, action[:1].repeat(3, axis=0))


# -- on the cores --------------------------------------------------------------------------------------------

Cases = dict[tuple[str, str], tuple[Outputs, Counts, targets.Sizes]]


# Policies of hover, and how many vectors: one on all cores, the other on one for each body.
ON_CORES = {("relu", core): MANY if core in BODIES else SOME // core.share for core in CORES}
ON_CORES |= {("tanh", core): SOME for core in BODIES}
EACH_CASE = pytest.mark.parametrize(
    ("activation", "core"),
    ON_CORES,
    indirect=["core"],
    ids=[f"{activation}-{core.name}" for activation, core in ON_CORES],
)


@pytest.fixture(scope="module")
def cases(kernel_of: KernelOf, tmp_path_factory: pytest.TempPathFactory) -> Cases:
    need([tool for toolchain in TOOLCHAINS for tool in targets.missing_tools(toolchain)])
    work = tmp_path_factory.mktemp("cores")

    def run(case: tuple[str, Core]) -> tuple[Outputs, Counts, targets.Sizes]:
        activation, core = case
        source, wanted = kernel_of(HOVER, activation), expected(HOVER, activation, ON_CORES[case])
        outputs, counts = targets.run_core(core, source, work, RELEASE, wanted.observations)
        return outputs, counts, targets.size(core, source, work)

    for (activation, _), n in ON_CORES.items():  # before the threads: what is cached is made once
        kernel_of(HOVER, activation)
        expected(HOVER, activation, n)
    with ThreadPoolExecutor(2) as pool:
        return {(a, c.name): case for (a, c), case in zip(ON_CORES, pool.map(run, ON_CORES), strict=True)}


@EACH_CASE
def test_every_core_gives_the_references_bits(activation: str, core: Core, cases: Cases) -> None:
    wanted = expected(HOVER, activation, ON_CORES[activation, core])
    assert_same(cases[activation, core.name][0], wanted.outputs)


BARS = {"M0": (26_500, 25_500), "M3": (18_500, 18_000), "M4F": (10_600, 10_200), "M7": (10_600, 10_200)}
BARS |= {"M33": BARS["M4F"], "M55": (4_000, 3_700), "RV32IMC": (25_000, 24_000), "RV32EC": (420_000, 420_000)}


@EACH_CASE
def test_it_costs_no_more_than_the_bars(activation: str, core: Core, cases: Cases) -> None:
    """Instructions: mean over flights. Flash, stack, static RAM: of the whole object, and of each entry."""
    _, counts, size = cases[activation, core.name]
    step, step_i16 = BARS[core.name]
    flights = slice(0, len(counts.i16) // 2)
    least = 5_504 / (8 if core is M55 else 2)  # multiply-adds an instruction at best
    assert least < counts.i16[flights].mean() <= step_i16
    assert least < counts.f32[flights].mean() <= step
    assert size.text + size.data <= (9_472 if core in (RV32IMC, RV32EC) else 8_960)
    assert (size.data, size.bss) == (0, 0)
    assert 0 < counts.stack_f32 <= 512
    assert 0 < counts.stack_i16 <= 512


@EACH_CASE
def test_the_time_it_takes_hardly_varies(activation: str, core: Core, cases: Cases) -> None:
    """Fixed trip counts: whatever is observed, within a twentieth of the mean; what is not finite ends early. A core
    without a multiplier takes longer for larger numbers.
    """
    _, counts, _ = cases[activation, core.name]
    wanted = expected(HOVER, activation, ON_CORES[activation, core])
    for each in (counts.i16, counts.f32[wanted.outputs.status < 2]):
        assert np.ptp(each) < (1.0 if core is RV32EC else 0.1) * each.mean()
    assert counts.f32[wanted.outputs.status == 2].max() < counts.f32.mean()


@pytest.mark.parametrize("core", [M0, M4F, M55], ids=["M0", "M4F", "M55"], indirect=True)
@pytest.mark.parametrize("flags", [("-Os",), ("-O0",), FIRMWARE], ids=" ".join)
@BOTH
def test_the_assembly_bears_any_optimization(
    activation: str,
    flags: tuple[str, ...],
    core: Core,
    kernel_of: KernelOf,
    tmp_path: Path,
) -> None:
    wanted = expected(HOVER, activation, FEW)
    found, _ = targets.run_core(core, kernel_of(HOVER, activation), tmp_path, flags, wanted.observations)
    assert_same(found, wanted.outputs)


@pytest.mark.usefixtures("cross")
@pytest.mark.parametrize(
    ("cpu", "instruction"),
    [
        ("cortex-m4", "smlad"),
        ("cortex-m7", "smlad"),
        ("cortex-m33", "smlad"),
        ("cortex-m55", "vmladava.s16"),
        ("cortex-m0plus", "muls"),
        ("cortex-m23", "muls"),
        ("cortex-m3", "mla"),
    ],
)
def test_each_core_gets_its_body(cpu: str, instruction: str, kernel_of: KernelOf, tmp_path: Path) -> None:
    """And the strictest warnings hold for all four."""
    source = kernel_of(HOVER, "tanh")
    command = ["arm-none-eabi-gcc", *STRICT, f"-mcpu={cpu}", "-mthumb", "-S", str(source), "-o", "kernel.s"]
    command += ["-mfloat-abi=hard"] if cpu == "cortex-m55" else []
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assembly = (tmp_path / "kernel.s").read_text()
    assert re.search(rf"^\s+{instruction}\b", assembly, re.MULTILINE)
    assert ("smlad" in assembly) == (instruction == "smlad")


def test_cppcheck_finds_nothing(kernel_of: KernelOf) -> None:
    need([] if shutil.which("cppcheck") else ["cppcheck"])
    for sizes, activation in ((HOVER, "relu"), (ODD, "tanh")):
        # Members that only align, or that one body of four does not use.
        command = ["cppcheck", "--quiet", "--error-exitcode=3", "--std=c99"]
        command += ["--enable=warning,style,performance,portability", "--suppress=unusedStructMember"]
        command += ["--suppress=missingIncludeSystem", "hover.c"]
        done = subprocess.run(
            command, cwd=kernel_of(sizes, activation).parent, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


# -- bad input -----------------------------------------------------------------------------------------------


@EITHER
def test_bad_input_is_answered(core: Core | None, kernel_of: KernelOf, tmp_path: Path) -> None:
    """Not finite: 2 and hover thrust, wherever it stands and however -ffast-math would have it; too far: 1."""
    policy, kernel = policies.policy(HOVER), policies.kernel(HOVER)
    good = policy.calibration[:1].repeat(18, axis=0)
    rows, each = np.arange(18), []
    for value in (np.nan, -np.nan, np.inf, -np.inf):
        each.append(good.copy())
        each[-1][rows, rows] = value
    far = good.copy()
    far[rows, rows] = 1.01 * np.where(rows % 2, kernel.obs_max, kernel.obs_min) * kernel.lsb
    obs, steps = np.concatenate([*each, far, good]), np.zeros((1, 18), np.int16)
    if core is None:
        found = targets.run_host(kernel_of(HOVER, "relu"), tmp_path, FIRMWARE, Observations(obs, steps))
    else:
        found, _ = targets.run_core(core, kernel_of(HOVER, "relu"), tmp_path, FIRMWARE, Observations(obs, steps))
    np.testing.assert_array_equal(found.status, np.repeat([2, 2, 2, 2, 1, 0], 18))
    np.testing.assert_allclose(found.act[:72], 0.667 * 9.81 / 4, rtol=1e-3)
    assert np.isfinite(found.act).all()
    saturated = good.copy()
    saturated[rows, rows] = np.where(rows % 2, kernel.obs_max, kernel.obs_min) * kernel.lsb
    np.testing.assert_array_equal(found.act[72:90], policies.step(kernel, saturated)[1])


# -- verification is able to fail -------------------------------------------------------------------------------


@pytest.fixture
def no_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "missing_tools", lambda _: ["the cross compiler"])


@pytest.mark.usefixtures("host", "no_cores")
def test_a_sound_kernel_passes(kernel_of: KernelOf) -> None:
    report = verify(policies.policy(ODD), policies.kernel(ODD), kernel_of(ODD, "relu"), FEW)
    assert report.passed == ["host, -O2", "host, -O3 -ffast-math"]
    assert report.skipped == [
        f"{family} and its costs: the cross compiler not found" for family in ("Cortex-M", "RISC-V")
    ]
    assert (report.costs, report.vectors) == ([], FEW)


@pytest.mark.usefixtures("cross", "host")
def test_every_target_is_verified_and_measured(kernel_of: KernelOf) -> None:
    report = verify(policies.policy(ODD, "tanh"), policies.kernel(ODD, "tanh"), kernel_of(ODD, "tanh"), 300)
    slow = f"RV32EC ({vectors.least(5)} of them)"
    assert report.passed == ["host, -O2", "host, -O3 -ffast-math", *(core.name for core in CORES[:-1]), slow]
    assert report.skipped == []
    assert [cost.core for cost in report.costs] == list(CORES)
    for cost in report.costs:
        assert 100 < cost.step_i16[0] < cost.step[0] <= cost.step[1]
        assert cost.static_ram == 0


def changed(kernel: Kernel, layer: int, **values: np.ndarray | int) -> Kernel:
    layers = list(kernel.layers)
    layers[layer] = replace(layers[layer], **values)
    return replace(kernel, layers=tuple(layers))


def bumped(kernel: Kernel, layer: int, what: str, by: int = 1) -> Kernel:
    values = getattr(kernel.layers[layer], what).copy()
    values.flat[0] += by if values.flat[0] < 127 or what != "weight" else -by
    return changed(kernel, layer, **{what: values})


def without_rounding(layer: Dense) -> np.ndarray:
    """Biases without the half that rounds."""
    return layer.bias - np.round(2.0 ** (15 + layer.shift) / layer.multiplier).astype(np.int64)


FAULTS: dict[str, Callable[[Kernel], Kernel]] = {
    "a weight of the first layer": lambda k: bumped(k, 0, "weight"),
    "a weight of the last layer": lambda k: bumped(k, -1, "weight"),
    "a bias of the first layer": lambda k: bumped(k, 0, "bias"),
    "a bias of the last layer": lambda k: bumped(k, -1, "bias"),
    "a multiplier": lambda k: bumped(k, 1, "multiplier"),
    "a shift": lambda k: changed(k, 1, shift=k.layers[1].shift ^ 1),
    "rounding": lambda k: changed(k, -1, bias=without_rounding(k.layers[-1])),
    "a limit": lambda k: replace(k, obs_max=k.obs_max - (np.arange(len(k.obs_max)) == 0)),
    "a scale": lambda k: replace(k, scale=k.scale - (np.arange(len(k.scale)) == 1)),
    "an exponent": lambda k: replace(k, exponent=k.exponent + (np.arange(len(k.scale)) == 0)),
    "the safe action": lambda k: replace(k, act_safe=np.nextafter(k.act_safe, np.float32(9))),
    "the step of an action": lambda k: replace(k, act_lsb=np.nextafter(k.act_lsb, np.float32(9))),
    "the least action": lambda k: replace(k, act_min=k.act_min + 1),
    "the activation": lambda k: replace(k, activation="tanh"),
}


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS.keys())
def test_one_step_of_a_difference_fails_verification(fault: Callable[[Kernel], Kernel], tmp_path: Path) -> None:
    """Emitted from another kernel than the reference; its golden vectors do not reveal it."""
    policy, kernel = policies.policy(ODD), policies.kernel(ODD)
    other = fault(kernel)
    source = policies.emitted(tmp_path, policy, other)
    wanted = expected(ODD, "relu", FEW)
    found = targets.run_host(source, tmp_path, ("-O0",), wanted.observations)
    assert found.selftest == 0
    with pytest.raises(VerificationFailed, match=r"^here: .*step.* differs from the reference in"):
        compare("here", found, wanted.outputs)


@pytest.mark.usefixtures("host", "no_cores")
def test_the_verification_of_another_kernel_fails(tmp_path: Path) -> None:
    policy, kernel = policies.policy(ODD), policies.kernel(ODD)
    other = bumped(kernel, -1, "bias")
    source = policies.emitted(tmp_path, policy, other)
    verify(policy, other, source, FEW)
    with pytest.raises(VerificationFailed, match=r"^host, -O2: step differs from the reference in"):
        verify(policy, kernel, source, FEW)


SOURCE_FAULTS = {
    "no saturation": ("z > 32767 ? 32767 : z < least ? least : z", "z"),
    "rounds down": ("+ 1u) / 2u", ") / 2u"),
    "infinity passes": ("exponent == 255", "in.real != in.real"),
    "status of a clip": ("        return 1;\n", "        return 0;\n"),
    "an input out of place": ("put(a.one + i,", "put(a.one + (i ^ 1),"),
    "an action out of place": ("((int16_t *)act)[i] = steps", "((int16_t *)act)[i ^ 1] = steps"),
}


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("fault", SOURCE_FAULTS.values(), ids=SOURCE_FAULTS.keys())
def test_a_slip_in_the_source_shows(fault: tuple[str, str], tmp_path: Path) -> None:
    policy, kernel = policies.policy(FLAT), policies.kernel(FLAT)
    narrow = kernel.layers[0]  # its outputs pass 16 bits now and then
    kernel = replace(kernel, layers=(replace(narrow, multiplier=narrow.multiplier, shift=max(narrow.shift - 3, 0)),))
    source = policies.emitted(tmp_path, policy, kernel)
    text = source.read_text()
    assert fault[0] in text
    source.write_text(text.replace(*fault))
    wanted = vectors.draw(policy, kernel, FEW)
    found = targets.run_host(source, tmp_path, ("-O0",), wanted.observations)
    with pytest.raises(VerificationFailed, match="differs from the reference"):
        compare("here", found, wanted.outputs)


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("table", ["obs", "obs_i16", "act_i16", "status"])
def test_the_self_test_reads_its_table(table: str, tmp_path: Path) -> None:
    """With another entry in a golden vector it fails, and so does verification; all outputs are right."""
    policy, kernel = policies.policy(ODD), policies.kernel(ODD)
    golden = vectors.golden(policy, kernel)
    part = golden if table.startswith("obs") else golden.outputs
    values = getattr(part, table).copy()
    values[1] = values[0] if part is golden else values[1] + 1
    part = part._replace(**{table: values})
    golden = part if isinstance(part, Vectors) else golden._replace(outputs=part)
    source = policies.emitted(tmp_path, policy, kernel, golden)
    wanted = expected(ODD, "relu", FEW)
    found = targets.run_host(source, tmp_path, ("-O0",), wanted.observations)
    assert found.selftest == 2
    with pytest.raises(VerificationFailed, match=r"here: the self-test failed \(2\)"):
        compare("here", found, wanted.outputs)


def test_a_difference_is_named() -> None:
    wanted = outputs = expected(ODD, "relu", FEW).outputs
    compare("M0", outputs, wanted)
    for name, value in (("status", 1), ("status_i16", 1), ("act_i16", 1)):
        wrong = getattr(wanted, name).copy()
        wrong[7] += value
        with pytest.raises(VerificationFailed, match=r"M0: .*_i16" if "i16" in name else "M0: status of .*in vector 7"):
            compare("M0", outputs._replace(**{name: wrong}), wanted)
    bit = wanted.act.copy()
    bit.view(np.int32)[9, 1] ^= 1
    with pytest.raises(VerificationFailed, match=r"M0: step differs .* in 1 places, first in vector 9"):
        compare("M0", outputs._replace(act=bit), wanted)
    with pytest.raises(VerificationFailed, match=r"M0: status of step: expected .* values, found"):
        compare("M0", outputs._replace(status=wanted.status[1:]), wanted)
    with pytest.raises(VerificationFailed, match=r"M0: the self-test failed \(-7\)"):
        compare("M0", outputs._replace(selftest=-7), wanted)

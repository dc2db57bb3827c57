"""Runs on targets are tested with a small kernel of known outputs, costs and stack, and with kernels of one fault.

Without the cross compiler or QEMU the target's tests are skipped; QRL_REQUIRE_CROSS=1 makes that a failure.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from cross_targets import EACH, EITHER, M0, M3, M4F, M7, M33, M55, need
from qrl.export import targets
from qrl.export.targets import CORES, FIRMWARE, RELEASE, STRICT, Core, Counts, VerificationFailed
from qrl.export.vectors import Observations, Outputs

HEADER = """\
#include <stdint.h>
#define SOUND_OBS_SIZE {obs}
#define SOUND_ACT_SIZE {act}
typedef struct {{
    int16_t steps;
    uint8_t sign;
}} sound_state;
void sound_reset(sound_state *state);
int sound_step(sound_state *state, const float obs[SOUND_OBS_SIZE], float act[SOUND_ACT_SIZE]);
int sound_step_i16(sound_state *state, const int16_t obs[SOUND_OBS_SIZE], int16_t act[SOUND_ACT_SIZE]);
int sound_selftest(void);
"""
# Copies, with statuses: float to float by bits, int16 to int16 after a loop of 2 * rounds instructions.
# The state counts the steps since the last reset. F32_STACK bytes of stack in one entry, I16_STACK in the other.
SOUND = """\
#include "sound.h"
#include <string.h>
#define F32_STACK 1000
#define I16_STACK 200

void sound_reset(sound_state *state)
{
    state->steps = 0;
    state->sign = 0;
}

int sound_step(sound_state *state, const float obs[SOUND_OBS_SIZE], float act[SOUND_ACT_SIZE])
{
    volatile uint8_t touched[F32_STACK];
    for (int i = 0; i < F32_STACK; i++) {
        touched[i] = 0;
    }
    memcpy(act, obs, sizeof(float) * SOUND_ACT_SIZE);
    state->steps++;
    /* end of f32 */
    return touched[0] + (obs[0] > 0.0f);
}

int sound_step_i16(sound_state *state, const int16_t obs[SOUND_OBS_SIZE], int16_t act[SOUND_ACT_SIZE])
{
    volatile uint8_t touched[I16_STACK];
    for (int i = 0; i < I16_STACK; i++) {
        touched[i] = 0;
    }
#ifdef __arm__
    uint32_t rounds = (uint32_t)(obs[0] & 0xff) + 1u;
    __asm__ volatile(".syntax unified\\n1: subs %0, #1\\n bne 1b" : "+l"(rounds) : : "cc");
#elif defined(__riscv)
    uint32_t rounds = (uint32_t)(obs[0] & 0xff) + 1u;
    __asm__ volatile("1: addi %0, %0, -1\\n bnez %0, 1b" : "+r"(rounds));
#endif
    memcpy(act, obs, sizeof(int16_t) * SOUND_ACT_SIZE);
    state->steps++;
    /* end of i16 */
    return touched[0] + (obs[0] > 0 ? 2 : 0);
}

int sound_selftest(void)
{
    /* selftest */
    return 0;
}
"""
VECTORS = 301  # more than ten chunks, the last one partly filled
RNG = np.random.default_rng(0)
OBS_F32 = RNG.integers(0, 2**32, (VECTORS, 18), np.uint32).view(np.float32)  # any bits: infinities and NaN among them
OBS_I16 = RNG.integers(-(2**15), 2**15, (VECTORS - 7, 18), np.int16)
LENGTH = 20  # steps from one reset to the next
GIVEN = Observations(OBS_F32, OBS_I16, LENGTH)
ODD = 77  # the vector that faults wait for


def write(folder: Path, *faults: tuple[str, str], obs: int = 18, act: int = 4) -> Path:
    """The sound kernel, with each (old, new) replaced; the path of its C."""
    source = SOUND
    for old, new in faults:
        assert old in source
        source = source.replace(old, new)
    folder.mkdir(exist_ok=True)
    (folder / "sound.h").write_text(HEADER.format(obs=obs, act=act), encoding="utf-8")
    (folder / "sound.c").write_text(source, encoding="utf-8")
    return folder / "sound.c"


class Case(NamedTuple):
    run: Outputs
    counts: Counts


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    """The sound kernel on every core, all started at once."""
    need([tool for toolchain in (targets.CORTEX_M, targets.RISC_V) for tool in targets.missing_tools(toolchain)])
    work = tmp_path_factory.mktemp("sound")
    kernel = write(work / "kernel")

    def run(core: Core) -> Case:
        return Case(*targets.run_core(core, kernel, work, RELEASE, GIVEN))

    with ThreadPoolExecutor(len(CORES)) as pool:
        return dict(zip((core.name for core in CORES), pool.map(run, CORES), strict=True))


def on(core: Core | None, kernel: Path, work: Path) -> Outputs:
    """`kernel` on a core, or on the host where there is none."""
    if core is None:
        return targets.run_host(kernel, work, RELEASE, GIVEN)
    return targets.run_core(core, kernel, work, RELEASE, GIVEN)[0]


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32).view(np.uint32)


def assert_sound(run: Outputs, *, statuses: bool = True) -> None:
    np.testing.assert_array_equal(bits(run.act), bits(OBS_F32[:, :4]))
    np.testing.assert_array_equal(run.act_i16, OBS_I16[:, :4])
    np.testing.assert_array_equal(run.status_i16, 2 * (OBS_I16[:, 0] > 0))
    for state, n in ((run.state, len(OBS_F32)), (run.state_i16, len(OBS_I16))):
        assert state.shape == (n, 4)
        np.testing.assert_array_equal(np.ascontiguousarray(state[:, :2]).view("<i2")[:, 0], np.arange(n) % LENGTH + 1)
        assert not state[:, 2].any()
    if statuses:
        np.testing.assert_array_equal(run.status, (OBS_F32[:, 0] > 0).astype(int))
    assert run.selftest == 0


@EACH
def test_every_output_comes_back_from_a_core(core: Core, cases: dict[str, Case]) -> None:
    assert_sound(cases[core.name].run)


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize(
    "flags", [STRICT, FIRMWARE, (*RELEASE, "-fsanitize=address,undefined", "-fno-sanitize-recover")]
)
def test_every_output_comes_back_from_the_host(flags: tuple[str, ...], tmp_path: Path) -> None:
    run = targets.run_host(write(tmp_path / "kernel"), tmp_path, flags, GIVEN)
    assert_sound(run, statuses="-ffast-math" not in flags)  # where a comparison with NaN may say anything


@EITHER
def test_one_output_and_an_odd_layout(core: Core | None, tmp_path: Path) -> None:
    kernel = write(tmp_path / "kernel", obs=3, act=1)
    obs_f32, obs_i16 = OBS_F32[:, :3], OBS_I16[:, 4:7]
    if core is None:
        run = targets.run_host(kernel, tmp_path, RELEASE, Observations(obs_f32, obs_i16))
    else:
        run = targets.run_core(core, kernel, tmp_path, FIRMWARE, Observations(obs_f32, obs_i16))[0]
    np.testing.assert_array_equal(bits(run.act), bits(obs_f32[:, :1]))
    np.testing.assert_array_equal(run.act_i16, obs_i16[:, :1])


@EITHER
def test_one_lsb_shows(core: Core | None, tmp_path: Path) -> None:
    flip = f"if (memcmp(&act[1], &(uint32_t){{{bits(OBS_F32)[ODD, 1]}u}}, 4) == 0) {{ ((uint8_t *)&act[2])[0] ^= 1; }}"
    add = f"if (obs[0] == {OBS_I16[ODD, 0]} && obs[1] == {OBS_I16[ODD, 1]}) {{ act[3] ^= 1; }}"
    kernel = write(tmp_path / "kernel", ("/* end of f32 */", flip), ("/* end of i16 */", add))
    run = on(core, kernel, tmp_path)
    assert np.argwhere(bits(run.act) != bits(OBS_F32[:, :4])).tolist() == [[ODD, 2]]
    assert np.argwhere(run.act_i16 != OBS_I16[:, :4]).tolist() == [[ODD, 3]]


@EITHER
def test_outputs_left_alone_show(core: Core | None, tmp_path: Path) -> None:
    run = on(core, write(tmp_path / "kernel", ("* SOUND_ACT_SIZE", "* (SOUND_ACT_SIZE - 1)")), tmp_path)
    assert set(bits(run.act)[:, 3]) == {0xA5A5A5A5}
    assert set(run.act_i16.view(np.uint16)[:, 3]) == {0xA5A5}


@EITHER
@pytest.mark.parametrize("entry", ["f32", "i16"])
def test_a_write_beyond_the_outputs_fails(entry: str, core: Core | None, tmp_path: Path) -> None:
    beyond = f"volatile int four = SOUND_ACT_SIZE; if (obs[0] == obs[0]) {{ act[four] = 0; }} /* end of {entry} */"
    kernel = write(tmp_path / "kernel", (f"/* end of {entry} */", beyond))
    with pytest.raises(VerificationFailed, match=rf"{'step_i16' if entry == 'i16' else 'step'} writes past the end"):
        on(core, kernel, tmp_path)


@EITHER
@pytest.mark.parametrize("entry", ["f32", "i16"])
def test_a_write_beyond_the_state_fails(entry: str, core: Core | None, tmp_path: Path) -> None:
    beyond = f"volatile int one = 1; state[one].steps = 0; /* end of {entry} */"
    kernel = write(tmp_path / "kernel", (f"/* end of {entry} */", beyond))
    with pytest.raises(VerificationFailed, match=rf"{'step_i16' if entry == 'i16' else 'step'} writes past .*state"):
        on(core, kernel, tmp_path)


@EITHER
def test_a_reset_that_leaves_something_out_shows(core: Core | None, tmp_path: Path) -> None:
    run = on(core, write(tmp_path / "kernel", ("state->sign = 0;", "")), tmp_path)
    assert set(run.state[:, 2]) == {0xA5}


@EITHER
def test_a_crash_fails(core: Core | None, tmp_path: Path) -> None:
    crash = f"if (obs[1] == {OBS_I16[ODD, 1]}) {{ void (*volatile nothing)(void) = 0; nothing(); }}"
    kernel = write(tmp_path / "kernel", ("/* end of i16 */", crash))
    with pytest.raises(VerificationFailed, match="host: the run failed .signal" if core is None else "processor fault"):
        on(core, kernel, tmp_path)


@EITHER
def test_a_hang_fails(core: Core | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "TIMEOUT_S", 0.7)
    hang = f'while (obs[1] == {OBS_I16[ODD, 1]}) {{ __asm__ volatile(""); }}'
    kernel = write(tmp_path / "kernel", ("/* end of i16 */", hang))
    with pytest.raises(VerificationFailed, match=r"timed out after 0.7 s"):
        on(core, kernel, tmp_path)


@EITHER
def test_the_selftests_answer_is_passed_on(core: Core | None, tmp_path: Path) -> None:
    assert on(core, write(tmp_path / "kernel", ("return 0;", "return -7;")), tmp_path).selftest == -7


# All that the host's reader needs.
LINE = f"obs=18 act=4 state=4 vectors_f32={len(OBS_F32)} vectors_i16={len(OBS_I16)} selftest=0"


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize(
    ("selftest", "words"),
    [
        ("exit(0);", "expected one result line, found 0"),
        ("exit(3);", r"the run failed \(exit 3\)"),
        (f'fputs("qrl-result: {LINE}\\n", stderr);', "expected one result line, found 2"),
        (f'fputs("qrl-result: {LINE}\\n", stderr); _exit(0);', "out.bin: expected"),
        (f'fputs("qrl-result: {LINE.replace("=18", "=3")}\\n", stderr); _exit(0);', "obs: expected 18, found 3"),
        (
            f'fputs("qrl-result: {LINE.replace("f32=3", "f32=2")}\\n", stderr); _exit(0);',
            "vectors_f32: expected 301",
        ),
    ],
)
def test_an_end_that_is_not_the_harnesss_own_fails(selftest: str, words: str, tmp_path: Path) -> None:
    heads = ("#include <string.h>", "#include <stdio.h>\n#include <stdlib.h>\n#include <string.h>\n#include <unistd.h>")
    kernel = write(tmp_path / "kernel", heads, ("/* selftest */", selftest))
    with pytest.raises(VerificationFailed, match=words):
        targets.run_host(kernel, tmp_path, FIRMWARE, GIVEN)


@pytest.mark.usefixtures("cross")
def test_a_restart_on_a_core_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "TIMEOUT_S", 0.7)
    kernel = write(
        tmp_path / "kernel", ("/* selftest */", "void (**volatile reset)(void) = (void (**)(void))4; (*reset)();")
    )
    with pytest.raises(VerificationFailed, match=r"timed out after|processor fault"):
        on(M3, kernel, tmp_path)


@EITHER
def test_a_compilers_complaint_is_one_line(core: Core | None, tmp_path: Path) -> None:
    kernel = write(tmp_path / "kernel", ("/* selftest */", "int unused;"))
    with pytest.raises(VerificationFailed, match=r"gcc|cc|clang") as failure:
        on(core, kernel, tmp_path)
    assert "unused" in str(failure.value)
    assert "\n" not in str(failure.value)


@pytest.mark.usefixtures("cross")
@pytest.mark.parametrize("call", ["tanhf(obs[0])", "(uintptr_t)malloc((unsigned)obs[0])"])
def test_a_kernel_that_needs_more_than_libgcc_does_not_link(call: str, tmp_path: Path) -> None:
    heads = ("#include <string.h>", "#include <math.h>\n#include <stdlib.h>\n#include <string.h>")
    kernel = write(tmp_path / "kernel", heads, ("/* end of f32 */", f"act[0] = (float){call};"))
    with pytest.raises(VerificationFailed, match="undefined reference"):
        on(M3, kernel, tmp_path)


@EACH
def test_instructions_are_counted_for_each_call(core: Core, cases: dict[str, Case]) -> None:
    counts = cases[core.name].counts
    assert (counts.f32.shape, counts.i16.shape) == ((len(OBS_F32),), (len(OBS_I16),))
    fixed = counts.i16 - 2 * (OBS_I16[:, 0] & 0xFF)
    assert np.ptp(fixed) <= 2 * targets.CLOCK_ERROR
    # Two hundred stores in a loop of three to six instructions, then a copy.
    assert 3 * 200 < fixed.mean() < 6 * 200 + 100
    assert abs(counts.selftest - 2) <= targets.CLOCK_ERROR  # the zero, and the return


@EACH
def test_a_clock_of_another_speed_fails(core: Core, tmp_path: Path) -> None:
    wrong = core._replace(tick=core.tick * 1.01)
    with pytest.raises(VerificationFailed, match="its counter does not tick every"):
        on(wrong, write(tmp_path / "kernel"), tmp_path)


def test_the_clock_is_held_to_its_error() -> None:
    targets.check_clock(M0, {0: 3.0, 1000: 2003.0 + targets.CLOCK_ERROR})
    with pytest.raises(VerificationFailed, match="a loop of 2003 instructions was measured as 1994"):
        targets.check_clock(M0, {0: 3.0, 1000: 1994.0})


@EACH
def test_the_stack_of_each_entry_is_seen(core: Core, cases: dict[str, Case]) -> None:
    counts = cases[core.name].counts
    assert 1000 <= counts.stack_f32 <= 1064
    assert 200 <= counts.stack_i16 <= 264
    assert 0 <= counts.stack_selftest <= 16


@pytest.mark.parametrize("core", [M0, M7], ids=["M0", "M7"], indirect=True)
def test_a_stack_that_overflows_fails(core: Core, tmp_path: Path) -> None:
    kernel = write(tmp_path / "kernel", ("F32_STACK 1000", "F32_STACK 6200"))
    with pytest.raises(VerificationFailed, match=r"all of the stack|processor fault|the run failed .signal"):
        on(core, kernel, tmp_path)


@EACH
def test_sizes(core: Core, tmp_path: Path) -> None:
    tables = (
        "#define F32_STACK 1000",
        "#define F32_STACK 1000\nextern const int8_t weights[1000];\nconst int8_t weights[1000] = {1};\n"
        "extern int32_t three[3], sixteen[16];\nint32_t three[3] = {1, 2, 3};\nint32_t sixteen[16];",
    )
    small = targets.size(core, write(tmp_path / "small"), tmp_path)
    kernel = write(tmp_path / "kernel", tables, ("/* end of f32 */", "act[0] = obs[1] * obs[2];"))
    large = targets.size(core, kernel, tmp_path)
    assert (small.data, small.bss, large.data, large.bss) == (0, 0, 12, 64)
    assert 1000 <= large.text - small.text <= 1032
    if core in (M4F, M7, M33, M55):
        assert large.library == small.library
    else:
        assert large.library - small.library > 100  # a multiplication in software


def test_missing_tools_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for toolchain, prefix, emulator in (
        (targets.CORTEX_M, "arm-none-eabi-", "qemu-system-arm"),
        (targets.RISC_V, "riscv64-unknown-elf-", "qemu-system-riscv32"),
    ):
        assert targets.missing_tools(toolchain) == [f"{prefix}gcc", f"{prefix}size", emulator]
    with pytest.raises(VerificationFailed, match="no C compiler"):
        targets.run_host(tmp_path, tmp_path, RELEASE, GIVEN)

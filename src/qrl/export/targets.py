"""Compiles an emitted kernel and runs it on the host and, with instruction counts, on `CORES` under QEMU.

A kernel is given by the path of its NAME.c; NAME.h is beside it. `harness/harness.c` runs both entry points over files
of observations, writes all outputs and states to a file, and prints one result line at the end. A run without exactly
one result line and a complete output file raises VerificationFailed. Each run has its own folder, so runs may be
concurrent.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from qrl.export.vectors import Observations, Outputs

Floats = np.ndarray[tuple[int, ...], np.dtype[np.floating]]
Ints = np.ndarray[tuple[int, ...], np.dtype[np.integer]]

SOURCES = Path(__file__).parent / "harness"
WARNINGS = ("-Wall", "-Wextra", "-Werror")
STRICT = ("-std=c99", "-pedantic", *WARNINGS, "-Wconversion", "-Wsign-conversion", "-Wshadow", "-O2")
FIRMWARE = ("-std=gnu11", "-O3", "-ffp-contract=fast", "-ffast-math")  # the least careful build
RELEASE = ("-std=c99", "-O2", *WARNINGS)  # for sizes and instruction counts
TIMEOUT_S = 60.0
CLOCK_ERROR = 8  # instructions, per measured call: two rounds of the loops around it
KNOWN_ROUNDS = (1000, 12345)  # of a loop of known length, timed in each run
GUARD = 0xA5  # value of each byte after the outputs and the state, set by the harness
UNDER_TEST = """\
#include "{name}.h"

enum {{ OBS = {NAME}_OBS_SIZE, ACT = {NAME}_ACT_SIZE }};
typedef {name}_state kernel_state;
#define kernel_reset {name}_reset
#define kernel_step {name}_step
#define kernel_step_i16 {name}_step_i16
#define kernel_selftest {name}_selftest
"""


class Toolchain(NamedTuple):
    """What compiles for a family of cores and runs it."""

    family: str
    prefix: str  # of the compiler's tools
    emulator: str
    sources: tuple[str, str]  # of the harness: its platform and its linker script
    library: str  # a file of the C library that it needs


class Core(NamedTuple):
    """A QEMU machine, and what is assumed of a common chip with that core."""

    name: str
    toolchain: Toolchain
    machine: str
    flags: tuple[str, ...]
    tick: float  # instructions per tick of its counter under `-icount shift=0`
    origins: tuple[int, int]  # addresses of flash and RAM
    flash_bytes: int
    ram_bytes: int
    clock_MHz: int
    cycles_per_instruction: float
    share: int = 1  # of the inputs of a verification, it runs one in so many


_KIB, _MIB = 1 << 10, 1 << 20
_HARD = ("-mfloat-abi=hard", "-mthumb")
CORTEX_M = Toolchain(
    "Cortex-M", "arm-none-eabi-", "qemu-system-arm", ("cortex_m.c", "cortex_m.ld"), "libc.a"
)  # fmt: skip
RISC_V = Toolchain(
    "RISC-V", "riscv64-unknown-elf-", "qemu-system-riscv32", ("risc_v.c", "risc_v.ld"), "picolibc.specs"
)  # fmt: skip
_M4, _M7, _M33 = (
    (f"-mcpu=cortex-{name}", f"-mfpu={fpu}-sp-d16", *_HARD)
    for name, fpu in (("m4", "fpv4"), ("m7", "fpv5"), ("m33", "fpv5"))
)
_RV32IMC, _RV32EC = (
    (f"-march={march}", f"-mabi={abi}", "-specs=picolibc.specs")
    for march, abi in (("rv32imc", "ilp32"), ("rv32ec", "ilp32e"))
)
_LOW, _SECURE, _HIGH = (0, 0x2000_0000), (0x1000_0000, 0x3800_0000), (0x8000_0000, 0x8040_0000)
_BIG = (4 * _MIB, 4 * _MIB)
CORES = (
    Core("M0", CORTEX_M, "microbit", ("-mcpu=cortex-m0", "-mthumb"), 62.5, _LOW, 256 * _KIB, 16 * _KIB, 48, 1.5),
    Core("M3", CORTEX_M, "mps2-an385", ("-mcpu=cortex-m3", "-mthumb"), 40.0, _LOW, *_BIG, 72, 1.5),
    Core("M4F", CORTEX_M, "mps2-an386", _M4, 40.0, _LOW, *_BIG, 168, 1.3),
    Core("M7", CORTEX_M, "mps2-an500", _M7, 40.0, _LOW, *_BIG, 480, 1.0),
    Core("M33", CORTEX_M, "mps2-an505", _M33, 50.0, _SECURE, 4 * _MIB, 2 * _MIB, 150, 1.3),
    Core("M55", CORTEX_M, "mps3-an547", ("-mcpu=cortex-m55", *_HARD), 31.25, _LOW, 512 * _KIB, 512 * _KIB, 160, 1.2),
    Core("RV32IMC", RISC_V, "virt", _RV32IMC, 1.0, _HIGH, *_BIG, 160, 1.3),
    Core("RV32EC", RISC_V, "virt", _RV32EC, 1.0, _HIGH, *_BIG, 48, 1.5, share=10),  # it multiplies in software
)


class VerificationFailed(RuntimeError):
    """A kernel does not compile or run, or differs from the reference; in one line."""


class Counts(NamedTuple):
    """Instructions of each call, to within CLOCK_ERROR, and maximum stack of each entry point, libraries included."""

    f32: Floats  # float64 [N]
    i16: Floats  # float64 [M]
    selftest: float
    stack_f32: int  # bytes
    stack_i16: int
    stack_selftest: int


class Sizes(NamedTuple):
    """Bytes of the object file, and of the library code that it needs."""

    text: int
    data: int
    bss: int
    library: int


def host_compiler() -> str | None:
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def missing_tools(toolchain: Toolchain) -> list[str]:
    """Tools that `run_core` and `size` need for its cores and this machine does not have."""
    compiler = f"{toolchain.prefix}gcc"
    tools = compiler, f"{toolchain.prefix}size", toolchain.emulator
    missing = [tool for tool in tools if not shutil.which(tool)]
    if compiler not in missing:
        command = [compiler, f"-print-file-name={toolchain.library}"]
        library = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
        if not Path(library).is_absolute():  # the compiler names a file that it does not have without a folder
            missing.append(f"{toolchain.library} of a C library for {compiler}")
    return missing


def run_host(
    kernel: Path, work: Path, flags: Sequence[str], given: Observations, libraries: Sequence[str] = ()
) -> Outputs:
    """Outputs of `kernel` on this machine for the observations `given`, compiled with `flags`."""
    compiler = host_compiler()
    if compiler is None:
        raise VerificationFailed("no C compiler on this machine (cc, gcc or clang)")
    folder = _folder(kernel, work, "host", given)
    _build([compiler, *flags, *_sources(kernel, folder, "host.c"), *libraries, "-o", "kernel"], folder, "host")
    output = _run([str(folder.resolve() / "kernel")], folder, "host")
    return _read(folder, "host", kernel.stem, output, given)[0]


def run_core(
    core: Core, kernel: Path, work: Path, flags: Sequence[str], given: Observations, libraries: Sequence[str] = ()
) -> tuple[Outputs, Counts]:
    """Outputs and costs of `kernel` on `core`; linked with libc, libgcc and `libraries` only."""
    tools, folder = core.toolchain, _folder(kernel, work, core.name, given)
    platform, script = tools.sources
    values = dict(zip(("FLASH", "RAM"), core.origins, strict=True))
    symbols = {f"{name}_ORIGIN": value for name, value in values.items()}
    symbols |= {"FLASH_BYTES": core.flash_bytes, "RAM_BYTES": core.ram_bytes}
    memory = [f"-Wl,--defsym={name}={value}" for name, value in symbols.items()]
    link = ["-nostdlib", "-T", str(SOURCES / script), *memory, *libraries, "-lc", "-lgcc"]
    sources = _sources(kernel, folder, platform, "core.c")
    _build([f"{tools.prefix}gcc", *core.flags, *flags, *sources, *link, "-o", "kernel.elf"], folder, core.name)
    qemu = [tools.emulator, "-machine", core.machine, "-display", "none", "-monitor", "none", "-serial", "none"]
    semihosting = ["-icount", "shift=0", "-semihosting-config", "enable=on,target=native"]
    image = ["-bios", "none"] if tools is RISC_V else []
    output = _run([*qemu, *semihosting, *image, "-kernel", "kernel.elf"], folder, core.name)
    outputs, fields, elapsed = _read(folder, core.name, kernel.stem, output, given)
    return outputs, _counts(core, fields, elapsed)


def size(core: Core, kernel: Path, work: Path) -> Sizes:
    """Size of the object file of `kernel` on `core`, and of the library code that it needs."""
    folder = Path(tempfile.mkdtemp(prefix=f"{core.name}-size-", dir=work))
    compiler = [f"{core.toolchain.prefix}gcc", *core.flags]
    _build([*compiler, *RELEASE, "-c", str(kernel.resolve()), "-o", "kernel.o"], folder, core.name)
    entry = ["-nostdlib", f"-Wl,--entry={kernel.stem}_step"]
    _build([*compiler, *entry, "kernel.o", "-lc", "-lgcc", "-o", "linked.elf"], folder, core.name)
    (text, data, bss), linked = (_sections(core, folder / name) for name in ("kernel.o", "linked.elf"))
    return Sizes(text, data, bss, max(0, linked[0] - text))


def _sections(core: Core, path: Path) -> list[int]:
    table = _build([f"{core.toolchain.prefix}size", path.name], path.parent, core.name)
    return [int(number) for number in table.splitlines()[1].split()[:3]]


def _folder(kernel: Path, work: Path, name: str, given: Observations) -> Path:
    folder = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=work))
    length = np.array(given.length, "<i4").tobytes()
    (folder / "f32.bin").write_bytes(length + np.ascontiguousarray(given.obs, "<f4").tobytes())
    (folder / "i16.bin").write_bytes(length + np.ascontiguousarray(given.obs_i16, "<i2").tobytes())
    header = UNDER_TEST.format(name=kernel.stem, NAME=kernel.stem.upper())
    (folder / "kernel_under_test.h").write_text(header, encoding="utf-8")
    return folder


def _sources(kernel: Path, folder: Path, *platform: str) -> list[str]:
    places = [f"-I{folder.resolve()}", f"-I{kernel.resolve().parent}"]
    return [*places, str(kernel.resolve()), str(SOURCES / "harness.c"), *(str(SOURCES / name) for name in platform)]


def _build(command: list[str], folder: Path, where: str) -> str:
    """The command's stdout; its first line about an error, raised, if it fails."""
    environment = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        error = _first(done.stderr, "error|undefined|overflowed|will not fit")
        raise VerificationFailed(f"{where}: {Path(command[0]).name}: {error}")
    return done.stdout


def _first(text: str, pattern: str) -> str:
    """The first line with `pattern` in it, else the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["no output"]
    return next((line for line in lines if re.search(pattern, line)), lines[-1])[:300]


def _run(command: list[str], folder: Path, where: str) -> str:
    """The harness's stderr; VerificationFailed if it crashes or times out."""
    nothing = subprocess.DEVNULL
    try:
        done = subprocess.run(command, cwd=folder, stdin=nothing, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        raise VerificationFailed(f"{where}: timed out after {TIMEOUT_S:g} s") from None
    output = done.stderr.decode(errors="replace")
    if done.returncode:
        how = f"signal {-done.returncode}" if done.returncode < 0 else f"exit {done.returncode}"
        raise VerificationFailed(f"{where}: the run failed ({how}): {_first(output, 'qrl-error|ERROR|Lockup')}")
    return output


def _read(
    folder: Path, where: str, name: str, output: str, given: Observations
) -> tuple[Outputs, dict[str, int], tuple[Ints, Ints]]:
    """Outputs, the fields of the result line, and (ticks, spins) int32 [N, 2], [M, 2] of a complete run."""
    obs_f32, obs_i16 = given.obs, given.obs_i16
    lines = [line for line in output.splitlines() if line.startswith("qrl-result:")]
    if len(lines) != 1:
        raise VerificationFailed(f"{where}: expected one result line, found {len(lines)}")
    fields = {field: int(value) for field, value in re.findall(r"(\w+)=(-?\d+)", lines[0])}
    expected = {"obs": obs_f32.shape[1], "vectors_f32": len(obs_f32), "vectors_i16": len(obs_i16)}
    found = {field: fields.get(field) for field in expected}
    if wrong := [f"{field}: expected {n}, found {found[field]}" for field, n in expected.items() if found[field] != n]:
        raise VerificationFailed(f"{where}: {', '.join(wrong)}")
    layouts = [_layout(fields, kind) for kind in ("<f4", "<i2")]
    data, split = (folder / "out.bin").read_bytes(), len(obs_f32) * layouts[0].itemsize
    if len(data) != (length := split + len(obs_i16) * layouts[1].itemsize):
        raise VerificationFailed(f"{where}: out.bin: expected {length} bytes, found {len(data)}")
    f32, i16 = np.frombuffer(data[:split], layouts[0]), np.frombuffer(data[split:], layouts[1])
    for records, entry in ((f32, f"{name}_step"), (i16, f"{name}_step_i16")):
        for guard, what in (("guard", "outputs"), ("state_guard", "state")):
            if np.any(records[guard] != GUARD):
                raise VerificationFailed(f"{where}: {entry} writes past the end of its {what}")
    both = [each[part] for each in (f32, i16) for part in ("status", "act", "state")]
    return Outputs(*both, selftest=fields["selftest"]), fields, (f32["elapsed"], i16["elapsed"])


def _layout(fields: dict[str, int], kind: str) -> np.dtype:
    """A record of out.bin whose actions are of the type `kind`."""
    state, act = fields["state"], fields["act"]
    state_words, act_words = -(-state // 4) + 1, act + 2
    return np.dtype(
        [
            ("status", "<i4"),
            ("state", "u1", state),
            ("state_guard", "u1", 4 * state_words - state),
            ("act", kind, act),
            ("guard", "u1", 4 * act_words - act * np.dtype(kind).itemsize),
            ("elapsed", "<i4", 2),
        ]
    )


def _counts(core: Core, fields: dict[str, int], elapsed: tuple[Ints, Ints]) -> Counts:
    def field(name: str) -> float:
        return float(_instructions(core, np.array([fields[f"{name}_ticks"], fields[f"{name}_spins"]])))

    around = field("known_0") - known_instructions(0)  # overhead of the measurement
    check_clock(core, {rounds: field(f"known_{rounds}") - around for rounds in KNOWN_ROUNDS})
    f32, i16 = (_instructions(core, each) - around for each in elapsed)
    stacks = [fields[f"stack_{name}"] for name in ("f32", "i16", "selftest")]
    return Counts(f32, i16, field("selftest") - around, *stacks)


def _instructions(core: Core, elapsed: Ints) -> Floats:
    """(ticks, spins) [..., 2] -> instructions [...]: from edge to edge, minus the rounds spun after the call."""
    return elapsed[..., 0] * core.tick - elapsed[..., 1] * 4.0


def known_instructions(rounds: int) -> int:
    return 2 * rounds + 3


def check_clock(core: Core, measured: dict[int, float]) -> None:
    """Raise VerificationFailed unless `known` was measured at its length: rounds -> instructions."""
    for rounds, instructions in measured.items():
        if abs(instructions - known_instructions(rounds)) > CLOCK_ERROR:
            raise VerificationFailed(
                f"{core.name}: a loop of {known_instructions(rounds)} instructions was measured as {instructions:g}:"
                f" its counter does not tick every {core.tick:g} instructions here"
            )

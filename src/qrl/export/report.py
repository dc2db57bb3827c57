"""What an export measured, its gates, and report.md."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export.accuracy import Accuracy
from qrl.export.kernel import Kernel, accumulator_bound
from qrl.export.policy import Policy
from qrl.export.verify import VerificationReport


class FlightStats(NamedTuple):
    summary: dict[str, float]  # as in evaluation.json
    success: NDArray[np.bool_] | None  # [starts]; None if the task does not measure it
    jitter: float  # mean change of an action from step to step over the tail, as a fraction of full scale
    starts: int


@dataclass(frozen=True)
class Gate:
    name: str
    measured: float
    limit: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        return self.measured <= self.limit  # False for NaN

    def with_unit(self, value: float) -> str:
        return f"{value:.3g} {self.unit}".strip()

    def __str__(self) -> str:
        return f"{self.name}: {self.with_unit(self.measured)} (limit {self.with_unit(self.limit)})"


@dataclass(frozen=True)
class Measured:
    accuracy: Accuracy
    float_flights: FlightStats
    integer_flights: FlightStats
    verification: VerificationReport


def gates(measured: Measured) -> list[Gate]:
    """Limits on the action error, on failures, and on how much worse the integer policy flies than the float one."""
    before, after = measured.float_flights, measured.integer_flights
    loss = (before.summary["return_mean"] - after.summary["return_mean"]) / abs(before.summary["return_mean"] or 1.0)
    found = [
        Gate("RMS action error", 100 * measured.accuracy.rmse, 1.0, "%"),
        Gate("max action error", 100 * measured.accuracy.maximum, 5.0, "%"),
        Gate("return lost", 100 * loss, 0.25, "%"),
        Gate("jitter added", 100 * (after.jitter - before.jitter), 0.2, "% per step"),
    ]
    if before.success is not None and after.success is not None:
        lost, gained = int(np.sum(before.success & ~after.success)), int(np.sum(after.success & ~before.success))
        found.append(Gate("starts from which it fails", 100 * (1.0 - float(after.success.mean())), 5.0, "%"))
        found.append(Gate(f"successful starts lost (of {before.starts:,}; {gained} gained)", lost, 0))
    for name, value in before.summary.items():
        if name.startswith("rms_") and name.endswith("_m"):
            label = name.removeprefix("rms_").removesuffix("_m")
            change = 1000 * abs(after.summary[name] - value)
            found.append(Gate(f"change of the steady-state {label} error", change, 2.0, "mm"))
    return found


def warnings(measured: Measured) -> list[str]:
    """A line of Markdown for each gate that is not kept."""
    return [f"> **Warning: failed: {gate}.**" for gate in gates(measured) if not gate.passed]


def with_warnings(text: str, lines: list[str]) -> str:
    """A page with lines below its title."""
    title, rest = text.split("\n", 1)
    return "\n".join([title, "", *lines, "> Find out why before it flies: report.md.", rest]) if lines else text


def report(policy: Policy, kernel: Kernel, measured: Measured, name: str) -> str:
    found = gates(measured)
    failed = warnings(measured)
    run = policy.provenance
    lines = [f"# {run.task}: {'-'.join(map(str, kernel.widths))} {kernel.activation}, int8", ""]
    lines += failed
    if failed:
        lines += ["> The C matches the integer reference; the integer policy differs this much from the float one.", ""]
    lines += [
        f"Run {run.run}, seed {run.seed}, {run.env_steps:,} environment steps, commit {run.commit}."
        f" One call every {policy.control_period_s:g} s.",
        "",
        *_verification(kernel, measured.verification),
        *_accuracy(measured, found),
        *_costs(policy, measured, name),
        USAGE.format(name=name),
    ]
    return "\n".join(lines)


def _verification(kernel: Kernel, verification: VerificationReport) -> Iterable[str]:
    bound = accumulator_bound(kernel)
    yield "## Verification\n"
    inputs = "observation" if kernel.memory is None else "observation and state"
    yield f"- Proved: no accumulator exceeds {bound:,} for any {inputs}, {bound / 2**31:.1%} of the 32-bit range."
    if verification.passed:
        yield (
            f"- Verified: the C equals the NumPy reference bit for bit on {verification.vectors:,} vectors per entry"
            f" point: {'; '.join(verification.passed)}."
        )
        yield (
            "  The vectors: observations of flights, corners of the ranges, saturating values, random bits, denormals,"
            " infinities, NaN."
        )
        if verification.steps:
            host, core = verification.steps
            slow = [cost.core for cost in verification.costs if cost.core.share > 1]
            fewer = "".join(f" ({core // each.share:,} on {each.name})" for each in slow)
            yield (
                f"- The same for the state after each, in sequences; and on smooth sequences of {host:,} steps on the"
                f" host, {core:,} on a core{fewer}."
            )
    yield from (f"- Skipped {line}." for line in verification.skipped)
    yield ""


def _accuracy(measured: Measured, found: list[Gate]) -> Iterable[str]:
    before, after = measured.float_flights, measured.integer_flights
    yield "## Integer against float\n"
    yield "| gate | measured | limit | |\n|---|---|---|---|"
    for gate in found:
        verdict = "ok" if gate.passed else "**failed**"
        yield f"| {gate.name} | {gate.with_unit(gate.measured)} | {gate.with_unit(gate.limit)} | {verdict} |"
    yield "\nAction errors and jitter are in % of full scale, the range of the action."
    yield f"\nBoth policies from the same {before.starts:,} fresh starts:\n"
    yield "| | float | int8 |\n|---|---|---|"
    for name, value in before.summary.items():
        if np.isfinite(value) or np.isfinite(after.summary[name]):
            yield f"| {name} | {value:.5g} | {after.summary[name]:.5g} |"
    yield f"| jitter, full scales per step | {before.jitter:.5f} | {after.jitter:.5f} |"
    yield ""


def _costs(policy: Policy, measured: Measured, name: str) -> Iterable[str]:
    yield "## Costs\n"
    costs = measured.verification.costs
    if not costs:
        yield "Not measured: this needs cross compilers and QEMU (above).\n"
        return
    yield "Instructions per inference under QEMU: mean of inputs in range (maximum over all vectors).\n"
    yield f"| core | `{name}_step` | `{name}_step_i16` |\n|---|---|---|"
    for cost in costs:
        both = (f"{mean:,.0f} ({most:,.0f})" for mean, most in (cost.step, cost.step_i16))
        yield f"| {cost.core.name} | {' | '.join(both)} |"
    yield "\n| core | flash | state | static RAM | stack: float entry | i16 entry | self-test | compiler library |"
    yield "|---|---|---|---|---|---|---|---|"
    for cost in costs:
        sizes = cost.flash, cost.state, cost.static_ram, *cost.stack, cost.library
        yield f"| {cost.core.name} | {' | '.join(f'{size:,} B' for size in sizes)} |"
    yield "\nFlash: text and data of the one object, -O2, all entry points and the self-test with its vectors.\n"
    yield (
        "Estimated rates: QEMU counts instructions, not cycles, so the cycles per instruction are assumed. Flash wait"
        " states, caches and interrupts add to them, and on an M0 so does a multiplier that takes 32 cycles instead of"
        " one. Measure on your board.\n"
    )
    yield "| core | clock | assumed cycles per instruction | float entry | i16 entry |\n|---|---|---|---|---|"
    for cost in costs:
        core = cost.core
        per_second = core.clock_MHz * 1e6 / core.cycles_per_instruction
        rates = " | ".join(f"{per_second / most:,.0f} Hz" for _, most in (cost.step, cost.step_i16))
        yield f"| {core.name} | {core.clock_MHz} MHz | {core.cycles_per_instruction} | {rates} |"
    yield f"\nThe policy needs {1 / policy.control_period_s:,.0f} Hz.\n"


USAGE = """\
## Use

Add `{name}.h` and `{name}.c` to the firmware: C99, no libm, no heap, no static state. The header documents\
 every input and output: order, unit, frame, range, motor positions and spins.

- `examples/bare_metal`: `make` runs it on the host; `CMakeLists.txt` for CMake.
- Arduino: this folder is a library; copy it to `libraries/{name}`. PlatformIO: to `lib/{name}`.
- Call `{name}_selftest()` at boot and do not fly unless it returns 0; `{name}_reset(&state)` before the first step and
  whenever the policy takes up control again.
- All names begin with `{name}`: any number of exports of different names link into one firmware.
- `{name}.onnx`: the float policy, for runtimes of ONNX. `{name}.npz`: its numbers, for NumPy.
- `manifest.json`: the same facts, machine-readable. `golden.csv`: inputs and outputs to test a port with,
  with memory of one sequence from a reset.
"""

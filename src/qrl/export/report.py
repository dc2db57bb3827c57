"""What an export measured, which of its gates it met, and report.md."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export.accuracy import Accuracy
from qrl.export.kernel import Kernel, accumulator_bound
from qrl.export.policy import Policy
from qrl.export.prove import Proof


class Flown(NamedTuple):
    """What was seen of flights from many starts."""

    summary: dict[str, float]  # as `qrl evaluate` has it
    success: NDArray[np.bool_] | None  # [starts]; none where the task measures none
    jitter: float  # mean change of an action from step to step over the tail, in full scales
    starts: int


@dataclass(frozen=True)
class Gate:
    """One bar: met where measured <= bar."""

    name: str
    measured: float
    bar: float
    unit: str = ""

    @property
    def met(self) -> bool:
        return self.measured <= self.bar  # a NaN never is


@dataclass(frozen=True)
class Measured:
    """Everything that an export found out."""

    accuracy: Accuracy
    naive: Accuracy
    flown_float: Flown
    flown_integer: Flown
    proof: Proof


def gates(measured: Measured) -> list[Gate]:
    """The bars of accuracy; a loss is how much worse the integers fly."""
    before, after = measured.flown_float, measured.flown_integer
    loss = (before.summary["return_mean"] - after.summary["return_mean"]) / abs(before.summary["return_mean"] or 1.0)
    found = [
        Gate("action error, RMSE", 100 * measured.accuracy.rmse, 1.0, "% of full scale"),
        Gate("action error, greatest", 100 * measured.accuracy.worst, 5.0, "% of full scale"),
        Gate("return lost", 100 * loss, 0.25, "%"),
        Gate("jitter added", after.jitter - before.jitter, 0.002, "full scales a step"),
    ]
    if before.success is not None and after.success is not None:
        lost, gained = int(np.sum(before.success & ~after.success)), int(np.sum(after.success & ~before.success))
        found.append(Gate("successful starts lost", lost, 0, f"of {before.starts:,} ({gained} gained)"))
    for name, value in before.summary.items():
        if name.startswith("rms_") and name.endswith("_m"):
            label = name.removeprefix("rms_").removesuffix("_m")
            found.append(
                Gate(f"steady state: {label} error, change", 1000 * abs(after.summary[name] - value), 2.0, "mm")
            )
    return found


def report(policy: Policy, kernel: Kernel, measured: Measured) -> str:
    """report.md."""
    found = gates(measured)
    missed = [gate for gate in found if not gate.met]
    network = "-".join(str(n) for n in (len(kernel.lsb), *(len(layer.bias) for layer in kernel.layers)))
    lines = [f"# {policy.origin.task}: {network} {kernel.activation}, int8", ""]
    lines += [f"> **Warning: missed: {gate.name}: {_value(gate)}, the bar is {gate.bar:g}.**" for gate in missed]
    lines += (
        ["> The C is exact; it is the integers that differ this much from the float policy in flight.", ""]
        if missed
        else []
    )
    lines += [
        f"Run {policy.origin.run}, seed {policy.origin.seed}, {policy.origin.env_steps:,} environment steps, commit"
        f" {policy.origin.commit}. One call every {policy.control_period_s:g} s.",
        "",
        *_proof(kernel, measured),
        *_accuracy(measured, found),
        *_costs(policy, measured),
        *_how_to_use(),
    ]
    return "\n".join(lines)


def _proof(kernel: Kernel, measured: Measured) -> Iterable[str]:
    bound = accumulator_bound(kernel)
    yield "## Proof\n"
    yield f"- No accumulator can pass {bound:,}, whatever is observed: {bound / 2**31:.1%} of what 32 bits hold."
    if measured.proof.held:
        yield f"- The C gave what the NumPy reference gives, to the bit, on: {', '.join(measured.proof.held)}."
        yield (
            f"  {measured.proof.vectors:,} observations in each entry: of flights, corners, saturating, random bits,"
            " denormal, infinite, not a number."
        )
    yield from (f"- Not proved {line}." for line in measured.proof.missing)
    yield ""


def _accuracy(measured: Measured, found: list[Gate]) -> Iterable[str]:
    before, after = measured.flown_float, measured.flown_integer
    yield "## Integers against float\n"
    yield "| gate | measured | bar | |\n|---|---|---|---|"
    yield from (f"| {g.name} | {_value(g)} | {g.bar:g} | {'met' if g.met else '**missed**'} |" for g in found)
    yield f"\nThe same {before.starts:,} fresh starts flown by both:\n"
    yield "| | float | int8 |\n|---|---|---|"
    for name, value in before.summary.items():
        if np.isfinite(value) or np.isfinite(after.summary[name]):
            yield f"| {name} | {value:.5g} | {after.summary[name]:.5g} |"
    yield f"| jitter, full scales a step | {before.jitter:.5f} | {after.jitter:.5f} |"
    yield (
        f"\nA naive int8 network (one scale for each tensor, int8 activations) errs by {measured.naive.rmse:.2%} RMSE"
        f" and {measured.naive.worst:.1%} at worst on a sample of the same flights.\n"
    )


CLOCKS = {"M0": 48, "M3": 72, "M4F": 168, "M7": 480}  # MHz of a common chip with that core
CYCLES_PER_INSTRUCTION = {"M0": 1.5, "M3": 1.5, "M4F": 1.3, "M7": 1.0}


def _costs(policy: Policy, measured: Measured) -> Iterable[str]:
    yield "## Costs\n"
    if not measured.proof.costs:
        yield "Not measured: that needs the Arm compiler and QEMU (above).\n"
        return
    yield "Instructions per inference under QEMU: mean over the policy's flights (greatest over all vectors).\n"
    yield "| core | `qrl_policy_step` | `qrl_policy_step_i16` | plain float32 | naive int8 |\n|---|---|---|---|---|"
    for cost in measured.proof.costs:
        both = (f"{mean:,.0f} ({most:,.0f})" for mean, most in (cost.step, cost.step_i16))
        others = ("–" if x is None else f"{x:,.0f}" for x in (cost.float32, cost.naive_int8))
        yield f"| {cost.core} | {' | '.join([*both, *others])} |"
    yield "\n| core | flash | static RAM | stack: float entry | i16 entry | self-test | compiler's library beside |"
    yield "|---|---|---|---|---|---|---|"
    for cost in measured.proof.costs:
        stacks = " | ".join(f"{stack} B" for stack in cost.stack)
        yield f"| {cost.core} | {cost.flash:,} B | {cost.static_ram} B | {stacks} | {cost.library:,} B |"
    yield "\nFlash: text and data of the one object, -O2, all entries and the self-test with its vectors.\n"
    yield (
        "Implied rates. QEMU counts instructions, not cycles, so a figure for cycles per instruction is assumed; flash"
        " wait states, caches and interrupts decide the rest, and on an M0 whether its multiplier takes one cycle (as"
        " assumed) or 32. Measure on your board.\n"
    )
    yield "| core | at | assumed cycles per instruction | float entry | i16 entry |\n|---|---|---|---|---|"
    for cost in measured.proof.costs:
        per_second = CLOCKS[cost.core] * 1e6 / CYCLES_PER_INSTRUCTION[cost.core]
        rates = " | ".join(f"{per_second / most:,.0f} Hz" for _, most in (cost.step, cost.step_i16))
        yield f"| {cost.core} | {CLOCKS[cost.core]} MHz | {CYCLES_PER_INSTRUCTION[cost.core]} | {rates} |"
    yield f"\nThe policy is made for {1 / policy.control_period_s:,.0f} Hz.\n"


def _how_to_use() -> Iterable[str]:
    yield "## Use\n"
    yield (
        "`qrl_policy.h` and `qrl_policy.c` are all there is to it: C99, no libm, no heap, no state. The header says"
        " what each input and output is: order, unit, frame, range, motor places and spins.\n\n"
        "- `examples/bare_metal`: `make` runs it here; `CMakeLists.txt` for CMake.\n"
        "- Arduino: this folder is a library; copy it to `libraries/qrl_policy`. PlatformIO: to `lib/qrl_policy`.\n"
        "- Call `qrl_policy_selftest()` at boot and do not fly unless it returns 0.\n"
        "- `manifest.json`: the same facts for programs. `golden.csv`: inputs and outputs to test a port with.\n"
    )


def _value(gate: Gate) -> str:
    return f"{gate.measured:.3g} {gate.unit}".strip()

"""Verifies the emitted C bit by bit against the NumPy reference, on the host and other cores, and measures costs."""

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from qrl.export import targets, vectors
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl.export.targets import CORES, FIRMWARE, STRICT, Core, VerificationFailed
from qrl.export.vectors import Outputs, Vectors

SEQUENCES = 2
HOST_STEPS, CORE_STEPS = 6_000, 600  # of each sequence


class Cost(NamedTuple):
    """Cost on one core; `step`, `step_i16`: instructions per inference, mean of inputs in range, maximum of all."""

    core: Core
    step: tuple[float, float]
    step_i16: tuple[float, float]
    state: int  # bytes of NAME_state
    flash: int  # bytes of text and data of the one object, -O2, all entry points
    static_ram: int  # bytes
    stack: tuple[int, int, int]  # bytes, of each entry point and the self-test, libraries included
    library: int  # bytes of compiler library that the object needs
    inputs: int  # that it was verified on, of each entry point


class VerificationReport(NamedTuple):
    """Targets on which the C equals the reference, targets skipped and why, and costs."""

    passed: list[str]
    skipped: list[str]
    costs: list[Cost]
    vectors: int  # per entry point
    steps: tuple[int, int] | None  # of each sequence, on the host and on a core; None without memory


def verify(policy: Policy, kernel: Kernel, source: Path, n: int) -> VerificationReport:
    """Compile `source`, the kernel's NAME.c, and run it on every target with its tools installed: on n vectors for each
    entry point and, with memory, on long sequences.

    Raises VerificationFailed at the first bit that differs from the reference.
    """

    def drawn(n: int, steps: int) -> list[Vectors]:
        long = [vectors.draw_sequences(policy, kernel, SEQUENCES, steps)] if policy.memory else []
        return [vectors.draw(policy, kernel, n), *long]

    on_host = drawn(n, HOST_STEPS)
    least, shares = vectors.least(len(policy.observations)), {core.share for core in CORES}
    on_core = {share: drawn(max(n // share, least), CORE_STEPS // share) for share in shares}
    passed, skipped, costs = [], [], []
    with TemporaryDirectory() as work, ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs: list[tuple[str, Future[Cost | None]]] = []
        if targets.host_compiler():
            for name, flags in (("host, -O2", STRICT), ("host, -O3 -ffast-math", FIRMWARE)):
                jobs.append((name, pool.submit(_on_host, source, Path(work), flags, on_host, name)))
        else:
            skipped.append("host: C compiler (cc) not found")
        for toolchain in dict.fromkeys(core.toolchain for core in CORES):
            if missing := targets.missing_tools(toolchain):
                skipped.append(f"{toolchain.family} and its costs: {', '.join(missing)} not found")
                continue
            for core in CORES:
                if core.toolchain == toolchain:
                    jobs.append((core.name, pool.submit(_on_core, core, source, Path(work), on_core[core.share])))
        for name, job in jobs:
            cost = job.result()
            passed.append(f"{name} ({cost.inputs:,} of them)" if cost and cost.inputs < n else name)
            costs += [cost] if cost else []
    return VerificationReport(passed, skipped, costs, n, (HOST_STEPS, CORE_STEPS) if policy.memory else None)


def _on_host(source: Path, work: Path, flags: tuple[str, ...], expected: list[Vectors], name: str) -> None:
    for each in expected:
        compare(name, targets.run_host(source, work, flags, each.observations), each.outputs)


def _on_core(core: Core, source: Path, work: Path, expected: list[Vectors]) -> Cost:
    first, *rest = expected
    outputs, counts = targets.run_core(core, source, work, targets.RELEASE, first.observations)
    compare(core.name, outputs, first.outputs)
    for each in rest:
        compare(core.name, targets.run_core(core, source, work, targets.RELEASE, each.observations)[0], each.outputs)
    size = targets.size(core, source, work)
    f32, i16 = counts.f32[first.outputs.status == 0], counts.i16[first.outputs.status_i16 == 0]
    return Cost(
        core=core,
        step=(float(f32.mean()), float(counts.f32.max())),
        step_i16=(float(i16.mean()), float(counts.i16.max())),
        state=outputs.state.shape[1],
        flash=size.text + size.data,
        static_ram=size.data + size.bss,
        stack=(counts.stack_f32, counts.stack_i16, counts.stack_selftest),
        library=size.library,
        inputs=len(first.obs),
    )


def compare(target: str, found: Outputs, expected: Outputs) -> None:
    """Raise VerificationFailed, naming the first vector, unless every output and status equals the reference's bits."""
    known = expected.state.shape[1]  # the rest is padding
    pairs = {
        "status of step": (found.status, expected.status),
        "step": (found.act.view(np.int32), expected.act.view(np.int32)),
        "status of step_i16": (found.status_i16, expected.status_i16),
        "step_i16": (found.act_i16, expected.act_i16),
        "state after step": (found.state[:, :known], expected.state),
        "state after step_i16": (found.state_i16[:, :known], expected.state_i16),
    }
    for name, (values, wanted) in pairs.items():
        if values.shape != wanted.shape:
            raise VerificationFailed(f"{target}: {name}: expected {wanted.shape} values, found {values.shape}")
        wrong = np.argwhere(values != wanted)
        if len(wrong):
            at = tuple(wrong[0])
            raise VerificationFailed(
                f"{target}: {name} differs from the reference in {len(wrong):,} places, first in vector {at[0]}:"
                f" expected {wanted[at]}, found {values[at]}"
            )
    if found.selftest:
        raise VerificationFailed(f"{target}: the self-test failed ({found.selftest})")

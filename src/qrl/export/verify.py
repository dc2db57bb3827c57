"""Verifies the emitted C bit by bit against the NumPy reference, on the host and four Cortex-M, and measures costs."""

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


class Cost(NamedTuple):
    """Cost on one core; `step` and `step_i16`: instructions per inference, mean over flights, maximum over vectors."""

    core: Core
    step: tuple[float, float]
    step_i16: tuple[float, float]
    flash: int  # bytes of text and data of the one object, -O2, all entry points
    static_ram: int  # bytes
    stack: tuple[int, int, int]  # bytes, of each entry point and the self-test, libraries included
    library: int  # bytes of compiler library that the object needs


class VerificationReport(NamedTuple):
    """Targets on which the C equals the reference, targets skipped and why, and costs."""

    passed: list[str]
    skipped: list[str]
    costs: list[Cost]
    vectors: int  # per entry point


def verify(policy: Policy, kernel: Kernel, folder: Path, n: int) -> VerificationReport:
    """Compile the kernel in `folder` and run it on n vectors per entry point, on every target with its tools installed.

    Raises VerificationFailed at the first bit that differs from the reference.
    """
    expected = vectors.draw(policy, kernel, n)
    passed, skipped, costs = [], [], []
    with TemporaryDirectory() as work, ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs: list[tuple[str, Future[Cost | None]]] = []
        if targets.host_compiler():
            for name, flags in (("host, -O2", STRICT), ("host, -O3 -ffast-math", FIRMWARE)):
                jobs.append((name, pool.submit(_on_host, folder, Path(work), flags, expected, name)))
        else:
            skipped.append("host: C compiler (cc) not found")
        if missing := targets.missing_tools():
            skipped.append(f"Cortex-M and its costs: {', '.join(missing)} not found")
        else:
            for core in CORES:
                jobs.append((core.name, pool.submit(_on_core, core, folder, Path(work), expected)))
        for name, job in jobs:
            cost = job.result()
            passed.append(name)
            costs += [cost] if cost else []
    return VerificationReport(passed, skipped, costs, n)


def _on_host(folder: Path, work: Path, flags: tuple[str, ...], expected: Vectors, name: str) -> None:
    compare(name, targets.run_host(folder, work, flags, expected.obs, expected.obs_i16), expected.outputs)


def _on_core(core: Core, folder: Path, work: Path, expected: Vectors) -> Cost:
    outputs, counts = targets.run_core(core, folder, work, targets.RELEASE, expected.obs, expected.obs_i16)
    compare(core.name, outputs, expected.outputs)
    size = targets.size(core, folder, work)
    flights = slice(0, len(expected.obs) // 2)
    return Cost(
        core=core,
        step=(float(counts.f32[flights].mean()), float(counts.f32.max())),
        step_i16=(float(counts.i16[flights].mean()), float(counts.i16.max())),
        flash=size.text + size.data,
        static_ram=size.data + size.bss,
        stack=(counts.stack_f32, counts.stack_i16, counts.stack_selftest),
        library=size.library,
    )


def compare(target: str, found: Outputs, expected: Outputs) -> None:
    """Raise VerificationFailed, naming the first vector, unless every output and status equals the reference's bits."""
    pairs = {
        "status of qrl_policy_step": (found.status, expected.status),
        "qrl_policy_step": (found.act.view(np.int32), expected.act.view(np.int32)),
        "status of qrl_policy_step_i16": (found.status_i16, expected.status_i16),
        "qrl_policy_step_i16": (found.act_i16, expected.act_i16),
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

"""Holds the emitted C against the NumPy reference, on this machine and on four Cortex-M, and measures what it costs."""

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from qrl.export import baseline, targets, vectors
from qrl.export import kernel as reference
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl.export.quantise import si_layers
from qrl.export.targets import CORES, FIRMWARE, STRICT, Core, Counts, Outputs, ProofFailed

BASELINE_VECTORS = 20


class Cost(NamedTuple):
    """One core: instructions per inference, mean over the policy's flights and greatest over all vectors, and bytes."""

    core: str
    step: tuple[float, float]
    step_i16: tuple[float, float]
    float32: float | None  # instructions of the same network written plainly in float32, and in naive int8;
    naive_int8: float | None  # none where that does not fit the core
    flash: int  # text and data of the one object, -O2, all entries
    static_ram: int
    stack: tuple[int, int, int]  # of each entry and the self-test, libraries included
    library: int  # bytes of compiler library that the object pulls in


class Proof(NamedTuple):
    """Where the C was held against the reference, where it could not be, and what it costs."""

    held: list[str]
    missing: list[str]
    costs: list[Cost]
    vectors: int


class Expected(NamedTuple):
    """Observations of both entries and what the reference says to them."""

    obs: np.ndarray  # float32 [n, F]
    obs_i16: np.ndarray  # int16 [n, F]
    status: np.ndarray
    act: np.ndarray  # float32 [n, A]
    status_i16: np.ndarray
    act_i16: np.ndarray

    @classmethod
    def of(cls, policy: Policy, kernel: Kernel, n: int, seed: int = 0) -> "Expected":
        obs = vectors.observations(policy, kernel, n, seed)
        obs_i16 = vectors.observations_i16(policy, kernel, n, seed)
        return cls(obs, obs_i16, *reference.step(kernel, obs), *reference.step_i16(kernel, obs_i16))


def prove(policy: Policy, kernel: Kernel, folder: Path, n: int) -> Proof:
    """Compile the kernel in `folder` and run it on n observations in each entry, wherever the tools are here.

    Raises ProofFailed at the first bit that differs from the reference.
    """
    expected = Expected.of(policy, kernel, n)
    held, missing, costs = [], [], []
    with TemporaryDirectory() as work, ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs: list[tuple[str, Future[Cost | None]]] = []
        if targets.host_compiler():
            for name, flags in (("this machine", STRICT), ("this machine with -O3 -ffast-math", FIRMWARE)):
                jobs.append((name, pool.submit(_on_host, folder, Path(work), flags, expected, name)))
        else:
            missing.append("on this machine: no C compiler (cc)")
        if lacking := targets.missing_tools():
            missing.append(f"on Cortex-M, nor measured: this machine lacks {', '.join(lacking)}")
        else:
            baseline.write(Path(work) / "baseline", si_layers(policy), policy.activation, policy.calibration)
            for core in CORES:
                jobs.append((core.name, pool.submit(_on_core, core, folder, Path(work), policy, expected)))
        for name, job in jobs:
            cost = job.result()
            held.append(name)
            costs += [cost] if cost else []
    return Proof(held, missing, costs, n)


def _on_host(folder: Path, work: Path, flags: tuple[str, ...], expected: Expected, name: str) -> None:
    compare(name, targets.run_host(folder, work, flags, expected.obs, expected.obs_i16), expected)


def _on_core(core: Core, folder: Path, work: Path, policy: Policy, expected: Expected) -> Cost:
    outputs, counts = targets.run_core(core, folder, work, targets.RELEASE, expected.obs, expected.obs_i16)
    compare(core.name, outputs, expected)
    size = targets.size(core, folder, work)
    obs = policy.calibration[:: max(1, len(policy.calibration) // BASELINE_VECTORS)][:BASELINE_VECTORS]
    plain = _plain(core, work, policy, obs)
    flights = slice(0, len(expected.obs) // 2)
    return Cost(
        core=core.name,
        step=(float(counts.f32[flights].mean()), float(counts.f32.max())),
        step_i16=(float(counts.i16[flights].mean()), float(counts.i16.max())),
        float32=plain and float(plain.f32.mean()),
        naive_int8=plain and float(plain.i16.mean()),
        flash=size.text + size.data,
        static_ram=size.data + size.bss,
        stack=(counts.stack_f32, counts.stack_i16, counts.stack_selftest),
        library=size.library,
    )


def _plain(core: Core, work: Path, policy: Policy, obs: np.ndarray) -> Counts | None:
    """What the same network written plainly costs; none where it does not fit."""
    network = baseline.naive(si_layers(policy), policy.activation, policy.calibration)
    obs_i16, flags = baseline.to_int8(network, obs), ("-std=c99", "-O2")
    try:
        return targets.run_core(core, work / "baseline", work, flags, obs, obs_i16, baseline.LIBRARIES)[1]
    except ProofFailed:
        return None


def compare(where: str, outputs: Outputs, expected: Expected) -> None:
    """ProofFailed, naming the first observation, unless every output and status is the reference's to the bit."""
    pairs = {
        "status of qrl_policy_step": (outputs.status, expected.status),
        "qrl_policy_step": (outputs.act.view(np.int32), expected.act.view(np.int32)),
        "status of qrl_policy_step_i16": (outputs.status_i16, expected.status_i16),
        "qrl_policy_step_i16": (outputs.act_i16, expected.act_i16),
    }
    for what, (found, wanted) in pairs.items():
        if found.shape != wanted.shape:
            raise ProofFailed(f"{where}: {what}: {found.shape} values, not {wanted.shape}")
        wrong = np.argwhere(found != wanted)
        if len(wrong):
            at = tuple(wrong[0])
            raise ProofFailed(
                f"{where}: {what} differs from the reference in {len(wrong):,} places, first in vector {at[0]}:"
                f" {found[at]}, not {wanted[at]}"
            )
    if outputs.selftest:
        raise ProofFailed(f"{where}: the self-test failed ({outputs.selftest})")

"""`qrl export`: the policy of a run as a C kernel, verified, flown and measured."""

import argparse
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import chex
import numpy as np
from numpy.typing import NDArray

from qrl import tasks
from qrl.algorithm.flights import Flights, summarize
from qrl.cli.terminal import DONE, clock, console
from qrl.evaluation import calibration
from qrl.evaluation.starts import evaluation_starts
from qrl.evaluation.trained_run import TrainedRun, flown_inputs
from qrl.export import emit, vectors
from qrl.export import kernel as reference
from qrl.export.accuracy import accuracy
from qrl.export.firmware import betaflight, crazyflie, px4
from qrl.export.kernel import Ints, Kernel
from qrl.export.policy import Policy
from qrl.export.quantize import UnsupportedNetwork, quantize, respond
from qrl.export.report import FlightStats, Measured, gates, report, warnings, with_warnings
from qrl.export.verify import VerificationReport, verify
from qrl_envs.specfile import BadInput

ADAPTERS = (crazyflie, betaflight, px4)


def export(args: argparse.Namespace) -> int:
    """Write RUN/export; print verification, gates and costs."""
    start_time = time.perf_counter()
    run = TrainedRun.load(args.run)
    name = kernel_name(run, args.name)
    measured = export_run(run, args.starts, args.vectors, console.print, name)
    verification = measured.verification
    for target in verification.passed:
        console.print(f"verified bit-exact ({verification.vectors:,} vectors per entry point): {target}")
    for line in verification.skipped:
        console.print(f"skipped {line}")
    for gate in gates(measured):
        console.print(f"{gate} {'ok' if gate.passed else 'FAILED'}")
    if verification.costs:
        heads = f"{'float entry':>12} {'i16 entry':>10} {'flash':>8} {'stack':>7} {'state':>6}"
        console.print(f"{'instructions per inference':<27} {heads}")
    for cost in verification.costs:
        mean, mean_i16 = cost.step[0], cost.step_i16[0]
        memory = f"{cost.flash:>6,} B {max(cost.stack):>5} B {cost.state:>4} B"
        console.print(f"{cost.core.name:<27} {mean:>12,.0f} {mean_i16:>10,.0f} {memory}")
    duration = clock(time.perf_counter() - start_time)
    for adapter in ADAPTERS:
        if (found := run.folder / "export" / adapter.FOLDER).is_dir():
            console.print(f"{adapter.TITLE}: {found} has {adapter.WHAT}")
    console.print(f"done in {duration}: {run.folder / 'export'}/{name}.c, .h, report.md")
    return DONE


def kernel_name(run: TrainedRun, name: str | None) -> str:
    """The prefix of all names in C: `name`, by default `qrl_` and the task's name. BadInput if it cannot be one."""
    if name is None:
        return emit.default_name(tasks.folder_name(run.config.task))
    if not emit.is_name(name):
        raise BadInput(
            f"--name '{name}': expected a C identifier of at most {emit.MAX_NAME} characters that is no header of the"
            " C library or of a firmware, such as hover"
        )
    return name


def export_run(
    run: TrainedRun, starts: int, vectors_per_entry: int, log: Callable[[str], None], name: str | None = None
) -> Measured:
    """Quantize, emit, verify and fly the policy of `run`, and replace its folder `export` atomically.

    Raises BadInput for a network that the kernel cannot represent, AccumulatorOverflow and VerificationFailed; the
    previous `export` is then unchanged. `name`: as `kernel_name` takes it.
    """
    from qrl.export import portable  # ONNX takes a second to import, and other commands import this file

    name = kernel_name(run, name)
    log("flying to calibrate")
    policy = run.policy()
    kernel = integer_kernel(run, policy)
    target = run.folder / "export"
    with TemporaryDirectory(dir=run.folder, prefix=".export-") as scratch, ThreadPoolExecutor(1) as pool:
        folder = Path(scratch) / "export"
        emitted = emit.files(policy, kernel, vectors.golden(policy, kernel), name)
        _write(folder, emitted)
        (folder / f"{name}.onnx").write_bytes(portable.onnx_model(policy))
        (folder / f"{name}.npz").write_bytes(portable.arrays(policy))
        log("compiling and verifying; flying")
        verification = pool.submit(verify, policy, kernel, folder / f"{name}.c", vectors_per_entry)
        measured = _measured(run, policy, kernel, starts, verification.result)
        for adapter in ADAPTERS:
            for path, data in adapter.files(policy, emitted, name).items():
                at_head = isinstance(data, str) and Path(path).name == "README.md"
                _write(folder, {path: with_warnings(data, warnings(measured)) if at_head else data})
        sections = "".join(adapter.section(policy) for adapter in ADAPTERS)
        _write(folder, {"report.md": report(policy, kernel, measured, name) + sections})
        previous = Path(scratch) / "previous"
        if target.exists():
            target.replace(previous)
        try:
            folder.replace(target)
        except OSError:
            if previous.exists():
                previous.replace(target)
            raise
    return measured


def integer_kernel(run: TrainedRun, policy: Policy) -> Kernel:
    """The kernel of a run's policy in integers; BadInput for a network that it cannot represent."""
    try:
        return quantize(policy)
    except UnsupportedNetwork as error:
        raise BadInput(f"{run.folder}: {error}") from None


def _write(folder: Path, files: Mapping[str, str | bytes]) -> None:
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.encode() if isinstance(data, str) else data)


def _measured(
    run: TrainedRun, policy: Policy, kernel: Kernel, starts: int, verification: Callable[[], VerificationReport]
) -> Measured:
    """Fly both policies from the starts of an evaluation, then wait for the verification."""
    keys = evaluation_starts(starts)
    float_flights, integer_flights = run.fly(keys), fly_kernel(run, policy, kernel, keys)
    # Every step of the transient, where the errors are; the observations of a settled vehicle repeat.
    inputs = flown_inputs(policy, float_flights)
    transient = 2 * calibration.TRANSIENT_STEPS
    parts = inputs[:, :transient], inputs[:, transient::4]
    flown = np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts])
    flown = flown[np.isfinite(flown).all(axis=1)]
    tail = run.tail_steps()
    return Measured(
        accuracy=accuracy(policy, partial(respond, kernel), flown),
        float_flights=_stats(policy, float_flights, tail),
        integer_flights=_stats(policy, integer_flights, tail),
        verification=verification(),
    )


def fly_kernel(run: TrainedRun, policy: Policy, kernel: Kernel, starts: chex.PRNGKey) -> Flights:
    """Flights of the integer reference, whose bits are the kernel's, in the environment of `run`."""

    def step(state: Ints, observation: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
        """It has the measured observation only, and keeps its own memory."""
        after, _, action = reference.step(kernel, state, observation[:, : len(policy.observations)])
        return after, action

    return run.fly_host_policy(step, reference.initial_state(kernel, len(starts)), starts)


def _stats(policy: Policy, flights: Flights, tail_steps: int) -> FlightStats:
    low, high = policy.limits
    actions = policy.to_si(np.asarray(flights.actions[:, -tail_steps:])) / (high - low)
    return FlightStats(
        summary=summarize(flights),
        success=np.asarray(flights.measures["success"]) > 0.5 if "success" in flights.measures else None,
        jitter=float(np.abs(np.diff(actions, axis=1)).mean()),
        starts=len(flights.returns),
    )

"""The command line: say what begins, import the rest, and map errors to exit codes."""

import argparse
import gc
import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import accumulate
from pathlib import Path

from qrl.cli.arguments import parse
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT, keep_interrupts, print_error
from qrl.config import FORMER_NAMES
from qrl_envs.specfile import BadInput, read

CACHE_BYTES = 2_000_000_000  # of compiled programs
# Of garbage, as `gc.set_threshold` has it: objects made between two collections of the young, of these between two of
# the middle generation, and of those between two of all.
RARE_COLLECTIONS = 200_000, 20, 2


def configure_jax() -> None:
    """Import JAX (seconds on a cold disk) with a persistent compilation cache of bounded size."""
    # NumPy's products are small here; threads of its own would fight XLA's: an export took five times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    warnings.filterwarnings("ignore", module=r"brax\..*")  # not about the user's input
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "qrl" / "xla"
        limit_size(cache, CACHE_BYTES)
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def limit_size(folder: Path, most_bytes: int) -> None:
    """Remove the least recently written files of `folder`, until the others have at most `most_bytes`.

    Not by JAX's own limit, which needs another package and a lock at each compilation.
    """
    with suppress(OSError):
        written = sorted(
            ((f.stat().st_mtime, f.stat().st_size, f) for f in folder.iterdir() if f.is_file()), reverse=True
        )
        for total, (_, _, file) in zip(accumulate(size for _, size, _ in written), written, strict=True):
            if total > most_bytes:
                file.unlink(missing_ok=True)


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 failed while running, 2 the input was wrong."""
    keep_interrupts()
    before = gc.get_threshold()
    # Imports and tracing make much and drop little, and Python would go through all of it again and again.
    gc.set_threshold(*RARE_COLLECTIONS)
    try:
        return _main(argv)
    finally:
        gc.set_threshold(*before)


def _main(argv: list[str] | None) -> int:
    args = parse(argv)
    subject = {"train": "task", "sweep": "grid", "identify": "vehicle"}.get(args.command, "run")
    if args.command != "tasks":
        print(f"qrl {args.command} {getattr(args, subject) or args.config or ''}: loading JAX", flush=True)
    _note_former_names(getattr(args, "config", None) or getattr(args, "grid", None))
    try:
        configure_jax()
        return _run(args)
    except KeyboardInterrupt:  # in an import
        print_error("interrupted")
        return FAILED


def _note_former_names(path: Path | None) -> None:
    """The note of a former flag, for the hyperparameters of CONFIG or GRID; the command says if the file is wrong."""
    with suppress(BadInput):
        data = read(path) if path else {}
        inside = [data.get(key) for key in ("learner", "fixed", "axes")]
        for values in inside:
            if isinstance(values, dict):
                for name in values.keys() & FORMER_NAMES.keys():
                    print(f"note: {path}: {name} is now {FORMER_NAMES[name]}", flush=True)
                inside += values.values()  # named settings


def _run(args: argparse.Namespace) -> int:
    """Run the parsed command and map what goes wrong to one line and an exit code."""
    import jax

    from qrl.export.kernel import AccumulatorOverflow
    from qrl.export.targets import VerificationFailed
    from qrl.runs import shipped
    from qrl.runs.integrity import IncompatibleCheckpoint
    from qrl.training.driver import NotFinite

    code = FAILED
    try:
        if getattr(args, "run", None):
            args.run = shipped.run_folder(args.run)
        if getattr(args, "beside", None):
            args.beside = [shipped.run_folder(folder) for folder in args.beside]
        return _command(args.command)(args)
    except BadInput as error:  # raised on every process
        print_error(str(error))
        return WRONG_INPUT
    except IncompatibleCheckpoint as error:
        print_error(str(error))
        code = WRONG_INPUT
    except OSError as error:
        print_error(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (NotFinite, AccumulatorOverflow, VerificationFailed, jax.errors.JaxRuntimeError) as error:
        print_error(str(error))  # of JAX: out of memory, above all
    except KeyboardInterrupt:
        print_error("interrupted")
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ValueError) and "Gloo" in str(error):  # how JAX says it on CPUs
            print_error(f"another process of the run is gone: {error}")
        else:
            traceback.print_exc()
    if jax.distributed.is_initialized():  # Python's own exit would wait for the other processes, and they for this one
        sys.stdout.flush()
        os._exit(code)
    return code


def _command(name: str) -> Callable[[argparse.Namespace], int]:
    """The command of that name, imported lazily: none waits for what another needs."""
    if name == "tasks":
        return _list_tasks
    command = getattr(importlib.import_module(f"qrl.cli.{name}"), name)
    if not gc.get_freeze_count():  # once in a process: what was imported stays, and need not be gone through again
        gc.freeze()
    return command


def _list_tasks(_: argparse.Namespace) -> int:
    from qrl import tasks
    from qrl.cli.terminal import console
    from qrl_envs import task as task_spec
    from qrl_envs.reference import shipped_references
    from qrl_envs.uncertainty import shipped_uncertainties
    from qrl_envs.vehicle import shipped_vehicles

    for name in task_spec.shipped():
        console.print(f"{name:<10} {task_spec.load(name).description}")
    console.print(f"\nBrax's own: {', '.join(tasks.foreign_tasks())}")
    console.print(f"Vehicles (VEHICLE=): {', '.join(shipped_vehicles())}, or a .json file of yours")
    console.print(f"Uncertainties (UNCERTAINTY=): {', '.join(shipped_uncertainties())}, or a .json file of yours")
    console.print(f"References (REFERENCE=): {', '.join(shipped_references())}, or a .json or .csv file of yours")
    console.print("Your environment: module:factory, a function that returns an environment with Brax's reset and step")
    return DONE

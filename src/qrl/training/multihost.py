"""What the processes of one run tell each other; a process alone hears itself.

Every process has to call `everyones`, `firsts` and `firsts_text`, in the same order.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from qrl_envs.specfile import BadInput

FIRST = 0  # the process that reads and writes the run folder


def first() -> bool:
    return jax.process_index() == FIRST


def everyones(value: float) -> np.ndarray:
    """What each process says here; float32 [processes]."""
    return np.ravel(multihost_utils.process_allgather(np.float32(value)))


def alone(value: float) -> np.ndarray:
    """The same for a process that has nothing to do with the others."""
    return np.array([value], np.float32)


def firsts(tree: Any) -> Any:
    """The first process's tree of arrays in NumPy; the others give one of the same structure, shapes and types."""
    if jax.process_count() == 1:
        return tree
    leaves, whole = jax.tree.flatten(tree)
    leaves = [np.asarray(leaf) for leaf in leaves]
    # As bytes: JAX broadcasts by a sum in single precision, which would turn −0 into 0 and round a double.
    sent = [np.ascontiguousarray(leaf).reshape(-1).view(np.uint8) for leaf in leaves]
    heard = multihost_utils.broadcast_one_to_all(sent)
    return whole.unflatten(
        [np.asarray(x).view(leaf.dtype).reshape(leaf.shape) for x, leaf in zip(heard, leaves, strict=True)]
    )


def firsts_text(text: str) -> str:
    """The first process's text, whatever the others give."""
    data = np.frombuffer(text.encode(), np.uint8)
    size = int(firsts(np.array(len(data))))
    return firsts(np.resize(data, size) if len(data) else np.zeros(size, np.uint8)).tobytes().decode()


class Process(NamedTuple):
    """Which of how many processes this is, and where process 0 listens ("" where the launcher says so itself)."""

    number: int
    of: int
    coordinator: str


def this_process(index: int | None, count: int | None, coordinator: str | None, env: Mapping[str, str]) -> Process:
    """From flags, else JAX's variables, else those of a SLURM step (`srun`); alone where nothing is said."""
    # Not SLURM_NTASKS: it is set in a batch script too, where only one process runs.
    step = env if "SLURM_STEP_NUM_TASKS" in env else {}
    found = [
        ("--process-id", index, env.get("JAX_PROCESS_ID"), step.get("SLURM_PROCID")),
        ("--processes", count, env.get("JAX_NUM_PROCESSES"), step.get("SLURM_STEP_NUM_TASKS")),
    ]
    index, count = (_number(flag, next((v for v in values if v is not None), None)) for flag, *values in found)
    if coordinator and count is None and index is None:
        raise BadInput("--processes is missing: expected how many there are, where there is a --coordinator")
    coordinator = coordinator or env.get("JAX_COORDINATOR_ADDRESS") or ""
    if count is None and index is None:
        return Process(0, 1, "")
    if count is None or index is None or not 0 <= index < count:
        raise BadInput(f"expected --process-id below --processes, found {index} of {count}")
    if count > 1 and not coordinator and not step:
        raise BadInput("--coordinator is missing: expected HOST:PORT, where process 0 can be reached")
    return Process(index, count, coordinator)


def _number(flag: str, value: int | str | None) -> int | None:
    try:
        return None if value is None else int(value)
    except ValueError:
        raise BadInput(f"{flag}: expected a number, found '{value}'") from None


def join(process: Process) -> None:
    """Meet the other processes, where there are any."""
    if process.of > 1 and not jax.distributed.is_initialized():
        try:
            jax.distributed.initialize(process.coordinator or None, process.of, process.number)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"process {process.number} of {process.of} cannot meet the others: {error}") from None

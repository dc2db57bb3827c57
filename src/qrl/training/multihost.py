"""The processes of one run: how they join, and what they exchange.

Every process must call `all_gather`, `broadcast` and `broadcast_text` in the same order.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from qrl_envs.specfile import BadInput

COORDINATOR = 0  # the process that reads and writes the run folder


def is_coordinator() -> bool:
    return jax.process_index() == COORDINATOR


def all_gather(value: float) -> np.ndarray:
    """The value of each process; float32 [processes]."""
    return np.ravel(multihost_utils.process_allgather(np.float32(value)))


def single_process(value: float) -> np.ndarray:
    """`all_gather` for a process that shares nothing with others."""
    return np.array([value], np.float32)


def broadcast(tree: Any) -> Any:
    """The coordinator's tree of arrays in NumPy; the others give one of the same structure, shapes and types."""
    if jax.process_count() == 1:
        return tree
    leaves, treedef = jax.tree.flatten(tree)
    leaves = [np.asarray(leaf) for leaf in leaves]
    # As bytes: JAX broadcasts by a sum in single precision, which would turn −0 into 0 and round a double.
    sent = [np.ascontiguousarray(leaf).reshape(-1).view(np.uint8) for leaf in leaves]
    received = multihost_utils.broadcast_one_to_all(sent)
    return treedef.unflatten(
        [np.asarray(x).view(leaf.dtype).reshape(leaf.shape) for x, leaf in zip(received, leaves, strict=True)]
    )


def broadcast_text(text: str) -> str:
    """The coordinator's text; the others' is ignored."""
    data = np.frombuffer(text.encode(), np.uint8)
    size = int(broadcast(np.array(len(data))))
    return broadcast(np.resize(data, size) if len(data) else np.zeros(size, np.uint8)).tobytes().decode()


class Process(NamedTuple):
    """Index and number of processes, and the address of process 0 ("" where the launcher gives it)."""

    number: int
    of: int
    coordinator: str


def this_process(index: int | None, count: int | None, coordinator: str | None, env: Mapping[str, str]) -> Process:
    """From flags, else JAX's variables, else those of a SLURM step (`srun`); a single process by default."""
    step = env if "SLURM_STEP_NUM_TASKS" in env else {}  # SLURM_NTASKS is set in a batch script too, for one process
    index = _number("--process-id", index, env.get("JAX_PROCESS_ID"), step.get("SLURM_PROCID"))
    count = _number("--processes", count, env.get("JAX_NUM_PROCESSES"), step.get("SLURM_STEP_NUM_TASKS"))
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


def _number(flag: str, *values: int | str | None) -> int | None:
    value = next((v for v in values if v is not None), None)
    try:
        return None if value is None else int(value)
    except ValueError:
        raise BadInput(f"{flag}: expected a number, found '{value}'") from None


def join(process: Process) -> None:
    if process.of > 1 and not jax.distributed.is_initialized():
        try:
            jax.distributed.initialize(process.coordinator or None, process.of, process.number)
        except (RuntimeError, ValueError) as error:
            raise OSError(
                f"process {process.number} of {process.of} cannot connect to the coordinator: {error}"
            ) from None

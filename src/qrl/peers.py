"""What the processes of one run tell each other; a process alone hears itself. Every process has to call these."""

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

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
    """The first process's tree of arrays; the others give one of the same structure, shapes and types."""
    return multihost_utils.broadcast_one_to_all(tree) if jax.process_count() > 1 else tree


def firsts_text(text: str) -> str:
    """The first process's text, whatever the others give."""
    data = np.frombuffer(text.encode(), np.uint8)
    size = int(firsts(np.int32(len(data))))
    return bytes(np.asarray(firsts(np.resize(data, size) if size else data[:0]))).decode() if size else ""

"""What the processes of one run tell each other; a process alone hears itself.

Every process has to call `everyones`, `firsts` and `firsts_text`, in the same order.
"""

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

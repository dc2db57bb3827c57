"""Orbax checkpoints of the whole training state, one manager for each member's folder."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

KEEP = 5


def manager(folder: Path) -> ocp.CheckpointManager:
    """The checkpoints of a run folder; a half-written one is not among them."""
    return ocp.CheckpointManager(
        (folder / "checkpoints").resolve(),
        options=ocp.CheckpointManagerOptions(max_to_keep=KEEP, enable_async_checkpointing=False),
    )


def member(states: Any, index: int) -> Any:
    """One member's state as NumPy copies: a live view of a device array would silently cancel its donation."""
    return jax.tree.map(lambda x: np.array(x[index]), states)


def save(checkpoints: ocp.CheckpointManager, env_steps: int, state: Any) -> None:
    """Save one member's state; OSError, naming the folder, if it did not come about."""
    try:
        saved = checkpoints.save(env_steps, args=ocp.args.StandardSave(state))
    except ValueError as error:  # how Orbax reports a full disk
        raise OSError(f"{checkpoints.directory}: the checkpoint could not be written ({_first(error)})") from None
    if not saved:
        raise OSError(f"{checkpoints.directory}: the checkpoint at step {env_steps:,} was not written")


def restore(checkpoints: ocp.CheckpointManager, env_steps: int, like: Any) -> Any:
    """The state saved at `env_steps`; `like` gives structure, shapes and types (one member's)."""
    try:
        state = checkpoints.restore(env_steps, args=ocp.args.StandardRestore(like))
    except (ValueError, KeyError) as error:
        raise OSError(
            f"{checkpoints.directory}: the checkpoint at step {env_steps:,} cannot be read ({_first(error)})"
        ) from None
    # Orbax hands back whatever shapes it finds.
    for (path, found), wanted in zip(jax.tree.leaves_with_path(state), jax.tree.leaves(like), strict=True):
        if found.shape != wanted.shape:
            raise OSError(
                f"{checkpoints.directory}: the checkpoint at step {env_steps:,} is of another configuration than"
                f" config.json ({jax.tree_util.keystr(path)} is {found.shape}, not {wanted.shape})"
            )
    return state


def _first(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:120]

"""Checkpoints as Orbax writes and reads them. `checkpoint` imports this late: Orbax takes a fifth of a second."""

import glob
import logging
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

# Orbax's threads log what fails in them, with a traceback. A checkpoint that was not written raises here.
logging.getLogger("absl").setLevel(logging.CRITICAL)
STATE, RECORD = "state", "record"  # Orbax items
# One process calls Orbax and must not wait for the other processes of the run.
_ONE_PROCESS = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0}, barrier_sync_key_prefix="qrl")


def read_record(path: Path) -> dict[str, Any]:
    """The record of the checkpoint at `path`."""
    with plain_path(path) as plain:
        return dict(ocp.JsonCheckpointHandler().restore(plain / RECORD))  # pyright: ignore[reportArgumentType]


def read_state(path: Path, leaves: dict[str, Any], part: bool) -> dict[str, Any]:
    """The saved `leaves`; ValueError if the saved names differ, with `part` only in the fields of `leaves`."""
    fields = {name.split(".")[0] for name in leaves}
    # The saved types: Orbax would otherwise convert.
    as_saved = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), leaves)
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=_ONE_PROCESS)
    with plain_path(path) as plain, ocp.Checkpointer(handler, multiprocessing_options=_ONE_PROCESS) as orbax:
        metadata = handler.metadata(plain / STATE).tree  # pyright: ignore[reportArgumentType]
        saved = {name for name in metadata if not part or name.split(".")[0] in fields}
        if differing := saved ^ leaves.keys():  # partial_restore would not report them
            raise ValueError(f"{min(differing)} is {'missing' if min(differing) in leaves else 'unknown'}")
        args = ocp.args.PyTreeRestore(leaves, restore_args=as_saved, partial_restore=part)
        return orbax.restore(plain / STATE, args=args)


def save(
    folder: Path, step: int, state: dict[str, Any], record: dict[str, Any], latest: int, kept: Iterable[int]
) -> None:
    """Save a checkpoint as `folder`/`step`; of all there, the `latest` so many and the steps `kept` remain."""
    items = ocp.args.Composite(**{STATE: ocp.args.StandardSave(state), RECORD: ocp.args.JsonSave(record)})
    options = ocp.CheckpointManagerOptions(
        create=False,
        cleanup_tmp_directories=True,
        enable_async_checkpointing=False,
        preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(latest), policies.CustomSteps([*kept])]),
        multiprocessing_options=_ONE_PROCESS,
    )
    with plain_path(folder) as plain, ocp.CheckpointManager(plain, options=options) as orbax:
        orbax.save(step, args=items, force=True)


@contextmanager
def plain_path(folder: Path) -> Iterator[Path]:
    """An absolute path of `folder` that Orbax, which globs below it unescaped, reads literally; a link if need be."""
    folder = folder.resolve()
    if glob.escape(str(folder)) == str(folder):
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="qrl-") as place:
        link = Path(place) / "link"
        link.symlink_to(folder)
        yield link

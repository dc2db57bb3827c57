"""Checkpoints of the complete training state of one run folder, written by Orbax in the background.

A checkpoint is complete once it has a manifest, which is written last and verified before each read. A checkpoint
without a manifest was interrupted while it was written, and is ignored.
"""

import errno
import os
import shutil
import time
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from qrl.runs import integrity
from qrl.runs.files import Row, rank_key
from qrl.runs.integrity import CorruptCheckpoint, IncompatibleCheckpoint, first_line
from qrl.runs.record import RunConfig

KEEP = 5  # most recent checkpoints; the best one is kept too


class Record(NamedTuple):
    """The part of a checkpoint besides the training state."""

    rows: list[Row]  # of metrics.csv, up to this checkpoint
    train_seconds: float
    report_seconds: float  # since the last report


class Checkpoint(NamedTuple):
    env_steps: int
    state: Any  # of one member, in NumPy; fields that were not read are None
    record: Record


def saved_steps(folder: Path) -> list[int]:
    """The environment steps of the complete checkpoints of a run folder, newest first."""
    return sorted((int(path.name) for path in _steps(folder) if integrity.has_manifest(path)), reverse=True)


def read(folder: Path, run: RunConfig, env_steps: int, target: Any, *, part: bool = False) -> Checkpoint:
    """The checkpoint of `run` at `env_steps`; `target` has structure, shapes and types of a member's state.

    With `part`, fields of `target` that are None are neither read nor compared. Raises CorruptCheckpoint if a file is
    not as it was written, IncompatibleCheckpoint if the checkpoint is of another run or version of qrl, another
    OSError if it cannot be read for now.
    """
    from qrl.runs import orbax_files

    path = _root(folder) / str(env_steps)
    integrity.verify(path)
    leaves = _by_name(target)
    try:
        record = orbax_files.read_record(path)
        if record.get("run_sha256") != run.sha256:
            raise IncompatibleCheckpoint(
                f"{path}: of another run than config.json (task, hyperparameters, seed or version of qrl differ)"
            )
        found = orbax_files.read_state(path, leaves, part)
        record = Record(**{name: record[name] for name in Record._fields})
    except (CorruptCheckpoint, IncompatibleCheckpoint):
        raise
    except OSError as error:
        raise OSError(f"{path}: cannot be read ({first_line(error)})") from None
    except (ValueError, KeyError, TypeError) as error:
        raise IncompatibleCheckpoint(f"{path}: of another version of qrl ({first_line(error)})") from None
    for name, leaf in leaves.items():  # Orbax ignores both for NumPy arrays
        if (found[name].shape, found[name].dtype) != (leaf.shape, leaf.dtype):
            raise IncompatibleCheckpoint(
                f"{path}: of another version of qrl ({name} is {found[name].dtype}{list(found[name].shape)},"
                f" not {leaf.dtype}{list(leaf.shape)})"
            )
    state = jax.tree.unflatten(jax.tree.structure(target), [np.asarray(found[name]) for name in leaves])
    return Checkpoint(env_steps, state, record)


def _by_name(tree: Any) -> dict[str, Any]:
    """The leaves of a state by their paths in it."""
    return {jax.tree_util.keystr(path, simple=True, separator="."): x for path, x in jax.tree.leaves_with_path(tree)}


def discard_after(folder: Path, env_steps: int, corrupt: Collection[int] = ()) -> None:
    """Remove the checkpoints after `env_steps`; those of the steps `corrupt`, and others that fail verification, are
    renamed to corrupt-STEP instead. OSError, with nothing changed, if one cannot be read.
    """
    later = [path for path in _steps(folder) if int(path.name) > env_steps]
    kept = [path for path in later if int(path.name) in corrupt or not _removable(path)]
    for path in later:
        if path in kept:
            quarantine = path.with_name(f"corrupt-{path.name}")
            shutil.rmtree(quarantine, ignore_errors=True)
            path.rename(quarantine)
        else:
            integrity.remove_manifest(path)  # first: no half-removed checkpoint may count as complete
            shutil.rmtree(path)


def _removable(path: Path) -> bool:
    """Whether a checkpoint is as it was written, or was never completed."""
    with suppress(CorruptCheckpoint, IncompatibleCheckpoint):
        if integrity.has_manifest(path):
            integrity.verify(path)
        return True
    return False


class Writer:
    """Saves checkpoints of one run into its folder, one at a time in `thread`, while training continues.

    The thread is not Orbax's: its own async mode prints a traceback when a save fails, and has no hook for a manifest.
    Writers share one: several that save at once hinder each other.
    """

    def __init__(self, folder: Path, run: RunConfig, thread: ThreadPoolExecutor) -> None:
        self._folder = folder
        self._descriptor = os.open(folder, os.O_RDONLY)  # while it is open, no new folder can get the same inode
        self._run_sha256 = run.sha256
        self._thread = thread
        self._pending: Future[None] | None = None
        self.seconds = 0.0  # that the last save took
        _root(folder).mkdir(exist_ok=True)

    def save(self, checkpoint: Checkpoint) -> None:
        """Start to save; OSError if the save before failed."""
        self.wait()
        self._pending = self._thread.submit(self._save, checkpoint)

    def check(self) -> None:
        """OSError if the run folder was removed or replaced, or the last save has already failed."""
        self._check_folder()
        if self._pending and self._pending.done():
            self.wait()

    @property
    def busy(self) -> bool:
        """Whether a save is in progress."""
        return self._pending is not None and not self._pending.done()

    def wait(self) -> None:
        """Wait until the save in progress is on disk; OSError, naming the folder, if it failed."""
        pending, self._pending = self._pending, None
        if pending:
            pending.result()

    def close(self) -> None:
        """Finish the save in progress, without reporting its errors."""
        if self._pending:
            self._pending.exception()
        os.close(self._descriptor)

    def _check_folder(self) -> None:
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(self._descriptor), self._folder.stat()):
                return
        raise OSError(f"{self._folder}: the run folder is gone")

    def _save(self, checkpoint: Checkpoint) -> None:
        from qrl.runs import orbax_files  # in this thread, beside training; before it, what compiles needs both cores

        begun = time.perf_counter()
        path = _root(self._folder) / str(checkpoint.env_steps)
        state = _by_name(checkpoint.state)
        record = {"run_sha256": self._run_sha256, **checkpoint.record._asdict()}
        best = _best(checkpoint.env_steps, saved_steps(self._folder), checkpoint.record.rows)
        try:
            # Orbax prints tracebacks when the disk fills up during a save.
            if shutil.disk_usage(path.parent).free < sum(leaf.nbytes for leaf in state.values()) * 5 // 4 + 2**20:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            orbax_files.save(path.parent, checkpoint.env_steps, state, record, KEEP, [best])
            self._check_folder()  # if it was removed meanwhile, Orbax has created it again
            integrity.write_manifest(path)
            self.seconds = time.perf_counter() - begun
        except (OSError, ValueError) as error:  # ValueError: tensorstore's errors
            raise OSError(f"{path}: the checkpoint could not be written ({first_line(error)})") from None


def _best(env_steps: int, saved: list[int], rows: list[Row]) -> int:
    """Of the checkpoints, and the one at `env_steps`, that with the best report in `rows`."""
    ranks = {row["env_steps"]: (rank_key(row["success"]), rank_key(row["return_mean"])) for row in rows}
    return int(max(ranks.keys() & {*saved, env_steps}, key=lambda step: (ranks[step], -step), default=env_steps))


def _root(folder: Path) -> Path:
    return folder / "checkpoints"


def _steps(folder: Path) -> list[Path]:
    root = _root(folder)  # not by glob, which finds nothing where it may not read
    return [path for path in root.iterdir() if path.name.isdecimal() and path.is_dir()] if root.exists() else []

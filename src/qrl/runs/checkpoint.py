"""Checkpoints of the whole training state of one run folder, written beside the training by Orbax.

A checkpoint is whole once it has its seal. Whoever reads checks that first, so that nothing damaged ever reaches Orbax;
what has no seal was being written when the process was killed, and counts for nothing.
"""

import ctypes
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

from qrl.runs import integrity
from qrl.runs.files import Row, comparable
from qrl.runs.integrity import Damaged, Foreign, Record, first_line
from qrl.runs.record import RunConfig

KEEP = 5  # the last so many, and the best
ROOM = "room.tmp"
STATE = "state"
# Whoever calls Orbax does so alone: it must not wait for other processes of the run.
_ONE_PROCESS = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0}, barrier_sync_key_prefix="qrl")


class Checkpoint(NamedTuple):
    env_steps: int
    state: Any  # one member's, in NumPy; of a part that was read, None for the rest
    record: Record


def steps(folder: Path) -> list[int]:
    """The environment steps at which a run folder has sealed checkpoints, newest first."""
    return sorted(int(path.parent.name) for path in _root(folder).glob(f"*/{integrity.NAME}") if _is_step(path.parent))[
        ::-1
    ]


def read(folder: Path, run: RunConfig, env_steps: int, like: Any, *, part: bool = False) -> Checkpoint:
    """The checkpoint of `run` at `env_steps`; `like` gives structure, shapes and types of a member's state.

    With `part`, fields of `like` that are None are not read, and nothing is said of what is saved there.
    Raises Damaged where the files are not those that were sealed, Foreign where they are of another run or version.
    """
    path = _root(folder) / str(env_steps)
    whole = integrity.checked(path)
    if whole.run_sha256 != run.sha256:
        raise Foreign(f"{path}: of another run than config.json (another task, hyperparameter, seed or version of qrl)")
    wanted = _by_name(like)
    try:
        found = _restored((path / STATE).resolve(), wanted, part)
    except OSError as error:
        raise Damaged(f"{path}: cannot be read ({first_line(error)})") from None
    except (ValueError, KeyError, TypeError) as error:
        raise Foreign(f"{path}: of another version of qrl ({first_line(error)})") from None
    for name, leaf in wanted.items():  # Orbax hands back whatever it finds
        if (found[name].shape, found[name].dtype) != (leaf.shape, leaf.dtype):
            raise Foreign(
                f"{path}: of another version of qrl ({name} is {found[name].dtype}{list(found[name].shape)},"
                f" not {leaf.dtype}{list(leaf.shape)})"
            )
    state = jax.tree.unflatten(jax.tree.structure(like), [np.asarray(found[name]) for name in wanted])
    return Checkpoint(env_steps, state, whole.record)


def _restored(path: Path, wanted: dict[str, Any], part: bool) -> dict[str, Any]:
    """What is saved under the names `wanted`; ValueError where there are others, of a part in its fields."""
    asked = {_field(name) for name in wanted}
    # As it was saved: Orbax would turn one type into another.
    as_saved = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), wanted)
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=_ONE_PROCESS)
    with ocp.Checkpointer(handler, multiprocessing_options=_ONE_PROCESS) as orbax:
        saved = handler.metadata(path).tree  # pyright: ignore[reportArgumentType]
        there = {name for name in saved if not part or _field(name) in asked}
        if differing := there ^ wanted.keys():  # of a part, Orbax would hand back what it was asked for, or less
            raise ValueError(f"{min(differing)} is {'missing' if min(differing) in wanted else 'unknown'}")
        return orbax.restore(path, args=ocp.args.PyTreeRestore(wanted, restore_args=as_saved, partial_restore=part))


def _field(name: str) -> str:
    """Of a leaf's name, the field of the state in which it is."""
    return name.split(".")[0]


def _by_name(tree: Any) -> dict[str, Any]:
    """The leaves of a state by their paths in it."""
    return {jax.tree_util.keystr(path, simple=True, separator="."): x for path, x in jax.tree.leaves_with_path(tree)}


def clear_after(folder: Path, env_steps: int) -> None:
    """Leave no checkpoint after `env_steps`: what is whole or was never sealed goes, what is damaged is set aside."""
    for path in sorted(_root(folder).glob("*")):
        if not _is_step(path) or int(path.name) <= env_steps:
            continue
        if (path / integrity.NAME).exists():
            try:
                integrity.checked(path)
            except (Damaged, Foreign):
                aside = path.with_name(f"aside-{path.name}")
                shutil.rmtree(aside, ignore_errors=True)
                path.rename(aside)
                continue
            (path / integrity.NAME).unlink()  # first: killed half-way, what is left is no checkpoint
        shutil.rmtree(path)


class Writer:
    """Saves checkpoints of one run into its folder, one at a time, while the training goes on."""

    def __init__(self, folder: Path, run: RunConfig) -> None:
        self._folder = folder
        self._open = os.open(folder, os.O_RDONLY)  # as long as it is, no other folder can be taken for it
        self._run_sha256 = run.sha256
        self._rows: list[Row] = []
        self._thread = ThreadPoolExecutor(1, "checkpoint")
        self._pending: Future[None] | None = None
        _root(folder).mkdir(exist_ok=True)
        for unfinished in _root(folder).glob("*.orbax-checkpoint-tmp*"):  # by a process that was killed
            shutil.rmtree(unfinished)
        (_root(folder) / ROOM).unlink(missing_ok=True)
        self._orbax = ocp.CheckpointManager(
            _root(folder).resolve(),
            options=ocp.CheckpointManagerOptions(
                create=False,
                enable_async_checkpointing=False,
                preservation_policy=_Preserve(self._best),
                multiprocessing_options=_ONE_PROCESS,
            ),
        )

    def save(self, checkpoint: Checkpoint) -> None:
        """Begin to save; OSError if the save before did not come about."""
        self.wait()
        self._pending = self._thread.submit(self._save, checkpoint)

    def check(self) -> None:
        """OSError if the run folder is not there any more, or the last save has failed already."""
        self._still_there()
        if self._pending and self._pending.done():
            self.wait()

    def wait(self) -> None:
        """Until what was begun is on disk; OSError, naming the folder, if it did not get there."""
        pending, self._pending = self._pending, None
        if pending:
            pending.result()

    def close(self) -> None:
        """Give up threads; what is still being written is finished, and no longer complained about."""
        self._thread.shutdown()
        with suppress(OSError, ValueError):
            self._orbax.close()
        os.close(self._open)

    def _still_there(self) -> None:
        ours, there = os.fstat(self._open), None
        with suppress(FileNotFoundError):
            there = self._folder.stat()
        if not there or (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino):
            raise OSError(f"{self._folder}: the run folder is gone")

    def _save(self, checkpoint: Checkpoint) -> None:
        self._still_there()  # Orbax would make it anew
        self._rows = checkpoint.record.rows
        path = _root(self._folder) / str(checkpoint.env_steps)
        try:
            state = _by_name(checkpoint.state)
            _make_sure_of_room(path, sum(leaf.nbytes for leaf in state.values()))
            self._orbax.save(
                checkpoint.env_steps,
                args=ocp.args.Composite(**{STATE: ocp.args.StandardSave(state)}),
                force=True,
            )
            self._still_there()  # removed meanwhile, Orbax has made it anew
            integrity.close(path, self._run_sha256, checkpoint.record)
            _give_back()
        except (OSError, ValueError) as error:  # ValueError: how Orbax reports a full disk
            raise OSError(f"{path}: the checkpoint could not be written ({first_line(error)})") from None

    def _best(self, among: Sequence[int]) -> int | None:
        """Of these steps the one whose report was best; None where none had a report."""
        reports = {row["env_steps"]: row for row in self._rows}
        ranks = {
            step: (comparable(row["success"]), comparable(row["return_mean"]))
            for step in among
            if (row := reports.get(step))
        }
        return max(ranks, key=lambda step: ranks[step], default=None)


class _Preserve(policies.PreservationPolicy):
    """The last KEEP, and the best."""

    def __init__(self, best: Callable[[Sequence[int]], int | None]) -> None:
        self._best = best

    def should_preserve(self, checkpoints: Sequence[Any], *, context: Any) -> Sequence[bool]:
        there = [info.step for info in checkpoints]
        kept = {*there[-KEEP:], self._best(there)}
        return [step in kept for step in there]


def _root(folder: Path) -> Path:
    return folder / "checkpoints"


def _make_sure_of_room(path: Path, state_bytes: int) -> None:
    """OSError where such a state has no room: Orbax, out of room half-way, fills the screen with tracebacks."""
    room = path.with_name(ROOM)
    try:
        with room.open("wb") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, state_bytes * 5 // 4 + 2**20)  # and what Orbax notes beside it
    finally:
        room.unlink(missing_ok=True)


def _give_back() -> None:
    """What Orbax's threads have freed: glibc keeps it in a heap for each, and a long run grows by some MB a save."""
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def _is_step(path: Path) -> bool:
    return path.name.isdecimal() and path.is_dir()

"""Train many members with one compiled program, in chunks that fit into memory; each chunk is recorded once complete.

A finished chunk is a file in the sweep's folder, written atomically. An interrupted sweep resumes, on any number of
devices or hosts, with the members that no file holds.
"""

import json
import math
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import SingleDeviceSharding

from qrl.runs.files import Row, replace_text
from qrl.training import driver
from qrl.training.state import MemberInputs, stack
from qrl.training.trainer import Trainer

# A CPU trains the members of a chunk in sequence: larger chunks are no faster, and an interruption loses more of them.
CPU_CHUNK = 8


@dataclass(frozen=True)
class Member:
    index: int  # in the sweep: index of the point · number of seeds + index of the seed
    seed: int
    inputs: MemberInputs


@dataclass(frozen=True)
class Group:
    """Members that share one compiled program."""

    trainer: Trainer
    members: list[Member]

    @property
    def steps(self) -> int:
        config = self.trainer.config
        return config.num_unrolls * config.steps_per_unroll


class Result(NamedTuple):
    """The recorded result of a member."""

    rows: list[Row]  # as in metrics.csv; `train_seconds` is its share of the chunk's
    diverged: str  # what was not finite first, and when; "" if all was finite


class Compiling(NamedTuple):
    """The programs of a group are compiled now, for `size` members at once."""

    size: int


class Progress(NamedTuple):
    """Heartbeat of a chunk, which its first member's index names."""

    chunk: int
    env_steps: int  # of all its members


class ChunkDone(NamedTuple):
    chunk: int
    results: dict[int, Result]
    seconds: float


def member_bytes(trainer: Trainer, inputs: MemberInputs) -> int:
    """Bytes of device memory of a member: its state twice (input and output of the program), and its flights."""
    one = stack([inputs])
    states = jax.eval_shape(trainer.init, driver.seeds(0, 1), one)
    flights = jax.eval_shape(trainer.fly, states.learner, one, driver.report_starts(trainer.config))
    return 2 * _bytes(states) + _bytes(flights)


def _bytes(tree: Any) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def chunk_members(members: int, each_bytes: int, budget_bytes: float, workers: int) -> int:
    """Members of one chunk, so that each worker holds one chunk and chunks are of even size; 0: not even one fits.

    A program needs room for its members and, as scratch, for about one more.
    """
    most = int(budget_bytes // (each_bytes * workers)) - 1
    if jax.default_backend() == "cpu":
        most = min(most, CPU_CHUNK)
    if most < 1:
        return 0
    rounds = math.ceil(members / (most * workers))
    return math.ceil(members / (rounds * workers))


def run(
    group: Group, devices: Sequence[Any], budget_bytes: float, folder: Path, stopped: Callable[[], bool]
) -> Iterator[Compiling | Progress | ChunkDone]:
    """Train the members of a group that have no result yet, a worker for each of `devices`, until `stopped()`.

    A device may occur several times: a CPU runs a program on about one core, and can run several at a time.
    """
    done = finished(folder)
    remaining = [member for member in group.members if member.index not in done]
    if not remaining or stopped():
        return
    each_bytes = member_bytes(group.trainer, remaining[0].inputs)
    size = chunk_members(len(remaining), each_bytes, budget_bytes, len(devices))
    folder.mkdir(parents=True, exist_ok=True)
    yield Compiling(size)
    programs = {device: _compiled(group.trainer, remaining, size, device) for device in set(devices)}
    chunks = iter([remaining[i : i + size] for i in range(0, len(remaining), size)])
    events: Queue[Any] = Queue()
    halt = threading.Event()

    def work(device: Any) -> None:
        try:
            for members in chunks:  # each worker takes the next
                if halt.is_set():
                    break
                for event in _chunk(group, programs[device], members, size, device, folder, halt.is_set):
                    events.put(event)
            events.put(None)
        except BaseException as error:
            events.put(error)

    with ThreadPoolExecutor(len(devices)) as pool:  # its end waits: Python must not exit while a thread is inside XLA
        try:
            pool.map(work, devices)
            working = len(devices)
            while working:
                event = events.get()
                if isinstance(event, BaseException):
                    raise event
                if stopped():
                    halt.set()
                if event is None:
                    working -= 1
                else:
                    yield event
        finally:
            halt.set()


def _inputs(members: list[Member], size: int, device: Any) -> tuple[jax.Array, MemberInputs]:
    """Seeds and inputs of `size` members on the device, the last one repeated."""
    padded = members + [members[-1]] * (size - len(members))
    seeds = np.asarray([member.seed for member in padded], np.int32)
    return jax.device_put((seeds, stack([member.inputs for member in padded])), device)


def _compiled(trainer: Trainer, members: list[Member], size: int, device: Any) -> tuple[Any, driver.Programs]:
    """The program of the initial states, and those of training, for chunks of `size` members."""
    seeds, inputs = _inputs(members[:size], size, device)
    states = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=SingleDeviceSharding(device)),
        jax.eval_shape(trainer.init, seeds, inputs),
    )
    train, apg, fly = (
        compiled(trainer, states, inputs) for compiled in (driver.compile_train, driver.compile_apg, driver.compile_fly)
    )
    return trainer.init.lower(seeds, inputs).compile(), driver.Programs(train, lambda: apg, fly, trainer.gather)


def _chunk(
    group: Group,
    programs: tuple[Any, driver.Programs],
    members: list[Member],
    size: int,
    device: Any,
    folder: Path,
    halted: Callable[[], bool],
) -> Iterator[Progress | ChunkDone]:
    """Train a chunk and record it, unless `halted()`."""
    start_time, chunk = time.perf_counter(), members[0].index
    seeds, inputs = _inputs(members, size, device)
    states = programs[0](seeds, inputs)
    rows: list[list[Row]] = [[] for _ in members]
    faults: list[str] = []
    for update in driver.run_chunks(states, inputs, programs[1], group.trainer.config, driver.Clock(), halted):
        faults = update.faults
        for kept, row in zip(rows, update.rows, strict=False):  # without the padding
            share = {"train_seconds": round(row["train_seconds"] / len(members), 3)}
            kept.append({key: value for key, value in (row | share).items() if key != "steps_per_second"})
        yield Progress(chunk, update.env_steps * len(members))
    if all(kept and kept[-1]["env_steps"] == group.steps for kept in rows):
        results = {member.index: Result(rows[i], faults[i]) for i, member in enumerate(members)}
        replace_text(folder / f"{chunk:07d}.json", json.dumps(record(results)) + "\n")
        yield ChunkDone(chunk, results, time.perf_counter() - start_time)


def record(results: dict[int, Result]) -> dict[str, Any]:
    """The content of a chunk's file. Numbers that are not finite are text: JSON has none."""
    members = {
        str(index): {
            "rows": [{name: x if np.isfinite(x) else str(x) for name, x in row.items()} for row in result.rows],
            "diverged": result.diverged,
        }
        for index, result in results.items()
    }
    return {"members": members, "crc32": _checksum(members)}


def _checksum(members: Any) -> int:
    return zlib.crc32(json.dumps(members).encode())


def finished(folder: Path, unreadable: Callable[[Path], None] = lambda path: None) -> dict[int, Result]:
    """The results in a sweep's folder of chunks, by member; files that cannot be read are ignored."""
    results = {}
    for path in sorted(folder.glob("*.json")):
        try:
            results |= _recorded(path)
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            unreadable(path)
    return results


def _recorded(path: Path) -> dict[int, Result]:
    data = json.loads(path.read_text(encoding="utf-8"))
    if data["crc32"] != _checksum(data["members"]):
        raise ValueError("damaged")
    results = {}
    for index, kept in data["members"].items():
        rows = [{name: float(x) if isinstance(x, str) else x for name, x in row.items()} for row in kept["rows"]]
        results[int(index)] = Result(rows, kept["diverged"])
    return results

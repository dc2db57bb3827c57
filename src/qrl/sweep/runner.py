"""Chunks of a sweep's members, each trained by one compiled program; each is recorded once complete.

`train` is all that a worker does: from a chunk, which is data, to its results. An engine decides where and when:
`Local` here, with a thread for each core or accelerator, and `ray_engine.Ray`, on the nodes of a cluster. A finished
chunk is a file in the sweep's folder, written atomically, so that an interrupted sweep resumes, on any engine, with the
members that no file holds.
"""

import json
import math
import threading
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax.sharding import SingleDeviceSharding

from qrl import tasks
from qrl.config import Config
from qrl.runs.files import Row, replace_text
from qrl.runs.record import TaskRecord
from qrl.sweep.search import Pruning
from qrl.training import devices, driver
from qrl.training.state import MemberInputs, stack
from qrl.training.trainer import Trainer, make_trainer

# A CPU trains the members of a chunk in sequence: larger chunks are no faster, and an interruption loses more of them.
CPU_CHUNK = 8
PROGRAMS = 4  # compiled ones that a process keeps; a search may need one and another in turn


@dataclass(frozen=True)
class Member:
    index: int  # in the sweep: index of the point · number of seeds + index of the seed
    seed: int
    inputs: MemberInputs  # NumPy


@dataclass(frozen=True)
class Chunk:
    """Members that are trained side by side: all that a worker needs to know, wherever it is."""

    task: TaskRecord  # and learner, of a point of the same program
    learner: Config
    static: str  # equal for points that share a program
    members: list[Member]
    size: int  # of the program; the last member fills it up
    program: int  # its number in the sweep
    memory_bytes: int  # of its members, and one more as scratch
    pruning: Pruning | None = None  # of a search

    @property
    def index(self) -> int:
        return self.members[0].index

    @property
    def steps(self) -> int:
        """Environment steps of a member that trains to its end."""
        return total_steps(self.learner)


class Result(NamedTuple):
    """The recorded result of a member."""

    rows: list[Row]  # as in metrics.csv; `train_seconds` is its share of the chunk's
    diverged: str  # what was not finite first, and when; "" if all was finite


class Compiling(NamedTuple):
    """A program is compiled now, for `size` members at once."""

    program: int
    size: int


class Progress(NamedTuple):
    """Heartbeat of a chunk, which its first member's index names."""

    chunk: int
    env_steps: int  # of all its members


class ChunkDone(NamedTuple):
    chunk: int
    results: dict[int, Result]
    seconds: float


Event = Compiling | Progress | ChunkDone


class Engine(Protocol):
    """Where chunks are trained."""

    on_cpu: bool
    workers: int  # chunks at a time
    memory_bytes: float  # of the members of all workers
    grid_bytes: float  # of points and reports, in this process

    def run(self, chunks: Sequence[Chunk], folder: Path, stopped: Callable[[], bool]) -> Iterator[Event]:
        """Train the chunks, and record each in `folder` once it is complete, until `stopped()`."""
        ...

    def describe(self) -> str: ...

    def close(self) -> None: ...


def chunk_bytes(size: int, each_bytes: int) -> int:
    """A program needs room for its members and, as scratch, for about one more."""
    return (size + 1) * each_bytes


def total_steps(learner: Config) -> int:
    return learner.num_unrolls * learner.steps_per_unroll


def member_bytes(trainer: Trainer, inputs: MemberInputs) -> int:
    """Bytes of device memory of a member: its state twice (input and output of the program), and its flights."""
    one = stack([inputs])
    states = jax.eval_shape(trainer.init, driver.seeds(0, 1), one)
    flights = jax.eval_shape(driver.report_flights(trainer), states.learner, one)
    return 2 * _bytes(states) + _bytes(flights)


def _bytes(tree: Any) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def chunk_members(members: int, each_bytes: int, budget_bytes: float, workers: int, *, on_cpu: bool) -> int:
    """Members of one chunk, so that each worker holds one chunk and chunks are of even size; 0: not even one fits."""
    most = int(budget_bytes // (each_bytes * workers)) - 1
    if on_cpu:
        most = min(most, CPU_CHUNK)
    if most < 1:
        return 0
    rounds = math.ceil(members / (most * workers))
    return math.ceil(members / (rounds * workers))


class Local:
    """This machine: a thread for each core, or each accelerator."""

    def __init__(self, memory_bytes: float | None) -> None:
        self.devices = devices.workers()
        self.workers = len(self.devices)
        self.on_cpu = self.devices[0].platform == "cpu"
        self.memory_bytes = memory_bytes or devices.memory_bytes()
        self.grid_bytes = memory_bytes or devices.host_bytes()

    def describe(self) -> str:
        return f"{self.workers:,} worker{'s' * (self.workers != 1)} on {self.devices[0].platform.upper()}"

    def close(self) -> None: ...

    def run(self, chunks: Sequence[Chunk], folder: Path, stopped: Callable[[], bool]) -> Iterator[Event]:
        """A device may occur several times: a CPU runs a program on about one core, and can run several at a time."""
        waiting = iter(chunks)
        events: Queue[Any] = Queue()
        halt = threading.Event()

        def work(device: Any) -> None:
            try:
                for chunk in waiting:  # each worker takes the next
                    if halt.is_set():
                        break
                    if done := train(chunk, device, halt.is_set, events.put):
                        keep(folder, done)
                        events.put(done)
                events.put(None)
            except BaseException as error:
                events.put(error)

        if stopped():
            return
        with ThreadPoolExecutor(self.workers) as pool:  # its end waits: Python must not exit with a thread inside XLA
            try:
                pool.map(work, self.devices)
                working = self.workers
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


class _Program(NamedTuple):
    """What trains the chunks of one key on one device."""

    trainer: Trainer
    init: Any
    programs: driver.Programs


_compiled: OrderedDict[tuple[str, int, Any], _Program] = OrderedDict()
_compiling = threading.Lock()


def _program(chunk: Chunk, device: Any, say: Callable[[Event], None]) -> _Program:
    """The compiled program of a chunk: one of those that this process has, else made now, by one thread at a time."""
    key = chunk.static, chunk.size, device
    with _compiling:
        if key not in _compiled:
            say(Compiling(chunk.program, chunk.size))
            while len(_compiled) >= PROGRAMS:
                _compiled.popitem(last=False)
            _compiled[key] = _compile(chunk, device)
        _compiled.move_to_end(key)
        return _compiled[key]


def _compile(chunk: Chunk, device: Any) -> _Program:
    trainer = make_trainer(tasks.environment(chunk.task), chunk.learner)
    seeds, inputs = _inputs(chunk, device)
    states = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=SingleDeviceSharding(device)),
        jax.eval_shape(trainer.init, seeds, inputs),
    )
    train, apg, fly = (
        compiled(trainer, states, inputs) for compiled in (driver.compile_train, driver.compile_apg, driver.compile_fly)
    )
    programs = driver.Programs(lambda: train, lambda: apg, lambda: fly, trainer.gather)
    return _Program(trainer, trainer.init.lower(seeds, inputs).compile(), programs)


def _inputs(chunk: Chunk, device: Any) -> tuple[jax.Array, MemberInputs]:
    """Seeds and inputs of the members on the device, the last one repeated."""
    padded = chunk.members + [chunk.members[-1]] * (chunk.size - len(chunk.members))
    seeds = np.asarray([member.seed for member in padded], np.int32)
    return jax.device_put((seeds, stack([member.inputs for member in padded])), device)


def train(chunk: Chunk, device: Any, halted: Callable[[], bool], say: Callable[[Event], None]) -> ChunkDone | None:
    """Train a chunk to its end, or until it is pruned; None if `halted()` before."""
    program = _program(chunk, device, say)
    prune = chunk.pruning.rule() if chunk.pruning else None
    start_time, pruned = time.perf_counter(), False
    seeds, inputs = _inputs(chunk, device)
    states = program.init(seeds, inputs)
    rows: list[list[Row]] = [[] for _ in chunk.members]
    faults: list[str] = []
    config = program.trainer.config
    for update in driver.run_chunks(states, inputs, program.programs, config, driver.Clock(), halted):
        faults = update.faults
        for kept, row in zip(rows, update.rows, strict=False):  # without the padding
            share = {"train_seconds": round(row["train_seconds"] / len(chunk.members), 3)}
            kept.append({key: value for key, value in (row | share).items() if key != "steps_per_second"})
        say(Progress(chunk.index, update.env_steps * len(chunk.members)))
        if prune and update.rows and prune([kept[-1] for kept in rows], faults):
            pruned = True
            break
    if not pruned and not all(kept and kept[-1]["env_steps"] == chunk.steps for kept in rows):
        return None
    results = {member.index: Result(rows[i], faults[i]) for i, member in enumerate(chunk.members)}
    return ChunkDone(chunk.index, results, time.perf_counter() - start_time)


def keep(folder: Path, done: ChunkDone) -> None:
    """Record a chunk, whole."""
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(folder / f"{done.chunk:07d}.json", json.dumps(record(done.results)) + "\n")


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

"""Many members through one compiled program: in chunks that fit into memory, each recorded whole once it is done.

A finished chunk is a file in the sweep's folder, written under another name and then renamed; whoever goes on with an
interrupted sweep, on however many devices or hosts, makes only the members that no file holds.
"""

import json
import math
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from qrl import loop
from qrl.runs import Row, replace_text
from qrl.train import Point, Trainer, TrainState, stack

# On a CPU a device takes its members one after the other: more gain no speed, and are what an interruption loses.
CPU_MEMBERS_PER_DEVICE = 8


class Member(NamedTuple):
    """One point with one seed."""

    index: int  # in the whole sweep: point · seeds + seed's place
    seed: int
    point: Point


@dataclass(frozen=True)
class Group:
    """Members that share one compiled program, and how many of them it takes at once."""

    trainer: Trainer
    members: list[Member]
    chunk: int

    @property
    def steps(self) -> int:
        """Environment steps of one member."""
        config = self.trainer.config
        return config.unrolls * config.unroll_size


class Result(NamedTuple):
    """What is kept of a member."""

    rows: list[Row]  # as in metrics.csv; `train_seconds` is its share of the chunk's
    diverged: str  # what was first not finite, and when; "": nothing


@dataclass(frozen=True)
class Compiling:
    """About to compile a group's programs."""

    group: Group


@dataclass(frozen=True)
class Progress:
    """A sign of life: how far the members of the chunk under way are, and of which group."""

    group: Group
    members: int
    share: float


@dataclass(frozen=True)
class ChunkDone:
    """A chunk is recorded."""

    group: Group
    results: dict[int, Result]
    seconds: float


def member_bytes(trainer: Trainer, point: Point) -> int:
    """What a member needs on its device: its state, once more where the program writes it, and its flights."""
    states = jax.eval_shape(trainer.init, loop.seeds(0, _devices(trainer)), stack([point] * _devices(trainer)))
    flights = jax.eval_shape(
        trainer.fly, states.learner, stack([point] * _devices(trainer)), loop.report_starts(trainer.config)
    )
    return (2 * _bytes(states) + _bytes(flights)) // _devices(trainer)


def _devices(trainer: Trainer) -> int:
    return trainer.mesh.size


def _bytes(tree: Any) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def chunk_members(members: int, each_bytes: int, budget_bytes: float, devices: int) -> int:
    """Members of one chunk: a multiple of the devices, within the budget, chunks as even as can be; 0: none fits."""
    most = int(budget_bytes // each_bytes) // devices
    if jax.default_backend() == "cpu":
        most = min(most, CPU_MEMBERS_PER_DEVICE)
    if most < 1:
        return 0
    chunks = max(1, math.ceil(members / (most * devices)))
    return math.ceil(members / (chunks * devices)) * devices


def run(group: Group, folder: Path, stopped: Callable[[], bool]) -> Iterator[Compiling | Progress | ChunkDone]:
    """Train the members of a group that have no result yet, chunk by chunk; returns early once `stopped()`."""
    done = finished(folder)
    left = [member for member in group.members if member.index not in done]
    programs = None
    while left and not stopped():
        members, left = left[: group.chunk], left[group.chunk :]
        padded = members + [members[-1]] * (group.chunk - len(members))  # one program, one number of members
        points = group.trainer.place(stack([member.point for member in padded]))
        if programs is None:
            yield Compiling(group)
        states = group.trainer.init(group.trainer.place(np.asarray([m.seed for m in padded], np.int32)), points)
        programs = programs or loop.Programs(
            loop.compile_advance(group.trainer, states, points), loop.compile_fly(group.trainer, states, points)
        )
        began = time.perf_counter()
        results = yield from _chunk(group, programs, states, points, members, stopped)
        if results is not None:
            folder.mkdir(parents=True, exist_ok=True)
            _record(folder / f"{members[0].index:07d}.json", results)
            yield ChunkDone(group, results, time.perf_counter() - began)


def _chunk(
    group: Group,
    programs: loop.Programs,
    states: TrainState,
    points: Point,
    members: list[Member],
    stopped: Callable[[], bool],
) -> Generator[Progress, None, dict[int, Result] | None]:
    """Train a chunk to its end; its results by member, or None if it was stopped on the way."""
    rows: list[list[Row]] = [[] for _ in members]
    for lap in loop.laps(states, points, programs, group.trainer.config, 0.0, stopped):
        states = lap.states
        for kept, row in zip(rows, lap.rows, strict=False):  # what fills the chunk up is not kept
            share = {"train_seconds": round(row["train_seconds"] / len(members), 3)}
            kept.append({key: v for key, v in (row | share).items() if key != "steps_per_second"})
        yield Progress(group, len(members), lap.env_steps / group.steps)
    if any(len(kept) == 0 or kept[-1]["env_steps"] < group.steps for kept in rows):
        return None
    return {member.index: Result(rows[i], loop.fault(states, i)) for i, member in enumerate(members)}


def _record(path: Path, results: dict[int, Result]) -> None:
    # Numbers that are not finite as text: JSON has none.
    members = {
        index: {"rows": [{k: v if np.isfinite(v) else str(v) for k, v in row.items()} for row in rows], "diverged": why}
        for index, (rows, why) in results.items()
    }
    replace_text(path, json.dumps({"members": members}) + "\n")


def finished(folder: Path) -> dict[int, Result]:
    """The results in a sweep's folder of chunks, by member."""
    results = {}
    for path in sorted(folder.glob("*.json")):
        for index, kept in json.loads(path.read_text(encoding="utf-8"))["members"].items():
            rows = [{k: float(v) if isinstance(v, str) else v for k, v in row.items()} for row in kept["rows"]]
            results[int(index)] = Result(rows, kept["diverged"])
    return results

"""A run from start to end on the host: compile, advance, report, record, save; stop and go on."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from qrl.algorithm.flights import Flights
from qrl.algorithm.types import Env
from qrl.runs import checkpoint, files
from qrl.runs import record as runs
from qrl.runs.checkpoint import Checkpoint
from qrl.runs.files import Row
from qrl.runs.integrity import Record
from qrl.runs.record import RunConfig
from qrl.runs.tensorboard import EventLog
from qrl.training import multihost, restore
from qrl.training.driver import (
    Clock,
    Lap,
    NotFinite,
    Programs,
    compile_advance,
    compile_climb,
    compile_fly,
    laps,
    report_starts,
    seeds,
)
from qrl.training.sharding import spread
from qrl.training.state import point, stack
from qrl.training.trainer import Trainer

SAVE_SECONDS = 60.0  # of training, at most, between two checkpoints


@dataclass(frozen=True)
class GoingOn:
    """Training goes on from a checkpoint, or from the start where none was whole."""

    env_steps: int
    notes: list[str]  # what was wrong with later ones


@dataclass(frozen=True)
class Compiling:
    """About to compile."""


@dataclass(frozen=True)
class Compiled:
    """Compiled, and all else is ready to train."""


@dataclass(frozen=True)
class Progress:
    """A sign of life between reports."""

    env_steps: int
    steps_per_second: float
    seconds_left: float


@dataclass(frozen=True)
class Reported:
    """A report was made and recorded, and is being saved."""

    rows: list[Row]  # one for each seed
    seconds_left: float


@dataclass(frozen=True)
class Finished:
    """All steps are made and saved; the policies that ship, flown once more from the reports' starts."""

    flights: Flights  # leading axis: seeds
    rows: list[list[Row]]  # of each seed


Event = GoingOn | Compiling | Compiled | Progress | Reported | Finished


class Member:
    """What the host keeps of one seed."""

    def __init__(self, folder: Path, run: RunConfig, env_steps: int, rows: list[Row]) -> None:
        self.folder = folder
        self.rows = rows
        self.checkpoints = checkpoint.Writer(folder, run)
        self._tensorboard = EventLog(folder / "tensorboard", purge_step=env_steps + 1)
        files.write_metrics(folder, rows)  # those after the checkpoint are cut

    def record(self, row: Row) -> None:
        self.checkpoints.check()
        self.rows.append(row)
        files.write_metrics(self.folder, self.rows)
        self._tensorboard.add(row)

    def save(self, env_steps: int, state: Any, clock: Clock) -> None:
        self.checkpoints.save(Checkpoint(env_steps, state, Record(rows=list(self.rows), **clock._asdict())))

    def close(self) -> None:
        self.checkpoints.close()
        self._tensorboard.close()


def train(env: Env, run: RunConfig, out: Path, *, resume: bool, stopped: Callable[[], bool]) -> Iterator[Event]:
    """Train into the run folder(s) of `out`, from the last whole checkpoint if `resume`; yields what happens.

    Returns early, all saved, once `stopped()` is true. Raises NotFinite with the last good checkpoint kept. Where a run
    has several processes, the first alone reads and writes.
    """
    trainer = Trainer(env, run.learner, spread(jax.devices(), run.seeds, run.learner.shard_count))
    points = stack([point(env, run.learner)] * run.seeds)
    folders = runs.members(out, run) if multihost.first() else []
    configs = [run.member(i) for i in range(run.seeds)]
    begin, clock, rows = 0, Clock(), [[] for _ in folders]
    like = restore.shapes(trainer, points)
    states: Any = None
    members: list[Member] = []
    # Side by side: each takes XLA seconds, and has little use for a second core.
    aside = ThreadPoolExecutor()
    try:
        yield Compiling()
        advance = aside.submit(compile_advance, trainer, trainer.laid_out(like), points)
        fly = aside.submit(compile_fly, trainer, trainer.laid_out(like), points)
        if resume:
            found = restore.latest(folders, configs, like) if folders else restore.Restored(0, None, [], [])
            begin = int(multihost.firsts(np.int32(found.env_steps)))
            if found.records:
                rows = [list(record.rows) for record in found.records]
                clock = Clock(found.records[0].train_seconds, found.records[0].report_seconds)
            if begin:
                empty = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like)
                states = trainer.place(multihost.firsts(found.states if folders else empty))
                clock = Clock(
                    *map(float, multihost.firsts(np.array(clock)))
                )  # the same on all: they have to save together
            yield GoingOn(begin, found.notes)
        if not begin:
            states = trainer.init(seeds(run.seed, run.seeds), points)
        programs = Programs(
            advance=advance.result(),
            fly=fly.result(),
            climb=aside.submit(compile_climb, trainer, trainer.laid_out(like), points).result,  # while training goes on
            on_host=trainer.on_host,
        )
        members = [Member(folder, configs[i], begin, rows[i]) for i, folder in enumerate(folders)]
        yield Compiled()
        saver = _Saver(trainer, run, members, clock)
        for lap in laps(states, points, programs, run.learner, clock, stopped, multihost.everyones):
            states, begin = lap.states, lap.env_steps
            yield saver.heed(lap)
        saver.end()
        if begin == run.learner.num_unrolls * run.learner.steps_per_unroll:
            flights = programs.on_host(programs.fly(states.learner, points, report_starts(run.learner)))
            yield Finished(flights, [member.rows for member in members])
    finally:
        aside.shutdown(cancel_futures=True)
        for member in members:
            member.close()


class _Saver:
    """Records and saves what laps bring."""

    def __init__(self, trainer: Trainer, run: RunConfig, members: list[Member], clock: Clock) -> None:
        self._trainer = trainer
        self._run = run
        self._members = members  # none, where another process writes
        self._lap: Lap | None = None  # not saved yet
        self._saved_at = clock.train_seconds

    def heed(self, lap: Lap) -> Progress | Reported:
        self._check(lap)
        # The row first: killed between the two, a resumed run cuts it and makes it again.
        for member, row in zip(self._members, lap.rows, strict=False):
            member.record(row)
        self._lap = lap
        if lap.rows or lap.clock.train_seconds - self._saved_at >= SAVE_SECONDS:
            self._save(lap)
        if lap.rows:
            return Reported(lap.rows, lap.seconds_left)
        return Progress(lap.env_steps, lap.steps_per_second, lap.seconds_left)

    def end(self) -> None:
        """Until all is on disk."""
        if self._lap:
            self._save(self._lap)
        for member in self._members:
            member.checkpoints.wait()

    def _save(self, lap: Lap) -> None:
        for i in range(self._run.seeds):
            state = self._trainer.member(lap.states, i)
            if self._members:
                self._members[i].save(lap.env_steps, state, lap.clock)
        self._lap, self._saved_at = None, lap.clock.train_seconds

    def _check(self, lap: Lap) -> None:
        for member in self._members:
            member.checkpoints.check()
        for i, what in enumerate(lap.faults):
            if what:
                where, kept = self._kept(i)
                raise NotFinite(f"{where}seed {self._run.seed + i}: {what}; {kept}")

    def _kept(self, i: int) -> tuple[str, str]:
        if not self._members:
            return "", "the first process says what is kept"
        member = self._members[i]
        member.checkpoints.wait()
        saved = checkpoint.steps(member.folder)
        kept = f"the checkpoint at step {saved[0]:,} is kept" if saved else "no checkpoint had been made yet"
        return f"{member.folder}: ", kept


def finished(out: Path, run: RunConfig) -> bool:
    """Whether the run in `out` has nothing left to do: its summaries are written last."""
    return all((folder / "summary.json").is_file() for folder in {out, *runs.members(out, run)})

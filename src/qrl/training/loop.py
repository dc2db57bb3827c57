"""A run on the host: compile, train, report, record and save; stop and resume."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm.flights import Flights
from qrl.algorithm.running_statistics import RunningStatistics
from qrl.algorithm.types import Env
from qrl.runs import checkpoint, files, record
from qrl.runs.checkpoint import Checkpoint, Record
from qrl.runs.files import Row
from qrl.runs.record import RunConfig
from qrl.runs.tensorboard import EventLog
from qrl.training import driver, multihost, restore, sharding
from qrl.training.driver import Chunk, Clock, NotFinite, Programs
from qrl.training.state import TrainState, member_inputs, stack
from qrl.training.traced import Store
from qrl.training.trainer import Trainer, make_trainer

SAVE_SECONDS = 60.0  # of training, at most, between two checkpoints
SAVE_SHARE = 0.25  # of the time of training, at most, for checkpoints of several members more often than that


@dataclass(frozen=True)
class Resumed:
    """Training resumes from a checkpoint, or from the start where none is valid."""

    env_steps: int
    notes: list[str]  # what was wrong with later ones


@dataclass(frozen=True)
class Compiling:
    """About to compile."""


@dataclass(frozen=True)
class Compiled:
    """Ready to train; what is needed later is still being compiled."""


@dataclass(frozen=True)
class Progress:
    """A heartbeat between reports."""

    env_steps: int
    steps_per_second: float
    seconds_left: float


@dataclass(frozen=True)
class LearningExtended:
    """At the planned end of learning these members do not fly yet: seed -> environment steps at which APG begins."""

    until: dict[int, int]


@dataclass(frozen=True)
class Reported:
    """A report is recorded."""

    rows: list[Row]  # one for each seed
    seconds_left: float


@dataclass(frozen=True)
class Finished:
    """All steps are made and saved; the deployed policies' flights from the reports' starts."""

    flights: Flights  # leading axis: seeds
    rows: list[list[Row]]  # of each seed


Event = Resumed | Compiling | Compiled | Progress | LearningExtended | Reported | Finished


class Member:
    """The run folder of one seed, open for writing."""

    def __init__(
        self, folder: Path, run: RunConfig, env_steps: int, rows: list[Row], saving: ThreadPoolExecutor
    ) -> None:
        self.folder = folder
        self.rows = rows
        self.checkpoints = checkpoint.Writer(folder, run, saving)
        self._tensorboard = EventLog(folder / "tensorboard", purge_step=env_steps + 1)
        files.write_metrics(folder, rows)  # rows after the checkpoint are cut

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


def train(
    env: Env,
    run: RunConfig,
    out: Path,
    *,
    resume: bool,
    stopped: Callable[[], bool],
    policy: Callable[[], tuple[Any, RunningStatistics]] | None = None,
    store: Store | None = None,
) -> Iterator[Event]:
    """Train into the run folder(s) of `out`, from the last valid checkpoint if `resume`; yields what happens.

    `policy` gives the network's numbers that the run begins with, and the statistics of observations: by default
    random numbers, and none. `store` keeps traced programs, for `env` as the run describes it.

    Returns early, all saved, once `stopped()` is true. Raises NotFinite with the last good checkpoint kept. Of several
    processes only the coordinator reads and writes.
    """
    mesh = sharding.make_mesh(jax.devices(), run.seeds, run.learner.shard_count)
    trainer = make_trainer(env, run.learner, mesh)
    inputs = stack([member_inputs(env, run.learner)] * run.seeds)
    folders = record.member_folders(out, run) if multihost.is_coordinator() else []
    configs = [run.member(i) for i in range(run.seeds)]
    target, init = driver.compile_init(trainer, run.seeds, inputs, store)
    abstract = sharding.abstract_sharded(mesh, target)
    members: list[Member] = []
    saving = ThreadPoolExecutor(1, "checkpoint")
    executor = ThreadPoolExecutor(2)  # compiles programs, the first that is needed first
    try:
        yield Compiling()
        first, second, last = ("apg", "fly", "train") if run.learner.all_apg else ("train", "fly", "apg")
        compiled = {first: executor.submit(driver.lower(trainer, first, abstract, inputs, store))}
        begin, states, clock, rows = 0, None, Clock(), [[] for _ in folders]
        if resume:
            begin, states, clock, rows, notes = _resume(trainer, folders, configs, target)
            yield Resumed(begin, notes)
        if states is None:
            states = init(driver.seeds(run.seed, run.seeds), inputs)
            states = _beginning_with(states, *policy()) if policy else states
        compiled[second] = executor.submit(driver.lower(trainer, second, abstract, inputs, store))
        # The last is traced there, too, while training goes on.
        compiled[last] = executor.submit(lambda: driver.lower(trainer, last, abstract, inputs, store)())
        for i, folder in enumerate(folders):
            members.append(Member(folder, configs[i], begin, rows[i], saving))
        compiled[first].result()
        programs = Programs(**{name: future.result for name, future in compiled.items()}, gather=trainer.gather)
        yield Compiled()
        recorder = _Recorder(trainer, run, members, clock)
        for chunk in driver.run_chunks(states, inputs, programs, run.learner, clock, stopped, multihost.all_gather):
            states, begin = chunk.states, chunk.env_steps
            yield recorder.handle(chunk)
            if chunk.extended:
                yield LearningExtended({run.seed + i: steps for i, steps in chunk.extended.items()})
        recorder.finish()
        if begin == run.learner.num_unrolls * run.learner.steps_per_unroll:
            flights = programs.gather(programs.fly()(states.learner, inputs))
            yield Finished(flights, [member.rows for member in members])
    finally:
        executor.shutdown(cancel_futures=True)
        for member in members:
            member.close()
        saving.shutdown()


def _beginning_with(states: TrainState, policy: Any, statistics: RunningStatistics) -> TrainState:
    """`states` with the policy of every member, and its statistics where they are of as many observations."""

    def filled(now: Any, new: Any) -> Any:
        # Added to zeros of the state, for these are placed as the programs expect it.
        return jax.tree.map(lambda old, x: jnp.zeros_like(old) + jnp.asarray(x, old.dtype), now, new)

    learner = states.learner
    params = learner.params._replace(policy=filled(learner.params.policy, policy))
    if learner.statistics.mean.shape[-1] == statistics.mean.shape[-1]:
        learner = learner._replace(statistics=filled(learner.statistics, statistics))
    average = filled(learner.average, policy)
    return states._replace(learner=learner._replace(params=params, average=average))


def _resume(
    trainer: Trainer, folders: list[Path], configs: list[RunConfig], target: TrainState
) -> tuple[int, TrainState | None, Clock, list[list[Row]], list[str]]:
    """Environment steps, placed states (None: from the start), clock, rows of each member, and notes."""
    found = restore.restore_common(folders, configs, target) if folders else restore.Restored(0, None, [], [])
    begin = int(multihost.broadcast(np.int32(found.env_steps)))
    rows = [list(record.rows) for record in found.records] or [[] for _ in folders]
    clock = Clock(found.records[0].train_seconds, found.records[0].report_seconds) if found.records else Clock()
    if not begin:
        return 0, None, clock, rows, found.notes
    empty = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), target)
    states = sharding.device_put(trainer.setup.mesh, multihost.broadcast(found.states if folders else empty))
    clock = Clock(*map(float, multihost.broadcast(np.array(clock))))  # the same everywhere: all save together
    return begin, states, clock, rows, found.notes


class _Recorder:
    """Records and saves chunks."""

    def __init__(self, trainer: Trainer, run: RunConfig, members: list[Member], clock: Clock) -> None:
        self._trainer = trainer
        self._run = run
        self._members = members  # none where another process writes
        self._unsaved: Chunk | None = None
        self._saved_at = clock.train_seconds

    def handle(self, chunk: Chunk) -> Progress | Reported:
        self._check(chunk)
        # The row first: after a kill between the two, a resumed run cuts it and makes it again.
        for member, row in zip(self._members, chunk.rows, strict=False):
            member.record(row)
        self._unsaved = chunk
        seconds = chunk.clock.train_seconds - self._saved_at
        if seconds >= SAVE_SECONDS or (chunk.rows and not self._too_soon(seconds)):
            self._save(chunk)
        if chunk.rows:
            return Reported(chunk.rows, chunk.seconds_left)
        return Progress(chunk.env_steps, chunk.steps_per_second, chunk.seconds_left)

    def finish(self) -> None:
        """Save what is not saved, and wait until all is on disk."""
        if self._unsaved:
            self._save(self._unsaved)
        for member in self._members:
            member.checkpoints.wait()

    def _too_soon(self, seconds: float) -> bool:
        """Whether to save several members again, after `seconds` of training, took too much of the time."""
        if self._run.seeds == 1:
            return False
        writers = [member.checkpoints for member in self._members]
        taken = sum(writer.seconds for writer in writers)
        too_soon = taken > SAVE_SHARE * seconds or any(writer.busy for writer in writers)
        return bool(multihost.all_gather(too_soon).any())  # the same in all processes

    def _save(self, chunk: Chunk) -> None:
        for i, state in enumerate(self._trainer.members(chunk.states)):
            if self._members:
                self._members[i].save(chunk.env_steps, state, chunk.clock)
        self._unsaved, self._saved_at = None, chunk.clock.train_seconds

    def _check(self, chunk: Chunk) -> None:
        for member in self._members:
            member.checkpoints.check()
        for i, fault in enumerate(chunk.faults):
            if fault:
                where, kept = self._last_checkpoint(i)
                raise NotFinite(f"{where}seed {self._run.seed + i}: {fault}; {kept}")

    def _last_checkpoint(self, i: int) -> tuple[str, str]:
        if not self._members:
            return "", "process 0 reports the last checkpoint"
        member = self._members[i]
        member.checkpoints.wait()
        saved = checkpoint.saved_steps(member.folder)
        kept = f"the checkpoint at step {saved[0]:,} is kept" if saved else "no checkpoint had been made yet"
        return f"{member.folder}: ", kept


def finished(out: Path, run: RunConfig) -> bool:
    """Whether the run in `out` is complete: its summaries are written last."""
    return all((folder / "summary.json").is_file() for folder in {out, *record.member_folders(out, run)})

"""A run from start to end on the host: compile, advance, evaluate, record, save; stop and go on."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from brax.envs.base import Env
from tensorboardX import SummaryWriter

from qrl import checkpoint, runs
from qrl.config import Config
from qrl.evaluate import Flights, summarise
from qrl.learner import LearnerState
from qrl.runs import Row, RunConfig
from qrl.train import FAULT_TERMS, Point, Totals, Trainer, TrainState, point, stack

REPORT_STARTS_SEED = 20_061_122  # the fixed starts of every report of every run
CHUNK_SECONDS = 1.0  # how long the device works between two signs of life


class NotFinite(RuntimeError):
    """A number in training is not finite; the message says which, where and what was kept."""


@dataclass(frozen=True)
class Compiling:
    """About to compile this."""

    what: str


@dataclass(frozen=True)
class Progress:
    """A sign of life between reports."""

    env_steps: int
    steps_per_second: float
    seconds_left: float


@dataclass(frozen=True)
class Reported:
    """A report was made, recorded and saved."""

    rows: list[Row]  # one for each seed
    seconds_left: float


@dataclass(frozen=True)
class Finished:
    """All steps are made; the policies that ship, flown once more from the reports' starts."""

    flights: Flights  # leading axis: seeds


Event = Compiling | Progress | Reported | Finished


@dataclass(frozen=True)
class Lap:
    """Members have come this far; `states` are alive until the next lap is asked for."""

    states: TrainState
    env_steps: int
    steps_per_second: float
    seconds_left: float
    rows: list[Row]  # where a report is due: one for each member


@dataclass(frozen=True)
class Programs:
    """A trainer's programs, compiled for a number of members."""

    advance: Callable[[TrainState, Point, np.int32], TrainState]
    fly: Callable[[LearnerState, Point, jax.Array], Flights]


@dataclass
class Member:
    """What the host keeps of one seed."""

    folder: Path
    checkpoints: ocp.CheckpointManager
    writer: SummaryWriter
    rows: list[Row]

    def record(self, row: Row) -> None:
        self.rows.append(row)
        runs.write_metrics(self.folder, self.rows)
        for name, value in row.items():
            if name != "env_steps" and np.isfinite(value):
                self.writer.add_scalar(name, value, int(row["env_steps"]))
        self.writer.flush()


def train(env: Env, run: RunConfig, out: Path, *, resume: bool, stopped: Callable[[], bool]) -> Iterator[Event]:
    """Train into the run folder(s) of `out`, from the last checkpoint if `resume`; yields what happens.

    Returns early, all saved, once `stopped()` is true. Raises NotFinite with the last good checkpoint kept.
    """
    trainer = Trainer(env, run.learner)
    points = stack([point(env, run.learner)] * run.seeds)
    members = [
        Member(folder, checkpoint.manager(folder), SummaryWriter(str(folder / "tensorboard")), [])
        for folder in runs.members(out, run)
    ]
    try:
        yield Compiling("first state")
        states = trainer.init(seeds(run.seed, run.seeds), points)
        if resume:
            states = _restore_latest(states, members)
        yield Compiling("training")
        advance = compile_advance(trainer, states, points)
        yield Compiling("evaluation")
        programs = Programs(advance, compile_fly(trainer, states, points))
        yield from _advance_and_report(states, points, programs, run, members, stopped)
    finally:
        for member in members:
            member.writer.close()
            member.checkpoints.close()


def compile_advance(trainer: Trainer, states: TrainState, points: Point) -> Any:
    return trainer.advance.lower(states, points, np.int32(0)).compile()


def compile_fly(trainer: Trainer, states: TrainState, points: Point) -> Any:
    return trainer.fly.lower(states.learner, points, report_starts(trainer.config)).compile()


def seeds(first: int, count: int) -> np.ndarray:
    return np.arange(first, first + count, dtype=np.int32)


def report_starts(config: Config) -> jax.Array:
    """Keys of the starts that every report of every run flies."""
    return jax.random.split(jax.random.PRNGKey(REPORT_STARTS_SEED), config.report_flights)


def _advance_and_report(
    states: TrainState,
    points: Point,
    programs: Programs,
    run: RunConfig,
    members: list[Member],
    stopped: Callable[[], bool],
) -> Iterator[Event]:
    lap, saved = None, True
    clock = members[0].rows[-1]["train_seconds"] if members[0].rows else 0.0
    for lap in laps(states, points, programs, run.learner, clock, stopped):
        states = lap.states
        _check(states, run, members)
        saved = bool(lap.rows)
        if not lap.rows:
            yield Progress(lap.env_steps, lap.steps_per_second, lap.seconds_left)
            continue
        # The row first: killed between the two, a resumed run cuts it and makes it again.
        for member, row in zip(members, lap.rows, strict=True):
            member.record(row)
        _save(states, members, lap.env_steps)
        yield Reported(lap.rows, lap.seconds_left)
    if int(states.unrolls[0]) == run.learner.unrolls:
        yield Finished(programs.fly(states.learner, points, report_starts(run.learner)))
    elif lap and not saved:
        _save(states, members, lap.env_steps)


def laps(
    states: TrainState,
    points: Point,
    programs: Programs,
    config: Config,
    clock: float,
    stopped: Callable[[], bool],
) -> Iterator[Lap]:
    """Advance all members to the end or until `stopped()`, a lap about CHUNK_SECONDS; `clock`: seconds trained."""
    done = first = int(states.unrolls[0])
    count, starts = len(states.unrolls), report_starts(config)
    began = time.perf_counter()
    since_report, chunk = 0.0, 1
    while done < config.unrolls and not stopped():
        report_at = min(config.unrolls, (done // config.unrolls_per_report + 1) * config.unrolls_per_report)
        until = min(report_at, done + chunk)
        lap = time.perf_counter()
        states = jax.block_until_ready(programs.advance(states, points, np.int32(until)))
        lap = time.perf_counter() - lap
        clock, since_report = clock + lap, since_report + lap
        chunk = max(1, round((until - done) * CHUNK_SECONDS / lap))
        speed = (until - done) * config.unroll_size * count / lap
        done = until
        left = (time.perf_counter() - began) / (done - first) * (config.unrolls - done)
        rows: list[Row] = []
        if done == report_at:
            rows = _rows(config, states, programs.fly(states.learner, points, starts), clock, since_report)
            states = states._replace(totals=jax.tree.map(jnp.zeros_like, states.totals))
            since_report = 0.0
        yield Lap(states, done * config.unroll_size, speed, left, rows)


def restore(env: Env, run: RunConfig, folder: Path) -> tuple[Trainer, TrainState, int]:
    """Trainer, state (leading axis: one member) and environment steps of a seed's last checkpoint.

    Raises FileNotFoundError, naming the folder, where there is none.
    """
    if not (folder / "checkpoints").is_dir():
        raise FileNotFoundError(f"{folder}: no checkpoint")
    trainer = Trainer(env, run.learner)
    with checkpoint.manager(folder) as saved:
        latest = saved.latest_step()
        if latest is None:
            raise FileNotFoundError(f"{folder}: no checkpoint")
        like = jax.eval_shape(trainer.init, seeds(0, 1), stack([point(env, run.learner)]))
        state = checkpoint.restore(saved, latest, _one(like))
    return trainer, jax.tree.map(jnp.asarray, stack([state])), latest


def _one(states: TrainState) -> TrainState:
    """Shapes and types of one member."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)


def _restore_latest(states: TrainState, members: list[Member]) -> TrainState:
    """The last checkpoint that every seed has, later ones and later rows dropped; `states` where there is none."""
    common = set.intersection(*[set(member.checkpoints.all_steps()) for member in members])
    latest = max(common, default=0)
    for member in members:
        member.rows = [row for row in runs.read_metrics(member.folder) if row["env_steps"] <= latest]
        for step in member.checkpoints.all_steps():
            if step > latest:
                member.checkpoints.delete(step)
    if not latest:
        return states
    like = _one(states)
    return jax.tree.map(jnp.asarray, stack([checkpoint.restore(m.checkpoints, latest, like) for m in members]))


def _save(states: TrainState, members: list[Member], env_steps: int) -> None:
    for i, member in enumerate(members):
        checkpoint.save(member.checkpoints, env_steps, checkpoint.member(states, i))


def _check(states: TrainState, run: RunConfig, members: list[Member]) -> None:
    for i, member in enumerate(members):
        if what := fault(states, i):
            latest = member.checkpoints.latest_step()
            kept = f"the checkpoint at step {latest:,} is kept" if latest else "no checkpoint had been made yet"
            raise NotFinite(f"{member.folder}: seed {run.seed + i}: {what}; {kept}")


def fault(states: TrainState, member: int) -> str:
    """What was first not finite in a member's training, and when; "" if nothing was."""
    update, term = int(states.fault_update[member]), int(states.fault_term[member])
    return f"{FAULT_TERMS[term]} is not finite in update {update:,}" if update >= 0 else ""


def _rows(config: Config, states: TrainState, flights: Flights, clock: float, seconds: float) -> list[Row]:
    totals: Totals = jax.tree.map(np.asarray, states.totals)
    rows: list[Row] = []
    for i in range(len(totals.steps)):
        count = max(float(totals.updates[i]), 1.0)
        summary = summarise(jax.tree.map(lambda x, i=i: x[i], flights))
        rows.append(
            {
                "env_steps": int(states.unrolls[i]) * config.unroll_size,
                "updates": int(states.learner.updates[i]),
                **{name: summary.pop(name) for name in ("return_mean", "return_min", "success")},
                "train_seconds": round(clock, 3),
                **summary,
                "reward_mean": float(totals.rewards[i] / totals.steps[i]),
                "ended_early": float(totals.early[i] / max(float(totals.episodes[i]), 1.0)),
                **{name: float(value[i]) / count for name, value in totals.terms._asdict().items()},
                "steps_per_second": round(float(totals.steps.sum()) / seconds, 1),
            }
        )
    return rows


def finished(out: Path, run: RunConfig) -> bool:
    """Whether the run in `out` has nothing left to do: its summaries are written last."""
    return all((folder / "summary.json").exists() for folder in {out, *runs.members(out, run)})

"""The host's side of training: run the compiled programs in chunks, and make the reports that are due."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm.flights import Flights, summarize
from qrl.algorithm.learner import LearnerState
from qrl.config import Config
from qrl.runs.files import Row
from qrl.training import multihost, sharding, traced
from qrl.training.state import FAULT_TERMS, MemberInputs, Totals, TrainState
from qrl.training.traced import Store
from qrl.training.trainer import DONATED, Trainer

REPORT_STARTS_SEED = 20_061_122  # the fixed starts of every report of every run
CHUNK_SECONDS = 1.0  # target duration of one call of a compiled program
HANDOVER_SHARE = 0.9  # share of a report's flights within the bounds from which APG may begin


class NotFinite(RuntimeError):
    """A number in training is not finite; the message says which, when, and which checkpoint is kept."""


class Clock(NamedTuple):
    """Seconds of training, without evaluation and without waiting for compilation, which may go on beside the first."""

    train_seconds: float = 0.0
    report_seconds: float = 0.0  # of these, since the last report


@dataclass(frozen=True)
class Chunk:
    """The members after one call of a program; `states` are valid until the next chunk is asked for."""

    states: TrainState
    env_steps: int
    steps_per_second: float
    seconds_left: float
    clock: Clock
    rows: list[Row]  # one for each member where a report is due, else none
    extended: dict[int, int]  # member that does not fly yet -> environment steps at which APG begins now
    faults: list[str]  # of each member: what was first not finite, and when; "": nothing


Program = Callable[[TrainState, MemberInputs, np.int32], TrainState]


@dataclass(frozen=True)
class Programs:
    """A trainer's programs for a number of members, each got when it is needed, since it may still be compiling."""

    train: Callable[[], Program]
    apg: Callable[[], Program]
    fly: Callable[[], Callable[[LearnerState, MemberInputs], Flights]]
    gather: Callable[[Any], Any]


def compile_init(trainer: Trainer, count: int, inputs: MemberInputs, store: Store | None = None) -> tuple[Any, Any]:
    """Shapes and types of the states of so many members, and what makes them, compiled when it is first called."""
    args: Any = seeds(0, count), inputs
    if everywhere := sharding.replicated(trainer.setup.mesh):
        args = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=everywhere), args)
    found = traced.find(store, "init", args) if store else None
    traced_once = jax.jit(trainer.init.__wrapped__)  # for its shapes and its program
    shapes = found.result if found else jax.eval_shape(traced_once, *args)

    def init(*given: Any) -> TrainState:
        program = found or (traced.trace(store, "init", traced_once, args) if store else None)
        return program.lower(args, trainer.effort("init"))()(*given) if program else trainer.init(*given)

    return shapes, init


def lower(
    trainer: Trainer, name: str, states: TrainState, inputs: MemberInputs, store: Store | None = None
) -> Callable[[], Any]:
    """Trace a program, "train", "apg" or "fly", for arguments like these; what is returned compiles it.

    Threads that compile run side by side, those that trace in turn. Compiled it is None where a run has no such phase.
    """
    config = trainer.config
    if (name == "train" and config.all_apg) or (name == "apg" and not config.num_apg_updates):
        return lambda: None
    args = (states.learner, inputs) if name == "fly" else (states, inputs, np.int32(0))
    jitted = report_flights(trainer) if name == "fly" else getattr(trainer, name)
    program = traced.trace(store, name, jitted.__wrapped__, args) if store else None
    if program is None:
        return jitted.lower(*args).compile
    return program.lower(args, trainer.effort(name), DONATED.get(name))


def compile_train(trainer: Trainer, states: TrainState, inputs: MemberInputs, store: Store | None = None) -> Any:
    return lower(trainer, "train", states, inputs, store)()


def compile_apg(trainer: Trainer, states: TrainState, inputs: MemberInputs, store: Store | None = None) -> Any:
    return lower(trainer, "apg", states, inputs, store)()


def compile_fly(trainer: Trainer, states: TrainState, inputs: MemberInputs, store: Store | None = None) -> Any:
    return lower(trainer, "fly", states, inputs, store)()


def seeds(first: int, count: int) -> np.ndarray:
    return np.arange(first, first + count, dtype=np.int32)


def report_starts(config: Config) -> jax.Array:
    """Keys of the starts that every report of every run flies."""
    return jax.random.split(jax.random.PRNGKey(REPORT_STARTS_SEED), config.num_eval_envs)


def report_flights(trainer: Trainer) -> Any:
    """A jitted program: (learners [M], inputs [M]) -> the flights [M] of a report.

    It draws the starts itself: a program of their own, compiled beside larger ones, would wait for their threads.
    """

    def fly(learners: LearnerState, inputs: MemberInputs) -> Flights:
        return trainer.fly.__wrapped__(learners, inputs, report_starts(trainer.config))

    return jax.jit(fly, compiler_options=trainer.effort("fly"))


def run_chunks(
    states: TrainState,
    inputs: MemberInputs,
    programs: Programs,
    config: Config,
    clock: Clock,
    stopped: Callable[[], bool],
    all_gather: Callable[[float], np.ndarray] = multihost.single_process,
) -> Iterator[Chunk]:
    """Train all members to the end or until `stopped()`, in chunks of about CHUNK_SECONDS.

    Processes that share the members must make the same chunks: `all_gather` gives a value of each process.
    """
    done = first = int(programs.gather(states.unrolls)[0])
    count = len(states.unrolls)
    start_time = time.perf_counter()
    size = 1
    while done < config.num_unrolls and not all_gather(stopped()).any():
        due = (done // config.unrolls_per_eval + 1) * config.unrolls_per_eval
        report_at = config.align_to_apg_update(min(config.num_unrolls, due))
        handover = programs.gather(states.learning_unrolls)
        next_handover = min(handover[handover > done], default=config.num_unrolls)
        until = min(report_at, int(next_handover), config.align_to_apg_update(done + size))
        phases = [programs.train()] if (handover > done).any() else []
        phases += [programs.apg()] if (handover <= done).any() else []
        chunk_start = time.perf_counter()
        for program in phases:
            states = jax.block_until_ready(program(states, inputs, np.int32(until)))
        seconds = float(all_gather(time.perf_counter() - chunk_start)[multihost.COORDINATOR])
        clock = Clock(clock.train_seconds + seconds, clock.report_seconds + seconds)
        size = max(1, round((until - done) * CHUNK_SECONDS / seconds))
        speed = (until - done) * config.steps_per_unroll * count / seconds
        done = until
        made, ahead = config.estimated_cost(first, done), config.estimated_cost(done, config.num_unrolls)
        seconds_left = (time.perf_counter() - start_time) * ahead / made
        faults = _faults(programs.gather((states.fault_update, states.fault_term)))
        rows: list[Row] = []
        extended: dict[int, int] = {}
        handing_over = (handover == done) & (done < config.num_unrolls)
        if done == report_at or handing_over.any():
            flights: Flights = programs.gather(programs.fly()(states.learner, inputs))
            flies = flights.complete.mean(axis=1) >= HANDOVER_SHARE
            # A bounded gradient learns from flights that go wrong, too.
            waits = handing_over & ~flies & (config.apg_cotangent_norm is None)
            longer = np.where(waits, config.extended_learning(done), handover)
            extended = {int(i): longer[i] * config.steps_per_unroll for i in np.flatnonzero(longer > handover)}
            if extended:
                states = _with_learning_unrolls(states, config, longer)
            if done == report_at:
                updates, totals = programs.gather((states.learner.updates, states.totals))
                rows = _rows(done * config.steps_per_unroll, updates, totals, flights, clock)
                clock = clock._replace(report_seconds=0.0)
                states = states._replace(totals=jax.tree.map(jnp.zeros_like, states.totals))
        yield Chunk(states, done * config.steps_per_unroll, speed, seconds_left, clock, rows, extended, faults)


def _with_learning_unrolls(states: TrainState, config: Config, unrolls: np.ndarray) -> TrainState:
    """States whose learning phase ends after `unrolls` [M], with the schedules of a phase of that length."""
    planned = np.array([config.planned_updates(int(n)) for n in unrolls], np.int32)
    now = states.learner
    # Added to zeros of the state, for these are placed as the programs expect it.
    planned_updates = jnp.zeros_like(now.planned_updates) + planned
    return states._replace(
        learning_unrolls=jnp.zeros_like(states.learning_unrolls) + unrolls.astype(np.int32),
        learner=now._replace(planned_updates=planned_updates),
    )


def _faults(found: tuple[np.ndarray, np.ndarray]) -> list[str]:
    return [
        f"{FAULT_TERMS[term]} is not finite in update {update:,}" if update >= 0 else ""
        for update, term in zip(*found, strict=True)
    ]


def _rows(env_steps: int, updates: np.ndarray, totals: Totals, flights: Flights, clock: Clock) -> list[Row]:
    rows: list[Row] = []
    for i in range(len(updates)):
        count = max(float(totals.updates[i]), 1.0)
        summary = summarize(jax.tree.map(lambda x, i=i: x[i], flights))
        rows.append(
            {
                "env_steps": env_steps,
                "updates": int(updates[i]),
                **{name: summary.pop(name) for name in ("return_mean", "return_min", "success")},
                "train_seconds": round(clock.train_seconds, 3),
                **summary,
                "reward_mean": float(totals.rewards[i] / max(float(totals.steps[i]), 1.0)),
                "ended_early": float(totals.early[i] / max(float(totals.episodes[i]), 1.0)),
                "apg_skipped": float(totals.skipped[i]),
                **{name: float(value[i]) / count for name, value in totals.metrics._asdict().items()},
                "steps_per_second": round(float(totals.steps.sum()) / clock.report_seconds, 1),
            }
        )
    return rows

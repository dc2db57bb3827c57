"""Training as the host sees it: members advance lap by lap, and every so often a report is due."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm.flights import Flights, summarise
from qrl.algorithm.learner import LearnerState
from qrl.config import Config
from qrl.runs.files import Row
from qrl.training import multihost
from qrl.training.state import FAULT_TERMS, Point, Totals, TrainState
from qrl.training.trainer import Trainer

REPORT_STARTS_SEED = 20_061_122  # the fixed starts of every report of every run
CHUNK_SECONDS = 1.0  # how long the device works between two signs of life


class NotFinite(RuntimeError):
    """A number in training is not finite; the message says which, where and what was kept."""


class Clock(NamedTuple):
    """Seconds of training, without compilation and evaluation."""

    train_seconds: float = 0.0
    report_seconds: float = 0.0  # of these, since the last report


@dataclass(frozen=True)
class Lap:
    """Members have come this far; `states` are alive until the next lap is asked for."""

    states: TrainState
    env_steps: int
    steps_per_second: float
    seconds_left: float
    clock: Clock
    rows: list[Row]  # where a report is due: one for each member
    faults: list[str]  # of each member, what was first not finite in its training, and when; "": nothing


Advance = Callable[[TrainState, Point, np.int32], TrainState]


@dataclass(frozen=True)
class Programs:
    """A trainer's programs, compiled for a number of members."""

    advance: Advance
    climb: Callable[[], Advance]  # asked for when it is needed, so that it may still be compiling before
    fly: Callable[[LearnerState, Point, jax.Array], Flights]
    on_host: Callable[[Any], Any]


def compile_advance(trainer: Trainer, states: TrainState, points: Point) -> Any:
    return trainer.advance.lower(states, points, np.int32(0)).compile()


def compile_climb(trainer: Trainer, states: TrainState, points: Point) -> Any:
    """Of the run's last part; None where it has none."""
    return trainer.climb.lower(states, points, np.int32(0)).compile() if trainer.config.num_apg_updates else None


def compile_fly(trainer: Trainer, states: TrainState, points: Point) -> Any:
    return trainer.fly.lower(states.learner, points, report_starts(trainer.config)).compile()


def seeds(first: int, count: int) -> np.ndarray:
    return np.arange(first, first + count, dtype=np.int32)


def report_starts(config: Config) -> jax.Array:
    """Keys of the starts that every report of every run flies."""
    return jax.random.split(jax.random.PRNGKey(REPORT_STARTS_SEED), config.num_eval_envs)


def laps(
    states: TrainState,
    points: Point,
    programs: Programs,
    config: Config,
    clock: Clock,
    stopped: Callable[[], bool],
    hear: Callable[[float], np.ndarray] = multihost.alone,
) -> Iterator[Lap]:
    """Advance all members to the end or until `stopped()`, a lap about CHUNK_SECONDS.

    Processes that share the members have to make the same laps: `hear` tells what each of them says.
    """
    done = first = int(programs.on_host(states.unrolls)[0])
    count, starts = len(states.unrolls), report_starts(config)
    began = time.perf_counter()
    chunk = 1
    while done < config.num_unrolls and not hear(stopped()).any():
        due = (done // config.unrolls_per_eval + 1) * config.unrolls_per_eval
        report_at = config.align_to_apg_update(min(config.num_unrolls, due))
        learning = done < config.learning_unrolls
        until = min(
            report_at,
            config.learning_unrolls if learning else config.num_unrolls,
            config.align_to_apg_update(done + chunk),
        )
        advance = programs.advance if learning else programs.climb()
        started = time.perf_counter()
        states = jax.block_until_ready(advance(states, points, np.int32(until)))
        lap = float(hear(time.perf_counter() - started)[multihost.FIRST])
        clock = Clock(clock.train_seconds + lap, clock.report_seconds + lap)
        chunk = max(1, round((until - done) * CHUNK_SECONDS / lap))
        speed = (until - done) * config.steps_per_unroll * count / lap
        done = until
        left = (
            (time.perf_counter() - began)
            * config.estimated_cost(done, config.num_unrolls)
            / config.estimated_cost(first, done)
        )
        faults = _faults(programs.on_host((states.fault_update, states.fault_term)))
        rows: list[Row] = []
        if done == report_at:
            flights = programs.on_host(programs.fly(states.learner, points, starts))
            updates, totals = programs.on_host((states.learner.updates, states.totals))
            rows = _rows(config, done * config.steps_per_unroll, updates, totals, flights, clock)
            clock = clock._replace(report_seconds=0.0)
            states = states._replace(totals=jax.tree.map(jnp.zeros_like, states.totals))
        yield Lap(states, done * config.steps_per_unroll, speed, left, clock, rows, faults)


def _faults(found: tuple[np.ndarray, np.ndarray]) -> list[str]:
    return [
        f"{FAULT_TERMS[term]} is not finite in update {update:,}" if update >= 0 else ""
        for update, term in zip(*found, strict=True)
    ]


def _rows(
    config: Config, env_steps: int, updates: np.ndarray, totals: Totals, flights: Flights, clock: Clock
) -> list[Row]:
    rows: list[Row] = []
    for i in range(len(updates)):
        count = max(float(totals.updates[i]), 1.0)
        summary = summarise(jax.tree.map(lambda x, i=i: x[i], flights))
        rows.append(
            {
                "env_steps": env_steps,
                "updates": int(updates[i]),
                **{name: summary.pop(name) for name in ("return_mean", "return_min", "success")},
                "train_seconds": round(clock.train_seconds, 3),
                **summary,
                "reward_mean": float(totals.rewards[i] / max(float(totals.steps[i]), 1.0)),
                "ended_early": float(totals.early[i] / max(float(totals.episodes[i]), 1.0)),
                **{name: float(value[i]) / count for name, value in totals.terms._asdict().items()},
                "steps_per_second": round(float(totals.steps.sum()) / clock.report_seconds, 1),
            }
        )
    return rows

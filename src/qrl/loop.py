"""A run from start to end on the host: compile, advance, evaluate, record, save; pause and go on."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env
from tensorboardX import SummaryWriter

from qrl import checkpoint, runs
from qrl.evaluate import Flights
from qrl.runs import Row, RunConfig
from qrl.train import FAULT_TERMS, Totals, Trainer, TrainState

REPORT_STARTS_SEED = 20_061_122  # the fixed starts of every report of every run


class NotFinite(RuntimeError):
    """A number in training is not finite; the message says which, where and what was kept."""


@dataclass(frozen=True)
class Compiling:
    """About to compile this."""

    what: str


@dataclass(frozen=True)
class Reported:
    """A report was made, recorded and saved."""

    rows: list[Row]  # one for each seed
    flights: Flights  # leading axis: seeds
    seconds_left: float


Event = Compiling | Reported


def train(env: Env, run: RunConfig, out: Path, *, resume: bool, stopped: Callable[[], bool]) -> Iterator[Event]:
    """Train into the run folder(s) below `out`, from the last checkpoint if `resume`; yields what happens.

    Ends early, all saved, once `stopped()` is true at a report. Raises NotFinite with the last good
    checkpoint kept.
    """
    config = run.learner
    trainer = Trainer(env, config)
    folders = runs.members(out, run)
    managers = [checkpoint.manager(folder) for folder in folders]
    writers = [SummaryWriter(str(folder / "tensorboard")) for folder in folders]
    try:
        yield Compiling("first state")
        states = trainer.init(jnp.arange(run.seed, run.seed + run.seeds))
        history: list[list[Row]] = [[] for _ in folders]
        if resume:
            states, history = _restored(states, folders, managers, config.unroll_size)
        yield Compiling("training")
        advance = trainer.advance.lower(states, jnp.int32(0)).compile()
        yield Compiling("evaluation")
        starts = jax.random.split(jax.random.PRNGKey(REPORT_STARTS_SEED), config.report_flights)
        fly = trainer.fly.lower(states.learner, starts).compile()

        done = int(states.unrolls[0])
        clock = history[0][-1]["train_seconds"] if history[0] else 0.0
        began, first = time.perf_counter(), done
        while done < config.unrolls and not stopped():
            until = min(config.unrolls, done + config.unrolls_per_report)
            lap = time.perf_counter()
            states, totals = jax.block_until_ready(advance(states, jnp.int32(until)))
            lap = time.perf_counter() - lap
            _check(states, config, run, folders, managers)
            clock += lap
            flights = fly(states.learner, starts)
            rows = _rows(config, totals, states, flights, until * config.unroll_size, clock, lap)
            for i, (folder, writer, saved) in enumerate(zip(folders, writers, managers, strict=True)):
                # The checkpoint first: after a kill between the two, a row is computed again, never missing.
                checkpoint.save(saved, until * config.unroll_size, checkpoint.member(states, i))
                history[i].append(rows[i])
                runs.write_metrics(folder, history[i])
                _log(writer, rows[i])
            done = until
            pace = (time.perf_counter() - began) / (done - first)
            yield Reported(rows, flights, pace * (config.unrolls - done))
    finally:
        for writer in writers:
            writer.close()
        for saved in managers:
            saved.close()


def finished(out: Path, run: RunConfig) -> bool:
    """Whether the run in `out` has nothing left to do: its summaries are written last."""
    return all((folder / "summary.json").exists() for folder in {out, *runs.members(out, run)})


def restore(env: Env, run: RunConfig, out: Path) -> tuple[Trainer, TrainState, list[int]]:
    """Trainer, states (leading axis: seeds) and environment steps of each seed's last checkpoint.

    Raises FileNotFoundError, naming the folder, where there is none.
    """
    trainer = Trainer(env, run.learner)
    folders = runs.members(out, run)
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), jax.eval_shape(trainer.init, jnp.zeros(1, jnp.int32))
    )
    states, steps = [], []
    for folder in folders:
        with checkpoint.manager(folder) as saved:
            latest = saved.latest_step()
            if latest is None:
                raise FileNotFoundError(f"{folder}: no checkpoint")
            states.append(checkpoint.restore(saved, latest, like))
            steps.append(latest)
    return trainer, jax.tree.map(jnp.asarray, checkpoint.stack(states)), steps


def _restored(
    states: TrainState, folders: list[Path], managers: list[Any], unroll_size: int
) -> tuple[TrainState, list[list[Row]]]:
    """The last checkpoint that every seed has, and the metrics up to it; `states` where there is none."""
    common = set.intersection(*[set(saved.all_steps()) for saved in managers])
    if not common:
        return states, [[] for _ in folders]
    latest = max(common)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)
    restored = [checkpoint.restore(saved, latest, like) for saved in managers]
    rows = [[row for row in runs.read_metrics(folder) if row["env_steps"] <= latest] for folder in folders]
    for saved in managers:
        for step in saved.all_steps():
            if step > latest:
                saved.delete(step)
    return jax.tree.map(jnp.asarray, checkpoint.stack(restored)), rows


def _check(states: TrainState, config: Any, run: RunConfig, folders: list[Path], managers: list[Any]) -> None:
    for i, (update, term) in enumerate(zip(states.fault_update, states.fault_term, strict=True)):
        if update >= 0:
            latest = managers[i].latest_step()
            kept = f"the checkpoint at step {latest:,} is kept" if latest else "no checkpoint had been made"
            raise NotFinite(
                f"{folders[i]}: seed {run.seed + i}: {FAULT_TERMS[int(term)]} was not finite in update {int(update):,}; {kept}"
            )


def _rows(
    config: Any, totals: Totals, states: TrainState, flights: Flights, env_steps: int, clock: float, lap: float
) -> list[Row]:
    totals, updates = jax.tree.map(np.asarray, (totals, states.learner.updates))
    rows = []
    for i in range(len(updates)):
        returns = np.asarray(flights.returns[i])
        measures = {name: np.asarray(value[i]) for name, value in flights.measures.items()}
        count = max(float(totals.updates[i]), 1.0)
        row: Row = {
            "env_steps": env_steps,
            "updates": int(updates[i]),
            "return_mean": float(returns.mean()),
            "return_min": float(returns.min()),
            "success": float(measures["success"].mean()) if measures else float("nan"),
            "train_seconds": round(clock, 3),
        }
        if measures:
            row["settle_median_s"] = float(np.median(measures["settle_s"]))
            row["settle_p95_s"] = float(np.percentile(measures["settle_s"], 95, method="higher"))
        row |= {name: float(np.median(value)) for name, value in measures.items() if name.startswith("rms_")}
        row["reward_mean"] = float(totals.rewards[i] / totals.steps[i])
        row["ended_early"] = float(totals.early[i] / max(float(totals.episodes[i]), 1.0))
        row |= {name: float(value[i] / count) for name, value in totals.terms._asdict().items()}
        row["steps_per_second"] = round(float(totals.steps[i]) * len(updates) / lap, 1)
        rows.append(row)
    return rows


def _log(writer: SummaryWriter, row: Row) -> None:
    for name, value in row.items():
        if name != "env_steps" and np.isfinite(value):
            writer.add_scalar(name, value, row["env_steps"])
    writer.flush()

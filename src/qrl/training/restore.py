"""From a run folder's checkpoints back to a training state, to go on with, or to its learner alone, to fly."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from qrl.algorithm.learner import Learner, LearnerState
from qrl.algorithm.types import Env
from qrl.runs import checkpoint
from qrl.runs.integrity import Damaged, Record
from qrl.runs.record import RunConfig
from qrl.training import driver
from qrl.training.state import Point, TrainState, stack
from qrl.training.trainer import Trainer


class Restored(NamedTuple):
    """Where a run goes on."""

    env_steps: int  # 0: from the start, for nothing whole was saved
    states: TrainState | None  # NumPy; leading axis: members
    records: list[Record]  # of each member
    notes: list[str]  # what was wrong with later checkpoints, and what became of them


def shapes(trainer: Trainer, points: Point) -> TrainState:
    """Shapes and types of the states of as many members as there are `points`."""
    return jax.eval_shape(trainer.init, driver.seeds(0, len(jax.tree.leaves(points)[0])), points)


def latest(folders: list[Path], configs: list[RunConfig], like: TrainState) -> Restored:
    """The last checkpoint that is whole in every member's folder; `like`: shapes and types of all their states.

    What is damaged is set aside; what is later, or was never finished, goes: it will be made again, the same.
    Raises checkpoint.Foreign, with nothing touched, where what was saved is of something else.
    """
    one, notes = _one(like), []
    common = set.intersection(*[set(checkpoint.steps(folder)) for folder in folders])
    for env_steps in sorted(common, reverse=True):
        try:
            found = [checkpoint.read(*member, env_steps, one) for member in zip(folders, configs, strict=True)]
        except Damaged as error:
            notes.append(str(error))
            continue
        break
    else:
        env_steps, found = 0, []
    for folder in folders:
        checkpoint.clear_after(folder, env_steps)
    whence = f"going on from the checkpoint at step {env_steps:,}" if env_steps else "starting afresh: none is whole"
    notes = [f"{note}; {whence}" for note in notes]
    states = stack([each.state for each in found]) if found else None
    return Restored(env_steps, states, [each.record for each in found], notes)


def learner_shapes(learner: Learner) -> LearnerState:
    """Shapes and types of one member's learner, for which no environment is traced."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), jax.eval_shape(learner.init, jax.random.PRNGKey(0))
    )


def last(env: Env, run: RunConfig, folder: Path) -> tuple[Trainer, LearnerState, int]:
    """Trainer, learner (leading axis: one member) and environment steps of a seed's last checkpoint.

    Raises FileNotFoundError, naming the folder, where there is none; OSError where it is not whole: whoever flies a
    policy should not be given an earlier one unasked.
    """
    trainer = Trainer(env, run.learner)
    return trainer, *next(newest(trainer.learner, run, folder, 1))


def newest(learner: Learner, run: RunConfig, folder: Path, most: int) -> Iterator[tuple[LearnerState, int]]:
    """Learner and environment steps, as from `last`, of a seed's checkpoints, newest first, of at most so many.

    Each is read when it is asked for, and raises as `last` does.
    """
    saved = checkpoint.steps(folder)
    if not saved:
        raise FileNotFoundError(f"{folder}: no checkpoint")
    nothing: Any = [None] * len(TrainState._fields)
    like = TrainState(*nothing)._replace(learner=learner_shapes(learner))
    for env_steps in saved[:most]:
        found = checkpoint.read(folder, run, env_steps, like, part=True)
        yield jax.tree.map(jnp.array, stack([found.state.learner])), found.env_steps


def _one(states: Any) -> Any:
    """Shapes and types of one member."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)

"""From a run folder's checkpoints back to a training state, to resume, or to its learner alone, to fly."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from qrl.algorithm import learner
from qrl.algorithm.learner import LearnerSpec, LearnerState
from qrl.runs import checkpoint
from qrl.runs.checkpoint import Record
from qrl.runs.integrity import CorruptCheckpoint
from qrl.runs.record import RunConfig
from qrl.training import driver
from qrl.training.state import MemberInputs, TrainState, stack
from qrl.training.trainer import Trainer


class Restored(NamedTuple):
    """Where a run resumes."""

    env_steps: int  # 0: from the start, without a valid checkpoint
    states: TrainState | None  # NumPy; leading axis: members
    records: list[Record]  # of each member
    notes: list[str]  # what was wrong with later checkpoints, and what was done


def abstract_states(trainer: Trainer, inputs: MemberInputs) -> TrainState:
    """Shapes and types of the states of as many members as `inputs` has."""
    return jax.eval_shape(trainer.init, driver.seeds(0, len(jax.tree.leaves(inputs)[0])), inputs)


def restore_common(folders: list[Path], configs: list[RunConfig], target: TrainState) -> Restored:
    """The last checkpoint that is valid in every member's folder; `target`: shapes and types of all their states.

    Corrupt checkpoints are quarantined; later or unfinished ones are deleted: the run makes them again. Raises
    IncompatibleCheckpoint, with nothing changed, if a checkpoint belongs to another run or version of qrl, another
    OSError if one cannot be read for now.
    """
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), target)
    notes: list[str] = []
    corrupt: dict[Path, set[int]] = {folder: set() for folder in folders}
    common = set.intersection(*[set(checkpoint.saved_steps(folder)) for folder in folders])
    for env_steps in sorted(common, reverse=True):
        found = []
        for folder, run in zip(folders, configs, strict=True):
            try:
                found.append(checkpoint.read(folder, run, env_steps, one))
            except CorruptCheckpoint as error:
                notes.append(str(error))
                corrupt[folder].add(env_steps)
        if len(found) == len(folders):
            break
    else:
        env_steps, found = 0, []
    for folder in folders:
        checkpoint.discard_after(folder, env_steps, corrupt[folder])
    where = f"resuming from step {env_steps:,}" if env_steps else "no valid checkpoint; starting from scratch"
    notes = [f"{note}; {where}" for note in notes]
    states = stack([each.state for each in found]) if found else None
    return Restored(env_steps, states, [each.record for each in found], notes)


def abstract_learner(spec: LearnerSpec) -> LearnerState:
    """Shapes and types of one member's learner; no environment is traced."""
    return jax.eval_shape(lambda key: learner.init(spec, spec.config.hyperparameters, key), jax.random.PRNGKey(0))


def iter_learners(spec: LearnerSpec, run: RunConfig, folder: Path, most: int) -> Iterator[tuple[LearnerState, int]]:
    """Learner (leading axis: one member) and environment steps of a seed's last `most` checkpoints, newest first.

    Each is read when it is asked for. Raises FileNotFoundError, naming the folder, where there is none; OSError where
    one is corrupt, rather than giving an earlier one.
    """
    saved = checkpoint.saved_steps(folder)
    if not saved:
        raise FileNotFoundError(f"{folder}: no checkpoint")
    nothing: Any = [None] * len(TrainState._fields)
    target = TrainState(*nothing)._replace(learner=abstract_learner(spec))
    for env_steps in saved[:most]:
        found = checkpoint.read(folder, run, env_steps, target, part=True)
        yield jax.tree.map(jnp.array, stack([found.state.learner])), found.env_steps

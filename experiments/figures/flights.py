"""Flights of trained policies for the figures: the paper's hovering trial, and circles."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from qrl import tasks
from qrl.evaluation.trained_run import EVALUATION_STARTS_SEED
from qrl.runs import record
from qrl.training import restore
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs.perturbations import OffNominal, conditions
from qrl_envs.task import QuadrotorTask

STARTS = 1000  # those of `make evaluate`; what is drawn are the first of them


class PolicyFlights(NamedTuple):
    """Flights of one policy, SI units."""

    seed: int
    env_steps: int  # of training
    task: QuadrotorTask
    observations: np.ndarray  # [n, K + 1, 18] at times 0, dt, … K·dt; NaN after an early end
    measures: dict[str, np.ndarray]  # of measures.py -> [n]

    @property
    def times_s(self) -> np.ndarray:
        return np.arange(self.observations.shape[1]) * self.task.control_period_s


def fly_policy(folder: Path, *, trial: bool = False, starts: int = STARTS) -> PolicyFlights:
    """The last policy of a run's first seed, from the first starts of `make evaluate`.

    With `trial`, the initial position and velocity are those of the paper's trial; attitude, which the paper does not
    give, and body rates are those of the start. Raises BadInput or OSError where the run cannot be read.
    """
    config = tasks.load_run_config(folder)
    task = tasks.spec(config.task)
    assert isinstance(task, QuadrotorTask)
    one = config.member(0)
    trainer = make_trainer(tasks.environment(config.task), config.learner)
    learner, env_steps = next(
        restore.iter_learners(trainer.setup.spec, one, record.member_folders(folder, config)[0], 1)
    )
    if trial:
        trainer = make_trainer(OffNominal(task, conditions(task)["trial"]), config.learner)
    keys = jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), STARTS)[:starts]
    found = trainer.fly(learner, stack([member_inputs(trainer.setup.env, config.learner)]), keys)
    found = jax.tree.map(lambda x: np.asarray(x)[0], found)
    return PolicyFlights(one.seed, env_steps, task, found.observations, found.measures)

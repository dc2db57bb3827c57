"""Flights of trained policies for the figures: the paper's hovering trial, and circles."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from qrl import tasks
from qrl.evaluation.starts import STARTS, evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import record
from qrl_envs.off_nominal import OffNominal, conditions
from qrl_envs.task import QuadrotorTask


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
    run = TrainedRun.load(record.member_folders(folder, tasks.load_run_config(folder))[0])
    task = run.task
    assert isinstance(task, QuadrotorTask)
    env = OffNominal(task, conditions(task)["trial"]) if trial else None
    flights = run.fly(evaluation_starts()[:starts], env)
    measures = {name: np.asarray(value) for name, value in flights.measures.items()}
    return PolicyFlights(run.config.seed, run.env_steps, task, np.asarray(flights.observations), measures)

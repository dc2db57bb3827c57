"""Compiled flights of float policies of one configuration, and the checkpoints that hold them."""

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import chex
import jax
import numpy as np

from qrl.algorithm import learner as learners
from qrl.algorithm.flights import Flights
from qrl.algorithm.learner import LearnerState
from qrl.algorithm.types import Env
from qrl.config import Config
from qrl.runs.record import RunConfig
from qrl.training import restore
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer


class FlightPrograms:
    """Flights of any policy of one configuration, compiled once per kind of environment and number of starts.

    Environments of one task that differ in `params` only are of one kind. A LearnerState has a leading axis of one
    member.
    """

    def __init__(self, env: Env, config: Config) -> None:
        self.env = env
        self.config = config
        self._kinds: list[tuple[Env, Trainer]] = [(env, make_trainer(env, config))]
        self._setup = self._kinds[0][1].setup
        self.max_episode_steps = self._setup.max_episode_steps
        self._compiled: dict[tuple[int, int], Future[Any]] = {}  # by kind and number of starts

    def checkpoints(self, run: RunConfig, folder: Path, most: int) -> Iterator[tuple[LearnerState, int]]:
        """Learner and environment steps of the last `most` checkpoints, newest first; OSError if one is invalid."""
        return restore.iter_learners(self._setup.spec, run, folder, most)

    def deployed(self, learner: LearnerState) -> LearnerState:
        """The member's learner in NumPy, with the policy that is deployed."""
        return jax.tree.map(lambda x: np.asarray(x[0], np.float64), learners.deployed(self._setup.spec, learner))

    def initial_memory(self, *lanes: int) -> Any:
        """The policy's memory at the start of a flight; [*lanes, H], or () of a feed-forward policy."""
        return learners.initial_memory(self._setup.spec, *lanes)

    def act(self, learner: LearnerState, memory: Any, observation: chex.Array) -> tuple[Any, chex.Array]:
        """Next memory and mean action of the deployed policy; [..., F] -> [..., A]."""
        one = learners.deployed(self._setup.spec, jax.tree.map(lambda x: x[0], learner))
        return learners.act(self._setup.spec, self.config.hyperparameters, one, memory, observation)

    def compile(self, env: Env, starts: chex.PRNGKey, executor: Executor) -> None:
        """Start compiling `fly` in `executor`."""
        kind = self._kind(env)

        def compiled() -> Any:
            one = restore.abstract_learner(self._setup.spec)
            learner = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), one)
            return self._kinds[kind][1].fly.lower(learner, self._inputs(env), starts).compile()

        if (kind, len(starts)) not in self._compiled:
            self._compiled[kind, len(starts)] = executor.submit(compiled)

    def fly(self, learner: LearnerState, env: Env, starts: chex.PRNGKey) -> Flights:
        """Deterministic flights in NumPy; leading axis: starts."""
        kind = self._kind(env)
        compiled = self._compiled.get((kind, len(starts)))
        program = compiled.result() if compiled else self._kinds[kind][1].fly
        return jax.tree.map(lambda x: np.asarray(x[0]), program(learner, self._inputs(env), starts))

    def _inputs(self, env: Env) -> Any:
        return stack([member_inputs(env, self.config)])

    def _kind(self, env: Any) -> int:
        """Index of the environment's kind."""
        for i, (known, _) in enumerate(self._kinds):
            if env is known or (type(env) is type(known) and _task(env) and _task(env) == _task(known)):
                return i
        self._kinds.append((env, make_trainer(env, self.config)))
        return len(self._kinds) - 1


def _task(env: Any) -> Any:
    return getattr(env, "task", None)

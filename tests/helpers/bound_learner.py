"""The learner's pure functions with their spec and hyperparameters bound, as a test of one learner calls them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from qrl.algorithm import analytic_gradient, learner
from qrl.algorithm.learner import LearnerSpec
from qrl.config import Config, Hyperparameters


class BoundLearner:
    def __init__(
        self,
        config: Config,
        observation_size: int,
        action_size: int,
        axis: str | None = None,
        policy_observation_size: int | None = None,
        policy_view: Callable[[jax.Array], jax.Array] = lambda observation: observation,
    ) -> None:
        self.config = config
        self.spec = LearnerSpec(config, observation_size, action_size, axis, policy_observation_size, policy_view)
        self.planned_updates = config.planned_updates(config.learning_unrolls)
        self.policy, self.critic = self.spec.policy, self.spec.critic
        self._bind(config.hyperparameters)

    def with_hyper(self, hyper: Hyperparameters) -> "BoundLearner":
        other = BoundLearner(*self.spec)
        other._bind(hyper)
        return other

    def mean(self, state: Any, observation: Any) -> Any:
        """Mean action of a feed-forward policy."""
        return self.act(state, (), observation)[1]

    def _bind(self, hyper: Hyperparameters) -> None:
        def bound(function: Any) -> Any:
            return partial(function, self.spec, hyper)

        self.hyper = hyper
        self.init, self.update, self.loss = bound(learner.init), bound(learner.update), bound(learner._loss)
        self.act, self.preprocess = bound(learner.act), bound(learner.preprocess)
        self.sigma = partial(learner.sigma, hyper)
        self.deployed = partial(learner.deployed, self.spec)
        self.update_statistics = partial(learner.update_statistics, self.spec)
        self.apg_update = bound(analytic_gradient.update)

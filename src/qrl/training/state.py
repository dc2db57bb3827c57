"""The state of a run, and the inputs of its program. Shapes are one member's (one seed or grid point)."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from qrl.algorithm.adapter import adapt
from qrl.algorithm.learner import LearnerState, UpdateMetrics
from qrl.algorithm.replay_buffer import ReplayBuffer
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import Env
from qrl.config import Config, Hyperparameters

FAULT_TERMS = ("reward", "observation", *UpdateMetrics._fields)


class Totals(NamedTuple):
    """Sums since the last report; scalars."""

    rewards: chex.Array
    steps: chex.Array
    episodes: chex.Array  # that ended
    early: chex.Array  # of these, before their last step
    updates: chex.Array
    skipped: chex.Array  # APG updates whose gradient was not finite
    metrics: UpdateMetrics


class TrainState(NamedTuple):
    """All that a run needs to continue; the content of a checkpoint."""

    learner: LearnerState
    buffer: ReplayBuffer
    lanes: Lanes
    key: chex.PRNGKey  # of noise and minibatches
    start_key: chex.PRNGKey  # of the lanes' starts
    unrolls: chex.Array  # int32 []
    learning_unrolls: chex.Array  # int32 []: of these, before APG begins
    skipped_in_a_row: chex.Array  # int32 []: APG updates
    fault_update: chex.Array  # int32 []: the update in which a number was first not finite; −1: none
    fault_term: chex.Array  # int32 []: its index in FAULT_TERMS
    totals: Totals  # since the last report, which resets them


class MemberInputs(NamedTuple):
    """Arguments of the program: members may differ in these and in their seed, and in nothing else."""

    hyper: Hyperparameters
    env_params: Any  # the environment's `params`; () for one without


def member_inputs(env: Env, config: Config) -> MemberInputs:
    """One member's inputs (NumPy) for an environment and a configuration."""
    return MemberInputs(config.hyperparameters, jax.tree.map(np.asarray, adapt(env).params))


def stack(members: Sequence[Any]) -> Any:
    """Members' values with a leading member axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *members)

"""What a run is: its state, the point that it trains at, and how members of these lie side by side and on devices.

Shapes are one member's (one seed or grid point); whoever trains has a leading member axis before them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from qrl.algorithm.learner import Hyper, LearnerState, Terms, hyper
from qrl.algorithm.replay_buffer import Ring
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import Env
from qrl.config import Config

FAULT_TERMS = ("reward", "observation", *Terms._fields)


class Totals(NamedTuple):
    """Sums since the last report; scalars."""

    rewards: chex.Array
    steps: chex.Array
    episodes: chex.Array  # that ended
    early: chex.Array  # of these, before their last step (fled, tumbled, or terminated)
    updates: chex.Array
    terms: Terms


class TrainState(NamedTuple):
    """Everything a run needs to go on: what a checkpoint holds."""

    learner: LearnerState
    ring: Ring
    lanes: Lanes
    key: chex.PRNGKey  # of noise and minibatches
    starts: chex.PRNGKey  # of the lanes' starts
    unrolls: chex.Array  # int32 []
    fault_update: chex.Array  # int32 []: the update in which a number was first not finite; −1: none
    fault_term: chex.Array  # int32 []: which (FAULT_TERMS)
    totals: Totals  # since the last report; whoever reports sets them to zero


class Point(NamedTuple):
    """What one program takes as arguments: members may differ in it, and in nothing else but their seed."""

    hyper: Hyper
    world: Any  # the environment's `params`; () of one that has none


def point(env: Env, config: Config) -> Point:
    """The point (NumPy, one member's) of an environment and a configuration."""
    return Point(hyper(config), jax.tree.map(np.asarray, getattr(env, "params", ())))


def stack(members: Sequence[Any]) -> Any:
    """Members' values side by side: a leading member axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *members)

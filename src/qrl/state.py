"""What a run is: its state, the point that it trains at, and how members of these lie side by side and on devices.

Shapes are one member's (one seed or grid point); whoever trains has a leading member axis before them.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from qrl.buffer import Ring
from qrl.config import Config
from qrl.learner import Hyper, LearnerState, Terms, hyper
from qrl.rollout import Lanes
from qrl.types import Env

MEMBER, SHARD = "member", "shard"  # the mesh's axes
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


# How a state lies on a mesh: axis 0 is the member's; a lane is with its shard, and whatever holds no lanes, everywhere.
LAYOUT: Any = TrainState(*[P(MEMBER)] * len(TrainState._fields))._replace(  # pyright: ignore[reportArgumentType]
    ring=Ring(P(MEMBER, None, SHARD), P(MEMBER)),  # pyright: ignore[reportArgumentType]
    lanes=P(MEMBER, SHARD),  # pyright: ignore[reportArgumentType]
)


def spread(devices: Sequence[Any], members: int, shards: int) -> Mesh | None:
    """The mesh [member, shard] over as many of `devices` as can share the work evenly; None: one is enough.

    Members have no need of each other, and so they part first.
    """
    for count in range(len(devices), 1, -1):
        apart = math.gcd(members, count)
        if shards % (count // apart) == 0:
            return Mesh(np.reshape(np.array(devices[:count]), (apart, -1)), (MEMBER, SHARD))
    return None

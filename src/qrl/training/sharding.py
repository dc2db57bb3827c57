"""How the states of several members lie on the devices of a mesh."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from qrl.algorithm.replay_buffer import Ring
from qrl.training.state import TrainState

MEMBER, SHARD = "member", "shard"  # the mesh's axes


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

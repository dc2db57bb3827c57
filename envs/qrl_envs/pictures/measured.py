"""What measures.py says of many flights, as pictures show it."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs import measures
from qrl_envs.task import CircleReward, PendulumTask, Task

ERRORS = {  # name in measures.py -> label; unit; name of its tolerance in the task's `evaluation`
    "position_m": ("distance to target", "m", "distance_m"),
    "radius_m": ("radius error", "m", "distance_m"),
    "height_m": ("height error", "m", "distance_m"),
    "speed_m_s": ("speed error", "m/s", "speed_m_s"),
    "angle_rad": ("angle error", "rad", "angle_rad"),
}


class Measured(NamedTuple):
    """What measures.py says of n flights."""

    errors: dict[str, np.ndarray]  # name with unit -> [n, K + 1]
    success: np.ndarray  # [n] bool
    settle_s: np.ndarray  # [n]; infinite where it never settles


def measure(task: Task, observations: np.ndarray) -> Measured:
    """measures.py of each of `observations` [n, K + 1, F]."""
    errors, summary = jax.tree.map(np.asarray, _measured(task, jnp.asarray(observations, jnp.float32)))
    return Measured(errors, summary["success"] > 0, summary["settle_s"])


@functools.partial(jax.jit, static_argnums=0)
def _measured(task: Task, observations: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """Errors [n, K + 1] and summary [n] of `observations` [n, K + 1, F]."""
    dt_s = task.control_period_s

    def one(flight: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        if isinstance(task, PendulumTask):
            found = measures.pendulum(flight, task.evaluation)
        elif isinstance(wanted := task.evaluation.reward, CircleReward):
            found = measures.circle(flight, task.evaluation, wanted.radius_m, wanted.speed_m_s)
        else:
            found = measures.hover(flight, task.evaluation)
        return found.errors, measures.summarise(found, round(task.evaluation.tail_s / dt_s), dt_s)

    return jax.vmap(one)(observations)


def successes(found: Measured) -> str:
    return f"{np.sum(found.success):,} of {len(found.success):,} flights succeed"

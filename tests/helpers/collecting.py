"""Unrolls by themselves, without a replay buffer that outlives them."""

from typing import Any

import jax

from qrl.algorithm import replay_buffer, rollout
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import TaskEnv, Transition


def unroll(
    env: TaskEnv, lanes: Lanes, *args: Any, unroll_length: int, max_episode_steps: int
) -> tuple[Lanes, Transition]:
    """The lanes after an unroll, and its transitions [N, T, ...]; `args` are policy, sigma and the two keys."""
    shapes = rollout.transitions_of(lanes, env.action_size, unroll_length)
    buffer = replay_buffer.create(shapes, 1)
    lanes, buffer = rollout.unroll(env, lanes, buffer, *args, max_episode_steps=max_episode_steps)
    return lanes, jax.tree.map(lambda x: x[0], buffer.data)

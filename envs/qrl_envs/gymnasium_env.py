"""The tasks as Gymnasium vector environments, stepped as one compiled program. Requires Gymnasium (`qrl[gym]`).

`make_vec("hover", num_envs=64)` or, by registered id,
`gymnasium.make_vec("qrl_envs.gymnasium_env:qrl_envs/Hover-v0", num_envs=64)`.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from qrl_envs import env as envs
from qrl_envs import task as tasks
from qrl_envs.task_env import State, TaskEnv


class BraxVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """`num_envs` copies of a task, with NumPy float32 arrays in and out.

    An environment that ends is restarted within the same step (`AutoresetMode.SAME_STEP`): `step` returns the new
    episode's first observation, and `infos["final_obs"]` [num_envs, F] holds the ended episode's last one where
    `infos["_final_obs"]` is true. Episodes end as truncations, at `episode_steps` or out of the task's bounds; the
    latter is marked in `infos["final_info"]["out_of_bounds"]`. Observations, actions and units are those of `env`.
    """

    def __init__(self, env: TaskEnv, num_envs: int, seed: int | None = None) -> None:
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = Box(-np.inf, np.inf, (env.observation_size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes: Any = None  # (State, steps since the start, key) of each environment, set by `reset`
        super().reset(seed=seed)

        def step(
            state: State, steps: jax.Array, key: jax.Array, action: jax.Array
        ) -> tuple[tuple[State, jax.Array, jax.Array], tuple[jax.Array, ...]]:
            last = env.step(state, action)
            steps += 1
            out_of_bounds = last.info["out_of_bounds"] > 0
            terminated = (last.done > 0) & ~(last.info["truncated"] > 0)
            truncated = ~terminated & ((last.done > 0) | (steps >= env.episode_steps))
            next_key, start_key = jax.random.split(key)
            restarted = env.restart(last, start_key), jnp.zeros_like(steps), next_key
            ended = terminated | truncated
            now = jax.tree.map(lambda new, old: jnp.where(ended, new, old), restarted, (last, steps, key))
            return now, (now[0].obs, last.reward, terminated, truncated, last.obs, out_of_bounds)

        self._reset = jax.jit(jax.vmap(env.reset))
        self._step = jax.jit(jax.vmap(step))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start all episodes anew: the same seed gives the same starts, no seed continues the random sequence."""
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        starts, restarts = jax.random.split(key)
        state = self._reset(jax.random.split(starts, self.num_envs))
        self._episodes = state, jnp.zeros(self.num_envs, jnp.int32), jax.random.split(restarts, self.num_envs)
        return np.array(state.obs), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period under `actions` [num_envs, A] in [−1, 1]; values beyond are clipped."""
        self._episodes, results = self._step(*self._episodes, jnp.asarray(actions, jnp.float32))
        obs, reward, terminated, truncated, final_obs, out_of_bounds = (np.array(x) for x in results)
        infos: dict[str, Any] = {}
        if (ended := terminated | truncated).any():
            final_info = {"out_of_bounds": out_of_bounds, "_out_of_bounds": ended}
            infos = {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}
        return obs, reward, terminated, truncated, infos


def make_vec(task: str, num_envs: int = 1, seed: int | None = None) -> BraxVectorEnv:
    """The vector environment of a shipped task's name or of a task file; `seed` is that of a first unseeded reset."""
    return BraxVectorEnv(envs.make(task), num_envs, seed)


for _name in tasks.shipped():
    gymnasium.register(
        id=f"qrl_envs/{_name.capitalize()}-v0", vector_entry_point=f"{__name__}:make_vec", kwargs={"task": _name}
    )

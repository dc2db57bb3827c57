"""Members of one program, which differ in what is traced."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from qrl.config import Config
from qrl.training import driver
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer


class Paid(Env):
    """A step is paid what the environment, not its state, holds; every episode is anew after two."""

    def __init__(self, params: Any = 1.0) -> None:
        self.params = jnp.asarray(params, jnp.float32)

    @property
    def observation_size(self) -> int:
        return 1

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "toy"

    def with_params(self, params: Any) -> "Paid":
        return Paid(params)

    def reset(self, rng: jax.Array) -> State:
        del rng
        return State(jnp.zeros(1), self.params[None], jnp.float32(0.0), jnp.float32(0.0))

    def step(self, state: State, action: jax.Array) -> State:
        del action
        clock = state.pipeline_state + 1.0
        return state.replace(
            pipeline_state=clock, obs=self.params[None] + clock, reward=self.params, done=(clock[0] >= 2.0) * 1.0
        )


def test_each_collects_in_its_own_environment() -> None:
    """An environment whose parameters are not in its state: its steps and its starts are of the member's."""
    small = {"num_envs": 4, "unroll_length": 5, "num_timesteps": 20, "batch_size": 4, "replay_unrolls": 1}
    other = {"warmup_unrolls": 1, "symmetries": False, "observation_scale": None}
    config = Config.preset("pendulum").model_copy(update=small | other)
    paid = np.array([2.0, 5.0], np.float32)
    inputs = stack([member_inputs(Paid(x), config) for x in paid])
    trainer = make_trainer(Paid(), config)
    states = trainer.train(trainer.init(driver.seeds(0, 2), inputs), inputs, np.int32(1))
    seen = jax.tree.map(lambda x: np.asarray(x)[:, 0], states.buffer.data)  # [M, N, T, ...]
    mine = paid[:, None, None]
    np.testing.assert_array_equal(seen.reward, np.broadcast_to(mine, seen.reward.shape))
    clock = np.arange(5) % 2
    np.testing.assert_array_equal(seen.observation[..., 0], np.broadcast_to(mine + clock, seen.reward.shape))

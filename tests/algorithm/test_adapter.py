"""Environments seen as a `TaskEnv`: what they have is used, and what they lack has a default."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm.adapter import BRAX_EPISODE_STEPS, adapt
from qrl_envs import env as worlds
from qrl_envs.task_env import State


class Slider:
    """A point on a line, moved by its action."""

    observation_size, action_size, dt = 1, 1, 0.1

    def reset(self, rng: jax.Array) -> State:
        x = jax.random.uniform(rng, (1,))
        return State(x, x, jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        return state.replace(pipeline_state=state.obs + action, obs=state.obs + action)


class Scaled(Slider):
    """With a parameter, in both halves of the ability."""

    def __init__(self, gain: Any = 2.0) -> None:
        self.params = gain

    def with_params(self, params: Any) -> "Scaled":
        return Scaled(params)


def test_defaults_stand_for_what_is_missing() -> None:
    slider = adapt(Slider())
    key = jax.random.key(0)
    assert (slider.params, slider.episode_steps, slider.control_period_s) == ((), BRAX_EPISODE_STEPS, 0.1)
    assert not slider.differentiable
    assert slider.evaluation() is None
    assert slider.symmetry(jnp.zeros(2)) is None
    assert slider.with_params(()) is slider
    start = slider.reset(key)
    for state in (slider.restart(start, key), slider.reset_calibration(key)):
        np.testing.assert_array_equal(state.obs, start.obs)
    np.testing.assert_array_equal(slider.step(start, jnp.ones(1)).obs, start.obs + 1.0)


def test_what_is_there_is_used() -> None:
    hover = worlds.make("hover")
    assert adapt(hover) is hover
    scaled = adapt(Scaled())
    assert scaled.params == 2.0
    assert scaled.with_params(3.0).params == 3.0


@pytest.mark.parametrize(("half", "missing"), [("params", "with_params"), ("with_params", "params")])
def test_half_of_an_ability_is_refused(half: str, missing: str) -> None:
    """Its parameters would be ignored silently."""
    env: Any = Slider()
    setattr(env, half, 2.0 if half == "params" else lambda _: env)
    with pytest.raises(ValueError, match=rf"^Slider: expected both .* or neither; '{missing}' is missing$"):
        adapt(env)

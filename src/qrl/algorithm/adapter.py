"""Any Brax environment as a `TaskEnv`: defaults for the abilities that it does not offer."""

from typing import Any

import chex
import jax

from qrl.algorithm.types import Env, Evaluation, State, Symmetry, TaskEnv

BRAX_EPISODE_STEPS = 1000  # Brax's customary episode length

_ABILITIES = (
    *("params", "policy_observation_size", "policy_view", "episode_steps", "control_period_s", "differentiable"),
    *("with_params", "restart", "step_lanes", "reset_calibration", "symmetry", "evaluation"),
)


class _Adapted:
    """Defaults of a `TaskEnv`; an attribute that the wrapped environment has takes precedence."""

    def __init__(self, env: Env) -> None:
        self.unwrapped_env = env
        period = getattr(env, "dt", None)  # Brax's name
        self.control_period_s: float | None = None if period is None else float(period)
        for name in ("reset", "step", "observation_size", "action_size", *_ABILITIES):
            # A wrapper passes on what it does not have: the inner environment's `step_lanes` would be without its step.
            if hasattr(type(env) if name == "step_lanes" else env, name):
                setattr(self, name, getattr(env, name))

    params: Any = ()
    policy_observation_size: int | None = None
    episode_steps: int = BRAX_EPISODE_STEPS
    differentiable: bool = False  # not known

    def policy_view(self, observation: chex.Array) -> chex.Array:
        return observation

    def with_params(self, params: Any) -> Any:
        del params
        return self

    def restart(self, state: Any, rng: chex.PRNGKey) -> State:
        del state
        return self.unwrapped_env.reset(rng)

    def step_lanes(self, state: Any, action: chex.Array) -> State:
        return jax.vmap(self.unwrapped_env.step, in_axes=-1, out_axes=-1)(state, action)

    def reset_calibration(self, rng: chex.PRNGKey) -> State:
        return self.unwrapped_env.reset(rng)

    def symmetry(self, u: chex.Array) -> Symmetry | None:
        del u
        return None

    def evaluation(self) -> Evaluation | None:
        return None


def adapt(env: Env) -> TaskEnv:
    """`env` itself where it offers every ability of a `TaskEnv`, else a view of it with defaults for the others.

    `params` and `with_params` are one ability: a program passes the one through the other. ValueError for half of it,
    whose parameters would be ignored silently.
    """
    halves = "params", "with_params"
    found = [name for name in halves if hasattr(env, name)]
    if len(found) == 1:
        missing = next(name for name in halves if name not in found)
        expected = "expected both 'params' and 'with_params(params)', or neither"
        raise ValueError(f"{type(env).__name__}: {expected}; '{missing}' is missing")
    whole = all(hasattr(env, name) for name in _ABILITIES) and hasattr(type(env), "step_lanes")
    task_env: Any = env if whole else _Adapted(env)
    return task_env

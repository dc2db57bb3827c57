"""The environments of an evaluation, and classical controllers as baselines in them."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from qrl.algorithm import flights
from qrl.algorithm.flights import Flights
from qrl.algorithm.types import Env
from qrl.training.trainer import xla_effort
from qrl_envs.controllers import geometric, lqr
from qrl_envs.task import QuadrotorTask

CONTROLLERS = {"geometric": geometric.controller, "lqr": lqr.controller}
NOMINAL = "nominal"

Controller = Callable[[chex.Array], chex.Array]


class EvalEnvs(NamedTuple):
    """The environments and starts that policies and baselines share."""

    envs: dict[str, Env]  # NOMINAL, and off-nominal conditions by name, which differ in `params` only
    starts: chex.PRNGKey

    @property
    def kinds(self) -> dict[type, Env]:
        """One environment for each program to compile."""
        return {type(env): env for env in self.envs.values()}


class Baselines:
    """Classical controllers of a quadrotor task; compilation starts in `executor` on construction."""

    def __init__(self, eval_envs: EvalEnvs, task: QuadrotorTask, executor: Executor) -> None:
        controllers = executor.submit(_controllers, task)
        self._eval_envs = eval_envs
        self._programs = {
            kind: executor.submit(_compiled, env, controllers, eval_envs.starts)
            for kind, env in eval_envs.kinds.items()
        }

    def fly(self) -> dict[str, dict[str, Flights]]:
        """Flights by controller and environment."""
        by_env: dict[str, dict[str, Flights]] = {}
        for name, env in self._eval_envs.envs.items():
            program = self._programs[type(env)].result()
            by_env[name] = jax.tree.map(np.asarray, program(getattr(env, "params", ()), self._eval_envs.starts))
        return {name: {env: found[name] for env, found in by_env.items()} for name in by_env[NOMINAL]}


def _controllers(task: QuadrotorTask) -> dict[str, Controller]:
    """The controllers that exist for this task: they give thrusts; what cannot be stabilized has no regulator."""
    made: dict[str, Controller] = {}
    if task.action != "thrust":
        return made
    for name, make in CONTROLLERS.items():
        try:
            made[name] = make(task)
        except (np.linalg.LinAlgError, ValueError):
            continue
    return made


def _compiled(env: Any, controllers: Future[dict[str, Controller]], starts: chex.PRNGKey) -> Callable[..., Any]:
    def fly(params: Any, keys: chex.PRNGKey) -> dict[str, Flights]:
        return {
            name: flights.fly(env.with_params(params), each, keys, 0) for name, each in controllers.result().items()
        }

    return jax.jit(fly, compiler_options=xla_effort(1)).lower(env.params, starts).compile()

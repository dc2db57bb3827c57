"""Who flies an evaluation, and in which worlds: trained policies and classical controllers, from the same starts.

A kind of pilot takes XLA a program for the nominal world, and one for all off-nominal conditions. They are compiled
side by side: each takes seconds, and has little use for a second core.
"""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import chex
import jax
import numpy as np

from qrl.algorithm import flights as evaluate
from qrl.algorithm.flights import Flights
from qrl.algorithm.learner import LearnerState
from qrl.algorithm.types import Env
from qrl.config import Config
from qrl.training import restore
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer, xla_effort
from qrl_envs.controllers import geometric, lqr
from qrl_envs.task import QuadrotorTask

CONTROLLERS = {"geometric": geometric.controller, "lqr": lqr.controller}
NOMINAL = "nominal"


class Worlds(NamedTuple):
    """Where all fly, and from which starts."""

    nominal: Env
    off_nominal: dict[str, Env]  # by condition; alike but for their `params`
    starts: chex.PRNGKey


Program = Callable[..., Any]


class Policies:
    """The policies of one configuration in every world; compiling begins when this is made."""

    def __init__(self, worlds: Worlds, config: Config, aside: Executor) -> None:
        self.trainer = make_trainer(worlds.nominal, config)
        self._points = {name: stack([member_inputs(env, config)]) for name, env in _named(worlds).items()}
        self._programs = _each_kind(worlds, lambda env: aside.submit(_compiled_policy, env, config, worlds.starts))
        self._starts = worlds.starts

    def fly(self, learner: LearnerState, world: str = NOMINAL) -> Flights:
        """One policy's flights; `learner`'s leading axis is one member."""
        flights = self._programs[world].result()(learner, self._points[world], self._starts)
        return jax.tree.map(lambda x: np.asarray(x[0]), flights)

    def off_nominal(self, learner: LearnerState) -> dict[str, Flights]:
        return {name: self.fly(learner, name) for name in self._programs if name != NOMINAL}


class Baselines:
    """The classical controllers of a quadrotor task in every world; compiling begins when this is made."""

    def __init__(self, worlds: Worlds, task: QuadrotorTask, aside: Executor) -> None:
        made = aside.submit(_controllers, task)
        self._params = {name: getattr(env, "params", ()) for name, env in _named(worlds).items()}
        self._programs = _each_kind(worlds, lambda env: aside.submit(_compiled_controllers, env, made, worlds.starts))
        self._starts = worlds.starts

    def fly(self) -> dict[str, dict[str, Flights]]:
        """By controller and by world."""
        flown = {
            name: jax.tree.map(np.asarray, program.result()(self._params[name], self._starts))
            for name, program in self._programs.items()
        }
        return {name: {world: flights[name] for world, flights in flown.items()} for name in flown[NOMINAL]}


def _named(worlds: Worlds) -> dict[str, Env]:
    return {NOMINAL: worlds.nominal, **worlds.off_nominal}


def _each_kind(worlds: Worlds, compiling: Callable[[Env], Future]) -> dict[str, Future]:
    """By world the program for it: that of the nominal one, and one for all conditions."""
    programs = {NOMINAL: compiling(worlds.nominal)}
    for any_of_them in list(worlds.off_nominal.values())[:1]:
        programs |= dict.fromkeys(worlds.off_nominal, compiling(any_of_them))
    return programs


def _compiled_policy(env: Env, config: Config, starts: chex.PRNGKey) -> Program:
    trainer, points = make_trainer(env, config), stack([member_inputs(env, config)])
    one = restore.abstract_learner(trainer.setup.spec)
    learners = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), one)
    return trainer.fly.lower(learners, points, starts).compile()


def _controllers(task: QuadrotorTask) -> dict[str, Callable[[chex.Array], chex.Array]]:
    """Those that there are for this vehicle: of one that cannot be stabilised there is no regulator."""
    made = {}
    for name, make in CONTROLLERS.items():
        try:
            made[name] = make(task)
        except (np.linalg.LinAlgError, ValueError):
            continue
    return made


def _compiled_controllers(env: Any, made: Future, starts: chex.PRNGKey) -> Program:
    def fly(params: Any, keys: chex.PRNGKey) -> dict[str, Flights]:
        return {name: evaluate.fly(env.with_params(params), each, keys, 0) for name, each in made.result().items()}

    return jax.jit(fly, compiler_options=xla_effort(1)).lower(env.params, starts).compile()

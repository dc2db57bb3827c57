"""The worlds: a pendulum and a quadrotor as Brax environments. Importing registers them with Brax.

Brax takes seconds to import and this asks for none of it: they are registered as soon as somebody imports `brax.envs`.
"""

import functools
from types import ModuleType

from wrapt import when_imported

from qrl_envs import env, task


@when_imported("brax.envs")
def _register(envs: ModuleType) -> None:
    envs.Env.register(env.TaskEnv)
    for name in task.shipped():
        envs.register_environment(name, functools.partial(env.make, name))

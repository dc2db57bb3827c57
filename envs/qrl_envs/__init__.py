"""A pendulum and a quadrotor as Brax environments, one for each task file in `tasks/`.

`import qrl_envs` makes `brax.envs.get_environment("hover")` work. It imports neither Brax nor JAX, which take seconds:
the import hook below registers the tasks when `brax.envs` is imported, before or after.
"""

import functools
from types import ModuleType

from wrapt import when_imported


@when_imported("brax.envs")
def _register(envs: ModuleType) -> None:
    from qrl_envs import env, task

    envs.Env.register(env.TaskEnv)
    for name in task.shipped():
        envs.register_environment(name, functools.partial(env.make, name))

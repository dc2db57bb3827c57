"""The worlds: a pendulum and a quadrotor as Brax environments. Importing registers them with Brax."""

import functools

from brax.envs import register_environment

from qrl_envs import env, task

for _name in task.shipped():
    register_environment(_name, functools.partial(env.make, _name))  # pyright: ignore[reportArgumentType]

"""From a task to its Brax environment."""

from qrl_envs import task as tasks
from qrl_envs.pendulum_env import PendulumEnv
from qrl_envs.quadrotor_env import QuadrotorEnv, RealQuadrotorEnv
from qrl_envs.task import QuadrotorTask, Task
from qrl_envs.task_env import TaskEnv


def from_task(task: Task) -> TaskEnv:
    """The Brax environment of a task."""
    if not isinstance(task, QuadrotorTask):
        return PendulumEnv(task)
    return QuadrotorEnv(task) if task.ideal else RealQuadrotorEnv(task)


def make(name_or_path: str) -> TaskEnv:
    """The Brax environment of a shipped task's name or of a task file; raises BadInput if there is none."""
    return from_task(tasks.load(name_or_path))

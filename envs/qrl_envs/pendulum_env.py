"""The pendulum's task as an environment."""

import chex

from qrl_envs import measures, pendulum, rewards, symmetry
from qrl_envs.symmetry import Symmetry
from qrl_envs.task import PendulumTask
from qrl_envs.task_env import Evaluation, Params, TaskEnv


class PendulumEnv(TaskEnv):
    """Gymnasium's Pendulum-v1. Observation [3]: cos θ, sin θ, θ̇ [rad/s]; action [1] in [−1, 1]: torque/max_torque."""

    task: PendulumTask

    def __init__(self, task: PendulumTask) -> None:
        params = Params(pendulum.physics(task.rod), rewards.from_spec(task.reward), pendulum.start(task.start), {})
        super().__init__(task, params, observation_size=3, action_size=1)

    def _draw(self, params: Params, rng: chex.PRNGKey) -> pendulum.Pendulum:
        return pendulum.draw(params.start, rng)

    def _advance(
        self, params: Params, x: pendulum.Pendulum, action: chex.Array
    ) -> tuple[pendulum.Pendulum, chex.Array]:
        torque = pendulum.torque_N_m(params.physics, action)
        return pendulum.step(params.physics, x, torque, self.task.control_period_s), params.reward(x, torque)

    def _observe(self, params: Params, x: pendulum.Pendulum) -> chex.Array:
        del params
        return pendulum.observe(x)

    def symmetry(self, u: chex.Array) -> Symmetry:
        return symmetry.pendulum(u)

    def evaluation(self) -> Evaluation:
        spec, dt_s = self.task.evaluation, self.task.control_period_s

        def measure(observations: chex.Array) -> dict[str, chex.Array]:
            return measures.summarize(measures.pendulum(observations, spec), round(spec.tail_s / dt_s), dt_s)

        params = self.params
        if spec.start:
            params = params._replace(start=pendulum.start(spec.start))
        if spec.reward:
            params = params._replace(reward=rewards.from_spec(spec.reward))
        return Evaluation(self.with_params(params), round(spec.duration_s / dt_s), self.task.episode_steps, measure)

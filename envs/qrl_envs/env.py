"""Tasks as Brax environments.

`state.pipeline_state` is a `Lane`: the lane's own task (physics, reward weights, start ranges, bounds) travels
with its physical state, so a batch may mix vehicles. Beyond Brax's `Env`, a `TaskEnv` offers `restart` (a
fresh start that keeps the lane's task), `with_params` (the same world with other parameters) and `evaluation`. An
episode that ends early by leaving the bounds has `done = 1`, and `truncated = 1` and `out_of_bounds = 1` in `info`:
whoever bootstraps should treat it as a truncation, and should not trust a value function there.
"""

import abc
import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax.numpy as jnp
from flax import struct

from qrl_envs import measures, pendulum, quadrotor, rewards, symmetry
from qrl_envs import task as tasks
from qrl_envs.symmetry import Symmetry
from qrl_envs.task import PendulumTask, QuadrotorTask, Task


class Params(NamedTuple):
    """The task of one lane as a pytree; what of a task it holds is `task.TRACED`."""

    physics: Any
    reward: Any
    start: Any
    bounds: Any


class Lane(NamedTuple):
    """One lane's `pipeline_state`."""

    x: Any
    params: Params


class State(struct.PyTreeNode):
    """`brax.envs.State`, field by field. Not that class itself, as Brax takes seconds to import."""

    pipeline_state: Any
    obs: chex.Array  # [observation_size]
    reward: chex.Array  # []
    done: chex.Array  # [] float 0 or 1
    metrics: dict[str, chex.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class Evaluation(NamedTuple):
    """How a task is judged: fly `env` for `steps`, add up the first `return_steps` rewards, then `measure`."""

    env: "TaskEnv"
    steps: int
    return_steps: int
    measure: Callable[[chex.Array], dict[str, chex.Array]] | None  # observations [steps + 1, F] -> named scalars


class TaskEnv(abc.ABC):
    """A Brax environment made from a task; subclasses say what one world does.

    An instance of `brax.envs.Env` wherever Brax has been imported: `import qrl_envs` sees to it.
    """

    def __init__(self, task: Task, params: Params, observation_size: int, action_size: int) -> None:
        self.task = task
        self.params = params
        self._sizes = observation_size, action_size

    @property
    def observation_size(self) -> int:
        return self._sizes[0]

    @property
    def action_size(self) -> int:
        return self._sizes[1]

    @property
    def backend(self) -> str:
        return "qrl"

    @property
    def unwrapped(self) -> "TaskEnv":
        return self

    @property
    def episode_steps(self) -> int:
        return self.task.episode_steps

    @property
    def control_period_s(self) -> float:
        return self.task.control_period_s

    differentiable = True  # step and reward

    def with_params(self, params: Params) -> "TaskEnv":
        """This environment with other parameters of the same structure, which may be tracers."""
        other = copy.copy(self)
        other.params = params
        return other

    def reset(self, rng: chex.PRNGKey) -> State:
        """A fresh start drawn with `rng` (a legacy or typed key)."""
        return self._begin(self.params, rng)

    def reset_calibration(self, rng: chex.PRNGKey) -> State:
        """A start from the envelope that a policy has to cope with once it leaves the simulator."""
        return self.reset(rng)

    def restart(self, state: State, rng: chex.PRNGKey) -> State:
        """A fresh start that keeps the task carried by `state`."""
        return self._begin(state.pipeline_state.params, rng)

    def step(self, state: State, action: chex.Array) -> State:
        """One control period under `action` in [−1, 1]ⁿ (values beyond are clipped)."""
        lane: Lane = state.pipeline_state
        x, reward = self._advance(lane.params, lane.x, action)
        done = self._fled(lane.params, x).astype(jnp.float32)
        return state.replace(
            pipeline_state=Lane(x, lane.params),
            obs=self._observe(x),
            reward=reward,
            done=done,
            info={**state.info, "truncated": done, "out_of_bounds": done},
        )

    def symmetry(self, u: chex.Array) -> Symmetry:
        """A random symmetry of the task, drawn with u [2], uniform in [0, 1)."""
        return Symmetry(jnp.eye(self._sizes[0]), jnp.eye(self._sizes[1]))

    def _begin(self, params: Params, rng: chex.PRNGKey) -> State:
        x = self._draw(params, rng)
        zero = jnp.float32(0.0)
        return State(
            Lane(x, params), self._observe(x), zero, zero, metrics={}, info={"truncated": zero, "out_of_bounds": zero}
        )

    @abc.abstractmethod
    def _draw(self, params: Params, rng: chex.PRNGKey) -> Any: ...

    @abc.abstractmethod
    def _advance(self, params: Params, x: Any, action: chex.Array) -> tuple[Any, chex.Array]: ...

    @abc.abstractmethod
    def _observe(self, x: Any) -> chex.Array: ...

    def _fled(self, params: Params, x: Any) -> chex.Array:
        """Whether the episode ends here, before its last step; a bool []."""
        return jnp.bool_(False)

    @abc.abstractmethod
    def evaluation(self) -> Evaluation:
        """How DESIGN.md judges this task, whatever ranges and weights it trains with."""


class QuadrotorEnv(TaskEnv):
    """Hover or circle. Observation [18] and action [4] as in DESIGN.md, "Frames, units, order"."""

    task: QuadrotorTask

    def __init__(self, task: QuadrotorTask) -> None:
        bounds = {name: jnp.float32(value) for name, value in task.bounds.model_dump().items()}
        reward = rewards.from_spec(task.reward)
        params = Params(quadrotor.physics(task.vehicle), reward, quadrotor.start(task.start), bounds)
        super().__init__(task, params, observation_size=18, action_size=4)

    def reset_calibration(self, rng: chex.PRNGKey) -> State:
        return self._begin(self.params._replace(start=quadrotor.start(self.task.envelope)), rng)

    def _draw(self, params: Params, rng: chex.PRNGKey) -> quadrotor.Body:
        return quadrotor.draw(params.start, rng)

    def _advance(self, params: Params, x: quadrotor.Body, action: chex.Array) -> tuple[quadrotor.Body, chex.Array]:
        thrust = quadrotor.thrust_N(params.physics, action)
        body = quadrotor.step(params.physics, x, thrust, self.task.control_period_s)
        return body, params.reward(body, quadrotor.applied_action(params.physics, thrust))

    def _observe(self, x: quadrotor.Body) -> chex.Array:
        return quadrotor.observe(x)

    def _fled(self, params: Params, x: quadrotor.Body) -> chex.Array:
        near = jnp.linalg.norm(x.pose.position_m) <= params.bounds["distance_m"]
        calm = jnp.linalg.norm(x.twist.body_rate_rad_s) <= params.bounds["body_rate_rad_s"]
        return ~(near & calm)  # so that a NaN ends the episode too

    def symmetry(self, u: chex.Array) -> Symmetry:
        circling = self.task.reward.form == "circle"
        return (symmetry.circle if circling else symmetry.hover)(self.params.physics, u)

    def evaluation(self) -> Evaluation:
        spec, dt_s = self.task.evaluation, self.task.control_period_s
        judged = {"start": quadrotor.start(spec.start), "reward": rewards.from_spec(spec.reward)}
        env = self.with_params(self.params._replace(**judged))

        def measure(observations: chex.Array) -> dict[str, chex.Array]:
            if spec.reward.form == "hover":
                flight = measures.hover(observations, spec)
            else:
                flight = measures.circle(observations, spec, spec.reward.radius_m, spec.reward.speed_m_s)
            return measures.summarise(flight, round(spec.tail_s / dt_s), dt_s)

        return Evaluation(env, round(spec.duration_s / dt_s), spec.return_steps, measure)


class PendulumEnv(TaskEnv):
    """Pendulum-v1. Observation [cos θ, sin θ, θ̇], action [1]: torque/max_torque."""

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

    def _observe(self, x: pendulum.Pendulum) -> chex.Array:
        return pendulum.observe(x)

    def symmetry(self, u: chex.Array) -> Symmetry:
        return symmetry.pendulum(u)

    def evaluation(self) -> Evaluation:
        spec, dt_s = self.task.evaluation, self.task.control_period_s

        def measure(observations: chex.Array) -> dict[str, chex.Array]:
            return measures.summarise(measures.pendulum(observations, spec), round(spec.tail_s / dt_s), dt_s)

        params = self.params
        if spec.start:
            params = params._replace(start=pendulum.start(spec.start))
        if spec.reward:
            params = params._replace(reward=rewards.from_spec(spec.reward))
        return Evaluation(self.with_params(params), round(spec.duration_s / dt_s), self.task.episode_steps, measure)


def from_task(task: Task) -> TaskEnv:
    """The Brax environment of a task."""
    return QuadrotorEnv(task) if isinstance(task, QuadrotorTask) else PendulumEnv(task)


def make(name_or_path: str) -> TaskEnv:
    """The Brax environment of a shipped task's name or of a task file; BadInput if there is none."""
    return from_task(tasks.load(name_or_path))

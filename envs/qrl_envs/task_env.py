"""Tasks as Brax environments.

`state.pipeline_state` is a `Lane`: the lane's own task (physics, reward weights, start ranges, bounds) travels
with its physical state, so a batch may mix vehicles. Beyond Brax's `Env`, a `TaskEnv` has `restart` (a new start
that keeps the lane's task), `with_params`, `reset_calibration`, `symmetry` and `evaluation`. An episode that leaves
the bounds ends with `done = 1`, and `truncated = 1` and `out_of_bounds = 1` in `info`: it is a truncation whose last
reward goes on, for no flight within the bounds is to be worse than leaving them. A value function has seen no state
beyond the bounds, so a learner should not bootstrap from its value there.
"""

import abc
import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from qrl_envs.symmetry import Symmetry
from qrl_envs.task import Task


class Params(NamedTuple):
    """The parameters of one lane's task as a pytree: the parts of a task that `task.TRACED` names."""

    physics: Any
    reward: Any
    start: Any
    bounds: Any
    ranges: Any = ()  # of what differs from flight to flight


class Lane(NamedTuple):
    """One lane's `pipeline_state`."""

    x: Any
    params: Params


class State(struct.PyTreeNode):
    """A copy of `brax.envs.State`, because importing Brax takes seconds."""

    pipeline_state: Any
    obs: chex.Array  # [observation_size]
    reward: chex.Array  # []
    done: chex.Array  # [] float 0 or 1
    metrics: dict[str, chex.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class Evaluation(NamedTuple):
    """How a task is evaluated: step `env` `steps` times, add up the first `return_steps` rewards, then `measure`."""

    env: "TaskEnv"
    steps: int
    return_steps: int
    measure: Callable[[chex.Array], dict[str, chex.Array]] | None  # observations [steps + 1, F] -> named scalars


class TaskEnv(abc.ABC):
    """A Brax environment of a task; subclasses implement the physics.

    Once Brax is imported, `qrl_envs` registers this class as a virtual subclass of `brax.envs.Env`.
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
    policy_observation_size: int | None = None  # a policy sees this many numbers of an observation; None: all

    def policy_view(self, observation: chex.Array) -> chex.Array:
        """The input of a policy network, of what a policy sees of an observation; [..., F] -> [..., I]."""
        return observation

    def with_params(self, params: Params) -> "TaskEnv":
        """A copy with other parameters of the same structure, which may be tracers."""
        other = copy.copy(self)
        other.params = params
        return other

    def reset(self, rng: chex.PRNGKey) -> State:
        """A random start drawn with `rng`, a legacy or typed key."""
        return self._reset(self.params, rng)

    def reset_calibration(self, rng: chex.PRNGKey) -> State:
        """A random start from the task's `envelope`, the ranges that an exported policy is calibrated for."""
        return self.reset(rng)

    def restart(self, state: State, rng: chex.PRNGKey) -> State:
        """A random start that keeps the task carried by `state`."""
        return self._reset(state.pipeline_state.params, rng)

    def step(self, state: State, action: chex.Array) -> State:
        """One control period under `action` [A], clipped to [−1, 1]; differentiable in state and action, not in the
        task's parameters, which are constants of a flight.
        """
        lane: Lane = state.pipeline_state
        given, lane = lane, lane._replace(params=jax.lax.stop_gradient(lane.params))
        x, reward = self._advance(lane.params, lane.x, action)
        out = self._out_of_bounds(lane.params, x)
        reward, done = jnp.where(out, self._reward_out_of_bounds(lane.params), reward), out.astype(jnp.float32)
        return state.replace(
            pipeline_state=Lane(x, given.params),
            obs=self._observation(lane.params, x, action.shape[1:]),
            reward=reward,
            done=done,
            info={**state.info, "truncated": done, "out_of_bounds": done},
        )

    def _observation(self, params: Params, x: Any, lanes: tuple[int, ...]) -> chex.Array:
        """The observation [F], or [F, n] of n lanes."""
        if not lanes:
            return self._observe(params, x)
        # Each by itself: so its transposition, which networks read, takes no operation of its own.
        given = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, lanes) if jnp.ndim(leaf) == 0 else leaf, (params, x))
        return jax.vmap(self._observe, in_axes=-1, out_axes=-1)(*given)

    def step_lanes(self, state: State, action: chex.Array) -> State:
        """`step` of many lanes, which lie along the last axis of every leaf: so a CPU takes vectors of lanes.

        What a subclass computes (`_advance`, `_out_of_bounds`, …) is for one lane, or for any axes behind those of one;
        `_observe` and a `step` of its own are for one lane.
        """
        if self._steps_one_lane():
            return jax.vmap(self.step, in_axes=-1, out_axes=-1)(state, action)
        return self.step(state, action)

    def _steps_one_lane(self) -> bool:
        """Whether `step` was overridden without `step_lanes`: then it may sum over what would be lanes."""
        for names in (vars(self), *map(vars, type(self).__mro__)):
            if "step_lanes" in names:
                return False
            if "step" in names:
                return True
        return False

    def symmetry(self, u: chex.Array) -> Symmetry:
        """The random symmetry of the task that u [2] selects, uniform in [0, 1)."""
        return Symmetry(jnp.eye(self._sizes[0]), jnp.eye(self._sizes[1]))

    def _reset(self, params: Params, rng: chex.PRNGKey) -> State:
        x = self._draw(params, rng)
        zero = jnp.float32(0.0)
        return State(
            Lane(x, params),
            self._observe(params, x),
            zero,
            zero,
            metrics={},
            info={"truncated": zero, "out_of_bounds": zero},
        )

    @abc.abstractmethod
    def _draw(self, params: Params, rng: chex.PRNGKey) -> Any: ...

    @abc.abstractmethod
    def _advance(self, params: Params, x: Any, action: chex.Array) -> tuple[Any, chex.Array]: ...

    @abc.abstractmethod
    def _observe(self, params: Params, x: Any) -> chex.Array: ...

    def _out_of_bounds(self, params: Params, x: Any) -> chex.Array:
        """Whether the episode ends early in state `x`; bool []."""
        return jnp.bool_(False)

    def _reward_out_of_bounds(self, params: Params) -> chex.Array:
        """The reward of a step that leaves the bounds, and of each that the episode would still have had; []."""
        del params
        return jnp.float32(0.0)

    @abc.abstractmethod
    def evaluation(self) -> Evaluation:
        """The evaluation that the task file defines; it does not depend on the ranges and weights of training."""

"""Values that flow between rollout, replay buffer and learner, and what an environment is."""

from typing import Any, NamedTuple, Protocol

import chex
import jax.numpy as jnp


class State(Protocol):
    """`brax.envs.State`, or any class with its fields; `pipeline_state` may be any pytree."""

    @property
    def pipeline_state(self) -> Any: ...
    @property
    def obs(self) -> chex.Array: ...
    @property
    def reward(self) -> chex.Array: ...
    @property
    def done(self) -> chex.Array: ...
    @property
    def metrics(self) -> dict[str, chex.Array]: ...
    @property
    def info(self) -> dict[str, Any]: ...
    def replace(self, **changes: Any) -> Any: ...


def info_flag(state: State, name: str) -> chex.Array:
    """`state.info[name]`, false where it is absent; bool of `state.done`'s shape."""
    return jnp.asarray(state.info.get(name, jnp.zeros_like(state.done))).astype(bool)


class Env(Protocol):
    """`brax.envs.Env`, or any class with its methods, with flat observations. (Brax itself takes seconds to import.)

    An action is in [−1, 1]ⁿ. `done` is 1 at the end of an episode: a termination, or a truncation where `info` says so
    by "truncation" (Brax's name) or "truncated". `info["out_of_bounds"]` marks a truncation at states from which no
    transition begins; its last reward counts for each step that the episode would still have had.
    """

    def reset(self, rng: chex.PRNGKey) -> State: ...
    def step(self, state: Any, action: chex.Array) -> State: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...


class Symmetry(Protocol):
    """A symmetry of a task as matrices: step(S_o·o, S_a·a) = S_o·step(o, a), with the same reward."""

    @property
    def observation(self) -> chex.Array: ...  # S_o [F, F]
    @property
    def action(self) -> chex.Array: ...  # S_a [A, A]


class Evaluation(Protocol):
    """How a task is judged: fly `env` for `steps`, add up the first `return_steps` rewards, then `measure`."""

    @property
    def env(self) -> Env: ...
    @property
    def steps(self) -> int: ...
    @property
    def return_steps(self) -> int: ...
    @property
    def measure(self) -> Any: ...  # observations [steps + 1, F] -> named scalars; None: nothing is measured


class TaskEnv(Env, Protocol):
    """An environment with all abilities that qrl can use; `adapter.adapt` supplies those that an `Env` lacks."""

    @property
    def params(self) -> Any: ...  # pytree of arrays that sweeps may vary; () for none
    @property
    def policy_observation_size(self) -> int | None:
        """A policy sees this many numbers, the first; None: all. In APG `step` is given these alone, too."""
        ...

    def policy_view(self, observation: chex.Array) -> chex.Array: ...  # a policy network's input, of what it sees
    @property
    def episode_steps(self) -> int: ...  # maximum length of an episode
    @property
    def control_period_s(self) -> float | None: ...  # None: unknown
    @property
    def differentiable(self) -> bool: ...  # step and reward, as APG needs
    def with_params(self, params: Any) -> "TaskEnv": ...  # of the same structure; may be tracers
    def restart(self, state: Any, rng: chex.PRNGKey) -> State: ...  # a fresh start that keeps the state's parameters
    def step_lanes(self, state: Any, action: chex.Array) -> Any: ...  # `step`; lanes lie along the last axis of leaves
    def reset_calibration(self, rng: chex.PRNGKey) -> State: ...  # a start that a deployed policy must cope with
    def symmetry(self, u: chex.Array) -> Symmetry | None: ...  # a random one, drawn with u [2] in [0, 1)
    def evaluation(self) -> Evaluation | None: ...  # None: one episode, nothing measured


class Transition(NamedTuple):
    """What Algorithm 2 records of a step; leading axes as the holder says ([T, N], [slots, N, T], …).

    The observation after a step is the next step's own, but where an episode ends, and at the last step. Of those
    `final_observation` keeps two that V is bootstrapped from. It has no time axis, and neither has the memory.
    """

    observation: chex.Array  # [..., F] before the step
    action: chex.Array  # [..., A] as drawn from mu, not clipped
    log_mu: chex.Array  # [...] log-density of `action` under the policy that drew it
    reward: chex.Array  # [...]
    terminated: chex.Array  # [...] float 0 or 1: the bootstrap is zero
    truncated: chex.Array  # [...] float 0 or 1: bootstrapped, and the trace is cut
    out_of_bounds: chex.Array  # [...] float 0 or 1: truncated where no transition of the environment begins
    final_observation: Any  # [..., 2, F] after the first truncation within bounds, after the last step; 0 if not used
    memory: Any = ()  # [..., H] the policy's before the first step of an unroll; () for none


class Networks(NamedTuple):
    """Flax parameters of the two networks."""

    policy: chex.ArrayTree
    critic: chex.ArrayTree

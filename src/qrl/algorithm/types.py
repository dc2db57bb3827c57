"""Values that flow between rollout, ring buffer and learner, and what the learner takes for an environment."""

from typing import Any, NamedTuple, Protocol

import chex


class State(Protocol):
    """`brax.envs.State`, or what has its fields; any pytree will do as the physics' state."""

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


class Env(Protocol):
    """`brax.envs.Env`, or what has its methods, with flat observations. (Brax itself takes seconds to import.)"""

    def reset(self, rng: chex.PRNGKey) -> State: ...
    def step(self, state: Any, action: chex.Array) -> State: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...


class Transition(NamedTuple):
    """What Algorithm 2 records of a step; leading axes as the holder says ([T, N], [slots, N, T], …)."""

    observation: chex.Array  # [..., F] before the step
    action: chex.Array  # [..., A] as drawn from mu, not clipped
    log_mu: chex.Array  # [...] log-density of `action` under the policy that drew it
    reward: chex.Array  # [...]
    next_observation: chex.Array  # [..., F] after the step, before any reset: the next `observation` but at an end
    terminated: chex.Array  # [...] float 0 or 1: the bootstrap is zero
    truncated: chex.Array  # [...] float 0 or 1: bootstrapped, and the trace is cut
    out_of_bounds: chex.Array  # [...] float 0 or 1: truncated where no transition of the environment begins any more


class Networks(NamedTuple):
    """Flax parameters of the two networks."""

    policy: chex.ArrayTree
    critic: chex.ArrayTree

"""Values that flow between rollout, ring buffer and learner."""

from typing import NamedTuple

import chex


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

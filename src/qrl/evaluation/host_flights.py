"""Flights under a policy that runs on the host, in NumPy: step by step, so that each compiled program can be cached."""

from collections.abc import Callable
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from qrl.algorithm.adapter import adapt
from qrl.algorithm.flights import FlightPlan, Flights, Progress, observed
from qrl.algorithm.types import Env, State

ONCE = {"xla_backend_optimization_level": 0}  # of a program that runs once: half the time to compile
HostPolicy = Callable[[Any, NDArray[np.float32]], tuple[Any, NDArray[np.floating]]]
"""Memory and observation [n, F] of n flights -> next memory, and action [n, A] in [−1, 1]."""


class HostFlights:
    """The flights of one environment."""

    def __init__(self, env: Env, max_episode_steps: int) -> None:
        """`max_episode_steps`: of an environment without an `evaluation`."""
        plan = FlightPlan.of(env, max_episode_steps)

        def start(keys: chex.PRNGKey, in_envelope: chex.Array) -> Progress:
            def reset(key: chex.PRNGKey, in_envelope: chex.Array) -> State:
                states = adapt(plan.env).reset_calibration(key), plan.env.reset(key)
                return jax.tree.map(partial(jnp.where, in_envelope), *states)

            return plan.start(jax.vmap(reset)(keys, in_envelope))

        self._steps = plan.steps
        self._start = jax.jit(start, compiler_options=ONCE)
        self._step, self._flights = jax.jit(plan.step), jax.jit(plan.flights)
        self._observed = jax.jit(lambda now: (now.state.obs, observed(now.state)))

    def fly(self, policy: HostPolicy, memory: Any, starts: chex.PRNGKey, from_envelope: float = 0.0) -> Flights:
        """In NumPy, leading axis: starts, of which the last fraction `from_envelope` starts in the envelope.

        `memory` is that of the first step.
        """
        now = self._start(starts, jnp.arange(len(starts)) >= (1.0 - from_envelope) * len(starts))
        observations, actions = [], []
        for _ in range(self._steps):
            seen, recorded = self._observed(now)
            memory, action = policy(memory, np.asarray(seen))
            now, given = self._step(now, np.asarray(action, np.float32))
            observations.append(recorded)
            actions.append(given)
        return jax.tree.map(np.asarray, self._flights(now, jnp.stack(observations), jnp.stack(actions)))

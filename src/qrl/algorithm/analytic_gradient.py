"""Analytic policy gradient (APG): ascend the return of flights, differentiated through the environment's own step.

Backpropagation through time, as in Brax's APG (Freeman et al. 2021), for environments whose step and reward are
differentiable. It needs no stored trajectories and no value function.
"""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm import learner
from qrl.algorithm.adapter import adapt
from qrl.algorithm.carried import Carried, Carry
from qrl.algorithm.learner import LearnerSpec, LearnerState, UpdateMetrics
from qrl.algorithm.types import Env, State, info_flag
from qrl.config import Hyperparameters
from qrl_envs.fusion import stored

# memory [n, H] or (), what a policy sees [n, I] -> next memory, mean actions [n, A]
Act = Callable[[Any, chex.Array], tuple[Any, chex.Array]]


@jax.custom_vjp
def _bounded(carry: Carry, memory: Any, limit: chex.Array) -> tuple[Carry, Any]:
    """Both as they are; on the way back the norm of the cotangent of each of the n flights is at most `limit`."""
    del limit
    return carry, memory


def _bounded_forward(carry: Carry, memory: Any, limit: chex.Array) -> tuple[tuple[Carry, Any], chex.Array]:
    return (carry, memory), limit


def _bounded_backward(limit: chex.Array, cotangents: tuple[Carry, Any]) -> tuple[Carry, Any, None]:
    carry, memory = cotangents

    def square(x: chex.Array, lanes: int) -> chex.Array | float:
        if x.dtype == jax.dtypes.float0:
            return 0.0
        return jnp.sum(x * x, axis=[axis for axis in range(x.ndim) if axis != lanes % x.ndim])

    total = sum(square(x, 0) for x in jax.tree.leaves((carry.observation, memory)))
    total = total + sum(square(x, -1) for x in jax.tree.leaves(carry._replace(observation=())))
    factor = jnp.where(jnp.isfinite(total), jnp.minimum(1.0, limit * jax.lax.rsqrt(total + 1e-20)), 0.0)

    def scaled(x: chex.Array, factor: chex.Array) -> chex.Array:
        return x if x.dtype == jax.dtypes.float0 else jnp.where(factor > 0.0, x * factor, 0.0)

    memory = jax.tree.map(lambda x: scaled(x, factor[:, None]), memory)
    return jax.tree.map(scaled, carry, carry.each(factor)), memory, None


_bounded.defvjp(_bounded_forward, _bounded_backward)


def returns(
    env: Env,
    policy: Act,
    memory: Any,
    sigma: chex.Array,
    keys: chex.PRNGKey,
    steps: int,
    cotangent_norm: chex.Array | None = None,
) -> tuple[chex.Array, chex.Array]:
    """For each of `keys` [n] a flight of `steps` from a fresh start: sum of its rewards, and whether it is complete.

    Actions are clip(mean + sigma·noise, −1, 1), where policy(memory, observation) gives the next memory and the mean;
    `memory` is that of the first step. A flight that ends early is not complete. It is held where it ended, since what
    overflows has no gradient, and is charged for the steps that are left: the last reward each, or 0 if that was above
    0 and the flight was not out of bounds. So ending never pays. With `cotangent_norm` the gradient of a flight's
    return with respect to its state, its observation and the policy's memory after any step is cut to that norm: long
    flights of a lagged vehicle are chaotic, and a few of them would drown all others.
    """
    env = adapt(env)

    def one(key: chex.PRNGKey) -> tuple[State, chex.Array]:
        start, noise = jax.random.split(key)
        return env.reset(start), jax.random.normal(noise, (steps, env.action_size))

    def step_of(state: State, action: chex.Array) -> State:
        return seen_of(env.step_lanes(state, action))

    def seen_of(state: State) -> State:
        return state.replace(obs=state.obs[: env.policy_observation_size])  # a critic is not asked

    # Flights lie along the last axis: so a CPU takes vectors of them.
    states, noise = jax.vmap(one, out_axes=-1)(keys)
    states = seen_of(states)
    carried = Carried(step_of, states, noise[0], _wanted, _wanted)

    def step(now: tuple[Carry, Any, chex.Array], noise: chex.Array) -> tuple[tuple[Carry, Any, chex.Array], Any]:
        carry, memory, alive = now
        state = carried.unpack(carry, states)
        memory, mean = policy(memory, carry.observation)
        after = step_of(state, stored(jnp.clip(mean.T + sigma * noise, -1.0, 1.0)))
        charge = jnp.where(info_flag(state, "out_of_bounds"), state.reward, jnp.minimum(state.reward, 0.0))
        reward = jnp.where(alive > 0, after.reward, charge)
        carry = jax.tree.map(jnp.where, carry.each(alive > 0), carried.follow(carry, after), carry)
        if cotangent_norm is not None:
            # The observation too: through it alone the next action depends on this one.
            carry, memory = _bounded(carry, memory, cotangent_norm)
        return (carry, memory, alive * (1.0 - after.done)), reward

    # Rematerialize each step in the backward pass: the intermediate values of all steps would not fit a CPU's cache.
    first = carried.pack(states), memory, jnp.ones_like(states.reward)
    (_, _, alive), rewards = jax.lax.scan(jax.checkpoint(step), first, noise)
    return jnp.sum(rewards, axis=0), alive > 0


def _wanted(state: State) -> Any:
    """What `returns` takes of a state."""
    return state.obs, state.reward, state.done, state.info.get("out_of_bounds")


def decay(progress: chex.Array) -> chex.Array:
    """Factor on step size and noise at a `progress` of APG in [0, 1), from 1 to 0; [].

    (1 − progress)^1.5: with a linear decay policies still wandered by 2 mm near the end (docs/profile.md).
    """
    return (1.0 - progress) ** 1.5


def update(
    spec: LearnerSpec,
    hyper: Hyperparameters,
    state: LearnerState,
    returns_of: Callable[[LearnerState], tuple[chex.Array, chex.Array]],
    progress: chex.Array,
) -> tuple[LearnerState, UpdateMetrics, chex.Array, chex.Array]:
    """One step up the mean return; also the sums of returns and of complete flights over all devices [2], and whether
    the step was skipped (bool []).

    `returns_of` gives returns [n], differentiable in the policy, and whether each flight is complete [n]. `progress` []
    is the fraction of APG that is done. The first starts from the deployed policy with a new optimizer.
    Flights can be chaotic: where the gradient is not finite, the step is skipped: policy and optimizer stay.
    """
    before = learner.deployed(spec, state).params.policy
    optimizer = jax.tree.map(lambda x: jnp.where(progress == 0, 0, x).astype(x.dtype), state.optimizer.policy)

    def loss(policy: chex.ArrayTree) -> tuple[chex.Array, chex.Array]:
        values, complete = returns_of(state._replace(params=state.params._replace(policy=policy)))
        return -jnp.sum(values), len(values) * jnp.stack([jnp.mean(values), jnp.mean(complete), 1.0])

    # Divided after the way back: a bound there is on the gradient of one flight's return, however many fly beside it.
    sums = jax.grad(loss, has_aux=True)(before)
    flights = sums[1][2]
    gradient, means = learner.mean_over_devices(spec, jax.tree.map(lambda x: x / flights, sums))
    rate = decay(progress) * hyper.apg_learning_rate
    after, optimizer_after, norm = learner.apply_gradient(hyper, before, gradient, optimizer, rate)
    finite = jnp.isfinite(norm)
    policy, optimizer = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), (after, optimizer_after), (before, optimizer)
    )
    state = state._replace(
        params=state.params._replace(policy=policy),
        optimizer=state.optimizer._replace(policy=optimizer),
        average=policy,
        updates=state.updates + 1,
    )
    zero = jnp.zeros(())
    metrics = UpdateMetrics(*[zero] * len(UpdateMetrics._fields))
    metrics = metrics._replace(policy_loss=-means[0], policy_gradient=jnp.where(finite, norm, 0.0))
    return state, metrics, spec.config.apg_num_envs * means[:2], ~finite

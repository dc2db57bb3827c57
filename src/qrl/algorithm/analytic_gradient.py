"""Analytic policy gradient: the return of whole flights, to be differentiated through the environment's own step.

Backpropagation through time, as in Brax's APG (Freeman et al. 2021). For environments whose step and reward are
differentiable, such as ours; no trajectory is needed but that of the policy itself, and no value function.
"""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm.types import Env, State

Mean = Callable[[chex.Array], chex.Array]  # observations [..., F] -> actions [..., A]


def returns(
    env: Env,
    mean: Mean,
    sigma: chex.Array,
    keys: chex.PRNGKey,
    steps: int,
) -> tuple[chex.Array, chex.Array]:
    """For each of `keys` [n] a flight of `steps` from a fresh start: the sum of its rewards, and whether it is whole.

    Actions are clip(mean(observation) + sigma·noise, −1, 1). A flight that ends early is not whole; its sum is 0,
    without a gradient: where rewards are below 0, it would pay to end.
    """

    def one(key: chex.PRNGKey) -> tuple[State, chex.Array]:
        start, noise = jax.random.split(key)
        return env.reset(start), jax.random.normal(noise, (steps, env.action_size))

    def step(carry: tuple[State, chex.Array], noise: chex.Array) -> tuple[tuple[State, chex.Array], chex.Array]:
        state, whole = carry
        after = jax.vmap(env.step)(state, jnp.clip(mean(state.obs) + sigma * noise, -1.0, 1.0))
        return (after, whole * (1.0 - after.done)), after.reward

    states, noise = jax.vmap(one)(keys)
    # Each step once more on the way back: its intermediate values, of all steps, would not stay in a CPU's cache.
    first = states, jnp.ones_like(states.reward)
    (_, whole), rewards = jax.lax.scan(jax.checkpoint(step), first, jnp.swapaxes(noise, 0, 1))
    return jnp.where(whole > 0, jnp.sum(rewards, axis=0), 0.0), whole > 0

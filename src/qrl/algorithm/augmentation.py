"""Data augmentation by the task's symmetries.

The method holds for any mu, so a transformed trajectory is learned from as the transformed policy's: log_mu stays.
"""

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm.types import TaskEnv, Transition


def sample(keys: chex.PRNGKey, minibatches: int, each: int) -> chex.Array:
    """Uniform numbers that draw a symmetry for each trajectory; [minibatches, S·each, 2] for `keys` [S]."""
    draws = jax.vmap(lambda key: jax.random.uniform(key, (minibatches, each, 2)))(keys)
    return jnp.swapaxes(draws, 0, 1).reshape(minibatches, -1, 2)


def augment(env: TaskEnv, batch: Transition, draws: chex.Array) -> Transition:
    """Trajectories [B, T, ...], each transformed by the symmetry of `env` that `draws` [B, 2] selects."""

    def transform(x: chex.Array, matrices: chex.Array) -> chex.Array:
        return jnp.matmul(x, matrices.swapaxes(1, 2), precision="highest")  # a GPU's default would round to ten bits

    symmetries = jax.vmap(env.symmetry)(draws)
    if symmetries is None:
        return batch
    # Together: a product of two rows takes a CPU as long as one of fifty.
    observations = jnp.concatenate([batch.observation, batch.final_observation], axis=1)
    transformed = transform(observations, symmetries.observation)
    observation, final = jnp.split(transformed, [batch.observation.shape[1]], axis=1)
    return batch._replace(
        observation=observation, final_observation=final, action=transform(batch.action, symmetries.action)
    )

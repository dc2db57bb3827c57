"""The Gaussian policy and the critic as flax modules, and the log-density of the policy."""

from collections.abc import Callable

import chex
import flax.linen as nn
import jax.numpy as jnp

ACTIVATIONS: dict[str, Callable[[chex.Array], chex.Array]] = {"relu": nn.relu, "tanh": nn.tanh}


class MLP(nn.Module):
    """Fully connected network with orthogonal initialisation; [..., F] -> [..., outputs]."""

    hidden: tuple[int, ...]
    outputs: int
    activation: str
    final_gain: float

    @nn.compact
    def __call__(self, x: chex.Array) -> chex.Array:
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.final_gain))(x)


def log_density(action: chex.Array, mean: chex.Array, sigma: float | chex.Array) -> chex.Array:
    """log N(action; mean, sigma²·I) summed over action dimensions; [..., A], [..., A], [] -> [...]."""
    z = (action - mean) / sigma
    return jnp.sum(-0.5 * z**2 - jnp.log(sigma) - 0.5 * jnp.log(2.0 * jnp.pi), axis=-1)

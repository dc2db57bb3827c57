"""The Gaussian policy and the critic as flax modules, and the log-density of the policy."""

from collections.abc import Callable
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp

ACTIVATIONS: dict[str, Callable[[chex.Array], chex.Array]] = {"relu": nn.relu, "tanh": nn.tanh}


class MLP(nn.Module):
    """Fully connected network with orthogonal initialization; [..., F] -> [..., outputs]."""

    hidden: tuple[int, ...]
    outputs: int
    activation: str
    final_gain: float

    @nn.compact
    def __call__(self, x: chex.Array) -> chex.Array:
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))(x))
        last = nn.Dense(
            self.outputs, kernel_init=nn.initializers.orthogonal(self.final_gain), dot_general=_narrow_dot_general
        )
        return last(x)


@jax.custom_vjp
def _product(x: chex.Array, kernel: chex.Array) -> chex.Array:
    """x @ kernel, [..., F] and [F, outputs], for few outputs; differentiable in reverse mode alone."""
    return x @ kernel


def _forward(x: chex.Array, kernel: chex.Array) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
    return _product(x, kernel), (x, kernel)


def _backward(residuals: tuple[chex.Array, chex.Array], error: chex.Array) -> tuple[chex.Array, chex.Array]:
    x, kernel = residuals
    # The barrier keeps XLA from folding the transposition into the product, which takes a CPU six times as long where
    # outputs are few.
    transposed = jax.lax.optimization_barrier(error.reshape(-1, error.shape[-1]).T @ x.reshape(-1, x.shape[-1]))
    return error @ kernel.T, transposed.T


_product.defvjp(_forward, _backward)


def _narrow_dot_general(
    x: chex.Array, kernel: chex.Array, dimension_numbers: Any, precision: Any = None, **_: Any
) -> chex.Array:
    assert precision is None
    assert dimension_numbers == (((x.ndim - 1,), (0,)), ((), ()))
    return _product(x, kernel)


def log_density(action: chex.Array, mean: chex.Array, sigma: float | chex.Array) -> chex.Array:
    """log N(action; mean, sigma²·I) summed over action dimensions; [..., A], [..., A], [] -> [...]."""
    z = (action - mean) / sigma
    return jnp.sum(-0.5 * z**2 - jnp.log(sigma) - 0.5 * jnp.log(2.0 * jnp.pi), axis=-1)


def apply(network: MLP, params: chex.ArrayTree, x: chex.Array) -> chex.Array:
    """The network's output; [..., F] -> [..., outputs]."""
    return jnp.asarray(network.apply(params, x))  # flax types its result as a union

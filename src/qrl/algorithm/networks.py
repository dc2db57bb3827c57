"""The Gaussian policy, feed-forward or recurrent, and the critic as flax modules; the log-density of the policy."""

from collections.abc import Callable
from functools import partial
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp

ACTIVATIONS: dict[str, Callable[[chex.Array], chex.Array]] = {"relu": nn.relu, "tanh": nn.tanh}
BLOCK_WORK = 100 * 64**2  # multiply-adds; twice as many were still computed by one thread, four times by two
MIN_BLOCK_ROWS = 32  # thinner blocks take longer than one product, of wide layers many times as long


class MLP(nn.Module):
    """Fully connected network with orthogonal initialization; [..., F] -> [..., outputs]."""

    hidden: tuple[int, ...]
    outputs: int
    activation: str
    final_gain: float
    in_blocks: bool = False  # hidden layers' weight gradients are sums over blocks of rows (`_gradient_in_blocks`)

    @nn.compact
    def __call__(self, x: chex.Array) -> chex.Array:
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](_hidden_layer(width, self.in_blocks)(x))
        return _last_layer(self.outputs, self.final_gain)(x)


class GRU(nn.Module):
    """Fully connected layers, a gated recurrent unit (Cho et al. 2014, in cuDNN's form) and a linear output.

    r, z = σ(W x + U h + b), n = tanh(W_n x + b_n + r·(U_n h + c)), h' = z·h + (1 − z)·n; the output is that of h'.
    """

    hidden: tuple[int, ...]
    units: int  # H
    outputs: int
    activation: str
    final_gain: float
    in_blocks: bool = False  # hidden layers' weight gradients are sums over blocks of rows (`_gradient_in_blocks`)

    def setup(self) -> None:
        square = nn.initializers.orthogonal()
        self.layers = [_hidden_layer(width, self.in_blocks) for width in self.hidden]
        self.of_input = nn.Dense(3 * self.units, kernel_init=_each_gate(square), bias_init=_remembers)
        self.of_memory = nn.Dense(3 * self.units, kernel_init=_each_gate(square), use_bias=False)
        self.candidate_bias = self.param("candidate_bias", nn.initializers.zeros, (self.units,))
        self.of_output = _last_layer(self.outputs, self.final_gain)

    def __call__(self, memory: chex.Array, x: chex.Array) -> tuple[chex.Array, chex.Array]:
        """Next memory and output; [..., H], [..., F] -> [..., H], [..., outputs]."""
        memory = self.remember(memory, self.encode(x))
        return memory, self.output(memory)

    def encode(self, x: chex.Array) -> chex.Array:
        """What the gates are given of an input; [..., F] -> [..., 3H]."""
        for layer in self.layers:
            x = ACTIVATIONS[self.activation](layer(x))
        return self.of_input(x)

    def remember(self, memory: chex.Array, gates: chex.Array) -> chex.Array:
        """The next memory; [..., H], [..., 3H] -> [..., H]."""
        # Split, not sliced: the gradient is one concatenation, that of slices a sum of padded arrays.
        sizes = 2 * self.units, self.units
        given, given_n = jax.lax.split(gates, sizes, axis=gates.ndim - 1)
        own, own_n = jax.lax.split(self.of_memory(memory), sizes, axis=memory.ndim - 1)
        r, z = jnp.split(nn.sigmoid(given + own), 2, axis=-1)
        n = jnp.tanh(given_n + r * (own_n + self.candidate_bias))
        return z * memory + (1.0 - z) * n

    def output(self, memory: chex.Array) -> chex.Array:
        """[..., H] -> [..., outputs]."""
        return self.of_output(memory)


Network = MLP | GRU


def _each_gate(initializer: Any) -> Any:
    """An initializer of three square blocks, each by itself."""

    def init(key: chex.PRNGKey, shape: tuple[int, int], dtype: Any = jnp.float32) -> chex.Array:
        keys = jax.random.split(key, 3)
        return jnp.concatenate([initializer(k, (shape[0], shape[1] // 3), dtype) for k in keys], axis=1)

    return init


def _remembers(key: chex.PRNGKey, shape: tuple[int], dtype: Any = jnp.float32) -> chex.Array:
    """Biases of the gates: z begins at 0.73, so that a gradient reaches back a few steps."""
    del key
    units = shape[0] // 3
    return jnp.zeros(shape, dtype).at[units : 2 * units].set(1.0)


def _hidden_layer(width: int, in_blocks: bool) -> nn.Dense:
    product = partial(_dot_general, _gradient_in_blocks) if in_blocks else jax.lax.dot_general
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5), dot_general=product)


def _last_layer(outputs: int, gain: float) -> nn.Dense:
    product = partial(_dot_general, _gradient_of_few_outputs)
    return nn.Dense(outputs, kernel_init=nn.initializers.orthogonal(gain), dot_general=product)


WeightGradient = Callable[[chex.Array, chex.Array], chex.Array]  # of x [n, F] and its product's error [n, outputs]


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _product(weight_gradient: WeightGradient, x: chex.Array, kernel: chex.Array) -> chex.Array:
    """x @ kernel, [..., F] and [F, outputs], whose kernel's gradient is computed by `weight_gradient`; differentiable
    in reverse mode alone.
    """
    return x @ kernel


def _forward(
    weight_gradient: WeightGradient, x: chex.Array, kernel: chex.Array
) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
    return _product(weight_gradient, x, kernel), (x, kernel)


def _backward(
    weight_gradient: WeightGradient, residuals: tuple[chex.Array, chex.Array], error: chex.Array
) -> tuple[chex.Array, chex.Array]:
    x, kernel = residuals
    rows, errors = x.reshape(-1, x.shape[-1]), error.reshape(-1, error.shape[-1])
    return error @ kernel.T, weight_gradient(rows, errors)


_product.defvjp(_forward, _backward)


def _gradient_of_few_outputs(x: chex.Array, error: chex.Array) -> chex.Array:
    # The barrier keeps XLA from folding the transposition into the product, which takes a CPU six times as long where
    # outputs are few.
    return jax.lax.optimization_barrier(error.T @ x).T


def _gradient_in_blocks(x: chex.Array, error: chex.Array) -> chex.Array:
    """As a sum over blocks of rows, each of BLOCK_WORK or less, where the number of rows allows it and each has at
    least MIN_BLOCK_ROWS: of layers of up to 100 units or so.

    Eigen divides a larger product among the threads of the process. Where each has a device of its own to run, the
    parts wait for each other (docs/profile.md, "With two devices").
    """
    rows = x.shape[0]
    least = -(-rows * x.shape[1] * error.shape[1] // BLOCK_WORK)
    most = min(2 * least - 1, rows // MIN_BLOCK_ROWS)
    blocks = next((n for n in range(least, most + 1) if rows % n == 0), 1)
    if blocks == 1:
        return x.T @ error
    parts = jnp.einsum("bni,bno->bio", *(y.reshape(blocks, rows // blocks, -1) for y in (x, error)))
    return jnp.sum(parts, axis=0)


def _dot_general(
    weight_gradient: WeightGradient,
    x: chex.Array,
    kernel: chex.Array,
    dimension_numbers: Any,
    precision: Any = None,
    **_: Any,
) -> chex.Array:
    assert precision is None
    assert dimension_numbers == (((x.ndim - 1,), (0,)), ((), ()))
    return _product(weight_gradient, x, kernel)


def log_density(action: chex.Array, mean: chex.Array, sigma: float | chex.Array) -> chex.Array:
    """log N(action; mean, sigma²·I) summed over action dimensions; [..., A], [..., A], [] -> [...]."""
    z = (action - mean) / sigma
    return jnp.sum(-0.5 * z**2 - jnp.log(sigma) - 0.5 * jnp.log(2.0 * jnp.pi), axis=-1)


def apply(network: Network, params: Any, *inputs: chex.Array, method: str = "__call__") -> Any:
    """The network's result, or that of one of its methods."""
    return network.apply(params, *inputs, method=method)


def scale_inputs(network: Network, params: Any, scale: chex.Array) -> Any:
    """Parameters with which a network makes of x what `params` make of x · scale [F], to rounding."""
    first = "layers_0" if isinstance(network, GRU) else "Dense_0"
    layer = params["params"][first]
    return {"params": params["params"] | {first: layer | {"kernel": layer["kernel"] * scale[:, None]}}}


def init(network: Network, key: chex.PRNGKey, x: chex.Array) -> Any:
    """Parameters of a network of inputs like x [..., F]."""
    if isinstance(network, GRU):
        return network.init(key, initial_memory(network, x.shape[:-1]), x)
    return network.init(key, x)


def initial_memory(network: Network, lanes: tuple[int, ...]) -> Any:
    """The memory of so many lanes at the start of an episode: zeros [*lanes, H], or () of a feed-forward network."""
    return jnp.zeros((*lanes, network.units)) if isinstance(network, GRU) else ()


def step(network: Network, params: Any, memory: Any, x: chex.Array) -> tuple[Any, chex.Array]:
    """Next memory and output for the inputs x; [..., F] -> [..., outputs]."""
    if isinstance(network, GRU):
        return apply(network, params, memory, x)
    return memory, apply(network, params, x)


def unroll(network: Network, params: Any, memory: Any, x: chex.Array, ended: chex.Array) -> chex.Array:
    """Outputs over trajectories x [B, T, F], from the memory before their first steps; it starts anew after each step
    that `ended` [B, T] an episode. As one row for each step: [B·T, outputs].
    """
    batch, steps = x.shape[:2]
    flat = x.reshape(batch * steps, -1)  # one large product instead of a batched small one
    if not isinstance(network, GRU):
        return apply(network, params, flat)
    gates = apply(network, params, flat, method="encode").reshape(batch, steps, -1)
    fresh = jnp.pad(ended[:, :-1] > 0, ((0, 0), (1, 0)))

    def one(memory: chex.Array, at: tuple[chex.Array, chex.Array]) -> tuple[chex.Array, chex.Array]:
        gates, fresh = at
        memory = jnp.where(fresh[:, None], 0.0, memory)
        memory = apply(network, params, memory, gates, method="remember")
        return memory, memory

    _, memories = jax.lax.scan(one, memory, (gates.swapaxes(0, 1), fresh.T))
    return apply(network, params, memories.swapaxes(0, 1).reshape(batch * steps, -1), method="output")

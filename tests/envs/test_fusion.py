"""`stored`: what a compiler computes once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from qrl_envs.fusion import stored


def used_often(keep: Callable[[Any], Any]) -> Callable[[jax.Array], jax.Array]:
    """A value that XLA would compute anew in each of three operations that it does not fuse with each other."""

    def f(x: jax.Array) -> jax.Array:
        y = keep({"y": x * x + 3.0})["y"]
        return jnp.stack([jnp.cumsum(y), jnp.sort(y), jnp.cumsum(y[::-1])])

    return f


def occurrences(operation: str, f: Callable[[jax.Array], jax.Array]) -> int:
    """In the compiled program."""
    return str(jax.jit(f).lower(jnp.arange(64.0)).compile().as_text()).count(f" {operation}(")


def test_what_is_stored_is_computed_once() -> None:
    """XLA repeats the product without, behind an optimization barrier too."""
    assert occurrences("multiply", used_often(lambda x: x)) > 1
    assert occurrences("multiply", used_often(jax.lax.optimization_barrier)) > 1
    assert occurrences("multiply", used_often(stored)) == 1


@pytest.mark.parametrize("mode", ["fwd", "rev"])
def test_derivatives_are_those_without(mode: str) -> None:
    """Against finite differences, in both modes, batched, in a loop whose steps are computed again on the way back."""

    def f(x: jax.Array) -> jax.Array:
        def step(x: jax.Array, a: jax.Array) -> tuple[jax.Array, None]:
            return jnp.sin(stored({"x": x * a, "n": 1})["x"][::-1]), None

        return jax.lax.scan(jax.checkpoint(step), x, jnp.linspace(0.5, 1.5, 4))[0]

    x = jnp.array([[0.3, -0.7, 1.1], [0.1, 0.2, 0.3]])
    check_grads(jax.vmap(f), (x,), order=1, modes=[mode], rtol=1e-2)
    np.testing.assert_array_equal(jax.jit(jax.vmap(f))(x)[0], jax.jit(f)(x[0]))


def test_the_cotangent_is_stored_too() -> None:
    def forward(x: jax.Array) -> jax.Array:
        return jnp.sum(stored(x * x) ** 3)

    assert occurrences("call", forward) == 1
    assert occurrences("call", jax.grad(forward)) == 2

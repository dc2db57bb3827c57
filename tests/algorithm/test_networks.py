"""The networks against the same formula in plain `jnp`, gradients too: some layers have their own."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm import networks
from qrl.algorithm.networks import MLP

F = 5


def plain(params: dict, x: jax.Array) -> jax.Array:
    """The same without flax."""
    layers = [params["params"][f"Dense_{i}"] for i in range(len(params["params"]))]
    for layer in layers[:-1]:
        x = jnp.tanh(x @ layer["kernel"] + layer["bias"])
    return x @ layers[-1]["kernel"] + layers[-1]["bias"]


@pytest.mark.parametrize("outputs", [1, 4, 17])
@pytest.mark.parametrize("shape", [(F,), (7, F), (3, 7, F)], ids=["one", "a row", "trajectories"])
def test_gradients_are_those_of_the_plain_formula(outputs: int, shape: tuple[int, ...]) -> None:
    """In parameters and inputs, of a loss that weighs every output differently."""
    network = MLP((8, 6), outputs, "tanh", final_gain=1.0)
    x = jax.random.normal(jax.random.PRNGKey(0), shape)
    weights = jax.random.normal(jax.random.PRNGKey(1), (*shape[:-1], outputs))
    params = network.init(jax.random.PRNGKey(2), x)

    def gradient(apply: object) -> object:
        return jax.jit(jax.grad(lambda p, x: jnp.sum(jnp.sin(apply(p, x)) * weights), argnums=(0, 1)))(params, x)

    ours, theirs = gradient(network.apply), gradient(plain)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), ours, theirs)


@pytest.mark.parametrize("axes", [(0, 0), (None, 0), (0, None)], ids=["members", "inputs", "parameters"])
@pytest.mark.parametrize("in_blocks", [False, True])
def test_gradients_of_members_side_by_side(
    axes: tuple[int | None, int | None], in_blocks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under vmap, within a rematerialized scan, as flights are differentiated."""
    monkeypatch.setattr(networks, "BLOCK_WORK", 2 * F * 8)
    monkeypatch.setattr(networks, "MIN_BLOCK_ROWS", 2)
    network = MLP((8,), 2, "tanh", final_gain=1.0, in_blocks=in_blocks)
    x = jax.random.normal(jax.random.PRNGKey(0), (3, 4, F))
    many = jax.vmap(lambda key: network.init(key, x[0]))(jax.random.split(jax.random.PRNGKey(2), 3))
    params = many if axes[0] == 0 else jax.tree.map(lambda p: p[0], many)
    inputs = x if axes[1] == 0 else x[0]

    def gradient(apply: object) -> object:
        def loss(p: dict, x: jax.Array) -> jax.Array:
            step = jax.checkpoint(lambda o, _: (o + jnp.tile(apply(p, o), 3)[:, :F], None))
            return jnp.sum(jax.lax.scan(step, x, None, length=3)[0] ** 2)

        return jax.jit(jax.vmap(jax.grad(loss), in_axes=axes))(params, inputs)

    ours, theirs = gradient(network.apply), gradient(plain)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), ours, theirs)


@pytest.mark.parametrize(("rows", "blocks"), [(12, 3), (18, 6), (13, 1), (4, 1), (20, 1)])
def test_weight_gradients_in_blocks_of_rows(rows: int, blocks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a number of rows that blocks divide, one that none divides, one that is a block by itself, and one whose
    blocks would be too thin; each product within the limit, as the compiled program has them.
    """
    monkeypatch.setattr(networks, "BLOCK_WORK", (4 if rows < 20 else 2) * F * 8)
    monkeypatch.setattr(networks, "MIN_BLOCK_ROWS", 3)
    network = MLP((8,), 2, "tanh", final_gain=1.0, in_blocks=True)
    x = jax.random.normal(jax.random.PRNGKey(0), (rows, F))
    params = network.init(jax.random.PRNGKey(2), x)

    def gradient(apply: object) -> object:
        return jax.grad(lambda p, x: jnp.sum(jnp.sin(apply(p, x))), argnums=(0, 1))

    ours, theirs = jax.jit(gradient(network.apply)).lower(params, x).compile(), gradient(plain)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), ours(params, x), theirs(params, x)
    )
    assert {int(n) for n in re.findall(rf"f32\[(\d+),{F},8\]", ours.as_text())} == ({blocks} if blocks > 1 else set())

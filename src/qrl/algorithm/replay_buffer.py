"""Device-resident ring buffer of whole unrolls.

A slot holds one unroll of all lanes; a full ring overwrites its oldest slot. `inserted` must stay unbatched
where members are vmapped: a batched cursor turns the slice update into a scatter.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


class Ring(NamedTuple):
    data: chex.ArrayTree  # leaves [slots, N, T, ...]
    inserted: chex.Array  # int32 []: unrolls ever added


def create(unroll: chex.ArrayTree, slots: int) -> Ring:
    """An empty ring for unrolls like `unroll` (leaves [N, T, ...], arrays or shape structs)."""
    return Ring(jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), unroll), jnp.int32(0))


def add(ring: Ring, unroll: chex.ArrayTree) -> Ring:
    """Write `unroll` (leaves [N, T, ...]) into the next slot."""
    slots = jax.tree.leaves(ring.data)[0].shape[0]
    slot = ring.inserted % slots
    data = jax.tree.map(
        lambda d, x: jax.lax.dynamic_update_index_in_dim(d, x.astype(d.dtype), slot, 0), ring.data, unroll
    )
    return Ring(data, ring.inserted + 1)


def draw(ring: Ring, keys: chex.PRNGKey, minibatches: int, each: int) -> chex.Array:
    """Indices of trajectories (slot, lane); int32 [minibatches, S·each] for `keys` [S].

    The ring's lanes are S shards of neighbours. Each puts `each` trajectories of its own into every minibatch, drawn
    by its own key, uniformly with replacement over the filled slots: so a shard's share is the same whatever other
    shards are in the ring with it. The ring must hold at least one unroll. Drawn for many minibatches at once: a draw
    costs far more to compile, and more to run, than the gather.
    """
    slots, lanes = jax.tree.leaves(ring.data)[0].shape[:2]
    shards = keys.shape[0]
    width = lanes // shards
    filled = jnp.minimum(ring.inserted, slots)
    bits = jax.vmap(lambda key: jax.random.bits(key, (minibatches, each)))(keys)
    drawn = (bits % (filled * width).astype(jnp.uint32)).astype(jnp.int32)  # uneven by less than a part in a million
    first = jnp.arange(shards, dtype=jnp.int32)[:, None, None] * width
    index = drawn // width * lanes + first + drawn % width
    return jnp.swapaxes(index, 0, 1).reshape(minibatches, -1)


def gather(ring: Ring, index: chex.Array) -> chex.ArrayTree:
    """The trajectories at `index` [B]; leaves [B, T, ...]."""
    return jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[index], ring.data)

"""Device-resident ring buffer of unrolls.

A slot holds one unroll of all lanes, leaves [N, T, ...], and of each lane what has no time axis, [N, ...]: its final
observations, and the memory that it began with. A full buffer overwrites its oldest slot. `inserted` must stay
unbatched where members are vmapped: with a cursor for each member a slice update is a scatter.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


class ReplayBuffer(NamedTuple):
    data: chex.ArrayTree  # leaves [slots, N, T, ...]
    inserted: chex.Array  # int32 []: unrolls ever added


def create(unroll: chex.ArrayTree, slots: int) -> ReplayBuffer:
    """An empty buffer for unrolls like `unroll` (arrays or shape structs)."""
    return ReplayBuffer(jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), unroll), jnp.int32(0))


def slot(buffer: ReplayBuffer) -> chex.Array:
    """Where the next unroll belongs; int32 []."""
    return buffer.inserted % _slots(buffer)


def write(
    data: chex.Array, values: chex.Array, slot: chex.Array, lane: chex.Array, step: chex.Array | None = None
) -> chex.Array:
    """A leaf of a buffer's data, in place where nothing else needs it, with the values of n lanes, from `lane` on.

    Of a leaf [slots, N, T, ...]: values [n, ...] at `step`, or [n, T, ...] without a step. Of a leaf without time axis,
    [slots, N, ...]: values [n, ...].
    """
    values = jnp.expand_dims(values, 0 if step is None else (0, 2)).astype(data.dtype)
    at = [slot, lane, *([] if step is None else [step])]
    first = [jnp.asarray(i, jnp.int32) for i in at + [0] * (data.ndim - len(at))]
    return jax.lax.dynamic_update_slice(data, values, first)


def newest(buffer: ReplayBuffer) -> chex.ArrayTree:
    """The unroll that was added last; leaves [N, T, ...]."""
    last = (buffer.inserted - 1) % _slots(buffer)
    return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, last, keepdims=False), buffer.data)


def _slots(buffer: ReplayBuffer) -> int:
    return jax.tree.leaves(buffer.data)[0].shape[0]


def sample(buffer: ReplayBuffer, keys: chex.PRNGKey, minibatches: int, each: int) -> chex.Array:
    """Indices of trajectories (slot, lane); int32 [minibatches, S·each] for `keys` [S].

    The buffer's lanes are S shards of neighbors. Each shard draws `each` trajectories of its own for every minibatch,
    by its own key, uniformly with replacement over the filled slots (uneven by n/2³² of n trajectories): so its share
    does not depend on other shards. The buffer must hold at least one unroll. All minibatches are drawn at once: a draw
    costs far more to compile and to run than the gather.
    """
    slots, lanes = jax.tree.leaves(buffer.data)[0].shape[:2]
    shards = keys.shape[0]
    width = lanes // shards
    filled = jnp.minimum(buffer.inserted, slots)
    bits = jax.vmap(lambda key: jax.random.bits(key, (minibatches, each)))(keys)
    drawn = (bits % (filled * width).astype(jnp.uint32)).astype(jnp.int32)
    first = jnp.arange(shards, dtype=jnp.int32)[:, None, None] * width
    index = drawn // width * lanes + first + drawn % width
    return jnp.swapaxes(index, 0, 1).reshape(minibatches, -1)


def epochs(buffer: ReplayBuffer, keys: chex.PRNGKey, minibatches: int, each: int) -> chex.Array:
    """Indices of trajectories as `sample` gives, but whole passes over each shard's lanes in the newest slot, each in a
    random order without replacement; `minibatches`·`each` must be a multiple of a shard's lanes.
    """
    slots, lanes = jax.tree.leaves(buffer.data)[0].shape[:2]
    width = lanes // keys.shape[0]
    passes = minibatches * each // width

    def one(key: chex.PRNGKey) -> chex.Array:
        orders = jax.vmap(lambda key: jax.random.permutation(key, width))(jax.random.split(key, passes))
        return orders.reshape(minibatches, each)

    first = jnp.arange(keys.shape[0], dtype=jnp.int32)[:, None, None] * width
    index = (buffer.inserted - 1) % slots * lanes + first + jax.vmap(one)(keys)
    return jnp.swapaxes(index, 0, 1).reshape(minibatches, -1)


def gather(buffer: ReplayBuffer, index: chex.Array) -> chex.ArrayTree:
    """The trajectories at `index` [B]; leaves [B, T, ...]."""
    return jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[index], buffer.data)

"""The ring buffer beside flashbax's trajectory buffer, and the uniformity of what it samples."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from qrl.algorithm import replay_buffer
from qrl.algorithm.replay_buffer import ReplayBuffer

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # flashbax's own imports
    import flashbax


Array = np.ndarray

SLOTS, LANES, STEPS, BATCH = 4, 3, 5, 512
ADDS = range(2 * SLOTS + 2)  # from an empty ring to the second time around

indices = jax.jit(replay_buffer.sample, static_argnums=(2, 3))


def plain_add(ring: ReplayBuffer, unroll: Any) -> ReplayBuffer:
    """An unroll's lanes, the last first, each step by itself, and rewards all at once, as a rollout writes them."""
    data, slot = dict(ring.data), replay_buffer.slot(ring)
    for name, x in unroll.items():
        for lane in reversed(range(len(x))):
            values = jnp.asarray(x)[lane : lane + 1]
            if name == "reward":
                data[name] = replay_buffer.write(data[name], values, slot, lane)
                continue
            for t in range(x.shape[1]):
                data[name] = replay_buffer.write(data[name], values[:, t], slot, lane, t)
    return ReplayBuffer(data, ring.inserted + 1)


add = jax.jit(plain_add)


@jax.jit
def sample(ring: ReplayBuffer, key: jax.Array) -> Any:
    """BATCH trajectories, drawn as two minibatches at once."""
    return replay_buffer.gather(ring, replay_buffer.sample(ring, key[None], 2, BATCH // 2).reshape(BATCH))


def tag(unroll: Array | int, lane: Array | int) -> Array:
    """A number of its own for every trajectory ever added; never zero, as an empty slot is."""
    return np.asarray(unroll) * LANES + lane + 1


def unroll_number(i: int) -> dict[str, Array]:
    """Unroll i with leaves [N, T, ...], which name trajectory and step in every entry."""
    trajectory = np.broadcast_to(tag(i, np.arange(LANES))[:, None], (LANES, STEPS))
    step = np.broadcast_to(np.arange(STEPS), (LANES, STEPS))
    return {
        "observation": np.stack([trajectory, step, trajectory * step], axis=-1).astype(np.float32),
        "reward": (trajectory + step / 8).astype(np.float32),
        "done": (trajectory + step) % 2 == 0,
        "trajectory": trajectory.astype(np.int32),
    }


@pytest.fixture(scope="module")
def ring_after() -> list[ReplayBuffer]:
    """The ring before any unroll, after one, after two …"""
    filled = [replay_buffer.create(unroll_number(0), SLOTS)]
    for i in ADDS:
        filled.append(add(filled[-1], unroll_number(i)))
    return filled


@pytest.fixture(scope="module")
def theirs() -> Any:
    """flashbax's buffer of the same size; with a period of one unroll it too draws whole trajectories."""
    return flashbax.make_trajectory_buffer(
        add_batch_size=LANES,
        sample_batch_size=BATCH,
        sample_sequence_length=STEPS,
        period=STEPS,
        min_length_time_axis=STEPS,
        max_length_time_axis=SLOTS * STEPS,
    )


@pytest.fixture(scope="module")
def theirs_after(theirs: Any) -> list[Any]:
    """Its states, as in `ring_after`."""
    filled = [theirs.init(jax.tree.map(lambda x: jnp.zeros_like(x[0, 0]), unroll_number(0)))]
    their_add = jax.jit(theirs.add)
    for i in ADDS:
        filled.append(their_add(filled[-1], unroll_number(i)))
    return filled


def kept(adds: int) -> Array:
    """The tags of the trajectories that a ring holds after so many unrolls: those of the latest SLOTS."""
    unrolls = np.arange(max(0, adds - SLOTS), adds)
    return np.sort(tag(unrolls[:, None], np.arange(LANES)).ravel())


def in_time_order(ring: ReplayBuffer) -> Any:
    """Our leaves [slots, N, T, ...] as flashbax lays them out: [N, slots·T, ...]."""
    return jax.tree.map(
        lambda x: np.moveaxis(np.asarray(x), 0, 1).reshape(LANES, SLOTS * STEPS, *x.shape[3:]), ring.data
    )


@pytest.mark.parametrize("adds", range(1, len(ADDS) + 1))
def test_contents_are_flashbaxs_after_every_add(
    adds: int, ring_after: list[ReplayBuffer], theirs_after: list[Any]
) -> None:
    """Partly filled, full, and wrapped around twice; what is empty is zero."""
    ours, expected = ring_after[adds], theirs_after[adds]
    for leaf, their_leaf in zip(
        jax.tree.leaves(in_time_order(ours)), jax.tree.leaves(expected.experience), strict=True
    ):
        assert leaf.dtype == their_leaf.dtype
        np.testing.assert_array_equal(leaf, their_leaf)
    assert int(ours.inserted) == adds
    assert int(ours.inserted) % SLOTS * STEPS == int(expected.current_index)
    assert (int(ours.inserted) >= SLOTS) == bool(expected.is_full)


def test_sampled_trajectories_are_those_flashbax_samples(
    ring_after: list[ReplayBuffer], theirs: Any, theirs_after: list[Any]
) -> None:
    """The same set of whole trajectories, at every fill."""
    their_sample = jax.jit(theirs.sample)
    for i in ADDS:
        drawn = sample(ring_after[i + 1], jax.random.key(i))
        expected = their_sample(theirs_after[i + 1], jax.random.key(i)).experience
        for name, leaf in drawn.items():
            np.testing.assert_array_equal(np.unique(leaf, axis=0), np.unique(expected[name], axis=0))


@pytest.mark.parametrize("adds", range(1, len(ADDS) + 1))
def test_samples_are_whole_trajectories_of_filled_slots(adds: int, ring_after: list[ReplayBuffer]) -> None:
    """Every leaf of a row is one trajectory from its first step to its last, and all that are kept turn up."""
    drawn = sample(ring_after[adds], jax.random.key(adds))
    trajectory, step = np.asarray(drawn["trajectory"][:, :1]), np.arange(STEPS)
    np.testing.assert_array_equal(drawn["trajectory"], np.repeat(trajectory, STEPS, axis=1))
    whole = np.stack([trajectory + 0 * step, step + 0 * trajectory, trajectory * step], axis=-1)
    np.testing.assert_array_equal(drawn["observation"], whole)
    np.testing.assert_array_equal(drawn["reward"], trajectory + step / 8)
    np.testing.assert_array_equal(drawn["done"], (trajectory + step) % 2 == 0)
    np.testing.assert_array_equal(np.unique(trajectory), kept(adds))


@pytest.mark.parametrize("adds", [1, SLOTS - 1, SLOTS, SLOTS + 1, 2 * SLOTS + 2])
def test_samples_are_uniform_and_independent(adds: int, ring_after: list[ReplayBuffer]) -> None:
    """Chi-square over trajectories, and over pairs of neighbors in the minibatch (drawn with replacement)."""
    count = 0
    pairs = np.zeros((len(kept(adds)), len(kept(adds))))
    for seed in range(16):
        drawn = sample(ring_after[adds], jax.random.key(100 + seed))["trajectory"][:, 0]
        index = np.searchsorted(kept(adds), drawn)
        count = count + np.bincount(index, minlength=len(kept(adds)))
        np.add.at(pairs, (index[0::2], index[1::2]), 1)
    assert stats.chisquare(count).pvalue > 0.001
    assert stats.chisquare(pairs.ravel()).pvalue > 0.001


@pytest.mark.parametrize("adds", [2, SLOTS + 1])
def test_shards_draw_their_part_of_each_minibatch_from_their_own_lanes(adds: int) -> None:
    """As a ring of those lanes alone would with the same key: so it does not matter which shards share a device."""
    shards, width, each, minibatches = 3, 2, 64, 4

    def ring_of(lanes: Array) -> ReplayBuffer:
        ring = replay_buffer.create({"x": np.zeros((len(lanes), 1), np.int32)}, SLOTS)
        for i in range(adds):
            ring = add(ring, {"x": (100 * i + lanes)[:, None].astype(np.int32)})
        return ring

    def drawn(lanes: Array, keys: jax.Array) -> Array:
        ring = ring_of(lanes)
        index = indices(ring, keys, minibatches, each)
        assert index.shape == (minibatches, len(keys) * each)
        return np.asarray(replay_buffer.gather(ring, index)["x"])[..., 0]

    keys = jax.random.split(jax.random.key(0), shards)
    whole = drawn(np.arange(shards * width), keys).reshape(minibatches, shards, each)
    for shard in range(shards):
        lanes = np.arange(shard * width, (shard + 1) * width)
        np.testing.assert_array_equal(whole[:, shard], drawn(lanes, keys[shard, None]))
        held = [100 * i + lane for i in range(max(0, adds - SLOTS), adds) for lane in lanes]
        np.testing.assert_array_equal(np.unique(whole[:, shard]), held)
    assert (whole[:, 0] % width != whole[:, 1] % width).any()  # they do not draw alike


@pytest.fixture(scope="module")
def orders() -> Array:
    """Indices of four passes over the newest slot, which has two shards of four lanes, from 300 pairs of keys:
    [300, pass, shard, lane]."""
    shards, width, each, passes = 2, 4, 2, 4
    ring = replay_buffer.create({"x": np.zeros((shards * width, 1), np.float32)}, SLOTS)._replace(
        inserted=jnp.int32(SLOTS + 3)
    )
    minibatches = passes * width // each
    keys = jax.random.split(jax.random.PRNGKey(0), (300, shards))
    draw = jax.jit(jax.vmap(lambda keys: replay_buffer.epochs(ring, keys, minibatches, each)))
    drawn = np.asarray(draw(keys))
    assert drawn.shape == (300, minibatches, shards * each)
    of_shards = drawn.reshape(300, passes, width // each, shards, each).swapaxes(2, 3)
    first = 2 * shards * width + width * np.arange(shards)  # the third slot is the newest
    return of_shards.reshape(300, passes, shards, width) - first[:, None]


def test_each_pass_has_every_trajectory_of_the_newest_slot_once(orders: Array) -> None:
    """Each shard's of its own lanes; all minibatches of a pass together."""
    np.testing.assert_array_equal(np.sort(orders, axis=-1), np.broadcast_to(np.arange(4), orders.shape))


@pytest.mark.parametrize("other", ["pass", "shard", "update"])
def test_each_pass_has_an_order_of_its_own(orders: Array, other: str) -> None:
    """All 24 orders are as likely, and one says nothing of the next pass's, of the other shard's, of the next keys'.

    Of that the chi-square test of the lanes that come first in both.
    """
    names = orders @ 4 ** np.arange(4)
    assert stats.chisquare(np.unique(names, return_counts=True)[1]).pvalue > 0.001
    assert len(np.unique(names)) == 24
    pairs = {
        "pass": (orders[:, :-1], orders[:, 1:]),
        "shard": (orders[:, :, 0], orders[:, :, 1]),
        "update": (orders[:-1], orders[1:]),
    }
    one, two = (x[..., 0].ravel() for x in pairs[other])
    assert stats.chisquare(np.bincount(4 * one + two, minlength=16)).pvalue > 0.001


def test_the_key_decides_the_sample(ring_after: list[ReplayBuffer]) -> None:
    """The same key draws the same, another another."""
    first, again, other = (sample(ring_after[-1], jax.random.key(seed))["trajectory"] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_what_is_added_takes_the_rings_types() -> None:
    """A ring of shapes alone, as the train loop makes it; doubles and integers become what it holds."""
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), unroll_number(0))
    ring = replay_buffer.create(shapes, 2)
    assert int(ring.inserted) == 0
    assert all(not leaf.any() for leaf in jax.tree.leaves(ring.data))
    wider = unroll_number(0) | {"reward": unroll_number(0)["reward"].astype(np.int32)}
    after = add(ring, wider)
    assert jax.tree.map(lambda x: x.dtype, after.data) == jax.tree.map(lambda x: x.dtype, ring.data)
    np.testing.assert_array_equal(after.data["reward"][0], wider["reward"])


def test_members_side_by_side_share_the_cursor() -> None:
    """vmapped over members with `inserted` unbatched, as the module asks, each member has its own contents."""
    one = replay_buffer.create(unroll_number(0), 2)
    members = ReplayBuffer(jax.tree.map(lambda x: jnp.stack([x, x]), one.data), one.inserted)
    axes = ReplayBuffer(0, None)
    side_by_side = jax.jit(jax.vmap(plain_add, in_axes=(axes, 0), out_axes=axes))
    for i in range(3):
        both = jax.tree.map(lambda *x: np.stack(x), unroll_number(10 * i), unroll_number(10 * i + 1))
        members = side_by_side(members, both)
    assert members.inserted.shape == ()
    for member in (0, 1):
        alone = one
        for i in range(3):
            alone = add(alone, unroll_number(10 * i + member))
        for leaf, expected in zip(jax.tree.leaves(members.data), jax.tree.leaves(alone.data), strict=True):
            np.testing.assert_array_equal(leaf[member], expected)

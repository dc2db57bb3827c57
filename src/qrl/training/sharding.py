"""How members and their shards are mapped over devices: the mesh, the layout of states on it, and maps over members.

Members are split across devices first, since they exchange nothing; then each member's shards: its lanes, with their
part of replay buffer and minibatch. Without a mesh all is on one device.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from qrl.algorithm.replay_buffer import ReplayBuffer
from qrl.training.state import TrainState

MEMBER, SHARD = "member", "shard"  # the mesh's axes

# Axis 0 is the member's; what has lanes is sharded by them, all else is replicated over a member's devices.
LAYOUT: Any = TrainState(*[P(MEMBER)] * len(TrainState._fields))._replace(  # pyright: ignore[reportArgumentType]
    buffer=ReplayBuffer(P(MEMBER, None, SHARD), P(MEMBER)),  # pyright: ignore[reportArgumentType]
    lanes=P(MEMBER, SHARD),  # pyright: ignore[reportArgumentType]
)


def make_mesh(devices: Sequence[Any], members: int, shards: int) -> Mesh | None:
    """The mesh [member, shard] over as many of `devices` as can share the work evenly; None: one is enough."""
    for count in range(len(devices), 1, -1):
        rows = math.gcd(members, count)
        if shards % (count // rows) == 0:
            return Mesh(np.reshape(np.array(devices[:count]), (rows, -1)), (MEMBER, SHARD))
    return None


def device_put(mesh: Mesh | None, states: TrainState) -> TrainState:
    """States in NumPy, placed as the programs expect them."""
    if not mesh:
        return jax.tree.map(jnp.array, states)

    def put(x: Any, sharding: NamedSharding) -> Any:
        return jax.make_array_from_callback(x.shape, sharding, np.asarray(x).__getitem__)

    return _map_layout(mesh, put, states)


def abstract_sharded(mesh: Mesh | None, states: TrainState) -> TrainState:
    """Shapes and types of states, with the sharding that `device_put` gives them."""
    if not mesh:
        return states
    return _map_layout(mesh, lambda x, to: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=to), states)


def _map_layout(mesh: Mesh, put: Callable[[Any, NamedSharding], Any], states: TrainState) -> TrainState:
    def part(spec: P, tree: Any) -> Any:
        return jax.tree.map(lambda x: put(x, NamedSharding(mesh, spec)), tree)

    return jax.tree.map(part, LAYOUT, states, is_leaf=lambda x: isinstance(x, P))


def replicated(mesh: Mesh | None) -> NamedSharding | None:
    return NamedSharding(mesh, P()) if mesh else None


def shard_map(mesh: Mesh | None, program: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
    """`program` on every device of the mesh; unchanged without one."""
    if not mesh:
        return program
    # Unchecked: gradients are averaged explicitly, in one exchange.
    return jax.shard_map(program, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def num_shard_devices(mesh: Mesh | None) -> int:
    """Devices that share one member's lanes."""
    return mesh.shape[SHARD] if mesh else 1


def local_indices(mesh: Mesh | None, count: int) -> chex.Array:
    """This device's part of the numbers 0 … count − 1; inside `shard_map`."""
    mine = count // num_shard_devices(mesh)
    first = jax.lax.axis_index(SHARD) * mine if mesh else 0
    return first + jnp.arange(mine, dtype=jnp.int32)


def sum_over_shards(mesh: Mesh | None, values: Any) -> Any:
    return jax.lax.psum(values, SHARD) if mesh else values


def map_members(one: Callable[[Any], Any], members: Any) -> Any:
    """`one` of each member; on a CPU one after the other (`lax.map`), which is faster there than `vmap`."""
    count = len(jax.tree.leaves(members)[0])
    if count == 1:  # a loop that is passed once still takes its time to compile
        alone = one(jax.tree.map(lambda x: jax.lax.squeeze(x, (0,)), members))
        return jax.tree.map(lambda x: jax.lax.expand_dims(x, (0,)), alone)
    return jax.lax.map(one, members) if sequential_members(count) else jax.vmap(one)(members)


def map_states(
    one: Callable[[TrainState, Any, chex.Array], TrainState],
    states: TrainState,
    inputs: Any,
    until: chex.Array,
    active: chex.Array,
) -> TrainState:
    """`one(state, inputs, until)` of the state of each member that is `active` [M]; the others stay."""
    if sequential_members(len(states.unrolls)):
        untils = jnp.where(active, until, states.unrolls)
        return map_members(lambda m: one(*m), (states, inputs, untils))
    # The active members are equally far, and their counters have no member axis: batched, they would turn every insert
    # into the replay buffer into a scatter, and the loop into a selection over the whole state.
    axes: Any = TrainState(*[0] * len(TrainState._fields))._replace(buffer=ReplayBuffer(0, None), unrolls=None)  # pyright: ignore[reportArgumentType]
    unrolls = jnp.where(jnp.any(active), jnp.max(states.unrolls, initial=0, where=active), until)
    inserted = jnp.max(states.buffer.inserted, initial=0, where=active)
    members = states._replace(unrolls=unrolls, buffer=states.buffer._replace(inserted=inserted))
    after = jax.vmap(one, in_axes=(axes, 0, None), out_axes=axes)(members, inputs, until)
    buffer = after.buffer._replace(inserted=states.buffer.inserted + (after.buffer.inserted - inserted))
    after = after._replace(unrolls=jnp.broadcast_to(after.unrolls, active.shape), buffer=buffer)
    return jax.tree.map(lambda x, y: jnp.where(active.reshape(-1, *[1] * (x.ndim - 1)), x, y), after, states)


def sequential_members(count: int) -> bool:
    """Whether members run one after the other; a single one does everywhere, so that its branches stay branches."""
    return count == 1 or jax.default_backend() == "cpu"

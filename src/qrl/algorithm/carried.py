"""What a loop over the steps of an environment carries."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval

from qrl.algorithm.types import State

Step = Callable[[Any, chex.Array], Any]  # states, actions [A, n] -> states
Wanted = Callable[[Any], Any]  # a state -> what is wanted of it, a pytree of its leaves


class Carry(NamedTuple):
    """What is carried of the states of n lanes.

    Numbers are one array: an operation on each leaf takes a CPU longer than what it does.
    """

    observation: chex.Array  # [n, F], as networks read it
    moving: chex.Array  # [S, n] other numbers that a step changes
    drawn: chex.Array  # [C, n] those that a restart alone changes
    others: list[chex.Array]  # [..., n] not of the observation's type, such as counters

    def each(self, value: chex.Array) -> "Carry":
        """A value [n] for each lane, so that it broadcasts against every part."""
        return jax.tree.map(lambda _: value, self)._replace(observation=value[:, None])


class Carried:
    """The leaves of a batch of states that a step changes and that a later step, or what is wanted of it, depends on;
    and those that a restart changes.

    What is constant stays out of the loop, and so does its gradient; what no later step depends on is not kept. Lanes
    lie along the last axis of every leaf.
    """

    def __init__(
        self,
        step: Step,
        states: State,
        action: Any,
        results: Wanted,
        wanted: Wanted = lambda state: (),
        restart: Callable[[Any], Any] | None = None,
    ) -> None:
        """Of step(states, actions) -> states, and of restart(state) -> state of one lane, if lanes restart.

        `results` are wanted of the states that a step gives, `wanted` of those that are unpacked, too; the observation
        always is. `states` and `action` may be shapes. Raises ValueError for states of another structure, or with
        leaves of another type or shape.
        """
        leaves, self._structure = jax.tree.flatten(states)
        self._shapes = [x.shape[:-1] for x in leaves]
        places: Any = jax.tree.unflatten(self._structure, list(range(len(leaves))))
        self._observed: int = places.obs
        programs = [self._traced("step", step, states, action)]
        if restart is not None:
            one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[:-1], x.dtype), states)
            programs.append(self._traced("restart", restart, one))
        asked = {self._observed, *jax.tree.leaves(wanted(places))}
        needed = _needed(programs, [{*jax.tree.leaves(results(places))}, set()], asked, len(leaves))
        handed_on, kept = (
            [old is new for old, new in zip(program.invars, program.outvars, strict=False)]
            for program in (programs[0], programs[-1])
        )
        drawn = [i for i in sorted(needed) if handed_on[i] and not kept[i]]
        dtype = leaves[self._observed].dtype
        changes = [i for i in sorted(needed) if not handed_on[i] and i != self._observed]
        self._moving = [i for i in changes if leaves[i].dtype == dtype]
        self._drawn = [i for i in drawn if leaves[i].dtype == dtype]
        self._others = [i for i in sorted(changes + drawn) if leaves[i].dtype != dtype]

    def _traced(self, name: str, call: Callable[..., Any], *inputs: Any) -> Any:
        closed, after = jax.make_jaxpr(call, return_shape=True)(*inputs)
        before = inputs[0]
        if (found := jax.tree.structure(after)) != self._structure:
            raise ValueError(f"{name} gives a state of another structure: expected {self._structure}, found {found}")
        for (path, old), new in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True):
            # A constant needs no lanes.
            if new.dtype != old.dtype or new.shape not in (old.shape, ()):
                leaf = jax.tree_util.keystr(path)
                expected, given = (f"{x.dtype} {list(x.shape)}" for x in (old, new))
                raise ValueError(f"{name} gives another type or shape of {leaf}: expected {expected}, found {given}")
        return closed.jaxpr

    def pack(self, states: State) -> Carry:
        """What is carried of states."""
        return self._carry(states, self._rows(states, self._drawn))

    def follow(self, before: Carry, states: State) -> Carry:
        """What is carried a step later, of the states after it."""
        return self._carry(states, before.drawn)

    def _carry(self, states: State, drawn: chex.Array) -> Carry:
        leaves, lanes = jax.tree.leaves(states), states.obs.shape[-1:]
        others = [jnp.broadcast_to(leaves[i], self._shapes[i] + lanes) for i in self._others]
        return Carry(states.obs.T, self._rows(states, self._moving), drawn, others)

    def _rows(self, states: State, at: list[int]) -> chex.Array:
        leaves, lanes = jax.tree.leaves(states), states.obs.shape[-1]
        # What a step gives as a constant has no lanes.
        each = [jnp.broadcast_to(leaves[i], (*self._shapes[i], lanes)) for i in at]
        none = jnp.zeros((0, lanes), states.obs.dtype)
        return jnp.concatenate([none, *(x.reshape(math.prod(x.shape[:-1]), lanes) for x in each)])

    def unpack(self, carry: Carry, constant: State) -> Any:
        """The states again; a leaf that is not carried is that of the states `constant`."""
        leaves = jax.tree.leaves(constant)
        leaves[self._observed] = carry.observation.T
        for numbers, at in ((carry.moving, self._moving), (carry.drawn, self._drawn)):
            # Split, not sliced: the gradient is one concatenation, that of slices a sum of as many padded arrays.
            rows = jax.lax.split(numbers, [math.prod(self._shapes[i]) for i in at])
            for i, row in zip(at, rows, strict=True):
                leaves[i] = row.reshape(*self._shapes[i], row.shape[-1])
        for i, value in zip(self._others, carry.others, strict=True):
            leaves[i] = value
        return jax.tree.unflatten(self._structure, leaves)


def _needed(programs: list[Any], results: list[set[int]], wanted: set[int], leaves: int) -> set[int]:
    """The leaves that those `wanted` of any later state and the `results` of a program depend on; and `wanted`."""
    while True:
        more = set()
        for program, also in zip(programs, results, strict=False):
            _, used = partial_eval.dce_jaxpr(program, [i in wanted | also for i in range(leaves)])
            more |= {i for i in range(leaves) if used[i]}
        if more <= wanted:
            return wanted
        wanted = wanted | more


def lanes_last(tree: Any) -> Any:
    """Leaves [n, ...] as [..., n]."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), tree)


def lanes_first(tree: Any) -> Any:
    """Leaves [..., n] as [n, ...]."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), tree)

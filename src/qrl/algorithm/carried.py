"""What a loop over the steps of an environment carries."""

from collections.abc import Callable, Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval

Wanted = Callable[[Any], Any]  # a state -> what is wanted of it, a pytree of its leaves
Carry = tuple[chex.Array, list[chex.Array]]


class Carried:
    """The leaves of a batch of states that a step changes and that a later step, or what is wanted of it, depends on.

    What is constant during a flight stays out of the loop, and so does its gradient; what no later step depends on is
    not kept. The numbers are carried as one array [S, n], for n lanes along the last axis of every leaf: an operation
    on each leaf takes a CPU longer than what it does.
    """

    def __init__(self, step: Callable[[Any, chex.Array], Any], states: Any, action: chex.Array, wanted: Wanted) -> None:
        """Of step(states, actions) -> states; `states` are those of the first step.

        Raises ValueError for a step whose states have another structure.
        """
        self._leaves, self._structure = jax.tree.flatten(states)
        self._dtype = jax.tree.leaves(wanted(states))[0].dtype
        places = jax.tree.unflatten(self._structure, list(range(len(self._leaves))))
        closed, after = jax.make_jaxpr(step, return_shape=True)(states, action)
        if (found := jax.tree.structure(after)) != self._structure:
            raise ValueError(f"expected a step to give states like {self._structure}, found {found}")
        program = closed.jaxpr
        inputs = program.invars[: len(self._leaves)]
        needed = _needed(program, set(jax.tree.leaves(wanted(places))), len(inputs))
        self._at = [i for i in sorted(needed) if program.outvars[i] is not inputs[i]]

    def pack(self, states: Any) -> Carry:
        """What is carried of states."""
        leaves = jax.tree.leaves(states)
        # What a step gives as a constant has no lanes.
        carried = [jnp.broadcast_to(leaves[i], self._leaves[i].shape) for i in self._at]
        numbers = [x.reshape(-1, x.shape[-1]) for x in carried if x.dtype == self._dtype]
        return jnp.concatenate(numbers), [x for x in carried if x.dtype != self._dtype]

    def unpack(self, carry: Carry) -> Any:
        """The states again; of a leaf that is not carried, that of the first step."""
        numbers, others, row, leaves = carry[0], iter(carry[1]), 0, list(self._leaves)
        for i in self._at:
            if leaves[i].dtype != self._dtype:
                leaves[i] = next(others)
                continue
            shape = leaves[i].shape
            rows = leaves[i].size // shape[-1]
            leaves[i], row = numbers[row : row + rows].reshape(shape), row + rows
        return jax.tree.unflatten(self._structure, leaves)


def _needed(program: Any, wanted: set[int], leaves: int) -> set[int]:
    """The leaves that those `wanted` of any later step depend on, and these themselves."""
    while True:
        asked: Sequence[bool] = [i in wanted for i in range(leaves)]
        _, used = partial_eval.dce_jaxpr(program, list(asked))
        if not (more := {i for i in range(leaves) if used[i]} - wanted):
            return wanted
        wanted = wanted | more

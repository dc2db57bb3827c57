"""What a loop over steps carries of the states of an environment."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm.carried import Carried
from qrl_envs import env as worlds

LANES, STEPS = 3, 4


def step(state: dict[str, Any], action: jax.Array) -> dict[str, Any]:
    """`x` is wanted, and `late`, `count` and `gain` are what it depends on; `seen` is what nobody asks for."""
    count, seen = state["count"] + 1, state["x"] * 2.0
    x = state["x"] + state["gain"] * state["late"] * count + action
    return {"x": x, "late": state["soon"], "soon": action, "count": count, "gain": state["gain"], "seen": seen}


def states() -> dict[str, Any]:
    rows = jnp.arange(2.0 * LANES).reshape(2, LANES)
    same = {"x": rows, "late": rows + 1.0, "soon": rows + 2.0, "gain": rows + 3.0, "seen": rows}
    return same | {"count": jnp.zeros(LANES, jnp.int32)}


def test_a_loop_carries_what_a_later_step_needs_and_no_more() -> None:
    """The leaves that change and reach x, in one step or two; numbers in one array, the counter beside it."""
    first, action = states(), jnp.ones((2, LANES))
    carried = Carried(step, first, action, lambda state: state["x"])
    numbers, others = carried.pack(first)
    np.testing.assert_array_equal(numbers, jnp.concatenate([first["late"], first["soon"], first["x"]]))
    assert len(others) == 1
    np.testing.assert_array_equal(others[0], first["count"])
    packed, whole = carried.pack(first), first
    for i in range(STEPS):
        packed = carried.pack(step(carried.unpack(packed), i * action))
        whole = step(whole, i * action)
    for name in ("x", "late", "soon", "count", "gain"):
        np.testing.assert_array_equal(carried.unpack(packed)[name], whole[name])
    assert carried.unpack(packed)["seen"] is first["seen"]


def test_a_step_that_gives_other_states_is_refused() -> None:
    def renames(state: dict[str, Any], action: jax.Array) -> dict[str, Any]:
        return {"z" if name == "x" else name: value for name, value in step(state, action).items()}

    with pytest.raises(ValueError, match="expected a step to give states like"):
        Carried(renames, states(), jnp.ones((2, LANES)), lambda state: next(iter(state.values())))


@pytest.mark.parametrize("task", ["any", "hover", "pendulum"])
def test_flights_of_what_is_carried_are_those_of_whole_states(task: str) -> None:
    """Of a task that ships: reward, end and observation at each step, whatever else its state has."""
    env = worlds.make(task)
    first = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.PRNGKey(0), LANES))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, env.action_size, LANES), minval=-1.0)

    def wanted(state: Any) -> Any:
        return state.obs, state.reward, state.done

    carried = Carried(env.step_lanes, first, actions[0], wanted)
    packed, whole = carried.pack(first), first
    for action in actions:
        after, whole = env.step_lanes(carried.unpack(packed), action), env.step_lanes(whole, action)
        for ours, expected in zip(wanted(after), wanted(whole), strict=True):
            np.testing.assert_array_equal(ours, expected)
        packed = carried.pack(after)
    size = sum(x.size for x in jax.tree.leaves(packed))
    assert size < sum(x.size for x in jax.tree.leaves(whole))

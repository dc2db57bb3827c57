"""What a loop over steps carries of the states of an environment."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm.carried import Carried
from qrl_envs import env as worlds

LANES, STEPS = 3, 4


class State(NamedTuple):
    """`obs` depends on `late`, `count` and `gain`, the reward on `debt`, a restart on `wish`; nobody asks `seen`."""

    obs: jax.Array
    late: jax.Array
    soon: jax.Array
    count: jax.Array
    gain: jax.Array
    debt: jax.Array
    wish: jax.Array
    reward: jax.Array
    seen: jax.Array


def step(state: State, action: jax.Array) -> State:
    count = state.count + 1
    obs = state.obs + state.gain * state.late * count + action
    reward = jnp.sum(state.obs, axis=0) - state.debt
    return State(obs, state.soon, action, count, state.gain, state.debt + count, obs[0], reward, state.obs * 2.0)


def restart(state: State) -> State:
    """Draws the gain, as was wished."""
    return state._replace(gain=state.wish * jnp.ones(2), obs=jnp.zeros(2))


def states() -> State:
    rows, one = jnp.arange(2.0 * LANES).reshape(2, LANES), jnp.arange(1.0 * LANES)
    return State(rows, rows + 1.0, rows + 2.0, jnp.zeros(LANES, jnp.int32), rows + 3.0, one, one, one, rows)


def results(state: State) -> Any:
    return state.reward


@pytest.mark.parametrize(("restarts", "wanted"), [(False, False), (True, False), (True, True)])
def test_a_loop_carries_what_a_later_step_needs_and_no_more(restarts: bool, wanted: bool) -> None:
    """The leaves that change and reach observation or reward, in one step or two: numbers in one array, what a restart
    alone changes in another, the counter beside them. The reward itself only where it is wanted of unpacked states.
    """
    first, action = states(), jnp.ones((2, LANES))
    asked = results if wanted else lambda state: ()
    carried = Carried(step, first, action, results, asked, restart if restarts else None)
    carry = carried.pack(first)
    np.testing.assert_array_equal(carry.observation, first.obs.T)
    moving = [first.late, first.soon, first.debt[None]]
    moving += [first.wish[None]] * restarts + [first.reward[None]] * wanted
    np.testing.assert_array_equal(carry.moving, jnp.concatenate(moving))
    np.testing.assert_array_equal(carry.drawn, first.gain if restarts else np.zeros((0, LANES)))
    np.testing.assert_array_equal(carry.others, [first.count])
    whole = first
    for i in range(STEPS):
        after, whole = step(carried.unpack(carry, first), i * action), step(whole, i * action)
        np.testing.assert_array_equal(after.reward, whole.reward)
        carry = carried.follow(carry, after)
    found = carried.unpack(carry, first)
    for name in ("obs", "late", "soon", "count", "gain", "debt", *["wish"] * restarts, *["reward"] * wanted):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    assert found.seen is first.seen


@pytest.mark.parametrize("name", ["step", "restart"])
def test_states_of_another_structure_are_refused(name: str) -> None:
    def other(state: Any, *_: Any) -> Any:
        return tuple(state)

    calls: Any = {"step": step, "restart": restart} | {name: other}
    with pytest.raises(ValueError, match=f"{name} gives a state of another structure"):
        Carried(calls["step"], states(), jnp.ones((2, LANES)), results, restart=calls["restart"])


def test_a_value_for_each_lane_meets_every_part() -> None:
    """Lanes along the first axis of the observation, along the last of all else."""
    carry = Carried(step, states(), jnp.ones((2, LANES)), results, restart=restart).pack(states())
    factor = jnp.arange(LANES)
    times = jax.tree.map(jnp.multiply, carry.each(factor), carry)
    np.testing.assert_array_equal(times.observation, (states().obs * factor).T)
    np.testing.assert_array_equal(times.drawn, states().gain * factor)


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
        after, whole = env.step_lanes(carried.unpack(packed, first), action), env.step_lanes(whole, action)
        for ours, expected in zip(wanted(after), wanted(whole), strict=True):
            np.testing.assert_array_equal(ours, expected)
        packed = carried.follow(packed, after)
    size = sum(x.size for x in jax.tree.leaves(packed))
    assert size < sum(x.size for x in jax.tree.leaves(whole))

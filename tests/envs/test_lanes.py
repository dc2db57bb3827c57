"""`step_lanes`: many lanes along the last axis of every leaf."""

import json
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm.carried import Carried
from qrl_envs import task
from qrl_envs.env import from_task
from qrl_envs.quadrotor_env import RealQuadrotorEnv

CASES = [
    ("hover", None),
    ("circle", None),
    ("pendulum", None),
    ("hover", "hexa"),
    ("circle", "crazyflie"),
    ("track", None),
]


@pytest.mark.parametrize(("name", "vehicle"), [*CASES, ("hover", "tilted"), ("hover", "shaken")])
def test_lanes_along_the_last_axis_step_as_each_by_itself(name: str, vehicle: str | None, tmp_path: Path) -> None:
    """Values and gradients; "tilted": a full inertia, and motors along axes of their own; "shaken": gusts and fixes."""
    uncertainty = None
    if vehicle == "shaken":
        vehicle, uncertainty = "crazyflie", str(tmp_path / "shaken.json")
        ranges = {"gust_m_s": [0.5, 1.0], "position_period_s": [0.0, 0.03], "bias_wander_m": [0.0, 0.01]}
        Path(uncertainty).write_text(json.dumps(ranges))
    if vehicle == "tilted":
        data = task.load("hover", "crazyflie").model_dump(mode="json")["vehicle"]
        data["inertia_kg_m2"] = [*data["inertia_kg_m2"], 1e-7, 0.0, -1e-7]
        for motor in data["motors"]:
            x, y = motor["position_m"][:2]
            motor["axis"] = [1.5 * x, 1.5 * y, 1.0]
        vehicle = str(tmp_path / "tilted.json")
        Path(vehicle).write_text(json.dumps(data))
    world = from_task(task.load(name, vehicle, uncertainty))
    states = jax.jit(jax.vmap(world.reset))(jax.random.split(jax.random.PRNGKey(0), 5))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (5, world.action_size), minval=-1.2, maxval=1.2)

    def last(tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), tree)

    def each(actions: jax.Array) -> tuple[jax.Array, Any]:
        after = jax.vmap(world.step)(states, actions)
        return jnp.sum(after.reward) + jnp.sum(jnp.sin(after.obs)), last(after)

    def lanes(actions: jax.Array) -> tuple[jax.Array, Any]:
        after = world.step_lanes(last(states), actions.T)
        return jnp.sum(after.reward) + jnp.sum(jnp.sin(after.obs)), after

    (wanted, after_each), (found, after_lanes) = (jax.jit(jax.grad(f, has_aux=True))(actions) for f in (each, lanes))
    assert jnp.abs(wanted).max() > 1e-4
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5 * float(jnp.abs(wanted).max()))
    for x, y in zip(jax.tree.leaves(after_lanes), jax.tree.leaves(after_each), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("name", "vehicle"), [("pendulum", None), ("hover", None), ("hover", "crazyflie")])
@pytest.mark.parametrize("of", ["class", "instance"])
def test_lanes_step_as_a_subclass_says(name: str, vehicle: str | None, of: str) -> None:
    """Its step is for one lane: it sums over actions, and gives a leaf without lanes. A lane's reward is its own."""
    world = from_task(task.load(name, vehicle))
    own = type(world).step

    def step(self: Any, state: Any, action: jax.Array) -> Any:
        after = own(self, state, action / 2)
        return after.replace(reward=after.reward - jnp.sum(action**2), done=jnp.float32(0.0))

    if of == "class":
        world = type("Costly", (type(world),), {"step": step})(world.task)
    else:
        world.step = types.MethodType(step, world)
    states = jax.vmap(world.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (3, world.action_size), minval=-1.0)
    found = world.step_lanes(jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), states), actions.T)
    for i in range(3):
        alone = world.step(jax.tree.map(lambda x, i=i: x[i], states), actions[i])
        np.testing.assert_allclose(found.reward[i], alone.reward, rtol=1e-5)
        np.testing.assert_allclose(found.obs[:, i], alone.obs, rtol=1e-5, atol=1e-5)


def test_parameters_and_a_flights_world_are_constant() -> None:
    """So they stay out of APG's loop, and what moves does not."""
    world = from_task(task.load("hover", "crazyflie"))
    assert isinstance(world, RealQuadrotorEnv)
    states = jax.jit(jax.vmap(world.reset, out_axes=-1))(jax.random.split(jax.random.PRNGKey(0), 3))
    carried = Carried(world.step_lanes, states, jnp.zeros((4, 3)), lambda state: (state.obs, state.reward, state.done))
    moved = jax.tree.map(lambda x: x + 1, states)
    lane, first, later = (x.pipeline_state for x in (carried.unpack(carried.pack(moved), states), states, moved))
    for ours, expected in ((lane.params, first.params), (lane.x.world, first.x.world)):
        assert all(x is y for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True))
    for name in ("body", "speed", "integral_m_s"):
        jax.tree.map(np.testing.assert_array_equal, getattr(lane.x, name), getattr(later.x, name))

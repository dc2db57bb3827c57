"""Symmetries of the tasks: the turned world goes the turned way, for the same reward."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qrl.algorithm import augmentation
from qrl.algorithm.adapter import adapt
from qrl.algorithm.types import Transition
from qrl_envs import env as worlds
from qrl_envs import quadrotor
from qrl_envs import task as tasks
from qrl_envs.env import TaskEnv

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")
DRAWS = 64
PLUS = {
    "motors": [
        {"position_m": position_m, "spin": spin, "max_N": 8.0}
        for position_m, spin in (([0.1, 0.0], 1), ([0.0, 0.1], -1), ([-0.1, 0.0], 1), ([0.0, -0.1], -1))
    ]
}


def changed(name: str, vehicle: dict[str, Any]) -> TaskEnv:
    spec = tasks.load(name).model_dump(mode="json", exclude_none=True)
    spec["vehicle"] |= vehicle
    return worlds.from_task(tasks.from_data(spec, name))


def body_at(observation: np.ndarray) -> quadrotor.Body:
    """The body that is so observed; scipy's quaternion."""
    attitude = Rotation.from_matrix(observation[:9].reshape(3, 3)).as_quat(scalar_first=True)
    parts = (
        jnp.asarray(part, jnp.float32) for part in (observation[9:12], attitude, observation[12:15], observation[15:])
    )
    position, attitude, velocity, rate = parts
    return quadrotor.Body(quadrotor.Pose(position, attitude), quadrotor.Twist(velocity, rate))


def flown(env: TaskEnv, observation: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float]:
    """Observation and reward one step after `observation`."""
    body = body_at(observation)
    body, reward = env._advance(env.params, body, jnp.asarray(action, jnp.float32))
    return np.asarray(env._observe(body)), float(reward)


def different(found: list[np.ndarray]) -> int:
    return len({tuple(np.round(matrix, 3).ravel() + 0.0) for matrix in found})


@pytest.mark.parametrize(
    ("name", "vehicle", "turns"),
    [
        ("hover", {}, 4),
        ("circle", {}, 2),
        ("hover", PLUS, 2),
        ("hover", PLUS | {"inertia_kg_m2": [0.0023, 0.0023, 0.0037]}, 4),
    ],
)
def test_the_turned_vehicle_flies_the_turned_way(name: str, vehicle: dict[str, Any], turns: int) -> None:
    """step(G·s, P·a) = G·step(s, a) and the same reward; as many ways to turn the motors as the vehicle has.

    A quarter turn would swap motors that spin oppositely; a plus is mirrored about its diagonals.
    """
    env, rng = changed(name, vehicle), np.random.default_rng(0)
    found = []
    for u in rng.random((DRAWS, 2)):
        turn = jax.tree.map(np.asarray, env.symmetry(jnp.asarray(u, jnp.float32)))
        found.append(turn.action)
        observation = np.concatenate([Rotation.random(rng=rng).as_matrix().ravel(), rng.normal(size=9) * 2.0])
        action = rng.uniform(-1.2, 1.2, 4)
        there, reward = flown(env, observation, action)
        turned, same = flown(env, turn.observation @ observation, turn.action @ action)
        np.testing.assert_allclose(turned, turn.observation @ there, atol=2e-5)
        np.testing.assert_allclose(same, reward, rtol=1e-5)
        np.testing.assert_allclose(turn.observation @ turn.observation.T, np.eye(18), atol=1e-6)
    assert different(found) == turns


@pytest.mark.parametrize(
    "broken", [{"max_N": 7.0}, {"position_m": [0.08, 0.07425]}, {"spin": -1}], ids=["weak", "off its place", "reversed"]
)
def test_a_lopsided_vehicle_has_no_symmetry_that_moves_its_odd_motor(broken: dict[str, Any]) -> None:
    """One motor differs: what is left is the mirror through it, if any."""
    motors = [motor.model_dump(mode="json") for motor in tasks.load("hover").vehicle.motors]  # pyright: ignore[reportAttributeAccessIssue]
    env = changed("hover", {"motors": [motors[0] | broken, *motors[1:]]})
    for u in np.random.default_rng(0).random((DRAWS, 2)):
        turn = env.symmetry(jnp.asarray(u, jnp.float32))
        np.testing.assert_array_equal(turn.action, np.eye(4))
        np.testing.assert_array_equal(turn.observation, np.eye(18))


def test_two_motors_in_one_place_leave_the_task_as_it_is() -> None:
    """Which of them moves where cannot be said: no turn, and no action counted twice."""
    motors = [motor.model_dump(mode="json") for motor in tasks.load("hover").vehicle.motors]  # pyright: ignore[reportAttributeAccessIssue]
    env = changed("hover", {"motors": [motors[0], motors[0], *motors[2:]]})
    for u in np.random.default_rng(0).random((8, 2)):
        turn = env.symmetry(jnp.asarray(u, jnp.float32))
        np.testing.assert_array_equal(turn.action, np.eye(4))
        np.testing.assert_array_equal(turn.observation, np.eye(18))


def test_the_circle_is_turned_by_any_angle() -> None:
    """About z, evenly: its directions average out."""
    env = worlds.make("circle")
    draws = jnp.asarray(np.random.default_rng(0).random((4000, 2)), jnp.float32)
    world = np.asarray(jax.vmap(env.symmetry)(draws).observation)[:, 9:12, 9:12]
    angle = np.arctan2(world[:, 1, 0], world[:, 0, 0])
    counts, _ = np.histogram(angle, 8, (-np.pi, np.pi))
    assert counts.min() > 400


def test_the_pendulum_swings_either_way() -> None:
    env, found = worlds.make("pendulum"), set()
    for u in np.random.default_rng(0).random((8, 2)):
        turn = jax.tree.map(np.asarray, env.symmetry(jnp.asarray(u, jnp.float32)))
        found.add(float(turn.action[0, 0]))
        state = env.reset(jax.random.PRNGKey(int(1000 * u[1])))
        x = state.pipeline_state.x
        other = x._replace(pose=turn.action[0, 0] * x.pose, twist=turn.action[0, 0] * x.twist)
        np.testing.assert_allclose(env._observe(other), turn.observation @ state.obs, atol=1e-6)
        (there, reward), (turned, same) = (
            env._advance(env.params, at, jnp.asarray(action))
            for at, action in ((x, np.array([0.7])), (other, turn.action @ [0.7]))
        )
        np.testing.assert_allclose(env._observe(turned), turn.observation @ env._observe(there), atol=1e-5)
        np.testing.assert_allclose(same, reward, rtol=1e-5)
    assert found == {1.0, -1.0}


class Plain:
    """An environment without symmetries."""

    observation_size, action_size = 18, 4

    def reset(self, rng: jax.Array) -> Any: ...
    def step(self, state: Any, action: jax.Array) -> Any: ...


def test_a_minibatch_is_turned_trajectory_by_trajectory() -> None:
    """Observations and actions by the symmetry that each trajectory's numbers draw; all else is left."""
    env, rng = worlds.make("hover"), np.random.default_rng(0)
    shape, turns = (3, 5), jnp.asarray(rng.random((3, 2)), jnp.float32)
    scalars = [jnp.asarray(rng.normal(size=shape), jnp.float32) for _ in range(5)]
    observation, after = jnp.asarray(rng.normal(size=(2, *shape, 18)), jnp.float32)
    action = jnp.asarray(rng.normal(size=(*shape, 4)), jnp.float32)
    batch = Transition(observation, action, *scalars[:2], after, *scalars[2:])
    turned = augmentation.augment(env, batch, turns)
    for i in range(3):
        turn = env.symmetry(turns[i])
        for t in range(5):
            np.testing.assert_allclose(turned.observation[i, t], turn.observation @ observation[i, t], rtol=1e-5)
            np.testing.assert_allclose(turned.next_observation[i, t], turn.observation @ after[i, t], rtol=1e-5)
            np.testing.assert_allclose(turned.action[i, t], turn.action @ action[i, t], rtol=1e-5)
    rest = {"observation": 0, "next_observation": 0, "action": 0}
    jax.tree.map(np.testing.assert_array_equal, turned._replace(**rest), batch._replace(**rest))
    plain = adapt(Plain())
    jax.tree.map(np.testing.assert_array_equal, augmentation.augment(plain, batch, turns), batch)

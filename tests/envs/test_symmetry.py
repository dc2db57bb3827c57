"""Symmetries of the tasks: a transformed step is the step transformed, with the same reward."""

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
from qrl_envs.symmetry import Symmetry
from qrl_envs.target import Sines
from qrl_envs.task_env import TaskEnv

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


def bodies_at(observations: np.ndarray) -> quadrotor.Body:
    """The bodies with these observations [n, 18], by SciPy's quaternions."""
    attitude = Rotation.from_matrix(observations[:, :9].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    position, velocity, rate = (observations[:, i : i + 3] for i in (9, 12, 15))
    body = quadrotor.Body(quadrotor.Pose(position, attitude), quadrotor.Twist(velocity, rate))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), body)


def draws(env: TaskEnv, n: int, seed: int = 0) -> Symmetry:
    """n symmetries of the task, in NumPy."""
    u = jnp.asarray(np.random.default_rng(seed).random((n, 2)), jnp.float32)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(env.symmetry))(u))


@pytest.mark.parametrize(
    ("name", "vehicle", "permutations"),
    [
        ("hover", {}, 4),
        ("circle", {}, 2),
        ("hover", PLUS, 2),
        ("hover", PLUS | {"inertia_kg_m2": [0.0023, 0.0023, 0.0037]}, 4),
    ],
)
def test_a_transformed_step_is_the_step_transformed(name: str, vehicle: dict[str, Any], permutations: int) -> None:
    """step(G·s, P·a) = G·step(s, a) and the same reward; as many motor permutations as the vehicle has.

    A quarter turn would swap motors of opposite spin; a plus frame is mirrored about its diagonals.
    """
    env, rng = changed(name, vehicle), np.random.default_rng(0)
    found = draws(env, DRAWS)
    G, P = found.observation, found.action
    attitude = Rotation.random(DRAWS, rng=rng).as_matrix().reshape(DRAWS, 9)
    observation = np.concatenate([attitude, rng.normal(size=(DRAWS, 9)) * 2.0], axis=1)
    action = rng.uniform(-1.2, 1.2, (DRAWS, 4))

    @jax.jit
    @jax.vmap
    def step(body: quadrotor.Body, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        body, reward = env._advance(env.params, body, action)
        return env._observe(env.params, body), reward

    after, reward = step(bodies_at(observation), action.astype(np.float32))
    transformed = np.einsum("nij,nj->ni", G, observation), np.einsum("nij,nj->ni", P, action).astype(np.float32)
    transformed_after, same_reward = step(bodies_at(transformed[0]), transformed[1])
    np.testing.assert_allclose(transformed_after, np.einsum("nij,nj->ni", G, after), atol=2e-5)
    np.testing.assert_allclose(same_reward, reward, rtol=1e-5)
    np.testing.assert_allclose(G @ G.swapaxes(1, 2), np.broadcast_to(np.eye(18), G.shape), atol=1e-6)
    assert len(np.unique(np.round(P, 3) + 0.0, axis=0)) == permutations


@pytest.mark.parametrize(
    ("name", "vehicle", "permutations"), [("hover", "crazyflie", 4), ("hover", "hexa", 2), ("track", "crazyflie", 4)]
)
def test_a_real_vehicles_step_is_transformed_with_its_world(name: str, vehicle: str, permutations: int) -> None:
    """What is drawn for the flight turns with it: forces, wind and the reference as vectors, torques as pseudovectors,
    motors by permutation; so do memory and what the critic sees. A hexarotor's spins allow the mirror image about x
    alone.
    """
    task = tasks.load(name, vehicle)
    env, rng = worlds.RealQuadrotorEnv(task), np.random.default_rng(0)  # pyright: ignore[reportArgumentType]
    found = draws(env, DRAWS)
    keys = jax.random.split(jax.random.PRNGKey(0), DRAWS)
    flights = jax.jit(jax.vmap(env.reset))(keys).pipeline_state.x
    sensors = flights.world.sensors
    silent = sensors._replace(noise=jax.tree.map(jnp.zeros_like, sensors.noise))
    motors = flights.speed.shape[-1]
    flights = flights._replace(
        world=flights.world._replace(sensors=silent),
        speed=jnp.asarray(rng.uniform(0.2, 1.0, (DRAWS, motors)), jnp.float32),
        previous_action=jnp.asarray(rng.uniform(-1, 1, (DRAWS, motors)), jnp.float32),
        integral_m_s=jnp.asarray(rng.uniform(-0.5, 0.5, (DRAWS, 3)), jnp.float32),
    )
    flights = flights._replace(sensed=flights.body)
    world, body = found.observation[:, 9:12, 9:12], found.observation[:, 15:18, 15:18]

    def by(matrices: np.ndarray, vectors: Any) -> jax.Array:
        return jnp.asarray(np.einsum("nij,nj->ni", matrices, vectors), jnp.float32)

    def reference_of(drawn: Any) -> Any:
        """The map permutes and reflects axes: so do amplitudes; rates and phases are permuted."""
        if not drawn:
            return drawn
        signs = np.repeat(world.sum(axis=2)[:, :, None], 2, axis=2)
        places = np.abs(world)

        def permuted(x: Any) -> jax.Array:
            return jnp.asarray(np.einsum("nij,n...jk->n...ik", places, x), jnp.float32)

        size, rate, phase = map(permuted, drawn[:3])
        ahead = tuple(map(permuted, drawn.ahead))
        return Sines(jnp.asarray(signs * size, jnp.float32), rate, phase, ahead)

    def turned(x: Any) -> Any:
        pushed = x.world.disturbance
        observation = jax.vmap(quadrotor.observe)(x.body)
        moved = bodies_at(np.einsum("nij,nj->ni", found.observation[:, :18, :18], observation))
        return x._replace(
            body=moved,
            sensed=moved,
            speed=by(found.action, x.speed),
            set_points=jnp.asarray(np.einsum("nij,nkj->nki", found.action, x.set_points), jnp.float32),
            previous_action=by(found.action, x.previous_action),
            integral_m_s=by(world, x.integral_m_s),
            world=x.world._replace(
                reference=reference_of(x.world.reference),
                motor_factor=by(found.action, x.world.motor_factor),
                disturbance=pushed._replace(
                    force_N=by(world, pushed.force_N),
                    wind_m_s=by(world, pushed.wind_m_s),
                    torque_N_m=by(body, pushed.torque_N_m),
                ),
            ),
        )

    @jax.jit
    @jax.vmap
    def step(x: Any, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        after, reward = env._advance(env.params, x, action)
        return env._observe(env.params, x), env._observe(env.params, after), reward

    action = jnp.asarray(rng.uniform(-1.2, 1.2, (DRAWS, motors)), jnp.float32)
    before, after, reward = step(flights, action)
    turned_before, turned_after, same_reward = step(turned(flights), by(found.action, action))
    np.testing.assert_allclose(turned_before, by(found.observation, before), atol=2e-5)
    np.testing.assert_allclose(turned_after, by(found.observation, after), atol=1e-3)
    np.testing.assert_allclose(same_reward, reward, rtol=1e-4)
    assert len(np.unique(np.round(found.action, 3) + 0.0, axis=0)) == permutations


@pytest.mark.parametrize(
    "broken", [{"max_N": 7.0}, {"position_m": [0.08, 0.07425]}, {"spin": -1}], ids=["weak", "off its place", "reversed"]
)
def test_a_lopsided_vehicle_has_no_symmetry_that_moves_its_odd_motor(broken: dict[str, Any]) -> None:
    """One motor differs: only the reflection through it could remain."""
    motors = [motor.model_dump(mode="json") for motor in tasks.load("hover").vehicle.motors]  # pyright: ignore[reportAttributeAccessIssue]
    env = changed("hover", {"motors": [motors[0] | broken, *motors[1:]]})
    found = draws(env, DRAWS)
    np.testing.assert_array_equal(found.action, np.broadcast_to(np.eye(4), found.action.shape))
    np.testing.assert_array_equal(found.observation, np.broadcast_to(np.eye(18), found.observation.shape))


def test_two_motors_in_one_place_leave_the_task_as_it_is() -> None:
    """The permutation is not unique: only the identity is drawn, and no action counts twice."""
    env = worlds.make("hover")
    same = [0, 0, 2, 3]
    physics = env.params.physics
    twice = physics._replace(motor_torque_m=physics.motor_torque_m[:, same])
    env = env.with_params(env.params._replace(physics=twice))
    found = draws(env, 8)
    np.testing.assert_array_equal(found.action, np.broadcast_to(np.eye(4), found.action.shape))
    np.testing.assert_array_equal(found.observation, np.broadcast_to(np.eye(18), found.observation.shape))


def test_the_circle_is_turned_by_any_angle() -> None:
    """About z, evenly: its directions average out."""
    world = draws(worlds.make("circle"), 4000).observation[:, 9:12, 9:12]
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
        np.testing.assert_allclose(env._observe(env.params, other), turn.observation @ state.obs, atol=1e-6)
        (there, reward), (turned, same) = (
            env._advance(env.params, at, jnp.asarray(action))
            for at, action in ((x, np.array([0.7])), (other, turn.action @ [0.7]))
        )
        np.testing.assert_allclose(
            env._observe(env.params, turned), turn.observation @ env._observe(env.params, there), atol=1e-5
        )
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
    observation, final = (jnp.asarray(rng.normal(size=(3, n, 18)), jnp.float32) for n in (5, 2))
    action = jnp.asarray(rng.normal(size=(*shape, 4)), jnp.float32)
    batch = Transition(observation, action, *scalars, final)
    turned = augmentation.augment(env, batch, turns)
    for i in range(3):
        turn = env.symmetry(turns[i])
        for t in range(5):
            np.testing.assert_allclose(turned.observation[i, t], turn.observation @ observation[i, t], rtol=1e-5)
            np.testing.assert_allclose(turned.action[i, t], turn.action @ action[i, t], rtol=1e-5)
        for k in range(2):
            turned_final = turn.observation @ final[i, k]
            np.testing.assert_allclose(turned.final_observation[i, k], turned_final, rtol=1e-5, atol=1e-6)
    rest = {"observation": 0, "final_observation": 0, "action": 0}
    jax.tree.map(np.testing.assert_array_equal, turned._replace(**rest), batch._replace(**rest))
    plain = adapt(Plain())
    jax.tree.map(np.testing.assert_array_equal, augmentation.augment(plain, batch, turns), batch)

"""Distributions of vehicles, and actions that are rotor speeds."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl_envs import own_vehicle, plant, quadrotor, task
from qrl_envs.distribution import VehicleDistribution
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.specfile import BadInput

N = 3000


@pytest.fixture(scope="module")
def drawn() -> Any:
    base = task.load("any")
    assert isinstance(base, task.QuadrotorTask)
    physics = quadrotor.physics(base.vehicle)
    u = jax.random.uniform(jax.random.PRNGKey(0), (N, own_vehicle.DRAWS))
    spec = VehicleDistribution()
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda one: own_vehicle.draw(spec, physics, one)))(u)), physics


def test_vehicles_are_within_their_ranges_and_fill_them(drawn: Any) -> None:
    """What a vehicle can do, computed from what was drawn: thrust over weight, angular accelerations, lags."""
    vehicles, base = drawn
    physics = vehicles.physics
    weight = physics.mass_kg * 9.81
    arm = np.hypot(0.0304056, 0.0304056)
    found = {
        "thrust": (physics.motor_max_N.sum(axis=1) / weight, 1.35, 11.0),
        "agility": (arm * physics.motor_max_N[:, 0] / physics.inertia_kg_m2[:, 0], 50.0, 1200.0),
        "yaw": (
            np.abs(physics.motor_torque_m[:, 2, 0]) / physics.inertia_kg_m2[:, 2] * physics.inertia_kg_m2[:, 0] / arm,
            0.04,
            0.45,
        ),
        "rise": (vehicles.rotors.rise_s, 0.001, 0.15),
    }
    for name, (values, low, high) in found.items():
        share = (np.log(values) - np.log(low)) / np.log(high / low)
        assert share.min() > -1e-4, name
        assert share.max() < 1.0001, name
        # Log-uniform: Kolmogorov's distance to the uniform distribution, of which 1.63/√n is the 1 % point.
        distance = np.abs(np.sort(share) - (np.arange(N) + 0.5) / N).max()
        assert distance < 1.63 / np.sqrt(N), name
    ratio = vehicles.rotors.fall_s / vehicles.rotors.rise_s
    assert 0.8 <= ratio.min() < 0.85
    assert 1.95 < ratio.max() <= 2.0001
    np.testing.assert_array_equal(np.sign(physics.motor_torque_m[:, 2]), np.tile([1, -1, 1, -1], (N, 1)))
    np.testing.assert_array_equal(physics.motor_torque_m[:, :2], np.tile(base.motor_torque_m[:2], (N, 1, 1)))
    surplus = found["thrust"][0] - 1.0
    assert np.all(vehicles.surplus_weights <= 0.3 * np.minimum(surplus, 1.5) + 1e-6)


def test_no_random_number_is_used_twice(drawn: Any) -> None:
    vehicles, _ = drawn
    physics, rotors = vehicles.physics, vehicles.rotors
    columns = [
        np.log(physics.motor_max_N[:, 0]),
        np.log(physics.motor_max_N[:, 0] / physics.inertia_kg_m2[:, 0]),
        physics.inertia_kg_m2[:, 0] / physics.inertia_kg_m2[:, 1],
        np.log(np.abs(physics.motor_torque_m[:, 2, 0]) / physics.inertia_kg_m2[:, 2] * physics.inertia_kg_m2[:, 0]),
        np.log(rotors.rise_s),
        rotors.fall_s / rotors.rise_s,
        rotors.curve,
        vehicles.drag_N_s_m[:, 0],
        vehicles.surplus_weights / np.minimum(physics.motor_max_N.sum(axis=1) / (0.03 * 9.81) - 1.0, 1.5),
    ]
    correlation = np.corrcoef(np.array(columns)) - np.eye(len(columns))
    assert np.abs(correlation).max() < 0.07


def test_a_rotor_speed_is_a_set_point() -> None:
    """−1 to 1 stands for 0 to the greatest speed, whatever the thrust; below the least one it is that."""
    base = task.load("any")
    assert isinstance(base, task.QuadrotorTask)
    env = RealQuadrotorEnv(base.model_copy(update={"distribution": None}))
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    world = state.pipeline_state.x.world
    set_point, applied = plant.commanded(world, jnp.array([-1.5, -0.4, 0.6, 1.2]), rotor_speed=True)
    np.testing.assert_allclose(set_point, [0.0, 0.3, 0.8, 1.0], atol=1e-6)
    np.testing.assert_allclose(applied, [-1.0, -0.4, 0.6, 1.0], atol=1e-6)
    idle = world._replace(physics=world.physics._replace(motor_min_N=0.09 * world.physics.motor_max_N))
    set_point, applied = plant.commanded(idle, jnp.array([-1.0] * 4), rotor_speed=True)
    np.testing.assert_allclose(set_point, [0.3] * 4, atol=1e-6)  # thrust is speed squared here
    np.testing.assert_allclose(applied, [-0.4] * 4, atol=1e-6)


def test_each_flight_has_its_own_vehicle_and_begins_in_its_hover() -> None:
    env = RealQuadrotorEnv(task.load("any"))  # pyright: ignore[reportArgumentType]
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
    world, speed = states.pipeline_state.x.world, states.pipeline_state.x.speed
    assert len(np.unique(world.rotors.rise_s)) == 64
    lift = (
        world.rotors.curve[:, None] * speed + (1 - world.rotors.curve[:, None]) * speed**2
    ) * world.physics.motor_max_N
    np.testing.assert_allclose(lift.sum(axis=1), np.full(64, 0.03 * 9.81), rtol=1e-3)
    assert np.isfinite(states.obs).all()
    assert np.abs(states.obs[:, env.policy_observation_size :]).max() < 12.0  # what a critic sees is about 1 in size


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"action": "thrust"}, "rotor_speed"),
        ({"vehicle": "hexa"}, "four motors"),
        ({"distribution": {"rotor_rise_s": [0.1, 0.05]}}, "distribution.rotor_rise_s"),
        ({"distribution": "quadrotor"}, "quadrotors"),
        ({"distribution": {"thrust_per_weight": [0.5, 2.0]}}, "thrust_per_weight"),
        ({"distribution": {"moment_z_factor": 2.0}}, "rigid body"),
        ({"distribution": {"thrust_curve": [-5.0, 0.0]}}, "thrust_curve from -0.9 to 1"),
        ({"uncertainty": {"rotor_lag_factor": [0.5, 2.0]}}, "rotor_lag"),
    ],
)
def test_a_distribution_that_cannot_be_flown_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInput) as caught:
        task.from_data({"extend": "any", **changes}, "here")
    assert words in str(caught.value)

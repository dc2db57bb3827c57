"""The tasks as Brax environments: through Brax's own registry, wrappers and PPO."""

import dataclasses
import functools
import subprocess
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.envs.base import Env, State
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo

import qrl_envs
from qrl_envs import env, quadrotor, task, task_env
from qrl_envs.task_env import Lane, TaskEnv

Array = np.ndarray

LANES = 6
BRAXS_OWN = ("steps", "truncation", "episode_done", "episode_metrics", "first_")
SIZES = {"hover": (18, 4), "circle": (18, 4), "pendulum": (3, 1)}


class World(NamedTuple):
    """An environment from Brax's registry, its functions compiled for LANES lanes, and a reset and a step of it."""

    name: str
    env: TaskEnv
    reset: Callable[..., State]
    step: Callable[..., State]
    restart: Callable[..., State]
    start: State
    after: State


@functools.cache
def world(name: str) -> World:
    one = envs.get_environment(name)
    assert isinstance(one, TaskEnv)
    reset, step, restart = (jax.jit(jax.vmap(f)) for f in (one.reset, one.step, one.restart))
    start = reset(keys(0))
    return World(name, one, reset, step, restart, start, step(start, jnp.full((LANES, one.action_size), 0.1)))


def keys(seed: int) -> jax.Array:
    """One legacy key a lane."""
    return jax.random.split(jax.random.PRNGKey(seed), LANES)


@pytest.fixture(params=["hover", "circle", "pendulum"])
def any_world(request: pytest.FixtureRequest) -> World:
    return world(request.param)


@pytest.fixture
def hover() -> World:
    return world("hover")


def with_params(state: State, **physics: Array) -> State:
    """The same state, each lane with its own value of the given parameters of physics."""
    lane: Lane = state.pipeline_state
    params = lane.params._replace(physics=lane.params.physics._replace(**physics))
    return state.replace(pipeline_state=lane._replace(params=params))


def placed(state: State, *, position_m: Array | None = None, body_rate_rad_s: Array | None = None) -> State:
    """The same state with lanes [N, 3] moved, or set turning."""
    pose, twist = state.pipeline_state.x
    pose = pose if position_m is None else pose._replace(position_m=jnp.asarray(position_m, jnp.float32))
    if body_rate_rad_s is not None:
        twist = twist._replace(body_rate_rad_s=jnp.asarray(body_rate_rad_s, jnp.float32))
    return state.replace(pipeline_state=state.pipeline_state._replace(x=quadrotor.Body(pose, twist)))


def test_importing_registers_every_shipped_task() -> None:
    """`import qrl_envs` alone, under the names of the task files."""
    assert qrl_envs.__name__ == "qrl_envs"
    assert set(task.shipped()) <= set(envs._envs)


def test_it_is_an_environment_of_braxs(any_world: World) -> None:
    """By its type, and by the fields of its state, with their defaults."""
    assert isinstance(any_world.env, Env)
    ours, theirs = (dataclasses.fields(kind) for kind in (task_env.State, State))
    assert [(f.name, f.default, f.default_factory) for f in ours] == [
        (f.name, f.default, f.default_factory) for f in theirs
    ]


def test_it_is_registered_when_brax_is_imported_later() -> None:
    """This module imports Brax first."""
    program = "import qrl_envs; from brax import envs; print(isinstance(envs.get_environment('hover'), envs.Env))"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said.splitlines()[-1] == "True"


def test_without_brax_none_of_it_is_imported() -> None:
    """Nor what it brings along: its physics takes most of its time."""
    program = "import sys, qrl_envs.off_nominal as _; print({'brax', 'mujoco', 'gymnasium', 'scipy'} & {*sys.modules})"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said == "set()\n"


def test_sizes_are_designs(any_world: World) -> None:
    """As declared and as observed; all in float32."""
    observations, actions = SIZES[any_world.name]
    assert (any_world.env.observation_size, any_world.env.action_size) == (observations, actions)
    for state in (any_world.start, any_world.after):
        assert state.obs.shape == (LANES, observations)
        assert state.reward.shape == state.done.shape == (LANES,)
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(state))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))


def test_reset_and_step_return_the_same_tree(any_world: World) -> None:
    """Keys of metrics and info included; so a state may be carried through a scan."""
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (any_world.start, any_world.after)]
    assert shapes[0] == shapes[1]
    assert any_world.start.metrics.keys() == any_world.after.metrics.keys()
    assert any_world.start.info.keys() == any_world.after.info.keys()


def test_no_key_is_one_of_braxs_own(any_world: World) -> None:
    """Its wrappers would overwrite it."""
    for state in (any_world.start, any_world.after):
        for key in [*state.metrics, *state.info]:
            assert not key.startswith(BRAXS_OWN)


def test_legacy_and_typed_keys_draw_the_same_start(any_world: World) -> None:
    """A typed key of the same seed."""
    typed = jax.random.split(jax.random.key(0), LANES)
    for ours, theirs in zip(jax.tree.leaves(any_world.reset(typed)), jax.tree.leaves(any_world.start), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_lanes_start_apart_and_keys_repeat(any_world: World) -> None:
    """Every lane's draw is its own; the same key gives the same start, another another."""
    again, other = any_world.reset(keys(0)), any_world.reset(keys(1))
    np.testing.assert_array_equal(again.obs, any_world.start.obs)
    assert len(np.unique(np.concatenate([again.obs, other.obs]), axis=0)) == 2 * LANES


def coordinates(name: str, x: quadrotor.Body) -> dict[str, Array]:
    """What a start draws uniformly, by the names of the task file."""
    if name == "pendulum":
        return {"angle_rad": np.asarray(x.pose), "rate_rad_s": np.asarray(x.twist)}
    return {
        "position_m": np.asarray(x.pose.position_m),
        "velocity_m_s": np.asarray(x.twist.velocity_m_s),
        "body_rate_rad_s": np.asarray(x.twist.body_rate_rad_s),
    }


def test_starts_fill_their_ranges_and_no_more(any_world: World) -> None:
    """1,200 starts: each coordinate within ± its range, near both ends, and none the copy of another."""
    draws = [any_world.reset(keys(seed)).pipeline_state.x for seed in range(200)]
    columns = []
    for field, reach in any_world.env.task.start.model_dump(exclude={"tilt_rad"}).items():
        drawn = np.concatenate([coordinates(any_world.name, x)[field].reshape(LANES, -1) for x in draws])
        assert np.abs(drawn).max() <= np.float32(reach)
        assert (drawn.max(axis=0) > 0.98 * reach).all()
        assert (drawn.min(axis=0) < -0.98 * reach).all()
        columns.append(drawn / reach)
    numbers = np.concatenate(columns, axis=1)
    assert np.abs(np.corrcoef(numbers.T) - np.eye(numbers.shape[1])).max() < 0.15


def test_braxs_create_wraps_it(any_world: World) -> None:
    """EpisodeWrapper, VmapWrapper and AutoResetWrapper: an episode ends at its length and starts over."""
    wrapped = envs.create(any_world.name, episode_length=3, batch_size=LANES)
    assert wrapped.action_size == any_world.env.action_size
    step = jax.jit(wrapped.step)
    first = state = jax.jit(wrapped.reset)(jax.random.PRNGKey(0))
    done, steps = [], []
    for _ in range(7):
        state = step(state, jnp.full((LANES, wrapped.action_size), 0.1))
        done.append(float(state.done.mean()))
        steps.append(float(state.info["steps"].mean()))
    assert done == [0, 0, 1, 0, 0, 1, 0]
    assert steps == [1, 2, 3, 1, 2, 3, 1]
    second_flight = state.obs
    np.testing.assert_allclose(second_flight, step(first, jnp.full((LANES, wrapped.action_size), 0.1)).obs, rtol=1e-5)


def test_brax_ppo_trains_on_hover(monkeypatch: pytest.MonkeyPatch) -> None:
    """400 steps of Brax's own PPO on our environment as registered, with finite losses and an evaluation."""

    # Brax 0.14.2 calls jax.device_put_replicated, which JAX 0.10 no longer has. This is what it did, for one device.
    def device_put_replicated(tree: Any, devices: list[Any]) -> Any:
        assert len(devices) == 1
        return jax.tree.map(lambda x: jax.device_put(jnp.asarray(x)[None], devices[0]), tree)

    monkeypatch.setattr(jax, "device_put_replicated", device_put_replicated, raising=False)
    factory = functools.partial(
        ppo_networks.make_ppo_networks, policy_hidden_layer_sizes=(8,), value_hidden_layer_sizes=(8,)
    )
    _, _, metrics = ppo.train(
        environment=envs.get_environment("hover"),
        num_timesteps=400,
        episode_length=50,
        num_envs=8,
        batch_size=8,
        unroll_length=5,
        num_minibatches=1,
        num_updates_per_batch=1,
        num_evals=1,
        num_eval_envs=4,
        network_factory=factory,
        normalize_observations=True,
        max_devices_per_host=1,
    )
    assert "eval/episode_reward" in metrics
    assert "training/total_loss" in metrics
    assert all(np.isfinite(value).all() for value in metrics.values())
    assert metrics["eval/episode_reward"] < 0
    assert 0 < metrics["eval/avg_episode_length"] <= 50


def test_each_lane_flies_its_own_vehicle(hover: World) -> None:
    """Six masses in one batch step as six tasks with one mass each."""
    mass = np.linspace(0.3, 0.9, LANES).astype(np.float32)
    action = jnp.full((LANES, 4), 0.2)
    after = hover.step(with_params(hover.start, mass_kg=mass), action)
    velocity = after.pipeline_state.x.twist.velocity_m_s - hover.start.pipeline_state.x.twist.velocity_m_s
    body_z = np.asarray(hover.start.obs).reshape(LANES, 18)[:, [2, 5, 8]]
    thrust = 0.667 * 9.81 + 4 * 6.0 * 0.2  # F_o is the policy's, whatever the mass
    expected = 0.01 * (body_z * (thrust / mass)[:, None] - [0.0, 0.0, 9.81])
    np.testing.assert_allclose(velocity, expected, atol=1e-5)
    np.testing.assert_array_equal(after.pipeline_state.params.physics.mass_kg, mass)


def test_restart_keeps_the_lanes_own_task(any_world: World) -> None:
    """Every parameter of every lane stays; start ranges are the lane's own too; the draw is fresh."""
    lane: Lane = any_world.start.pipeline_state
    scale = jnp.linspace(0.5, 1.0, LANES)
    params = jax.tree.map(lambda x: x * scale.reshape(-1, *[1] * (x.ndim - 1)), lane.params)
    still = {name: value.at[0].set(0.0) for name, value in params.start._asdict().items() if value is not None}
    params = params._replace(start=params.start._replace(**still))
    state = any_world.restart(any_world.start.replace(pipeline_state=lane._replace(params=params)), keys(7))
    for kept, given in zip(jax.tree.leaves(state.pipeline_state.params), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(kept, given)
    for drawn in coordinates(any_world.name, state.pipeline_state.x).values():
        assert (drawn[0] == 0).all()
        assert (drawn[1:] != 0).all()
    assert len(np.unique(np.concatenate([state.obs, any_world.start.obs]), axis=0)) == 2 * LANES


def test_restart_ends_the_end(hover: World) -> None:
    """A fresh start is neither done nor truncated, though the state before it was."""
    fled = hover.step(placed(hover.start, position_m=np.full((LANES, 3), 15.0)), jnp.zeros((LANES, 4)))
    assert (fled.done == 1).all()
    fresh = hover.restart(fled, keys(3))
    assert not fresh.done.any()
    assert not fresh.info["truncated"].any()
    np.testing.assert_allclose(fresh.reward, 0.0)


def ends(state: State, at: list[int]) -> None:
    """Exactly the lanes `at` ended, each as a truncation."""
    expected = np.isin(np.arange(LANES), at)
    np.testing.assert_array_equal(state.done, expected)
    np.testing.assert_array_equal(state.info["truncated"], expected)


def test_a_vehicle_that_flees_ends_as_a_truncation(hover: World) -> None:
    """|p| > 20 m in any direction, after the step."""
    position = np.array([[20.1, 0, 0], [-20.1, 0, 0], [0, 0, 19.9], [12, 12, 12], [11, 11, 11], [0, 19.9, 0]])
    start = placed(hover.start, position_m=position)
    velocity = jnp.zeros((LANES, 3)).at[5, 1].set(50.0)  # the last one gets there in this step
    x = start.pipeline_state.x
    x = x._replace(twist=x.twist._replace(velocity_m_s=velocity))
    after = hover.step(start.replace(pipeline_state=start.pipeline_state._replace(x=x)), jnp.zeros((LANES, 4)))
    ends(after, [0, 1, 3, 5])


def test_a_vehicle_that_tumbles_ends_as_a_truncation(hover: World) -> None:
    """|ω| > 100 rad/s about any axis; about a principal one it turns on steadily."""
    rate = np.array([[101.0, 0, 0], [0, -101.0, 0], [0, 0, 99.0], [0, 0, 101.0], [99.0, 0, 0], [0, 0, 0]])
    ends(hover.step(placed(hover.start, body_rate_rad_s=rate), jnp.zeros((LANES, 4))), [0, 1, 3])


def test_a_number_that_is_not_finite_ends_the_episode(hover: World) -> None:
    """NaN or infinity in position, velocity, attitude or body rate of a lane, and in its action; the others fly on."""
    pose, twist = hover.start.pipeline_state.x
    pose = pose._replace(position_m=pose.position_m.at[0, 1].set(jnp.nan), attitude=pose.attitude.at[1, 2].set(jnp.nan))
    twist = twist._replace(
        velocity_m_s=twist.velocity_m_s.at[2, 0].set(jnp.inf),
        body_rate_rad_s=twist.body_rate_rad_s.at[3, 2].set(jnp.nan),
    )
    lane = hover.start.pipeline_state._replace(x=quadrotor.Body(pose, twist))
    action = jnp.zeros((LANES, 4)).at[4, 0].set(jnp.nan)
    ends(hover.step(hover.start.replace(pipeline_state=lane), action), [0, 1, 2, 3, 4])


def test_whatever_bound_is_left_costs_the_same(any_world: World) -> None:
    """The reward at 20 m above the origin, upside down, under full action; less than nearer ones. No NaN spoils it."""
    if any_world.name == "pendulum":
        pytest.skip("it has no bounds")
    spec: Any = any_world.env.task.reward
    rate = np.zeros((LANES, 3))
    position = np.array([[20.1, 0, 0], [0, 0, -25.0], [0.1, 0, 0], [0, 0, 0], [0, 0.5, 0], [np.nan, 0, 0]])
    rate[2:4, :] = [[101.0, 0, 0], [0, 0, -150.0]]
    after = any_world.step(placed(any_world.start, position_m=position, body_rate_rad_s=rate), jnp.zeros((LANES, 4)))
    ends(after, [0, 1, 2, 3, 5])
    if any_world.name == "hover":
        expected = -(spec.w1_attitude * np.sqrt(2.0) + spec.w2_position_1_m * 20.0 + spec.w3_action * 2.0)
    else:
        distance, chi = np.hypot(20.0, spec.radius_m), spec.radius_m * spec.speed_m_s
        expected = -(spec.w4_distance_1_m * distance + spec.w5_direction_s_m2 * chi + spec.w6_action * 2.0)
    np.testing.assert_allclose(after.reward[np.array([0, 1, 2, 3, 5])], expected, rtol=1e-5)
    assert after.reward[4] > expected / 5


def test_the_bounds_travel_with_the_lane(hover: World) -> None:
    """A lane with a bound of its own ends at that."""
    lane: Lane = hover.start.pipeline_state
    reach = {
        "distance_m": jnp.full(LANES, 20.0).at[2].set(1.0),
        "body_rate_rad_s": lane.params.bounds["body_rate_rad_s"],
    }
    state = hover.start.replace(pipeline_state=lane._replace(params=lane.params._replace(bounds=reach)))
    ends(hover.step(placed(state, position_m=np.full((LANES, 3), 1.0)), jnp.zeros((LANES, 4))), [2])


def test_evaluation_flies_its_own_starts_and_reward() -> None:
    """Whatever ranges, weights and episodes training uses; the return is of the first 200 steps."""
    spec = task.from_data(
        {"extend": "hover", "start": {"position_m": 0.1}, "reward": {"w3_action": 9.0}, "episode_steps": 150}, "here"
    )
    assert isinstance(spec, task.QuadrotorTask)
    plan = env.from_task(spec).evaluation()
    assert isinstance(plan.env, TaskEnv)
    assert (plan.steps, plan.return_steps) == (800, 200)
    np.testing.assert_allclose(plan.env.params.start[:4], [2.0, 1.0, 1.0, np.pi], rtol=1e-6)
    assert plan.env.params.start.nested is None
    np.testing.assert_allclose(jax.tree.leaves(plan.env.params.reward), [1.0, 0.2, 0.2, 0.2])


def test_the_pendulum_is_judged_alike_whatever_it_trains_with() -> None:
    """By Pendulum-v1's starts and reward; a task file that does not say how it is judged: as it trains."""
    other = {"start": {"angle_rad": 0.1}, "reward": {"w_torque_1_N2m2": 9.0}, "rod": {"mass_kg": 2.0}}
    spec = task.from_data({"extend": "pendulum", **other}, "here")
    judged = env.from_task(spec).evaluation().env
    assert isinstance(judged, TaskEnv)
    np.testing.assert_allclose(judged.params.start, [np.pi, 1.0])
    np.testing.assert_allclose(judged.params.reward, [1.0, 0.1, 0.001])
    assert judged.params.physics.mass_kg == 2.0
    silent = spec.model_copy(update={"evaluation": spec.evaluation.model_copy(update={"start": None, "reward": None})})
    judged = env.from_task(silent).evaluation().env
    assert isinstance(judged, TaskEnv)
    np.testing.assert_allclose(judged.params.start, [0.1, 1.0])
    np.testing.assert_allclose(judged.params.reward, [1.0, 0.1, 9.0])


def test_unknown_keyword_is_no_silent_default() -> None:
    """brax.envs.create passes its keywords on."""
    with pytest.raises(TypeError):
        envs.create("hover", mass=1.0)


def test_a_foreign_env_is_left_alone() -> None:
    """Registering ours has not touched Brax's names."""
    assert "inverted_pendulum" in envs._envs
    assert issubclass(envs._envs["inverted_pendulum"], Env)

"""The pendulum beside Gymnasium's Pendulum-v1, in float64."""

from collections.abc import Iterator
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from gymnasium.envs.classic_control import PendulumEnv as GymPendulum

from qrl_envs import env, pendulum, rewards, task, task_env

Array = np.ndarray

SPEC = task.load("pendulum")
assert isinstance(SPEC, task.PendulumTask)
ROD, REWARD, START = SPEC.rod, SPEC.reward, SPEC.start
WORLD = env.from_task(SPEC)
STEPS, FLIGHTS = 40, 20  # the upright point is unstable: rounding grows e^3.9-fold a second, 2 s keep it below 1e-11


class Path(NamedTuple):
    """States, observations and rewards of flights [n], each of K steps."""

    state: Array  # [n, K + 1, 2] angle, rate
    observation: Array  # [n, K + 1, 3]
    reward: Array  # [n, K]


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


def in_float64(kind: type, values: object) -> tuple:
    """The fields of `kind`, read from the task file in double precision."""
    return kind(*(jnp.float64(getattr(values, field)) for field in kind._fields))


@jax.jit
@jax.vmap
def fly(start: jax.Array, torque: jax.Array) -> tuple[jax.Array, ...]:
    """Our environment from a start [2] under torques [K] in N m, as large as the caller likes."""
    params = task_env.Params(
        in_float64(pendulum.Physics, ROD), in_float64(rewards.SwingUp, REWARD), WORLD.params.start, {}
    )
    x = pendulum.Pendulum(start[0], start[1])
    zero = jnp.float32(0.0)
    info = {"truncated": zero, "out_of_bounds": zero}
    state = State(task_env.Lane(x, params), pendulum.observe(x), jnp.float64(0.0), zero, {}, info)

    def step(state: State, torque: jax.Array) -> tuple[State, State]:
        after = WORLD.step(state, torque[None] / ROD.max_torque_N_m)
        return after, after

    _, after = jax.lax.scan(step, state, torque)
    states = jnp.stack(after.pipeline_state.x, axis=-1)
    return (
        jnp.concatenate([start[None], states]),
        jnp.concatenate([state.obs[None], after.obs]),
        after.reward,
        after.done,
    )


def gym_flies(start: Array, torque: Array) -> Path:
    """The same by Gymnasium, one flight after the other."""
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    assert isinstance(theirs, GymPendulum)
    paths = []
    for x, torques in zip(start, torque, strict=True):
        theirs.reset(seed=0)
        theirs.state = x.copy()
        path = [(theirs.state, theirs._get_obs(), 0.0)]
        for u in torques:
            observation, reward, *_ = theirs.step(np.array([u]))
            path.append((theirs.state, observation, reward))
        paths.append([np.stack(column) for column in zip(*path, strict=True)])
    state, observation, reward = (np.stack(column) for column in zip(*paths, strict=True))
    return Path(state, observation, reward[:, 1:])


@pytest.fixture(scope="module")
def flights(float64: None) -> tuple[Path, Path, Array, Array]:
    """Ours, Gymnasium's, our `done`, and the torques: from any angle, turned up to twice, and any allowed rate."""
    rng = np.random.default_rng(0)
    start = rng.uniform([-4 * np.pi, -8.0], [4 * np.pi, 8.0], size=(FLIGHTS, 2))
    torque = rng.uniform(-5.0, 5.0, size=(FLIGHTS, STEPS))
    *ours, done = map(np.asarray, fly(start, torque))
    return Path(*ours), gym_flies(start, torque), done, torque


def test_states_are_gymnasiums(flights: tuple[Path, Path, Array, Array]) -> None:
    """800 steps: angle (not wrapped) and rate after each."""
    ours, theirs, _, _ = flights
    np.testing.assert_allclose(ours.state, theirs.state, rtol=0, atol=1e-10)


def test_rewards_are_gymnasiums(flights: tuple[Path, Path, Array, Array]) -> None:
    """On the state before the step and with the torque after clipping, both as Gymnasium has it."""
    ours, theirs, _, _ = flights
    np.testing.assert_allclose(ours.reward, theirs.reward, rtol=0, atol=1e-10)


def test_observations_are_gymnasiums(flights: tuple[Path, Path, Array, Array]) -> None:
    """cos θ, sin θ, θ̇; Gymnasium rounds its own to float32."""
    ours, theirs, _, _ = flights
    np.testing.assert_allclose(ours.observation, theirs.observation, rtol=1e-6, atol=1e-7)


def test_the_flights_met_both_limits_and_both_wraps(flights: tuple[Path, Path, Array, Array]) -> None:
    """What the comparison above rests on: torques beyond the limit, rates at it, angles beyond ±π."""
    ours, _, _, torque = flights
    angle, rate = ours.state[..., 0], ours.state[..., 1]
    for limit in (-8.0, 8.0):
        assert 5 < np.sum(rate == limit) < rate.size / 2
    assert (np.abs(torque) > 2).mean() > 0.5
    assert (angle > np.pi).any()
    assert (angle < -np.pi).any()


def test_the_pendulum_never_ends_early(flights: tuple[Path, Path, Array, Array]) -> None:
    """As in Gymnasium, where only the time limit ends an episode."""
    _, _, done, _ = flights
    assert not done.any()


def test_the_task_file_is_pendulum_v1() -> None:
    """Its constants, period, episode and starts are Gymnasium's own."""
    theirs = gymnasium.make("Pendulum-v1")
    unwrapped = theirs.unwrapped
    assert isinstance(unwrapped, GymPendulum)
    assert (ROD.gravity_m_s2, ROD.mass_kg, ROD.length_m) == (unwrapped.g, unwrapped.m, unwrapped.l)
    assert (ROD.max_torque_N_m, ROD.max_rate_rad_s) == (unwrapped.max_torque, unwrapped.max_speed)
    assert SPEC.control_period_s == unwrapped.dt
    assert theirs.spec is not None
    assert SPEC.episode_steps == theirs.spec.max_episode_steps
    starts = np.abs([theirs.reset(seed=seed)[0] for seed in range(1000)])
    assert START.angle_rad == pytest.approx(np.pi)
    assert START.rate_rad_s == pytest.approx(starts[:, 2].max(), abs=0.01)

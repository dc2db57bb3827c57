"""The memory that an environment keeps for its policy in training is the one that the exported kernel keeps."""

from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State

from qrl.evaluation import calibration
from qrl.evaluation.starts import calibration_starts
from qrl.evaluation.trained_run import TrainedRun, flown_inputs, inputs_in_si
from qrl.export import kernel as reference
from qrl.export.policy import ActionSpec, Integral, Memory, ObservationSpec, Policy, Provenance
from qrl.export.quantize import quantize

PERIOD_S, PUSH_M_S2, RADIUS_M, LIMIT_M_S = 0.02, 0.9, 0.8, 0.3
OFFSET_N, SCALE_N = np.array([1.0, -0.5, 0.2]), np.array([4.0, 5.0, 3.0])
MEMORY = Memory(True, Integral((0, 1, 2), RADIUS_M, LIMIT_M_S))
STARTS = 20


class World(NamedTuple):
    p: jax.Array
    v: jax.Array
    previous: jax.Array
    integral: jax.Array


class Pushed:
    """A mass of 1 kg pushed by a constant force, with lag; observed: p, v, the previous a, the integral of p, more."""

    observation_size, action_size, dt, episode_steps = 14, 3, PERIOD_S, 900

    def reset(self, rng: jax.Array) -> State:
        p, zero = jax.random.uniform(rng, (3,), minval=-1.5, maxval=1.5), jnp.zeros(3)
        return self._state(World(p, zero, zero, zero))

    def step(self, state: State, action: jax.Array) -> State:
        world = cast(Any, state.pipeline_state)
        force = OFFSET_N + SCALE_N * (0.5 * action + 0.5 * world.previous) - OFFSET_N + PUSH_M_S2
        v = world.v + PERIOD_S * force
        return self._state(World(world.p + PERIOD_S * v, v, action, world.integral))

    def _state(self, world: World) -> State:
        gate = jnp.maximum(0.0, 1.0 - (world.p**2).sum() / RADIUS_M**2) ** 2
        integral = jnp.clip(world.integral + PERIOD_S * gate * world.p, -LIMIT_M_S, LIMIT_M_S)
        world = world._replace(integral=integral)
        zero = jnp.zeros(())
        unseen = jnp.full(2, 7.0)  # a critic's
        return State(cast(Any, world), jnp.concatenate([*world, unseen]), zero, zero)


def made_policy() -> Policy:
    """Feedback of p, v, the previous action and the integral, as a network of relu(x) − relu(−x)."""
    eye = np.eye(3)
    gains = np.concatenate([-4.0 * eye, -3.5 * eye, -0.2 * np.diag(SCALE_N), -5.0 * eye]) / SCALE_N
    ports = (
        ActionSpec(f"f{i}", "N", "world", OFFSET_N[i], SCALE_N[i], OFFSET_N[i] - 9, OFFSET_N[i] + 9, OFFSET_N[i])
        for i in range(3)
    )
    return Policy(
        provenance=Provenance("made-up", "pushed", "hold a place", "0", 0, 0),
        control_period_s=PERIOD_S,
        observations=tuple(ObservationSpec(name, "?", "world") for name in ("px", "py", "pz", "vx", "vy", "vz")),
        actions=tuple(ports),
        observation_offset=np.concatenate([np.zeros(6), OFFSET_N, np.zeros(3)]),
        observation_gain=np.concatenate([np.ones(6), 1.0 / SCALE_N, np.ones(3)]),
        observation_clip=np.inf,
        observation_scale=np.ones(12),
        layers=(
            (np.concatenate([gains, -gains], axis=1), np.zeros(6)),
            (np.concatenate([eye, -eye]), np.zeros(3)),
        ),
        activation="relu",
        calibration=np.zeros((0, 12), np.float32),
        memory=MEMORY,
    )


@pytest.fixture(scope="module")
def run() -> TrainedRun:
    """What `TrainedRun` needs to fly policies of the host in this environment."""
    policy = made_policy()
    config = SimpleNamespace(task=SimpleNamespace(spec=None, name="pushed"), learner=None)
    programs = SimpleNamespace(env=Pushed(), max_episode_steps=Pushed.episode_steps)
    found = TrainedRun(cast(Any, None), cast(Any, config), cast(Any, programs), cast(Any, None), 0)
    found._specs = lambda: (policy.observations, policy.actions)
    found.float_policy = lambda memory=None: policy
    return found


def test_the_integer_policy_flies_with_its_own_memory(run: TrainedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """From measurements alone it does what the float policy does with the environment's memory, and settles."""
    monkeypatch.setattr(calibration, "STARTS", 100)
    policy = run.policy()
    assert policy.calibration.shape[1] == 12
    np.testing.assert_allclose(policy.calibration[:, 6:9].max(axis=0), OFFSET_N + SCALE_N, atol=2.5)
    kernel = quantize(policy)
    keys = jax.random.split(jax.random.PRNGKey(5), STARTS)

    def in_float(memory: np.ndarray, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return memory, policy(inputs_in_si(policy, observation))

    def in_integers(state: np.ndarray, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        after, _, action = reference.step(kernel, state.astype(np.int64), observation[:, :6])
        return after, action

    flown = [
        run.fly_host_policy(in_float, np.zeros((STARTS, 0), int), keys),
        run.fly_host_policy(in_integers, reference.initial_state(kernel, STARTS), keys),
    ]
    positions = [np.asarray(flights.observations)[:, :, :3] for flights in flown]
    assert np.abs(positions[0] - positions[1]).max() < 0.02
    for position in positions:
        assert np.abs(position[:, -50:]).max() < 2e-3
    assert (
        np.abs(np.asarray(flown[1].observations)[:, -1, 9:12]).min() > 0.1
    )  # the integral that holds against the push


class Misled(Pushed):
    """Its measurements are 0.25 m and m/s off the truth, which is recorded; a flight ends 0.3 m from the origin."""

    def _state(self, world: World) -> State:
        state = super()._state(world)
        obs = state.obs + 0.25 * (jnp.arange(14) < 6)
        done = (jnp.linalg.norm(world.p) < 0.3).astype(jnp.float32)
        return State(state.pipeline_state, obs, state.reward, done, {}, {"true_obs": state.obs})


def test_calibration_is_on_what_the_policy_was_given(run: TrainedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on the truth beside it, and not on what comes after a flight's end."""
    monkeypatch.setattr(calibration, "STARTS", STARTS)
    monkeypatch.setattr(calibration, "select", lambda observations: observations)
    monkeypatch.setattr(run, "env", Misled())
    monkeypatch.setattr(run, "_on_host", {})
    policy, given = run.float_policy(), []

    def step(memory: None, observation: np.ndarray) -> tuple[None, np.ndarray]:
        given.append(inputs_in_si(policy, observation))
        return memory, policy(given[-1])

    flights = run.fly_host_policy(step, None, calibration_starts(STARTS), from_envelope=0.2, calibrating=True)
    ended = np.isnan(flights.observations[:, :-1, 0])
    assert 0 < ended.all(axis=1).sum() + ended.any(axis=1).sum() < 2 * STARTS
    found = run.policy().calibration
    np.testing.assert_allclose(found[~ended], np.stack(given, axis=1)[~ended], rtol=1e-5)
    np.testing.assert_allclose(found[~ended][:, :6] - 0.25, flights.observations[:, :-1, :6][~ended], atol=1e-5)
    assert np.isnan(found[ended]).all()


def test_the_inputs_of_a_flight_are_those_that_the_environment_gave(run: TrainedRun) -> None:
    """Recovered from measurements and actions; a flight that ended has none."""
    policy = run.float_policy()
    keys = jax.random.split(jax.random.PRNGKey(7), STARTS)
    flights = run.fly_host_policy(
        lambda memory, o: (memory, policy(inputs_in_si(policy, o))), np.zeros((STARTS, 0), int), keys
    )
    wanted = inputs_in_si(policy, np.asarray(flights.observations)[:, :-1])
    np.testing.assert_allclose(flown_inputs(policy, flights), wanted, atol=2e-5)
    ended = np.asarray(flights.observations).copy()
    ended[3, 40:] = np.nan
    found = flown_inputs(policy, flights._replace(observations=ended))
    assert np.isfinite(found[3, :40]).all()
    assert np.isnan(found[3, 40:]).any(axis=-1).all()
    np.testing.assert_allclose(np.delete(found, 3, axis=0), np.delete(wanted, 3, axis=0), atol=2e-5)


def test_the_float_policys_own_memory_is_the_environments(run: TrainedRun) -> None:
    policy = run.float_policy()
    keys = jax.random.split(jax.random.PRNGKey(6), STARTS)
    flights = run.fly_host_policy(
        lambda memory, o: (memory, policy(inputs_in_si(policy, o))), np.zeros((STARTS, 0), int), keys
    )
    inputs = inputs_in_si(policy, np.asarray(flights.observations))
    memory = policy.initial_memory(STARTS)
    for t in range(Pushed.episode_steps):
        before = memory
        memory, action = policy.step(memory, inputs[:, t, :6])
        np.testing.assert_allclose(before[:, :3], inputs[:, t, 6:9], atol=1e-3)
        np.testing.assert_allclose(memory[:, 3:], inputs[:, t, 9:], atol=1e-5)
        np.testing.assert_allclose(action, policy(inputs[:, t]), atol=1e-3)

"""Off-nominal flights against SciPy, against the nominal world, and on the statistics of what sensors say."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from test_quadrotor import flat, newton_euler

from qrl.algorithm import flights as evaluate
from qrl.algorithm.flights import Flights
from qrl_envs import env, perturbations, task
from qrl_envs.perturbations import Condition, Noise, OffNominal, PerturbedParams

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")

Array = np.ndarray
STEPS, LANES = 40, 512


def quadrotor_task(name: str, **evaluation: float) -> task.QuadrotorTask:
    loaded = task.from_data({"extend": name, "evaluation": evaluation}, name)
    assert isinstance(loaded, task.QuadrotorTask)
    return loaded


HOVER = quadrotor_task("hover")
SHORT = quadrotor_task("hover", duration_s=0.4, tail_s=0.1)
NOMINAL = Condition("")
NOISE = Noise()


class Flown(NamedTuple):
    """Leading axes: lanes, times 0 … STEPS; the last action of each lane is not flown."""

    states: State
    actions: Array


@functools.cache
def flown(condition: Condition) -> Flown:
    """LANES starts of a hover under random actions, the same ones whatever the condition."""
    actions = jax.random.uniform(jax.random.PRNGKey(1), (LANES, STEPS + 1, 4), minval=-1.0, maxval=1.0)
    keys = jax.random.split(jax.random.PRNGKey(0), LANES)
    states = states_of(OffNominal(HOVER, condition).params, keys, actions[:, :-1])
    return Flown(jax.tree.map(np.asarray, states), np.asarray(actions))


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def states_of(params: PerturbedParams, key: jax.Array, actions: jax.Array) -> State:
    """One program for all conditions."""
    world = OffNominal(HOVER, NOMINAL).with_params(params)
    start = world.reset(key)
    _, after = jax.lax.scan(lambda state, a: (now := world.step(state, a), now), start, actions)
    return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), start, after)


def one_noise(**sizes: float) -> Condition:
    return Condition("", noise=Noise(**(dict.fromkeys(Noise._fields, 0.0) | sizes)))


def rotations(observations: Array) -> Array:
    return observations[..., :9].reshape(*observations.shape[:-1], 3, 3)


def test_without_a_difference_it_is_the_tasks_own_world() -> None:
    """Every number of every state, from the same keys."""
    world, key = env.from_task(HOVER), jax.random.PRNGKey(3)
    own = OffNominal(HOVER, NOMINAL)
    theirs, ours = (jax.jit(lambda k, w=w: w.step(w.reset(k), jnp.full(4, 0.3)))(key) for w in (world, own))
    for name in ("obs", "reward", "done"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
    jax.tree.map(np.testing.assert_array_equal, theirs.pipeline_state.x, ours.pipeline_state.x)
    np.testing.assert_allclose(ours.info["sensor_obs"], ours.obs, atol=1e-6)


def test_rk4_flies_the_true_motion() -> None:
    """Tumbling at 9 rad/s for 0.4 s under a thrust that changes every 10 ms: SciPy's, where 10 ms Euler is far off."""
    world, rough = OffNominal(HOVER, Condition("", rk4=True)), OffNominal(HOVER, NOMINAL)

    def tumbling(world: OffNominal) -> State:
        start = world.reset(jax.random.PRNGKey(5))
        lane = start.pipeline_state
        body = lane.x._replace(twist=lane.x.twist._replace(body_rate_rad_s=jnp.array([6.0, -5.0, 4.0])))
        return start.replace(pipeline_state=lane._replace(x=body))

    lane = tumbling(world).pipeline_state
    actions = np.asarray(jax.random.uniform(jax.random.PRNGKey(6), (STEPS, 4), minval=-0.25, maxval=0.25))
    vehicle = jax.tree.map(lambda x: np.asarray(x, np.float64), lane.params.physics)
    exact = flat(jax.tree.map(lambda x: np.asarray(x, np.float64), lane.x))
    for action in actions:
        thrust = 0.667 * 9.81 / 4 + 6.0 * np.asarray(action, np.float64)
        motion = solve_ivp(newton_euler(vehicle, thrust), (0.0, 0.01), exact, rtol=1e-10, atol=1e-12)
        exact = motion.y[:, -1]

    def error(world: OffNominal) -> float:
        fly = jax.jit(lambda s: jax.lax.scan(lambda s, a: (world.step(s, a), None), s, actions)[0])
        end = fly(tumbling(world))
        return float(np.abs(flat(jax.tree.map(np.asarray, end.pipeline_state.x)) - exact).max())

    assert np.linalg.norm(exact[6:9]) > 5.0
    assert error(world) < 1e-4
    assert error(rough) > 0.05


def test_an_action_acts_one_step_late() -> None:
    """What was asked for in a step is flown in the next; hover thrust in the first, as the accelerations show."""
    late, nominal = flown(Condition("", delayed=True)), OffNominal(HOVER, NOMINAL)
    delayed = np.concatenate([np.zeros((LANES, 1, 4), np.float32), late.actions[:, : STEPS - 1]], axis=1)

    @jax.jit
    @jax.vmap
    def fly(key: jax.Array, actions: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda s, a: (now := nominal.step(s, a), now.obs), nominal.reset(key), actions)[1]

    observations = fly(jax.random.split(jax.random.PRNGKey(0), LANES), delayed)
    np.testing.assert_allclose(late.states.obs[:, 1:], observations, atol=1e-5)
    speed_up = np.linalg.norm(np.diff(late.states.obs[:, :2, 12:15], axis=1)[:, 0] + [0, 0, 0.0981], axis=-1)
    np.testing.assert_allclose(speed_up, 0.0981, rtol=1e-4)  # g·dt along body z
    np.testing.assert_allclose(late.states.info["sensor_obs"], late.states.obs, atol=1e-5)


def test_errors_are_gaussian_of_their_sizes() -> None:
    """Each of the twelve axes has its standard deviation and no offset, and none follows from another axis, the step
    before or the lane beside, at five sigmas of the sample; what is seen of the attitude is a rotation still.
    """
    states = flown(Condition("", noise=NOISE)).states
    true, seen = rotations(states.obs), rotations(states.info["sensor_obs"])
    np.testing.assert_allclose(seen @ seen.swapaxes(-1, -2), np.broadcast_to(np.eye(3), seen.shape), atol=2e-6)
    assert np.linalg.det(seen).min() > 0.99
    off = Rotation.from_matrix((true.swapaxes(-1, -2) @ seen).reshape(-1, 3, 3)).as_rotvec()  # about the body's axes
    errors = np.concatenate(
        [(states.info["sensor_obs"] - states.obs)[..., 9:], off.reshape(*seen.shape[:2], 3)], axis=-1
    )
    scaled = errors.astype(np.float64) / np.repeat([0.01, 0.02, 0.02, 0.01], 3)
    n = LANES * (STEPS + 1)
    assert np.abs(scaled.mean(axis=(0, 1))).max() < 5 / np.sqrt(n)
    together = np.einsum("lti,ltj->ij", scaled, scaled) / n
    assert np.abs(together - np.eye(12)).max() < 5 * np.sqrt(2 / n)  # a variance's own standard deviation is √2 larger
    for one, other in ((scaled[:, 1:], scaled[:, :-1]), (scaled[1:], scaled[:-1])):
        assert np.abs(np.einsum("lti,ltj->ij", one, other)).max() / n < 5 / np.sqrt(n)
    assert stats.kurtosis(scaled, axis=None) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("name", "part"), [("position_m", 9), ("velocity_m_s", 12), ("body_rate_rad_s", 15)])
def test_each_sensor_has_its_own_error(name: str, part: int) -> None:
    """The others then say what is."""
    states = jax.jit(lambda k: OffNominal(HOVER, one_noise(**{name: 0.5})).reset(k))(jax.random.PRNGKey(0))
    wrong = np.abs(np.asarray(states.info["sensor_obs"] - states.obs)) > 1e-3
    assert set(np.flatnonzero(wrong)) == {part, part + 1, part + 2}


def test_the_true_state_does_not_hear_of_the_noise() -> None:
    """The same actions fly the same; without noise what is seen is what is."""
    nominal, noisy, silent = (flown(c).states for c in (NOMINAL, Condition("", noise=NOISE), one_noise()))
    np.testing.assert_allclose(noisy.obs, nominal.obs, atol=1e-5)
    np.testing.assert_allclose(noisy.reward, nominal.reward, atol=1e-5)
    np.testing.assert_allclose(silent.info["sensor_obs"], nominal.obs, atol=1e-5)


@functools.cache
def fly(condition: Condition) -> Callable[[jax.Array], Flights]:
    """Short flights of a hover under `damped`, by their keys."""
    return jax.jit(lambda keys: evaluate.fly(OffNominal(SHORT, condition), damped, keys, 0))


def keys(n: int) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(0), n)


def damped(observation: jax.Array) -> jax.Array:
    """No pilot: one that shows what it sees of position and rates, and keeps the vehicle near for a while."""
    return 0.05 * observation[..., [9, 10, 15, 16]]


def test_the_policy_sees_the_noise_and_the_measures_do_not() -> None:
    """The actions are off those that the recorded, true observations call for by the noise, and from the first on."""
    flights = jax.tree.map(np.asarray, fly(Condition("", noise=NOISE))(keys(200)))
    called_for = np.asarray(damped(flights.observations[:, :-1]))
    off = (flights.actions - called_for)[(np.abs(called_for) < 0.9).all(-1)] / 0.05
    assert len(off) > 200 * 30
    np.testing.assert_allclose(off.std(axis=0), [0.01, 0.01, 0.02, 0.02], rtol=0.05)
    assert (flights.actions[:, 0] != called_for[:, 0]).all()
    starts = OffNominal(SHORT, NOMINAL).evaluation().env.reset
    np.testing.assert_array_equal(flights.observations[:, 0], jax.jit(jax.vmap(starts))(keys(200)).obs)


def test_noise_is_its_keys_own() -> None:
    """Flown again, and beside others, the same to the last bit."""
    flights, again = fly(Condition("", noise=NOISE))(keys(200)), fly(Condition("", noise=NOISE))(keys(200)[::-1])
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y[::-1]), flights, again)


def test_the_papers_trial_starts_anyhow_but_there() -> None:
    """Its position and velocity; attitudes uniform over SO(3), body rates in the start's ±1 rad/s."""
    trial = OffNominal(HOVER, Condition("", paper_trial=True)).evaluation().env
    start = np.asarray(jax.jit(jax.vmap(trial.reset))(keys(2000)).obs)
    np.testing.assert_allclose(start[:, 9:15] - [-1.58, 0.99, 1.45, -2.39, 6.20, 0.77], 0.0, atol=1e-6)
    assert np.abs(start[:, :9].mean(axis=0)).max() < 5 / np.sqrt(3 * 2000)  # each entry: mean 0, variance 1/3
    np.testing.assert_allclose(start[:, :9].var(axis=0), 1 / 3, atol=0.04)
    assert 0.98 < np.abs(start[:, 15:]).max() <= 1.0
    np.testing.assert_allclose(start[:, 15:].var(axis=0), 1 / 3, atol=0.04)


def test_the_conditions_are_those_that_a_policy_is_judged_by() -> None:
    """Each by itself, and the three together; the trial is a hover's."""
    named = perturbations.conditions(HOVER)
    differs = {name: {f for f in Condition._fields[1:] if getattr(c, f)} for name, c in named.items()}
    assert differs == {
        "rk4": {"rk4"},
        "latency": {"delayed"},
        "noise": {"noise"},
        "together": {"rk4", "delayed", "noise"},
        "trial": {"paper_trial"},
    }
    assert {c.noise for c in named.values() if c.noise} == {Noise(0.01, 0.02, 0.01, 0.02)}
    assert named.keys() - perturbations.conditions(quadrotor_task("circle")).keys() == {"trial"}

"""Classical controllers: where they keep still, from where they recover, against SciPy, and under symmetries."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from brax.envs.base import Env, State
from scipy.spatial.transform import Rotation
from test_quadrotor import newton_euler

from qrl.algorithm import flights as evaluate
from qrl.algorithm.flights import Flights
from qrl_envs import env, measures, quadrotor, symmetry, task
from qrl_envs.controllers import geometric, lqr, mixer
from qrl_envs.quadrotor_env import QuadrotorEnv

Array = np.ndarray
Controller = Callable[[jax.Array], jax.Array]
CONTROLLERS = {"geometric": geometric.controller, "lqr": lqr.controller}
DT_S = 0.01
UPSIDE_DOWN = 0  # among the starts


def quadrotor_task(name: str, **changes: object) -> task.QuadrotorTask:
    loaded = task.from_data({"extend": name, **changes}, name)
    assert isinstance(loaded, task.QuadrotorTask)
    return loaded


HOVER, CIRCLE = quadrotor_task("hover"), quadrotor_task("circle")
HEAVY = {  # another vehicle altogether: twice the mass and thrust, half as long again
    "mass_kg": 2 * 0.667,
    "inertia_kg_m2": [4.5 * 0.0023, 4.5 * 0.0025, 4.5 * 0.0037],
    "motors": [
        {"position_m": [1.5 * x for x in motor.position_m], "spin": motor.spin, "max_N": 16.0}
        for motor in HOVER.vehicle.motors
    ],
    "action_scale_N": 12.0,
}


def begin(world: Env, keys: jax.Array) -> State:
    """The evaluation's starts, but for one that is exactly upside down and at rest."""
    state = jax.vmap(world.reset)(keys)
    lane = state.pipeline_state
    (position, attitude), (velocity, rate) = lane.x
    attitude = attitude.at[UPSIDE_DOWN].set(jnp.array([0.0, 1.0, 0.0, 0.0]))
    body = quadrotor.Body(
        quadrotor.Pose(position, attitude),
        quadrotor.Twist(velocity.at[UPSIDE_DOWN].set(0.0), rate.at[UPSIDE_DOWN].set(0.0)),
    )
    return state.replace(pipeline_state=lane._replace(x=body), obs=jax.vmap(quadrotor.observe)(body))


def flyer(what: task.QuadrotorTask, controller: Controller) -> Callable[[jax.Array], Flights]:
    return jax.jit(lambda keys: evaluate.fly(env.from_task(what), controller, keys, 0, begin))


def keys(n: int) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(3), n)


@functools.cache
def recovered(name: str) -> Flights:
    what = {"hover": HOVER, "circle": CIRCLE, "heavy": quadrotor_task("hover", vehicle=HEAVY)}[name]
    n = {"hover": 201, "circle": 24, "heavy": 24}[name]
    return jax.tree.map(np.asarray, flyer(what, geometric.controller(what))(keys(n)))


@functools.cache
def motion(name: str) -> lqr.LinearModel:
    return lqr.linearize({"hover": HOVER, "circle": CIRCLE}[name])


@functools.cache
def regulator(name: str) -> Array:
    return lqr.gain(motion(name), *lqr.weights({"hover": HOVER, "circle": CIRCLE}[name]))


@functools.cache
def controller(kind: str, name: str) -> Controller:
    if kind == "lqr":
        return jax.jit(lqr.state_feedback(motion(name).trim, regulator(name).astype(np.float32)))
    return jax.jit(geometric.controller({"hover": HOVER, "circle": CIRCLE}[name]))


def level(position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, *position_m, 0, 0, 0, 0, 0, 0], np.float32)


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_in_hover_the_action_is_hover_thrust(kind: str) -> None:
    """To the last bit of the thrust; and 10 cm off it is not, or nothing here would mean anything."""
    still = quadrotor.thrust_N(quadrotor.physics(HOVER.vehicle), controller(kind, "hover")(level()))
    np.testing.assert_array_equal(still, quadrotor.physics(HOVER.vehicle).hover_thrust_N)
    assert np.abs(controller(kind, "hover")(level((0.0, 0.0, -0.1)))).max() > 0.01


def test_geometric_hovers_from_anywhere() -> None:
    """Also from exactly upside down; to 0 mm."""
    measures = recovered("hover").measures
    assert measures["success"].all()
    assert np.median(measures["settle_s"]) < 1.0
    assert measures["settle_s"].max() < 5.0
    assert measures["rms_position_m"].max() < 1e-5


def test_geometric_circles_from_anywhere() -> None:
    """The bar is 5 mm; `_acceleration` without its half step would be 3 mm farther off."""
    measures = recovered("circle").measures
    assert measures["success"].all()
    assert measures["rms_radius_m"].max() < 2e-3
    assert measures["rms_height_m"].max() < 1e-3
    assert measures["rms_speed_m_s"].max() < 7e-3


def test_another_vehicle_flies_with_the_same_gains() -> None:
    measures = recovered("heavy").measures
    assert measures["success"].all()
    assert np.median(measures["settle_s"]) < 1.5
    assert measures["rms_position_m"].max() < 1e-5


def observations(n: int) -> Array:
    rng = np.random.default_rng(0)
    turns = Rotation.random(n, random_state=1).as_matrix().reshape(n, 9)
    rest = rng.uniform(-1, 1, (n, 9)) * np.repeat([1.5, 2.0, 3.0], 3)
    return np.concatenate([turns, rest], axis=1).astype(np.float32)


@pytest.mark.parametrize(("kind", "name"), [("geometric", "hover"), ("geometric", "circle"), ("lqr", "hover")])
def test_controllers_are_equivariant(kind: str, name: str) -> None:
    """Under the symmetries of task and vehicle: axes, motors and signs are right."""
    physics, draw = quadrotor.physics(HOVER.vehicle), getattr(symmetry, name)
    seen = observations(64)
    answer = np.asarray(controller(kind, name)(seen))
    u = np.random.default_rng(1).uniform(size=(8, 2)).astype(np.float32)
    found = jax.tree.map(np.asarray, jax.jit(jax.vmap(draw, (None, 0)))(physics, u))
    for G, P in zip(*found, strict=True):
        difference = np.abs(controller(kind, name)(seen @ G.T) - answer @ P.T)
        assert np.quantile(difference, 0.95) < 1e-3  # rounding matters where motors saturate
    assert answer.std(axis=0).min() > 0.1


def test_lqr_on_the_circle_knows_no_phase() -> None:
    """The world turned about z by any angle: the same action."""
    physics, seen = quadrotor.physics(HOVER.vehicle), observations(64)
    answer = controller("lqr", "circle")(seen)
    for angle in (0.1, 0.4, 0.8):
        turn = symmetry.circle(physics, jnp.array([0.0, angle]))
        np.testing.assert_allclose(
            controller("lqr", "circle")(seen @ np.asarray(turn.observation).T), answer, atol=5e-3
        )


def stepped(trim: lqr.Trim, circling: bool, error: Array, action: Array) -> Array:
    """The error [12] after a step of the world, by SciPy, in float64; `action` [4] is added to the trim's."""
    position, velocity, turn, rate = np.split(error, 4)
    p, v, q, w, a = (np.asarray(x, np.float64) for x in trim)
    attitude = Rotation.from_quat(np.roll(q, -1)) * Rotation.from_rotvec(turn)
    thrust = 0.667 * 9.81 / 4 + 6.0 * (a + action)
    flat = np.concatenate([p + position, v + velocity, w + rate, attitude.as_matrix().ravel()])
    change = newton_euler(HOVER.vehicle, thrust)(0.0, flat)
    velocity, rate = v + velocity + DT_S * change[3:6], w + rate + DT_S * change[6:9]
    # A quaternion q + dt/2·q⊗ω, normalized, turns by 2·atan(dt/2·|ω|) about ω.
    by = 2.0 * np.arctan(DT_S / 2 * np.linalg.norm(rate)) * rate / max(np.linalg.norm(rate), 1e-12)
    position, attitude = p + position + DT_S * velocity, attitude * Rotation.from_rotvec(by)
    if circling:
        back = Rotation.from_euler("z", -np.arctan2(position[1], position[0]))
        position, velocity, attitude = back.apply(position), back.apply(velocity), back * attitude
    off = (Rotation.from_quat(np.roll(q, -1)).inv() * attitude).as_rotvec()
    return np.concatenate([position - p, velocity - v, off, rate - w])


@pytest.mark.parametrize("name", ["hover", "circle"])
def test_lqr_is_scipys_of_finite_differences(name: str) -> None:
    """The trim is a fixed point; a step's numerical derivatives, the gain from them, and a stable loop."""
    linear, circling, h = motion(name), name == "circle", 1e-5
    kept = np.delete(np.arange(12), [1] if circling else [])
    step = functools.partial(stepped, linear.trim, circling)
    np.testing.assert_allclose(step(np.zeros(12), np.zeros(4))[kept], 0.0, atol=2e-6)
    derivative = np.stack(
        [(step(e[:12], e[12:]) - step(-e[:12], -e[12:]))[kept] / (2 * h) for e in h * np.eye(16)], axis=1
    )
    a, b = derivative[:, kept], derivative[:, 12:]
    np.testing.assert_allclose(linear.a, a, atol=1e-4)
    np.testing.assert_allclose(linear.b, b, atol=1e-4)
    q, r = lqr.weights({"hover": HOVER, "circle": CIRCLE}[name])
    cost = scipy.linalg.solve_discrete_are(a, b, q, r)
    np.testing.assert_allclose(regulator(name), np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a), atol=5e-3)
    assert np.abs(np.linalg.eigvals(a - b @ regulator(name))).max() < 0.99
    assert np.abs(np.linalg.eigvals(a)).max() > 0.9999


@pytest.mark.parametrize("name", ["hover", "circle"])
def test_lqr_stabilizes_six_motors(name: str) -> None:
    vehicle = {"mass_kg": 1.3, "inertia_kg_m2": [0.012, 0.014, 0.02], "action_scale_N": 3.0}
    places = [(0.25 * np.cos(angle), 0.25 * np.sin(angle)) for angle in np.pi / 3 * np.arange(6)]
    motors = [{"position_m": [*place], "spin": (-1) ** i, "max_N": 6.0} for i, place in enumerate(places)]
    six = quadrotor_task(name, vehicle={**vehicle, "motors": motors})
    model = lqr.linearize(six)
    gain = lqr.gain(model, *lqr.weights(six))
    assert gain.shape == (6, len(model.a))
    assert (
        np.abs(np.linalg.eigvals(model.a - model.b @ gain)).max()
        < 1.0
        < np.abs(np.linalg.eigvals(model.a)).max() + 1e-3
    )


def test_weights_are_the_tasks() -> None:
    """Of the circle: distance, chi = r·vy − 2 by radius and speed; half a turn and an action count as 2 m do."""
    q, r = lqr.weights(CIRCLE)
    np.testing.assert_allclose(np.diag(q), [1 + 0.5 * 4, 1, 0, 0.5, 0, *[4 / np.pi**2] * 3, 0, 0, 0])
    assert q[0, 3] == q[3, 0] == pytest.approx(0.5 * 2)
    np.testing.assert_allclose(r, 4 * np.eye(4))
    q, r = lqr.weights(HOVER)
    np.testing.assert_allclose(np.diag(q), [0.2] * 3 + [0] * 3 + [0.2 * 4 / np.pi**2] * 3 + [0] * 3)
    np.testing.assert_allclose(r, 0.8 * np.eye(4))


def wrench(thrust: Array) -> Array:
    """Lift and torque of four thrusts, from the vehicle's geometry."""
    x, y = np.array([motor.position_m for motor in HOVER.vehicle.motors]).T
    spin = np.array([motor.spin for motor in HOVER.vehicle.motors])
    return np.array([thrust.sum(), (y * thrust).sum(), -(x * thrust).sum(), 0.016 * (spin * thrust).sum()])


@pytest.mark.parametrize(
    ("asked", "lift_error_N", "given"),
    [
        ((2.0, 0.1, -0.2, 0.01), 0.0, (2.0, 0.1, -0.2, 0.01)),  # all of it
        ((100.0, 0.0, 0.0, 0.0), 0.0, (24.0, 0.0, 0.0, 0.0)),  # what there is
        ((24.0, 0.3, 0.0, 0.0), 0.0, (24.0, 0.0, 0.0, 0.0)),  # no lift to spare for torque
        ((24.0, 0.3, 0.0, 0.0), 5.0, (24.0 - 0.3 / 0.07425, 0.3, 0.0, 0.0)),  # some
        ((24.0, 0.3, 0.0, 0.0), 2.0, (22.0, 2 * 0.07425, 0.0, 0.0)),  # and no more
        ((0.0, 0.2, 0.0, 1.0), 0.0, (0.0, 0.2, 0.0, 0.016 * (4 * 1.635675 - 0.2 / 0.07425))),  # heading last
    ],
)
def test_motors_do_what_they_can(asked: tuple[float, ...], lift_error_N: float, given: tuple[float, ...]) -> None:
    """Lift above hover [N], torque about x, y, z [N m]: asked of the mixer, and given by the thrusts it commands."""
    motors = mixer.mixer(HOVER.vehicle)
    action = np.asarray(mixer.action(motors, jnp.float32(asked[0]), jnp.asarray(asked[1:]), lift_error_N), np.float64)
    got = wrench(0.667 * 9.81 / 4 + 6.0 * action)
    np.testing.assert_allclose(got - [0.667 * 9.81, 0, 0, 0], given, atol=2e-3)


def test_failures_are_those_that_fail_again() -> None:
    """Of the LQR's flights: listed with the start that it was; flown alone, in another order, each fails again."""
    n = 96
    fly = flyer(HOVER, lqr.state_feedback(motion("hover").trim, regulator("hover").astype(np.float32)))
    flights = jax.tree.map(np.asarray, fly(keys(n)))
    found = measures.list_failures(HOVER, flights.observations, flights.measures["success"], 50)
    index = [each["start"] for each in found]
    assert 2 <= len(index) < n / 2
    assert index == list(np.flatnonzero(flights.measures["success"] == 0))
    alone = jnp.resize(keys(n)[np.array([i for i in index if i != UPSIDE_DOWN])], keys(n).shape)
    again = jax.tree.map(np.asarray, fly(alone)).measures["success"]
    assert not again[1:].any()  # the first is turned upside down
    for each in found:
        start = flights.observations[each["start"], 0]
        np.testing.assert_allclose(each["position_m"], start[9:12])
        assert each["speed_m_s"] == pytest.approx(np.sqrt((start[12:15] ** 2).sum()))
        assert np.cos(np.radians(each["tilt_deg"])) == pytest.approx(start[8], abs=1e-5)
    assert len(measures.list_failures(HOVER, flights.observations, flights.measures["success"], 1)) == 1


@pytest.mark.parametrize(
    ("part", "last", "reason"),
    [(12, 40.0, "too far"), (15, 99.0, "tumbled"), (None, 0.0, "did not settle")],
)
def test_why_a_flight_failed(part: int | None, last: float, reason: str) -> None:
    flight = np.tile(level((19.7, 0.0, 0.0) if part == 12 else (1.0, 0.0, 0.0)), (6, 1))
    if part:
        flight[3, part], flight[4:] = last, np.nan
    (found,) = measures.list_failures(HOVER, flight[None], np.zeros(1), 5)
    assert found["reason"] == reason
    assert isinstance(env.from_task(HOVER), QuadrotorEnv)

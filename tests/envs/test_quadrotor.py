"""The quadrotor against rigid-body mechanics written apart in NumPy and SciPy, in float64; rotations included."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from qrl_envs import integrate, quadrotor, rotation, task
from qrl_envs.quadrotor import Body, Disturbance, Physics, Pose, Twist
from qrl_envs.vehicle import Motor, Vehicle

Array = np.ndarray

HOVER = task.load("hover")
assert isinstance(HOVER, task.QuadrotorTask)
PAPERS = HOVER.vehicle
GRAVITY = 9.81
UP = np.array([0.0, 0.0, 1.0])
NOTHING, NO_PUSH = np.zeros(3), np.zeros(6)
FRONT_LEFT, REAR_LEFT, REAR_RIGHT, FRONT_RIGHT = range(4)

# Nothing equal, nothing symmetric: a swapped index or sign shows.
CROOKED = Vehicle(
    mass_kg=0.7,
    inertia_kg_m2=(0.002, 0.003, 0.004),
    motors=(
        Motor(position_m=(0.11, 0.07), spin=1, max_N=5.0),
        Motor(position_m=(-0.09, 0.06), spin=-1, max_N=4.0),
        Motor(position_m=(-0.13, -0.08), spin=1, max_N=3.5),
        Motor(position_m=(0.05, -0.12), spin=-1, max_N=3.0),
    ),
    yaw_moment_m=0.016,
    action_scale_N=6.0,
)


# As crooked, and with motors that tilt and stand at different heights, and products of inertia.
TILTED = Vehicle(
    mass_kg=0.7,
    inertia_kg_m2=(0.002, 0.003, 0.004, 0.0002, -0.0003, 0.0001),
    motors=(
        Motor(position_m=(0.11, 0.07, 0.01), axis=(0.1, 0.2, 2.0), spin=1, max_N=5.0),
        Motor(position_m=(-0.09, 0.06, -0.02), axis=(0.1, -0.1, 1.0), spin=-1, max_N=4.0, min_N=0.1),
        Motor(position_m=(-0.13, -0.08, 0.03), axis=(-0.2, 0.0, 1.0), spin=1, max_N=3.5),
        Motor(position_m=(0.05, -0.12), axis=(0.0, 0.1, 0.9), spin=-1, max_N=3.0),
        Motor(position_m=(0.0, 0.15), spin=-1, max_N=3.0),
        Motor(position_m=(0.02, -0.14), spin=1, max_N=3.0),
    ),
    yaw_moment_m=0.016,
    action_scale_N=6.0,
)


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


def physics(vehicle: Vehicle) -> Physics:
    """The vehicle's parameters in double precision, its gravity rounded to the float32 that the world flies with."""
    return jax.tree.map(lambda x: x.astype(jnp.float64), quadrotor.physics(vehicle))


def hover_thrusts(vehicle: Vehicle) -> Array:
    """The thrusts that carry the weight without torque, by the balance of forces and moments."""
    rows = [(1.0, m.position_m[1], -m.position_m[0], vehicle.yaw_moment_m * m.spin) for m in vehicle.motors]
    return np.linalg.solve(np.array(rows).T, [vehicle.mass_kg * GRAVITY, 0.0, 0.0, 0.0])


def bodies(rng: np.random.Generator, n: int, speed: float = 2.0, rate: float = 5.0) -> Body:
    """n random states, leading axis n."""
    q = Rotation.random(n, rng=rng).as_quat(scalar_first=True)
    return Body(
        Pose(rng.normal(size=(n, 3)), q), Twist(speed * rng.normal(size=(n, 3)), rate * rng.normal(size=(n, 3)))
    )


def one(body: Body, i: int = 0) -> Body:
    return jax.tree.map(lambda x: x[i], body)


def to_world(q: Array) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


derivatives = jax.jit(jax.vmap(quadrotor.derivative, in_axes=(None, 0, 0, None)))
step = jax.jit(quadrotor.step)
products = jax.jit(jax.vmap(rotation.product))
matrices = jax.jit(jax.vmap(rotation.matrix))


@jax.jit
def fly_euler(physics: Physics, body: Body, thrust: Array, dt_s: float, steps: int) -> Body:
    """`steps` control periods as the world takes them."""
    return jax.lax.fori_loop(0, steps, lambda _, b: quadrotor.step(physics, b, thrust, dt_s), body)


@jax.jit
def fly_midpoint(physics: Physics, body: Body, thrust: Array, dt_s: float, steps: int) -> Body:
    """As the plant of real vehicles takes them."""

    def rate(body: Body) -> Body:
        return quadrotor.derivative(physics, body, thrust)

    return jax.lax.fori_loop(0, steps, lambda _, b: integrate.midpoint(rate, rate, b, dt_s), body)


Integrator = Callable[[Physics, Body, Array, float, int], Body]
each_integrator = pytest.mark.parametrize(
    ("fly", "order"), [(fly_euler, 1), (fly_midpoint, 2)], ids=["euler", "midpoint"]
)


def momentum_and_energy(vehicle: Physics, body: Body) -> Array:
    """World-frame angular momentum [3] and rotational plus translational plus potential energy."""
    inertia, rate = np.asarray(vehicle.inertia_kg_m2), np.asarray(body.twist.body_rate_rad_s)
    mass, v = float(vehicle.mass_kg), np.asarray(body.twist.velocity_m_s)
    height = float(body.pose.position_m[2])
    q = np.asarray(body.pose.attitude)
    energy = 0.5 * rate @ (inertia * rate) + 0.5 * mass * v @ v + mass * float(vehicle.gravity_m_s2) * height
    return np.append(to_world(q).apply(inertia * rate), energy)


def newton_euler(
    vehicle: Vehicle,
    thrust: Array,
    drag: Array = NOTHING,
    push: Array = NO_PUSH,
    wind: Array = NOTHING,
    height_m: float = 0.0,
) -> Callable[[float, Array], Array]:
    """The equations of motion, written apart: r × F for each motor, and the attitude as a rotation matrix.

    State [18]: position, velocity, body rates, rotation matrix. `push`: a force, world, and a torque, body.
    """
    force, moment = np.zeros(3), push[3:].copy()
    for motor, pull in zip(vehicle.motors, thrust, strict=True):
        axis = np.array(motor.axis) / np.linalg.norm(motor.axis)
        arm = np.resize([*motor.position_m, 0.0], 3)
        force += pull * axis
        moment += np.cross(arm, pull * axis) + motor.spin * vehicle.yaw_moment_m * pull * axis
    xx, yy, zz, xy, xz, yz = np.resize([*vehicle.inertia_kg_m2, 0.0, 0.0, 0.0], 6)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    gravity = float(np.float32(GRAVITY))

    def rate_of_change(_: float, x: Array) -> Array:
        velocity, w, to_world = x[3:6], x[6:9], x[9:].reshape(3, 3)
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        air = to_world.T @ (velocity - wind)
        acceleration = (to_world @ (force - drag * air) + push[:3]) / vehicle.mass_kg - gravity * UP
        from_drag = np.cross([0.0, 0.0, height_m], -drag * air)
        w_dot = np.linalg.solve(inertia, moment + from_drag - np.cross(w, inertia @ w))
        return np.concatenate([velocity, acceleration, w_dot, (to_world @ skew).ravel()])

    return rate_of_change


def flat(body: Body) -> Array:
    """[18]: position, velocity, body rates, rotation matrix."""
    rotation_matrix = to_world(np.asarray(body.pose.attitude)).as_matrix().ravel()
    return np.concatenate([body.pose.position_m, *body.twist, rotation_matrix])


def fitted_order(errors: list[float], steps: list[int]) -> float:
    """The slope of log error over log step size."""
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


@each_integrator
def test_order_of_convergence(fly: Integrator, order: int) -> None:
    """Error after 0.4 s under uneven thrust, against SciPy on the equations written apart, for halved steps."""
    vehicle, thrust = physics(CROOKED), np.array([1.9, 1.6, 1.8, 1.7])
    start = one(bodies(np.random.default_rng(0), 1))
    exact = solve_ivp(
        newton_euler(CROOKED, thrust), (0.0, 0.4), flat(start), method="DOP853", rtol=1e-12, atol=1e-12
    ).y[:, -1]
    steps = [80, 160, 320, 640]
    errors = [float(np.linalg.norm(flat(fly(vehicle, start, thrust, 0.4 / n, n)) - exact)) for n in steps]
    assert fitted_order(errors, steps) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize(
    ("fly", "order", "steps"),
    [(fly_euler, 1, [400, 800, 1600]), (fly_midpoint, 2, [400, 800, 1600])],
    ids=["euler", "midpoint"],
)
def test_torque_free_motion_keeps_momentum_and_energy(fly: Integrator, order: int, steps: list[int]) -> None:
    """In free fall, world-frame angular momentum and energy: what is lost in 1 s vanishes as the order says."""
    vehicle, thrust = physics(CROOKED), np.zeros(4)
    start = one(bodies(np.random.default_rng(1), 1, rate=8.0))
    before = momentum_and_energy(vehicle, start)
    after = [momentum_and_energy(vehicle, fly(vehicle, start, thrust, 1.0 / n, n)) for n in steps]
    momentum_error = [float(np.linalg.norm(x[:3] - before[:3]) / np.linalg.norm(before[:3])) for x in after]
    energy_error = [abs(x[3] / before[3] - 1.0) for x in after]
    for error in (momentum_error, energy_error):
        assert error[0] < 0.05
        assert error[-1] > 1e-13
        assert fitted_order(error, steps) > order - 0.15


@pytest.mark.parametrize("spec", [CROOKED, TILTED], ids=["crooked", "tilted"])
def test_derivative_is_newton_euler(spec: Vehicle) -> None:
    """In 50 random states under random thrusts, drag above the center of mass, wind, push: all 18 rates."""
    rng = np.random.default_rng(2)
    vehicle, body = physics(spec), bodies(rng, 50)
    thrust = rng.uniform(0.0, 5.0, size=(50, len(spec.motors)))
    drag, wind, push = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 0.5]), 0.1 * np.arange(1.0, 7.0)
    ours = derivatives(vehicle, body, thrust, Disturbance(drag, wind, push[:3], push[3:], np.float64(0.02)))
    for i in range(50):
        expected = newton_euler(spec, thrust[i], drag, push, wind, 0.02)(0.0, flat(one(body, i)))
        np.testing.assert_allclose(ours.pose.position_m[i], expected[:3], atol=1e-12)
        np.testing.assert_allclose(ours.twist.velocity_m_s[i], expected[3:6], rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(
            ours.twist.body_rate_rad_s[i], expected[6:9], rtol=1e-6, atol=1e-4
        )  # parameters are float32


@pytest.mark.parametrize("yaw", np.linspace(-np.pi, np.pi, 9))
def test_hover_thrust_holds_a_level_vehicle_still_at_any_yaw(yaw: float) -> None:
    """F_o on each motor: no acceleration, and a step changes nothing; so does the action zero."""
    vehicle = physics(PAPERS)
    thrust = np.asarray(quadrotor.thrust_N(vehicle, jnp.zeros(4)))
    np.testing.assert_allclose(thrust, 0.667 * GRAVITY / 4, rtol=1e-7)
    q = Rotation.from_euler("z", yaw).as_quat(scalar_first=True)
    level = Body(Pose(np.array([1.0, 2.0, 3.0]), q), Twist(np.zeros(3), np.zeros(3)))
    rates = derivatives(vehicle, jax.tree.map(lambda x: x[None], level), thrust[None], None)
    # F_o is rounded to the float32 that the world flies with.
    np.testing.assert_allclose(np.concatenate(jax.tree.leaves(rates), axis=-1), 0.0, atol=1e-6)
    after = step(vehicle, level, thrust, 0.01)
    np.testing.assert_allclose(flat(after), flat(level), atol=1e-8)


@pytest.mark.parametrize("motor", range(4))
def test_one_motors_torque_is_r_cross_f_and_its_reaction(motor: int) -> None:
    """At rest: J·dω/dt = r × F + spin·yaw_moment·F about body z, whatever the attitude."""
    vehicle, body = physics(CROOKED), bodies(np.random.default_rng(3), 1, rate=0.0)
    force = 2.5
    thrust = np.eye(4)[[motor]] * force
    x, y = CROOKED.motors[motor].position_m[:2]
    reaction = CROOKED.motors[motor].spin * 0.016 * force
    torque = np.cross([x, y, 0.0], [0.0, 0.0, force]) + reaction * UP
    ours = derivatives(vehicle, body, thrust, None).twist.body_rate_rad_s[0] * np.array(CROOKED.inertia_kg_m2)
    np.testing.assert_allclose(ours, torque, rtol=1e-6)


@pytest.mark.parametrize(
    ("motor", "forward", "left", "yaw"),
    [(FRONT_LEFT, -1, -1, 1), (REAR_LEFT, 1, -1, -1), (REAR_RIGHT, 1, 1, 1), (FRONT_RIGHT, -1, 1, -1)],
)
def test_a_stronger_motor_tips_the_vehicle_away_from_it(motor: int, forward: int, left: int, yaw: int) -> None:
    """More thrust at the front left lifts that corner: off to the rear right, and turning with its spin's reaction."""
    vehicle = physics(PAPERS)
    thrust = np.asarray(quadrotor.thrust_N(vehicle, 0.02 * jnp.eye(4)[motor]))
    level = Body(Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), Twist(np.zeros(3), np.zeros(3)))
    after = fly_euler(vehicle, level, thrust, 0.01, 20)
    x, y = PAPERS.motors[motor].position_m[:2]
    corner = to_world(np.asarray(after.pose.attitude)).apply([x, y, 0.0])
    assert corner[2] > 0
    assert np.sign(after.pose.position_m[0]) == forward
    assert np.sign(after.pose.position_m[1]) == left
    assert np.sign(after.twist.body_rate_rad_s[2]) == yaw
    assert np.sign(to_world(np.asarray(after.pose.attitude)).as_euler("ZYX")[0]) == yaw


def test_free_fall_is_a_parabola_while_the_vehicle_tumbles() -> None:
    """Exactly, for each integrator: p0 + v0·t − g·t²/2, Euler's with t² replaced by t·(t + dt)."""
    vehicle, start = physics(CROOKED), one(bodies(np.random.default_rng(4), 1))
    p, v, _ = flat(start).reshape(6, 3)[:3]
    g, dt, steps = float(vehicle.gravity_m_s2), 0.01, 100
    t = dt * steps
    euler, midpoint = (fly(vehicle, start, np.zeros(4), dt, steps) for fly in (fly_euler, fly_midpoint))
    for body, drop in ((euler, t * (t + dt) / 2), (midpoint, t**2 / 2)):
        np.testing.assert_allclose(body.pose.position_m, p + v * t - g * drop * UP, atol=1e-12)
        np.testing.assert_allclose(body.twist.velocity_m_s, v - g * t * UP, atol=1e-12)


def test_one_step_moves_the_pose_with_the_new_velocities() -> None:
    """FIELD.md: velocities first, then attitude and position with the new ones; the quaternion stays a unit."""
    vehicle, thrust, dt = physics(CROOKED), np.array([1.9, 1.6, 1.8, 1.7]), 0.01
    before = one(bodies(np.random.default_rng(5), 1))
    after = step(vehicle, before, thrust, dt)
    rates = newton_euler(CROOKED, thrust)(0.0, flat(before))
    velocity, body_rate = before.twist.velocity_m_s + dt * rates[3:6], before.twist.body_rate_rad_s + dt * rates[6:9]
    q = before.pose.attitude
    q_dot = 0.5 * np.append(-q[1:] @ body_rate, q[0] * body_rate + np.cross(q[1:], body_rate))
    turned = q + dt * q_dot
    np.testing.assert_allclose(after.twist.velocity_m_s, velocity, atol=1e-12)
    np.testing.assert_allclose(after.twist.body_rate_rad_s, body_rate, atol=1e-10)
    np.testing.assert_allclose(after.pose.position_m, before.pose.position_m + dt * velocity, atol=1e-12)
    np.testing.assert_allclose(after.pose.attitude, turned / np.linalg.norm(turned), atol=1e-12)


def test_thrust_is_clipped_to_what_each_motor_gives() -> None:
    """F = clip(F_o + 6a, 0, max_N), with a clipped to [−1, 1] first."""
    vehicle = physics(CROOKED)
    action = np.random.default_rng(6).uniform(-2.0, 2.0, size=(200, 4))
    thrust = np.asarray(jax.vmap(quadrotor.thrust_N, in_axes=(None, 0))(vehicle, action))
    limit = np.array([5.0, 4.0, 3.5, 3.0])
    expected = np.minimum(np.maximum(hover_thrusts(CROOKED) + 6.0 * np.minimum(np.maximum(action, -1), 1), 0), limit)
    np.testing.assert_allclose(thrust, expected, atol=1e-6)
    assert (thrust == 0).any()
    assert (thrust == limit).any(axis=0).all()


def test_action_above_one_gives_no_more_than_one() -> None:
    """Where the motors could give more than F_o + 6 N."""
    thrust = quadrotor.thrust_N(physics(PAPERS), jnp.full(4, 1.05))
    np.testing.assert_allclose(thrust, 0.667 * GRAVITY / 4 + 6.0, rtol=1e-6)


def test_applied_action_is_that_of_the_thrust_after_clipping() -> None:
    """a = (F − F_o)/6: the action itself where nothing is clipped, less where it is."""
    vehicle = physics(CROOKED)
    asked = jnp.array([0.3, -1.0, -0.1, 0.9])
    applied = quadrotor.applied_action(vehicle, quadrotor.thrust_N(vehicle, asked))
    offset = hover_thrusts(CROOKED)
    np.testing.assert_allclose(applied, [0.3, -offset[1] / 6, -0.1, (3.0 - offset[3]) / 6], atol=1e-6)


def test_observation_is_designs_18_numbers_in_order() -> None:
    """r11 r12 r13 r21 … r33, px py pz, vx vy vz (world), wx wy wz (body)."""
    body = one(bodies(np.random.default_rng(7), 1))
    matrix = to_world(body.pose.attitude).as_matrix()
    rows = [matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 0], matrix[1, 1], matrix[1, 2], *matrix[2]]
    expected = [*rows, *body.pose.position_m, *body.twist.velocity_m_s, *body.twist.body_rate_rad_s]
    np.testing.assert_allclose(quadrotor.observe(body), expected, atol=1e-14)


@pytest.fixture(scope="module")
def quaternions() -> Array:
    """300 attitudes, some of them at and near the identity and half turns."""
    rng = np.random.default_rng(8)
    near = np.eye(4)[rng.integers(0, 4, size=100)] + 1e-4 * rng.normal(size=(100, 4))
    q = np.concatenate([np.eye(4), -np.eye(4), near, rng.normal(size=(192, 4))])
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_matrix_is_scipys(quaternions: Array) -> None:
    """Its columns are the body axes in the world; q and −q are one attitude."""
    expected = to_world(quaternions).as_matrix()
    np.testing.assert_allclose(matrices(quaternions), expected, atol=1e-14)
    np.testing.assert_allclose(matrices(-quaternions), expected, atol=1e-14)


def test_product_composes_as_scipys_does(quaternions: Array) -> None:
    """p ⊗ q turns by q first; also as quaternions, sign and all."""
    p, q = quaternions, quaternions[::-1]
    both = products(p, q)
    composed = to_world(p) * to_world(q)
    np.testing.assert_allclose(matrices(both), composed.as_matrix(), atol=1e-14)
    scalar = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    vector = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    np.testing.assert_allclose(both, np.column_stack([scalar, vector]), atol=1e-14)


def test_quaternion_derivative_is_the_finite_difference_of_a_turn(quaternions: Array) -> None:
    """Turning at a constant body rate ω: q(t) = q ⊗ exp(ωt), SciPy's, differenced to second order."""
    rate = np.random.default_rng(9).normal(size=quaternions[:, 1:].shape) * 5
    h = 1e-5

    def turned(t: float) -> Array:
        q = (to_world(quaternions) * Rotation.from_rotvec(rate * t)).as_quat(scalar_first=True)
        return q * np.sign(np.sum(q * quaternions, axis=1, keepdims=True))

    ours = jax.vmap(rotation.derivative)(quaternions, rate)
    np.testing.assert_allclose(ours, (turned(h) - turned(-h)) / (2 * h), atol=1e-7)


@pytest.fixture(scope="module")
def attitudes(float64: None) -> Array:
    """Those of 20,000 starts."""
    start = quadrotor.Start(*jnp.ones(3), jnp.float32(np.pi))
    draws = jax.jit(jax.vmap(lambda key: quadrotor.draw(start, key).pose.attitude))
    return np.asarray(draws(jax.random.split(jax.random.key(0), 20_000)))


def test_drawn_attitudes_are_unit_quaternions(attitudes: Array) -> None:
    """To rounding; of either sign."""
    assert (attitudes.min(axis=0) < -0.99).all()
    assert (attitudes.max(axis=0) > 0.99).all()
    np.testing.assert_allclose(np.linalg.norm(attitudes, axis=1), 1.0, atol=1e-14)


def test_drawn_attitudes_prefer_no_direction(attitudes: Array) -> None:
    """The mean rotation matrix is zero within five standard errors (each element has variance 1/3)."""
    mean = to_world(attitudes).as_matrix().mean(axis=0)
    assert np.abs(mean).max() < 5 * np.sqrt(1 / 3 / len(attitudes))


def test_rotation_angles_have_the_haar_density(attitudes: Array) -> None:
    """(1 − cos t)/π on [0, π]: a Kolmogorov–Smirnov test."""
    angles = to_world(attitudes).magnitude()
    assert stats.kstest(angles, lambda t: (t - np.sin(t)) / np.pi).pvalue > 0.01


def test_each_body_axis_is_uniform_on_the_sphere(attitudes: Array) -> None:
    """Archimedes: every coordinate of every axis is uniform on [−1, 1]; Kolmogorov–Smirnov, nine at once."""
    elements = to_world(attitudes).as_matrix().reshape(-1, 9)
    for element in elements.T:
        assert stats.kstest(element, stats.uniform(-1.0, 2.0).cdf).pvalue > 0.01 / 9


def test_tilt_limits_the_starts_evenly() -> None:
    """Within the tilt, uniform over the cap of body-z directions, and with any heading."""
    u = np.random.default_rng(0).uniform(size=(4000, 3))
    q = np.asarray(jax.vmap(rotation.uniform, in_axes=(0, None))(u, 0.5))
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    cosine = R[:, 2, 2]
    assert cosine.min() >= np.cos(0.5) - 1e-12
    assert stats.kstest((cosine - np.cos(0.5)) / (1.0 - np.cos(0.5)), "uniform").pvalue > 1e-3
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    assert stats.kstest((heading + np.pi) / (2.0 * np.pi), "uniform").pvalue > 1e-3


def test_nested_starts_have_ranges_of_their_own() -> None:
    """The same draws, each within the ranges times one factor for all of its coordinates, uniform in [0, 1)."""
    plain = quadrotor.Start(*map(jnp.float32, (1.0, 2.0, 3.0, np.pi)))
    keys = jax.random.split(jax.random.PRNGKey(0), 2000)
    draw = jax.jit(jax.vmap(quadrotor.draw, in_axes=(None, 0)))
    drawn = {
        name: draw(start, keys)
        for name, start in {
            "plain": plain,
            "nested": plain._replace(nested=jnp.float32(1.0)),
            "not": plain._replace(nested=jnp.float32(0.0)),
        }.items()
    }
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), drawn["not"], drawn["plain"])
    factors = np.asarray(drawn["nested"].pose.position_m / drawn["plain"].pose.position_m)
    np.testing.assert_allclose(factors, factors[:, :1] * np.ones(3), rtol=1e-4)
    of_rate = np.asarray(drawn["nested"].twist.body_rate_rad_s / drawn["plain"].twist.body_rate_rad_s)
    np.testing.assert_allclose(of_rate, factors, rtol=1e-3)
    assert stats.kstest(factors[:, 0], "uniform").pvalue > 1e-3
    _, x, y, _ = np.asarray(drawn["nested"].pose.attitude).T
    tilt = np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1))
    assert (tilt <= np.pi * factors[:, 0] + 1e-3).all()
    assert tilt.mean() < 1.0 < tilt.max()

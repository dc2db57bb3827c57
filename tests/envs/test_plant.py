"""The plant of real vehicles against SciPy on equations written apart, and what it draws, senses and remembers."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from test_quadrotor import flat, newton_euler

from qrl.export.policy import BodyFrame
from qrl_envs import noise, plant, quadrotor, rotors, task
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.uncertainty import Uncertainty

Array = np.ndarray
DT_S = 0.01


def real_task(vehicle: str = "crazyflie", **changes: Any) -> task.QuadrotorTask:
    loaded = task.from_data({"extend": "hover", "vehicle": vehicle, **changes}, "here")
    assert isinstance(loaded, task.QuadrotorTask)
    return loaded


def fixed(**values: float) -> Uncertainty:
    return Uncertainty(**{name: (value, value) for name, value in values.items()})


def flown(env: RealQuadrotorEnv, start: Any, actions: Array) -> Any:
    """The lanes' state after the actions [K, N]."""
    return jax.jit(lambda s: jax.lax.scan(lambda s, a: (env.step(s, a), None), s, jnp.asarray(actions))[0])(start)


def exact(spec: task.QuadrotorTask, world: plant.World, body: plant.Body, actions: Array) -> Array:
    """[18] after the actions by SciPy: rotor speeds beside the body, set-points that change `latency_s` late."""
    vehicle, latency = spec.vehicle, float(world.latency_s)
    c = float(world.rotors.curve)
    top = np.array([m.max_N for m in vehicle.motors])
    hover = vehicle.hover_thrusts_N

    def speed_of(thrust: Array) -> Array:
        return (-c + np.sqrt(c * c + 4 * (1 - c) * thrust / top)) / (2 * (1 - c))

    commands = [np.clip(hover + vehicle.action_scale_N * np.clip(a, -1, 1), 0, top) for a in actions]
    changes = [(0.0, speed_of(hover)), *((k * DT_S + latency, speed_of(f)) for k, f in enumerate(commands))]
    end = len(actions) * DT_S
    made = vehicle.model_copy(
        update={
            "mass_kg": float(world.physics.mass_kg),
            "inertia_kg_m2": tuple(float(x) for x in world.physics.inertia_kg_m2),
        }
    )
    d = world.disturbance
    push = np.concatenate([d.force_N, d.torque_N_m])
    x = np.concatenate([flat(body), speed_of(hover)])
    for (begin, set_point), following in zip(changes, [*changes[1:], (end, None)], strict=True):
        stop = min(following[0], end)
        if stop <= begin:
            continue

        def rate(_: float, x: Array, set_point: Array = set_point) -> Array:
            w = x[18:]
            lag = np.where(set_point > w, float(world.rotors.rise_s), float(world.rotors.fall_s))
            thrust = np.asarray(world.motor_factor) * top * (c * w + (1 - c) * w * w)
            motion = newton_euler(made, thrust, np.asarray(d.drag_N_s_m), push, np.asarray(d.wind_m_s))
            return np.concatenate([motion(0.0, x[:18]), (set_point - w) / lag])

        x = solve_ivp(rate, (begin, stop), x, rtol=1e-9, atol=1e-10).y[:, -1]
    return x[:18]


@pytest.mark.parametrize("latency_s", [0.0, 0.004, 0.01, 0.017])
def test_it_flies_as_scipy_says(latency_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of a second of random actions with everything at once, tumbling; and a shorter step is that much nearer,
    as the second order says.
    """
    spec = real_task("cf21_brushless")
    errors = []
    for step_s in (0.01, 0.0025):
        monkeypatch.setattr(plant, "INTEGRATION_STEP_S", step_s)
        env = RealQuadrotorEnv(
            spec,
            Uncertainty(
                mass_factor=(1.2, 1.2),
                inertia_factor=(0.9, 0.9),
                thrust_factor=(0.9, 0.9),
                motor_factor=(0.95, 1.05),
                rotor_lag_factor=(1.5, 1.5),
                force_weights=(0.1, 0.1),
                torque_share=(0.05, 0.05),
                wind_m_s=(2.0, 2.0),
                latency_s=(latency_s, latency_s),
            ),
        )
        start = env.reset(jax.random.PRNGKey(3))
        actions = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 4)).astype(np.float32)
        lane = start.pipeline_state.x
        lane = jax.tree.map(lambda x: np.asarray(x, np.float64), lane)
        end = jax.tree.map(lambda x: np.asarray(x, np.float64), flown(env, start, actions).pipeline_state.x.body)
        errors.append(np.abs(flat(end) - exact(spec, lane.world, lane.body, actions)).max())
    assert errors[0] < 0.02
    assert errors[1] < errors[0] / 6


def test_without_lag_and_disturbance_it_is_the_papers_world_integrated_finely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thrust at once: the error against the equations of motion is that of the integrator."""
    monkeypatch.setattr(plant, "INTEGRATION_STEP_S", 0.001)
    spec = task.load("hover")
    assert isinstance(spec, task.QuadrotorTask)
    env = RealQuadrotorEnv(spec)
    start = env.reset(jax.random.PRNGKey(0))
    actions = np.random.default_rng(1).uniform(-0.25, 0.25, (40, 4)).astype(np.float32)
    x = flat(jax.tree.map(lambda x: np.asarray(x, np.float64), start.pipeline_state.x.body))
    for action in actions:
        thrust = 0.667 * 9.81 / 4 + 6.0 * np.asarray(action, np.float64)
        x = solve_ivp(newton_euler(spec.vehicle, thrust), (0.0, 0.01), x, rtol=1e-10, atol=1e-12).y[:, -1]
    end = flown(env, start, actions).pipeline_state.x.body
    np.testing.assert_allclose(flat(jax.tree.map(np.asarray, end)), x, atol=1e-3)


@pytest.mark.parametrize(("latency_s", "late"), [(0.0, False), (0.004, False), (0.006, True), (0.01, True)])
def test_without_lag_a_latency_counts_to_the_nearest_step(latency_s: float, late: bool) -> None:
    """Up from hover by 2 N a motor: 8 N / 0.667 kg for 10 ms, or nothing yet."""
    spec = task.load("hover")
    assert isinstance(spec, task.QuadrotorTask)
    env = RealQuadrotorEnv(spec, fixed(latency_s=latency_s))
    start = jax.jit(env.reset)(jax.random.PRNGKey(0))
    level = start.pipeline_state.x.body._replace(
        pose=start.pipeline_state.x.body.pose._replace(attitude=jnp.array([1.0, 0.0, 0.0, 0.0])),
        twist=jax.tree.map(jnp.zeros_like, start.pipeline_state.x.body.twist),
    )
    x = start.pipeline_state.x._replace(body=level)
    state = start.replace(pipeline_state=start.pipeline_state._replace(x=x))
    after = jax.jit(env.step)(state, jnp.full(4, 2.0 / 6.0)).pipeline_state.x.body.twist.velocity_m_s
    np.testing.assert_allclose(after, [0.0, 0.0, 0.0 if late else 0.08 / 0.667], atol=1e-4)


@pytest.mark.parametrize(("period_s", "steps"), [(0.002, 1), (0.01, 1), (0.014, 2), (0.02, 2), (0.025, 3)])
def test_a_period_is_integrated_in_steps_of_10_ms_at_most(
    period_s: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    monkeypatch.setattr(plant.integrate, "midpoint", lambda f, g, body, step_s: (made.append(step_s), body)[1])
    spec = real_task("cf21_brushless").model_copy(update={"control_period_s": period_s})
    env = RealQuadrotorEnv(spec)
    jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(4)), jax.random.PRNGKey(0))
    assert made == pytest.approx([period_s / steps] * steps)


@pytest.mark.parametrize("curve", [-0.5, 0.0, 0.3, 1.0])
def test_speed_is_the_inverse_of_thrust(curve: float) -> None:
    """By NumPy's roots; its slope is finite everywhere."""
    fraction = np.linspace(0.01, 1.0, 20)
    speed = np.asarray(rotors.speed_of(jnp.float32(curve), jnp.asarray(fraction, jnp.float32)))
    for w, f in zip(speed, fraction, strict=True):
        candidates = np.roots([1.0 - curve, curve, -f]) if curve < 1.0 else np.array([f])
        assert np.abs(candidates - w).min() < 1e-5
    slope = jax.vmap(jax.grad(lambda f: rotors.speed_of(jnp.float32(curve), f)))(jnp.array([0.0, 1e-7, 0.5, 1.0]))
    assert np.isfinite(slope).all()


def test_draws_fill_their_ranges_and_nothing_else_differs() -> None:
    """Uniform by Kolmogorov and Smirnov, directions over the sphere; what is no range stays."""
    spec = real_task("crazyflie")
    uncertainty = Uncertainty(
        mass_factor=(0.8, 1.1),
        rotor_lag_factor=(0.5, 2.0),
        force_weights=(0.0, 0.2),
        latency_s=(0.0, 0.02),
        body_rate_noise_rad_s=(0.01, 0.03),
    )
    ranges, physics = plant.ranges(uncertainty, spec.vehicle), quadrotor.physics(spec.vehicle)
    u = jnp.asarray(np.random.default_rng(0).random((4000, plant.DRAWS + 4)), jnp.float32)
    world = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda u: plant.draw(ranges, physics, u)))(u))
    weight = 0.03 * 9.81
    for found, low, width in (
        (world.physics.mass_kg / 0.03, 0.8, 0.3),
        (world.rotors.rise_s, 0.036, 0.108),
        (np.linalg.norm(world.disturbance.force_N, axis=1) / weight, 0.0, 0.2),
        (world.latency_s, 0.0, 0.02),
        (world.sensors.noise.body_rate_rad_s, 0.01, 0.02),
    ):
        assert stats.kstest(found, stats.uniform(low, width).cdf).pvalue > 1e-3
    force = world.disturbance.force_N / np.linalg.norm(world.disturbance.force_N, axis=1, keepdims=True)
    for axis in force.T:
        assert stats.kstest(axis, stats.uniform(-1.0, 2.0).cdf).pvalue > 1e-3
    np.testing.assert_array_equal(world.physics.inertia_kg_m2, np.tile(physics.inertia_kg_m2, (4000, 1)))
    np.testing.assert_array_equal(world.motor_factor, 1.0)
    np.testing.assert_array_equal(world.sensors.noise.position_m, 0.0)
    np.testing.assert_array_equal(world.rotors.rise_s, world.rotors.fall_s)


def test_no_draw_has_less_thrust_than_it_can_fly_with() -> None:
    """Thrust of LEAST_THRUST of weight and force; a vehicle with less of its own keeps what it has."""
    heavy = Uncertainty(mass_factor=(1.0, 3.0), thrust_factor=(0.7, 1.0), force_weights=(0.0, 0.3))
    u = jnp.asarray(np.random.default_rng(0).random((500, plant.DRAWS + 4)), jnp.float32)
    for name, least in (("crazyflie", 1.45), ("weak", 1.2)):
        spec = real_task("crazyflie")
        vehicle = spec.vehicle
        if name == "weak":
            mass_kg = vehicle.total_thrust_N / 1.2 / 9.81
            vehicle = vehicle.model_copy(update={"mass_kg": mass_kg})
        ranges, physics = plant.ranges(heavy, vehicle), quadrotor.physics(vehicle)
        world = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda u: plant.draw(ranges, physics, u)))(u))  # noqa: B023
        thrust = (world.motor_factor * np.asarray(physics.motor_max_N)).sum(axis=1)
        needed = 9.81 * world.physics.mass_kg + np.linalg.norm(world.disturbance.force_N, axis=1)
        assert (thrust / needed).min() == pytest.approx(least, rel=1e-3)


def test_sensors_err_by_their_sizes() -> None:
    """Each of the twelve axes has its standard deviation, and none follows from another axis or the step before; what
    is seen of the attitude is a rotation still; a bias stays.
    """
    sizes = {
        "position_noise_m": 0.01,
        "velocity_noise_m_s": 0.02,
        "attitude_noise_rad": 0.01,
        "body_rate_noise_rad_s": 0.02,
    }
    env = RealQuadrotorEnv(real_task("crazyflie"), fixed(**sizes))
    lanes, steps = 256, 40

    @jax.jit
    @jax.vmap
    def fly(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(s: Any, _: None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            s = env.step(s, jnp.zeros(4))
            return s, (s.obs[:18], s.info["true_obs"])

        return jax.lax.scan(step, env.reset(key), None, length=steps)[1]

    seen, true = (np.asarray(x) for x in fly(jax.random.split(jax.random.PRNGKey(0), lanes)))
    matrices = [x[..., :9].reshape(lanes, steps, 3, 3) for x in (true, seen)]
    identity = np.broadcast_to(np.eye(3), matrices[1].shape)
    np.testing.assert_allclose(matrices[1] @ matrices[1].swapaxes(-1, -2), identity, atol=3e-6)
    off = Rotation.from_matrix((matrices[0].swapaxes(-1, -2) @ matrices[1]).reshape(-1, 3, 3)).as_rotvec()
    errors = np.concatenate([(seen - true)[..., 9:], off.reshape(lanes, steps, 3)], axis=-1)
    scaled = errors / np.repeat([0.01, 0.02, 0.02, 0.01], 3)
    n = lanes * steps
    # The table of noise has 4,096 rows, of which several flights see the same: six sigmas of so many.
    bound = 6 / np.sqrt(noise.ROWS)
    assert np.abs(scaled.mean(axis=(0, 1))).max() < bound
    together = np.einsum("lti,ltj->ij", scaled, scaled) / n
    assert np.abs(together - np.eye(12)).max() < np.sqrt(2) * bound
    assert np.abs(np.einsum("lti,ltj->ij", scaled[:, 1:], scaled[:, :-1])).max() / n < bound
    assert np.abs(np.einsum("lti,ltj->ij", scaled[1:], scaled[:-1])).max() / n < bound


def test_memory_is_what_a_literal_loop_says() -> None:
    """The action applied before, and the integral of the measured position, which hardly counts far away."""
    spec = real_task("crazyflie", start={"position_m": 0.4, "velocity_m_s": 0.5, "body_rate_rad_s": 0.1})
    env = RealQuadrotorEnv(spec, fixed(position_noise_m=0.01))
    state, step = jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.jit(env.step)
    integral, previous, rng = np.zeros(3), np.zeros(4), np.random.default_rng(0)
    radius, limit = 0.5, 0.6
    spread = []
    for _ in range(40):
        seen = np.asarray(state.obs, np.float64)
        p = seen[9:12]
        integral = np.clip(integral + DT_S * p * max(0.0, 1.0 - p @ p / radius**2) ** 2, -limit, limit)
        np.testing.assert_allclose(seen[18:22], previous, atol=1e-5)
        np.testing.assert_allclose(seen[22:25], integral, atol=1e-6)
        spread.append(np.linalg.norm(p))
        action = rng.uniform(-1.5, 1.5, 4)
        state = step(state, jnp.asarray(action, jnp.float32))
        scale, hover, top = spec.vehicle.action_scale_N, spec.vehicle.hover_thrusts_N, 0.14375
        previous = (np.clip(hover + scale * np.clip(action, -1, 1), 0, top) - hover) / scale
    assert min(spread) < radius < max(spread)


def test_the_integral_is_bounded() -> None:
    total = jnp.array([0.5999, -0.5999, 0.0])
    after = plant.integrated(total, jnp.array([0.1, -0.1, 0.1]), plant.Integrator(None, 0.5, 0.6), 0.1)
    np.testing.assert_allclose(after, [0.6, -0.6, 0.01 * (1 - 0.03 / 0.25) ** 2], atol=1e-6)


def test_on_a_circle_the_distance_to_its_radius_and_the_height_are_integrated() -> None:
    """Whichever way the vehicle is from the center; 0.05 m outside of 2 m, 0.1 m below."""
    turn, distance_m = 0.7, 2.05
    position = jnp.array([distance_m * np.cos(turn), distance_m * np.sin(turn), -0.1])
    after = plant.integrated(jnp.zeros(4), position, plant.Integrator(2.0, 0.5, 0.6), 0.1)
    gate = (1 - (0.05**2 + 0.1**2) / 0.25) ** 2
    moved = 0.05 * np.array([np.cos(turn), np.sin(turn)])
    wanted = 0.1 * gate * np.array([0.05, -0.1, *moved])
    np.testing.assert_allclose(after, wanted, rtol=0.05)  # to first order in 0.05 / 2


def test_in_the_body_frame_neither_heading_nor_azimuth_shows() -> None:
    """A policy's view is NumPy's literal rotation, the same wherever on the circle and whichever way the world lies."""
    circle = task.load("circle", "crazyflie")
    assert isinstance(circle, task.QuadrotorTask)
    env = RealQuadrotorEnv(circle)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    seen = np.array(state.obs[: env.policy_observation_size])
    to_body = seen[:9].reshape(3, 3).T
    seen[-2:] = 0.1, -0.2
    moved = to_body @ [*seen[-2:], 0]
    wanted = [to_body @ [0, 0, 1], to_body @ seen[9:12], to_body @ seen[12:15], seen[15:-2], moved]
    view = env.policy_view(jnp.asarray(seen))
    np.testing.assert_allclose(view, np.concatenate(wanted), atol=1e-6)
    assert env.body_view
    np.testing.assert_allclose(BodyFrame(*env.body_view)(seen[None])[0], view, atol=1e-6)
    turn = Rotation.from_euler("z", 1.1).as_matrix()
    other = np.concatenate(
        [(turn @ to_body.T).ravel(), turn @ seen[9:12], turn @ seen[12:15], seen[15:-2], turn[:2, :2] @ seen[-2:]]
    )
    assert np.abs(other - seen).max() > 0.3
    np.testing.assert_allclose(env.policy_view(jnp.asarray(other)), view, atol=1e-5)


def test_the_policy_sees_the_first_numbers_and_the_critic_all() -> None:
    env = RealQuadrotorEnv(real_task("hexa"))
    assert (env.policy_observation_size, env.observation_size, env.action_size) == (18 + 6 + 3, 18 + 6 + 3 + 14 + 6, 6)
    circle = task.load("circle", "hexa")
    assert isinstance(circle, task.QuadrotorTask)
    assert RealQuadrotorEnv(circle).policy_observation_size == 18 + 6 + 4  # the integral of distance, height, center
    nothing = RealQuadrotorEnv(real_task("hexa", memory={}))
    assert nothing.policy_observation_size == 18

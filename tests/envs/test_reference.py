"""References, and a vehicle's errors relative to them."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl_envs import plant, quadrotor, reference, specfile, task
from qrl_envs.env import from_task
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.reference import FixedReference, Random, evaluation_s
from qrl_envs.specfile import BadInput
from qrl_envs.target import Motion, Sines, follow

POINTS = [[0.0, 0.0, 0.0], [1.0, 0.2, 0.3], [1.2, 1.0, -0.1], [-0.5, 0.8, 0.2], [0.0, 0.0, 0.0]]
TIMES = [0.0, 1.1, 2.0, 3.4, 5.0]
FIXED: dict[str, dict[str, Any]] = {
    "point": {"form": "point", "position_m": [0.1, 0.2, 0.3]},
    "circle": {"form": "circle", "radius_m": 1.5, "speed_m_s": -2.0, "center_m": [0.0, 1.0, 0.5]},
    "eight": {"form": "lissajous", "amplitude_m": [1, 0.5, 0.2], "cycles": [1, 2, 3], "period_s": 5.5},
    "waypoints": {"form": "waypoints", "position_m": POINTS, "times_s": TIMES},
    "polynomials": {
        "form": "polynomials",
        "segments": [
            {"duration_s": 1.5, "x_m": [0, 1], "y_m": [1, 0, 0.5], "z_m": [0.2]},
            {"duration_s": 2.0, "x_m": [1.5, 1, -0.25], "y_m": [2.125, 1.5, 0, -0.1], "z_m": [0.2, 0, 0.05]},
        ],
    },
    "samples": {"form": "samples", "times_s": TIMES, "position_m": POINTS},
}


def jumping(duration_s: float) -> dict[str, Any]:
    """Polynomials whose velocity turns about where they join."""
    there, back = ({"duration_s": duration_s, "x_m": x, "y_m": [0], "z_m": [0]} for x in ([0, 5], [5 * duration_s, -5]))
    return {"form": "polynomials", "segments": [there, back]}


def built(name: str) -> Any:
    return specfile.build(FixedReference, FIXED[name], name)


def track(**changes: Any) -> task.QuadrotorTask:
    made = task.from_data({"extend": "track", **changes}, "here")
    assert isinstance(made, task.QuadrotorTask)
    return made


@pytest.mark.parametrize("name", FIXED)
def test_velocity_and_acceleration_are_the_positions_derivatives(name: str) -> None:
    spec, h = built(name), 1e-4
    times = np.linspace(0.05, 3.3, 80)
    times = times[np.abs(times - 1.5) > 2 * h]  # where the polynomials join, the velocity may jump
    now, before, after = spec.at(times), spec.at(times - h).position_m, spec.at(times + h).position_m
    np.testing.assert_allclose(now.velocity_m_s, (after - before) / (2 * h), atol=2e-5)
    np.testing.assert_allclose(now.acceleration_m_s2, (after - 2 * now.position_m + before) / h**2, atol=2e-4)


def test_circle_and_eight_are_the_textbooks() -> None:
    found = built("circle").at(np.array([0.0, 0.6])).position_m
    angle = -2.0 / 1.5 * 0.6
    wanted = [[1.5, 1.0, 0.5], [1.5 * np.cos(angle), 1.0 + 1.5 * np.sin(angle), 0.5]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    eight = track().evaluation.reference
    assert eight
    np.testing.assert_allclose(eight.at(np.array([5.5 / 8])).position_m, [[np.sqrt(0.5), 0.5, 0.0]], atol=1e-12)


def test_polynomials_are_evaluated_from_each_segments_beginning() -> None:
    found = built("polynomials").at(np.array([0.5, 2.5, 9.0]))
    t = 1.0
    np.testing.assert_allclose(found.position_m[0], [0.5, 1.125, 0.2])
    np.testing.assert_allclose(found.position_m[1], [1.5 + t - 0.25, 2.125 + 1.5 * t - 0.1, 0.25])
    np.testing.assert_allclose(found.position_m[2], [1.5 + 2 - 1, 2.125 + 3 - 0.8, 0.4])
    assert not found.velocity_m_s[2].any()


def test_through_waypoints_no_motion_has_less_snap() -> None:
    """It passes them, from rest to rest. The integral of its snap times that of any change that leaves the points, and
    the ends to the third derivative, as they are, is 0: Euler and Lagrange's condition, in its weak form.
    """
    spec = built("waypoints")
    np.testing.assert_allclose(spec.at(np.array(TIMES)).position_m, POINTS, atol=1e-9)
    assert np.abs(spec.at(np.array([0.0, 5.0])).velocity_m_s).max() < 1e-9
    fine = np.linspace(0.0, 5.0, 50_001)
    change = np.polynomial.Polynomial.fromroots([*TIMES, *[0.0] * 3, *[5.0] * 3, 1.7]).deriv(4)(fine)
    for axis in range(3):
        acceleration = spec.at(fine).acceleration_m_s2[:, axis]
        snap = np.gradient(np.gradient(acceleration, fine), fine)
        product, sizes = np.trapezoid(snap * change, fine), np.trapezoid(np.abs(snap * change), fine)
        assert abs(product) < 1e-3 * sizes


def test_an_evaluation_is_measured_after_the_first_lap_or_2_s() -> None:
    assert evaluation_s(built("eight")) == (5.5 + 11.0, 11.0)
    assert evaluation_s(built("point")) == (8.0, 6.0)
    duration_s, tail_s = evaluation_s(built("waypoints"))
    assert (duration_s - tail_s, tail_s) == (2.0, 6.0)
    slow = task.load("track", reference="eight_slow").evaluation
    assert (slow.duration_s, slow.tail_s) == (30.0, 15.0)  # pyright: ignore[reportAttributeAccessIssue]


# In flight


@pytest.mark.parametrize("name", ["circle", "eight", "waypoints"])
def test_a_figure_in_flight_is_the_figure(name: str) -> None:
    """Of many flights along the last axis, each at its own place, for as long as they last; the preview is the velocity
    then minus now.
    """
    spec, dt = built(name), 0.02
    figure: Any = follow(spec, dt, [0.1, 0.5], anywhere=True)
    begins = jnp.stack([figure.draw(jnp.array([u]), None, None) for u in (0.0, 0.3, 0.999)])  # pyright: ignore[reportArgumentType]
    lap = spec.lap_s or 0.0
    assert (np.asarray(begins) > 0).tolist() == [False, True, True]
    assert float(begins[-1]) * dt < (lap or spec.duration_s)
    for steps in (jnp.array([0, 7, 150]), jnp.array([700, 1400, 2500])):
        found = figure.at(begins, steps)
        times = np.asarray(begins + steps) * dt
        now = spec.at(times)
        np.testing.assert_allclose(found.position_m.T, now.position_m, atol=5e-5)
        np.testing.assert_allclose(found.velocity_m_s.T, now.velocity_m_s, atol=5e-5)
        later = [spec.at(times + ahead).velocity_m_s - now.velocity_m_s for ahead in (0.1, 0.5)]
        np.testing.assert_allclose(found.preview_m_s.T, np.concatenate(later, axis=1), atol=1e-4)


def motions(n: int, **values: Any) -> tuple[Motion, Sines]:
    motion = Motion(Random(form="random", **values), 0.01, [0.1, 0.5])
    physics = quadrotor.physics(task.load("hover", "crazyflie").vehicle)  # pyright: ignore[reportAttributeAccessIssue]
    u = jax.random.uniform(jax.random.PRNGKey(0), (n, motion.draws))
    thrust = jnp.float32(2.0 * 0.03 * 9.81)
    return motion, jax.jit(jax.vmap(lambda one: motion.draw(one, physics, thrust)))(u)


def test_random_motion_is_smooth_and_within_what_the_vehicle_can() -> None:
    """Velocities are the positions' differences, accelerations within half of the vehicle's; half of them rest."""
    motion, sines = motions(300)
    steps = jnp.arange(0, 600, 3)
    targets = jax.jit(jax.vmap(lambda one: jax.vmap(lambda k: motion.at(one, k))(steps)))(sines)
    later = jax.jit(jax.vmap(lambda one: jax.vmap(lambda k: motion.at(one, k))(steps + 10)))(sines)
    position, velocity = np.asarray(targets.position_m, float), np.asarray(targets.velocity_m_s, float)
    mean = (velocity[:, 1:] + velocity[:, :-1]) / 2
    np.testing.assert_allclose(np.diff(position, axis=1) / 0.03, mean, atol=5e-3)
    np.testing.assert_allclose(targets.preview_m_s[..., :3], later.velocity_m_s - targets.velocity_m_s, atol=1e-4)
    acceleration = np.linalg.norm(np.diff(velocity, axis=1) / 0.03, axis=-1).max(axis=1)
    most = 0.5 * 9.81 * np.sqrt(0.8 * 2.0**2 - 1.0)
    assert 0.8 * most < acceleration.max() < 1.001 * most
    assert 0.4 < np.mean(acceleration > 0) < 0.6
    moving = acceleration > 0
    assert np.abs(velocity[moving]).max() < 2 * 3.5
    assert 0.2 < position[moving][..., 0].std() < 1.0
    assert position[moving][..., 2].std() < 0.6 * position[moving][..., 0].std()


def test_no_random_number_of_a_motion_is_used_twice() -> None:
    _, sines = motions(4000, moving=1.0)
    table = np.concatenate([np.asarray(x).reshape(4000, -1) for x in sines[:3]], axis=1)  # the rest follows
    correlation = np.abs(np.corrcoef(table.T) - np.eye(table.shape[1]))
    correlation[:6, 6:12] = correlation[6:12, :6] = 0  # a fast sine has a small amplitude
    correlation[:6, :6] = 0  # and all are scaled together
    assert correlation.max() < 0.08


def test_what_is_observed_is_relative_to_the_reference() -> None:
    """A vehicle on the reference, at its velocity, has no error; moved by e, e is observed, and integrated."""
    env = RealQuadrotorEnv(track(uncertainty="none", reference={"form": "random", "moving": 1.0}))
    state = jax.jit(env.reset)(jax.random.PRNGKey(4))
    flight: plant.Flight = state.pipeline_state.x
    assert env._reference
    target = env._reference.at(flight.world.reference, flight.steps)
    assert np.abs(target.velocity_m_s).max() > 0.1
    e, v = jnp.array([0.03, -0.02, 0.01]), jnp.array([0.2, 0.1, -0.3])
    body = quadrotor.Body(
        flight.body.pose._replace(position_m=target.position_m + e),
        flight.body.twist._replace(velocity_m_s=target.velocity_m_s + v),
    )
    flight = flight._replace(body=body, sensed=body, integral_m_s=jnp.zeros(3))
    seen = env._observe(env.params, flight)
    np.testing.assert_allclose(seen[9:12], e, atol=1e-6)
    np.testing.assert_allclose(seen[12:15], v, atol=1e-6)
    np.testing.assert_allclose(seen[18:27], target.preview_m_s, atol=1e-6)
    after = env.step(state.replace(pipeline_state=state.pipeline_state._replace(x=flight)), jnp.zeros(4))
    later: plant.Flight = after.pipeline_state.x
    then = env._reference.at(flight.world.reference, jnp.int32(1))
    error = later.body.pose.position_m - then.position_m
    np.testing.assert_allclose(after.info["true_obs"][9:12], error, atol=1e-6)
    np.testing.assert_allclose(after.info["true_obs"][18:], then.preview_m_s, atol=1e-6)
    gate = (1 - jnp.sum(error**2) / 0.25) ** 2
    np.testing.assert_allclose(later.integral_m_s, 0.01 * gate * error, rtol=1e-4)
    (p, q), (w, omega) = later.body
    weights = env.task.reward
    assert isinstance(weights, task.TrackReward)
    action = np.asarray(later.previous_action)
    distance = np.sqrt(np.sum((p - then.position_m) ** 2) + weights.rounding_m**2) - weights.rounding_m
    assert weights.near
    wanted = -(
        weights.w_position_1_m * distance
        + weights.near.weight * distance / (distance + weights.near.distance_m)
        + weights.w_velocity_s_m * np.linalg.norm(w - then.velocity_m_s)
        + weights.w_body_rate_s2_rad2 * np.sum(omega**2)
        + weights.w_heading * q[3] ** 2 / (q[0] ** 2 + q[3] ** 2 + 1e-3)
        + weights.w_change * np.sum((action - np.asarray(flight.previous_action)) ** 2)
    )
    np.testing.assert_allclose(after.reward, wanted, rtol=1e-4)


def test_flights_start_about_the_reference_and_end_far_from_it() -> None:
    env = from_task(track(start={"position_m": 0.0, "velocity_m_s": 0.0, "body_rate_rad_s": 0.0}, uncertainty="none"))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 16))
    assert np.abs(states.obs[:, 9:15]).max() < 1e-5
    assert np.abs(states.pipeline_state.x.body.pose.position_m).max() > 0.2
    one = jax.tree.map(lambda x: x[0], states)
    x = one.pipeline_state.x
    far = x.body.pose._replace(position_m=x.body.pose.position_m + jnp.array([0.0, 20.1, 0.0]))
    moved = one.pipeline_state._replace(x=x._replace(body=x.body._replace(pose=far)))
    after = env.step(one.replace(pipeline_state=moved), jnp.zeros(4))
    assert after.info["out_of_bounds"] == 1
    reward = env.params.reward  # no flight within the bounds is worse
    inside = quadrotor.Twist(jnp.array([0.0, 0.0, 20.0]), jnp.array([0.0, 99.0, 0.0]))
    worst = quadrotor.Body(quadrotor.Pose(jnp.array([0.0, 19.9, 0.0]), jnp.array([0.0, 0.0, 0.0, 1.0])), inside)
    assert after.reward <= reward(worst, jnp.ones(4), -jnp.ones(4))


def test_an_evaluation_flies_its_own_reference_from_its_beginning() -> None:
    plan = from_task(track(uncertainty="none")).evaluation()
    assert plan.steps == 1650
    states = jax.jit(jax.vmap(plan.env.reset))(jax.random.split(jax.random.PRNGKey(0), 8))
    error, x = states.info["true_obs"][:, 9:12], states.pipeline_state.x
    np.testing.assert_allclose(x.body.pose.position_m - error, np.zeros((8, 3)), atol=1e-6)  # an eight begins at 0
    assert plan.measure
    good, bad = np.zeros((1651, 18), np.float32), np.zeros((1651, 18), np.float32)
    good[:500, 9], good[-30:, 9], bad[-1101:, 10] = 3.0, 0.6, 0.51
    found = [jax.tree.map(float, plan.measure(jnp.asarray(flight))) for flight in (good, bad)]
    assert [one["success"] for one in found] == [1.0, 0.0]  # a moment beyond the tolerance is not a failure
    np.testing.assert_allclose(found[0]["rms_position_m"], 0.6 * np.sqrt(30 / 1101), rtol=1e-5)


# What cannot be followed


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"form": "circle", "radius_m": 0.3, "speed_m_s": 3.0}, ["reference", "thrust"]),
        ({"form": "lissajous", "amplitude_m": [1, 1, 0], "cycles": [1, 1.5, 0], "period_s": 5.0}, ["whole", "1.5"]),
        ({"form": "waypoints", "position_m": [[0, 0, 0], [1, 0, 0]]}, ["times_s", "speed_m_s"]),
        ({"form": "waypoints", "position_m": [[0, 0, 0], [0, 0, 0]], "speed_m_s": 1.0}, ["times"]),
        ({"form": "waypoints", "position_m": [[0, 0, 0], [1, 0, 0]], "times_s": [0.0, 0.05]}, ["thrust"]),
        ({"form": "loop"}, ["form", "lissajous", "loop"]),
        (
            {"form": "lissajous", "amplitude_m": [1, 1, 0], "cycles": [900, 2, 0], "period_s": 5.0},
            ["cycles in a second"],
        ),
        ({"form": "point", "position_m": [1e6, 0, 0]}, ["within 1000 m"]),
        (jumping(1e13), ["120 s together"]),
        (jumping(1.0), ["thrust"]),
    ],
)
def test_a_reference_that_cannot_be_followed_is_refused(
    given: dict[str, Any], words: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(given))
    with pytest.raises(BadInput) as caught:
        task.load("track", reference=str(path))
    for word in words:
        assert word in str(caught.value)


def test_a_csv_is_a_reference(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    rows = [f"{t},{0.3 * t},{0.1 * t * t},1.0" for t in np.arange(0, 3, 0.1)]
    path.write_text("\n".join(["time_s,x_m,y_m,z_m", *rows]))
    found: Any = task.load("track", reference=str(path)).evaluation.reference  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(found.at(np.array([1.25])).position_m, [[0.375, 0.15625, 1.0]], atol=1e-3)
    path.write_text("\n".join(["time_s,x_m,y_m,z_m", *rows[:5], "0.5,a,0,0"]))
    with pytest.raises(BadInput, match=r"row 7: x_m: expected a number, found 'a'"):
        reference.reference_data(str(path))
    path.write_text("t,x,y,z\n0,0,0,0")
    with pytest.raises(BadInput, match="columns time_s, x_m, y_m, z_m"):
        reference.reference_data(str(path))


def test_only_a_task_that_tracks_takes_a_reference() -> None:
    with pytest.raises(BadInput, match="has no reference"):
        task.load("hover", reference="eight")
    with pytest.raises(BadInput, match="expected a reference with a reward of form 'track'"):
        task.from_data({"extend": "hover", "reference": {"form": "point"}}, "here")
    with pytest.raises(BadInput, match="preview_s"):
        task.from_data({"extend": "hover", "preview_s": [0.1]}, "here")

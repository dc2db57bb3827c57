"""The rewards of hover and circle against the paper's formulas (Sec. 5) written out in NumPy, in float64."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from scipy.spatial.transform import Rotation

from qrl_envs import env, rewards, task, task_env
from qrl_envs.quadrotor import Body, Pose, Twist

Array = np.ndarray

N = 200


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


def weights(name: str, section: str) -> dict:
    """The reward of a shipped task file as JSON has it: what training adds up, or what `evaluation` does."""
    spec = task.load(name).model_dump(mode="json")
    return spec[section]["reward"] if section == "evaluation" else spec["reward"]


each_section = pytest.mark.parametrize("section", ["training", "evaluation"])
WEIGHTS = {
    "hover": {"constant": 0.7, "w1_attitude": 0.3, "w2_position_1_m": 0.5, "w3_action": 0.11},
    "circle": {
        "constant": 0.7,
        "w4_distance_1_m": 0.9,
        "w5_direction_s_m2": 0.4,
        "w6_action": 0.13,
        "radius_m": 1.5,
        "speed_m_s": 2.5,
    },
}
each_form = pytest.mark.parametrize("form", ["hover", "circle"])


def ours(form: str, w: dict, body: Body, action: Array) -> Array:
    """The reward of n states by qrl, its weights in double precision; a constant left out is zero."""
    kind: type[rewards.Hover] | type[rewards.Circle] = {"hover": rewards.Hover, "circle": rewards.Circle}[form]
    reward = kind(*(jnp.float64(w.get(field, 0.0)) for field in kind._fields if field not in ("near", "w_change")))
    return np.asarray(OURS[form](reward, body, action))


OURS: dict[str, Callable] = {
    form: jax.jit(jax.vmap(lambda reward, body, action: reward(body, action), in_axes=(None, 0, 0)))
    for form in ("hover", "circle")
}


def papers_hover(w: dict, q: Array, p: Array, a: Array) -> float:
    """−[w1 w2 w3]·[‖q_e‖ ‖p_e‖ ‖a‖], q_e as in FIELD.md."""
    q_e = [1.0 - abs(q[0]), q[1], q[2], q[3]]
    norms = [np.sqrt(np.sum(np.square(v))) for v in (q_e, p, a)]
    return w.get("constant", 0.0) - np.dot([w["w1_attitude"], w["w2_position_1_m"], w["w3_action"]], norms)


def papers_circle(w: dict, p: Array, v: Array, a: Array) -> float:
    """−[w4 w5 w6]·[‖d‖ ‖χ‖ ‖a‖], d to the nearest point of the circle, χ from the cross product on the xy plane."""
    nearest = w["radius_m"] * np.array([p[0], p[1], 0.0]) / np.sqrt(p[0] ** 2 + p[1] ** 2)
    d = np.linalg.norm(p - nearest)
    chi = np.cross(p * [1, 1, 0], v * [1, 1, 0])[2] - w["radius_m"] * w["speed_m_s"]
    norms = [d, abs(chi), np.linalg.norm(a)]
    return w.get("constant", 0.0) - np.dot([w["w4_distance_1_m"], w["w5_direction_s_m2"], w["w6_action"]], norms)


def papers(form: str, w: dict, body: Body, action: Array) -> Array:
    """The same by the paper's formulas, one state after the other."""
    (p, q), (v, _) = body
    if form == "hover":
        return np.array([papers_hover(w, *x) for x in zip(q, p, action, strict=True)])
    return np.array([papers_circle(w, *x) for x in zip(p, v, action, strict=True)])


@pytest.fixture(scope="module")
def states() -> tuple[Body, Array]:
    """200 random states and actions, attitudes of either sign."""
    rng = np.random.default_rng(0)
    q = Rotation.random(N, rng=rng).as_quat(scalar_first=True) * rng.choice([-1.0, 1.0], size=(N, 1))
    p, v, rate = rng.normal(size=(3, N, 3))
    return Body(Pose(p, q), Twist(2.0 * v, rate)), rng.uniform(-1.0, 1.0, size=(N, 4))


@each_form
@each_section
def test_rewards_of_the_task_files_are_the_papers(form: str, section: str, states: tuple[Body, Array]) -> None:
    """With the weights of hover.json and circle.json, those trained with and those judged by."""
    w = weights(form, section)
    assert w["form"] == form
    np.testing.assert_allclose(ours(form, w, *states), papers(form, w, *states), atol=1e-12)


@each_form
def test_rewards_of_any_weights_are_the_papers(form: str, states: tuple[Body, Array]) -> None:
    """With a constant, and weights, radius and speed that are all different."""
    w = WEIGHTS[form]
    np.testing.assert_allclose(ours(form, w, *states), papers(form, w, *states), atol=1e-12)


@pytest.mark.parametrize("form", ["hover", "track"])
def test_near_cost_is_added(form: str, states: tuple[Body, Array]) -> None:
    """weight·d/(d + distance_m) of the distance d, half of the weight at `distance_m`; to track, of the rounded one."""
    shipped = task.load(form).reward.model_copy(update={"near": None})
    spec = shipped.model_copy(update={"near": task.Near(weight=0.4, distance_m=0.3)})
    reward, plain = rewards.from_spec(spec), rewards.from_spec(shipped)
    (body, action), d = states, np.linalg.norm(states[0].pose.position_m, axis=1)
    if isinstance(shipped, task.TrackReward):
        d = np.sqrt(d**2 + shipped.rounding_m**2) - shipped.rounding_m
    added = jax.vmap(plain)(body, action) - jax.vmap(reward)(body, action)
    np.testing.assert_allclose(added, 0.4 * d / (d + 0.3), atol=1e-6)


@each_form
def test_a_change_of_action_costs_its_square(form: str, states: tuple[Body, Array]) -> None:
    """w_change·‖a − a_before‖², and nothing where there is no action before."""
    spec = task.load(form).reward
    reward, plain = rewards.from_spec(spec.model_copy(update={"w_change": 0.25})), rewards.from_spec(spec)
    (body, action), before = states, np.random.default_rng(3).uniform(-1.0, 1.0, states[1].shape)
    cost = jax.vmap(plain)(body, action, before) - jax.vmap(reward)(body, action, before)
    np.testing.assert_allclose(cost, 0.25 * np.sum((action - before) ** 2, axis=1), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(jax.vmap(reward)(body, action), jax.vmap(plain)(body, action))


def test_slope_of_the_near_cost_is_finite_at_the_point() -> None:
    """weight/distance_m outward, and 0 at the point itself, where there is no outward."""
    near = rewards.Near(jnp.float32(0.4), jnp.float32(0.3))
    reward = rewards.Hover(*(jnp.float32(0.0) for _ in range(4)), near)

    def value(p: Array) -> jax.Array:
        return reward(Body(Pose(p, jnp.asarray(AT_REST)), Twist(jnp.zeros(3), jnp.zeros(3))), jnp.zeros(4))

    np.testing.assert_array_equal(jax.grad(value)(jnp.zeros(3)), 0.0)
    np.testing.assert_allclose(jax.grad(value)(jnp.array([0.0, 1e-6, 0.0])), [0.0, -0.4 / 0.3, 0.0], rtol=1e-4)


def test_evaluation_of_hover_is_fields_reward() -> None:
    """FIELD.md: 1 − 0.2(‖q_e‖ + ‖p_e‖ + ‖a‖)."""
    w = weights("hover", "evaluation")
    assert (w["constant"], w["w1_attitude"], w["w2_position_1_m"], w["w3_action"]) == (1.0, 0.2, 0.2, 0.2)


def test_circle_reward_is_blind_to_a_turn_about_z(states: tuple[Body, Array]) -> None:
    """Position, velocity and attitude of each state turned by its own random yaw."""
    (p, q), (v, rate) = states[0]
    yaw = Rotation.from_euler("z", np.random.default_rng(1).uniform(-np.pi, np.pi, size=(N, 1)))
    turned_q = (yaw * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True)
    turned = Body(Pose(yaw.apply(p), turned_q), Twist(yaw.apply(v), rate))
    for w in (weights("circle", "training"), WEIGHTS["circle"]):
        np.testing.assert_allclose(ours("circle", w, turned, states[1]), ours("circle", w, *states), atol=1e-12)


AT_REST = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("position", [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [0.0, -1.5, 0.0], [0.0, 0.0, 2.0]])
@each_form
def test_gradients_at_the_goal_are_finite(form: str, position: list[float], dtype: type) -> None:
    """Where a norm is 0: no action, the point itself, upright, on the circle, on its axis; in what trains and here."""
    kind: Any = {"hover": rewards.Hover, "circle": rewards.Circle}[form]
    reward = kind(*(dtype(WEIGHTS[form][field]) for field in kind._fields if field not in ("near", "w_change")))

    def value(p: Array, q: Array, v: Array, action: Array) -> jax.Array:
        return reward(Body(Pose(p, q), Twist(v, jnp.zeros_like(v))), action)

    velocity = np.array([0.0, 2.5, 0.0]) if position[0] else np.zeros(3)  # chi is 0 there
    at = [x.astype(dtype) for x in (np.array(position), AT_REST, velocity, np.zeros(4))]
    slopes = jax.jit(jax.grad(value, argnums=(0, 1, 2, 3)))(*at)
    for slope in slopes:
        assert slope.dtype == dtype
        assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slopes[3], 0.0)
    if form == "hover":
        slope = -WEIGHTS[form]["w2_position_1_m"] * np.sign(position)
        np.testing.assert_allclose(slopes[0], slope, rtol=1e-6)


@each_form
def test_q_and_minus_q_are_one_attitude(form: str, states: tuple[Body, Array]) -> None:
    """The reward is the same to the last bit."""
    body, action = states
    other = body._replace(pose=body.pose._replace(attitude=-body.pose.attitude))
    np.testing.assert_array_equal(ours(form, WEIGHTS[form], other, action), ours(form, WEIGHTS[form], body, action))


@each_form
def test_no_reward_is_above_the_constant(form: str, states: tuple[Body, Array]) -> None:
    """At any state; the states here all lose something."""
    assert (ours(form, WEIGHTS[form], *states) < WEIGHTS[form]["constant"]).all()


def circling(phase: Array, radius: float, speed: float) -> Body:
    """States on a horizontal circle, counter-clockwise for a positive speed."""
    zero, n = np.zeros_like(phase), len(phase)
    out, along = np.array([np.cos(phase), np.sin(phase), zero]), np.array([-np.sin(phase), np.cos(phase), zero])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Body(Pose(radius * out.T, level), Twist(speed * along.T, np.zeros((n, 3))))


def test_a_perfect_circle_without_effort_earns_the_constant() -> None:
    """To rounding, and for the shipped circle zero."""
    for w in (weights("circle", "training"), WEIGHTS["circle"]):
        body = circling(np.linspace(0.0, 2.0 * np.pi, 41), w["radius_m"], w["speed_m_s"])
        reward = ours("circle", w, body, np.zeros((41, 4)))
        np.testing.assert_allclose(reward, w.get("constant", 0.0), atol=1e-14)


def test_the_circle_flown_clockwise_pays_for_the_direction() -> None:
    """χ = −2·r·v there: at w5 times that below the constant."""
    w = WEIGHTS["circle"]
    body = circling(np.linspace(0.0, 6.0, 7), w["radius_m"], -w["speed_m_s"])
    lost = w["w5_direction_s_m2"] * 2.0 * w["radius_m"] * w["speed_m_s"]
    np.testing.assert_allclose(ours("circle", w, body, np.zeros((7, 4))), w["constant"] - lost, atol=1e-14)


def test_hovering_level_at_the_point_earns_the_constant_whatever_the_velocity() -> None:
    """To rounding, for either sign of the quaternion: the paper's hover weighs attitude, position and action alone."""
    for sign in (1.0, -1.0):
        level = Pose(np.zeros((1, 3)), np.array([[sign, 0.0, 0.0, 0.0]]))
        body = Body(level, Twist(np.ones((1, 3)), np.ones((1, 3))))
        reward = ours("hover", WEIGHTS["hover"], body, np.zeros((1, 4)))
        np.testing.assert_allclose(reward, WEIGHTS["hover"]["constant"], atol=1e-14)


@each_form
def test_a_step_is_rewarded_for_where_it_ends_and_the_thrust_applied(form: str, states: tuple[Body, Array]) -> None:
    """Through the environment, in its float32: the state after the step, a = (F − mg/4)/6 after clipping."""
    world, zero = env.make(form), np.float32(0.0)
    asked = np.random.default_rng(2).uniform(-1.5, 1.5, size=(N, 4))

    def step(body: Body, action: jax.Array) -> State:
        start = State(task_env.Lane(body, world.params), jnp.zeros(18), zero, zero, {}, {"truncated": zero})
        return world.step(start, action)

    with jax.enable_x64(False):
        end = jax.jit(jax.vmap(step))(*jax.tree.map(np.float32, (states[0], asked)))
    after = jax.tree.map(np.float64, end.pipeline_state.x)
    offset = 0.667 * 9.81 / 4
    applied = (np.clip(offset + 6.0 * np.clip(asked, -1.0, 1.0), 0.0, 8.0) - offset) / 6.0
    w = weights(form, "training")
    np.testing.assert_allclose(end.reward, papers(form, w, after, applied), atol=2e-5)
    assert np.median(np.abs(end.reward - papers(form, w, states[0], applied))) > 1e-3
    assert np.median(np.abs(end.reward - papers(form, w, after, asked))) > 1e-3

"""Rewards of the paper (Sec. 5) and of Gymnasium's Pendulum-v1. For one state; the caller vmaps. All return []."""

from typing import Any, NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs import task
from qrl_envs.pendulum import Pendulum
from qrl_envs.quadrotor import Body
from qrl_envs.task import CircleReward, HoverReward, PendulumReward, TrackReward


def _norm(x: chex.Array) -> chex.Array:
    """Euclidean norm [], with gradient 0 at 0, where that of jnp.linalg.norm is not a number."""
    square = jnp.sum(x * x, axis=0)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


class Near(NamedTuple):
    """The cost of a distance d that is steep near 0, weight·d/(d + distance_m); scalars.

    A cost in proportion to d says little about when a flight arrives: most of the sum is of the way far off.
    """

    weight: chex.Array
    distance_m: chex.Array

    def __call__(self, d: chex.Array) -> chex.Array:
        return self.weight * d / (d + self.distance_m)


def _change(weight: chex.Array | tuple[()], action: chex.Array, before: chex.Array | None) -> chex.Array | float:
    """weight·‖Δa‖² of an action [A] and the one `before` it; 0 without a weight, or at the first."""
    if isinstance(weight, tuple) or before is None:
        return 0.0
    return weight * jnp.sum((action - before) ** 2, axis=0)


class Hover(NamedTuple):
    """Weights of the hover reward; scalars."""

    constant: chex.Array
    w1_attitude: chex.Array
    w2_position_1_m: chex.Array
    w3_action: chex.Array
    near: Near | tuple[()] = ()
    w_change: chex.Array | tuple[()] = ()

    def __call__(self, body: Body, action: chex.Array, before: chex.Array | None = None) -> chex.Array:
        """constant − (w1·‖q_e‖ + w2·‖p_e‖ + near(‖p_e‖) + w3·‖a‖ + w_change·‖Δa‖²) of the state after the step, the
        applied action [4] and the one before it.

        q_e = [1 − |w|, x, y, z] of the attitude quaternion, so that q and −q, the same attitude, cost the same.
        """
        w, *xyz = jnp.unstack(body.pose.attitude)
        q_e = jnp.stack([1.0 - jnp.abs(w), *xyz])
        p_e = _norm(body.pose.position_m)
        cost = self.w1_attitude * _norm(q_e) + self.w2_position_1_m * p_e + self.w3_action * _norm(action)
        cost = cost + self.near(p_e) if self.near else cost
        return self.constant - (cost + _change(self.w_change, action, before))


class Circle(NamedTuple):
    """Weights of the circle reward and the circle itself (horizontal, about the origin); scalars."""

    constant: chex.Array
    w4_distance_1_m: chex.Array
    w5_direction_s_m2: chex.Array
    w6_action: chex.Array
    radius_m: chex.Array
    speed_m_s: chex.Array
    w_change: chex.Array | tuple[()] = ()

    def __call__(self, body: Body, action: chex.Array, before: chex.Array | None = None) -> chex.Array:
        """constant − (w4·d + w5·|chi| + w6·‖a‖ + w_change·‖Δa‖²) of the state after the step, the applied action [4]
        and the one before it.

        d is the distance to the circle and chi = x·vy − y·vx − r_des·v_des (paper, Sec. 5.3).
        """
        x, y, z = jnp.unstack(body.pose.position_m)
        vx, vy, _ = jnp.unstack(body.twist.velocity_m_s)
        d = _norm(jnp.stack([_norm(jnp.stack([x, y])) - self.radius_m, z]))
        chi = x * vy - y * vx - self.radius_m * self.speed_m_s
        return self.constant - (
            self.w4_distance_1_m * d
            + self.w5_direction_s_m2 * jnp.abs(chi)
            + self.w6_action * _norm(action)
            + _change(self.w_change, action, before)
        )


HEADING_MARGIN = 1e-3  # keeps the gradient of the heading finite upside down, where there is none


class Track(NamedTuple):
    """Weights of `task.TrackReward`; scalars."""

    constant: chex.Array
    w_position_1_m: chex.Array
    rounding_m: chex.Array
    w_velocity_s_m: chex.Array
    w_body_rate_s2_rad2: chex.Array
    w_heading: chex.Array
    w_change: chex.Array
    near: Near | tuple[()] = ()

    def __call__(self, body: Body, action: chex.Array, before: chex.Array | None = None) -> chex.Array:
        """Of the state after the step relative to the reference, its applied action [A], and the one `before` [A].

        The heading ψ is that of the quaternion's twist about z: sin²(ψ/2) = z²/(w² + z²), whatever the tilt.
        """
        w, _, _, z = jnp.unstack(body.pose.attitude)
        square = jnp.sum(body.pose.position_m**2, axis=0)
        distance = jnp.sqrt(square + self.rounding_m**2) - self.rounding_m
        rate = jnp.sum(body.twist.body_rate_rad_s**2, axis=0)
        near = self.near(distance) if self.near else 0.0
        return self.constant - (
            self.w_position_1_m * distance
            + near
            + self.w_velocity_s_m * _norm(body.twist.velocity_m_s)
            + self.w_body_rate_s2_rad2 * rate
            + self.w_heading * z * z / (w * w + z * z + HEADING_MARGIN)
            + _change(self.w_change, action, before)
        )


class SwingUp(NamedTuple):
    """Weights of Pendulum-v1's reward; scalars."""

    w_angle_1_rad2: chex.Array
    w_rate_s2_rad2: chex.Array
    w_torque_1_N2m2: chex.Array

    def __call__(self, x: Pendulum, torque: chex.Array) -> chex.Array:
        """−(w_angle·θ² + w_rate·θ̇² + w_torque·u²), θ wrapped to ±π, of the state before the step."""
        theta = jnp.mod(x.pose + jnp.pi, 2.0 * jnp.pi) - jnp.pi
        return -(self.w_angle_1_rad2 * theta**2 + self.w_rate_s2_rad2 * x.twist**2 + self.w_torque_1_N2m2 * torque**2)


_FORMS = {"hover": Hover, "circle": Circle, "track": Track, "pendulum": SwingUp}


def from_spec(
    spec: HoverReward | CircleReward | TrackReward | PendulumReward,
) -> Hover | Circle | Track | SwingUp:
    """The reward of a task file, with its weights as float32 arrays."""
    kind, optional = _FORMS[spec.form], _FORMS[spec.form]._field_defaults
    weights: dict[str, Any] = {field: getattr(spec, field) for field in kind._fields}
    asked = {name: weight for name, weight in weights.items() if weight or name not in optional}
    return kind(**{name: _array(weight) for name, weight in asked.items()})


def _array(weight: Any) -> Any:
    if isinstance(weight, task.Near):
        return Near(jnp.float32(weight.weight), jnp.float32(weight.distance_m))
    return jnp.float32(weight)

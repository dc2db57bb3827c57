"""Evaluation under conditions that training does not see: plant, latency, sensors, start.

An `OffNominal` environment is the task's own except for its condition, and success and errors are measured on the true
state as in the task. `info["sensor_obs"]` is what a policy observes, beside the true `obs`. The magnitudes are this
project's; the paper's trial starts as in its figure of a hovering trial.
"""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import quadrotor, rotation
from qrl_envs.env import QuadrotorEnv, State
from qrl_envs.quadrotor import Body, Pose, Twist
from qrl_envs.task import QuadrotorTask

RK4_STEP_S = 0.001
TRIAL_POSITION_M = (-1.58, 0.99, 1.45)  # world
TRIAL_VELOCITY_M_S = (-2.39, 6.20, 0.77)  # world
_SENSOR_STREAM = 1_000_003  # folded into a start's key, so that noise does not share the start's random numbers


class Noise(NamedTuple):
    """Standard deviations of Gaussian sensor errors, independent for each axis and step."""

    position_m: float = 0.01
    velocity_m_s: float = 0.02
    attitude_rad: float = 0.01  # of a small rotation about the body axes
    body_rate_rad_s: float = 0.02


class Condition(NamedTuple):
    """How a flight differs from the nominal one; by default not at all."""

    description: str  # one line
    rk4: bool = False  # integrate the plant by RK4 in steps of RK4_STEP_S
    delayed: bool = False  # apply each action one step late; the first step applies a = 0, hover thrust
    noise: Noise | None = None
    paper_trial: bool = False  # start with the position and velocity of the paper's trial


def conditions(task: QuadrotorTask) -> dict[str, Condition]:
    """The off-nominal conditions of a task by name; "trial" applies to hover only."""
    named = {
        "rk4": Condition("plant integrated by RK4 at 1 ms", rk4=True),
        "latency": Condition("actions one step late", delayed=True),
        "noise": Condition("sensors err by 1 cm, 2 cm/s, 0.01 rad, 0.02 rad/s (1 σ, each axis)", noise=Noise()),
        "together": Condition("rk4, latency and noise", rk4=True, delayed=True, noise=Noise()),
    }
    if task.evaluation.reward.form == "hover":
        named["trial"] = Condition("the paper's trial: its position and velocity, any attitude", paper_trial=True)
    return named


class PerturbedParams(NamedTuple):
    """`Params` and the condition as arrays, so that one compiled program serves all conditions."""

    physics: Any
    reward: Any
    start: Any
    bounds: Any
    rk4: chex.Array  # [] bool, like the next two
    delayed: chex.Array
    paper_trial: chex.Array
    noise: Noise  # zeros: exact sensors


class OffNominal(QuadrotorEnv):
    """A quadrotor task under a condition. A key gives the nominal start, except for what the condition sets.

    The condition is part of the parameters: `with_params` of another OffNominal's parameters takes its condition too.
    """

    def __init__(self, task: QuadrotorTask, condition: Condition) -> None:
        super().__init__(task)
        noise = Noise(*map(jnp.float32, condition.noise or Noise(0.0, 0.0, 0.0, 0.0)))
        flags = (jnp.bool_(flag) for flag in (condition.rk4, condition.delayed, condition.paper_trial))
        self.params: Any = PerturbedParams(*self.params, *flags, noise)  # pyright: ignore[reportCallIssue]

    def step(self, state: State, action: chex.Array) -> State:
        delayed, pending = state.pipeline_state.params.delayed, state.info["pending_action"]
        info = {**state.info, "pending_action": action}
        return self._sense(super().step(state.replace(info=info), jnp.where(delayed, pending, action)))

    def _reset(self, params: Any, rng: chex.PRNGKey) -> State:
        state = super()._reset(params, rng)
        key = jax.random.fold_in(rng, _SENSOR_STREAM)
        info = {**state.info, "pending_action": jnp.zeros(self.action_size), "sensor_key": key}
        return self._sense(state.replace(info=info))

    def _draw(self, params: Any, rng: chex.PRNGKey) -> Body:
        body = super()._draw(params, rng)
        trial = jnp.array(TRIAL_POSITION_M), jnp.array(TRIAL_VELOCITY_M_S)
        position, velocity = (
            jnp.where(params.paper_trial, *pair)
            for pair in zip(trial, (body.pose.position_m, body.twist.velocity_m_s), strict=True)
        )
        return Body(body.pose._replace(position_m=position), body.twist._replace(velocity_m_s=velocity))

    def _advance(self, params: Any, x: Body, action: chex.Array) -> tuple[Body, chex.Array]:
        thrust, dt_s = quadrotor.thrust_N(params.physics, action), self.task.control_period_s
        substeps = max(1, round(dt_s / RK4_STEP_S))
        body = jax.tree.map(
            lambda rk4, euler: jnp.where(params.rk4, rk4, euler),
            quadrotor.step_rk4(params.physics, x, thrust, dt_s, substeps),
            quadrotor.step(params.physics, x, thrust, dt_s),
        )
        return body, params.reward(body, quadrotor.applied_action(params.physics, thrust))

    def _sense(self, state: State) -> State:
        next_key, key = jax.random.split(state.info["sensor_key"])
        lane = state.pipeline_state
        sensor_obs = quadrotor.observe(add_sensor_noise(lane.x, lane.params.noise, key))
        return state.replace(info={**state.info, "sensor_key": next_key, "sensor_obs": sensor_obs})


def add_sensor_noise(body: Body, noise: Noise, key: chex.PRNGKey) -> Body:
    """`body` as measured by sensors with this noise."""
    position, velocity, tilt, rate = jax.random.normal(key, (4, 3))
    # A small-angle quaternion, normalized: a rotation exactly, its angle to 1e-5 of itself.
    small = rotation.normalize(jnp.concatenate([jnp.ones(1), noise.attitude_rad / 2 * tilt]))
    (p, q), (v, w) = body
    return Body(
        Pose(p + noise.position_m * position, rotation.product(q, small)),
        Twist(v + noise.velocity_m_s * velocity, w + noise.body_rate_rad_s * rate),
    )

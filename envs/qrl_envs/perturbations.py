"""Flights under other conditions than those that a policy trains in: plant, latency, sensors, start.

An `OffNominal` environment is the task's own but for its condition, and judged as the task is, on the true state. What
a policy sees stands in `info["sensed"]`, beside the true `obs`. Sizes are of the project's own bar,
the trial's start is the paper's (its figure of a hovering trial).
"""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import quadrotor, rotation
from qrl_envs.env import QuadrotorEnv, State
from qrl_envs.quadrotor import Body, Pose, Twist
from qrl_envs.task import QuadrotorTask

FINE_STEP_S = 0.001
TRIAL_POSITION_M = (-1.58, 0.99, 1.45)  # world
TRIAL_VELOCITY_M_S = (-2.39, 6.20, 0.77)  # world
_SENSORS = 1_000_003  # folded into a start's key: another stream than the start's own numbers


class Noise(NamedTuple):
    """Standard deviations of Gaussian errors, each axis' own, fresh at every step."""

    position_m: float = 0.01
    velocity_m_s: float = 0.02
    attitude_rad: float = 0.01  # of a small rotation about the body's axes
    body_rate_rad_s: float = 0.02


class Condition(NamedTuple):
    """How a flight differs from the nominal one; by default not at all."""

    says: str  # in a line
    fine: bool = False  # the plant integrated by RK4 in steps of FINE_STEP_S
    late: bool = False  # an action acts one step late; in the first step a = 0 does, hover thrust
    noise: Noise | None = None
    trial: bool = False  # position and velocity at the start are the paper's trial's


def conditions(task: QuadrotorTask) -> dict[str, Condition]:
    """Off-nominal conditions by name; the paper's trial is a start of a hover."""
    named = {
        "rk4": Condition("plant integrated by RK4 at 1 ms", fine=True),
        "latency": Condition("actions one step late", late=True),
        "noise": Condition("sensors err by 1 cm, 2 cm/s, 0.01 rad, 0.02 rad/s (1 σ, each axis)", noise=Noise()),
        "together": Condition("rk4, latency and noise", fine=True, late=True, noise=Noise()),
    }
    if task.evaluation.reward.form == "hover":
        named["trial"] = Condition("the paper's trial: its position and velocity, any attitude", trial=True)
    return named


class Conditioned(NamedTuple):
    """A `Params` that says the condition too: as numbers, so that one compiled program flies under any."""

    physics: Any
    reward: Any
    start: Any
    bounds: Any
    fine: chex.Array  # [] bool, as the other two
    late: chex.Array
    trial: chex.Array
    noise: Noise  # of zeros: sensors say what is


class OffNominal(QuadrotorEnv):
    """A quadrotor task under a condition. The same key gives the nominal start, but for what the condition sets.

    The condition is among the parameters: `under` those of another OffNominal of the same task, it is the other's.
    """

    def __init__(self, task: QuadrotorTask, condition: Condition) -> None:
        super().__init__(task)
        noise = Noise(*map(jnp.float32, condition.noise or Noise(0.0, 0.0, 0.0, 0.0)))
        flags = (jnp.bool_(flag) for flag in (condition.fine, condition.late, condition.trial))
        self.params: Any = Conditioned(*self.params, *flags, noise)  # pyright: ignore[reportCallIssue]

    def step(self, state: State, action: chex.Array) -> State:
        late = state.pipeline_state.params.late
        info = {**state.info, "waiting": action}
        return self._sense(super().step(state.replace(info=info), jnp.where(late, state.info["waiting"], action)))

    def _begin(self, params: Any, rng: chex.PRNGKey) -> State:
        state = super()._begin(params, rng)
        key = jax.random.fold_in(rng, _SENSORS)
        return self._sense(
            state.replace(info={**state.info, "waiting": jnp.zeros(self.action_size), "sensor_key": key})
        )

    def _draw(self, params: Any, rng: chex.PRNGKey) -> Body:
        body = super()._draw(params, rng)
        trial = jnp.array(TRIAL_POSITION_M), jnp.array(TRIAL_VELOCITY_M_S)
        position, velocity = (
            jnp.where(params.trial, *pair)
            for pair in zip(trial, (body.pose.position_m, body.twist.velocity_m_s), strict=True)
        )
        return Body(body.pose._replace(position_m=position), body.twist._replace(velocity_m_s=velocity))

    def _advance(self, params: Any, x: Body, action: chex.Array) -> tuple[Body, chex.Array]:
        thrust, dt_s = quadrotor.thrust_N(params.physics, action), self.task.control_period_s
        parts = max(1, round(dt_s / FINE_STEP_S))
        body = jax.tree.map(
            lambda fine, rough: jnp.where(params.fine, fine, rough),
            quadrotor.step_finely(params.physics, x, thrust, dt_s, parts),
            quadrotor.step(params.physics, x, thrust, dt_s),
        )
        return body, params.reward(body, quadrotor.applied_action(params.physics, thrust))

    def _sense(self, state: State) -> State:
        later, now = jax.random.split(state.info["sensor_key"])
        lane = state.pipeline_state
        return state.replace(
            info={
                **state.info,
                "sensor_key": later,
                "sensed": quadrotor.observe(erring(lane.x, lane.params.noise, now)),
            }
        )


def erring(body: Body, noise: Noise, key: chex.PRNGKey) -> Body:
    """`body` as sensors with that noise measure it."""
    position, velocity, tilt, rate = jax.random.normal(key, (4, 3))
    # The rotation of a small vector, but for 1e-5 of its angle; a rotation exactly.
    small = rotation.normalise(jnp.concatenate([jnp.ones(1), noise.attitude_rad / 2 * tilt]))
    (p, q), (v, w) = body
    return Body(
        Pose(p + noise.position_m * position, rotation.product(q, small)),
        Twist(v + noise.velocity_m_s * velocity, w + noise.body_rate_rad_s * rate),
    )

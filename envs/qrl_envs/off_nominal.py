"""Evaluation under conditions that a task does not name: lag, latency, other mass, wind, gusts, sensors, rate, start.

Each is an `Uncertainty` whose ranges are points, flown on the plant of real vehicles; success and errors are measured
on the true state, as in the task. The magnitudes are this project's; the paper's trial starts as in its figure of a
hovering trial.
"""

from typing import Any, NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs import plant
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.task import QuadrotorTask
from qrl_envs.uncertainty import Uncertainty

TRIAL_POSITION_M = (-1.58, 0.99, 1.45)  # world
TRIAL_VELOCITY_M_S = (-2.39, 6.20, 0.77)  # world
NOISE = {
    "position_noise_m": 0.01,
    "velocity_noise_m_s": 0.02,
    "attitude_noise_rad": 0.01,
    "body_rate_noise_rad_s": 0.02,
}
FIXES = {"position_period_s": 1.0 / 30.0, "position_delay_s": 0.01, "bias_wander_m": 0.005}  # motion capture
GUSTS = {"gust_m_s": 1.0, "gust_s": 1.0}
BIAS_M = 0.02
LAGS_S = (0.02, 0.05, 0.072, 0.1, 0.15)
LATENCY_S = 0.01


class Condition(NamedTuple):
    """How a flight differs from the nominal vehicle's; by default not at all."""

    description: str  # one line
    uncertainty: Uncertainty = Uncertainty()
    paper_trial: bool = False  # start with the position and velocity of the paper's trial
    held_periods: int = 1  # periods of the task for which each action of the policy is applied


def _fixed(**values: float) -> Uncertainty:
    return Uncertainty(**{name: (value, value) for name, value in values.items()})


SHAPED_FOR = _fixed(latency_s=2 * LATENCY_S, **GUSTS, **FIXES)  # what one program for all conditions has room for


def conditions(task: QuadrotorTask) -> dict[str, Condition]:
    """The off-nominal conditions of a task by name; "trial" applies to hover only, wind to a vehicle with drag."""
    named = {"exact": Condition("the vehicle as in its file, sensors exact", Uncertainty())}
    for lag_s in LAGS_S:
        text = f"rotors follow with a time constant of {1e3 * lag_s:g} ms"
        named[f"lag_{1e3 * lag_s:g}ms"] = Condition(text, _fixed(rotor_lag_s=lag_s))
    if not task.vehicle.ideal:
        named["lag_x2"] = Condition("rotors twice as late", _fixed(rotor_lag_factor=2.0))
    named |= {
        "latency": Condition("actions 10 ms late", _fixed(latency_s=LATENCY_S)),
        "latency_20ms": Condition("actions 20 ms late", _fixed(latency_s=2 * LATENCY_S)),
        "mass_x1.3": Condition("mass 30 % above the file's", _fixed(mass_factor=1.3)),
        "mass_x0.8": Condition("mass 20 % below", _fixed(mass_factor=0.8)),
        "thrust_x0.85": Condition("thrust 15 % below, as of a battery nearly empty", _fixed(thrust_factor=0.85)),
        "inertia_x1.25": Condition("inertia 25 % above", _fixed(inertia_factor=1.25)),
        "force": Condition("a constant force of a tenth of the weight, in any direction", _fixed(force_weights=0.1)),
    }
    wind = {"wind_m_s": 2.0} if any(task.vehicle.drag_N_s_m) else {"force_weights": 0.05}
    blows = "2 m/s of wind" if "wind_m_s" in wind else "a force of 5 % of the weight"
    if "wind_m_s" in wind:
        named["wind"] = Condition("2 m/s of wind", _fixed(**wind))
    gusts_blow = "through drag" if "wind_m_s" in wind else "as a force of 2.5 % of the weight for each m/s"
    fixes = "position at 30 Hz, 10 ms late, with a bias that wanders by 5 mm (1 σ, each axis, 5 s); velocity from it"
    named |= {
        "gusts": Condition(f"gusts of 1 m/s (1 σ, each axis, 1 s), {gusts_blow}", _fixed(**GUSTS)),
        "bias": Condition("the position measured 2 cm off, in any direction", _fixed(position_bias_m=BIAS_M)),
        "estimator": Condition(fixes, _fixed(**FIXES)),
        "half_rate": Condition("each action held for two periods", held_periods=2),
        "noise": Condition("sensors err by 1 cm, 2 cm/s, 0.01 rad, 0.02 rad/s (1 σ, each axis)", _fixed(**NOISE)),
        "together": Condition(
            f"latency of 10 ms, noise, mass 20 % above, {blows}",
            _fixed(**NOISE, **wind, latency_s=LATENCY_S, mass_factor=1.2),
        ),
    }
    if task.evaluation.reward.form == "hover":
        named["trial"] = Condition("the paper's trial: its position and velocity, any attitude", paper_trial=True)
    return named


class OffNominalParams(NamedTuple):
    """The parameters of a `RealQuadrotorEnv` and the start, so that one compiled program serves all conditions."""

    physics: Any
    reward: Any
    start: Any
    bounds: Any
    ranges: plant.Ranges
    paper_trial: chex.Array  # [] bool
    held_periods: chex.Array  # [] int32


class OffNominal(RealQuadrotorEnv):
    """A quadrotor task under a condition. A key gives the nominal start, except for what the condition sets.

    The condition is part of the parameters: `with_params` of another OffNominal's parameters takes its condition too.
    """

    def __init__(self, task: QuadrotorTask, condition: Condition) -> None:
        super().__init__(task, condition.uncertainty, SHAPED_FOR)
        flags = {"paper_trial": jnp.bool_(condition.paper_trial), "held_periods": jnp.int32(condition.held_periods)}
        self.params: Any = OffNominalParams(*self.params, **flags)  # pyright: ignore[reportCallIssue]

    def _advance(self, params: Any, x: plant.Flight, action: chex.Array) -> tuple[plant.Flight, chex.Array]:
        held = x.steps % params.held_periods != 0
        return super()._advance(params, x, jnp.where(held, x.previous_action, action))

    def _start(self, params: Any, key: chex.PRNGKey) -> plant.Body:
        body = super()._start(params, key)
        trial = jnp.array(TRIAL_POSITION_M), jnp.array(TRIAL_VELOCITY_M_S)
        position, velocity = (
            jnp.where(params.paper_trial, *pair)
            for pair in zip(trial, (body.pose.position_m, body.twist.velocity_m_s), strict=True)
        )
        return plant.Body(body.pose._replace(position_m=position), body.twist._replace(velocity_m_s=velocity))

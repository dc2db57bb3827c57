"""What differs from one flight to the next, as data of a task: the vehicle, what pushes it, how late it acts, how its
sensors err. `plant` draws from it.
"""

from typing import Annotated, Any

from pydantic import AfterValidator, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import NonNegative, Positive, Spec

MOST_LATENCY_S = 0.1


def ascending(pair: tuple[float, float]) -> tuple[float, float]:
    """`pair`; ValueError unless it is [least, greatest]."""
    if pair[0] > pair[1]:
        raise ValueError(f"expected [least, greatest], found [{pair[0]:g}, {pair[1]:g}]")
    return pair


Range = Annotated[tuple[NonNegative, NonNegative], AfterValidator(ascending)]
Factor = Annotated[tuple[Positive, Positive], AfterValidator(ascending)]
ZERO, ONE = (0.0, 0.0), (1.0, 1.0)


class Uncertainty(Spec):
    """Ranges [least, greatest] of what is drawn uniformly for each flight; by default nothing differs."""

    mass_factor: Factor = ONE
    inertia_factor: Factor = ONE
    thrust_factor: Factor = ONE  # of all motors
    motor_factor: Factor = ONE  # of each motor besides
    rotor_lag_factor: Factor = ONE
    rotor_lag_s: Range | None = None  # in place of the vehicle's time constants, rise and fall alike
    drag_factor: Range = ONE
    force_weights: Range = ZERO  # constant force in any direction, of the vehicle's weight
    torque_share: Range = ZERO  # constant torque about any axis, of the greatest about x or y from hover
    wind_m_s: Range = ZERO  # constant, horizontal; acts through drag
    latency_s: Range = ZERO  # from a measurement to the change of the rotors' set-points
    position_noise_m: Range = ZERO  # standard deviations: Gaussian, independent for each axis and step
    velocity_noise_m_s: Range = ZERO
    attitude_noise_rad: Range = ZERO  # of a small rotation about the body axes
    body_rate_noise_rad_s: Range = ZERO
    position_bias_m: Range = ZERO  # constant, in any direction

    @model_validator(mode="after")
    def _possible(self) -> "Uncertainty":
        if self.latency_s[1] > MOST_LATENCY_S:
            raise ValueError(f"expected latency_s of at most {MOST_LATENCY_S:g} s, found {self.latency_s[1]:g}")
        return self


def shipped_uncertainties() -> list[str]:
    """Names of the shipped uncertainties."""
    return specfile.shipped("uncertainties")


def uncertainty_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped uncertainty's file or of a `.json`; BadInput with one line if there is none."""
    return specfile.named("uncertainty", "uncertainties", name_or_path)

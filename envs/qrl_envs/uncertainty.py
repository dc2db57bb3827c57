"""What differs from one flight to the next, as data of a task: the vehicle, what pushes it, how late it acts, how its
sensors err. `plant` draws from it.
"""

import math
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import NonNegative, Positive, Spec, later

MOST_S = {"latency_s": 0.1, "position_period_s": 0.2, "position_delay_s": 0.1}  # the state of a flight grows with them


def ascending(pair: tuple[float, float]) -> tuple[float, float]:
    """`pair`; ValueError unless it is [least, greatest]."""
    if pair[0] > pair[1]:
        raise ValueError(f"expected [least, greatest], found [{pair[0]:g}, {pair[1]:g}]")
    return pair


Range = Annotated[tuple[NonNegative, NonNegative], AfterValidator(ascending)]
Factor = Annotated[tuple[Positive, Positive], AfterValidator(ascending)]
ROUNDING = 1e-6  # of a period
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
    # Constant torque about any axis, of what half of the motors have about x or y with their hover thrusts.
    torque_share: Range = ZERO
    wind_m_s: Range = ZERO  # constant, horizontal; acts through drag
    # Standard deviation along world x and y of wind that changes, and its correlation time (`gusts`).
    gust_m_s: Range = later(ZERO)
    gust_s: Factor = later(ONE)
    latency_s: Range = ZERO  # from a measurement to the change of the rotors' set-points
    position_noise_m: Range = ZERO  # standard deviations: Gaussian, independent for each axis and step
    velocity_noise_m_s: Range = ZERO
    attitude_noise_rad: Range = ZERO  # of a small rotation about the body axes
    body_rate_noise_rad_s: Range = ZERO
    position_bias_m: Range = ZERO  # constant, in any direction
    # Positions that are measured once in a period and known a delay after, and the velocity from them (`sensors`).
    position_period_s: Range = later(ZERO)  # 0: at each step, and the velocity apart
    position_delay_s: Range = later(ZERO)
    bias_wander_m: Range = later(ZERO)  # standard deviation of a bias that changes, for each axis
    bias_wander_s: Factor = later((5.0, 5.0))  # its correlation time

    @model_validator(mode="after")
    def _possible(self) -> "Uncertainty":
        for name, most_s in MOST_S.items():
            if (found := getattr(self, name)[1]) > most_s:
                raise ValueError(f"expected {name} of at most {most_s:g} s, found {found:g}")
        return self

    def excludes_lag(self, own_s: tuple[float, float]) -> str | None:
        """Which range leaves out a vehicle's own time constants, of rise and fall, in one line; None: none does."""
        name, given, own = "rotor_lag_factor", self.rotor_lag_factor, (1.0,)
        if self.rotor_lag_s is not None:
            name, given, own = "rotor_lag_s", self.rotor_lag_s, own_s
        slack = ROUNDING * given[1]
        if max(own_s) == 0.0 or (given[0] - slack <= min(own) and max(own) <= given[1] + slack):
            return None
        said = " and ".join(f"{1e3 * x:g}" for x in dict.fromkeys(own_s))
        return f"uncertainty.{name} [{given[0]:g}, {given[1]:g}] leaves out the vehicle's own lag of {said} ms"

    def layout(self, period_s: float) -> "Layout":
        """The shape of a flight's state under these ranges, at a control period."""
        late = max(self.position_period_s[1], self.position_delay_s[1], self.bias_wander_m[1]) > 0.0
        reach_s = self.position_delay_s[1] + 2.0 * max(self.position_period_s[1], period_s)
        return Layout(
            set_points=math.ceil(self.latency_s[1] / period_s - ROUNDING) + 1,
            positions=math.ceil(reach_s / period_s - ROUNDING) + 1 if late else 0,
            gusts=self.gust_m_s[1] > 0.0,
        )


class Layout(NamedTuple):
    """Shapes of a flight's state; where they differ, so do compiled programs."""

    set_points: int  # how many can matter at the greatest latency
    positions: int  # at how many of the last steps: back to the fix before the last; 0: no fixes
    gusts: bool


def shipped_uncertainties() -> list[str]:
    """Names of the shipped uncertainties."""
    return specfile.shipped("uncertainties")


def uncertainty_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped uncertainty's file or of a `.json`; BadInput with one line if there is none."""
    return specfile.named("uncertainty", "uncertainties", name_or_path)

"""Distributions of vehicles, as data of a task: each flight has a vehicle of its own, which the policy is not told.
`own_vehicle` draws it.
"""

from typing import Annotated, Any

from pydantic import AfterValidator, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import NonNegative, Positive, Spec
from qrl_envs.uncertainty import Factor, Range, ascending
from qrl_envs.vehicle import LEAST_THRUST_PER_WEIGHT

Curve = Annotated[tuple[float, float], AfterValidator(ascending)]


class VehicleDistribution(Spec):
    """Ranges [least, greatest] of quadrotors of one geometry, up to its size, which a policy of rotor speeds does not
    see: log-uniform but for what says otherwise. Its vehicle gives the places and spins of the motors.
    """

    thrust_per_weight: Factor = (1.35, 11.0)
    # Arm times the greatest thrust of a motor, over the moment of inertia about x; that about y differs by a factor.
    torque_per_inertia_1_s2: Factor = (50.0, 1200.0)
    pitch_factor: Factor = (0.85, 1.15)  # uniform
    yaw_per_roll: Factor = (0.04, 0.45)  # angular acceleration by a motor about z, over √2 times that about x
    rotor_rise_s: Factor = (0.001, 0.15)
    fall_per_rise: Factor = (0.8, 2.0)  # uniform
    thrust_curve: Curve = (-0.15, 0.4)  # uniform
    drag_1_s: Range = (0.0, 0.7)  # uniform; linear drag over mass
    # Constant force at most, of the thrust beyond the weight, of which no more than 1.5 weights count.
    force_surplus: NonNegative = 0.3
    moment_z_factor: Positive = 1.7  # moment of inertia about z over that about x

    @model_validator(mode="after")
    def _possible(self) -> "VehicleDistribution":
        if self.thrust_per_weight[0] < LEAST_THRUST_PER_WEIGHT:
            least, found = LEAST_THRUST_PER_WEIGHT, self.thrust_per_weight[0]
            raise ValueError(f"expected a thrust_per_weight of at least {least:g}, found {found:g}")
        if not -0.9 <= self.thrust_curve[0] <= self.thrust_curve[1] <= 1.0:
            raise ValueError(f"expected a thrust_curve from -0.9 to 1, found {list(self.thrust_curve)}")
        if self.moment_z_factor > 1.0 + 1.0 / self.pitch_factor[1]:
            raise ValueError(
                "expected a moment_z_factor of at most 1 + 1/pitch_factor, as of a rigid body, found"
                f" {self.moment_z_factor:g}"
            )
        return self


def shipped_distributions() -> list[str]:
    """Names of the shipped distributions."""
    return specfile.shipped("distributions")


def distribution_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped distribution's file or of a `.json`; BadInput with one line if there is none."""
    return specfile.named("distribution", "distributions", name_or_path)

"""The deployed policy as a value: weights, names and units of inputs and outputs, provenance, calibration data.

It is all that crosses from training to export, and needs NumPy alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ObservationSpec:
    name: str
    unit: str
    frame: str


@dataclass(frozen=True)
class ActionSpec:
    """One number that the policy outputs: clip(offset + scale·a, low, high) in `unit`, for a in [−1, 1]."""

    name: str
    unit: str
    frame: str
    offset: float
    scale: float
    low: float
    high: float
    safe: float  # the action when an observation is not finite
    position_m: tuple[float, ...] | None = None  # of a motor: x, y or x, y, z in the body frame
    spin: int | None = None  # of a motor: +1 if its reaction torque is positive about body z

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest action for a in [−1, 1]."""
        return max(self.low, self.offset - self.scale), min(self.high, self.offset + self.scale)


@dataclass(frozen=True)
class Provenance:
    run: str
    task: str
    description: str
    commit: str  # of the code that trained it
    seed: int
    env_steps: int


Layer = tuple[NDArray[np.float64], NDArray[np.float64]]  # weight [inputs, outputs], bias [outputs]


@dataclass(frozen=True, eq=False)
class Policy:
    """Deterministic policy in SI units: observation [..., F] -> action [..., A]."""

    provenance: Provenance
    control_period_s: float
    observations: tuple[ObservationSpec, ...]
    actions: tuple[ActionSpec, ...]
    observation_offset: NDArray[np.float64]  # [F] the network's input is clip((o − offset)·gain, ±clip)·scale
    observation_gain: NDArray[np.float64]  # [F]
    observation_clip: float  # infinite without clipping
    observation_scale: NDArray[np.float64]  # [F]
    layers: tuple[Layer, ...]
    activation: str  # of all layers but the last: "relu" or "tanh"
    calibration: NDArray[np.float32]  # [n, F] observations of the policy's own flights

    def __call__(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """Action in SI units; [..., F] -> [..., A]."""
        x = (observation - self.observation_offset) * self.observation_gain
        x = np.clip(x, -self.observation_clip, self.observation_clip) * self.observation_scale
        for weight, bias in self.layers[:-1]:
            x = ACTIVATIONS[self.activation](x @ weight + bias)
        weight, bias = self.layers[-1]
        return self.to_si(x @ weight + bias)

    def to_si(self, a: NDArray[np.floating]) -> NDArray[np.float64]:
        """Action [..., A] in SI units of the network's output a."""
        low, high = self.limits
        return np.clip(self.offset + self.scale * np.asarray(a, np.float64), low, high)

    @property
    def offset(self) -> NDArray[np.float64]:
        return np.array([action.offset for action in self.actions])

    @property
    def scale(self) -> NDArray[np.float64]:
        return np.array([action.scale for action in self.actions])

    @property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest action [A] for a in [−1, 1]."""
        low, high = zip(*(action.limits for action in self.actions), strict=True)
        return np.array(low), np.array(high)


ACTIVATIONS = {"relu": lambda x: np.maximum(x, 0.0), "tanh": np.tanh}

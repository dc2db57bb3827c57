"""The policy that ships, as a value: weights, what each number in and out means, and where it has been.

The only thing that crosses from training to export, so it needs NumPy alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Observed:
    """One number that the policy sees."""

    name: str
    unit: str
    frame: str


@dataclass(frozen=True)
class Acted:
    """One number that the policy gives: clip(offset + scale·a, low, high) for a in [−1, 1], in `unit`."""

    name: str
    unit: str
    frame: str
    offset: float
    scale: float
    low: float
    high: float
    safe: float  # what to do when nothing better is known
    position_m: tuple[float, float] | None = None  # of a motor: x, y in the body frame
    spin: int | None = None  # of a motor: +1 where its reaction torque is positive about body z


@dataclass(frozen=True)
class Origin:
    """Where a policy comes from."""

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

    origin: Origin
    control_period_s: float
    observed: tuple[Observed, ...]
    acted: tuple[Acted, ...]
    observation_offset: NDArray[np.float64]  # [F] the network sees clip((o − offset)·gain, ±clip)·scale
    observation_gain: NDArray[np.float64]  # [F]
    observation_clip: float  # infinite where there is none
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
        return self.in_units(x @ weight + bias)

    def in_units(self, a: NDArray[np.floating]) -> NDArray[np.float64]:
        """The action [..., A] in SI units of the network's output a."""
        low, high = self.limits
        return np.clip(self.offset + self.scale * np.asarray(a, np.float64), low, high)

    @property
    def offset(self) -> NDArray[np.float64]:
        return np.array([port.offset for port in self.acted])

    @property
    def scale(self) -> NDArray[np.float64]:
        return np.array([port.scale for port in self.acted])

    @property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and greatest action [A] that there can be, with a in [−1, 1]."""
        low = [max(port.low, port.offset - port.scale) for port in self.acted]
        high = [min(port.high, port.offset + port.scale) for port in self.acted]
        return np.array(low), np.array(high)


ACTIVATIONS = {"relu": lambda x: np.maximum(x, 0.0), "tanh": np.tanh}

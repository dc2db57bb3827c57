"""The deployed policy as a value: weights, names and units of inputs and outputs, memory, provenance, calibration data.

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
    vehicle: str | None = None  # None: has no name, or flies no vehicle


@dataclass(frozen=True)
class Integral:
    """The integral of the measured position p, gated: far away it stands still and cannot wind up.

    I_k = clip(I_{k−1} + control period·g(p_k), ±limit_m_s) per component, I = 0 after a reset;
    g(p) = p·max(0, 1 − |p|²/radius²)².
    """

    position: tuple[int, ...]  # indices into the observation: of p, or of the coordinates that are an error
    radius_m: float
    limit_m_s: float


@dataclass(frozen=True)
class Memory:
    """Inputs of the network that are not measured, after the observation: the previous action, then the integral.

    The previous action [A] is in SI units as it was output; after a reset, the action for a = 0.
    """

    previous_action: bool
    integral: Integral | None

    def size(self, actions: int) -> int:
        """Number of these inputs."""
        return actions * self.previous_action + (len(self.integral.position) if self.integral else 0)


Layer = tuple[NDArray[np.float64], NDArray[np.float64]]  # weight [inputs, outputs], bias [outputs]


@dataclass(frozen=True, eq=False)
class Policy:
    """Deterministic policy in SI units: inputs [..., I] -> action [..., A].

    The inputs are the measured observation [F] and, of a policy with memory, what `Memory` adds [M]; I = F + M.
    """

    provenance: Provenance
    control_period_s: float
    observations: tuple[ObservationSpec, ...]
    actions: tuple[ActionSpec, ...]
    observation_offset: NDArray[np.float64]  # [I] the network's input is clip((o − offset)·gain, ±clip)·scale
    observation_gain: NDArray[np.float64]  # [I]
    observation_clip: float  # infinite without clipping
    observation_scale: NDArray[np.float64]  # [I]
    layers: tuple[Layer, ...]
    activation: str  # of all layers but the last: "relu" or "tanh"
    calibration: NDArray[np.float32]  # [n, I] inputs of the policy's own flights
    memory: Memory | None = None

    def __call__(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """Action in SI units; [..., I] -> [..., A]. Of a policy without memory the inputs are the observation."""
        x = (inputs - self.observation_offset) * self.observation_gain
        x = np.clip(x, -self.observation_clip, self.observation_clip) * self.observation_scale
        for weight, bias in self.layers[:-1]:
            x = ACTIVATIONS[self.activation](x @ weight + bias)
        weight, bias = self.layers[-1]
        return self.to_si(x @ weight + bias)

    @property
    def memory_size(self) -> int:
        """M."""
        return self.memory.size(len(self.actions)) if self.memory else 0

    def initial_memory(self, n: int) -> NDArray[np.float64]:
        """Memory [n, M] after a reset, in the order of the inputs and in SI units."""
        memory = np.zeros((n, self.memory_size))
        if self.memory and self.memory.previous_action:
            memory[:, : len(self.actions)] = self.to_si(np.zeros(len(self.actions)))
        return memory

    def step(
        self, memory: NDArray[np.float64], observation: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Next memory [n, M] and action [n, A] for measured observations [n, F].

        Where an observation is not finite, the safe action, and the memory as it was.
        """
        observation = np.asarray(observation, np.float64)
        finite = np.isfinite(observation).all(axis=-1, keepdims=True)
        observation, before = np.where(finite, observation, 0.0), memory
        if self.memory and self.memory.integral:
            axes = len(self.memory.integral.position)
            memory = np.concatenate([memory[:, :-axes], self.integrated(memory[:, -axes:], observation)], axis=-1)
        action = self(np.concatenate([observation, memory], axis=-1))
        if self.memory and self.memory.previous_action:
            memory = np.concatenate([action, memory[:, action.shape[-1] :]], axis=-1)
        safe = np.array([port.safe for port in self.actions])
        return np.where(finite, memory, before), np.where(finite, action, safe)

    def integrated(self, total: NDArray[np.float64], observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next integral [n, k] for measured observations [n, F]."""
        assert self.memory
        assert self.memory.integral
        integral = self.memory.integral
        p = observation[:, list(integral.position)]
        gate = np.maximum(0.0, 1.0 - (p**2).sum(axis=-1, keepdims=True) / integral.radius_m**2) ** 2
        return np.clip(total + self.control_period_s * gate * p, -integral.limit_m_s, integral.limit_m_s)

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

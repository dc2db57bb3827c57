"""The deployed policy as a value: weights, names and units of inputs and outputs, memory, provenance, calibration data.

It is all that crosses from training to export, and needs NumPy alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class ObservationSpec:
    name: str
    unit: str
    frame: str
    ahead_s: float | None = None  # of the preview of a reference: how far ahead


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
    quantity: str | None = None  # where `unit` does not say it
    thrust_curve: float = 0.0  # of a motor, c: thrust is c·w + (1 − c)·w² of its greatest, w its speed of its greatest
    axis: tuple[float, float, float] = UP  # of a motor: direction of its thrust in the body frame

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
    """The integral of the error e of the measured position p, gated: far away it stands still and cannot wind up.

    I_k = clip(I_{k−1} + control period·g(e_k), ±limit_m_s) per component, I = 0 after a reset;
    g(e) = e·max(0, 1 − |e|²/radius²)². To hover, e = p. On a circle about z of radius R, e = [E, z, E·x/R, E·y/R] with
    E = (x² + y² − R²)/(2R), near the circle the distance to its radius; there |e|² is E² + z².
    """

    position: tuple[int, ...]  # indices of p in the observation: on a circle of x, y, z
    radius_m: float
    limit_m_s: float
    circle_m: float | None = None  # radius of the circle; None: hover

    @property
    def size(self) -> int:
        """k, the number of components."""
        return len(self.position) if self.circle_m is None else 4

    def error(self, position: NDArray[np.floating]) -> NDArray[np.float64]:
        """e [n, k] of positions p [n, 3]."""
        p = np.asarray(position, np.float64)
        if self.circle_m is None:
            return p
        x, y, z = p.T
        outside = (x**2 + y**2 - self.circle_m**2) / (2.0 * self.circle_m)
        return np.stack([outside, z, outside * x / self.circle_m, outside * y / self.circle_m], axis=-1)

    def gate(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """What of errors e [n, k] is integrated; [n, 1]."""
        part = error if self.circle_m is None else error[:, :2]
        return np.maximum(0.0, 1.0 - (part**2).sum(axis=-1, keepdims=True) / self.radius_m**2) ** 2


@dataclass(frozen=True)
class Memory:
    """Inputs of the network that are not measured, after the observation: the previous action, then the integral. And
    what a recurrent network remembers.

    The previous action [A] is in SI units as it was output; after a reset, the action for a = 0.
    """

    previous_action: bool
    integral: Integral | None
    units: int = 0  # H of the gated recurrent unit; 0: none

    def size(self, actions: int) -> int:
        """Number of these inputs."""
        return actions * self.previous_action + (self.integral.size if self.integral else 0)


WORLD_SIZE = 18  # numbers of a vehicle's measurements


@dataclass(frozen=True)
class BodyFrame:
    """What a network is given in the body frame, of inputs [I] that begin with a vehicle's 18 measurements: the world's
    x axis [3], if `heading`, and its z axis [3], position [3], velocity [3], body rates [3]; the vectors of the world
    that follow; then what is neither, and at the end the vector of the world that the last inputs are.
    """

    heading: bool
    vectors: int
    last: int  # how many numbers the vector at the end has: 3, or 2 of a horizontal one; 0: there is none

    @property
    def measured(self) -> int:
        """Numbers of the inputs that are measured."""
        return WORLD_SIZE + 3 * self.vectors

    @property
    def size(self) -> int:
        """Numbers of the network's input that follow from what is measured."""
        return 12 + 3 * self.heading + 3 * self.vectors

    @property
    def added(self) -> int:
        """How many numbers longer the rest becomes."""
        return 3 - self.last if self.last else 0

    def ordered(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of values [I], alike along the axes of a vector, one for each of the network's inputs."""
        return np.concatenate([values[: 3 * self.heading], values[6:], np.repeat(values[-1:], self.added)])

    def __call__(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """The network's inputs for the inputs [..., I]."""
        o = np.asarray(inputs, np.float64)
        rotation = o[..., :9].reshape(*o.shape[:-1], 3, 3)

        def rotated(at: int, numbers: int = 3) -> NDArray[np.float64]:
            return np.einsum("...ij,...i->...j", rotation[..., :numbers, :], o[..., at : at + numbers])

        end = o.shape[-1] - self.last
        parts = [o[..., : 3 * self.heading], o[..., 6:9], rotated(9), rotated(12), o[..., 15:WORLD_SIZE]]
        parts += [rotated(at) for at in range(WORLD_SIZE, self.measured, 3)]
        parts += [o[..., self.measured : end], *([rotated(end, self.last)] if self.last else [])]
        return np.concatenate(parts, axis=-1)


Layer = tuple[NDArray[np.float64], NDArray[np.float64]]  # weight [inputs, outputs], bias [outputs]


@dataclass(frozen=True, eq=False)
class GatedUnit:
    """A gated recurrent unit of D inputs x and H numbers h: with i = x W + b and m = h U + c, r = σ(i_r + m_r),
    z = σ(i_z + m_z), n = tanh(i_n + r·m_n), next h = z·h + (1 − z)·n (Cho et al. 2014, in cuDNN's form).
    """

    of_input: Layer  # [D, 3H], [3H]: W and b; r, z, n
    of_memory: Layer  # [H, 3H], [3H]: U and c

    def sums(self, x: NDArray[np.float64], h: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """i and m [..., 3H]."""
        (weight, bias), (own, own_bias) = self.of_input, self.of_memory
        return x @ weight + bias, h @ own + own_bias

    def parts(self, x: NDArray[np.float64], h: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """r, z, n and m_n [..., H] each."""
        i, m = (np.split(part, 3, axis=-1) for part in self.sums(x, h))
        r, z = sigmoid(i[0] + m[0]), sigmoid(i[1] + m[1])
        return r, z, np.tanh(i[2] + r * m[2]), m[2]

    def __call__(self, x: NDArray[np.float64], h: NDArray[np.float64]) -> NDArray[np.float64]:
        """The next h; [..., D], [..., H] -> [..., H]."""
        _, z, n, _ = self.parts(x, h)
        return z * h + (1.0 - z) * n


def sigmoid(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 + 0.5 * np.tanh(0.5 * x)


@dataclass(frozen=True, eq=False)
class Policy:
    """Deterministic policy in SI units: inputs [..., I] -> action [..., A].

    The inputs are the measured observation [F] and, of a policy with memory, what `Memory` adds: I_0 in all, of which
    the network is given scaled ones, with a `body_frame` in that. Of a recurrent policy then its h [H], from 0 after a
    reset on: I = I_0 + H.
    """

    provenance: Provenance
    control_period_s: float
    observations: tuple[ObservationSpec, ...]
    actions: tuple[ActionSpec, ...]
    observation_offset: NDArray[np.float64]  # [I_0] the network's input is clip((o − offset)·gain, ±clip)·scale
    observation_gain: NDArray[np.float64]  # [I_0]
    observation_clip: NDArray[np.float64] | float  # [I_0] or of all; infinite without clipping
    observation_scale: NDArray[np.float64]  # [I_0]
    layers: tuple[Layer, ...]
    activation: str  # of all layers but the last: "relu" or "tanh"
    calibration: NDArray[np.float32]  # [n, I] inputs of the policy's own flights
    memory: Memory | None = None
    body_frame: BodyFrame | None = None
    unit: GatedUnit | None = None  # before the last layer

    def __call__(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """Action in SI units; [..., I] -> [..., A]. Of a policy without memory the inputs are the observation."""
        return self.respond(inputs)[1]

    def respond(self, inputs: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The next h [..., H], of a feed-forward policy [..., 0], and the action [..., A] in SI units; of [..., I]."""
        x, h = np.split(np.asarray(inputs, np.float64), [len(self.observation_scale)], axis=-1)
        x = (x - self.observation_offset) * self.observation_gain
        x = np.clip(x, -self.observation_clip, self.observation_clip) * self.observation_scale
        x = self.seen(x)
        for weight, bias in self.layers[:-1]:
            x = ACTIVATIONS[self.activation](x @ weight + bias)
        if self.unit:
            x = h = self.unit(x, h)
        weight, bias = self.layers[-1]
        return h, self.to_si(x @ weight + bias)

    def seen(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """What the network is given of inputs [..., I_0], scaled or not."""
        return self.body_frame(inputs) if self.body_frame else np.asarray(inputs, np.float64)

    @property
    def input_gain(self) -> NDArray[np.float64]:
        """The network's inputs over those in SI units; one for each row of its first layer."""
        gain = self.observation_gain * self.observation_scale
        return self.body_frame.ordered(gain) if self.body_frame else gain

    @property
    def memory_size(self) -> int:
        """Numbers of the memory: those among the inputs, and H."""
        return self.memory.size(len(self.actions)) + self.memory.units if self.memory else 0

    def initial_memory(self, n: int) -> NDArray[np.float64]:
        """Memory [n, memory_size] after a reset, in the order of the inputs and in SI units."""
        memory = np.zeros((n, self.memory_size))
        if self.memory and self.memory.previous_action:
            memory[:, : len(self.actions)] = self.to_si(np.zeros(len(self.actions)))
        return memory

    def step(
        self, memory: NDArray[np.float64], observation: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Next memory [n, memory_size] and action [n, A] for measured observations [n, F].

        Where an observation is not finite, the safe action, and the memory as it was.
        """
        observation = np.asarray(observation, np.float64)
        finite = np.isfinite(observation).all(axis=-1, keepdims=True)
        observation, before = np.where(finite, observation, 0.0), memory
        first = len(self.actions) if self.memory and self.memory.previous_action else 0
        last = self.memory_size - (self.memory.units if self.memory else 0)
        previous, total, h = np.split(memory, [first, last], axis=-1)
        if self.memory and self.memory.integral:
            total = self.integrated(total, observation)
        h, action = self.respond(np.concatenate([observation, previous, total, h], axis=-1))
        memory = np.concatenate([action[:, :first], total, h], axis=-1)
        safe = np.array([port.safe for port in self.actions])
        return np.where(finite, memory, before), np.where(finite, action, safe)

    def integrated(self, total: NDArray[np.float64], observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next integral [n, k] for measured observations [n, F]."""
        assert self.memory
        assert self.memory.integral
        integral = self.memory.integral
        e = integral.error(observation[:, list(integral.position)])
        return np.clip(total + self.control_period_s * integral.gate(e) * e, -integral.limit_m_s, integral.limit_m_s)

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

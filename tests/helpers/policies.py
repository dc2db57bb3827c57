"""Policies without training: seeded networks of any shape, with flights made up for them to be calibrated on."""

from dataclasses import astuple, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from qrl.export import emit, vectors
from qrl.export import kernel as reference
from qrl.export.kernel import Kernel
from qrl.export.policy import (
    ACTIVATIONS,
    ActionSpec,
    BodyFrame,
    GatedUnit,
    Integral,
    Memory,
    ObservationSpec,
    Policy,
    Provenance,
)
from qrl.export.quantize import quantize
from qrl.export.vectors import Vectors
from qrl_envs import io_spec
from qrl_envs import task as tasks

PROVENANCE = Provenance(
    run="made-up",
    task="hover",
    description="reach a point and hover there",
    commit="0123456789ab",
    seed=3,
    env_steps=1_234_567,
)
HOVER, PENDULUM, ODD, FLAT = (18, 64, 64, 4), (3, 64, 64, 1), (5, 7, 3, 2), (18, 4)
TRACK = (24, 40, 4)  # with a preview of two times

NAME = "hover"  # of kernels, unless another is given


def emitted_files(name: str = NAME) -> set[str]:
    """What an export holds, but for its report."""
    return {
        *("examples/bare_metal/CMakeLists.txt", "examples/bare_metal/Makefile", "examples/bare_metal/main.c"),
        *(f"examples/{name}/{name}.ino", "golden.csv", "library.json", "library.properties", "manifest.json"),
        *(f"{name}.c", f"{name}.h"),
    }


def hover_flights(rng: np.random.Generator, n: int) -> np.ndarray:
    """Observations [n, 18]: attitudes, positions, velocities and rates from a wild start to rest at the hover point."""
    left = rng.uniform(0.01, 1.0, (n, 1)) ** 2  # how much of the start is left
    x, y, z = left.T * rng.normal(size=(3, n))
    w = np.sqrt(1.0 - np.minimum(x**2 + y**2 + z**2, 1.0))
    size = np.sqrt(w**2 + x**2 + y**2 + z**2)
    w, x, y, z = w / size, x / size, y / size, z / size
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    moving = left * rng.normal(size=(n, 9)) * np.repeat([1.0, 1.5, 4.0], 3)
    return np.concatenate([np.array(rotation).reshape(9, n).T, moving], axis=1).astype(np.float32)


def track_flights(rng: np.random.Generator, n: int) -> np.ndarray:
    """Observations [n, 24]: as of hover, and two previews."""
    return np.concatenate([hover_flights(rng, n), rng.normal(size=(n, 6)) * [0.3, 0.3, 0.1, 1, 1, 0.4]], axis=1).astype(
        np.float32
    )


def pendulum_flights(rng: np.random.Generator, n: int) -> np.ndarray:
    """Observations [n, 3], many of them at rest near upright."""
    left = rng.uniform(0.0, 1.0, n) ** 3
    angle = left * rng.uniform(-np.pi, np.pi, n)
    return np.stack([np.cos(angle), np.sin(angle), left * rng.normal(size=n) * 4.0], axis=1).astype(np.float32)


def odd_flights(rng: np.random.Generator, n: int) -> np.ndarray:
    """Observations [n, 5] far from zero and of very different sizes."""
    sizes, middles = np.array([1e-3, 1.0, 300.0, 0.05, 7.0]), np.array([2e-3, 0.0, -900.0, 1.0, 20.0])
    return (middles + sizes * rng.normal(size=(n, 5))).astype(np.float32)


def _specs(sizes: tuple[int, ...]) -> tuple[tuple[ObservationSpec, ...], tuple[ActionSpec, ...]]:
    name = {(18, 4): "hover", (24, 4): "track", (3, 1): "pendulum"}.get((sizes[0], sizes[-1]))
    if name:
        task = tasks.load(name)
        if name == "track":
            task = task.model_copy(update={"preview_s": (0.1, 0.5)})
        return (
            tuple(ObservationSpec(**port._asdict()) for port in io_spec.observations(task)),
            tuple(ActionSpec(**port._asdict()) for port in io_spec.actions(task)),
        )
    return (
        tuple(ObservationSpec(f"o{i}", "?", "as it comes") for i in range(sizes[0])),
        tuple(ActionSpec(f"a{i}", "?", "as it comes", 0.5 * i, 2.0 + i, -1.5, 2.0, 0.25) for i in range(sizes[-1])),
    )


@cache
def policy(sizes: tuple[int, ...] = HOVER, activation: str = "relu", seed: int = 0, samples: int = 1500) -> Policy:
    """A lively policy of these layer sizes: actions spread over their range, some of them clipped.

    The odd one normalizes its observations and clips them, as a run with `normalize_observations` does.
    """
    rng = np.random.default_rng([seed, *sizes])
    flights = {18: hover_flights, 24: track_flights, 3: pendulum_flights, 5: odd_flights}[sizes[0]](rng, samples)
    normalized = sizes == ODD
    observations, actions = _specs(sizes)
    made = Policy(
        provenance=PROVENANCE,
        control_period_s=0.05 if sizes[0] == 3 else 0.01,
        observations=observations,
        actions=actions,
        observation_offset=flights.mean(axis=0, dtype=float) if normalized else np.zeros(sizes[0]),
        observation_gain=1.0 / flights.std(axis=0, dtype=float) if normalized else np.ones(sizes[0]),
        observation_clip=10.0 if normalized else np.inf,
        observation_scale=rng.uniform(0.25, 1.0, sizes[0]),
        layers=tuple(
            (rng.normal(size=(i, o)) * (2.0 / i) ** 0.5, 0.1 * rng.normal(size=o)) for i, o in pairwise(sizes)
        ),
        activation=activation,
        calibration=flights,
    )
    *rest, (weight, bias) = made.layers
    a = outputs(made, flights)
    weight, middle = 0.7 * weight / a.std(axis=0), 0.7 * (a - bias).mean(axis=0) / a.std(axis=0)
    return replace(made, layers=(*rest, (weight, bias - middle)))


# Both kinds of memory, and each alone; in the body frame a circle, a preview, and no integral; a circle in the world
# frame; an odd number of actions; positions of very different sizes and steps, clipped.
REMEMBERING = {
    "both": (HOVER, Memory(True, Integral((9, 10, 11), radius_m=1.0, limit_m_s=0.4))),
    "circle": (HOVER, Memory(True, Integral((9, 10, 11), radius_m=0.9, limit_m_s=0.3, circle_m=1.5))),
    "track": (TRACK, Memory(True, Integral((9, 10, 11), radius_m=0.5, limit_m_s=0.6))),
    "body": (HOVER, Memory(True, None)),
    "world circle": (HOVER, Memory(False, Integral((9, 10, 11), radius_m=0.4, limit_m_s=0.2, circle_m=0.5))),
    "action": (HOVER, Memory(True, None)),
    "integral": (HOVER, Memory(False, Integral((9, 10, 11), radius_m=0.3, limit_m_s=0.05))),
    "one action": (PENDULUM, Memory(True, Integral((2, 0, 1), radius_m=3.0, limit_m_s=1.0))),
    "odd": (ODD, Memory(True, Integral((1, 4, 3), radius_m=25.0, limit_m_s=20.0))),
    "recurrent": (TRACK, Memory(True, Integral((9, 10, 11), radius_m=0.5, limit_m_s=0.6), units=10)),
    "recurrent alone": (ODD, Memory(False, None, units=7)),
}


FRAMES = {"circle": BodyFrame(False, 0, 2), "track": BodyFrame(True, 2, 3), "body": BodyFrame(False, 0, 0)}
FRAMES["recurrent"] = FRAMES["track"]


def gated_unit(rng: np.random.Generator, inputs: int, units: int) -> GatedUnit:
    """A lively one: gates and candidate spread over their ranges."""

    def layer(rows: int, outputs: int) -> tuple[np.ndarray, np.ndarray]:
        return rng.normal(size=(rows, outputs)) * (2.0 / rows) ** 0.5, 0.5 * rng.normal(size=outputs)

    return GatedUnit(layer(inputs, 3 * units), layer(units, 3 * units))


def in_body_frame(base: Policy, frame: BodyFrame) -> Policy:
    """A policy of a vehicle whose network is given its observations in the body frame."""
    scale = np.concatenate([np.repeat([1.0, 0.8, 0.5, 0.3], [9, 3, 3, 3]), np.repeat([0.4, 0.6], 3)])[: frame.measured]
    (weight, bias), *others = base.layers
    rows = np.concatenate([weight[: 3 * frame.heading], weight[6:]])
    return replace(base, body_frame=frame, observation_scale=scale, layers=((rows, bias), *others))


@cache
def remembering(which: str = "both", activation: str = "relu") -> Policy:
    """A lively policy with memory: each of its inputs moves the actions."""
    sizes, memory = REMEMBERING[which]
    base, frame = policy(sizes, activation), FRAMES.get(which)
    if frame:
        base = in_body_frame(base, frame)
    actions, n = len(base.actions), len(base.calibration)
    rng = np.random.default_rng([7, *sizes])
    columns, offset, gain = [base.calibration], [base.observation_offset], [base.observation_gain]
    if memory.previous_action:
        columns.append(rng.permutation(base.to_si(rng.uniform(-1.2, 1.2, (n, actions)))))
        offset.append(base.offset)
        gain.append(1.0 / base.scale)
    if memory.integral:
        columns.append(memory.integral.limit_m_s * rng.uniform(-1.0, 1.0, (n, memory.integral.size)) ** 3)
        offset.append(np.zeros(memory.integral.size))
        gain.append(np.full(memory.integral.size, 2.0 / memory.integral.limit_m_s))
    (weight, bias), *hidden, (last, last_bias) = base.layers
    rows = memory.size(actions) + (frame.added if frame else 0)
    more = rng.normal(size=(rows, weight.shape[1])) * 0.5 * (2.0 / len(weight)) ** 0.5
    scale = rng.uniform(0.5, 1.0, memory.size(actions))
    if frame and frame.last:
        scale[-frame.last :] = 0.7  # a vector: the same along its axes
    unit = None
    if memory.units:
        unit = gated_unit(rng, len(hidden[-1][1]) if hidden else len(bias), memory.units)
        columns.append(rng.uniform(-1.0, 1.0, (n, memory.units)))
        last = rng.normal(size=(memory.units, actions))
    made = replace(
        base,
        unit=unit,
        memory=memory,
        observation_offset=np.concatenate(offset),
        observation_gain=np.concatenate(gain),
        observation_scale=np.concatenate([base.observation_scale, scale]),
        layers=((np.concatenate([weight, more]), bias), *hidden, (last, last_bias)),
        calibration=np.concatenate(columns, axis=1).astype(np.float32),
    )
    a = outputs(made, made.calibration)
    last, middle = 0.7 * last / a.std(axis=0), 0.7 * (a - last_bias).mean(axis=0) / a.std(axis=0)
    return replace(made, layers=(*made.layers[:-1], (last, last_bias - middle)))


@cache
def remembering_kernel(which: str = "both", activation: str = "relu") -> Kernel:
    """`remembering` of the same arguments, quantized once for all tests."""
    return quantize(remembering(which, activation))


def literal_view(row: np.ndarray, heading: bool, vectors: int, last: int) -> list[float]:
    """What a network is given of inputs [I] in the body frame."""
    to_body = row[:9].reshape(3, 3).T
    found = [*(to_body @ [1.0, 0.0, 0.0]), *(to_body @ [0.0, 0.0, 1.0])][0 if heading else 3 :]
    found += [*(to_body @ row[9:12]), *(to_body @ row[12:15]), *row[15:18]]
    for k in range(vectors):
        found += [*(to_body @ row[18 + 3 * k : 21 + 3 * k])]
    rest = row[18 + 3 * vectors :]
    if not last:
        return [*found, *rest]
    return [*found, *rest[:-last], *(to_body[:, :last] @ rest[-last:])]


def outputs(policy: Policy, inputs: np.ndarray) -> np.ndarray:
    """The network's own outputs [n, A], written apart from Policy."""
    return outputs_and_unit(policy, inputs)[0]


def outputs_and_unit(policy: Policy, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The network's own outputs [n, A] and its next h [n, H], written apart from Policy."""
    inputs, h = inputs[:, : len(policy.observation_scale)], inputs[:, len(policy.observation_scale) :].astype(float)
    x = (inputs.astype(np.float64) - policy.observation_offset) * policy.observation_gain
    x = np.minimum(np.maximum(x, -policy.observation_clip), policy.observation_clip) * policy.observation_scale
    if frame := policy.body_frame:
        x = np.array([literal_view(row, *astuple(frame)) for row in x])
    for i, (weight, bias) in enumerate(policy.layers):
        if policy.unit and i == len(policy.layers) - 1:
            x = h = literal_unit(policy.unit, x, h)
        x = np.einsum("ni,io->no", x, weight) + bias
        if i < len(policy.layers) - 1:
            x = ACTIVATIONS[policy.activation](x)
    return x, h


def literal_unit(unit: GatedUnit, x: np.ndarray, h: np.ndarray) -> np.ndarray:
    """The next h [n, H], number by number."""
    (of_x, bias_x), (of_h, bias_h), units = unit.of_input, unit.of_memory, h.shape[1]
    after = np.empty_like(h)
    for k in range(len(h)):
        i = [bias_x[j] + sum(x[k, a] * of_x[a, j] for a in range(x.shape[1])) for j in range(3 * units)]
        m = [bias_h[j] + sum(h[k, a] * of_h[a, j] for a in range(units)) for j in range(3 * units)]
        for j in range(units):
            r, z = (1.0 / (1.0 + np.exp(-i[at] - m[at])) for at in (j, units + j))
            n = np.tanh(i[2 * units + j] + r * m[2 * units + j])
            after[k, j] = z * h[k, j] + (1.0 - z) * n
    return after


@cache
def kernel(sizes: tuple[int, ...] = HOVER, activation: str = "relu", seed: int = 0) -> Kernel:
    """`policy` of the same arguments, quantized once for all tests."""
    return quantize(policy(sizes, activation, seed))


def step(kernel: Kernel, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Status and action of the reference's float entry, from a reset."""
    return reference.step(kernel, reference.initial_state(kernel, len(observation)), observation)[1:]


def step_i16(kernel: Kernel, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Status and action of the reference's fixed-point entry, from a reset."""
    return reference.step_i16(kernel, reference.initial_state(kernel, len(observation)), observation)[1:]


def emitted(folder: Path, policy: Policy, kernel: Kernel, golden: Vectors | None = None, name: str = NAME) -> Path:
    """All that is emitted but the report, written to `folder`; the path of the kernel's C."""
    for file, text in emit.files(policy, kernel, golden or vectors.golden(policy, kernel), name).items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder / f"{name}.c"

"""The float policy for other programs: an ONNX graph of one step, and all of its numbers as NumPy arrays.

Both are float32 and for n vehicles at once. The graph has the inputs `observation` [n, F] and, of a policy with memory,
`memory` [n, M], and the outputs `action` [n, A] and `next_memory` [n, M]: in SI units and in the order of
`Policy.initial_memory`. What the kernel does with an observation that is not finite, the graph leaves to the caller.
"""

import io
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from qrl.export.policy import WORLD_SIZE, BodyFrame, GatedUnit, Integral, Layer, Policy

OPSET = 17  # what runtimes of 2023 and later read


def onnx_model(policy: Policy) -> bytes:
    """The ONNX model of `Policy.step`, checked."""
    graph = _Graph()
    observation, inputs = "observation", ["observation"]
    sizes = {"observation": len(policy.observations)}
    previous = total = h = ""
    if policy.memory:
        sizes["memory"] = policy.memory_size
        first = len(policy.actions) * policy.memory.previous_action
        parts = [first, policy.memory.integral.size if policy.memory.integral else 0, policy.memory.units]
        previous, total, h = graph.split("memory", parts)
        if policy.memory.integral:
            total = _integrated(graph, policy.memory.integral, policy.control_period_s, total, observation)
        inputs += [name for name in (previous, total) if name]
    x = graph.concat(inputs)
    x = graph.node(
        "Mul", graph.node("Sub", x, graph.constant(policy.observation_offset)), graph.constant(policy.observation_gain)
    )
    if np.isfinite(policy.observation_clip).any():
        most = np.broadcast_to(policy.observation_clip, policy.observation_scale.shape)
        x = graph.node("Max", graph.node("Min", x, graph.constant(most)), graph.constant(-most))
    x = graph.node("Mul", x, graph.constant(policy.observation_scale))
    if policy.body_frame:
        x = _in_body_frame(graph, policy.body_frame, x, len(policy.observation_scale))
    for layer in policy.layers[:-1]:
        x = graph.node({"relu": "Relu", "tanh": "Tanh"}[policy.activation], graph.dense(x, layer))
    if policy.unit:
        x = h = _unit(graph, policy.unit, x, h)
    a = graph.dense(x, policy.layers[-1])
    low, high = policy.limits
    si = graph.node("Add", graph.node("Mul", a, graph.constant(policy.scale)), graph.constant(policy.offset))
    action = graph.node("Max", graph.node("Min", si, graph.constant(high)), graph.constant(low))
    outputs = {"action": (action, len(policy.actions))}
    if policy.memory:
        kept = [action if previous else "", total, h]
        outputs["next_memory"] = graph.concat([name for name in kept if name]), policy.memory_size
    return graph.model(policy, sizes, outputs)


def arrays(policy: Policy) -> bytes:
    """A .npz file of the policy's numbers, float32, as docs/deploy.md names them."""
    named: dict[str, NDArray[Any]] = {
        "observation_offset": policy.observation_offset,
        "observation_gain": policy.observation_gain,
        "observation_clip": np.array(policy.observation_clip),
        "observation_scale": policy.observation_scale,
        "action_offset": policy.offset,
        "action_scale": policy.scale,
        "action_limits": np.stack(policy.limits),
    }
    for i, layer in enumerate(policy.layers):
        named |= _layer(f"layer_{i}", layer)
    if policy.unit:
        named |= _layer("unit_of_input", policy.unit.of_input) | _layer("unit_of_memory", policy.unit.of_memory)
    file = io.BytesIO()
    plain: dict[str, Any] = {name: np.asarray(values, np.float32) for name, values in named.items()}
    np.savez(file, **plain)
    return file.getvalue()


def _layer(name: str, layer: Layer) -> dict[str, NDArray[Any]]:
    return {f"{name}_weight": layer[0], f"{name}_bias": layer[1]}


class _Graph:
    """Nodes and constants as they are added; methods return the names of their results."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        name = f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def constant(self, values: Any, kind: Any = np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def integers(self, *values: int) -> str:
        return self.constant(values, np.int64)

    def dense(self, x: str, layer: Layer) -> str:
        return self.node("Gemm", x, self.constant(layer[0]), self.constant(layer[1]))

    def clip(self, x: str, least: float, most: float) -> str:
        return self.node("Clip", x, self.constant(least), self.constant(most))

    def concat(self, parts: list[str], axis: int = 1) -> str:
        return self.node("Concat", *parts, axis=axis) if len(parts) > 1 else parts[0]

    def split(self, x: str, sizes: list[int]) -> list[str]:
        """Columns of x [n, sum of sizes]; "" for a part without any."""
        found = iter(self.columns(x, *bounds) for bounds in _bounds(sizes))
        return [next(found) if size else "" for size in sizes]

    def columns(self, x: str, first: int, last: int, axis: int = 1) -> str:
        return self.node("Slice", x, self.integers(first), self.integers(last), self.integers(axis))

    def model(self, policy: Policy, inputs: dict[str, int], outputs: dict[str, tuple[str, int]]) -> bytes:
        for name, (result, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [result], [name]))
        sizes = {name: size for name, (_, size) in outputs.items()}
        ports = [
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size]) for name, size in each.items()]
            for each in (inputs, sizes)
        ]
        graph = helper.make_graph(self.nodes, policy.provenance.task, *ports, initializer=self.constants)
        model = helper.make_model(graph, producer_name="qrl", opset_imports=[helper.make_opsetid("", OPSET)])
        model.ir_version = helper.find_min_ir_version_for(model.opset_import)
        names = {
            "observation": [port.name for port in policy.observations],
            "action": [f"{port.name} [{port.unit}]" for port in policy.actions],
        }
        about = {name: " ".join(values) for name, values in names.items()}
        helper.set_model_props(model, about | {"control_period_s": f"{policy.control_period_s:g}"})
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)


def _bounds(sizes: list[int]) -> list[tuple[int, int]]:
    """First and last column of each part that has any."""
    ends = np.cumsum(sizes).tolist()
    return [(end - size, end) for size, end in zip(sizes, ends, strict=True) if size]


def _integrated(graph: _Graph, integral: Integral, period_s: float, total: str, observation: str) -> str:
    """`Policy.integrated`."""
    p = graph.node("Gather", observation, graph.integers(*integral.position), axis=1)
    e = part = p
    if (radius_m := integral.circle_m) is not None:
        x, y, z = graph.split(p, [1, 1, 1])
        square = graph.node("Add", graph.node("Mul", x, x), graph.node("Mul", y, y))
        over = graph.node("Sub", square, graph.constant(radius_m**2))
        outside = graph.node("Mul", over, graph.constant(0.5 / radius_m))
        center = graph.node("Mul", outside, graph.constant(1.0 / radius_m))
        e = graph.concat([outside, z, graph.node("Mul", center, x), graph.node("Mul", center, y)])
        part = graph.concat([outside, z])
    square = graph.node("ReduceSum", graph.node("Mul", part, part), graph.integers(1), keepdims=1)
    far = graph.node("Mul", square, graph.constant(1.0 / integral.radius_m**2))
    inside = graph.node("Relu", graph.node("Sub", graph.constant(1.0), far))
    gate = graph.node("Mul", graph.node("Mul", inside, inside), graph.constant(period_s))
    more = graph.node("Add", total, graph.node("Mul", gate, e))
    return graph.clip(more, -integral.limit_m_s, integral.limit_m_s)


def _in_body_frame(graph: _Graph, frame: BodyFrame, x: str, size: int) -> str:
    """`BodyFrame.__call__` of `size` inputs."""
    matrix = graph.node("Reshape", graph.columns(x, 0, 9), graph.integers(-1, 3, 3))

    def rotated(at: int, numbers: int = 3) -> str:
        rows = matrix if numbers == 3 else graph.columns(matrix, 0, numbers)
        vector = graph.node("Reshape", graph.columns(x, at, at + numbers), graph.integers(-1, 1, numbers))
        return graph.node("Reshape", graph.node("MatMul", vector, rows), graph.integers(-1, 3))

    end = size - frame.last
    parts = [graph.columns(x, 0, 3)] * frame.heading + [graph.columns(x, 6, 9), rotated(9), rotated(12)]
    parts += [graph.columns(x, 15, WORLD_SIZE), *(rotated(at) for at in range(WORLD_SIZE, frame.measured, 3))]
    parts += [graph.columns(x, frame.measured, end)] * (end > frame.measured)
    return graph.concat(parts + ([rotated(end, frame.last)] if frame.last else []))


def _unit(graph: _Graph, unit: GatedUnit, x: str, h: str) -> str:
    """`GatedUnit.__call__`."""
    size = len(unit.of_memory[0])
    i, m = (graph.split(graph.dense(*of), [size] * 3) for of in ((x, unit.of_input), (h, unit.of_memory)))
    r, z = (graph.node("Sigmoid", graph.node("Add", i[k], m[k])) for k in (0, 1))
    n = graph.node("Tanh", graph.node("Add", i[2], graph.node("Mul", r, m[2])))
    return graph.node("Add", n, graph.node("Mul", z, graph.node("Sub", h, n)))

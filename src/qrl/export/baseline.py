"""The same network in plain float32 and in naive int8: baselines for the kernel's costs and errors."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from qrl.export.targets import SOURCES, Floats, Ints

Layers = Sequence[tuple[Floats, Floats]]  # weight [in, out] and bias [out] of each, the last without activation
LIBRARIES = ("-lm",)
_ACTIVATIONS = {"tanh": (np.tanh, "tanhf(x)"), "relu": (lambda x: np.maximum(x, 0), "((x) > 0.0f ? (x) : 0.0f)")}


class NaiveLayer(NamedTuple):
    weight: Ints  # int8 [in, out]
    bias: Ints  # int32 [out]
    multiplier: int  # accumulator·multiplier >> shift is the next tensor's int8
    shift: int
    table: Ints | None  # int8 [256], of the activation; None for the last layer


class Naive(NamedTuple):
    """An int8 network with one scale per tensor: real = int8 · scale."""

    layers: list[NaiveLayer]
    obs_scale: float
    act_scale: float


def naive(layers: Layers, activation: str, obs: Floats) -> Naive:
    """`layers` in int8, each tensor scaled to its largest value over the observations [N, O]."""
    x, quantized = np.asarray(obs, np.float64), list[NaiveLayer]()
    obs_scale = scale = _scale(x)
    for index, (weight, bias) in enumerate(layers):
        y = x @ weight + bias
        weight_scale, y_scale = _scale(weight), _scale(y)
        shift = 29 - int(np.floor(np.log2(scale * weight_scale / y_scale)))  # a multiplier of 30 bits
        multiplier = round(scale * weight_scale / y_scale * 2**shift)
        table, next_scale = None, y_scale
        if index < len(layers) - 1:
            x = _ACTIVATIONS[activation][0](y)
            next_scale = _scale(x)
            table = _int8(_ACTIVATIONS[activation][0](np.arange(-128, 128) * y_scale), next_scale)
        bias_i32 = np.rint(bias / (scale * weight_scale)).astype(np.int32)
        quantized.append(NaiveLayer(_int8(weight, weight_scale), bias_i32, multiplier, shift, table))
        scale = next_scale
    return Naive(quantized, obs_scale, scale)


def to_int8(network: Naive, obs: Floats) -> Ints:
    """Observations [N, O] as int8 inputs of the naive network, stored in int16."""
    return _int8(obs, network.obs_scale).astype(np.int16)


def infer(network: Naive, obs: Ints) -> Ints:
    """Outputs [N, A] of the naive network, int8 in int16, for the result of `to_int8`; action = output·act_scale."""
    x = obs.astype(np.int64)
    for layer in network.layers:
        scaled = (x @ layer.weight.astype(np.int64) + layer.bias) * layer.multiplier
        y = np.clip((scaled + (1 << (layer.shift - 1))) >> layer.shift, -127, 127)
        x = y if layer.table is None else layer.table[y + 128].astype(np.int64)
    return x.astype(np.int16)


def _scale(values: Floats) -> float:
    return float(np.abs(values).max() or 1.0) / 127


def _int8(values: Floats, scale: float) -> Ints:
    return np.clip(np.rint(values / scale), -127, 127).astype(np.int8)


def data(layers: Layers, activation: str, obs: Floats) -> str:
    """baseline_data.h: the weights for harness/baseline.c."""
    network, parts, rows = naive(layers, activation, obs), list[str](), list[str]()
    for i, ((weight, bias), int8) in enumerate(zip(layers, network.layers, strict=True)):
        inputs, outputs = weight.shape
        parts += [
            _array("float", f"weight_{i}", _hex(weight.T)),
            _array("float", f"bias_{i}", _hex(bias)),
            _array("int8_t", f"weight_i8_{i}", map(str, int8.weight.T.ravel())),
            _array("int32_t", f"bias_i32_{i}", map(str, int8.bias)),
        ]
        if int8.table is not None:
            parts.append(_array("int8_t", f"table_{i}", map(str, int8.table)))
        names = f"weight_{i}, bias_{i}, weight_i8_{i}, bias_i32_{i}"
        table = "0" if int8.table is None else f"table_{i}"
        rows.append(f"{{{inputs}, {outputs}, {names}, {int8.multiplier}, {int8.shift}, {table}}}")
    widest = max(n for weight, _ in layers for n in weight.shape)
    head = f"#define LAYERS {len(layers)}\n#define WIDEST {widest}\n#define ACTIVATION(x) {_ACTIVATIONS[activation][1]}"
    return "\n".join([head, *parts, _array("struct layer", "layers", rows)])


def _hex(values: Floats) -> Iterable[str]:
    """float32 in C99's hexadecimal, which is exact."""
    return (f"{float(v).hex()}f" for v in np.asarray(values, np.float32).ravel())


def _array(kind: str, name: str, values: Iterable[str]) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(values)}}};\n"


def write(folder: Path, layers: Layers, activation: str, obs: Floats) -> Path:
    """A kernel in `folder` for `run_core(..., libraries=LIBRARIES)`; its int16 entry is the naive int8 network."""
    folder.mkdir(parents=True, exist_ok=True)
    inputs, outputs = layers[0][0].shape[0], layers[-1][0].shape[1]
    header = (SOURCES / "baseline.h").read_text(encoding="utf-8")
    sizes = f"#define BASELINE_OBS_SIZE {inputs}\n#define BASELINE_ACT_SIZE {outputs}\n"
    (folder / "baseline.h").write_text(sizes + header, encoding="utf-8")
    (folder / "baseline_data.h").write_text(data(layers, activation, obs), encoding="utf-8")
    return Path(shutil.copy(SOURCES / "baseline.c", folder))

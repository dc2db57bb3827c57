"""What the kernel is compared with: its network in plain float32 and in naive int8 (one scale per tensor).

    .venv/bin/python -m experiments.kernel.plain RUN

Prints the action error of naive int8 on the calibration of the run's policy, and, where the Arm compiler and QEMU are
installed, the instructions per inference of both on each core. `make export RUN=…` prints those of the kernel.
"""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from experiments.arguments import Parser, run_main
from qrl.evaluation.trained_run import TrainedRun
from qrl.export import targets
from qrl.export.accuracy import accuracy
from qrl.export.quantize import si_layers
from qrl.export.targets import CORES, Floats, Ints, VerificationFailed
from qrl.export.vectors import Observations
from qrl_envs.specfile import BadInput

SOURCES = Path(__file__).parent
COST_OBSERVATIONS = 20
FLAGS = ("-std=c99", "-O2")
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
    """plain_data.h: the weights for plain.c."""
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
    header = (SOURCES / "plain.h").read_text(encoding="utf-8")
    sizes = f"#define PLAIN_OBS_SIZE {inputs}\n#define PLAIN_ACT_SIZE {outputs}\n"
    (folder / "plain.h").write_text(sizes + header, encoding="utf-8")
    (folder / "plain_data.h").write_text(data(layers, activation, obs), encoding="utf-8")
    return Path(shutil.copy(SOURCES / "plain.c", folder))


def main(argv: list[str] | None = None) -> int:
    parser = Parser("plain", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    try:
        policy = TrainedRun.load(parser.parse_args(argv).run).policy()
    except BadInput as error:
        parser.error(str(error))
    layers, sample = si_layers(policy), policy.calibration
    network = naive(layers, policy.activation, sample)

    def flown(obs: Floats) -> Floats:
        return np.clip(infer(network, to_int8(network, obs)) * network.act_scale, *policy.limits)

    error = accuracy(policy, flown, sample)
    print(f"naive int8: RMS action error {error.rmse:.2%}, maximum {error.maximum:.1%} of full scale")
    missing = {core.toolchain: targets.missing_tools(core.toolchain) for core in CORES}
    for toolchain, tools in missing.items():
        if tools:
            print(f"no costs on {toolchain.family}: {', '.join(tools)} not found")
    obs = sample[:: max(1, len(sample) // COST_OBSERVATIONS)][:COST_OBSERVATIONS]
    print(f"{'instructions per inference':<27} {'plain float32':>14} {'naive int8':>11}")
    with TemporaryDirectory() as scratch:
        work = Path(scratch)
        kernel = write(work / "plain", layers, policy.activation, sample)
        given = Observations(obs, to_int8(network, obs))
        for core in (core for core in CORES if not missing[core.toolchain]):
            try:
                _, counts = targets.run_core(core, kernel, work, FLAGS, given, LIBRARIES)
                print(f"{core.name:<27} {counts.f32.mean():>14,.0f} {counts.i16.mean():>11,.0f}")
            except VerificationFailed as failure:
                print(f"{core.name:<27} {failure}")
    return 0


if __name__ == "__main__":
    run_main("plain", main)

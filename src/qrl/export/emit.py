"""The files of an export: the C templates of this package filled with tables, the manifest, golden vectors."""

import csv
import io
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as reference
from qrl.export.kernel import Dense, Integral, Ints, Kernel, Memory
from qrl.export.policy import UP, Policy
from qrl.export.vectors import Vectors, embedded

FORMAT = 2
TEMPLATES = Path(__file__).parent / "templates"
FRAMES = " * World and body frames: x forward, y left, z up. SI units.\n *"


MAX_NAME = 64
# A file of this name would stand for a header of the C library, or of a firmware beside whose files it is put.
RESERVED = {
    *("assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits", "locale", "math"),
    *("setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time"),
    *("wchar", "wctype"),
    *("app", "controller", "controller_pid", "debug", "freertos", "log", "neural_network", "nn_controller", "param"),
    *("platform", "platform_defaults", "task", "usec_time"),
    "bare_metal",  # the folder of the other example
    *("changed", "golden", "last", "next"),  # with _state or _step a variable's of the sources around the kernel
}


def is_name(name: str) -> bool:
    """Whether it can prefix the symbols of a kernel: a C identifier, and not `RESERVED`."""
    valid = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) and len(name) <= MAX_NAME
    return bool(valid) and name.lower() not in RESERVED


def default_name(task: str) -> str:
    """`qrl_` and the task's name, with '_' for what a C identifier cannot have."""
    return f"qrl_{re.sub(r'[^A-Za-z0-9_]', '_', task)}"[:MAX_NAME]


def files(policy: Policy, kernel: Kernel, golden: Vectors, name: str) -> dict[str, str]:
    """All emitted files except the report: path in the export folder -> text. `name`: as `is_name` wants it."""
    values = _values(policy, kernel, golden, name)
    templates = {str(path.relative_to(TEMPLATES)): path for path in TEMPLATES.rglob("*") if path.is_file()}
    emitted = {
        path.replace("NAME", name): re.sub(r"@(\w+)@", lambda match: values[match[1]], file.read_text(encoding="utf-8"))
        for path, file in templates.items()
    }
    emitted["manifest.json"] = json.dumps(manifest(policy, kernel, name), indent=2) + "\n"
    emitted["golden.csv"] = _golden_csv(policy, kernel, golden)
    return emitted


def state_bytes(kernel: Kernel) -> int:
    """sizeof(NAME_state)."""
    if kernel.memory is None:
        return 1
    short = 2 * (kernel.memory.actions + kernel.memory.units)
    integral = 4 * kernel.memory.integral.size if kernel.memory.integral else 0
    return -(-(integral + short) // 4) * 4 if integral else short


def manifest(policy: Policy, kernel: Kernel, name: str) -> dict[str, Any]:
    """manifest.json: ports with names, units, frames, ranges and steps, memory, and where the policy comes from."""
    run = policy.provenance
    obs = [
        {"name": o.name, "unit": o.unit, "frame": o.frame}
        | ({} if o.ahead_s is None else {"ahead_s": o.ahead_s})
        | {"range": limits, "steps": [int(low), int(high)], "lsb": lsb}
        for o, limits, low, high, lsb in zip(
            policy.observations, _obs_ranges(kernel), kernel.obs_min, kernel.obs_max, kernel.lsb.tolist(), strict=True
        )
    ]
    act = []
    for a, limits, lsb in zip(policy.actions, _act_ranges(kernel), kernel.act_lsb.tolist(), strict=True):
        motor = {} if a.position_m is None else {"position_m": list(a.position_m), "spin": a.spin}
        motor |= {} if a.axis == UP else {"axis": list(a.axis)}
        quantity = {} if a.quantity is None else {"quantity": a.quantity}
        port = {"name": a.name, "unit": a.unit, **quantity, "frame": a.frame, **motor, "range": limits, "lsb": lsb}
        act.append(port | {"safe": float(np.float32(a.safe))})
    return {
        "format": FORMAT,
        "name": name,
        "task": run.task,
        "vehicle": run.vehicle,
        "run": run.run,
        "commit": run.commit,
        "seed": run.seed,
        "env_steps": run.env_steps,
        "control_period_s": policy.control_period_s,
        "state_bytes": state_bytes(kernel),
        "memory": _memory(policy, kernel),
        "network": kernel.widths,
        "activation": kernel.activation,
        "obs": obs,
        "act": act,
    }


def _memory(policy: Policy, kernel: Kernel) -> dict[str, Any] | None:
    """What the state holds: the previous action, the integral of the error and a recurrent network's numbers, each null
    if it does not.
    """
    if policy.memory is None or kernel.memory is None:
        return None
    found: dict[str, Any] = {"previous_action": None, "integral": None, "recurrent": None}
    if kernel.memory.initial_action is not None:
        first = (kernel.memory.initial_action * kernel.act_lsb.astype(np.float64)).tolist()
        found["previous_action"] = {"after_reset": first}
    if policy.memory.integral and kernel.memory.integral:
        found["integral"] = {
            "of": [policy.observations[i].name for i in policy.memory.integral.position],
            "unit": "m s",
            "circle_m": policy.memory.integral.circle_m,
            "radius_m": policy.memory.integral.radius_m,
            "limit_m_s": policy.memory.integral.limit_m_s,
            "lsb": kernel.memory.integral.unit_m_s,
        }
    if units := kernel.memory.units:
        found["recurrent"] = {"cell": "gru", "units": units, "lsb": 1.0 / reference.INT16}
    return found


def _obs_ranges(kernel: Kernel) -> list[list[float]]:
    return (np.stack([kernel.obs_min, kernel.obs_max], axis=1) * kernel.lsb[:, None]).tolist()


def _act_ranges(kernel: Kernel) -> list[list[float]]:
    return (np.stack([kernel.act_min, kernel.act_max], axis=1) * kernel.act_lsb[:, None].astype(float)).tolist()


def _values(policy: Policy, kernel: Kernel, golden: Vectors, name: str) -> dict[str, str]:
    """Values of the templates' @placeholders@."""
    run, network = policy.provenance, "-".join(map(str, kernel.widths))
    banner = [
        f" * {run.task}: {run.description}.",
        f" * A policy trained by qrl, exported as an integer network {network} ({kernel.activation}).",
        f" * Run {run.run}, seed {run.seed}, {run.env_steps:,} environment steps, commit {run.commit}.",
    ]
    fields, meaning = _state(kernel)
    size = state_bytes(kernel)
    return {
        "name": name,
        "NAME": name.upper(),
        "state_is": meaning,
        "state_fields": fields,
        "state_bytes": f"{size} byte{'' if size == 1 else 's'}",
        "state_size": str(size),
        "previous_action": str(int(kernel.memory is not None and kernel.memory.initial_action is not None)),
        "integral": str(kernel.memory.integral.size if kernel.memory and kernel.memory.integral else 0),
        "positions": str(len(kernel.memory.integral.position) if kernel.memory and kernel.memory.integral else 0),
        "seen": str(len(reference.measured(kernel, kernel.obs_max[None])[0])),
        "turn": str(int(kernel.turn is not None)),
        "kept": str(len(kernel.memory.shift) if kernel.memory else 0),
        "goldens": str(embedded(kernel)),
        "units": str(kernel.memory.units if kernel.memory else 0),
        "banner": "\n".join(_comment_safe(line) for line in banner),
        "task": _comment_safe(run.task),
        "ports": "\n".join(f" * {_comment_safe(line)}".rstrip() for line in _port_lines(policy, kernel)),
        "frames": FRAMES if any(port.spin is not None for port in policy.actions) else " * SI units.\n *",
        "description_json": json.dumps(f"A trained policy for {run.task} as an integer kernel"),
        "period_s": f"{policy.control_period_s:g}",
        "period_us": f"{round(policy.control_period_s * 1e6)}",
        "obs_size": str(len(policy.observations)),
        "act_size": str(len(policy.actions)),
        "places": ",\n".join(
            f"    {name.upper()}_{kind}_{port.name.upper()} = {i}"
            for kind, ports in (("OBS", policy.observations), ("ACT", policy.actions))
            for i, port in enumerate(ports)
        ),
        "obs_lsb": _floats(kernel.lsb.astype(np.float32)),
        "obs_least": ", ".join(map(str, kernel.obs_min)),
        "obs_most": ", ".join(map(str, kernel.obs_max)),
        "act_lsb": _floats(kernel.act_lsb),
        "act_names": " ".join(port.name for port in policy.actions),
        "example_obs": _floats(golden.obs[0]),
        "acc_bound": f"{reference.accumulator_bound(kernel):,}",
        "widest": str(widest(policy)),
        "tanh": str(int(kernel.activation == "tanh")),
        "tables": _tables(kernel, golden, name),
    }


def _state(kernel: Kernel) -> tuple[str, str]:
    """The fields of NAME_state, and what they hold in words."""
    if kernel.memory is None:
        return (
            "    uint8_t unused; /* C has no empty structures */",
            "none; the functions are those of policies that have one",
        )
    fields, words = [], []
    if integral := kernel.memory.integral:
        fields.append(
            f"    int32_t integral[{integral.size}]; /* of the position's error, in {integral.unit_m_s:.4g} m s */"
        )
        words.append("the integral of the position's error")
    if (first := kernel.memory.initial_action) is not None:
        fields.append(f"    int16_t previous_action[{len(first)}]; /* in steps of lsb */")
        words.append("the previous action")
    if units := kernel.memory.units:
        fields.append(f"    int16_t recurrent[{units}]; /* of the network's recurrent unit, in 1 / 32767 */")
        words.append("the numbers of the network's recurrent unit")
    return "\n".join(fields), " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _comment_safe(text: str) -> str:
    """`text` on one line, without comment delimiters, line continuations or trigraphs."""
    text = "".join(c if c.isprintable() else " " for c in text.replace("\\", "|").replace("??/", "?? /"))
    return text.replace("*/", "* /").replace("/*", "/ *")


def _port_lines(policy: Policy, kernel: Kernel) -> Iterable[str]:
    heading = "name        unit    range                  lsb        meaning"
    yield f"obs  {heading}"
    for i, (o, (low, high), lsb) in enumerate(zip(policy.observations, _obs_ranges(kernel), kernel.lsb, strict=True)):
        yield f"{i:>3}  {o.name:<11} {o.unit:<7} {low:>9.4g} .. {high:<9.4g} {lsb:<10.4g} {o.frame}"
    yield ""
    yield f"act  {heading}"
    turns = {
        None: "",
        1: ", spin +1: reaction torque positive about body z, so it turns clockwise seen from above",
        -1: ", spin -1: counter-clockwise",
    }
    for i, (a, (low, high), lsb) in enumerate(zip(policy.actions, _act_ranges(kernel), kernel.act_lsb, strict=True)):
        axes = ", ".join(f"{axis} {x:+g} m" for axis, x in zip("xyz", a.position_m or (), strict=False))
        place = axes and f"; motor at {axes} of the body"
        meaning = f"{a.frame}{place}{turns[a.spin]}; safe {a.safe:.4g}"
        yield f"{i:>3}  {a.name:<11} {a.unit:<7} {low:>9.4g} .. {high:<9.4g} {float(lsb):<10.4g} {meaning}"


# -- C tables ------------------------------------------------------------------------------------------------


def _padded(n: int, to: int = 4) -> int:
    return -(-n // to) * to


def widest(policy: Policy) -> int:
    """How many numbers each of the kernel's two buffers of activations holds."""
    sizes = [len(policy.observations), *(size for weight, _ in policy.layers for size in weight.shape)]
    found = max(map(_padded, sizes))
    if policy.unit:
        given, units = policy.unit.of_input[0].shape[0], policy.unit.of_memory[0].shape[0]
        found = max(found, _padded(given, 8) + _padded(units, 8), _padded(2 * units) + 2 * _padded(units))
    return found


class _Layer(NamedTuple):
    """A layer as the C has it: weights [outputs, inputs], both padded to multiples of four."""

    dense: Dense
    parts: list[Ints]  # of the inputs x, and of a recurrent unit's gates those of its own numbers, which begin a tile
    hidden: bool

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.parts[0]), sum(part.shape[1] for part in self.parts)


def _layers(kernel: Kernel) -> list[_Layer]:
    found = []
    for dense in kernel.products:
        own = [-kernel.unit.units] if kernel.unit and dense is kernel.unit.gates else []
        parts = [
            np.pad(part, ((0, -part.shape[0] % 4), (0, -part.shape[1] % 4)))
            for part in np.split(dense.weight, own, axis=1)
        ]
        found.append(_Layer(dense, parts, hidden=any(dense is layer for layer in kernel.layers[:-1])))
    return found


def _tables(kernel: Kernel, golden: Vectors, name: str) -> str:
    prefix = name.upper()
    layers = _layers(kernel)
    columns = kernel.scale, kernel.exponent - 1, kernel.obs_min, kernel.obs_max - kernel.obs_min
    inputs = (f"{{{s}u, {e}, {low}, {span}u}}" for s, e, low, span in zip(*columns, strict=True))
    parts = [
        f"#define LAYERS {len(layers)}\n#define INPUTS {kernel.widths[0]}\n#define PADDED_INPUTS {layers[0].shape[1]}",
        _array(f"struct input inputs[{prefix}_OBS_SIZE]", inputs, 6),
        _array(f"float act_lsb[{prefix}_ACT_SIZE]", map(_float, kernel.act_lsb), 4),
        _array(f"float act_safe[{prefix}_ACT_SIZE]", map(_float, kernel.act_safe), 4),
        _array(f"int16_t act_least[{prefix}_ACT_SIZE]", kernel.act_min, 12),
        _array(f"int16_t act_most[{prefix}_ACT_SIZE]", kernel.act_max, 12),
    ]
    if kernel.activation == "tanh" or kernel.unit:
        parts.append(_array("uint16_t tanh_table[257]", reference.tanh_table() + 2**15, 16))
    if memory := kernel.memory:
        parts += _memory_tables(memory, prefix)
        if memory.integral:
            parts += _integral_tables(memory.integral, kernel.obs_shift)
    if units := kernel.memory.units if kernel.memory else 0:
        assert kernel.unit
        numbers = {"UNIT_LAYER": len(kernel.layers) - 1}
        numbers |= {"CANDIDATE_SHIFT": kernel.unit.shift, "MEMORY_SHIFT": kernel.unit.memory_shift}
        given = _padded(kernel.unit.of_input.weight.shape[1])
        numbers |= {"MEMORY_AT": f"TILES({given})", "INPUT_AT": _padded(2 * units), "PADDED_UNITS": _padded(units)}
        parts.append("\n".join(f"#define {name} {value}" for name, value in numbers.items()))
    if turn := kernel.turn:
        shifts = {"UP": turn.up, "POSITION": turn.position, "VELOCITY": turn.velocity, "AHEAD": turn.ahead}
        numbers = {"HEADING": int(turn.heading), "VECTORS": turn.vectors, "LAST": turn.last}
        numbers |= {f"{name}_SHIFT": shift for name, shift in shifts.items()}
        parts.append("\n".join(f"#define {name} {value}" for name, value in numbers.items()))
    parts += [_layer_tables(i, layer) for i, layer in enumerate(layers)]
    rows = (
        f"{{weights_{i}.w, outputs_{i}, outputs_{i} + {layer.shape[0] // 4}, {_sizes(layer, '')}, {int(layer.hidden)},"
        f" {layer.dense.shift}}}"
        for i, layer in enumerate(layers)
    )
    parts.append(_array("struct layer layers[LAYERS]", rows, 1))
    parts += _golden_tables(kernel, golden, embedded(kernel), name)
    return "\n\n".join(parts)


def _memory_tables(memory: Memory, prefix: str) -> list[str]:
    kept = (f"{{{s}, {low}, {high}}}" for s, low, high in zip(memory.shift, memory.low, memory.high, strict=True))
    parts = [_array("struct kept kept[KEPT]", kept, 8)] if len(memory.shift) else []
    if memory.initial_action is not None:
        parts.append(_array(f"int16_t act_first[{prefix}_ACT_SIZE]", memory.initial_action, 12))
    return parts


def _integral_tables(integral: Integral, obs_shift: Ints) -> list[str]:
    columns = integral.inverse_radius, integral.gain, integral.inverse_radius_shift, integral.gain_shift
    errors = (f"{{{', '.join(map(str, numbers))}}}" for numbers in zip(*columns, strict=True))
    positions = (f"{{{at}, {obs_shift[at]}}}" for at in integral.position)
    parts = [
        f"#define INTEGRAL_LIMIT {integral.limit}",
        _array("struct position positions[POSITIONS]", positions, 4),
        _array("struct error errors[INTEGRAL]", errors, 1),
    ]
    if circle := integral.circle:
        diameter = (f"{{{factor}, {shift}}}" for factor, shift in zip(circle.factor, circle.shift, strict=True))
        parts += ["#define CIRCLE 1", _array("struct factor diameter[2]", diameter, 2)]
    return parts


def _layer_tables(index: int, layer: _Layer) -> str:
    bias, multiplier, sums = (
        np.pad(x, (0, -len(x) % 4)) for x in (layer.dense.bias, layer.dense.multiplier, layer.dense.weight.sum(axis=1))
    )
    rows = []
    for at in range(0, len(bias), 4):
        biases = ", ".join(f"{bias[i]}, {sums[i]}" for i in range(at, at + 4))
        pairs = ", ".join(f"M2({multiplier[i]}, {multiplier[i + 1]})" for i in (at, at + 2))
        rows.append(f"{{{{B4({biases})}}, {{{pairs}}}}}")
    return "\n".join(
        [
            f"static const union {{\n    weight w[{len(bias)} * ({_sizes(layer, 'TILES')})];",
            f"    int32_t aligned;\n}} weights_{index} = {{{{",
            *_lines(_tiles(layer), 1),
            "}};",
            _array(f"struct outputs outputs_{index}[{len(bias) // 4}]", rows, 1),
        ]
    )


def _sizes(layer: _Layer, last: str) -> str:
    """The inputs of a layer, of which each part but the last takes whole tiles."""
    *whole, rest = (str(part.shape[1]) for part in layer.parts)
    return " + ".join([*(f"TILES({size})" for size in whole), f"{last}({rest})" if last else rest])


def _tiles(layer: _Layer) -> Iterable[str]:
    """Tiles of four outputs and eight inputs, the last of four where eight do not go into a part's inputs."""
    for at in range(0, layer.shape[0], 4):
        for part in layer.parts:
            for first in range(0, part.shape[1], 8):
                tile = part[at : at + 4, first : first + 8]
                numbers = [", ".join(map(str, row)) for row in tile]
                halves = ",\n       ".join([", ".join(numbers[:2]), ", ".join(numbers[2:])])
                yield f"W{tile.shape[1]}({halves})"


def _integrals(golden: Vectors, integral: Integral) -> Ints:
    """The integral after each vector, the state's first field; [n, k]."""
    return np.ascontiguousarray(golden.outputs.state[:, : 4 * integral.size]).view("<i4")


def _golden_tables(kernel: Kernel, golden: Vectors, n: int, name: str) -> list[str]:
    """The first n vectors, and the state after them."""
    rows = []
    for i in range(n):
        obs_i16, act = (", ".join(map(str, x[i])) for x in (golden.obs_i16, golden.outputs.act_i16))
        columns = f"{{{_floats(golden.obs[i])}}}", f"{{{obs_i16}}}", f"{{{act}}}"
        rows.append(f"{{{', '.join(columns)}, {golden.outputs.status[i]}, {golden.outputs.status_i16[i]}}}")
    head = "static const struct goldens goldens = {", "    {0x7fc00000u},", "    {"
    vectors = [*head, *_lines(rows, 1), "    },", "};"]
    if kernel.memory is None:
        return ["\n".join(vectors)]
    state = np.ascontiguousarray(golden.outputs.state[n - 1])
    first = 4 * kernel.memory.integral.size if kernel.memory.integral else 0
    numbers = np.split(state[first:].view("<i2"), [kernel.memory.actions])
    fields = [part.tolist() for part in (state[:first].view("<i4"), *numbers) if len(part)]
    text = ", ".join(f"{{{', '.join(map(str, field))}}}" for field in fields)
    return [
        "\n".join(vectors),
        f"#define STATE_BYTES {len(state)}\nstatic const {name}_state golden_state = {{{text}}};",
    ]


def _array(declaration: str, values: Iterable[Any], columns: int) -> str:
    return "\n".join([f"static const {declaration} = {{", *_lines(map(str, values), columns), "};"])


def _lines(values: Iterable[str], columns: int) -> list[str]:
    cells = list(values)
    return [f"    {', '.join(cells[i : i + columns])}," for i in range(0, len(cells), columns)]


def _float(value: np.floating) -> str:
    """A C float literal with exactly these bits."""
    return f"{np.format_float_scientific(np.float32(value), unique=True)}F"


def _floats(values: NDArray[np.float32]) -> str:
    return ", ".join(map(_float, values))


def _golden_csv(policy: Policy, kernel: Kernel, golden: Vectors) -> str:
    """One row per vector: obs in SI units, obs in steps, status of each entry point, act in steps, and the integral.

    Of a policy with memory they are one sequence, from a reset on.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [port.name for port in policy.observations]
    acts = [f"{port.name}_lsb" for port in policy.actions]
    integral = kernel.memory.integral if kernel.memory else None
    kept = [f"integral_{names[i]}" for i in integral.position] if integral else []
    if integral and integral.circle:
        kept = [
            "integral_distance",
            f"integral_{names[integral.position[2]]}",
            "integral_center_x",
            "integral_center_y",
        ]
    writer.writerow([*names, *(f"{name}_lsb" for name in names), "status", "status_i16", *acts, *kept])
    outputs = golden.outputs
    integrals = _integrals(golden, integral) if integral else np.zeros((len(golden.obs), 0))
    columns = golden.obs, golden.obs_i16, outputs.status, outputs.status_i16, outputs.act_i16, integrals
    for obs, obs_i16, status, status_i16, act_i16, integral in zip(*columns, strict=True):
        writer.writerow([*map(str, obs), *obs_i16, status, status_i16, *act_i16, *integral])
    return out.getvalue()

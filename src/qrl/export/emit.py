"""The kernel's files: C tables laid into the templates beside this module, manifest, golden vectors."""

import csv
import io
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as reference
from qrl.export import vectors
from qrl.export.kernel import Dense, Ints, Kernel
from qrl.export.policy import Policy

FORMAT = 1
FRAMES = " * World and body frames: x forward, y left, z up. SI units.\n *"
EMBEDDED = 2  # golden vectors inside the C, for the self-test


@dataclass(frozen=True, eq=False)
class Golden:
    """Observations and what the kernel answers, by the NumPy reference; leading axis [n]."""

    obs: NDArray[np.float32]  # [n, F] in SI units
    obs_i16: NDArray[np.int16]  # [n, F] in steps
    status: Ints  # [n]
    status_i16: Ints  # [n]
    act: NDArray[np.int16]  # [n, A] in steps; the same for both entries where both inputs mean the same

    @classmethod
    def of(cls, kernel: Kernel, obs: NDArray[np.float32]) -> "Golden":
        """The answers to finite observations [n, F]."""
        wanted, _ = reference.quantised(kernel, obs)
        obs_i16 = np.clip(wanted, -reference.INT16, reference.INT16).astype(np.int16)
        status, _ = reference.step(kernel, obs)
        status_i16, act = reference.step_i16(kernel, obs_i16)
        return cls(obs, obs_i16, status, status_i16, act)


def golden(policy: Policy, kernel: Kernel, n: int = 256) -> Golden:
    """n finite vectors; the first ones, which the C embeds, are of a flight, and one that is clipped."""
    obs = vectors.observations(policy, kernel, 2 * n)
    found = Golden.of(kernel, obs[np.isfinite(obs).all(axis=1)])
    clipped = int(np.argmax(found.status))
    order = [*range(EMBEDDED - 1), clipped, *(i for i in range(EMBEDDED - 1, len(found.obs)) if i != clipped)]
    thinned = [*order[:EMBEDDED], *order[EMBEDDED :: max(1, (len(order) - EMBEDDED) // (n - EMBEDDED))]][:n]
    return Golden(
        obs=found.obs[thinned],
        obs_i16=found.obs_i16[thinned],
        status=found.status[thinned],
        status_i16=found.status_i16[thinned],
        act=found.act[thinned],
    )


def files(policy: Policy, kernel: Kernel, golden: Golden) -> dict[str, str]:
    """Everything that is emitted but the report: path in the export folder -> text."""
    words = _words(policy, kernel, golden)
    emitted = {path: _filled(text, words) for path, text in _templates(resources.files("qrl.export") / "templates")}
    emitted["manifest.json"] = json.dumps(manifest(policy, kernel), indent=2) + "\n"
    emitted["golden.csv"] = _golden_csv(policy, golden)
    return emitted


def _templates(folder: Traversable, path: str = "") -> Iterable[tuple[str, str]]:
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        name = f"{path}{entry.name}"
        if entry.is_dir():
            yield from _templates(entry, f"{name}/")
        else:
            yield name, entry.read_text(encoding="utf-8")


def _filled(text: str, words: dict[str, str]) -> str:
    """`text` with every @word@ replaced; KeyError for one that nobody knows."""
    return re.sub(r"@(\w+)@", lambda match: words[match[1]], text)


def manifest(policy: Policy, kernel: Kernel) -> dict[str, Any]:
    """DESIGN.md's manifest.json."""
    act_lsb = kernel.act_lsb.astype(float)
    return {
        "format": FORMAT,
        "task": policy.origin.task,
        "run": policy.origin.run,
        "commit": policy.origin.commit,
        "seed": policy.origin.seed,
        "env_steps": policy.origin.env_steps,
        "control_period_s": policy.control_period_s,
        "network": [len(policy.observed), *(len(layer.bias) for layer in kernel.layers)],
        "activation": kernel.activation,
        "obs": [
            {
                "name": o.name,
                "unit": o.unit,
                "frame": o.frame,
                "range": [float(bound[i] * kernel.lsb[i]) for bound in (kernel.least, kernel.most)],
                "steps": [int(kernel.least[i]), int(kernel.most[i])],
                "lsb": float(kernel.lsb[i]),
            }
            for i, o in enumerate(policy.observed)
        ],
        "act": [
            {"name": a.name, "unit": a.unit, "frame": a.frame}
            | ({} if a.position_m is None else {"position_m": list(a.position_m), "spin": a.spin})
            | {
                "range": [kernel.act_least[i] * act_lsb[i], kernel.act_most[i] * act_lsb[i]],
                "lsb": act_lsb[i],
                "safe": float(kernel.act_safe[i]),
            }
            for i, a in enumerate(policy.acted)
        ],
    }


def _words(policy: Policy, kernel: Kernel, golden: Golden) -> dict[str, str]:
    """What the templates' @placeholders@ stand for."""
    origin = policy.origin
    banner = [
        f" * {origin.task}: {origin.description}.",
        f" * A policy trained by qrl, exported as an integer network {_network(policy)} ({kernel.activation}).",
        f" * Run {origin.run}, seed {origin.seed}, {origin.env_steps:,} environment steps, commit {origin.commit}.",
    ]
    return {
        "banner": "\n".join(_comment_safe(line) for line in banner),
        "task": _comment_safe(origin.task),
        "ports": "\n".join(f" * {_comment_safe(line)}".rstrip() for line in _port_lines(policy, kernel)),
        "frames": FRAMES if any(port.spin is not None for port in policy.acted) else " * SI units.\n *",
        "description_json": json.dumps(f"A trained policy for {origin.task} as an integer kernel"),
        "period_s": f"{policy.control_period_s:g}",
        "period_us": f"{round(policy.control_period_s * 1e6)}",
        "obs_size": str(len(policy.observed)),
        "act_size": str(len(policy.acted)),
        "places": ",\n".join(
            f"    QRL_POLICY_{kind}_{port.name.upper()} = {i}"
            for kind, ports in (("OBS", policy.observed), ("ACT", policy.acted))
            for i, port in enumerate(ports)
        ),
        "obs_lsb": _floats(kernel.lsb.astype(np.float32)),
        "obs_least": ", ".join(map(str, kernel.least)),
        "obs_most": ", ".join(map(str, kernel.most)),
        "act_lsb": _floats(kernel.act_lsb),
        "act_names": " ".join(port.name for port in policy.acted),
        "example_obs": _floats(golden.obs[0]),
        "acc_bound": f"{reference.accumulator_bound(kernel):,}",
        "widest": str(max(_padded(len(kernel.lsb)), *(_padded(len(layer.bias)) for layer in kernel.layers))),
        "tanh": str(int(kernel.activation == "tanh")),
        "tables": _tables(kernel, golden),
    }


def _network(policy: Policy) -> str:
    return "-".join(str(n) for n in (len(policy.observed), *(len(bias) for _, bias in policy.layers)))


def _comment_safe(text: str) -> str:
    """Text on one line that neither begins nor ends a C comment, nor continues its line."""
    text = "".join(c if c.isprintable() else " " for c in text.replace("\\", "|").replace("??/", "?? /"))
    return text.replace("*/", "* /").replace("/*", "/ *")


def _port_lines(policy: Policy, kernel: Kernel) -> Iterable[str]:
    lows, highs, act_lsb = kernel.least * kernel.lsb, kernel.most * kernel.lsb, kernel.act_lsb.astype(float)
    yield "obs  name        unit    range                  lsb        meaning"
    for i, o in enumerate(policy.observed):
        yield f"{i:>3}  {o.name:<11} {o.unit:<7} {lows[i]:>9.4g} .. {highs[i]:<9.4g} {kernel.lsb[i]:<10.4g} {o.frame}"
    yield ""
    yield "act  name        unit    range                  lsb        meaning"
    for i, a in enumerate(policy.acted):
        low, high = kernel.act_least[i] * act_lsb[i], kernel.act_most[i] * act_lsb[i]
        where = (
            "" if a.position_m is None else f"; motor at x {a.position_m[0]:+g} m, y {a.position_m[1]:+g} m of the body"
        )
        turn = {None: "", 1: ", spin +1: reaction torque positive about body z", -1: ", spin -1: negative"}[a.spin]
        yield (
            f"{i:>3}  {a.name:<11} {a.unit:<7} {low:>9.4g} .. {high:<9.4g} {act_lsb[i]:<10.4g} {a.frame}{where}{turn};"
            f" safe {a.safe:.4g}"
        )


# -- C tables ------------------------------------------------------------------------------------------------


def _padded(n: int) -> int:
    return -(-n // 4) * 4


def _tables(kernel: Kernel, golden: Golden) -> str:
    sizes = [_padded(len(kernel.lsb)), *(_padded(len(layer.bias)) for layer in kernel.layers)]
    columns = kernel.scale, kernel.exponent, kernel.least, kernel.most
    inputs = (f"{{{s}u, {e}, {least}, {most}}}" for s, e, least, most in zip(*columns, strict=True))
    parts = [
        f"#define LAYERS {len(kernel.layers)}\n#define PADDED_OBS_SIZE {sizes[0]}\n#define GOLDENS {EMBEDDED}",
        _array("struct input inputs[QRL_POLICY_OBS_SIZE]", inputs, 6),
        _array("float act_lsb[QRL_POLICY_ACT_SIZE]", map(_float, kernel.act_lsb), 4),
        _array("float act_safe[QRL_POLICY_ACT_SIZE]", map(_float, kernel.act_safe), 4),
        _array("int16_t act_least[QRL_POLICY_ACT_SIZE]", kernel.act_least, 12),
        _array("int16_t act_most[QRL_POLICY_ACT_SIZE]", kernel.act_most, 12),
    ]
    if kernel.activation == "tanh":
        parts.append(_array("int16_t tanh_table[257]", reference.tanh_table(), 16))
    parts += [_layer_tables(i, layer) for i, layer in enumerate(kernel.layers)]
    rows = (
        f"{{weights_{i}.w, biases_{i}, factors_{i}, {sizes[i]}, {sizes[i + 1]},"
        f" {int(i < len(kernel.layers) - 1)}, {layer.shift}}}"
        for i, layer in enumerate(kernel.layers)
    )
    parts.append(_array("struct layer layers[LAYERS]", rows, 1))
    parts.append(_array("struct golden goldens[GOLDENS]", _golden_rows(golden), 1))
    return "\n\n".join(parts)


def _layer_tables(index: int, layer: Dense) -> str:
    outputs, inputs = layer.weight.shape
    weight = np.pad(layer.weight, ((0, _padded(outputs) - outputs), (0, _padded(inputs) - inputs)))
    tiles = weight.reshape(len(weight) // 4, 4, -1, 4).swapaxes(1, 2).reshape(-1, 4)
    fours = (f"W4({', '.join(map(str, four))})" for four in tiles)
    bias, multiplier = (np.pad(x, (0, len(weight) - outputs)) for x in (layer.bias, layer.multiplier))
    sums = weight.sum(axis=1)
    return "\n".join(
        [
            f"static const union {{\n    weight w[{weight.size}];\n    int32_t aligned;\n}} weights_{index} = {{{{",
            *_lines(fours, 4),
            "}};",
            _array(
                f"int32_t biases_{index}[{len(bias)}]",
                (f"BIAS({b}, {s})" for b, s in zip(bias, sums, strict=True)),
                5,
            ),
            _array(
                f"factors factors_{index}[]",
                (f"M2({a}, {b})" for a, b in multiplier.reshape(-1, 2)),
                8,
            ),
        ]
    )


def _golden_rows(golden: Golden) -> Iterable[str]:
    for i in range(EMBEDDED):
        obs_i16, act = (", ".join(map(str, x[i])) for x in (golden.obs_i16, golden.act))
        columns = f"{{{_floats(golden.obs[i])}}}", f"{{{obs_i16}}}", f"{{{act}}}"
        yield f"{{{', '.join(columns)}, {golden.status[i]}, {golden.status_i16[i]}}}"


def _array(declaration: str, values: Iterable[Any], columns: int) -> str:
    return "\n".join([f"static const {declaration} = {{", *_lines(map(str, values), columns), "};"])


def _lines(values: Iterable[str], columns: int) -> list[str]:
    cells = list(values)
    return [f"    {', '.join(cells[i : i + columns])}," for i in range(0, len(cells), columns)]


def _float(value: np.floating) -> str:
    """A C float literal that reads back as the same bits."""
    text = np.format_float_scientific(np.float32(value), unique=True)
    return f"{text}F"


def _floats(values: NDArray[np.float32]) -> str:
    return ", ".join(map(_float, values))


def _golden_csv(policy: Policy, golden: Golden) -> str:
    """A row for each vector: obs in SI units, in steps, status of each entry, act in steps."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [port.name for port in policy.observed]
    acts = [f"{port.name}_lsb" for port in policy.acted]
    writer.writerow([*names, *(f"{name}_lsb" for name in names), "status", "status_i16", *acts])
    for i in range(len(golden.obs)):
        writer.writerow(
            [*map(str, golden.obs[i]), *golden.obs_i16[i], golden.status[i], golden.status_i16[i], *golden.act[i]]
        )
    return out.getvalue()

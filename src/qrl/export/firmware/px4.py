"""For PX4: a module around any kernel, and of RAPTOR's shape the checkpoint that mc_raptor loads (docs/px4.md).

The checkpoint is a tar file of the archive format ustar, as RLtools (Eschmann et al.) writes and reads it: for each
tensor an entry `…/meta` of lines `key: value` and an entry `…/data`, little-endian float32, row-major. Facts of PX4 are
those of `src/modules/mc_raptor` of its main branch before v1.18, of RLtools those of its commit 9acdf5c.
"""

import io
import re
import tarfile
import zlib

import numpy as np
from numpy.typing import NDArray

from qrl.export.firmware import ned, vehicle
from qrl.export.firmware.vehicle import Corner
from qrl.export.policy import Policy, sigmoid

TITLE, FOLDER, FILE = "PX4", "px4", "policy.tar"
WHAT = "a module for it, or the file of its mc_raptor"
RELEASE = "v1.18"
QUAD_X = (  # the module's motors: PX4's quadrotor X
    Corner("front right (1)", 1, -1, -1),
    Corner("back left (2)", -1, 1, -1),
    Corner("front left (3)", 1, 1, 1),
    Corner("back right (4)", -1, -1, 1),
)
# Ages as mc_raptor has them; that of the set-point is seen to outside of the hook.
HOOK = ned.Firmware("PX4", "PX4's quadrotor X", 100_000, 50_000, 200_000)
MOST_MODE, MOST_PARAMETER = 24, 16  # characters of PX4's names

HIDDEN, UNITS = 16, 16
# Its actions: of RAPTOR's quadrotor, whose order is the Crazyflie's; mc_raptor renumbers them to PX4's quadrotor X.
MOTORS = (
    Corner("front right", 1, -1, -1),
    Corner("back right", -1, -1, 1),
    Corner("back left", -1, 1, -1),
    Corner("front left", 1, 1, 1),
)
PERIOD_S = 0.01  # at which mc_raptor steps the memory
# Its inputs, of qrl's: position, rotation matrix, velocity, body rates; then the previous action, by motor.
ORDER = (*range(9, 12), *range(9), *range(12, 18))
LIMITS = (slice(9, 12), 0.5), (slice(12, 15), 1.0)  # at which it clips the errors [m], [m/s]
STEPS, FLIGHTS = 500, 2  # of the example; mc_raptor compares the first 5 steps of both
MOST_ERROR = 1e-5  # mean absolute, in a in [−1, 1], at which it refuses a checkpoint
MOST_NAME = 99
Floats = NDArray[np.floating]


def refusal(policy: Policy) -> str | None:
    """Why there is no module for a policy, in one line; None if there is."""
    if reason := vehicle.misfit(policy):
        return reason
    if "circle" in policy.observations[9].frame:
        return "its set-point is the center of a circle that it flies, and the mode holds places"
    order = vehicle.by_place_and_spin(policy, QUAD_X)
    return f"of PX4's quadrotor X, {order}" if isinstance(order, str) else None


def checkpoint_refusal(policy: Policy) -> str | None:
    """Why mc_raptor cannot fly a policy, in one line; None if it can."""
    memory = policy.memory
    measured = [port.name for port in policy.observations] == vehicle.MEASURED
    if not measured or policy.body_frame or not memory or not memory.previous_action or memory.integral:
        return "the inputs are not a vehicle's state in the world's frame and the previous action (as of TASK=raptor)"
    shape = tuple(weight.shape for weight, _ in policy.layers)
    if shape != ((22, HIDDEN), (UNITS, 4)) or memory.units != UNITS or policy.activation != "relu":
        return f"the network is not 22 inputs, {HIDDEN} ReLU, a gated recurrent unit of {UNITS}, 4 outputs"
    if not vehicle.orders_speeds(policy):
        return "the actions are not rotor speeds"
    if round(policy.control_period_s, 9) != PERIOD_S:
        return f"the control period is {policy.control_period_s * 1e3:g} ms, and mc_raptor's {PERIOD_S * 1e3:g} ms"
    limits = np.broadcast_to(policy.observation_clip / policy.observation_gain, 22)
    for part, most in LIMITS:
        if not np.allclose(limits[part], most):
            return f"its inputs {part.start + 1} to {part.stop} are not clipped at {most:g}, as mc_raptor does"
    if np.isfinite(np.delete(limits, np.r_[9:15])).any():
        return "inputs are clipped that mc_raptor does not clip"
    if reason := vehicle.tilted(policy):
        return reason
    order = vehicle.by_place_and_spin(policy, MOTORS)
    return f"the motors are not those of PX4's quadrotor X: {order}" if isinstance(order, str) else None


def tensors(policy: Policy) -> dict[str, NDArray[np.float32]]:
    """The parameters by name, for inputs and outputs in mc_raptor's order and units: actions in [−1, 1].

    No `checkpoint_refusal`.
    """
    motors = vehicle.by_place_and_spin(policy, MOTORS)
    assert not isinstance(motors, str), motors
    (weight, bias), (last, last_bias) = policy.layers
    unit = policy.unit
    assert unit
    gain = policy.observation_gain * policy.observation_scale
    scale, offset = np.ones(22), np.zeros(22)  # of an input in SI units, of that in mc_raptor's
    scale[18:], offset[18:] = policy.scale, policy.offset
    bias = bias + ((offset - policy.observation_offset) * gain) @ weight
    inputs = [*ORDER, *(18 + motor for motor in motors)]
    named = {
        "0/weights": (weight * (scale * gain)[:, None]).T[:, inputs],
        "0/biases": bias,
        "1/weights_input": unit.of_input[0].T,
        "1/biases_input": unit.of_input[1],
        "1/weights_hidden": unit.of_memory[0].T,
        "1/biases_hidden": unit.of_memory[1],
        "1/initial_hidden_state": np.zeros(UNITS),
        "2/weights": last.T[motors],
        "2/biases": last_bias[motors],
    }
    return {name: np.ascontiguousarray(values, np.float32) for name, values in named.items()}


def example(policy: Policy) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inputs [STEPS, FLIGHTS, 22] and outputs [STEPS, FLIGHTS, 4] of mc_raptor's policy, from a reset on."""
    motors = vehicle.by_place_and_spin(policy, MOTORS)
    assert not isinstance(motors, str), motors
    rows = np.resize(policy.calibration[:, :22], (STEPS * FLIGHTS, 22)).astype(np.float64)
    rows[:, 18:] = (rows[:, 18:] - policy.offset) / policy.scale
    for part, most in LIMITS:
        rows[:, part] = np.clip(rows[:, part], -most, most)
    x = rows[:, [*ORDER, *(18 + motor for motor in motors)]].astype(np.float32).reshape(STEPS, FLIGHTS, 22)
    return x, outputs(tensors(policy), x)


def outputs(parameters: dict[str, NDArray[np.float32]], x: Floats) -> NDArray[np.float32]:
    """What RLtools makes of `tensors` for inputs [T, n, 22]: actions [T, n, 4], not clipped."""
    w = {name: values.astype(np.float64) for name, values in parameters.items()}
    h, found = np.tile(w["1/initial_hidden_state"], (x.shape[1], 1)), []
    for now in x.astype(np.float64):
        seen = np.maximum(now @ w["0/weights"].T + w["0/biases"], 0.0)
        own = np.split(h @ w["1/weights_hidden"].T + w["1/biases_hidden"], 3, axis=-1)
        given = np.split(seen @ w["1/weights_input"].T + w["1/biases_input"], 3, axis=-1)
        r, z = sigmoid(given[0] + own[0]), sigmoid(given[1] + own[1])
        h = z * h + (1.0 - z) * np.tanh(given[2] + r * own[2])
        found.append(h @ w["2/weights"].T + w["2/biases"])
    return np.array(found, np.float32)


def archive(policy: Policy, name: str) -> bytes:
    """The file's contents; mc_raptor prints `name` as that of the checkpoint."""
    x, y = example(policy)
    kinds = {"0": "activation_function: RELU\ntype: dense\n", "1": "type: gru\n"}
    kinds["2"] = "activation_function: IDENTITY\ntype: dense\n"
    entries = {"actor/meta": f"checkpoint_name: {_one_line(name)}\ntype: sequential\n".encode()}
    for path, values in tensors(policy).items():
        entries |= _tensor(f"actor/layers/{path}/parameters", values)
    entries |= {f"actor/layers/{layer}/meta": kind.encode() for layer, kind in kinds.items()}
    entries |= _tensor("example/input", x) | _tensor("example/output", y)
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for path, data in entries.items():
            entry = tarfile.TarInfo(path)  # of no time, so that the same policy gives the same bytes
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    return file.getvalue()


def _one_line(name: str) -> str:
    return re.sub(r"[^\x20-\x7e]", "_", name)[:MOST_NAME]


def _tensor(path: str, values: NDArray[np.float32]) -> dict[str, bytes]:
    lines = ["type: tensor", "dtype: float32", f"num_dims: {values.ndim}"]
    lines += [f"dim_{i}: {size}" for i, size in enumerate(values.shape)]
    return {
        f"{path}/meta": "".join(f"{line}\n" for line in lines).encode(),
        f"{path}/data": values.astype("<f4").tobytes(),
    }


def files(policy: Policy, kernel: dict[str, str], name: str) -> dict[str, str | bytes]:
    """Path in the export folder -> contents: the module and the checkpoint, where there is no refusal.

    `kernel`: NAME.c and NAME.h.
    """
    if refusal(policy) and checkpoint_refusal(policy):
        return {}
    checkpoint, module = said(policy)
    values = {"name": name, "release": RELEASE, "checkpoint": checkpoint, "module": module}
    values["facts"] = "\n".join(f"- {fact}" for fact in facts(policy))
    texts = vehicle.filled(FOLDER, values, name)
    found: dict[str, str | bytes] = {"README.md": texts["README.md"]}
    if not refusal(policy):
        found |= {f"module/{path}": text for path, text in _module(policy, kernel, name).items()}
    if not checkpoint_refusal(policy):
        run = f"{policy.provenance.run} {policy.provenance.env_steps} {name}"
        found |= {"README.md": texts["README.md"] + texts["checkpoint.md"], FILE: archive(policy, run)}
    return {f"{FOLDER}/{path}": contents for path, contents in found.items()}


def _module(policy: Policy, kernel: dict[str, str], name: str) -> dict[str, str]:
    """Path in the folder for EXTERNAL_MODULES_LOCATION -> text."""
    order = vehicle.by_place_and_spin(policy, QUAD_X)
    assert not isinstance(order, str), order
    values = {
        "name": name,
        "NAME": name.upper(),
        "class": f"{name}_mode",
        "mode": _cut(name, MOST_MODE),
        "parameter": _cut(name, MOST_PARAMETER - len(OFFBOARD)).upper() + OFFBOARD,
        "request_id": str(zlib.crc32(name.encode())),
        "description": " ".join(policy.provenance.description.split()),
        "command": ned.COMMAND,
        "rate_hz": f"{1.0 / policy.control_period_s:.0f}",
        "release": RELEASE,
        "facts": "\n".join(f"- {fact}" for fact in ned.facts(policy)),
    }
    hook = ned.files(policy, name, HOOK, QUAD_X, order)
    source = hook | {file: kernel[file] for file in (f"{name}.c", f"{name}.h")}
    return vehicle.filled("px4_module", values, name) | {
        f"src/modules/{name}/{path}": text for path, text in source.items()
    }


OFFBOARD = "_OFFB"


def _cut(name: str, most: int) -> str:
    """A name of at most so many characters; of a longer one the end is of its hash, so that two differ."""
    return name if len(name) <= most else f"{name[: most - 4]}{zlib.crc32(name.encode()) & 0xFFFF:04x}"


def said(policy: Policy, where: str = "") -> tuple[str, str]:
    """Of the checkpoint and of the module, in the folder `where`: what it is for, or why there is none."""
    reason, other = checkpoint_refusal(policy), refusal(policy)
    return (
        f"No `{where}{FILE}`: {reason}."
        if reason
        else f"`{where}{FILE}`: for PX4's mode mc_raptor, without a compiler.",
        f"No `{where}module/`: {other}." if other else f"`{where}module/`: to be built with PX4; its README says how.",
    )


def facts(policy: Policy) -> list[str]:
    """What to know of a policy of RAPTOR's shape before flight, a sentence each."""
    return [
        vehicle.facts(policy)[0],
        "It holds a place or follows `trajectory_setpoint`; it sees no set-point ahead, and lags one that moves.",
        "It has no integral: what it cannot tell from its memory, such as wind, it flies at an offset.",
        "The commands stand for rotor speeds, from 0 to the greatest: motors that are linear in speed, no thrust curve"
        " (`THR_MDL_FAC` 0).",
    ]


def section(policy: Policy) -> str:
    """What report.md says of it; nothing of a policy that flies no vehicle."""
    if not vehicle.flies(policy):
        return ""
    lines = "".join(f"- {line}\n" for line in said(policy, f"{FOLDER}/"))
    return f"\n## {TITLE}\n\n{lines}"

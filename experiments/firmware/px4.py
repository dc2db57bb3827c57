"""The checkpoint of a run for mc_raptor, loaded and flown by PX4's own source of that module, at 400 Hz in the plant.

    git clone https://github.com/PX4/PX4-Autopilot      # main of 2026, or v1.18
    git -C PX4-Autopilot submodule update --init src/lib/rl_tools/rl_tools src/modules/mc_raptor/blob
    .venv/bin/python -m experiments.firmware.px4 RUN --px4 PX4-Autopilot

RUN is a folder of a run of TASK=raptor. The checkpoint is emitted anew. RLtools must give the policy's own outputs, the
module must fly as the bare policy does, and mistakes in its source or in the checkpoint must show.
"""

import argparse
import ctypes
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from experiments.arguments import Parser, run_main
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.crazyflie import heading_deg
from experiments.firmware.crazyflie_loop import Floats, Mutant, Ordered, Reference, World
from experiments.output import table
from qrl.cli.main import configure_jax
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.firmware import px4
from qrl.export.firmware.vehicle import by_place_and_spin
from qrl.export.policy import Policy
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask

SHIM = Path(__file__).parent / "px4_shim.cpp"
MODULE, LIBRARY = "src/modules/mc_raptor", "src/lib/rl_tools/rl_tools/include"
NEEDED = [f"{MODULE}/{name}" for name in ("mc_raptor.cpp", "mc_raptor.hpp", "blob/policy.h")]
NEEDED += [f"{LIBRARY}/rl_tools/rl_tools.h", "src/lib/matrix/matrix/math.hpp"]
GYRO_HZ = 400
FELL_M, SAME_MM, SAME_OUTPUT = 3.0, 1.0, 1e-5
# PX4's motors 1 to 4: signs of body x and y (its documentation of the quadrotor X).
CORNERS = ((1, -1), (-1, 1), (1, 1), (-1, -1))
Tensors = dict[str, NDArray[np.float32]]


def build(tree: Path, folder: Path, *mutants: Mutant) -> Path:
    """The module's library in `folder`, whose `sd` is its SD card; ValueError if a mutant's text is not there."""
    source = (tree / MODULE / "mc_raptor.cpp").read_text(encoding="utf-8")
    for mutant in mutants:
        if mutant.old not in source:
            raise ValueError(f"not in mc_raptor.cpp: {mutant.old}")
        source = source.replace(mutant.old, mutant.new)
    headers, out = folder / "headers", folder / "mc_raptor.so"
    (folder / "sd" / "raptor").mkdir(parents=True, exist_ok=True)
    for name in re.findall(r"#include <((?!rl_tools/)[^>]+/[^>]+)>", (tree / MODULE / "mc_raptor.hpp").read_text()):
        (headers / name).parent.mkdir(parents=True, exist_ok=True)
        (headers / name).touch()
    (folder / "mc_raptor.cpp").write_text(source, encoding="utf-8")
    includes = [headers, tree / MODULE, tree / "src/lib/matrix", tree / LIBRARY]
    defines = {"PX4_STORAGEDIR": folder / "sd", "MC_RAPTOR_SOURCE": folder / "mc_raptor.cpp"}
    command = ["g++", "-std=c++17", "-O1", "-shared", "-fPIC", "-w", "-D__PX4_POSIX", str(SHIM), "-o", str(out)]
    command += [f'-D{name}="{path}"' for name, path in defines.items()] + [f"-I{path}" for path in includes]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")
    return out


class Module:
    """mc_raptor with a checkpoint on its SD card."""

    def __init__(self, library: Path, checkpoint: bytes) -> None:
        self._card, self._checkpoint = library.parent / "sd" / "raptor" / px4.FILE, checkpoint
        self._library = ctypes.CDLL(str(library))
        self._library.boot.restype, self._library.checkpoint.restype = ctypes.c_void_p, ctypes.c_char_p
        self._library.be_quiet(1)

    def boot(self) -> ctypes.c_void_p:
        """One more vehicle; ValueError if the module refuses the checkpoint."""
        self._card.write_bytes(self._checkpoint)
        vehicle = self._library.boot(GYRO_HZ)
        if not vehicle:
            raise ValueError("mc_raptor refuses the checkpoint")
        return ctypes.c_void_p(vehicle)

    def name(self) -> str:
        return self._library.checkpoint(self.boot()).decode()

    def respond(self, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Outputs [T, 4] of RLtools for inputs [T, 22], from a reset on."""
        inputs, found = np.ascontiguousarray(inputs, np.float32), np.zeros((len(inputs), 4), np.float32)
        self._library.respond(self.boot(), len(inputs), _pointer(inputs), _pointer(found))
        return found

    def tick(self, vehicle: ctypes.c_void_p, step: int, numbers: Floats, fresh: tuple[int, int, int, int]) -> Floats:
        """`actuator_motors` 1 to 4 and whether they were published, [5], of the IMU sample `step`."""
        numbers, found = np.ascontiguousarray(numbers, np.float32), np.zeros(5, np.float32)
        now_us = ctypes.c_uint64(2_000_000 + step * 1_000_000 // GYRO_HZ)
        self._library.tick(vehicle, now_us, _pointer(numbers), _pointer(np.array(fresh, np.int32)), _pointer(found))
        return found


def _pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def numbers(state: Floats, now: Reference) -> Floats:
    """Of states [n, 13] in qrl's frames what PX4's topics say, north-east-down and forward-right-down; [n, 21]."""
    down = np.array([1.0, -1.0, -1.0])
    q = state[:, 6:10] * [1.0, 1.0, -1.0, -1.0]
    asked = [now.position_m * down, now.velocity_m_s * down, [-np.deg2rad(now.yaw_deg), 0.0]]
    asked = np.broadcast_to(np.concatenate(asked), (len(state), 8))
    return np.concatenate([state[:, 0:3] * down, state[:, 3:6] * down, q, state[:, 10:13] * down, asked], axis=1)


def thrust_N(world: World, command: Floats) -> Floats:
    """Of rotor speeds [n, motors] in [0, 1]."""
    c = world.vehicle.thrust_curve
    return world.max_N * command * (c + (1.0 - c) * command)


def by_module(world: World, module: Module, n: int, silent_s: float = np.inf) -> Ordered:
    """Thrusts as mc_raptor orders them, of n vehicles; set-points stop after `silent_s`."""
    vehicles = [module.boot() for _ in range(n)]
    order = [CORNERS.index(loop.corner(motor.position_m)) for motor in world.vehicle.motors]

    def ordered(step: int, state: Floats, now: Reference) -> Floats:
        heard = int(step * world.step_s < silent_s)
        rows = numbers(state, now)
        every = zip(vehicles, rows, strict=True)
        found = np.array([module.tick(vehicle, step, row, (1, 1, heard, 1)) for vehicle, row in every])
        return thrust_N(world, np.clip(found[:, order], 0.0, 1.0))

    return ordered


def by_policy(world: World, policy: Policy, n: int) -> Ordered:
    """Thrusts of the float policy at its own period, given the same errors unclipped."""
    corners = [loop.corner(port.position_m) for port in policy.actions]
    order = [corners.index(loop.corner(motor.position_m)) for motor in world.vehicle.motors]
    every, memory, held = round(policy.control_period_s / world.step_s), policy.initial_memory(n), np.zeros((n, 4))

    def ordered(step: int, state: Floats, now: Reference) -> Floats:
        nonlocal memory, held
        if step % every == 0:
            c, s = np.cos(np.deg2rad(now.yaw_deg)), np.sin(np.deg2rad(now.yaw_deg))
            turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            attitude = (turn @ np.asarray(loop._matrices(jnp.asarray(state[:, 6:10], jnp.float32)))).reshape(n, 9)
            errors = [(state[:, 0:3] - now.position_m) @ turn.T, (state[:, 3:6] - now.velocity_m_s) @ turn.T]
            memory, action = policy.step(memory, np.concatenate([attitude, *errors, state[:, 10:13]], axis=1))
            held = thrust_N(world, action[:, order])
        return held

    return ordered


def asked(t: float) -> Reference:
    """A place with a heading."""
    del t
    return Reference(np.array([0.3, -0.2, 0.4]), np.zeros(3), np.zeros(3), np.zeros(3), 30.0)


def fell(states: Floats) -> NDArray[np.bool_]:
    return ~(np.linalg.norm(states[..., :3], axis=-1) < FELL_M).all(axis=0)


def last_second(world: World, states: Floats) -> Floats:
    return states[-round(1.0 / world.step_s) :, :, :3].mean(axis=0)


def loads(module: Module, policy: Policy) -> Iterator[str]:
    """The checkpoint as RLtools reads it beside the policy itself, over 500 steps of what a flight gives it."""
    motors = [loop.corner(port.position_m) for port in policy.actions]
    order = [motors.index(corner) for corner in loop.CORNERS]  # RAPTOR's are the Crazyflie's
    rng, memory = np.random.default_rng(0), policy.initial_memory(1)
    rows, inputs, wanted = policy.calibration[rng.permutation(len(policy.calibration))[:500], :18], [], []
    previous = np.zeros(4)
    for row in rows:
        memory, action = policy.step(memory, row[None])
        errors = np.clip(row[9:12], -0.5, 0.5), np.clip(row[12:15], -1.0, 1.0)
        inputs.append(np.concatenate([errors[0], row[:9], errors[1], row[15:18], previous]))
        previous = 2.0 * action[0, order] - 1.0
        wanted.append(previous)
    apart = np.abs(np.clip(module.respond(np.array(inputs)), -1.0, 1.0) - wanted).max()
    yield f"mc_raptor loads the checkpoint '{module.name()}', and its own test passes"
    verdict = "ok" if apart < SAME_OUTPUT else "FAILED"
    yield f"RLtools' outputs are at most {apart:.1e} from the policy's, 500 steps (limit {SAME_OUTPUT:g}): {verdict}"


def beside_the_policy(world: World, module: Module, policy: Policy, n: int, seconds: float) -> str:
    start = loop.starts(n, seed=100)
    flights = [
        loop.flown(world, start, seconds, ordered, asked)
        for ordered in (by_module(world, module, n), by_policy(world, policy, n))
    ]
    goal = asked(0.0).position_m
    ours, bare = (1e3 * np.linalg.norm(last_second(world, states) - goal, axis=1) for states in flights)
    change = np.abs(ours - bare).max()
    verdict = "ok" if change < SAME_MM and not fell(flights[0]).any() else "FAILED"
    return (
        f"{n} starts, {seconds:g} s: final offset at most {ours.max():.2f} mm, of the bare policy at 100 Hz"
        f" {bare.max():.2f} mm; from one start they differ by at most {change:.2f} mm (limit {SAME_MM:g}): {verdict};"
        f" {fell(flights[0]).sum()} fell, bare {fell(flights[1]).sum()}"
    )


def rules(world: World, module: Module, n: int) -> Iterator[str]:
    states = loop.flown(
        world, loop.starts(n, seed=102, distance_m=0.3, tilt_rad=0.3), 6.0, by_module(world, module, n, 2.0), asked
    )
    there = states[round(2.2 / world.step_s), :, :3]
    moved = np.linalg.norm(states[-round(1.0 / world.step_s) :, :, :3] - there, axis=-1).max()
    yield f"set-points stop after 2 s: at 5 to 6 s at most {moved:.2f} m from there; {fell(states).sum()} fell"
    for what, limit_ms, place in (("local position", 100, 0), ("attitude", 50, 1)):
        vehicle, row, published = module.boot(), numbers(loop.starts(1), asked(0.0))[0], []
        for step in range(200):
            fresh = [1, 1, 1, 1]
            fresh[place] = int(step < 100)
            published.append(bool(module.tick(vehicle, step, row, (fresh[0], fresh[1], fresh[2], fresh[3]))[4]))
        late_ms = 1e3 * (published.index(False, 1) - 99) / GYRO_HZ if False in published[1:] else np.inf
        yield f"no {what}: orders stop {late_ms:.1f} ms after the last (its limit: {limit_ms} ms)"


SIGNS = "+--"  # of x, y, z from PX4's frames to RAPTOR's, in the module's source
RATE, QUATERNION = "= {1}_vehicle_angular_velocity.xyz[{0}];", "qr[{0}] = {1}_vehicle_attitude.q[{2}];"
POSITION = "p[{0}] = {1}(position[{0}] - _trajectory_setpoint.position[{0}]);"
VELOCITY = "v[{0}] = {1}(linear_velocity[{0}]"
YAW, REMAP = "0.5f * _trajectory_setpoint.yaw", "temp.control[{}] = actuator_motors.control[{}];"
REMAPPED = (0, 2, 3, 1)


def in_source() -> dict[str, tuple[Mutant, ...]]:
    """Mistakes in the module's source: what it would be to be made for other units, orders or signs."""

    def one(old: str, new: str) -> tuple[Mutant, ...]:
        return (Mutant(old, new),)

    def turned(form: str, *axes: int) -> tuple[Mutant, ...]:
        """With the other sign along these axes."""
        return tuple(Mutant(form.format(i, SIGNS[i]), form.format(i, "-+"[SIGNS[i] == "-"])) for i in axes)

    def attitude(*changed: tuple[int, str, int]) -> tuple[Mutant, ...]:
        """qr[i] of another sign or of another number."""
        return tuple(
            Mutant(QUATERNION.format(i, "++--"[i], i), QUATERNION.format(i, sign, j)) for i, sign, j in changed
        )

    def motors(*places: int) -> tuple[Mutant, ...]:
        """PX4's motors given these of RAPTOR's."""
        pairs = enumerate(zip(REMAPPED, places, strict=True))
        return tuple(Mutant(REMAP.format(i, old), REMAP.format(i, new)) for i, (old, new) in pairs if old != new)

    return {
        **{f"body rate {axis} the other way": turned(RATE, i) for i, axis in enumerate("xyz")},
        "body rates in deg/s": tuple(
            Mutant(RATE.format(i, sign), RATE.format(i, f"{sign}57.3f * ")) for i, sign in enumerate(SIGNS)
        ),
        **{f"position {axis} the other way": turned(POSITION, i) for i, axis in enumerate("xyz")},
        "velocity the other way": turned(VELOCITY, 0, 1, 2),
        "quaternion x y z w": attitude((0, "+", 1), (1, "+", 2), (2, "-", 3), (3, "-", 0)),
        "attitude left in forward-right-down": attitude((2, "+", 2), (3, "+", 3)),
        "attitude conjugated": attitude((1, "-", 1), (2, "+", 2), (3, "+", 3)),
        "heading ignored": one(YAW, YAW.replace("0.5", "0.0")),
        "heading the other way": one(YAW, f"-{YAW}"),
        "motors not remapped": one("if constexpr(Raptor::REMAP_FROM_CRAZYFLIE)", "if constexpr(false)"),
        "motors 3 and 4 swapped": motors(0, 2, 1, 3),
        "motors mirrored: spins reversed": motors(3, 1, 0, 2),
        "commands not halved": one("value = (value + 1) / 2;", "value = value + 1;"),
        "memory at each sample": one("imu_gyro_ratemax / POLICY_CONTROL_FREQUENCY_TRAINING;", "1;"),
    }


def in_checkpoint(policy: Policy) -> dict[str, Callable[[Tensors], Tensors]]:
    """Mistakes in the checkpoint; what is stored as an example has them too, so that the module loads it."""
    motors = by_place_and_spin(policy, px4.MOTORS)
    assert not isinstance(motors, str)
    back, home = np.argsort(motors), np.argsort([*px4.ORDER, *range(18, 22)])

    def change(name: str, what: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Callable[[Tensors], Tensors]:
        return lambda made: made | {name: np.ascontiguousarray(what(made[name]))}

    by_columns = [0, 1, 2, 3, 6, 9, 4, 7, 10, 5, 8, 11, *range(12, 22)]

    def by_gate(weights: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.concatenate([part.T for part in np.split(weights, 3)])

    def gates(made: Tensors) -> Tensors:
        order = np.r_[16:32, 0:16, 32:48]
        return made | {name: made[name][order] for name in made if name.startswith("1/") and len(made[name]) == 48}

    def own_motors(made: Tensors) -> Tensors:
        inputs = np.r_[0:18, 18 + back]
        changed = {"2/weights": made["2/weights"][back], "2/biases": made["2/biases"][back]}
        return made | changed | {"0/weights": made["0/weights"][:, inputs]}

    def halved(made: Tensors) -> Tensors:
        weights = made["0/weights"].copy()
        weights[:, 18:] *= 0.5
        return made | {"0/weights": weights}

    return {
        "inputs in qrl's order": change("0/weights", lambda w: w[:, home]),
        "rotation matrix by columns": change("0/weights", lambda w: w[:, by_columns]),
        "weights column-major": change("0/weights", lambda w: w.T.reshape(w.shape)),
        "gates z, r, n": gates,
        "memory's weights transposed": change("1/weights_hidden", by_gate),
        "no bias of the gates": change("1/biases_input", np.zeros_like),
        "motors in the file's order": own_motors,
        "previous action of another scale": halved,
        "outputs of another sign": change("2/weights", np.negative),
    }


def mistakes(
    world: World, tree: Path, folder: Path, library: Path, policy: Policy, n: int
) -> Iterator[tuple[str, str, str]]:
    """For each: where it is, its name, and what n flights of it do."""
    start, wanted = loop.starts(n, seed=103, distance_m=0.5, tilt_rad=0.6), asked(0.0)
    right = px4.archive(policy, "right")

    def flown(module: Module) -> Floats:
        return loop.flown(world, start, 5.0, by_module(world, module, n), asked)

    def off(states: Floats) -> str:
        distance_m = np.linalg.norm(last_second(world, states) - wanted.position_m, axis=1).max()
        turned = np.abs((heading_deg(states) - wanted.yaw_deg + 180.0) % 360.0 - 180.0).max()
        return f"{1e3 * distance_m:.0f} mm and {turned:.1f}°"

    usual = off(flown(Module(library, right)))

    def verdict(module: Module) -> str:
        states = flown(module)
        return f"{fell(states).sum()} of {n} fall" if fell(states).any() else f"{off(states)} off, without it {usual}"

    for i, (name, mutants) in enumerate(in_source().items()):
        yield "module", name, verdict(Module(build(tree, folder / f"mutant{i}", *mutants), right))
    tensors = px4.tensors
    for name, wrong in in_checkpoint(policy).items():
        px4.tensors = lambda policy, wrong=wrong: wrong(tensors(policy))
        try:
            checkpoint = px4.archive(policy, name)
        finally:
            px4.tensors = tensors
        yield "checkpoint", name, verdict(Module(library, checkpoint))


def main(argv: list[str] | None = None) -> int:
    parser = Parser("px4", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument("--px4", type=Path, required=True, help="folder of PX4-Autopilot")
    parser.add_argument("--vehicle", default="x500", help="that flies it (default: x500)")
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--no-mistakes", action="store_true")
    args = parser.parse_args(argv)
    configure_jax()
    try:
        return fly(args)
    except BadInput as error:
        parser.error(str(error))


def fly(args: argparse.Namespace) -> int:
    if missing := [path for path in NEEDED if not (args.px4 / path).exists()]:
        raise BadInput(f"--px4 {args.px4}: expected PX4-Autopilot with its submodules, found no {missing[0]}")
    policy = TrainedRun.load(args.run).policy()
    if reason := px4.checkpoint_refusal(policy):
        raise BadInput(f"{args.run}: no {px4.FILE} for mc_raptor: {reason}")
    task = tasks.load("hover", args.vehicle)
    assert isinstance(task, QuadrotorTask)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        library = build(args.px4, folder / "right")
        module, world = Module(library, px4.archive(policy, "policy")), World(task.vehicle, 1.0 / GYRO_HZ)
        print("\n".join(loads(module, policy)), flush=True)
        print(beside_the_policy(world, module, policy, args.starts, args.seconds), flush=True)
        print("\n".join(rules(world, module, 5)), flush=True)
        if not args.no_mistakes:
            print(table(("in", "mistake", "flights"), list(mistakes(world, args.px4, folder, library, policy, 4))))
    return 0


if __name__ == "__main__":
    run_main("px4", main)

"""The emitted hook for Betaflight in the loop: compiled for a PC, at 1 kHz in the plant, in north, east, down."""

import ctypes
import math
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.crazyflie_loop import Floats, Mutant, World
from qrl.export.firmware import betaflight

FLIP = np.array([1.0, -1.0, -1.0])  # front, left, up <-> front, right, down; and of the world
OFF, FLIES, POSITION_OLD, ATTITUDE_OLD, SETPOINT_OLD, NOT_FINITE, SELFTEST = range(7)
NOW_US = 2**32 - 600_000  # the clock wraps around in mid-flight
WARNINGS = ("-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wdouble-promotion")
STRICT = ("-std=c99", "-pedantic", *WARNINGS)
HOOK = """
#include "{name}_hook.c"
unsigned size(void) {{ return (unsigned)sizeof({name}_hook); }}
float command_of(float of_most) {{ return command(of_most); }}
"""
# What Indiflight's main loop and its other tasks do, as far as its neural controller sees it.
INDIFLIGHT = """
#include "nn_controller.c"
static timeUs_t now;
timeUs_t extLatestMsgTime;
pos_setpoint_ned_t posSpNed;
static int given_up;
timeUs_t micros(void) { return now; }
void nn_deactivate(void) { given_up = 1; }
void reset(uint32_t us) { now = us; extLatestMsgTime = us; given_up = 0; nn_reset(); }
int control(uint32_t us, uint32_t measured_us, const float to[7], const float world_state[16], float motor[4]) {
    now = us;
    extLatestMsgTime = measured_us;
    posSpNed.pos.V.X = to[0]; posSpNed.pos.V.Y = to[1]; posSpNed.pos.V.Z = to[2];
    posSpNed.vel.V.X = to[3]; posSpNed.vel.V.Y = to[4]; posSpNed.vel.V.Z = to[5];
    posSpNed.psi = to[6];
    nn_control(world_state, motor);
    return given_up;
}
"""


class Estimate(ctypes.Structure):
    _fields_ = (
        *(
            (name, ctypes.c_float * size)
            for name, size in (("position", 3), ("velocity", 3), ("attitude", 4), ("w", 3))
        ),
        ("position_us", ctypes.c_uint32),
        ("attitude_us", ctypes.c_uint32),
    )


class SetPoint(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_float * 3) for name in ("position", "velocity", "acceleration", "jerk")),
        ("yaw_rad", ctypes.c_float),
        ("received_us", ctypes.c_uint32),
    )


def ned(state: Floats, now_us: int) -> Estimate:
    """Of a state [13] of the plant: position, velocity, quaternion w x y z, body rates."""
    parts = FLIP * state[:3], FLIP * state[3:6], [*state[6:8], *-state[8:10]], FLIP * state[10:13]
    return Estimate(*(tuple(part) for part in parts), now_us, now_us)


def set_point(now: loop.Reference, now_us: int) -> SetPoint:
    return SetPoint(*(tuple(FLIP * part) for part in now[:4]), -math.radians(now.yaw_deg), now_us)


def mutated(text: str, mutants: Sequence[Mutant]) -> str:
    """ValueError if a mutant's text is not there."""
    for mutant in mutants:
        if mutant.old not in text:
            raise ValueError(f"not in the source: {mutant.old}")
        text = text.replace(mutant.old, mutant.new)
    return text


def compiled(source: Path, folder: Path, name: str, flags: Sequence[str]) -> ctypes.CDLL:
    """A library of `source` with the kernel, and for Indiflight the hook, in `folder`, which are compiled once."""
    objects = [folder / f"{name}.o"] + ([folder / f"{name}_hook.o"] if "nn_" in source.name else [])
    for each in objects:
        if not each.exists():
            _gcc("-O1", *STRICT, "-fPIC", "-c", str(each.with_suffix(".c")), "-o", str(each))
    out = source.with_suffix(".so")
    includes = f"-I{source.parent}", f"-I{folder}"
    _gcc("-O0", "-shared", "-fPIC", *flags, *includes, str(source), *map(str, objects), "-lm", "-o", str(out))
    return ctypes.CDLL(str(out))


def _gcc(*words: str) -> None:
    done = subprocess.run(["gcc", *words], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr)


class Hook:
    """The hook that an export left in `folder`, compiled in `out`; the calls of any number of vehicles."""

    def __init__(self, folder: Path, name: str, out: Path, *mutants: Mutant, flags: Sequence[str] = ()) -> None:
        out.mkdir(parents=True)
        (out / f"{name}_hook.c").write_text(mutated((folder / f"{name}_hook.c").read_text(), mutants))
        (out / "shim.c").write_text(HOOK.format(name=name))
        flags = [*(() if mutants else STRICT), *flags]
        self.c, self._name = compiled(out / "shim.c", folder, name, flags), name
        self.c.command_of.restype = ctypes.c_float
        self.hooks: list[ctypes.Array[ctypes.c_char]] = []

    def boot(self) -> int:
        """One more vehicle; its number. RuntimeError if its self-test fails."""
        self.hooks.append(ctypes.create_string_buffer(self.c.size()))
        if not self.c[f"{self._name}_hook_init"](self.hooks[-1]) & 1:
            raise RuntimeError("the self-test failed")
        return len(self.hooks) - 1

    def start(self, vehicle: int, now_us: int) -> None:
        self.c[f"{self._name}_hook_start"](self.hooks[vehicle], ctypes.c_uint32(now_us))

    def run(self, vehicle: int, estimate: Estimate, to: SetPoint, now_us: int) -> tuple[int, Floats]:
        motor = (ctypes.c_float * 4)(*[math.nan] * 4)
        call = self.c[f"{self._name}_hook_run"]
        who = call(self.hooks[vehicle], ctypes.byref(estimate), ctypes.byref(to), ctypes.c_uint32(now_us), motor)
        return who, np.array(motor)

    def command(self, of_most: float) -> float:
        """Of an action as a fraction of its greatest."""
        return self.c.command_of(ctypes.c_float(of_most))

    def quaternion(self, roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
        found = (ctypes.c_float * 4)()
        self.c[f"{self._name}_quaternion"](*map(ctypes.c_float, (roll_rad, pitch_rad, yaw_rad)), found)
        return np.array(found)


class Indiflight:
    """One vehicle with Indiflight's interface around the hook: Euler angles in, no time on the attitude."""

    def __init__(self, folder: Path, name: str, out: Path, flags: Sequence[str], *mutants: Mutant) -> None:
        """`flags`: to compile against its headers."""
        out.mkdir(parents=True)
        (out / "nn_controller.c").write_text(mutated((folder / "nn_controller.c").read_text(), mutants))
        (out / "nn_shim.c").write_text(INDIFLIGHT)
        self.c = compiled(out / "nn_shim.c", folder, name, flags)

    def boot(self) -> int:
        return 0

    def start(self, _: int, now_us: int) -> None:
        self.c.reset(ctypes.c_uint32(now_us))

    def run(self, _: int, estimate: Estimate, to: SetPoint, now_us: int) -> tuple[int, Floats]:
        w, x, y, z = estimate.attitude
        angles = (
            math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
            math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        )
        world = (ctypes.c_float * 16)(*estimate.position, *estimate.velocity, *angles, *estimate.w, 0, 0, 0, 0)
        target = (ctypes.c_float * 7)(*to.position, *to.velocity, to.yaw_rad)
        motor = (ctypes.c_float * 4)(*[math.nan] * 4)
        times = ctypes.c_uint32(now_us), ctypes.c_uint32(estimate.position_us)
        given_up = self.c.control(*times, target, world, motor)
        return OFF if given_up else FLIES, np.array(motor)


def by_hook(world: World, hooks: Sequence[tuple[Hook | Indiflight, int]]) -> loop.Ordered:
    """Thrusts of each vehicle's hook, called at 1 kHz; none where it does not fly."""
    corners = [(motor.x, motor.y) for motor in betaflight.MOTORS]
    order = [corners.index(loop.corner(motor.position_m)) for motor in world.vehicle.motors]
    c, commands = world.vehicle.thrust_curve, np.zeros((len(hooks), 4))

    def thrust_N(step: int, state: Floats, now: loop.Reference) -> Floats:
        now_us = (NOW_US + 1000 * step) % 2**32
        for i, (hook, vehicle) in enumerate(hooks):
            if step == 0:
                hook.start(vehicle, now_us)
            who, motor = hook.run(vehicle, ned(state[i], now_us), set_point(now, now_us), now_us)
            commands[i] = motor if who == FLIES else 0.0
        w = commands[:, order]
        return np.maximum(world.max_N * w * (c + (1 - c) * w), world.min_N)

    return thrust_N


def circling(t: float) -> loop.Reference:
    """A circle of 0.5 m at 1 rad/s, rising and falling, that leaves the origin, with a heading of 40 degrees."""
    c, s = math.cos(t), math.sin(t)
    d = 0.5 * np.array([[s, 1 - c, 0.2 * s], [c, s, 0.2 * c], [-s, c, -0.2 * s], [-c, -s, -0.2 * c]])
    return loop.Reference(*d, yaw_deg=40.0)


Q = [f"estimate->attitude[{i}]" for i in range(4)]
QUATERNION = "w = {}, x = {}, y = {}, z = {}".format
W, TURN = "estimate->rates_rad_s", "setpoint->yaw_rad"
HEADING = "{{cosf({0}), sinf({0})}}".format
WEST = "heading[1] * north - heading[0] * east"
P, V = "p[0] - to[0], p[1] - to[1], p[2] - to[2]", "v[0] - at[0], v[1] - at[1], v[2] - at[2]"


def mistakes(name: str) -> dict[str, list[Mutant]]:
    """In the source of the hook: units, orders and signs, of a policy that orders thrusts."""
    period = f"{name.upper()}_PERIOD_US"
    found: dict[str, list[tuple[str, str]]] = {
        "quaternion x y z w": [(QUATERNION(*Q), QUATERNION(Q[3], *Q[:3]))],
        "quaternion conjugated": [(f"w = {Q[0]}", f"w = -{Q[0]}")],
        "matrix by columns": [("R11 + 3 * row + column", "R11 + 3 * column + row")],
        "rates about back": [(f"= {W}[0]", f"= -{W}[0]")],
        "rates about right": [(f"-{W}[1]", f"{W}[1]")],
        "rates about down": [(f"-{W}[2]", f"{W}[2]")],
        "rates in deg/s": [(f"{W}[{i}];", f"{W}[{i}] * 57.3f;") for i in range(3)],
        "down for up": [("out[2] = -down", "out[2] = down")],
        "east for west": [(WEST, f"-({WEST})")],
        "position absolute": [(P, "p[0], p[1], p[2]")],
        "velocity absolute": [(V, "v[0], v[1], v[2]")],
        "heading ignored": [(HEADING(TURN), "{1.0f, 0.0f}")],
        "heading the other way": [(HEADING(TURN), HEADING(f"-{TURN}"))],
        "heading in degrees": [(HEADING(TURN), HEADING(f"0.01745f * {TURN}"))],
        "thrust as speed": [("share = 2.0f * thrust / (c + root)", "share = thrust")],
        "every call": [(f"hook->next_us += {period}", "hook->next_us += 0"), (f"now_us + {period}", "now_us")],
    }
    for i in range(4):
        for j in range(i):
            swap = (f"[{i}] = c", "[9] = c"), (f"[{j}] = c", f"[{i}] = c"), ("[9]", f"[{j}]")
            found[f"motors {j + 1} and {i + 1} swapped"] = list(swap)
    return {what: [Mutant(*change) for change in changes] for what, changes in found.items()}


def indiflight_mistakes() -> dict[str, list[Mutant]]:
    """In the source of Indiflight's neural controller."""
    angles = "world_state[6], world_state[7], world_state[8]"
    found = {
        "yaw first": (angles, "world_state[8], world_state[7], world_state[6]"),
        "pitch the other way": (angles, angles.replace("world_state[7]", "-world_state[7]")),
        "rates and angles mixed up": ("{world_state[9], world_state[10], world_state[11]}", f"{{{angles}}}"),
        "north and east swapped": ("{world_state[0], world_state[1]", "{world_state[1], world_state[0]"),
        "no heading": (".yaw_rad = posSpNed.psi", ".yaw_rad = 0.0f"),
        "set-point's height the other way": ("posSpNed.pos.V.Z}", "-posSpNed.pos.V.Z}"),
        "set-point at rest": (
            "{posSpNed.vel.V.X, posSpNed.vel.V.Y, posSpNed.vel.V.Z}",
            "{0.0f, 0.0f, 0.0f}",
        ),
    }
    return {what: [Mutant(*change)] for what, change in found.items()}

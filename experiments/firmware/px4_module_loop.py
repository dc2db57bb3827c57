"""The module for PX4 compiled for a PC, its topics, and flights with it and with the bare kernel."""

import ctypes
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.firmware import crazyflie_loop as loop
from experiments.firmware import px4 as raptor
from experiments.firmware.betaflight_loop import circling, mutated
from experiments.firmware.crazyflie_loop import Floats, Mutant, Ordered, Reference, World
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl_envs.specfile import BadInput

SHIM = Path(__file__).parent / "px4_module_shim.cpp"
GYRO_HZ = raptor.GYRO_HZ
# Of PX4's cmake/px4_add_common_flags.cmake: those for both languages, and of one each.
WARNINGS = (
    *("-Wall", "-Wextra", "-Werror", "-Warray-bounds", "-Wcast-align", "-Wdisabled-optimization", "-Wdouble-promotion"),
    *("-Wfatal-errors", "-Wfloat-equal", "-Wformat-security", "-Winit-self", "-Wlogical-op", "-Wpointer-arith"),
    *("-Wshadow", "-Wuninitialized", "-Wunknown-pragmas", "-Wunused-variable", "-Wno-missing-field-initializers"),
    *("-Wno-unused-parameter", "-fno-signed-zeros", "-fno-trapping-math", "-freciprocal-math", "-fno-math-errno"),
    *("-fno-strict-aliasing", "-fmerge-all-constants"),
)
C, CXX = ("-std=gnu11", *WARNINGS, "-Wstrict-prototypes", "-Wnested-externs"), ("-std=gnu++14", *WARNINGS, "-Wreorder")
TOPICS = (
    *("actuator_motors", "arming_check_reply", "arming_check_request", "register_ext_component_reply"),
    *("register_ext_component_request", "trajectory_setpoint", "unregister_ext_component", "vehicle_angular_velocity"),
    *("vehicle_attitude", "vehicle_control_mode", "vehicle_local_position", "vehicle_status"),
)
BEGIN_US = 5_000_000


def topics(tree: Path, out: Path) -> Path:
    """A file of the structs that PX4's `msg/` in `tree` describes; BadInput if one is not there."""
    out.write_text("".join(_struct(tree, topic) for topic in TOPICS), encoding="utf-8")
    return out


def _struct(tree: Path, topic: str) -> str:
    name = "".join(part.capitalize() for part in topic.split("_"))
    paths = [tree / "msg" / folder / f"{name}.msg" for folder in ("versioned", ".")]
    path = next((path for path in paths if path.exists()), None)
    if path is None:
        raise BadInput(f"--px4 {tree}: expected PX4-Autopilot, found no {paths[0].relative_to(tree)}")
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if found := re.match(r"(\w+)(\[\d+\])?\s+(\w+)\s*(=\s*[^#]+)?", line):
            kind, size, field, value = found.groups()
            if kind == "Event":  # nested; the module sends none
                continue
            kind = {"float32": "float", "float64": "double", "bool": "bool", "char": "char"}.get(kind, f"{kind}_t")
            lines.append(
                f"    static constexpr {kind} {field} {value};" if value else f"    {kind} {field}{size or ''};"
            )
    return f"struct {topic}_s {{\n" + "\n".join(lines) + "\n};\n"


class Module:
    """The module in the folder `module/` of an export, compiled in `out`; of any number of vehicles, one at a time."""

    def __init__(self, folder: Path, name: str, out: Path, *mutants: Mutant, messages: Path | None = None) -> None:
        """Mutants may be of the mode's source or of the hook's; ValueError if one's text is in neither."""
        source = folder / "module" / "src" / "modules" / name
        out.mkdir(parents=True)
        texts = {path: (source / path).read_text(encoding="utf-8") for path in (f"{name}_mode.cpp", f"{name}_hook.c")}
        of_hook = [mutant for mutant in mutants if mutant.old not in texts[f"{name}_mode.cpp"]]
        of_mode = [mutant for mutant in mutants if mutant not in of_hook]
        for path, changed in zip(texts, (of_mode, of_hook), strict=True):
            (out / path).write_text(mutated(texts[path], changed), encoding="utf-8")
        header = (source / f"{name}_mode.hpp").read_text(encoding="utf-8")
        for include in re.findall(r"#include <([^>]+/[^>]+)>", header):
            (out / "headers" / include).parent.mkdir(parents=True, exist_ok=True)
            (out / "headers" / include).touch()
        found = re.search(r"class (\w+) final", header)
        assert found, header
        defines = [f'-DMODULE_NAME="{name}"', f"-DMODE={found[1]}", f'-DMODE_SOURCE="{out / name}_mode.cpp"']
        defines += [f'-DPX4_TOPICS="{messages}"'] if messages else []
        system = [f"-isystem{path}" for path in (out / "headers", SHIM.parent)]
        kernel, hook = source / f"{name}.o", out / "hook.o" if of_hook else source / "hook.o"
        library, common = out / "module.so", ("-fPIC", f"-I{source}")
        if not kernel.exists():  # with the option of the module's CMakeLists.txt
            loop.run("gcc", *C, "-Wno-float-equal", "-O1", *common, "-c", str(source / f"{name}.c"), "-o", str(kernel))
        of_c, of_cxx = (("-std=gnu11", "-w"), ("-std=gnu++14", "-w")) if mutants else (C, CXX)
        if not hook.exists():
            loop.run("gcc", *of_c, "-O1", *common, "-c", str(out / f"{name}_hook.c"), "-o", str(hook))
        objects = str(SHIM), str(hook), str(kernel)
        lean = ("-O0", "-shared", "-fno-rtti", "-fno-exceptions", "-nostdlib")
        loop.run("g++", *of_cxx, *lean, *common, *defines, *system, *objects, "-lm", "-lc", "-o", str(library))
        self.c = ctypes.CDLL(str(library))
        self.c.boot.restype, self.c.name.restype = ctypes.c_void_p, ctypes.c_char_p
        self.c.quiet(1)

    def boot(self) -> "Vehicle":
        """One more vehicle, not yet registered; ValueError if its self-test fails."""
        pointer = self.c.boot()
        if not pointer:
            raise ValueError("the self-test failed")
        return Vehicle(self, ctypes.c_void_p(pointer))


class Out:
    """What a tick published: commands of motors 1 to 4, whether they were, and the answer to the arming check."""

    def __init__(self, found: Floats) -> None:
        self.motor, self.published, self.whole = found[:4].copy(), bool(found[4]), bool(found[6])
        self.able = None if found[5] < 0 else bool(found[5])


class Vehicle:
    """One that runs the module. A tick is told which topics are new, and the mode."""

    def __init__(self, module: Module, pointer: ctypes.c_void_p) -> None:
        self.module, self.pointer = module, pointer

    def tick(
        self,
        now_us: float,
        numbers: Floats,
        position: int = 1,
        attitude: int = 1,
        asks: int = 1,
        mode: int = 1,
        armed: int = 1,
        check: int = 0,
    ) -> Out:
        """Numbers [27] as of `topics_of`; `position` 2: told not to be valid."""
        given, found = np.ascontiguousarray(numbers, np.float32), np.zeros(7, np.float32)
        flags = np.array([position, attitude, asks, mode, armed, check], np.int32)
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (given, flags, found)]
        self.module.c.tick(self.pointer, ctypes.c_uint64(round(now_us)), *pointers)
        return Out(found)

    def register(self, now_us: float = BEGIN_US - 20_000) -> "Vehicle":
        """As the commander does, while the mode is off; there are no estimates yet."""
        rest = topics_of(np.eye(13)[6:7], loop.REST)[0]
        self.tick(now_us, rest, position=0, attitude=0, mode=0, armed=0)
        self.module.c.registered(1, 1)
        self.tick(now_us + 2500, rest, position=0, attitude=0, mode=0, armed=0)
        return self


def topics_of(state: Floats, now: Reference) -> Floats:
    """Of states [n, 13] in qrl's frames what PX4's topics say, in the shim's order; [n, 27]."""
    along = np.concatenate([now.acceleration_m_s2, now.jerk_m_s3]) * np.tile([1.0, -1.0, -1.0], 2)
    return np.concatenate([raptor.numbers(state, now), np.broadcast_to(along, (len(state), 6))], axis=1)


def here(state: Floats) -> Reference:
    """A set-point at the place and the heading of a state [13]."""
    w, x, y, z = state[6:10]
    heading_deg = np.rad2deg(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    return loop.REST._replace(position_m=state[:3], yaw_deg=float(heading_deg))


def by_module(world: World, vehicles: Sequence[Vehicle], every: int) -> Ordered:
    """Thrusts as each vehicle's module orders them, from a take-over a control period, `every` steps, before."""
    order = [raptor.CORNERS.index(loop.corner(motor.position_m)) for motor in world.vehicle.motors]
    held = np.zeros((len(vehicles), 4))

    def ordered(step: int, state: Floats, now: Reference) -> Floats:
        if step == 0:
            for vehicle, row in zip(vehicles, topics_of(state, now), strict=True):
                vehicle.tick(BEGIN_US - every * 1e6 / GYRO_HZ, row, asks=0)
        for i, row in enumerate(topics_of(state, now)):
            out = vehicles[i].tick(BEGIN_US + step * 1e6 / GYRO_HZ, row)
            held[i] = out.motor if out.published else held[i]
        return np.maximum(raptor.thrust_N(world, held[:, order]), world.min_N)

    return ordered


def by_kernel(world: World, policy: Policy, kernel: Kernel, n: int) -> Ordered:
    """Thrusts of the bare kernel, after one step that holds the place of the start, as at a take-over."""
    ports, every = policy.observations[18::3], round(policy.control_period_s / world.step_s)

    def ahead(t: float) -> Floats:
        now = circling(t)
        times = [port.ahead_s or 0.0 for port in ports] if t >= 0.0 else []
        along = [now.acceleration_m_s2 * s + now.jerk_m_s3 * s**2 / 2.0 for s in times]
        return np.concatenate(along) if along else np.zeros(3 * len(ports))

    bare = [loop.by_kernel(world, policy, kernel, 1, ahead if ports else None) for _ in range(n)]

    def ordered(step: int, state: Floats, now: Reference) -> Floats:
        if step == 0:
            for i in range(n):
                bare[i](-every, state[i : i + 1], here(state[i]))
        return np.concatenate([bare[i](step, state[i : i + 1], now) for i in range(n)])

    return ordered

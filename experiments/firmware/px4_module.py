"""The emitted module for PX4, compiled for a PC and flown in the plant at 400 Hz: topics in, `actuator_motors` out.

    .venv/bin/python -m experiments.firmware.px4_module RUN [--px4 PX4-Autopilot]

RUN is a folder of a run, or `any`. uORB, work queue and parameters are a stub (px4_stub.hpp), and so are the topics'
fields, unless `--px4` gives PX4's own `msg/`. The module is emitted anew. It must fly as the bare kernel does, keep its
rules, and each mistake in its source must show.
"""

import argparse
import ctypes
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.arguments import Parser, run_main
from experiments.firmware import betaflight_loop as hooks
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware import px4 as raptor
from experiments.firmware.betaflight_loop import circling, mutated
from experiments.firmware.crazyflie_loop import Floats, Mutant, Ordered, Reference, World
from experiments.firmware.emitted import emitted
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.firmware import px4
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl.export.quantize import quantize
from qrl.runs import shipped
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask

NAME = "policy"
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
SAME_MM, ASTRAY_M, RIGHT = 1.0, 0.01, 4


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
            _run("gcc", *C, "-Wno-float-equal", "-O1", *common, "-c", str(source / f"{name}.c"), "-o", str(kernel))
        of_c, of_cxx = (("-std=gnu11", "-w"), ("-std=gnu++14", "-w")) if mutants else (C, CXX)
        if not hook.exists():
            _run("gcc", *of_c, "-O1", *common, "-c", str(out / f"{name}_hook.c"), "-o", str(hook))
        objects = str(SHIM), str(hook), str(kernel)
        lean = ("-O0", "-shared", "-fno-rtti", "-fno-exceptions", "-nostdlib")
        _run("g++", *of_cxx, *lean, *common, *defines, *system, *objects, "-lm", "-lc", "-o", str(library))
        self.c = ctypes.CDLL(str(library))
        self.c.boot.restype, self.c.name.restype = ctypes.c_void_p, ctypes.c_char_p
        self.c.quiet(1)

    def boot(self) -> "Vehicle":
        """One more vehicle, not yet registered; ValueError if its self-test fails."""
        pointer = self.c.boot()
        if not pointer:
            raise ValueError("the self-test failed")
        return Vehicle(self, ctypes.c_void_p(pointer))


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")


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


# Rules


def faults(module: Module) -> Iterator[str]:
    """What the module does other than its README says, of a policy that remembers; nothing if all is well."""
    yield from _registration(module)
    yield from _orders(module)
    yield from _ages(module)
    yield from _set_points(module)


def _on(module: Module) -> Vehicle:
    return module.boot().register()


def _still(distance_m: float = 0.0) -> Floats:
    """Topics of a vehicle at rest so far from the origin, and a set-point there."""
    return topics_of(np.eye(13)[6:7] + distance_m * np.eye(13)[0], loop.REST)[0]


def _registration(module: Module) -> Iterator[str]:
    vehicle, c, row = module.boot(), module.c, _still()
    vehicle.tick(BEGIN_US, row, mode=0)
    if not c.asked():
        yield "it asks for no mode, or otherwise"
    vehicle.tick(BEGIN_US + 500_000, row, mode=0)
    if c.asked():
        yield "it asks again within a second"
    vehicle.tick(BEGIN_US + 1_500_000, row, mode=0)
    if not c.asked():
        yield "without a reply it asks no more"
    for granted, own in ((0, 1), (1, 0)):
        c.registered(granted, own)
        if vehicle.tick(BEGIN_US + 1_600_000, row, check=1).published or c.configured():
            yield "a refusal, or the reply to another, is taken for a registration"
    c.registered(1, 1)
    vehicle.tick(BEGIN_US + 1_700_000, row, mode=0)
    if not c.configured():
        yield "PX4's controllers stay on"
    other = _on(module)
    other.tick(BEGIN_US + 2_000_000, row, mode=0, check=2)
    orders = other.tick(BEGIN_US + 2_010_000, row).published
    if orders or not c.asked():
        yield "a mode that the commander has removed gives orders, or is not asked for again"
    if not c.stopped(vehicle.pointer):
        yield "a stop leaves the mode registered"
    c.in_place_of_offboard(1)
    module.boot().tick(BEGIN_US, row, mode=0)
    if not c.asked():
        yield "it does not take the place of Offboard"
    c.in_place_of_offboard(0)


def _orders(module: Module) -> Iterator[str]:
    if any(_on(module).tick(BEGIN_US, _still(), mode=mode, armed=armed).published for mode, armed in ((0, 1), (1, 0))):
        yield "it gives orders in another mode, or disarmed"
    for gyro_us, jitter_us in ((2500, 0), (2500, 300), (4000, 0), (1000, 0)):
        vehicle, rng = _on(module), np.random.default_rng(0)
        times = [BEGIN_US + gyro_us * i + rng.uniform(-1, 1) * jitter_us for i in range(400_000 // gyro_us)]
        out = [vehicle.tick(time, _still()) for time in times]
        steps = np.diff([time for time, each in zip(times, out, strict=True) if each.published])
        if not len(steps):
            yield "no orders"
        elif not (abs(steps.sum() - 10_000 * len(steps)) < gyro_us + 1000 and np.ptp(steps) <= 2 * gyro_us):
            yield f"with the gyro every {gyro_us} us its steps are {steps.min():.0f} to {steps.max():.0f} us"
        if not all(each.whole for each in out if each.published):
            yield "actuator_motors is not as it should be"
    vehicle = _on(module)
    first = [vehicle.tick(BEGIN_US + i * 10_000, _still(0.3 if i else 0.0)).motor for i in range(100)]
    vehicle.tick(BEGIN_US + 1_000_000, _still(), mode=0)
    again = [vehicle.tick(BEGIN_US + 1_010_000 + i * 10_000, _still(0.3 if i else 0.0)).motor for i in range(2)]
    if np.array_equal(first[1], first[-1]):
        yield "the policy of the test has no memory"
    if not np.array_equal(first[:2], again):
        yield "it remembers what was before a take-over"


def _ages(module: Module) -> Iterator[str]:
    late, row = 40_000_000_000, _still()  # [us] after boot: twice as long as a difference in 32 bits can say
    for stale in ({"position": 0}, {"position": 2}, {"position": 3}, {"attitude": 0}):
        for begin_us in (BEGIN_US, late):
            if _on(module).tick(begin_us, row, mode=0, check=1, **stale).able:
                yield f"it may be armed without {stale}"
        vehicle, most_us = _on(module), 50_000 if "attitude" in stale else 100_000
        flew = [vehicle.tick(BEGIN_US + 2500 * i, row, check=1).published for i in range(8)]
        out = [vehicle.tick(BEGIN_US + 17_500 + 2500 * i, row, check=1, **stale) for i in range(1, 60)]
        *ordered, last = [(2500 * i, each) for i, each in enumerate(out, 1) if each.published] or [(0, out[0])]
        ordered_us = ordered[-1][0] if ordered else 0
        if last[0] != most_us + 2500 or np.ptp(last[1].motor):
            yield f"with {stale} a torque is left on the motors"
        able_us = 2500 * max((i for i, each in enumerate(out, 1) if each.able), default=0)
        if not any(flew) or not most_us - 10_000 <= ordered_us <= most_us or able_us != most_us:
            yield f"with {stale} orders end after {ordered_us} us, the arming check's yes after {able_us} us"
        back = [vehicle.tick(BEGIN_US + 200_000 + 10_000 * i, row, check=1) for i in range(4)]
        if any(each.published or each.able for each in back):
            yield f"a fault is forgotten in flight, {stale}"
        vehicle.tick(BEGIN_US + 300_000, row, mode=0)
        if not vehicle.tick(BEGIN_US + 310_000, row, check=1).published:
            yield "a fault stays when the mode is left"
        for later_us in (2**31 + 1_000_000, 2**32 + 20_000):  # as differences in 32 bits: less than 0, and 20 ms
            vehicle = _on(module)
            vehicle.tick(BEGIN_US, row, mode=0)
            if vehicle.tick(BEGIN_US + later_us, row, mode=0, check=1, **stale).able:
                yield f"what is old is new when a clock of 32 bits has wrapped around, {stale}"
    if not _on(module).tick(BEGIN_US, row, mode=0, check=1).able:
        yield "it may not be armed"
    for index in range(13):
        vehicle, bad = _on(module), row.copy()
        bad[index] = np.nan
        if not vehicle.tick(BEGIN_US, row).published or not vehicle.tick(BEGIN_US + 10_000, row).published:
            yield "no orders"
        out = vehicle.tick(BEGIN_US + 20_000, bad, check=1)
        if (out.published and np.ptp(out.motor)) or out.able:
            yield f"orders of number {index} that is not one"
        vehicle.tick(BEGIN_US + 30_000, row, mode=0)
        if not vehicle.tick(BEGIN_US + 40_000, row, mode=0, check=1).able:
            yield "a number that was not one stays"
    vehicle, bad = _on(module), np.where(np.arange(27) == 0, np.nan, row)
    vehicle.tick(BEGIN_US, bad)
    vehicle.tick(BEGIN_US + 10_000, bad, mode=0)
    if not vehicle.tick(BEGIN_US + 20_000, row, mode=0, check=1).able:
        yield "a place to hold that was no number stays"


def _set_points(module: Module) -> Iterator[str]:
    """Two vehicles with the same estimates must be given the same orders: the set-points mean the same."""
    state = loop.starts(12, seed=7, distance_m=0.2, tilt_rad=0.3)
    place = here(state[0])
    elsewhere = place._replace(position_m=place.position_m + [0.3, -0.2, 0.4], yaw_deg=place.yaw_deg + 50.0)
    moving = elsewhere._replace(velocity_m_s=np.array([0.4, 0.2, -0.3]))
    nan = np.full(3, np.nan)

    def differ(asked: Callable[[int], Reference | None], meant: Callable[[int], Reference], until: int = 12) -> bool:
        orders = []
        for to in (asked, meant):
            vehicle, found = _on(module), []
            for i, now in enumerate(state[:until]):
                ask = to(i)
                row = topics_of(now[None], ask or elsewhere)[0]
                # Set-points come at 100 Hz: the first, in the very sample of the take-over, is none for this mode.
                found.append(vehicle.tick(BEGIN_US + 10_000 * i, row, asks=int(ask is not None)).motor)
            orders.append(found)
        return not np.array_equal(*orders)

    if differ(lambda i: None, lambda i: place):
        yield "without a set-point it does not hold the place and heading of the take-over"
    if differ(lambda i: elsewhere if i == 0 else None, lambda i: place):
        yield "it follows a set-point of before the take-over"
    if not differ(lambda i: elsewhere, lambda i: place) or not differ(lambda i: moving, lambda i: elsewhere):
        yield "it does not follow a set-point"
    for what, asked, meant in (
        ("position", moving._replace(position_m=np.array([np.nan, 0.1, 0.1])), place),
        ("velocity", moving._replace(velocity_m_s=nan), elsewhere),
        ("acceleration", moving._replace(acceleration_m_s2=nan), moving),
        ("jerk", moving._replace(jerk_m_s3=nan), moving),
        ("heading", moving._replace(yaw_deg=np.nan), moving._replace(yaw_deg=place.yaw_deg)),
    ):
        if differ(lambda i, asked=asked: asked, lambda i, meant=meant: meant):
            yield f"a set-point without {what} is not taken as it should be"
    vehicle, twin = _on(module), _on(module)
    orders = []
    for i in range(60):  # set-points stop after 100 ms; from 310 ms on it holds where it was then
        now = state[5] + 0.01 * i * np.eye(13)[1]
        there = here(state[5] + 0.01 * 31 * np.eye(13)[1])
        first, second = topics_of(now[None], elsewhere)[0], topics_of(now[None], elsewhere if i < 31 else there)[0]
        outs = vehicle.tick(BEGIN_US + 10_000 * i, first, asks=int(i <= 10)), twin.tick(BEGIN_US + 10_000 * i, second)
        orders.append([out.motor for out in outs])
    if not all(np.array_equal(*both) for both in orders):
        yield "set-points stop, and it does not hold the place and heading of 200 ms later"


def mistakes(name: str) -> dict[str, list[Mutant]]:
    """In the source of the mode, and of the hook: order, signs and units, then rules."""
    take = "memcpy(_estimate.attitude, attitude.q, sizeof(_estimate.attitude));"
    by_hand = "for (int i = 0; i < 4; ++i) {{ _estimate.attitude[i] = {}; }}".format
    p = "position_m[{}] = position.{}".format
    motor, heading = "i < 4 ? motor[i]", "_setpoint.yaw_rad = asked.yaw"
    able = f"able == {name.upper()}_FLIES"
    on = "status.nav_state == _mode_id"
    found = {
        "north and east swapped": [(p(0, "x"), p(0, "y")), (p(1, "y;"), p(1, "x;"))],
        "height the other way": [("= position.z", "= -position.z")],
        "east the other way": [("= position.y", "= -position.y")],
        "velocity down the other way": [("= position.vz", "= -position.vz")],
        "quaternion x y z w": [(take, by_hand("attitude.q[(i + 1) % 4]"))],
        "quaternion conjugated": [(take, by_hand("i ? -attitude.q[i] : attitude.q[i]"))],
        "attitude of forward, left, up": [(take, by_hand("i > 1 ? -attitude.q[i] : attitude.q[i]"))],
        "rates left out": [("memcpy(_estimate.rates_rad_s, rates.xyz,", "memset(_estimate.rates_rad_s, 0,")],
        "set-point's velocity left out": [("or_zero(asked.velocity[i])", "0.0f")],
        "set-point's height the other way": [
            ("position_m[i] = asked.position[i]", "position_m[i] = i == 2 ? -asked.position[i] : asked.position[i]")
        ],
        "heading left out": [(heading, "_setpoint.yaw_rad = 0.0f")],
        "heading the other way": [(heading, "_setpoint.yaw_rad = -asked.yaw")],
        "motors mirrored: spins reversed": [(motor, "i < 4 ? motor[i ^ 2]")],
        "motors front and back swapped": [(motor, "i < 4 ? motor[3 - i]")],
        "motors in the Crazyflie's order": [(motor, "i < 4 ? motor[i == 1 ? 3 : i == 3 ? 2 : i == 2 ? 1 : 0]")],
        "commands halved": [(motor, "i < 4 ? 0.5f * motor[i]")],
        "other motors at 0": [(": NAN", ": 0.0f")],
        "ages ignored": [("ahead ? then_us - now_us : now_us - then_us", "0 * then_us")],
        "ages wrap around": [
            ("apart_us < INT32_MAX ? static_cast<uint32_t>(apart_us) : INT32_MAX", "(uint32_t)apart_us")
        ],
        "validity ignored": [("position.xy_valid && position.z_valid", "true || position.z_valid")],
        "time of the last position ignored": [("_position_us = position.timestamp", "_position_us = UINT64_MAX")],
        "memory not reset": [(f"{name}_reset(&hook->memory);", "")],
        "take-over at boot alone": [("if (_on && !before)", "if (_on && !before && _steps == 0)")],
        "flies in every mode": [(on, "status.nav_state > 0")],
        "flies disarmed": [("status.arming_state == vehicle_status_s::ARMING_STATE_ARMED", "true")],
        "arming check always granted": [(able, "able >= 0")],
        "arming check forgets a fault": [(f"{able} && (!_on || _who == {name.upper()}_FLIES)", able)],
        "fault stays with the set-point": [("_setpoint = {}; // one", "// one")],
        "set-point does not age": [(f"now_us > _asked_us + {name.upper()}_SETPOINT_US", "false")],
        "holds the place of each sample": [("_asked = false;", "_asked = true;")],
        "holds no place at the take-over": [("hold(); // a set-point", "// a set-point")],
        "holds the heading north": [("_setpoint.yaw_rad = atan2f", "_setpoint.yaw_rad = 0.0f * atan2f")],
        "a set-point of before": [("} else if (asks) {", "} if (asks) {")],
        "a set-point without a position": [("if (!PX4_ISFINITE(asked.position[i]))", "if (false)")],
        "a set-point without a velocity": [("PX4_ISFINITE(value) ? value : 0.0f", "value")],
        "a set-point without a heading": [("if (PX4_ISFINITE(asked.yaw))", "if (true)")],
        "orders at each sample": [("_hook.next_us != due_us", "true")],
        "period not kept": [
            (f"hook->next_us += {name.upper()}_PERIOD_US", f"hook->next_us = now_us + {name.upper()}_PERIOD_US")
        ],
        "another's registration": [("reply.request_id == REQUEST_ID && ", "")],
        "a registration refused": [(" && reply.success", "")],
        "asks once": [("now_us > _requested_us + REQUEST_US", "false")],
        "control allocation left on": [
            ("config.source_id", "config.flag_control_allocation_enabled = true; config.source_id")
        ],
        "body rates left to PX4": [("config.source_id", "config.flag_control_rates_enabled = true; config.source_id")],
        "arming check of another": [("= request.request_id", "= 0")],
        "not unregistered": [("request.mode_id = _mode_id;", "")],
        "never in place of Offboard": [("_param_offboard.get()", "false")],
        "a removed mode stays": [("!(request.valid_registrations_mask & (1u << _arming_check_id))", "false")],
        "may be armed in this mode": [("mode_req_prevent_arming = true", "mode_req_prevent_arming = false")],
        "dead reckoning taken for a position": [(" && !position.dead_reckoning", "")],
        "torque left at a fault": [(f"_who == {name.upper()}_FLIES && _on)", "_who < 0)")],
        "no MAVLink set-points": [("request_offboard_setpoints = true", "request_offboard_setpoints = false")],
    }
    return {what: [Mutant(*change) for change in changes] for what, changes in found.items()}


def main(argv: list[str] | None = None) -> int:
    parser = Parser("px4_module", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder, or `any`")
    parser.add_argument("--px4", type=Path, metavar="TREE", help="a checkout of PX4-Autopilot, for its msg/")
    parser.add_argument("--vehicle", default="x500", help="that flies it (default: x500)")
    parser.add_argument("--seconds", type=float, default=4.0, help="of each flight (default: 4)")
    args = parser.parse_args(argv)
    configure_jax()
    try:
        return fly(args)
    except BadInput as error:
        print(f"px4_module: {error}", file=sys.stderr)
        return WRONG_INPUT


def fly(args: argparse.Namespace) -> int:
    policy = TrainedRun.load(shipped.run_folder(args.run)).policy()
    if reason := px4.refusal(policy):
        raise BadInput(f"{args.run}: no module for PX4: {reason}")
    task = tasks.load("hover", args.vehicle)
    assert isinstance(task, QuadrotorTask)
    world, kernel = World(task.vehicle, 1.0 / GYRO_HZ), quantize(policy)
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch)
        messages = topics(args.px4, out / "topics.hpp") if args.px4 else None
        folder = emitted(px4, policy, kernel, out, NAME)
        right = Module(folder, NAME, out / "right", messages=messages)
        of_hook = hooks.mistakes(NAME)
        if policy.actions[0].quantity:
            del of_hook["thrust as speed"]
        if policy.body_frame:  # mirrored vectors and a mirrored matrix are the same to it
            del of_hook["east for west"]
        del of_hook["every call"]  # below: orders at each sample
        wrong = mistakes(NAME) | {f"hook: {what}": mutants for what, mutants in of_hook.items()}
        modules = [
            Module(folder, NAME, out / f"mistake{i}", *mutants, messages=messages)
            for i, mutants in enumerate(wrong.values())
        ]
        start = loop.starts(RIGHT, seed=100, distance_m=0.3, tilt_rad=0.4)
        every = np.concatenate([start, np.tile(start[:1], (len(wrong), 1))])
        vehicles = [module.boot().register() for module in [right] * RIGHT + modules]
        steps = round(policy.control_period_s * GYRO_HZ)
        flown = loop.flown(world, every, args.seconds, by_module(world, vehicles, steps), circling)[..., :3]
        bare = loop.flown(world, start, args.seconds, by_kernel(world, policy, kernel, RIGHT), circling)[..., :3]
        found = list(faults(right))
        apart_mm = 1e3 * np.abs(flown[:, :RIGHT] - bare).max()
        astray = np.abs(flown[:, RIGHT:] - bare[:, :1]).max(axis=(0, 2)) > ASTRAY_M
        broken = np.array([next(faults(module), None) is not None for module in modules])
    print(f"{RIGHT} flights of {args.seconds:g} s: at most {apart_mm:.3f} mm from the bare kernel (limit {SAME_MM:g})")
    print("\n".join(["rules that it breaks:", *found]) if found else "it keeps its rules")
    print(
        f"of {len(wrong)} mistakes {astray.sum()} stray by more than {1e3 * ASTRAY_M:g} mm, or fall;"
        f" {(broken & ~astray).sum()} others break a rule"
    )
    missed = [what for what, shows in zip(wrong, astray | broken, strict=True) if not shows]
    for what in missed:
        print(f"  not: {what}")
    return DONE if apart_mm < SAME_MM and not found and not missed else FAILED


if __name__ == "__main__":
    run_main("px4_module", main)

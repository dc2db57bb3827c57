"""The app for a Crazyflie: for whom there is one, and that it flies as the bare kernel does; each mistake in it shows.

Compiled against headers of our own (`helpers/crazyflie_headers`); `experiments.firmware.crazyflie` does the same
against the firmware's.
"""

import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import policies
from cross_targets import need
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware import crazyflie_mistakes as faulty
from experiments.firmware import crazyflie_protocol as protocol
from experiments.firmware.crazyflie import NAME, boots, circling, fell, tail
from experiments.firmware.crazyflie_loop import App, Firmware, Mutant, World
from experiments.firmware.emitted import emitted as written
from qrl.export import emit, vectors
from qrl.export.firmware import crazyflie
from qrl.export.policy import ActionSpec, Integral, Memory, Policy
from qrl.export.quantize import quantize
from qrl_envs import io_spec
from qrl_envs import task as tasks
from qrl_envs.task import QuadrotorTask

HEADERS = Path(__file__).parents[1] / "helpers" / "crazyflie_headers"
BRUSHLESS, BRUSHED = "-DCONFIG_PLATFORM_CF21BL", "-DCONFIG_PLATFORM_CF2"


def flying(task: str, vehicle: str | None = None) -> tuple[ActionSpec, ...]:
    spec = tasks.load(task, vehicle)
    return tuple(ActionSpec(**port._asdict()) for port in io_spec.actions(spec))


def of_vehicle(vehicle: str, task: str = "hover") -> Policy:
    """A lively policy of a vehicle with four motors."""
    return replace(policies.policy(policies.HOVER), actions=flying(task, vehicle))


@cache
def steady() -> Policy:
    """A linear controller of the brushless Crazyflie that hovers, with an integral: its gains are the network."""
    task = tasks.load("hover", "cf21_brushless")
    assert isinstance(task, QuadrotorTask)
    vehicle, mass, g = task.vehicle, task.vehicle.mass_kg, 9.81
    jx, jy, jz = vehicle.inertia_kg_m2
    p, v, w, integral = 9, 12, 15, 18
    gain = np.zeros((21, 4))  # of the inputs, on force along z and torques about x, y, z
    for axis, (to_force, to_torque, inertia) in enumerate([(None, 2, jy), (None, 1, jx), (0, None, None)]):
        for place, k in ((p, -2.0), (v, -2.5), (integral, -0.5)):
            if to_torque is None:
                gain[place + axis, to_force] = k * mass
            else:
                gain[place + axis, to_torque] = (1 if to_torque == 2 else -1) * k / g * inertia * 100.0
    gain[2, 2], gain[5, 1], gain[3, 3] = -jy * 100.0, jx * 100.0, -jz * 20.0  # r13, r23, r21
    for axis, (inertia, damping) in enumerate([(jx, 18.0), (jy, 18.0), (jz, 9.0)]):
        gain[w + axis, 1 + axis] = -inertia * damping
    motors = np.linalg.inv(np.concatenate([np.ones((1, 4)), vehicle.torques_m]))
    ports = flying("hover", "cf21_brushless")
    rng = np.random.default_rng(0)
    flights = np.concatenate([policies.hover_flights(rng, 1500), rng.uniform(-0.3, 0.3, (1500, 3))], axis=1)
    return replace(
        policies.policy(policies.HOVER),
        actions=ports,
        memory=Memory(False, Integral((9, 10, 11), radius_m=1.0, limit_m_s=0.6)),
        observation_offset=np.zeros(21),
        observation_gain=np.ones(21),
        observation_scale=np.ones(21),
        layers=((gain @ motors.T / np.array([port.scale for port in ports]), np.zeros(4)),),
        calibration=flights.astype(np.float32),
    )


def emitted(policy: Policy, folder: Path) -> Path:
    """The app's folder in an export to `folder`."""
    return written(crazyflie, policy, quantize(policy), folder, NAME)


class Built:
    def __init__(self, policy: Policy, platform: str, folder: Path) -> None:
        self.policy, self.kernel = policy, quantize(policy)
        self.app, self.firmware = emitted(policy, folder), Firmware((HEADERS,), (platform,))
        self.library = loop.build(self.app, self.firmware, folder / "build" / "app.so")

    def with_mistake(self, *mutants: Mutant) -> Path:
        count = len(list(self.library.parent.glob("*.so")))
        return loop.build(self.app, self.firmware, self.library.with_name(f"mistake{count}.so"), *mutants)

    def faults(self, library: Path) -> list[str]:
        return list(protocol.faults(boots(library), self.policy, self.kernel))


def recurrent() -> Policy:
    """With a preview, all memory, in the body frame; of the brushless Crazyflie."""
    return policies.remembering("recurrent")


def any_vehicle() -> Policy:
    """The same for any vehicle, in another order of motors."""
    return replace(recurrent(), actions=flying("any"))


POLICIES = {
    "any vehicle, brushed": (any_vehicle, BRUSHED),
    "another order": (lambda: of_vehicle("crazyflie"), BRUSHED),
}


@pytest.fixture(scope="module", autouse=True)
def _compiler() -> None:
    need([] if shutil.which("gcc") else ["gcc"])


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(recurrent(), BRUSHLESS, tmp_path_factory.mktemp("recurrent"))


@pytest.mark.parametrize(
    ("vehicle", "title"),
    [
        ("crazyflie", "Crazyflie 2.1+ or 2.X with its propellers"),
        ("cf2x_l250", "Crazyflie 2.1+ or 2.X with its propellers"),
        ("cf21_brushless", "Crazyflie 2.1 Brushless"),
    ],
)
def test_the_platform_is_the_vehicles(vehicle: str, title: str) -> None:
    policy = of_vehicle(vehicle)
    assert crazyflie.refusal(policy) is None
    found = crazyflie.platform(policy)
    assert found
    assert found.title == title


def test_a_policy_of_any_vehicle_fits_each_platform() -> None:
    assert crazyflie.refusal(any_vehicle()) is None
    assert crazyflie.platform(any_vehicle()) is None


def changed(policy: Policy, index: int, **changes: object) -> Policy:
    """With another port for one motor."""
    ports = list(policy.actions)
    ports[index] = replace(ports[index], **changes)
    return replace(policy, actions=tuple(ports))


def wide(units: int) -> Policy:
    """With a hidden layer of so many units."""
    return replace(policies.policy((18, units, 4)), actions=flying("hover", "crazyflie"))


UNFIT = {
    "pendulum": (lambda: policies.policy(policies.PENDULUM), "observation is not"),
    "units of its own": (lambda: policies.policy((18, 4, 3)), "observation is not"),
    "six motors": (lambda: replace(of_vehicle("crazyflie"), actions=flying("hover", "hexa")), "the policy has 6"),
    "heavy": (lambda: of_vehicle("paper"), "hover takes 1.64 N of a motor, and a Crazyflie's have at most 0.2 N"),
    "4.5 ms": (lambda: replace(recurrent(), control_period_s=0.0045), "control period of 4.5 ms is no whole number"),
    "0.5 ms": (lambda: replace(recurrent(), control_period_s=0.0005), "control period of 0.5 ms is no whole number"),
    "spin": (lambda: changed(recurrent(), 1, spin=-1), r"back right \(M2\) has spin \+1, and the vehicle's \(f2\) -1"),
    "a corner": (lambda: changed(recurrent(), 1, position_m=(0.03, -0.03)), r"right \(M1\), and the vehicle has 2"),
    "plus": (lambda: changed(recurrent(), 1, position_m=(0.0, -0.05)), r"back right \(M2\), and the vehicle has 0"),
    "large": (
        lambda: replace(
            recurrent(),
            actions=tuple(replace(a, position_m=tuple(2 * x for x in a.position_m or ())) for a in recurrent().actions),
        ),
        "motors are 100 mm from the center, and a Crazyflie's 46 to 50 mm",
    ),
    "unit": (lambda: changed(recurrent(), 2, unit="1", quantity="duty"), "neither thrusts"),
    "wide": (lambda: wide(352), "its two buffers take 1,408 of the stabilizer's 1,800 bytes of stack"),
    "tilted": (lambda: changed(recurrent(), 2, axis=(0.0, 0.1, 0.995)), r"the vehicle's are tilted \(f3\)"),
    "heading": (
        lambda: replace(
            recurrent(), observations=recurrent().observations[:18] + policies.policy(policies.ODD).observations[:3]
        ),
        "observation is not",
    ),
}


@pytest.mark.parametrize("case", UNFIT)
def test_what_cannot_fly_is_refused_with_the_reason(case: str) -> None:
    make, reason = UNFIT[case]
    policy = make()
    said = crazyflie.refusal(policy)
    assert said
    assert re.search(reason, said), said
    assert crazyflie.files(policy, {}, NAME) == {}
    assert (said in crazyflie.section(policy)) == all(port.spin for port in policy.actions)


def test_the_files_are_whole() -> None:
    kernel = {f"{NAME}.c": "c\n", f"{NAME}.h": "h\n"}
    for policy in (recurrent(), any_vehicle(), of_vehicle("crazyflie")):
        files = crazyflie.files(policy, kernel, NAME)
        app = {"Kbuild", "Makefile", "README.md", "app-config", "src/Kbuild", f"src/{NAME}_controller.c"}
        assert set(files) == {f"crazyflie/{name}" for name in app | {f"src/{NAME}.c", f"src/{NAME}.h"}}
        for text in files.values():
            assert "@" not in text.replace("@brief", "")
            assert text.endswith("\n")
        assert all(
            fact in crazyflie.section(policy) and fact in files["crazyflie/README.md"]
            for fact in crazyflie.facts(policy)
        )
    readme = crazyflie.files(of_vehicle("crazyflie"), kernel, NAME)["crazyflie/README.md"]
    assert "30.0 g" in readme
    assert "above 0.12 N are cut" in readme
    assert "flies at an offset" in readme
    assert "hover: reach a point and hover there." in readme
    assert (
        "CONFIG_CRAZYFLIE_21_PLUS=y\n" in crazyflie.files(of_vehicle("crazyflie"), kernel, NAME)["crazyflie/app-config"]
    )


@pytest.mark.parametrize(("units", "words"), [(8, 600), (64, 600), (348, 884)])
def test_the_apps_stack_is_for_the_widest_layer(units: int, words: int) -> None:
    files = crazyflie.files(wide(units), {f"{NAME}.c": "", f"{NAME}.h": ""}, NAME)
    assert f"CONFIG_APP_STACKSIZE={words}\n" in files["crazyflie/app-config"]


def test_another_platform_does_not_compile(built: Built) -> None:
    source = built.app / "src" / f"{NAME}_controller.c"
    for flags, wanted in (([BRUSHED], "build for the Crazyflie 2.1 Brushless"), ([BRUSHLESS], "")):
        command = ["gcc", "-fsyntax-only", f"-I{HEADERS}", *flags, str(source)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert wanted in done.stderr
        assert (done.returncode == 0) == (not wanted)


def test_it_compiles_for_the_crazyflies_core(built: Built) -> None:
    need([] if shutil.which("arm-none-eabi-gcc") else ["arm-none-eabi-gcc"])
    core = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os", "-Wdouble-promotion"]
    for name in (NAME, f"{NAME}_controller"):
        source, output = built.app / "src" / f"{name}.c", built.library.with_name(f"{name}_arm.o")
        command = ["arm-none-eabi-gcc", "-std=gnu11", *core, *loop.STRICT, f"-I{HEADERS}", BRUSHLESS, "-c"]
        subprocess.run([*command, str(source), "-o", str(output)], check=True)


def test_it_orders_what_the_kernel_does(built: Built) -> None:
    """Forces, hold, take-over, fallback: `crazyflie_protocol.CASES`."""
    assert built.faults(built.library) == []


@pytest.mark.parametrize("case", POLICIES)
def test_it_orders_what_other_kernels_do(case: str, tmp_path: Path) -> None:
    make, platform = POLICIES[case]
    found = Built(make(), platform, tmp_path)
    assert found.faults(found.library) == []


OF_SPEEDS = ("speed as force", "motors may stop")  # the other policy orders no less than its vehicle's min_N


@pytest.mark.parametrize("mistake", sorted(set(faulty.mistakes(NAME.upper(), recurrent())) - set(OF_SPEEDS)))
def test_each_mistake_is_found(mistake: str, built: Built) -> None:
    assert built.faults(built.with_mistake(*faulty.mistakes(NAME.upper(), built.policy)[mistake]))


def test_each_mistake_with_speeds_is_found(tmp_path: Path) -> None:
    found = Built(any_vehicle(), BRUSHLESS, tmp_path)
    assert found.faults(found.library) == []
    for mistake in OF_SPEEDS:
        assert found.faults(found.with_mistake(*faulty.of_orders(NAME.upper(), found.policy)[mistake])), mistake


def test_a_self_test_that_fails_grounds_it(built: Built) -> None:
    failing = Mutant(f"{NAME}_selftest() == 0", f"{NAME}_selftest() == 1")
    for library, passes, state in ((built.library, True, [1, 1]), (built.with_mistake(failing), False, [6, 0])):
        app = App(library)
        assert app.passed == passes
        app.arm()
        assert app.tick(loop.numbers(protocol.states(1, 0), protocol.MOVING)[0])[4:].tolist() == state


GROUNDED = "gyro in deg/s, gyro.x the other way, quaternion w x y z, quaternion conjugated, matrix by columns"
GROUNDED += ", motors mirrored: spins reversed, motors turned by one, position the other way, forces as torques"
RIGHT, SECONDS = 3, 2.0  # flights without a mistake, and how long all are
ASTRAY = "velocity in the body frame, velocity absolute, heading ignored, heading the other way, heading in rad"
ASTRAY += ", THRUST_MAX of another platform, position in the body frame"


def test_it_flies_as_the_kernel_does_and_mistakes_do_not(tmp_path: Path) -> None:
    """In the plant at 1 kHz along a circle, with a heading, all flights of the app at once: apart from the bare kernel
    by less than 1 mm, and each mistake falls or strays.
    """
    task = tasks.load("hover", "cf21_brushless")
    assert isinstance(task, QuadrotorTask)
    built, world = Built(steady(), BRUSHLESS, tmp_path), World(task.vehicle)
    of_orders = faulty.of_orders(NAME.upper(), built.policy)
    names = GROUNDED.split(", ") + ASTRAY.split(", ") + [name for name in of_orders if "swapped" in name]
    vehicles = loop.apps(built.library, RIGHT)
    vehicles += [loop.apps(built.with_mistake(*of_orders[name]), 1)[0] for name in names]
    start = loop.starts(RIGHT, seed=5, distance_m=0.3, tilt_rad=0.4)
    every = np.concatenate([start, np.tile(start[:1], (len(names), 1))])
    flights = loop.flown(world, every, SECONDS, loop.by_app(world, vehicles), circling)
    bare = loop.flown(world, start, SECONDS, loop.by_kernel(world, built.policy, built.kernel, RIGHT), circling)
    assert not fell(flights)[:RIGHT].any()
    assert np.abs(flights[:, :RIGHT, :3] - bare[..., :3]).max() < 1e-3
    down = dict(zip(names, fell(flights)[RIGHT:], strict=True))
    apart = dict(zip(names, np.linalg.norm(tail(flights) - tail(flights)[0], axis=1)[RIGHT:], strict=True))
    assert [name for name in names if not down[name] and not apart[name] > 0.01] == []


def test_the_kernel_is_the_emitted_one(built: Built) -> None:
    files = emit.files(built.policy, built.kernel, vectors.golden(built.policy, built.kernel), NAME)
    for name in (f"{NAME}.c", f"{NAME}.h"):
        assert (built.app / "src" / name).read_text() == files[name]

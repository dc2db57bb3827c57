"""The module for PX4: for whom there is one; it flies as the bare kernel does and keeps its rules; mistakes show.

Compiled against a stub of uORB (`experiments/firmware/px4_stub.hpp`) with PX4's own warnings.
"""

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from test_betaflight import UNFIT
from test_crazyflie import any_vehicle, changed, of_vehicle, recurrent, steady
from test_px4 import shaped

from cross_targets import need
from experiments.firmware import betaflight_loop as hooks
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware import px4_module_loop as modules
from experiments.firmware.crazyflie_loop import Mutant, World
from experiments.firmware.emitted import emitted as written
from experiments.firmware.px4_module_loop import Module
from experiments.firmware.px4_module_mistakes import mistakes
from experiments.firmware.px4_module_rules import faults
from qrl.export.firmware import px4
from qrl.export.policy import Policy
from qrl.export.quantize import quantize
from qrl_envs import task as tasks
from qrl_envs.task import QuadrotorTask

NAME, EVERY = "fly", 4  # steps of the gyro in a control period
KERNEL = {f"{NAME}.c": "", f"{NAME}.h": ""}
SOURCE = f"px4/module/src/modules/{NAME}"


@pytest.fixture(scope="module", autouse=True)
def _compiler() -> None:
    need([tool for tool in ("gcc", "g++") if not shutil.which(tool)])


def emitted(policy: Policy, folder: Path) -> Path:
    return written(px4, policy, quantize(policy), folder, NAME)


@cache
def world() -> World:
    task = tasks.load("hover", "cf21_brushless")
    assert isinstance(task, QuadrotorTask)
    return World(task.vehicle, 1.0 / modules.GYRO_HZ)


REASONS = {
    **{case: UNFIT[case] for case in ("pendulum", "six motors", "unit", "tilted")},
    "a corner": (UNFIT["a corner"][0], r"there is one motor front right \(1\), and the vehicle has 2"),
    "a spin": (lambda: changed(recurrent(), 1, spin=-1), r"back right \(4\) has spin \+1, and the vehicle's \(f2\) -1"),
    "a circle": (lambda: around_a_circle(recurrent()), "the center of a circle that it flies"),
}


def around_a_circle(policy: Policy) -> Policy:
    ports = list(policy.observations)
    ports[9] = replace(ports[9], frame="world: position from the circle's center")
    return replace(policy, observations=tuple(ports))


@pytest.mark.parametrize("case", REASONS)
def test_what_cannot_fly_is_refused_with_the_reason(case: str) -> None:
    make, reason = REASONS[case]
    policy = make()
    said = px4.refusal(policy)
    assert said
    assert re.search(reason, said), said
    assert px4.files(policy, {}, NAME) == {}
    assert (said in px4.section(policy)) == all(port.spin for port in policy.actions)


def test_each_policy_gets_what_it_fits() -> None:
    """Of RAPTOR's shape the checkpoint and the module, of another the module; README and report say which and why."""
    module = {
        *("px4/README.md", "px4/module/README.md", "px4/module/src/CMakeLists.txt"),
        *(f"{SOURCE}/{file}" for file in ("CMakeLists.txt", "Kconfig", "module.yaml", f"{NAME}.c", f"{NAME}.h")),
        *(f"{SOURCE}/{NAME}_{file}" for file in ("hook.c", "hook.h", "mode.cpp", "mode.hpp")),
    }
    for policy in (shaped(), recurrent(), any_vehicle(), of_vehicle("x500")):
        files, reason = px4.files(policy, KERNEL, NAME), px4.checkpoint_refusal(policy)
        assert set(files) == module | ({f"px4/{px4.FILE}"} if reason is None else set())
        texts = [str(text) for path, text in files.items() if path != f"px4/{px4.FILE}"]
        assert not any("@" in text for text in texts)
        for text in (files["px4/README.md"], px4.section(policy)):
            assert (reason or "without a compiler") in str(text)
            assert "module/`: to be built with PX4" in str(text)
    assert px4.checkpoint_refusal(shaped()) is None
    assert px4.checkpoint_refusal(of_vehicle("x500"))


def test_names_are_as_long_as_px4_takes_and_differ() -> None:
    found = set[str]()
    for name in ("qrl_a_policy_of_a_very_long_name", "qrl_a_policy_of_a_very_long_name_too"):
        files = px4.files(recurrent(), {f"{name}.c": "", f"{name}.h": ""}, name)
        source = f"px4/module/src/modules/{name}"
        parameter = re.search(r"^        (\w+):$", str(files[f"{source}/module.yaml"]), re.MULTILINE)
        mode = re.search(r'strncpy\(request.name, "(\w+)"', str(files[f"{source}/{name}_mode.cpp"]))
        assert parameter
        assert mode
        assert (len(parameter[1]), len(mode[1])) == (16, 24)
        found |= {parameter[1], mode[1]}
    assert len(found) == 4
    assert f"px4::params::{parameter[1]}>" in str(files[f"{source}/{name}_mode.hpp"])


def test_each_name_has_a_class_of_its_own() -> None:
    names, found = ("hover2", "hover_2", "Hover2", "_2d"), set[str]()
    for name in names:
        files = px4.files(recurrent(), {f"{name}.c": "", f"{name}.h": ""}, name)
        header = str(files[f"px4/module/src/modules/{name}/{name}_mode.hpp"])
        found |= set(re.findall(r"^class ([A-Za-z_]\w*) final", header, re.MULTILINE))
    assert len(found) == len(names)


def test_it_compiles_for_a_flight_controller(tmp_path: Path) -> None:
    """With PX4's warnings; the stub's headers are not PX4's."""
    need([] if shutil.which("arm-none-eabi-gcc") else ["arm-none-eabi-gcc"])
    core = ["-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-O2", "-c", "-o", "/dev/null"]
    for policy, folder in ((recurrent(), tmp_path / "a"), (of_vehicle("x500"), tmp_path / "b")):
        source = emitted(policy, folder) / "module" / "src" / "modules" / NAME
        options = {f"{NAME}.c": ["-Wno-float-equal"], f"{NAME}_hook.c": []}
        assert "PROPERTIES COMPILE_OPTIONS -Wno-float-equal" in (source / "CMakeLists.txt").read_text()
        for file, option in options.items():
            subprocess.run(["arm-none-eabi-gcc", *core, *modules.C, *option, str(source / file)], check=True)


def test_it_keeps_its_rules(tmp_path: Path) -> None:
    """Registration, arming check, period, take-over, time-outs, set-points: `px4_module_rules`."""
    module = Module(emitted(steady(), tmp_path), NAME, tmp_path / "b")
    assert list(faults(module)) == []


def test_a_self_test_that_fails_registers_no_mode(tmp_path: Path) -> None:
    folder = emitted(steady(), tmp_path)
    module = Module(folder, NAME, tmp_path / "b", Mutant(f"{NAME}_selftest() == 0", f"{NAME}_selftest() == 1"))
    with pytest.raises(ValueError, match="the self-test failed"):
        module.boot()
    assert not module.c.asked()


# `experiments.firmware.px4_module` has them, too; each is to be compiled.
LEFT_OUT = {
    *("north and east swapped", "velocity down the other way", "quaternion conjugated", "rates left out"),
    *("heading the other way", "motors front and back swapped", "commands halved", "ages ignored"),
    *("take-over at boot alone", "arming check always granted", "set-point does not age", "orders at each sample"),
    *("holds the heading north", "a set-point without a heading", "a registration refused", "not unregistered"),
}


def test_it_flies_as_the_kernel_does_and_mistakes_do_not(tmp_path: Path) -> None:
    """In the plant at 400 Hz along a circle, with a heading: apart from the bare kernel by less than 1 mm; each mistake
    falls, strays by more than 1 cm, or breaks a rule.
    """
    policy, n, seconds = steady(), 2, 0.6
    folder, kernel = emitted(policy, tmp_path), quantize(policy)
    wrong = {what: mutants for what, mutants in mistakes(NAME).items() if what not in LEFT_OUT}
    right = Module(folder, NAME, tmp_path / "right")
    mutants = [Module(folder, NAME, tmp_path / f"mistake{i}", *each) for i, each in enumerate(wrong.values())]
    vehicles = [module.boot().register() for module in [right] * n + mutants]
    start = loop.starts(n, seed=5, distance_m=0.3, tilt_rad=0.4)
    every = np.concatenate([start, np.tile(start[:1], (len(wrong), 1))])
    flights = loop.flown(world(), every, seconds, modules.by_module(world(), vehicles, EVERY), hooks.circling)[..., :3]
    bare = loop.flown(world(), start, seconds, modules.by_kernel(world(), policy, kernel, n), hooks.circling)[..., :3]
    assert np.abs(flights[:, :n] - bare).max() < 1e-3
    astray = np.abs(flights[:, n:] - bare[:, :1]).max(axis=(0, 2)) > 0.01
    rest = [(what, module) for what, module, far in zip(wrong, mutants, astray, strict=True) if not far]
    assert [what for what, module in rest if next(faults(module), None) is None] == []


@pytest.mark.parametrize("make", [recurrent, any_vehicle], ids=["recurrent", "any"])
def test_it_looks_ahead_and_remembers(make: Callable[[], Policy], tmp_path: Path) -> None:
    """Orders of a recurrent policy with a preview are those of the bare kernel, in another order of motors, too; not
    without the set-point's acceleration or jerk.
    """
    policy = make()
    folder, kernel = emitted(policy, tmp_path), quantize(policy)

    def thrusts(ordered: loop.Ordered) -> np.ndarray:
        state = loop.starts(8, seed=3, distance_m=0.2, tilt_rad=0.3)
        return np.array([ordered(4 * i, row[None], hooks.circling(0.01 * i)) for i, row in enumerate(state)])

    def module(out: str, *mutants: Mutant) -> np.ndarray:
        vehicle = Module(folder, NAME, tmp_path / out, *mutants).boot().register()
        return thrusts(modules.by_module(world(), [vehicle], EVERY))

    expected = thrusts(modules.by_kernel(world(), policy, kernel, 1))
    np.testing.assert_allclose(module("right"), expected, atol=1e-3 * world().max_N[0])
    for i, part in enumerate(("acceleration", "jerk")):
        found = module(f"wrong{i}", Mutant(f"or_zero(asked.{part}[i])", "0.0f"))
        assert np.abs(found - expected).max() > 2e-3 * world().max_N[0]

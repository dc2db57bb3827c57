"""The hook for Betaflight: for whom there is one; it flies as the bare kernel does, and mistakes in it show."""

import ctypes
import math
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_crazyflie import any_vehicle, changed, flying, of_vehicle, recurrent, steady

import policies
from cross_targets import need
from experiments.firmware import betaflight_loop as hooks
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.betaflight_loop import (
    ATTITUDE_OLD,
    FLIES,
    FLIP,
    NOT_FINITE,
    OFF,
    POSITION_OLD,
    SELFTEST,
    SETPOINT_OLD,
    Estimate,
    Hook,
    Indiflight,
    SetPoint,
    ned,
    set_point,
)
from experiments.firmware.crazyflie_loop import Mutant, World
from experiments.firmware.emitted import emitted as written
from qrl.export import kernel as integers
from qrl.export import targets
from qrl.export.firmware import betaflight
from qrl.export.firmware.vehicle import c_float
from qrl.export.policy import Policy
from qrl.export.quantize import quantize
from qrl_envs import task as tasks
from qrl_envs.task import QuadrotorTask

NAME = "fly"
HEADERS = Path(__file__).parents[1] / "helpers" / "indiflight_headers"


@pytest.fixture(scope="module", autouse=True)
def _compiler() -> None:
    need([] if shutil.which("gcc") else ["gcc"])


def emitted(policy: Policy, folder: Path) -> Path:
    return written(betaflight, policy, quantize(policy), folder, NAME)


@cache
def world() -> World:
    task = tasks.load("hover", "cf21_brushless")
    assert isinstance(task, QuadrotorTask)
    return World(task.vehicle)


UNFIT = {
    "pendulum": (lambda: policies.policy(policies.PENDULUM), "observation is not"),
    "six motors": (lambda: replace(of_vehicle("crazyflie"), actions=flying("hover", "hexa")), "the policy has 6"),
    "a corner": (lambda: changed(recurrent(), 1, position_m=(0.03, -0.03)), r"rear right \(1\), and the vehicle has 0"),
    "spins": (lambda: changed(recurrent(), 1, spin=-1), "do not turn as a quad X's do"),
    "unit": (lambda: changed(recurrent(), 2, unit="1", quantity="duty"), "neither thrusts"),
    "tilted": (lambda: changed(recurrent(), 2, axis=(0.0, 0.1, 0.995)), r"the vehicle's are tilted \(f3\)"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_what_cannot_fly_is_refused_with_the_reason(case: str) -> None:
    make, reason = UNFIT[case]
    said = betaflight.refusal(make())
    assert said
    assert re.search(reason, said), said
    assert betaflight.files(make(), {}, NAME) == {}


def test_spins_of_either_sense_are_told() -> None:
    """The x500's front propellers turn inwards; a vehicle with all spins reversed turns them outwards."""
    inwards = of_vehicle("x500")
    outwards = replace(inwards, actions=tuple(replace(a, spin=-(a.spin or 0)) for a in inwards.actions))
    kernel = {f"{NAME}.c": "", f"{NAME}.h": ""}
    for policy, flag in ((inwards, "OFF"), (outwards, "ON")):
        files = betaflight.files(policy, kernel, NAME)
        assert f"yaw_motors_reversed = {flag}" in files["betaflight/README.md"]
        assert not any("@" in text for text in files.values())


def test_axes_are_turned_as_rotations_are() -> None:
    """The quaternion of `ned`, against scipy's of the matrix between the turned axes."""
    state = loop.starts(1, seed=2)[0]
    body = Rotation.from_quat(state[[7, 8, 9, 6]]).as_matrix()
    found = np.array(ned(state, 0).attitude)[[1, 2, 3, 0]]
    turned = np.diag(FLIP) @ body @ np.diag(FLIP)
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turned, atol=1e-6)


def test_roll_pitch_and_yaw_are_those_of_aerospace(tmp_path: Path) -> None:
    """scipy's intrinsic rotations about z, y', x''."""
    hook = Hook(emitted(steady(), tmp_path), NAME, tmp_path / "b")
    for roll, pitch, yaw in ((0.3, -0.7, 2.0), (-2.5, 1.2, -0.4)):
        x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
        found = hook.quaternion(roll, pitch, yaw)
        np.testing.assert_allclose(found * np.sign(found[0]), np.array([w, x, y, z]) * np.sign(w), atol=1e-6)


@pytest.mark.parametrize(
    "make", [recurrent, any_vehicle, lambda: of_vehicle("paper")], ids=["recurrent", "any", "paper"]
)
def test_it_compiles_for_a_flight_controller(make: object, tmp_path: Path) -> None:
    need([] if shutil.which("arm-none-eabi-gcc") else ["arm-none-eabi-gcc"])
    folder = emitted(make(), tmp_path)  # type: ignore[operator]
    core = ["-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-sp-d16", "-Os"]
    for name in (NAME, f"{NAME}_hook"):
        command = ["arm-none-eabi-gcc", *core, *hooks.STRICT, f"-I{folder}", "-c", str(folder / f"{name}.c")]
        subprocess.run([*command, "-o", str(tmp_path / f"{name}.o")], check=True)


def test_a_hook_of_zeros_is_off(tmp_path: Path) -> None:
    """A static one that no boot has initialised."""
    hook, still = Hook(emitted(steady(), tmp_path), NAME, tmp_path / "b"), np.eye(13)[6]
    vehicle = hook.boot()
    ctypes.memset(hook.hooks[vehicle], 0, hook.c.size())
    assert hook.run(vehicle, ned(still, 0), set_point(loop.REST, 0), 0)[0] == OFF
    hook.start(vehicle, 0)
    assert hook.run(vehicle, ned(still, 0), set_point(loop.REST, 0), 0)[0] == SELFTEST


# Linked without start-up files: those of -ffast-math would make this process flush denormals to zero.
@pytest.mark.parametrize("flags", [(), (*targets.FIRMWARE, "-nostartfiles")], ids=["strict", "firmware"])
def test_time_outs_faults_and_hand_over(flags: tuple[str, ...], tmp_path: Path) -> None:
    hook, still = Hook(emitted(steady(), tmp_path), NAME, tmp_path / "b", flags=flags), np.eye(13)[6]
    vehicle, now = hook.boot(), 2**32 - 2000

    def run(now_us: int, estimate: Estimate | None = None, to: SetPoint | None = None) -> int:
        now_us %= 2**32
        return hook.run(vehicle, estimate or ned(still, now_us), to or set_point(loop.REST, now_us), now_us)[0]

    assert run(now) == OFF
    hook.start(vehicle, now)
    first = hook.run(vehicle, ned(still, now), set_point(loop.REST, now), now)[1]
    moved = still + 0.2 * np.eye(13)[0]
    for late_ms, holds in ((1, True), (9, True), (10, False)):
        then = (now + 1000 * late_ms) % 2**32
        who, motor = hook.run(vehicle, ned(moved, then), set_point(loop.REST, then), then)
        assert who == FLIES
        assert np.array_equal(motor, first) == holds
    ahead = ned(still, 5000)  # stamped a little after `now`
    assert run(4990, ahead) == FLIES
    for fault, old_us, field in (
        (POSITION_OLD, 250_000, "position_us"),
        (ATTITUDE_OLD, 20_000, "attitude_us"),
        (SETPOINT_OLD, 1_000_000, "received_us"),
    ):
        ages = {old_us: FLIES, old_us + 1: fault, 2**31 + 10**6: fault, -10_000: FLIES, -10_001: fault}
        for age, expected in ages.items():
            hook.start(vehicle, 9_000_000)
            estimate, to = ned(still, 9_000_000), set_point(loop.REST, 9_000_000)
            setattr(estimate if hasattr(estimate, field) else to, field, (9_000_000 - age) % 2**32)
            assert run(9_000_000, estimate, to) == expected
        assert run(9_010_000) == fault  # until the next start
    places = [(0, field) for field in ("position", "velocity", "attitude", "w")]
    places += [(1, field) for field in ("position", "velocity", "acceleration", "jerk", "yaw_rad")]
    for which, field in places:
        for number in (math.nan, math.inf):
            hook.start(vehicle, 0)
            assert run(0, ned(still, 0)) == FLIES
            given = ned(still, 10_000), set_point(loop.REST, 10_000)
            if field == "yaw_rad":
                given[1].yaw_rad = number
            else:
                getattr(given[which], field)[1] = number
            assert run(10_000, *given) == NOT_FINITE
    hook.start(vehicle, 0)
    none = ned(still, 0)
    none.attitude[0] = 0.5
    assert run(0, none) == NOT_FINITE


@pytest.mark.parametrize("c", [-0.1, 0.0, 0.5, 0.99999, 1.0])
def test_a_thrust_is_that_of_its_command(c: float, tmp_path: Path) -> None:
    policy = steady()
    mutant = Mutant(f"c = {c_float(policy.actions[0].thrust_curve)}", f"c = {c_float(c)}")
    hook, thrusts = Hook(emitted(policy, tmp_path), NAME, tmp_path / "b", mutant), np.linspace(0.0, 1.0, 101)
    w = np.array([hook.command(thrust) for thrust in thrusts])
    np.testing.assert_allclose(w * (c + (1.0 - c) * w), thrusts, atol=2e-6)


def test_it_flies_as_the_kernel_does_and_mistakes_do_not(tmp_path: Path) -> None:
    """In the plant at 1 kHz along a circle, with a heading: apart from the bare kernel by less than 1 mm, alone and as
    Indiflight's neural controller, and each mistake falls or strays by more than 1 cm.
    """
    policy, right, seconds = steady(), 2, 1.0
    folder, flags = emitted(policy, tmp_path), [*hooks.STRICT, f"-I{HEADERS}"]
    whole = Hook(folder, NAME, tmp_path / "whole")
    vehicles: list[tuple[Hook | Indiflight, int]] = [(whole, whole.boot()) for _ in range(right)]
    vehicles += [(Indiflight(folder, NAME, tmp_path / f"right{i}", flags), 0) for i in range(right)]
    of_hook, of_controller = hooks.mistakes(NAME), hooks.indiflight_mistakes()
    for i, mutants in enumerate(of_hook.values()):
        wrong = Hook(folder, NAME, tmp_path / f"mistake{i}", *mutants)
        vehicles.append((wrong, wrong.boot()))
    for i, mutants in enumerate(of_controller.values()):
        vehicles.append((Indiflight(folder, NAME, tmp_path / f"wrong{i}", [f"-I{HEADERS}"], *mutants), 0))
    names = [*of_hook, *of_controller]
    start = loop.starts(right, seed=5, distance_m=0.3, tilt_rad=0.4)
    every = np.concatenate([start, start, np.tile(start[:1], (len(names), 1))])
    flights = loop.flown(world(), every, seconds, hooks.by_hook(world(), vehicles), hooks.circling)[..., :3]
    kernel = loop.by_kernel(world(), policy, quantize(policy), right)
    bare = loop.flown(world(), start, seconds, kernel, hooks.circling)[..., :3]
    alone, controller, mistaken = np.split(flights, [right, 2 * right], axis=1)
    assert np.abs(alone - bare).max() < 1e-3
    assert np.abs(controller - bare).max() < 1e-3
    astray = np.abs(mistaken - bare[:, :1]).max(axis=(0, 2))
    assert [name for name, far in zip(names, astray, strict=True) if not far > 0.01] == []


def test_it_looks_ahead_and_orders_speeds(tmp_path: Path) -> None:
    """A recurrent policy of any vehicle with a preview: its first command, against the float policy's observation."""
    policy = any_vehicle()
    folder = emitted(policy, tmp_path)
    hook = Hook(folder, NAME, tmp_path / "b")
    vehicle = hook.boot()
    state, now = loop.starts(1, seed=3)[0], hooks.circling(0.7)
    hook.start(vehicle, 0)
    who, motor = hook.run(vehicle, ned(state, 0), set_point(now, 0), 0)
    assert who == FLIES
    turn = Rotation.from_euler("z", -now.yaw_deg, degrees=True).as_matrix()
    body = turn @ Rotation.from_quat(state[[7, 8, 9, 6]]).as_matrix()
    ahead = [port.ahead_s or 0.0 for port in policy.observations[18::3]]
    previews = [turn @ (now.acceleration_m_s2 * t + now.jerk_m_s3 * t**2 / 2) for t in ahead]
    relative = turn @ (state[:3] - now.position_m), turn @ (state[3:6] - now.velocity_m_s)
    obs = np.concatenate([body.ravel(), *relative, state[10:13], *previews])[None].astype(np.float32)
    kernel = quantize(policy)
    _, _, action = integers.step(kernel, integers.initial_state(kernel, 1), obs)
    order, _ = betaflight.motors(policy)  # type: ignore[misc]
    np.testing.assert_allclose(motor, action[0, order], atol=2e-3)

"""The emitted app for a Crazyflie, compiled against crazyflie-firmware and flown in the plant at 1 kHz.

    git clone --branch 2026.08 https://github.com/bitcraze/crazyflie-firmware     # commit 54f31e243a0b
    git -C crazyflie-firmware submodule update --init vendor/FreeRTOS
    .venv/bin/python -m experiments.firmware.crazyflie RUN --firmware crazyflie-firmware

RUN is a folder of a run, or `any`. The app is emitted anew; headers, stock PID and mixer are the firmware's. It must
fly as the bare kernel does, hand over to the PID, and each mistake in its source must show.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.arguments import Parser, run_main
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware import crazyflie_mistakes as faulty
from experiments.firmware import crazyflie_protocol as protocol
from experiments.firmware.crazyflie_loop import App, Firmware, Floats, Reference, World
from experiments.firmware.emitted import emitted
from experiments.output import table
from qrl.cli.main import configure_jax
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.firmware import crazyflie
from qrl.export.firmware.crazyflie import PLATFORMS, Platform
from qrl.export.firmware.vehicle import orders_speeds
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl.export.quantize import quantize
from qrl.runs import shipped
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask

NAME = "policy"
HEADERS = "src/config src/platform/interface src/drivers/interface src/hal/interface src/modules/interface"
HEADERS += " src/modules/interface/controller src/modules/interface/lighthouse src/utils/interface"
HEADERS += " src/utils/interface/lighthouse vendor/FreeRTOS/include vendor/FreeRTOS/portable/GCC/ARM_CM4F"
SOURCES = "controller/controller_pid controller/attitude_pid_controller controller/position_controller_pid"
STOCK = [f"src/modules/src/{name}.c" for name in (*SOURCES.split(), "power_distribution_quadrotor")]
STOCK += [f"src/utils/src/{name}.c" for name in ("pid", "filter", "num")]
HAND_OVER = "stock given a state that is not finite"  # of `faulty.of_control`: shown by a flight
CONFIG = {  # what Kconfig makes of the app's configuration, of what these sources ask for
    "cf2_defconfig": ("CONFIG_PLATFORM_CF2 1",),
    "cf21bl_defconfig": (
        *("CONFIG_PLATFORM_CF21BL 1", "CONFIG_MOTORS_REQUIRE_ARMING 1"),
        "CONFIG_THRUST_BAT_COMPENSATION_MAX_THRUST 200",
    ),
}
WHATS = ("disarmed", "NaN for 5 ms", "set-point NaN for 5 ms", "state frozen")
FELL_M, SAME_MM, TAIL_MS = 3.0, 1.0, 1000


def firmware(tree: Path, build: Platform, out: Path) -> Firmware:
    """Headers and sources of `tree` for a platform; BadInput if they are not there."""
    missing = [path for path in (*HEADERS.split(), *STOCK) if not (tree / path).exists()]
    if missing:
        raise BadInput(f"--firmware {tree}: expected crazyflie-firmware with vendor/FreeRTOS, found no {missing[0]}")
    lines = [*CONFIG[build.defconfig], "CONFIG_ENABLE_THRUST_BAT_COMPENSATED 1", "CONFIG_CONTROLLER_OOT 1"]
    lines += [build.config.replace("=y", " 1")] if build.config else []
    out.mkdir(parents=True, exist_ok=True)
    (out / "autoconf.h").write_text("".join(f"#define {line}\n" for line in lines), encoding="utf-8")
    return Firmware(
        (out, *(tree / path for path in HEADERS.split())), ("-DREAL_STOCK",), tuple(tree / path for path in STOCK)
    )


def circling(t: float) -> Reference:
    """A circle of 0.5 m at 0.6 m/s with a heading, as a commander gives it."""
    w, turn = 1.2, np.array([np.cos(1.2 * t), np.sin(1.2 * t), 0.0])
    across = np.array([-turn[1], turn[0], 0.0])
    return Reference(0.5 * turn, 0.5 * w * across, -0.5 * w**2 * turn, -0.5 * w**3 * across, 30.0)


def fell(states: Floats) -> Floats:
    """Which of the flights [ms, n, 13] did not stay in reach; [n]."""
    return ~(np.linalg.norm(states[..., :3], axis=-1) < FELL_M).all(axis=0)


def tail(states: Floats) -> Floats:
    """Mean position [n, 3] of the last second."""
    return states[-TAIL_MS:, :, :3].mean(axis=0)


def heading_deg(states: Floats) -> Floats:
    """At the end; [n]."""
    w, x, y, z = states[-1, :, 6:10].T
    return np.rad2deg(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))


def beside_the_kernel(world: World, library: Path, policy: Policy, kernel: Kernel, n: int, seconds: float) -> str:
    """Final offsets of both, and how far apart they are from the same start: beside the bare kernel from a start that
    is 1 µm away, since a policy with memory in integers settles at one of many places.
    """
    start, moved = loop.starts(n, seed=100), loop.starts(n, seed=100)
    moved[:, 0] += 1e-6
    vehicles = loop.apps(library, n)
    bare, other = np.split(
        loop.flown(world, np.concatenate([start, moved]), seconds, loop.by_kernel(world, policy, kernel, 2 * n)),
        2,
        axis=1,
    )
    app = loop.flown(world, start, seconds, loop.by_app(world, vehicles))
    offset, offset_bare = (1e3 * np.linalg.norm(tail(states), axis=1) for states in (app, bare))
    apart, own = (1e3 * np.linalg.norm(tail(states) - tail(bare), axis=1).max() for states in (app, other))
    change, clipped = np.abs(offset - offset_bare).max(), sum(vehicle.counts()[1] for vehicle in vehicles)
    verdict = "ok" if change < SAME_MM and not fell(app).any() else "FAILED"
    return (
        f"{n} starts, {seconds:g} s: final offset at most {offset.max():.2f} mm, of the bare kernel"
        f" {offset_bare.max():.2f} mm; from one start they differ by at most {change:.2f} mm (limit {SAME_MM:g}):"
        f" {verdict}; {apart:.2f} mm apart, the bare kernel from itself {own:.2f} mm; {fell(app).sum()} fell, bare"
        f" {fell(bare).sum()}; {clipped} inputs clipped"
    )


def following(world: World, library: Path, policy: Policy, kernel: Kernel, n: int, seconds: float) -> str:
    """Of a policy that looks ahead: what set-points with acceleration and jerk cost beside the true preview."""
    ahead_s = [port.ahead_s or 0.0 for port in policy.observations[18::3]]

    def preview(t: float) -> Floats:
        now = circling(t).velocity_m_s
        return np.concatenate([circling(t + s).velocity_m_s - now for s in ahead_s])

    start = loop.starts(n, seed=101, distance_m=0.3)
    there = np.array([circling(i * loop.STEP_S).position_m for i in range(round(seconds * 1e3) + 1)])[:, None]
    found = []
    for thrust in (loop.by_app(world, loop.apps(library, n)), loop.by_kernel(world, policy, kernel, n, preview)):
        states = loop.flown(world, start, seconds, thrust, circling)
        error = np.linalg.norm(states[..., :3] - there, axis=-1)[-2 * TAIL_MS :]
        found.append(f"{1e3 * np.sqrt((error**2).mean()):.1f} mm")
    return f"circle of 0.5 m at 0.6 m/s: RMSE {found[0]} from set-points, {found[1]} of the bare kernel, true preview"


def hand_over(world: World, library: Path, n: int, whats: Sequence[str] = WHATS) -> Iterator[str]:
    """The stock PID of the firmware takes over after 2 s of the policy, and holds the place."""
    for what in whats:
        vehicles = loop.apps(library, n)
        ordered = loop.by_app(world, vehicles)
        frozen: dict[str, Floats] = {}

        def thrust_N(
            step: int, state: Floats, now: Reference, what=what, vehicles=vehicles, ordered=ordered, frozen=frozen
        ):
            if what == "disarmed" and step == 2000:
                for app in vehicles:
                    app.arm(False)
            elif what == "NaN for 5 ms" and 2000 <= step < 2005:
                state = np.where(np.arange(13) < 6, np.nan, state)
            elif what == "set-point NaN for 5 ms" and 2000 <= step < 2005:
                now = now._replace(position_m=np.full(3, np.nan))
            elif what == "state frozen" and 2000 <= step < 2060:
                state = frozen.setdefault("state", state)
            return ordered(step, state, now)

        states = loop.flown(world, loop.starts(n, seed=102, distance_m=0.3, tilt_rad=0.5), 6.0, thrust_N)
        furthest = np.linalg.norm(states[2000:, :, :3], axis=-1).max()
        last = np.linalg.norm(tail(states), axis=1).max()
        verdict = "flies on" if furthest < FELL_M else "FALLS"
        yield f"{what} at 2 s: the firmware's PID {verdict}: at most {furthest:.2f} m away, at last {last:.2f} m"


def mistakes(
    world: World, library: Path, app: Path, made: Firmware, policy: Policy, kernel: Kernel, n: int, seconds: float
) -> Iterator[tuple[str, str, str]]:
    """For each mistake: its name, what the comparison with the integer reference says, and what n flights do."""
    of_orders = faulty.of_orders(NAME.upper(), policy)
    both = of_orders | faulty.of_control(NAME.upper())
    built = {
        name: loop.build(app, made, library.with_name(f"mistake{i}.so"), *mutants)
        for i, (name, mutants) in enumerate(both.items())
    }
    # All flights at once, those of the right one first.
    start = loop.starts(n, seed=103, distance_m=0.5, tilt_rad=0.6)
    vehicles = [app for one in (library, *(built[name] for name in of_orders)) for app in loop.apps(one, n)]
    every = np.tile(start, (len(vehicles) // n, 1))
    flights = loop.flown(world, every, seconds, loop.by_app(world, vehicles), circling)
    right, *wrong = np.split(flights, len(vehicles) // n, axis=1)
    said = {HAND_OVER: next(hand_over(world, built[HAND_OVER], n, WHATS[1:2]))}
    for name, states in zip(of_orders, wrong, strict=True):
        apart = np.linalg.norm(tail(states) - tail(right), axis=1).max()
        turned = np.abs((heading_deg(states) - heading_deg(right) + 180.0) % 360.0 - 180.0).max()
        said[name] = (
            f"{fell(states).sum()} of {n} fall" if fell(states).any() else f"{1e3 * apart:.1f} mm, {turned:.1f}° apart"
        )
    for name, path in built.items():
        yield name, next(protocol.faults(boots(path), policy, kernel), "–"), said.get(name, "–")


def boots(library: Path) -> Callable[[], App]:
    """A function that boots one more vehicle's firmware."""
    count = iter(range(1000))

    def boot() -> App:
        vehicle = loop.apps(library, 1, first=1000 + next(count))[0]
        vehicle.arm(False)
        return vehicle

    return boot


def main(argv: list[str] | None = None) -> int:
    parser = Parser("crazyflie", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder, or a policy that ships")
    parser.add_argument("--firmware", type=Path, required=True, help="folder of crazyflie-firmware")
    parser.add_argument("--vehicle", help="that flies a policy of any vehicle (default: cf21_brushless)")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--no-mistakes", action="store_true")
    args = parser.parse_args(argv)
    configure_jax()
    try:
        return fly(args)
    except BadInput as error:
        parser.error(str(error))


def fly(args: argparse.Namespace) -> int:
    run = TrainedRun.load(shipped.run_folder(args.run))
    policy = run.policy()
    if reason := crazyflie.refusal(policy):
        raise BadInput(f"{args.run}: no app for a Crazyflie: {reason}")
    kernel = quantize(policy)
    task = tasks.load("hover", args.vehicle or "cf21_brushless") if orders_speeds(policy) else run.task
    assert isinstance(task, QuadrotorTask)
    vehicle = task.vehicle
    build = crazyflie.platform(policy) or min(PLATFORMS, key=lambda p: abs(p.thrust_max_N - vehicle.motors[0].max_N))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        made = firmware(args.firmware, build, folder / "generated")
        app, world = emitted(crazyflie, policy, kernel, folder, NAME), World(vehicle)
        library = loop.build(app, made, folder / "build" / "app.so")
        print(f"compiled for {build.title}: {' '.join(loop.STRICT)}, without warnings")
        wrong = list(protocol.faults(boots(library), policy, kernel))
        print("\n".join(wrong) or "who flies, and each force, as the integer reference: ok", flush=True)
        print(beside_the_kernel(world, library, policy, kernel, args.starts, args.seconds), flush=True)
        if len(policy.observations) > 18:
            print(following(world, library, policy, kernel, 10, 8.0), flush=True)
        print("\n".join(hand_over(world, library, 10)), flush=True)
        if not args.no_mistakes:
            rows = mistakes(world, library, app, made, policy, kernel, 4, 4.0)
            print(table(("mistake", "beside the reference", "flights"), rows))
    return 0


if __name__ == "__main__":
    run_main("crazyflie", main)

"""The emitted hook for Betaflight and its relatives, compiled against Indiflight and flown in the plant at 1 kHz.

    git clone https://github.com/tudelft/indiflight     # commit 15b7626
    .venv/bin/python -m experiments.firmware.betaflight RUN --firmware indiflight

RUN is a folder of a run, or `any`. The hook is emitted anew; clock, set-point and the neural controller's interface are
the firmware's headers'. It must fly as the bare kernel does, and each mistake in its source must show.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from experiments.arguments import Parser, run_main
from experiments.firmware import betaflight_loop as hooks
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.betaflight_loop import Hook, Indiflight
from experiments.firmware.crazyflie_loop import World
from experiments.firmware.emitted import emitted
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.firmware import betaflight
from qrl.export.quantize import quantize
from qrl.runs import shipped
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask

NAME = "policy"
TARGET = "src/main/target/SITL"
DEFINES = ("SIMULATOR_BUILD", "SITL", "USE_NN_CONTROL", "USE_EKF", "USE_GPS_PI", "USE_POS_CTL", "USE_INDI")
SAME_MM, ASTRAY_M, RIGHT = 1.0, 0.01, 4


def main(argv: list[str] | None = None) -> int:
    parser = Parser("betaflight", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--firmware", type=Path, required=True, metavar="TREE", help="a checkout of Indiflight")
    parser.add_argument("--vehicle", default="cf21_brushless", help="to fly (cf21_brushless)", metavar="NAME")
    parser.add_argument("--seconds", type=float, default=4.0, help="of each flight (4)", metavar="S")
    args = parser.parse_args(argv)
    configure_jax()
    try:
        flags = against(args.firmware)
        policy = TrainedRun.load(shipped.run_folder(args.run)).policy()
        if reason := betaflight.refusal(policy):
            raise BadInput(f"{args.run}: {reason}")
        task = tasks.load("hover", args.vehicle)
    except BadInput as error:
        print(f"betaflight: {error}", file=sys.stderr)
        return WRONG_INPUT
    assert isinstance(task, QuadrotorTask)
    world, kernel = World(task.vehicle), quantize(policy)
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch)
        folder = emitted(betaflight, policy, kernel, out, NAME)
        whole = Hook(folder, NAME, out / "hook")
        vehicles: list[tuple[Hook | Indiflight, int]] = [(whole, whole.boot()) for _ in range(RIGHT)]
        vehicles += [(Indiflight(folder, NAME, out / f"right{i}", flags), 0) for i in range(RIGHT)]
        wrong = {**hooks.mistakes(NAME), **hooks.indiflight_mistakes()}
        if policy.actions[0].quantity:
            del wrong["thrust as speed"]
        if policy.body_frame:  # mirrored vectors and a mirrored matrix are the same to it
            del wrong["east for west"]
        for i, (what, mutants) in enumerate(wrong.items()):
            if what in hooks.indiflight_mistakes():
                vehicles.append((Indiflight(folder, NAME, out / f"mistake{i}", _lax(flags), *mutants), 0))
            else:
                hook = Hook(folder, NAME, out / f"mistake{i}", *mutants)
                vehicles.append((hook, hook.boot()))
        start = loop.starts(RIGHT, seed=100, distance_m=0.3, tilt_rad=0.4)
        every = np.concatenate([start, start, np.tile(start[:1], (len(wrong), 1))])
        flown = loop.flown(world, every, args.seconds, hooks.by_hook(world, vehicles), hooks.circling)
        ahead = lambda t: np.concatenate([_ahead(t, port.ahead_s or 0.0) for port in policy.observations[18::3]])  # noqa: E731
        preview = ahead if len(policy.observations) > 18 else None
        bare = loop.flown(
            world, start, args.seconds, loop.by_kernel(world, policy, kernel, RIGHT, preview), hooks.circling
        )
    return told(flown[..., :3], bare[..., :3], list(wrong), policy.observations[18:] == ())


def against(tree: Path) -> list[str]:
    """Flags to compile against the headers of Indiflight's simulator target; BadInput if they are not there."""
    if not (tree / TARGET / "target.h").exists():
        raise BadInput(f"--firmware {tree}: expected a checkout of Indiflight, found no {TARGET}/target.h")
    folders = ("src/main", "src/main/target", TARGET, "lib/main/MAVLink", "lib/main/dyad")
    return [
        *("-std=gnu17", *hooks.WARNINGS, '-D__TARGET__="SITL"', '-D__REVISION__="none"'),
        *(f"-D{name}" for name in DEFINES),
        *(f"-isystem{tree / folder}" for folder in folders),
    ]


def _lax(flags: list[str]) -> list[str]:
    return [flag for flag in flags if flag not in hooks.WARNINGS]


def _ahead(t: float, ahead_s: float) -> np.ndarray:
    """The set-point's velocity so much later less that now, as the hook continues it: by acceleration and jerk."""
    now = hooks.circling(t)
    return now.acceleration_m_s2 * ahead_s + now.jerk_m_s3 * ahead_s**2 / 2.0


def told(flown: np.ndarray, bare: np.ndarray, wrong: list[str], same_inputs: bool) -> int:
    """Print what was found; DONE or FAILED. Positions [ms, n, 3]; `same_inputs`: Indiflight lacks no input."""
    hook, controller, mistaken = np.split(flown, [RIGHT, 2 * RIGHT], axis=1)
    apart_mm = [1e3 * np.abs(part - bare).max() for part in (hook, controller)]
    astray = np.abs(mistaken - bare[:, :1]).max(axis=(0, 2))
    missed = [what for what, far in zip(wrong, astray, strict=True) if not far > ASTRAY_M]
    alone, inside = apart_mm
    print(f"{RIGHT} flights: the hook at most {alone:.2f} mm from the bare kernel, in Indiflight {inside:.2f} mm")
    if not same_inputs:
        print("  (Indiflight's set-point has no acceleration, of which the preview is made: there it sees none)")
    print(f"{len(wrong) - len(missed)} of {len(wrong)} mistakes stray by more than {1e3 * ASTRAY_M:g} mm, or fall")
    for what in missed:
        print(f"  not: {what}")
    right = alone < SAME_MM and (inside < SAME_MM or not same_inputs)
    return DONE if right and not missed else FAILED


if __name__ == "__main__":
    run_main("betaflight", main)

"""The emitted module for PX4, compiled for a PC and flown in the plant at 400 Hz: topics in, `actuator_motors` out.

    .venv/bin/python -m experiments.firmware.px4_module RUN [--px4 PX4-Autopilot]

RUN is a folder of a run, or `any`. uORB, work queue and parameters are a stub (px4_stub.hpp), and so are the topics'
fields, unless `--px4` gives PX4's own `msg/`. The module is emitted anew. It must fly as the bare kernel does, keep its
rules, and each mistake in its source must show.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from experiments.arguments import Parser, run_main
from experiments.firmware import betaflight_loop as hooks
from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.betaflight_loop import circling
from experiments.firmware.crazyflie_loop import World
from experiments.firmware.emitted import emitted
from experiments.firmware.px4_module_loop import GYRO_HZ, Module, by_kernel, by_module, topics
from experiments.firmware.px4_module_mistakes import mistakes
from experiments.firmware.px4_module_rules import faults
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.firmware import px4
from qrl.export.quantize import quantize
from qrl.runs import shipped
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask

NAME = "policy"
SAME_MM, ASTRAY_M, RIGHT = 1.0, 0.01, 4


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

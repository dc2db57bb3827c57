"""The commands behind the command line: export and tasks; train, evaluate and sweep have modules of their own."""

import argparse
import os
import sys
import time
import traceback

import jax

from qrl import deploy, evaluate_command, loop, request, sweep_command, train_command
from qrl.exits import DONE, FAILED, WRONG_INPUT, complain
from qrl.export.kernel import PossibleOverflow
from qrl.export.report import gates
from qrl.export.targets import ProofFailed
from qrl.seal import Foreign
from qrl.terminal import clock, console
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput


def run(args: argparse.Namespace) -> int:
    """Run the parsed command and map what goes wrong to one line and an exit code."""
    commands = {
        "train": train_command.train,
        "evaluate": evaluate_command.evaluate,
        "export": export,
        "sweep": sweep_command.sweep,
        "tasks": list_tasks,
    }
    code = FAILED
    try:
        return commands[args.command](args)
    except BadInput as error:  # every process hears of it
        complain(str(error))
        return WRONG_INPUT
    except Foreign as error:
        complain(str(error))
        code = WRONG_INPUT
    except (loop.NotFinite, PossibleOverflow, ProofFailed) as error:
        complain(str(error))
    except OSError as error:
        complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except jax.errors.JaxRuntimeError as error:  # out of memory, above all
        complain(str(error))
    except KeyboardInterrupt:
        complain("interrupted")
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ValueError) and "Gloo" in str(error):  # how JAX says it on CPUs
            complain(f"another process of the run is gone: {error}")
        else:
            traceback.print_exc()
    if jax.distributed.is_initialized():  # Python's own end would wait for the others, and they for this process
        sys.stdout.flush()
        os._exit(code)
    return code


def list_tasks(_: argparse.Namespace) -> int:
    for name in tasks.shipped():
        console.print(f"{name:<10} {tasks.load(name).description}")
    console.print(f"\nBrax's own: {', '.join(request.foreign_tasks())}")
    console.print("Your own: a .json file that extends one of the first, such as experiments/vehicles/crazyflie.json")
    return DONE


# -- export --------------------------------------------------------------------------------------------------


def export(args: argparse.Namespace) -> int:
    """Emit, prove and fly a run's integer policy; print gates and costs, leave it all in RUN/export."""
    begun = time.perf_counter()
    done = deploy.export(deploy.Run(args.run), args.starts, args.vectors, console.print)
    proof = done.measured.proof
    for name in proof.held:
        console.print(f"held against the reference, bit for bit, on {proof.vectors:,} observations an entry: {name}")
    for what in proof.missing:
        console.print(f"NOT proved {what}")
    for gate in gates(done.measured):
        mark = "met" if gate.met else "MISSED"
        console.print(f"{gate.name:<40} {gate.measured:>9.3g} {gate.unit:<20} bar {gate.bar:<6g} {mark}")
    if proof.costs:
        console.print(
            f"{'instructions per inference':<27} {'float entry':>12} {'i16 entry':>10} {'flash':>8} {'stack':>7}"
        )
    for cost in proof.costs:
        mean, mean_i16 = cost.step[0], cost.step_i16[0]
        console.print(f"{cost.core:<27} {mean:>12,.0f} {mean_i16:>10,.0f} {cost.flash:>6,} B {max(cost.stack):>5} B")
    console.print(f"done in {clock(time.perf_counter() - begun)}: {done.folder}/qrl_policy.c, .h, report.md")
    return DONE

"""What the command line calls: each command from its own module, and an exit code for whatever goes wrong."""

import argparse
import os
import sys
import traceback
from collections.abc import Callable

import jax

from qrl import request
from qrl.exits import DONE, FAILED, WRONG_INPUT, complain
from qrl.export.kernel import PossibleOverflow
from qrl.export.targets import ProofFailed
from qrl.laps import NotFinite
from qrl.seal import Foreign
from qrl.terminal import console
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput


def run(args: argparse.Namespace) -> int:
    """Run the parsed command and map what goes wrong to one line and an exit code."""
    code = FAILED
    try:
        return _command(args.command)(args)
    except BadInput as error:  # every process hears of it
        complain(str(error))
        return WRONG_INPUT
    except Foreign as error:
        complain(str(error))
        code = WRONG_INPUT
    except (NotFinite, PossibleOverflow, ProofFailed) as error:
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


def _command(name: str) -> Callable[[argparse.Namespace], int]:
    """The command of that name, imported only now: none should wait for what another needs."""
    match name:
        case "train":
            from qrl.train_command import train as command
        case "evaluate":
            from qrl.evaluate_command import evaluate as command
        case "export":
            from qrl.export_command import export as command
        case "view":
            from qrl.view_command import view as command
        case "sweep":
            from qrl.sweep_command import sweep as command
        case _:
            return list_tasks
    return command


def list_tasks(_: argparse.Namespace) -> int:
    for name in tasks.shipped():
        console.print(f"{name:<10} {tasks.load(name).description}")
    console.print(f"\nBrax's own: {', '.join(request.foreign_tasks())}")
    console.print("Your own: a .json file that extends one of the first, such as experiments/vehicles/crazyflie.json")
    return DONE

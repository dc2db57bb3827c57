"""The command line's first second: parse, say what begins, import the rest, map errors to exit codes."""

import argparse
import difflib
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT, complain
from qrl.config import FORMER_NAMES, Config


class _Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message: str) -> NoReturn:
        complain(message)
        sys.exit(WRONG_INPUT)

    def refuse(self, word: str) -> NoReturn:
        """`word` is neither a flag nor an argument of this command."""
        flags = [flag for action in self._actions for flag in action.option_strings]
        close = difflib.get_close_matches(word.split("=")[0], flags, n=1) if word.startswith("-") else []
        self.error(
            f"unknown {'flag' if word.startswith('-') else 'argument'} {word}"
            f" ({f'did you mean {close[0]}?' if close else f'see {self.prog} --help'})"
        )


def whole_number(text: str) -> int:
    value = float(text)
    if not (0 <= value < 2**31 and value.is_integer()):
        raise ValueError
    return int(value)


def count(text: str) -> int:
    value = whole_number(text)
    if value < 1:
        raise ValueError
    return value


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError
    return value


def vectors(text: str) -> int:
    value = whole_number(text)
    if value < 500:  # fewer would leave kinds of them out
        raise ValueError
    return value


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = _Parser(prog="qrl", description="From a vehicle and a task to a policy that flies.", allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train a policy; leaves a run folder", allow_abbrev=False)
    train.add_argument("task", nargs="?", help="a task's name (see qrl tasks) or a .json file", metavar="TASK")
    train.add_argument("--seed", type=whole_number, help="first seed (0)", metavar="N")
    train.add_argument("--seeds", type=count, help="seeds trained side by side in one program (1)", metavar="N")
    train.add_argument("--out", type=Path, help="run folder (runs/TASK)", metavar="FOLDER")
    train.add_argument("--config", type=Path, help="a config.json, whole or in part", metavar="FILE")
    train.add_argument("--resume", action="store_true", help="go on from the run folder's last checkpoint")
    train.add_argument("--preset", help="hyperparameters by name, in place of the task's preset", metavar="NAME")
    learner = train.add_argument_group("learner", "each as in the presets; the default is the task's preset")
    former: dict[str, list[str]] = {}
    for old, new in FORMER_NAMES.items():
        former.setdefault(new, []).append(old)
    for name, field in Config.model_fields.items():
        text = (field.description or "").replace("%", "%%")
        flags = [f"--{flag.replace('_', '-')}" for flag in (name, *former.get(name, ()))]
        learner.add_argument(flags[0], dest=f"learner.{name}", help=text, metavar="X")
        if flags[1:]:
            learner.add_argument(*flags[1:], dest=f"learner.{name}", help=argparse.SUPPRESS)

    evaluate = commands.add_parser("evaluate", help="fly a trained policy from fresh starts", allow_abbrev=False)
    evaluate.add_argument("run", type=Path, help="run folder", metavar="RUN")
    evaluate.add_argument("--starts", type=count, default=1000, help="how many starts (1000)", metavar="N")
    evaluate.add_argument(
        "--off-nominal", action="store_true", help="also under RK4, latency, sensor noise; hover: the paper's trial"
    )
    evaluate.add_argument(
        "--beside", type=Path, nargs="+", default=[], help="other runs of the same task, a column each", metavar="RUN"
    )
    evaluate.add_argument("--checkpoints", type=count, default=1, help="the last so many checkpoints (1)", metavar="K")

    export = commands.add_parser("export", help="emit a trained policy as a C kernel, proved", allow_abbrev=False)
    export.add_argument("run", type=Path, help="run folder", metavar="RUN")
    export.add_argument("--starts", type=count, default=1000, help="how many starts to fly it from (1000)", metavar="N")
    export.add_argument(
        "--vectors",
        type=vectors,
        default=2000,
        help="observations to hold the C against (2000; 500 or more)",
        metavar="N",
    )

    view = commands.add_parser("view", help="flights of a trained policy as a 3D page", allow_abbrev=False)
    view.add_argument("run", type=Path, help="run folder", metavar="RUN")
    view.add_argument(
        "--starts",
        type=whole_number,
        nargs="+",
        help="which of evaluate's 1,000 starts, by index (eight; first those that it found to fail)",
        metavar="N",
    )
    view.add_argument("--out", type=Path, help="the page (RUN/view.html)", metavar="FILE")

    sweep = commands.add_parser(
        "sweep", help="train every point of a grid; the same command goes on", allow_abbrev=False
    )
    sweep.add_argument(
        "grid", type=Path, help="a grid file, such as experiments/grids/pendulum_lr.json", metavar="GRID"
    )
    sweep.add_argument("--out", type=Path, help="folder of the results (runs/GRID)", metavar="FOLDER")
    sweep.add_argument(
        "--memory-gb", type=positive, help="what the members may take (half of the devices' memory)", metavar="GB"
    )
    for command, what in ((train, "that train together"), (sweep, "that share the sweep")):
        hosts = command.add_argument_group(f"processes {what}", "each told these, or by JAX's or SLURM's variables")
        hosts.add_argument("--process-id", type=whole_number, help="which this is, from 0", metavar="I")
        hosts.add_argument("--processes", type=count, help="how many there are", metavar="N")
        hosts.add_argument("--coordinator", help="where process 0 can be reached", metavar="HOST:PORT")

    commands.add_parser("tasks", help="list the tasks that can be trained", allow_abbrev=False)
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        commands.choices[args.command].refuse(unknown[0])
    return args


def _load() -> None:
    """Import JAX (seconds on a cold disk); use the compile cache."""
    # NumPy's products are small here; threads of its own would fight XLA's: an export took five times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    warnings.filterwarnings("ignore", module=r"brax\..*")  # its remarks are not on what the user did
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "qrl" / "xla"
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns DESIGN.md's exit code: 0 done, 1 failed while running, 2 the input was wrong."""
    args = _parse(argv)
    if args.command == "train":
        print(f"qrl train {args.task or args.config or ''}: loading JAX", flush=True)
    elif args.command in ("evaluate", "export", "view"):
        print(f"qrl {args.command} {args.run}: loading JAX", flush=True)
    elif args.command == "sweep":
        print(f"qrl sweep {args.grid}: loading JAX", flush=True)
    try:
        _load()
    except KeyboardInterrupt:
        complain("interrupted")
        return FAILED
    return _run(args)


def _run(args: argparse.Namespace) -> int:
    """Run the parsed command and map what goes wrong to one line and an exit code."""
    import jax

    from qrl.export.kernel import AccumulatorOverflow
    from qrl.export.targets import VerificationFailed
    from qrl.runs.integrity import IncompatibleCheckpoint
    from qrl.training.driver import NotFinite
    from qrl_envs.specfile import BadInput

    code = FAILED
    try:
        return _command(args.command)(args)
    except BadInput as error:  # every process hears of it
        complain(str(error))
        return WRONG_INPUT
    except IncompatibleCheckpoint as error:
        complain(str(error))
        code = WRONG_INPUT
    except (NotFinite, AccumulatorOverflow, VerificationFailed) as error:
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
            from qrl.cli.train import train as command
        case "evaluate":
            from qrl.cli.evaluate import evaluate as command
        case "export":
            from qrl.cli.export import export as command
        case "view":
            from qrl.cli.view import view as command
        case "sweep":
            from qrl.cli.sweep import sweep as command
        case _:
            return _list_tasks
    return command


def _list_tasks(_: argparse.Namespace) -> int:
    from qrl import tasks
    from qrl.cli.terminal import console
    from qrl_envs import task as task_spec

    for name in task_spec.shipped():
        console.print(f"{name:<10} {task_spec.load(name).description}")
    console.print(f"\nBrax's own: {', '.join(tasks.foreign_tasks())}")
    console.print("Your own: a .json file that extends one of the first, such as experiments/vehicles/crazyflie.json")
    return DONE

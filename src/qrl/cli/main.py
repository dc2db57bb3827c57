"""The command line: parse, say what begins, import the rest, and map errors to exit codes."""

import argparse
import difflib
import json
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin

from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT, print_error
from qrl.config import FORMER_NAMES, Config, load_preset

CACHE_BYTES = 2_000_000_000  # of compiled programs


class _Parser(argparse.ArgumentParser):
    """argparse with one-line errors, and without abbreviated flags."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **kwargs)

    def error(self, message: str) -> NoReturn:
        print_error(message)
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


def build_parser() -> _Parser:
    """The parser of all commands."""
    parser = _Parser(prog="qrl", description="From a task to a policy that flies from a microcontroller.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train a policy and write a run folder")
    train.add_argument(
        "task",
        nargs="?",
        help="name (see qrl tasks), .json file, or module:factory of your environment",
        metavar="TASK",
    )
    train.add_argument("--seed", type=whole_number, help="first seed (default 0)", metavar="N")
    train.add_argument("--seeds", type=count, help="number of seeds, trained in one program (default 1)", metavar="N")
    train.add_argument("--out", type=Path, help="run folder (default runs/TASK)", metavar="FOLDER")
    train.add_argument("--config", type=Path, help="config.json, complete or in part", metavar="FILE")
    train.add_argument("--resume", action="store_true", help="resume from the run folder's last checkpoint")
    train.add_argument("--preset", help="preset of hyperparameters, in place of the task's", metavar="NAME")
    _add_hyperparameters(train)

    evaluate = commands.add_parser("evaluate", help="fly a trained policy from fresh starts")
    evaluate.add_argument("run", type=Path, help="run folder", metavar="RUN")
    evaluate.add_argument("--starts", type=count, default=1000, help="number of starts (default 1000)", metavar="N")
    evaluate.add_argument(
        "--off-nominal", action="store_true", help="also fly with RK4, latency, sensor noise; hover: the paper's trial"
    )
    evaluate.add_argument(
        "--beside", type=Path, nargs="+", default=[], help="other runs of the same task, a column each", metavar="RUN"
    )
    evaluate.add_argument(
        "--checkpoints", type=count, default=1, help="number of most recent checkpoints to fly (default 1)", metavar="K"
    )

    export = commands.add_parser("export", help="write a trained policy as a C kernel, and verify it")
    export.add_argument("run", type=Path, help="run folder", metavar="RUN")
    export.add_argument(
        "--starts", type=count, default=1000, help="number of starts to fly the kernel from (default 1000)", metavar="N"
    )
    export.add_argument(
        "--vectors",
        type=vectors,
        default=2000,
        help="test vectors per entry point (default 2000, at least 500)",
        metavar="N",
    )

    view = commands.add_parser("view", help="write flights of a trained policy as a 3D page")
    view.add_argument("run", type=Path, help="run folder", metavar="RUN")
    view.add_argument(
        "--starts",
        type=whole_number,
        nargs="+",
        help="indices among evaluate's 1,000 starts (default: eight, failed ones first)",
        metavar="N",
    )
    view.add_argument("--out", type=Path, help="HTML file (default RUN/view.html)", metavar="FILE")

    sweep = commands.add_parser("sweep", help="train every point of a grid; rerun to resume")
    sweep.add_argument("grid", type=Path, help="grid file, such as experiments/grids/pendulum_lr.json", metavar="GRID")
    sweep.add_argument("--out", type=Path, help="folder of the results (default runs/GRID)", metavar="FOLDER")
    sweep.add_argument(
        "--memory-gb", type=positive, help="memory of the members (default: half of the devices')", metavar="GB"
    )
    for command, what in ((train, "one run"), (sweep, "one sweep")):
        hosts = command.add_argument_group(f"several processes for {what}", "defaults: JAX's or SLURM's variables")
        hosts.add_argument("--process-id", type=whole_number, help="index of this process, from 0", metavar="I")
        hosts.add_argument("--processes", type=count, help="number of processes", metavar="N")
        hosts.add_argument("--coordinator", help="address of process 0", metavar="HOST:PORT")

    commands.add_parser("tasks", help="list the tasks that can be trained")
    return parser


def _add_hyperparameters(train: argparse.ArgumentParser) -> None:
    """A flag for each field of Config: its type or choices, and its value in the default preset."""
    group = train.add_argument_group(
        "hyperparameters", "Defaults are of the default preset; a task's preset sets others."
    )
    defaults = load_preset("default")
    former: dict[str, list[str]] = {}
    for old, new in FORMER_NAMES.items():
        former.setdefault(new, []).append(old)
    for name, field in Config.model_fields.items():
        default = json.dumps(defaults[name])
        text = f"{field.description} (default {default})".replace("%", "%%")
        unset: Any = {"dest": f"learner.{name}", "default": argparse.SUPPRESS}
        group.add_argument(_flag(name), help=text, metavar=_metavar(field.annotation), **unset)
        for old in former.get(name, ()):
            group.add_argument(_flag(old), help=argparse.SUPPRESS, action=_FormerName, now=_flag(name), **unset)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _metavar(annotation: Any) -> str:
    """How a value of this type is written."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    if get_origin(annotation) is Literal:
        return "|".join(map(str, parts))
    if get_origin(annotation) is tuple:
        return f"[{_metavar(parts[0])},…]"
    if get_origin(annotation) is Annotated or len(parts) == 1:
        return _metavar(parts[0])
    return {int: "INT", float: "FLOAT", bool: "true|false"}.get(annotation, "VALUE")


class _FormerName(argparse.Action):
    """A flag of before, which says its name of today."""

    def __init__(self, *args: Any, now: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.now = now

    def __call__(self, parser: Any, namespace: argparse.Namespace, value: Any, option: str | None = None) -> None:
        print(f"note: {option} is now {self.now}", flush=True)
        setattr(namespace, self.dest, value)


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = build_parser()
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        commands.choices[args.command].refuse(unknown[0])
    return args


def configure_jax() -> None:
    """Import JAX (seconds on a cold disk) with a persistent compilation cache of bounded size."""
    # NumPy's products are small here; threads of its own would fight XLA's: an export took five times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    warnings.filterwarnings("ignore", module=r"brax\..*")  # not about the user's input
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "qrl" / "xla"
        limit_size(cache, CACHE_BYTES)
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def limit_size(folder: Path, most_bytes: int) -> None:
    """Remove the least recently written files of `folder`, until the others have at most `most_bytes`.

    Not by JAX's own limit, which needs another package and a lock at each compilation.
    """
    with suppress(OSError):
        written = sorted(
            ((f.stat().st_mtime, f.stat().st_size, f) for f in folder.iterdir() if f.is_file()), reverse=True
        )
        for total, (_, _, file) in zip(accumulate(size for _, size, _ in written), written, strict=True):
            if total > most_bytes:
                file.unlink(missing_ok=True)


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 failed while running, 2 the input was wrong."""
    args = _parse(argv)
    subject = {"train": "task", "sweep": "grid"}.get(args.command, "run")
    if args.command != "tasks":
        print(f"qrl {args.command} {getattr(args, subject) or args.config or ''}: loading JAX", flush=True)
    try:
        configure_jax()
    except KeyboardInterrupt:
        print_error("interrupted")
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
    except BadInput as error:  # raised on every process
        print_error(str(error))
        return WRONG_INPUT
    except IncompatibleCheckpoint as error:
        print_error(str(error))
        code = WRONG_INPUT
    except (NotFinite, AccumulatorOverflow, VerificationFailed) as error:
        print_error(str(error))
    except OSError as error:
        print_error(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except jax.errors.JaxRuntimeError as error:  # out of memory, above all
        print_error(str(error))
    except KeyboardInterrupt:
        print_error("interrupted")
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ValueError) and "Gloo" in str(error):  # how JAX says it on CPUs
            print_error(f"another process of the run is gone: {error}")
        else:
            traceback.print_exc()
    if jax.distributed.is_initialized():  # Python's own exit would wait for the other processes, and they for this one
        sys.stdout.flush()
        os._exit(code)
    return code


def _command(name: str) -> Callable[[argparse.Namespace], int]:
    """The command of that name, imported lazily: none waits for what another needs."""
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
    console.print(
        "Your vehicle: a .json file that extends one of the first, such as experiments/vehicles/crazyflie.json"
    )
    console.print("Your environment: module:factory, a function that returns an environment with Brax's reset and step")
    return DONE

"""The command line's words: commands, flags, types, and one-line errors."""

import argparse
import difflib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeAlias, get_args, get_origin

from qrl.cli.terminal import WRONG_INPUT, print_error
from qrl.config import FORMER_NAMES, Config, load_preset


class _Parser(argparse.ArgumentParser):
    """argparse with one-line errors, and without abbreviated flags."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **kwargs)

    def error(self, message: str) -> NoReturn:
        print_error(message)
        sys.exit(WRONG_INPUT)

    def refuse(self, word: str, former: Mapping[str, str]) -> NoReturn:
        """Exit with the flag that `word` is nearest to; where that is a `former` one, with its current name."""
        flags = {**{flag: flag for action in self._actions for flag in action.option_strings}, **former}
        close = difflib.get_close_matches(word.split("=")[0], flags, n=1) if word.startswith("-") else []
        self.error(
            f"unknown {'flag' if word.startswith('-') else 'argument'} {word}"
            f" ({f'did you mean {flags[close[0]]}?' if close else f'see {self.prog} --help'})"
        )


def whole_number(text: str, least: int = 0) -> int:
    value = float(text)
    if not (least <= value < 2**31 and value.is_integer()):
        raise ValueError
    return int(value)


def count(text: str) -> int:
    return whole_number(text, least=1)


def vectors(text: str) -> int:
    return whole_number(text, least=500)  # fewer would leave kinds of them out


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError
    return value


FIGURE = "a shipped reference's name, a .json or a .csv file"
Commands: TypeAlias = "argparse._SubParsersAction[_Parser]"


def build_parser() -> _Parser:
    parser = _Parser(prog="qrl", description="From a task to a policy that flies from a microcontroller.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_train(commands)
    _add_flights(commands)
    _add_identify(commands)
    _add_sweep(commands)
    commands.add_parser("tasks", help="list the tasks that can be trained")
    return parser


def _add_train(commands: Commands) -> None:
    train = commands.add_parser("train", help="train a policy and write a run folder")
    task = "name (see qrl tasks), .json file, or module:factory of your environment"
    train.add_argument("task", nargs="?", metavar="TASK", help=task)
    vehicle = "a shipped vehicle's name or a .json file (default: the task's own)"
    train.add_argument("--vehicle", metavar="VEHICLE", help=vehicle)
    uncertainty = "what differs from flight to flight: a shipped name or a .json file (default: the task's own)"
    train.add_argument("--uncertainty", metavar="UNCERTAINTY", help=uncertainty)
    reference = f"what to track and to be judged on: {FIGURE} (default: the task's own)"
    train.add_argument("--reference", metavar="REFERENCE", help=reference)
    train.add_argument("--seed", type=whole_number, metavar="N", help="first seed (default 0)")
    train.add_argument("--seeds", type=count, metavar="N", help="number of seeds, trained in one program (default 1)")
    train.add_argument("--out", type=Path, metavar="FOLDER", help="run folder (default runs/TASK)")
    train.add_argument("--config", type=Path, metavar="FILE", help="config.json, complete or in part")
    train.add_argument("--resume", action="store_true", help="resume from the run folder's last checkpoint")
    train.add_argument("--preset", metavar="NAME", help="preset of hyperparameters, in place of the task's")
    begin = "begin with the policy of a run, its folder or the name of one that ships (any): fine-tune it"
    train.add_argument("--init", metavar="RUN", help=begin)
    hosts = train.add_argument_group("several processes for one run", "defaults: JAX's or SLURM's variables")
    hosts.add_argument("--process-id", type=whole_number, metavar="I", help="index of this process, from 0")
    hosts.add_argument("--processes", type=count, metavar="N", help="number of processes")
    hosts.add_argument("--coordinator", metavar="HOST:PORT", help="address of process 0")
    _add_hyperparameters(train)


def _add_flights(commands: Commands) -> None:
    """What flies a trained policy."""
    evaluate = commands.add_parser("evaluate", help="fly a trained policy from fresh starts")
    export = commands.add_parser("export", help="write a trained policy as a C kernel, and verify it")
    view = commands.add_parser("view", help="write flights of a trained policy as a 3D page")
    fly = commands.add_parser("fly", help="fly a policy of any vehicle with yours: evaluate and view")
    for command in (evaluate, export, view):
        command.add_argument("run", type=Path, metavar="RUN", help="run folder, or the name of a run that ships: any")
    fly.add_argument(
        "run", nargs="?", type=Path, default=Path("any"), metavar="RUN", help="run folder, or a run that ships (any)"
    )
    fly.add_argument("--starts", type=count, default=200, metavar="N", help="number of starts (default 200)")
    for command in (evaluate, view, fly):
        instead = f"{FIGURE}, in place of the task's own"
        command.add_argument("--reference", metavar="REFERENCE", help=instead)
        other = "of a policy of any vehicle: a shipped vehicle's name or a .json file"
        command.add_argument("--vehicle", metavar="VEHICLE", help=other, required=command is fly)
    for command in (evaluate, export):
        command.add_argument("--starts", type=count, default=1000, metavar="N", help="number of starts (default 1000)")
    conditions = "also fly with other lag, latency, mass, thrust, wind, gusts, sensors and control rate"
    for command in (evaluate, fly):
        command.add_argument("--off-nominal", action="store_true", help=conditions)
    others = "other runs of the same task, a column each"
    evaluate.add_argument("--beside", type=Path, nargs="+", default=[], metavar="RUN", help=others)
    recent = "number of most recent checkpoints to fly (default 1)"
    evaluate.add_argument("--checkpoints", type=count, default=1, metavar="K", help=recent)
    each = "test vectors per entry point (default 2000, at least 500)"
    export.add_argument("--vectors", type=vectors, default=2000, metavar="N", help=each)
    name = "prefix of all names in the C code (default qrl_TASK)"
    export.add_argument("--name", metavar="NAME", help=name)
    chosen = "indices among evaluate's 1,000 starts (default: eight, failed ones first)"
    view.add_argument("--starts", type=whole_number, nargs="+", metavar="N", help=chosen)
    for command in (view, fly):
        command.add_argument("--kernel", action="store_true", help="show the int8 kernel's flights beside the policy's")
    view.add_argument("--out", type=Path, metavar="FILE", help="HTML file (default RUN/view.html)")


def _add_identify(commands: Commands) -> None:
    identify = commands.add_parser("identify", help="fit a vehicle's file to logs of its flights")
    identify.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="CSV file of a flight")
    start = "the vehicle to start from: a shipped name or a .json file"
    identify.add_argument("--vehicle", required=True, metavar="VEHICLE", help=start)
    fitted = "the fitted vehicle's file (default fitted.json)"
    identify.add_argument("--out", type=Path, default=Path("fitted.json"), metavar="FILE", help=fitted)
    apart = "share of the flights not fitted, or logs of such flights (default 0.25)"
    identify.add_argument("--hold-out", nargs="+", default=["0.25"], metavar="SHARE|LOG", help=apart)
    identify.add_argument("--plot", type=Path, metavar="FILE", help="PNG file (default beside the fitted vehicle's)")


def _add_sweep(commands: Commands) -> None:
    sweep = commands.add_parser("sweep", help="train every point of a grid; rerun to resume")
    sweep.add_argument("grid", type=Path, metavar="GRID", help="grid file, such as experiments/grids/pendulum_lr.json")
    sweep.add_argument("--out", type=Path, metavar="FOLDER", help="folder of the results (default runs/GRID)")
    engine = "this machine (local, the default), or a cluster: that of RAY_ADDRESS, else this machine's own"
    sweep.add_argument("--engine", choices=("local", "ray"), default="local", help=engine)
    memory = "memory of the members (default: half of the devices'); with --engine ray of each task's (2, on a GPU 8)"
    sweep.add_argument("--memory-gb", type=positive, metavar="GB", help=memory)


def _add_hyperparameters(train: argparse.ArgumentParser) -> None:
    """A flag for each field of Config: its type or choices, and its value in the default preset."""
    group = train.add_argument_group(
        "hyperparameters", "Defaults are of the default preset; a task's preset sets others."
    )
    defaults = load_preset("default")
    for name, field in Config.model_fields.items():
        default = json.dumps(defaults[name])
        text = f"{field.description} (default {default})".replace("%", "%%")
        kind, dest = _metavar(field.annotation), f"learner.{name}"
        group.add_argument(_flag(name), dest=dest, default=argparse.SUPPRESS, metavar=kind, help=text)


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


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The words of a command; exits with 2 where they are wrong."""
    words = list(sys.argv[1:] if argv is None else argv)
    former = {_flag(old): _flag(name) for old, name in FORMER_NAMES.items()} if words[:1] == ["train"] else {}
    for i, word in enumerate(words):
        flag, equals, value = word.partition("=")
        if flag in former:
            print(f"note: {flag} is now {former[flag]}", flush=True)
            words[i] = former[flag] + equals + value
    parser = build_parser()
    args, unknown = parser.parse_known_args(words)
    if unknown:
        commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        commands.choices[args.command].refuse(unknown[0], former)
    return args

"""Imports go through the doors that are there: experiments -> qrl -> qrl_envs, and inside each from room to room.

`ROOMS` is the table of docs/architecture.md: for each room the rooms and libraries that it may import. Read from the
source, so an import inside a function counts like any other. Every rule is seen failing (`BROKEN`).
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"qrl": ROOT / "src" / "qrl", "qrl_envs": ROOT / "envs" / "qrl_envs"}


class Room(NamedTuple):
    """What a room may import beside itself and the standard library."""

    rooms: set[str]  # of its own package; "*": all
    libraries: set[str]  # and, in qrl, what of qrl_envs it may know


WORLDS = {"qrl_envs"}
INPUT = {"qrl_envs.specfile"}  # no world: how wrong input is said
STORED = {"qrl_envs.fusion"}  # no world either: what a compiler computes once
MATHS = {"jax", "numpy", "chex"}

ROOMS: dict[str, dict[str, Room]] = {
    "qrl": {
        "__init__": Room({"api", "config"}, set()),
        "api": Room({"cli", "tasks", "evaluation", "algorithm", "runs", "config"}, MATHS | INPUT | {"pydantic"}),
        "__main__": Room({"cli"}, set()),
        "config": Room(set(), {"pydantic", "numpy"} | INPUT),
        "export": Room(set(), {"numpy", "onnx"}),
        "algorithm": Room({"config"}, MATHS | STORED | {"flax", "optax"}),
        "runs": Room({"config"}, MATHS | INPUT | {"orbax", "pydantic", "matplotlib", "tensorboardX"}),
        "training": Room({"runs", "algorithm", "config"}, MATHS | INPUT),
        "tasks": Room({"runs", "algorithm", "config"}, MATHS | WORLDS | {"brax"}),
        "request": Room({"tasks", "training", "runs", "config"}, MATHS | WORLDS),
        "sweep": Room(
            {"tasks", "training", "runs", "algorithm", "config"},
            MATHS | WORLDS | {"pydantic", "matplotlib", "optuna", "ray"},
        ),
        "evaluation": Room({"tasks", "training", "export", "runs", "algorithm", "config"}, MATHS | WORLDS),
        "identification": Room(set(), MATHS | WORLDS | {"scipy", "matplotlib"}),
        "cli": Room({"*"}, MATHS | WORLDS | {"rich"}),
    },
    "qrl_envs": {
        "specfile": Room(set(), {"pydantic"}),
        "rotation": Room(set(), MATHS),
        "fusion": Room(set(), {"jax"}),
        "integrate": Room({"fusion"}, MATHS),
        "vehicle": Room({"specfile"}, {"pydantic", "numpy"}),
        "uncertainty": Room({"specfile"}, {"pydantic"}),
        "reference": Room({"specfile", "vehicle"}, {"pydantic", "numpy", "scipy"}),
        "distribution": Room({"specfile", "vehicle", "uncertainty"}, {"pydantic"}),
        "task": Room({"specfile", "vehicle", "uncertainty", "reference", "distribution"}, {"pydantic"}),
        "rotors": Room({"vehicle"}, MATHS),
        "pendulum": Room({"task", "integrate"}, MATHS),
        "quadrotor": Room({"task", "vehicle", "rotation", "integrate", "fusion"}, MATHS),
        "rewards": Room({"task", "quadrotor", "pendulum"}, MATHS),
        "measures": Room({"task"}, MATHS),
        "io_spec": Room({"task"}, MATHS),
        "symmetry": Room({"quadrotor"}, MATHS),
        "controllers": Room({"task", "vehicle", "quadrotor", "rotation"}, MATHS | {"scipy"}),
        "target": Room({"quadrotor", "reference"}, MATHS),
        "own_vehicle": Room({"distribution", "quadrotor", "rotors", "vehicle"}, MATHS),
        "noise": Room(set(), MATHS),
        "sensors": Room({"noise", "quadrotor", "rotation"}, MATHS),
        "gusts": Room({"noise", "quadrotor", "sensors"}, MATHS),
        "plant": Room(
            {"task", "uncertainty", "vehicle", "quadrotor", "rotation", "rotors", "integrate", "sensors", "gusts"}
            | {"target", "own_vehicle", "fusion"},
            MATHS,
        ),
        "task_env": Room({"task", "symmetry"}, MATHS | {"flax.struct"}),
        "pendulum_env": Room({"task", "task_env", "pendulum", "rewards", "measures", "symmetry"}, MATHS),
        "quadrotor_env": Room(
            {"task", "task_env", "uncertainty", "quadrotor", "plant", "rewards", "measures", "symmetry"}
            | {"reference", "target", "own_vehicle"},
            MATHS,
        ),
        "env": Room({"task", "task_env", "quadrotor_env", "pendulum_env"}, set()),
        "gymnasium_env": Room({"env", "task", "task_env"}, MATHS | {"gymnasium"}),
        "off_nominal": Room({"quadrotor_env", "task", "uncertainty", "plant"}, MATHS),
        "viewer": Room({"task", "measures", "io_spec"}, MATHS | {"plotly"}),
        "plots": Room({"task", "measures"}, MATHS | {"matplotlib"}),
        "__init__": Room({"env", "task"}, {"brax", "wrapt"}),
    },
}
# A file is data: what would run code that stands in one.
RUNS_CODE = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml", "runpy", "code"}
CLOSED = ("experiments", "tests")  # nobody imports from there


class Import(NamedTuple):
    line: int
    name: str  # absolute and dotted; of `from a import b`, "a.b"


def name_of(path: Path, room: str, folder: Path) -> str:
    """ "qrl.cli.main" of src/qrl/cli.py and of src/qrl/cli/__init__.py; "qrl" of the room's own __init__."""
    parts = path.relative_to(folder).with_suffix("").parts
    return ".".join((room, *(parts[:-1] if parts[-1] == "__init__" else parts)))


def imports_of(path: Path, name: str) -> Iterator[Import]:
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), path)):
        match node:
            case ast.Import():
                yield from (Import(node.lineno, alias.name) for alias in node.names)
            case ast.ImportFrom(module=module, level=level):
                up = package.split(".")[: len(package.split(".")) + 1 - level] if level else []
                base = ".".join([*up, *([module] if module else [])])
                yield from (Import(node.lineno, f"{base}.{alias.name}") for alias in node.names)
            # importlib.import_module("x") and __import__("x")
            case ast.Call(
                func=ast.Attribute(attr="import_module") | ast.Name(id="import_module" | "__import__"),
                args=[ast.Constant(value=str(target)), *_],
            ):
                yield Import(node.lineno, target)


class House:
    """The source of all rooms: where each module lies, and what it imports."""

    def __init__(self, rooms: dict[str, Path]) -> None:
        self.paths = {name_of(p, room, d): p for room, d in rooms.items() for p in sorted(d.rglob("*.py"))}
        self.imports = {name: list(imports_of(path, name)) for name, path in self.paths.items()}

    def module(self, name: str) -> str:
        """The module of ours that the import `name` reads: "qrl.tasks" for "qrl.tasks.environment"; "" for none."""
        while name and name not in self.paths:
            name = name.rpartition(".")[0]
        return name


def room_of(name: str) -> str:
    """ "algorithm" of "qrl.algorithm.vtrace", "__init__" of "qrl"."""
    return (name.split(".") + ["__init__"])[1]


def within(name: str, allowed: set[str]) -> bool:
    return any(f"{name}.".startswith(f"{prefix}.") for prefix in allowed)


def fault(house: House, importer: str, name: str) -> str | None:
    """What is wrong with `importer` importing `name`, if anything is."""
    package, target_package = importer.split(".")[0], name.split(".")[0]
    room = ROOMS[package].get(room_of(importer))
    if room is None:
        return None  # said once, by without_a_room()
    if target_package in CLOSED:
        return "nobody imports from there"
    if (package, target_package) == ("qrl_envs", "qrl"):
        return "the worlds never import the learner"
    if target_package == package:
        target = room_of(name) if room_of(name) in ROOMS[package] else "__init__"
        open_to = target == room_of(importer) or "*" in room.rooms or target in room.rooms
        return None if open_to else f"no door from {room_of(importer)} to {target}"
    if target_package == "qrl_envs":
        return None if within(name, room.libraries) else f"{room_of(importer)} knows no world"
    allowed = target_package in sys.stdlib_module_names or within(name, room.libraries)
    return None if allowed else f"not among the libraries of {room_of(importer)}"


def without_a_room(house: House) -> list[str]:
    return [
        f"{name}: unknown here: give it a room in ROOMS"
        for name in house.paths
        if room_of(name) not in ROOMS[name.split(".")[0]]
    ]


def doors(house: House) -> list[str]:
    return [
        f"{importer}, line {line}, imports {name}: {wrong}"
        for importer, imports in house.imports.items()
        for line, name in imports
        if (wrong := fault(house, importer, name))
    ]


def unused_doors(house: House) -> list[str]:
    """Doors in the table that no import goes through: the table would allow what the house does not have."""
    used: set[tuple[str, str, str]] = set()
    for importer, imports in house.imports.items():
        for _, name in imports:
            if target := house.module(name):
                used.add((importer.split(".")[0], room_of(importer), room_of(target)))
    return [
        f"{package}: no import goes from {here} to {there}: close that door"
        for package, rooms in ROOMS.items()
        for here, room in rooms.items()
        for there in room.rooms - {"*"}
        if (package, here, there) not in used
    ]


def circles(house: House) -> list[str]:
    # A package's own __init__ is loaded before any module inside it: `from qrl_envs import task` asks for task.
    graph = {
        name: {target for imported in imports if (target := house.module(imported.name)) not in ("", name)}
        for name, imports in house.imports.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [f"a circle: {' -> '.join(error.args[1])}"]
    return []


def runs_code(house: House) -> list[str]:
    faults = []
    for name, path in house.paths.items():
        found = [(i.line, i.name) for i in house.imports[name] if i.name.split(".")[0] in RUNS_CODE]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), path)):
            match node:
                case ast.Call(func=ast.Name(id="eval" | "exec" | "compile" as word)):
                    found.append((node.lineno, word))
                case ast.keyword(arg="allow_pickle") if not (
                    isinstance(node.value, ast.Constant) and node.value.value is False
                ):
                    found.append((node.lineno, "allow_pickle"))
        faults += [f"{name}, line {line}: {word} runs code that stands in a file" for line, word in found]
    return faults


RULES = {
    "a room for each": without_a_room,
    "doors": doors,
    "no circles": circles,
    "files are data": runs_code,
}


@pytest.fixture(scope="module")
def house() -> House:
    return House(PACKAGES)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_the_house_keeps(rule, house: House) -> None:
    faults = rule(house)
    assert not faults, "\n" + "\n".join(faults)


def test_every_door_is_used(house: House) -> None:
    faults = unused_doors(house)
    assert not faults, "\n" + "\n".join(faults)


def test_both_packages_are_read(house: House) -> None:
    assert {
        "qrl.algorithm.vtrace",
        "qrl.algorithm.objective",
        "qrl_envs.quadrotor",
        "qrl_envs.env",
    } <= house.paths.keys()
    assert any(imported.name == "jax.numpy" for imported in house.imports["qrl.algorithm.vtrace"])


def test_the_package_and_its_help_load_no_jax() -> None:
    """JAX takes most of a command's first seconds."""
    program = "import sys, qrl.cli.main, qrl.cli.arguments as cli; cli.build_parser(); print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "False\n"


# Each rule, and each row, seen failing: a file, what it says, and the words that must come of it.
BROKEN = {
    "unknown module": ("qrl/brainwave.py", "", without_a_room, "give it a room"),
    "config": ("qrl/config.py", "from qrl.algorithm.types import Env", doors, "no door from config to algorithm"),
    "algorithm, a room above": ("qrl/algorithm/vtrace.py", "from qrl.training import state", doors, "no door"),
    "algorithm, relative": ("qrl/algorithm/vtrace.py", "from ..training import state", doors, "no door"),
    "algorithm, inside a function": (
        "qrl/algorithm/vtrace.py",
        "def f():\n    import qrl.runs.files",
        doors,
        "no door",
    ),
    "algorithm, a world": ("qrl/algorithm/learner.py", "from qrl_envs import env", doors, "algorithm knows no world"),
    "algorithm, input": ("qrl/algorithm/learner.py", "from qrl_envs.specfile import BadInput", doors, "knows no world"),
    "runs": ("qrl/runs/files.py", "from qrl.training.state import TrainState", doors, "no door from runs to training"),
    "runs, a world": ("qrl/runs/files.py", "from qrl_envs import task", doors, "runs knows no world"),
    "training": ("qrl/training/loop.py", "from qrl import tasks", doors, "no door from training to tasks"),
    "tasks": ("qrl/tasks.py", "from qrl import request", doors, "no door from tasks to request"),
    "request": ("qrl/request.py", "from qrl.sweep import grid", doors, "no door from request to sweep"),
    "sweep": ("qrl/sweep/grid.py", "from qrl.export import emit", doors, "no door from sweep to export"),
    "evaluation": ("qrl/evaluation/trained_run.py", "from qrl.cli import terminal", doors, "no door"),
    "identification": ("qrl/identification/fit.py", "from qrl.runs import files", doors, "no door from identification"),
    "cli, a library": ("qrl/cli/main.py", "import optax", doors, "libraries of cli"),
    "package, at import": ("qrl/__init__.py", "from qrl.algorithm import learner", doors, "no door from __init__"),
    "__main__": ("qrl/__main__.py", "from qrl.training import loop", doors, "no door from __main__"),
    "export needs JAX": ("qrl/export/policy.py", "import jax", doors, "libraries of export"),
    "export needs a room": (
        "qrl/export/policy.py",
        "from qrl.algorithm.types import Env",
        doors,
        "no door from export",
    ),
    "a test oracle": ("qrl/algorithm/vtrace.py", "import rlax", doors, "libraries of algorithm"),
    "api": ("qrl/api.py", "from qrl.sweep import grid", doors, "no door from api to sweep"),
    "api, a world": ("qrl/api.py", "from qrl_envs import env", doors, "api knows no world"),
    "experiments": ("qrl/cli/main.py", "import experiments.figures", doors, "nobody imports"),
    "the registry": ("qrl_envs/rotation.py", "import qrl_envs", doors, "no door from rotation"),
    "world -> learner": ("qrl_envs/env.py", "import qrl.algorithm.vtrace", doors, "never import the learner"),
    "world -> learner, by name": (
        "qrl_envs/env.py",
        "import importlib\nimportlib.import_module('qrl')",
        doors,
        "never",
    ),
    "the plant knows its rewards": ("qrl_envs/quadrotor.py", "from qrl_envs import rewards", doors, "no door"),
    "a vehicle knows its task": ("qrl_envs/vehicle.py", "from qrl_envs import task", doors, "no door"),
    "specfile": ("qrl_envs/specfile.py", "from qrl_envs import task", doors, "no door from specfile to task"),
    "rotation": ("qrl_envs/rotation.py", "from qrl_envs import integrate", doors, "no door from rotation"),
    "fusion": ("qrl_envs/fusion.py", "from qrl_envs import rotation", doors, "no door from fusion"),
    "integrate": ("qrl_envs/integrate.py", "from qrl_envs import rotation", doors, "no door from integrate"),
    "task": ("qrl_envs/task.py", "import jax", doors, "libraries of task"),
    "pendulum": ("qrl_envs/pendulum.py", "from qrl_envs import quadrotor", doors, "no door from pendulum"),
    "rewards": ("qrl_envs/rewards.py", "from qrl_envs import measures", doors, "no door from rewards"),
    "measures": ("qrl_envs/measures.py", "from qrl_envs import rewards", doors, "no door from measures"),
    "io_spec": ("qrl_envs/io_spec.py", "from qrl_envs import quadrotor", doors, "no door from io_spec"),
    "symmetry": ("qrl_envs/symmetry.py", "from qrl_envs import task", doors, "no door from symmetry"),
    "controllers": ("qrl_envs/controllers/lqr.py", "from qrl_envs import env", doors, "no door from controllers"),
    "uncertainty": ("qrl_envs/uncertainty.py", "from qrl_envs import task", doors, "no door from uncertainty"),
    "rotors": ("qrl_envs/rotors.py", "from qrl_envs import plant", doors, "no door from rotors"),
    "reference": ("qrl_envs/reference.py", "import jax", doors, "libraries of reference"),
    "distribution": ("qrl_envs/distribution.py", "from qrl_envs import task", doors, "no door from distribution"),
    "target": ("qrl_envs/target.py", "from qrl_envs import plant", doors, "no door from target"),
    "own_vehicle": ("qrl_envs/own_vehicle.py", "from qrl_envs import plant", doors, "no door from own_vehicle"),
    "noise": ("qrl_envs/noise.py", "from qrl_envs import rotation", doors, "no door from noise"),
    "sensors": ("qrl_envs/sensors.py", "from qrl_envs import plant", doors, "no door from sensors"),
    "gusts": ("qrl_envs/gusts.py", "from qrl_envs import plant", doors, "no door from gusts"),
    "plant": ("qrl_envs/plant.py", "from qrl_envs import env", doors, "no door from plant"),
    "env": ("qrl_envs/env.py", "from qrl_envs import off_nominal", doors, "no door from env to off_nominal"),
    "task_env": ("qrl_envs/task_env.py", "from qrl_envs import plant", doors, "no door from task_env"),
    "task_env, a library": ("qrl_envs/task_env.py", "from flax import linen", doors, "libraries of task_env"),
    "pendulum_env": ("qrl_envs/pendulum_env.py", "from qrl_envs import plant", doors, "no door from pendulum_env"),
    "quadrotor_env": ("qrl_envs/quadrotor_env.py", "from qrl_envs import viewer", doors, "no door from quadrotor_env"),
    "gymnasium_env": ("qrl_envs/gymnasium_env.py", "from qrl_envs import plots", doors, "no door from gymnasium_env"),
    "off_nominal": ("qrl_envs/off_nominal.py", "from qrl_envs import symmetry", doors, "no door"),
    "viewer": ("qrl_envs/viewer/__init__.py", "from qrl_envs import env", doors, "no door from viewer"),
    "plots": ("qrl_envs/plots/settle.py", "from qrl_envs import env", doors, "no door from plots"),
    "qrl_envs, at import": ("qrl_envs/__init__.py", "from qrl_envs import plots", doors, "no door from __init__"),
    "a circle": ("qrl/algorithm/rollout.py", "from qrl.algorithm.learner import update", circles, "a circle"),
    "pickle": ("qrl/runs/files.py", "import pickle", runs_code, "pickle runs code"),
    "pickle, through NumPy": (
        "qrl/runs/files.py",
        "np.load(p, allow_pickle=True)",
        runs_code,
        "allow_pickle runs code",
    ),
    "eval": ("qrl/cli/main.py", "def value(text):\n    return eval(text)", runs_code, "line 2: eval runs code"),
}
SOUND = {
    "qrl/__init__.py": "",
    "qrl/config.py": "import pydantic",
    "qrl/algorithm/types.py": "import jax\nfrom flax import struct\nfrom flax.struct import dataclass",
    "qrl/algorithm/vtrace.py": "import jax.numpy as jnp\nfrom qrl.algorithm.types import Transition",
    "qrl/algorithm/learner.py": "import optax\nfrom . import rollout\nfrom qrl.config import Config",
    "qrl/algorithm/rollout.py": "from .. import config\nfrom qrl_envs.fusion import stored",
    "qrl/runs/files.py": "from qrl_envs.specfile import BadInput",
    "qrl/training/state.py": "from qrl.algorithm.learner import LearnerState",
    "qrl/training/loop.py": "from qrl.training.state import TrainState\nfrom qrl.runs import files",
    "qrl/export/policy.py": "import json\nimport numpy as np",
    "qrl/cli/main.py": "import re\nimport rich\nimport qrl_envs\nfrom qrl.training import loop\nWORD = re.compile('a')",
    "qrl_envs/__init__.py": "from qrl_envs import env",
    "qrl_envs/env.py": "from qrl_envs.quadrotor_env import QuadrotorEnv",
    "qrl_envs/quadrotor_env.py": "from qrl_envs.quadrotor import step",
    "qrl_envs/quadrotor.py": "import jax",
    "qrl_envs/rotation.py": "import jax",
}


def build(folder: Path, files: dict[str, str]) -> House:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return House({package: folder / package for package in PACKAGES})


def test_a_sound_house_passes(tmp_path: Path) -> None:
    house = build(tmp_path, SOUND)
    assert [rule(house) for rule in RULES.values()] == [[] for _ in RULES]


@pytest.mark.parametrize(("path", "text", "rule", "words"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_house_fails(path: str, text: str, rule, words: str, tmp_path: Path) -> None:
    faults = rule(build(tmp_path, SOUND | {path: text}))
    assert faults
    assert all(words in said for said in faults), faults


def test_every_row_is_seen_failing() -> None:
    """Each room has a case in BROKEN that goes through a door, or to a library, that it lacks."""
    places = [Path(path).parts for path, _, rule, _ in BROKEN.values() if rule is doors]
    broken = {(package, room.removesuffix(".py")) for package, room, *_ in places}
    assert broken == {(package, room) for package, rooms in ROOMS.items() for room in rooms}


def test_the_page_has_the_table() -> None:
    """docs/architecture.md: the rooms of qrl, and for each the rooms that it may import."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    found: dict[str, set[str]] = {}
    for line in page.splitlines():
        if line.startswith("| `"):
            names, _, may_import = (cell.strip() for cell in line.strip("|").split(" | "))
            rooms = set() if may_import == "–" else set(may_import.split(", "))
            found |= {name.removesuffix("/").removesuffix(".py"): rooms for name in re.findall(r"`([^`]+)`", names)}
    found["config"] |= found.pop("presets")  # files alone
    expected = {
        name: {"all"} if "*" in room.rooms else room.rooms | ({"qrl_envs"} if room.libraries >= WORLDS else set())
        for name, room in ROOMS["qrl"].items()
    }
    assert found == expected

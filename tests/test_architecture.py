"""Imports go only downward, and through the doors that are there: experiments -> qrl -> qrl_envs.

A module may import those of its own floor, as long as no circle comes of it, and of the floors below; third-party
libraries as `ALLOWED` says. Read from the source, so an import inside a function counts like any other.
"""

import ast
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {"qrl": ROOT / "src" / "qrl", "qrl_envs": ROOT / "envs" / "qrl_envs"}

# The house. A package's row covers all modules inside it; "__init__" is the room's own.
FLOORS: dict[str, dict[str, int]] = {
    "qrl_envs": {
        "specfile": 0,
        "rotation": 0,
        "integrate": 0,
        "task": 0,
        "pendulum": 1,
        "quadrotor": 1,
        "rewards": 1,
        "measures": 1,
        "ports": 1,
        "symmetry": 1,
        "controllers": 1,
        "failures": 1,
        "env": 2,
        "conditions": 2,
        "__init__": 2,
        "viewer": 3,
        "pictures": 3,
    },
    "qrl": {
        "__init__": 0,
        "config": 0,
        "types": 0,
        "networks": 1,
        "vtrace": 1,
        "objective": 1,
        "buffer": 1,
        "statistics": 1,
        "policy": 1,
        "export": 1,
        "peers": 2,
        "learner": 2,
        "apg": 2,
        "rollout": 2,
        "evaluate": 2,
        "state": 3,
        "train": 3,
        "laps": 3,
        "loop": 3,
        "restore": 3,
        "seal": 3,
        "checkpoint": 3,
        "sweep": 3,
        "sweep_plot": 3,
        "runs": 3,
        "tensorboard": 3,
        "plots": 3,
        "exits": 4,
        "request": 4,
        "terminal": 4,
        "processes": 4,
        "axes": 4,
        "grid": 4,
        "results": 4,
        "sweep_command": 4,
        "export_command": 4,
        "train_command": 4,
        "evaluate_command": 4,
        "view_command": 4,
        "evaluate_table": 4,
        "pilots": 4,
        "deploy": 4,
        "commands": 4,
        "cli": 4,
        "__main__": 4,
    },
}
# What each floor may import beside the standard library, on top of what the floors below it may; None: anything.
ALLOWED: list[set[str] | None] = [
    {"jax", "numpy", "chex", "flax.struct", "pydantic"},
    {"flax", "scipy"},
    {"brax", "optax", "wrapt"},
    {"orbax", "matplotlib", "tensorboardX"},
    None,
]
COMMAND_LINE = 4  # the floor that joins the learner and the worlds
ALONE = {"qrl": ("policy", "export")}  # a firmware tool may read these: NumPy, and nothing that needs more
# A file is data: what would run code that stands in one.
RUNS_CODE = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml", "runpy", "code"}
CLOSED = ("experiments", "tests")  # rooms that nobody imports from


class Import(NamedTuple):
    line: int
    name: str  # absolute and dotted; of `from a import b`, "a.b"


def name_of(path: Path, room: str, folder: Path) -> str:
    """ "qrl.cli" of src/qrl/cli.py and of src/qrl/cli/__init__.py; "qrl" of the room's own __init__."""
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
        """The module of ours that the import `name` reads: "qrl.vtrace" for "qrl.vtrace.vtrace"; "" for none."""
        while name and name not in self.paths:
            name = name.rpartition(".")[0]
        return name

    def reached_from(self, name: str) -> set[str]:
        """`name` and whatever of ours it imports, directly or not."""
        reached, ahead = set(), [name]
        while ahead:
            here = ahead.pop()
            if here not in reached:
                reached.add(here)
                ahead += filter(None, (self.module(imported.name) for imported in self.imports[here]))
        return reached


def floor_of(name: str) -> int | None:
    room, *rest = name.split(".")
    return FLOORS[room].get(rest[0] if rest else "__init__")


def allowed_on(floor: int, name: str) -> bool:
    if name.split(".")[0] in sys.stdlib_module_names:
        return True
    below = ALLOWED[: floor + 1]
    return None in below or any(f"{name}.".startswith(f"{lib}.") for libs in below if libs for lib in libs)


def fault(house: House, importer: str, name: str) -> str | None:
    """What is wrong with `importer` importing `name`, if anything is."""
    here, target = floor_of(importer), house.module(name)
    room, target_room = importer.split(".")[0], name.split(".")[0]
    if here is None:
        return None  # said once, by homeless()
    if target_room in CLOSED:
        return "nobody imports from there"
    if room == "qrl_envs" and target_room == "qrl":
        return "the worlds never import the learner"
    if room == "qrl" and target_room == "qrl_envs":
        return None if here == COMMAND_LINE else "the learner's mathematics never imports a world"
    if target_room == room:
        there = floor_of(target) if target else None
        return f"that is on floor {there}, above" if there is not None and there > here else None
    return None if allowed_on(here, name) else f"not among the libraries of floor {here}"


def homeless(house: House) -> list[str]:
    return [f"{name}: unknown here: give it a floor in FLOORS" for name in house.paths if floor_of(name) is None]


def upward(house: House) -> list[str]:
    return [
        f"{importer} (floor {floor_of(importer)}), line {line}, imports {name}: {wrong}"
        for importer, imports in house.imports.items()
        for line, name in imports
        if (wrong := fault(house, importer, name))
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


def not_alone(house: House) -> list[str]:
    faults = []
    for name in house.paths:
        room, *rest = name.split(".")
        if rest and rest[0] in ALONE.get(room, ()):
            for reached in house.reached_from(name):
                for line, imported in house.imports[reached]:
                    root = imported.split(".")[0]
                    if root not in {*sys.stdlib_module_names, "numpy", room}:
                        faults.append(f"{name} reaches {imported} ({reached}, line {line}): NumPy alone is allowed")
    return faults


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
    "a floor for each": homeless,
    "downward": upward,
    "no circles": circles,
    "NumPy alone": not_alone,
    "files are data": runs_code,
}


@pytest.fixture(scope="module")
def house() -> House:
    return House(ROOMS)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_the_house_keeps(rule, house: House) -> None:
    faults = rule(house)
    assert not faults, "\n" + "\n".join(faults)


def test_both_rooms_are_read(house: House) -> None:
    assert {"qrl.vtrace", "qrl.objective", "qrl_envs.quadrotor", "qrl_envs.env"} <= house.paths.keys()
    assert any(imported.name == "jax.numpy" for imported in house.imports["qrl.vtrace"])


def test_the_learner_opens_without_a_cost(house: House) -> None:
    assert house.imports["qrl"] == [], "qrl/__init__ imports nothing"


# Each rule, seen failing: a file, what it says, and the words that must come of it.
BROKEN = {
    "unknown module": ("qrl/brainwave.py", "", homeless, "give it a floor"),
    "upward": ("qrl/vtrace.py", "from qrl.learner import update", upward, "above"),
    "upward, relative": ("qrl/vtrace.py", "from .learner import update", upward, "above"),
    "upward, relative to the package": ("qrl/vtrace.py", "from . import learner", upward, "above"),
    "upward, inside a function": ("qrl/vtrace.py", "def f():\n    import qrl.learner", upward, "above"),
    "upward, from a package": ("qrl/buffer/ring.py", "from ..learner import update", upward, "above"),
    "upward, to the registry": ("qrl_envs/rotation.py", "import qrl_envs", upward, "above"),
    "learner -> world": ("qrl/learner.py", "from qrl_envs import env", upward, "never imports a world"),
    "world -> learner": ("qrl_envs/env.py", "import qrl.vtrace", upward, "never import the learner"),
    "world -> learner, by name": (
        "qrl_envs/env.py",
        "import importlib\nimportlib.import_module('qrl')",
        upward,
        "never",
    ),
    "a library above its floor": ("qrl/vtrace.py", "import optax", upward, "libraries of floor 1"),
    "flax below its floor": ("qrl/types.py", "from flax import linen", upward, "libraries of floor 0"),
    "a test oracle": ("qrl/vtrace.py", "import rlax", upward, "libraries of floor 1"),
    "experiments": ("qrl/cli.py", "import experiments.figures", upward, "nobody imports"),
    "a circle": ("qrl/learner.py", "from qrl.rollout import Lanes", circles, "a circle"),
    "the state needs its trainer": ("qrl/state.py", "from qrl.train import Trainer", circles, "a circle"),
    "the learner needs the state": ("qrl/learner.py", "from qrl.state import TrainState", upward, "above"),
    "policy needs JAX": ("qrl/policy.py", "import jax", not_alone, "NumPy alone"),
    "pickle": ("qrl/runs.py", "import pickle", runs_code, "pickle runs code"),
    "pickle, through NumPy": ("qrl/loop.py", "np.load(path, allow_pickle=True)", runs_code, "allow_pickle runs code"),
    "eval": ("qrl/cli.py", "def value(text):\n    return eval(text)", runs_code, "line 2: eval runs code"),
    "policy needs JAX elsewhere": ("qrl/policy.py", "from qrl.types import Transition", not_alone, "NumPy alone"),
}
SOUND = {
    "qrl/__init__.py": "",
    "qrl/types.py": "import jax\nfrom flax import struct\nfrom flax.struct import dataclass",
    "qrl/vtrace.py": "import jax.numpy as jnp\nfrom qrl.types import Transition",
    "qrl/policy.py": "import json\nimport numpy as np",
    "qrl/buffer/__init__.py": "",
    "qrl/rollout.py": "import brax.envs\nfrom qrl.learner import update",
    "qrl/learner.py": "import optax\nfrom . import vtrace",
    "qrl/state.py": "from qrl.learner import LearnerState",
    "qrl/train.py": "from qrl.state import TrainState",
    "qrl/cli.py": "import re\nimport rich\nimport qrl_envs\nfrom qrl import rollout\nWORD = re.compile('a')",
    "qrl_envs/__init__.py": "from qrl_envs import env",
    "qrl_envs/env.py": "from brax.envs import Env\nfrom qrl_envs.rotation import rotate",
    "qrl_envs/rotation.py": "import jax",
}


def build(folder: Path, files: dict[str, str]) -> House:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return House({room: folder / room for room in ROOMS})


def test_a_sound_house_passes(tmp_path: Path) -> None:
    house = build(tmp_path, SOUND)
    assert [rule(house) for rule in RULES.values()] == [[] for _ in RULES]


@pytest.mark.parametrize(("path", "text", "rule", "words"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_house_fails(path: str, text: str, rule, words: str, tmp_path: Path) -> None:
    faults = rule(build(tmp_path, SOUND | {path: text}))
    assert faults
    assert all(words in said for said in faults), faults

"""Garbage in: whatever stands in a file that qrl reads, it is read, or refused in one line that names the file.

`--hypothesis-profile=stress` runs 10,000 cases of each kind of file, others each time.
"""

import copy
import csv
import functools
import io
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from qrl import request, tasks
from qrl.cli import sweep
from qrl.cli.terminal import clock
from qrl.config import Config
from qrl.runs import files, learning_curve, record
from qrl.runs.record import RunConfig, TaskRecord
from qrl.sweep import grid, runner
from qrl.training.state import member_inputs
from qrl_envs import io_spec, specfile
from qrl_envs import task as task_spec
from qrl_envs.specfile import BadInput
from qrl_envs.vehicle import vehicle_data

VEHICLE = {"extend": "hover", "vehicle": vehicle_data("crazyflie")}
LONGEST = 1000  # characters of a message
BUDGET = 2e7  # bytes of a grid's points

PENDULUM = tasks.task_record("pendulum")
LEARNER = specfile.build(Config, tasks.task_preset(PENDULUM, ""), "")
RUN = RunConfig(task=PENDULUM, learner=LEARNER, seed=3, seeds=2, versions={"jax": "1"}, devices=["cpu"])
PART = {
    "task": "circle",
    "learner": {"gamma": 0.9, "policy_hidden_layer_sizes": [8, 8], "observation_scale": [1] * 18},
    "seed": 1,
}

FEW = {"num_timesteps": 4e4, "num_evals": 2}
LISTED = {"task": "pendulum", "fixed": FEW, "axes": {"gamma": [0.9, 0.99], "task.rod.mass_kg": [1, 2]}, "seeds": 2}
NAMED = {"task": "hover", "axes": {"m": {"a": {}, "b": {"lam": 0.5}}, "task.vehicle.motors.*.max_N": [5, 6]}}
RANGE = {"from": 1e-3, "to": 0.5, "spacing": "log"}
SPANNED = {"task": "circle", "axes": {"sigma": RANGE | {"count": 3}}, "seeds": [4, 7]}
SAMPLED = {"task": "hover", "axes": {"sigma": RANGE, "lam": [0.5, 1]}, "sample": {"count": 5, "seed": 1}}
PARTED = {"axes": {"task": ["hover", "circle"], "vehicle": ["crazyflie", "x500"]}, "fixed": {"gamma": 0.9}}
SEARCHED = {"task": "hover", "axes": {"sigma": RANGE, "lam": [0.5, 1]}, "search": {"trials": 5, "prune": False}}
FILE = specfile.build(grid.GridFile, LISTED, "")
GRID = grid.Grid(FILE, [grid.GridPoint({"gamma": 0.9}, PENDULUM, LEARNER)])

ROW = {"env_steps": 200, "updates": 4, "return_mean": -1.5, "return_min": -3.25, "success": math.nan}
ROWS = [ROW | {"train_seconds": 0.5, "value": 1e-9}, ROW | {"env_steps": 400, "train_seconds": 1.25, "value": 0.0}]
RESULTS = {0: runner.Result(ROWS, ""), 1: runner.Result(ROWS, "reward is not finite in update 3")}


# -- what reads each file, and goes on as far as a command does before it trains ----------------------------------


def starts(task: TaskRecord, learner: Config, where: Path) -> None:
    env = tasks.environment(task)
    tasks.check(env, learner, str(where))
    member_inputs(env, learner)


def reads_task(path: Path) -> None:
    run = request.run_config(str(path), None, record.ConfigFile(), {}, None, None)
    starts(run.task, run.learner, path)
    task = task_spec.load(str(path))
    assert len(io_spec.observations(task)) in (3, 18, 27)
    assert all(action.low <= action.safe <= action.high for action in io_spec.actions(task))


def reads_config(path: Path) -> None:
    file = request.config_file(path)
    run = request.run_config(None if file.task else "pendulum", path, file, {}, None, None)
    starts(run.task, run.learner, path)
    has_folders(run)


def reads_stored(path: Path) -> None:
    run = tasks.load_run_config(path.parent)
    starts(run.task, run.learner, path)
    has_folders(run)


def has_folders(run: RunConfig) -> None:
    """Of a number that a disk holds, inside runs/; and seeds that the program's integers hold."""
    if run.seeds > 100_000:
        raise MemoryError(run.seeds)
    folders = record.member_folders(Path("runs") / run.task.name, run)
    assert Path("runs").resolve() in folders[0].resolve().parents
    assert run.member(run.seeds - 1).seed < 2**31


def reads_grid(path: Path) -> None:
    found = grid.load(path, BUDGET)
    assert len(found.points) * len(found.seeds) * grid.REPORT_BYTES <= BUDGET
    json.dumps(found.record, allow_nan=False)
    for first, *_ in found.groups():
        starts(found.points[first].task, found.points[first].learner, path)


def reads_chunk(path: Path) -> None:
    """What a sweep does not read it makes anew; but it must not take one number for another."""
    unreadable: list[Path] = []
    found = runner.finished(path.parent, unreadable.append)
    assert same(found, {} if unreadable else RESULTS)


def reads_held(path: Path) -> None:
    assert sweep._holds_sweep(path.parent, GRID)


def reads_metrics(path: Path) -> None:
    """As a run that goes on does."""
    kept = [row for row in files.read_metrics(path.parent) if row["env_steps"] <= 200]
    clock(kept[-1]["train_seconds"] if kept else 0.0)
    files.write_metrics(path.parent, [*kept, ROWS[-1]])
    last = files.read_metrics(path.parent)[-1]
    assert same({name: last[name] for name in ROWS[-1]}, ROWS[-1])
    learning_curve.aligned([kept], "return_mean")


def same(found: Any, expected: Any) -> bool:
    return json.dumps(found, sort_keys=True) == json.dumps(expected, sort_keys=True)  # as text: NaN equals NaN


# -- the files ---------------------------------------------------------------------------------------------------


class Text(str):
    """What stands in a file as it is."""


class Pairs(list[list[Any]]):
    """A JSON object; keys may stand twice."""


def tree(document: Any) -> Any:
    return json.loads(json.dumps(document), object_pairs_hook=lambda pairs: Pairs(map(list, pairs)))


def spelled(node: Any) -> str:
    if isinstance(node, Pairs):
        return f"{{{','.join(f'{spelled(key)}:{spelled(value)}' for key, value in node)}}}"
    if isinstance(node, list):
        return f"[{','.join(map(spelled, node))}]"
    return node if isinstance(node, Text) else json.dumps(node)


def spelled_csv(lines: Any) -> str:
    cells = [line if isinstance(line, list) else [line] for line in lines]
    return "\n".join(",".join(spelled(cell).strip('"') for cell in line) for line in cells) + "\n"


class Kind(NamedTuple):
    """One kind of file: its name, what reads it, and sound ones."""

    name: str
    reads: Callable[[Path], None]
    documents: list[Any]
    refusal: type[Exception] = BadInput
    spelled: Callable[[Any], str] = spelled


SHIPPED = [tree(task_spec.load(name).model_dump(mode="json")) for name in task_spec.shipped()]
RECORD = GRID.record | {"versions": {"jax": "1"}, "devices": ["cpu"]}
CHUNK = runner.record(RESULTS)
TABLE = list(csv.reader(io.StringIO(files.csv_text(ROWS))))
KINDS = {
    "task": Kind("mine.json", reads_task, [*SHIPPED, tree(VEHICLE), tree({"extend": "circle"})]),
    "config": Kind("mine.json", reads_config, [tree(RUN.model_dump(mode="json")), tree(PART)]),
    "stored": Kind("config.json", reads_stored, [tree(RUN.model_dump(mode="json"))]),
    "grid": Kind(
        "mine.json", reads_grid, [tree(LISTED), tree(NAMED), tree(SPANNED), tree(SAMPLED), tree(PARTED), tree(SEARCHED)]
    ),
    "chunk": Kind("0000000.json", reads_chunk, [tree(CHUNK)]),
    "held": Kind("grid.json", reads_held, [tree(RECORD)]),
    "metrics": Kind("metrics.csv", reads_metrics, [TABLE], OSError, spelled_csv),
}

# -- garbage -----------------------------------------------------------------------------------------------------

LONG = {  # what stands for them in a case, which is thus short
    "@deep": "[" * 9000 + "]" * 9000,
    "@nested": "[" * 300 + "]" * 300,
    "@objects": '{"a":' * 300 + "1" + "}" * 300,
    "@list": "[1" + ",1" * 5000 + "]",
    "@keys": "{" + ",".join(f'"{i}":{i}' for i in range(5000)) + "}",
    "@digits": "9" * 5000,
    "@power": "1" + "0" * 400,
    "@word": '"' + "x" * 5000 + '"',
}
MANY = {  # and what hangs a reader that looks through all keys for each, or lists the points before it counts them
    "@many": "{" + ",".join(f'"{i}":{i}' for i in range(60_000)) + "}",
    "@range": '{"from": 0, "to": 1, "count": 1e6}',
}
ODD = [
    *("null", "true", "{}", "[]", "0", "-1", "2.5", "1e400", "-1e400", "1e-400", "NaN", "Infinity", "-Infinity", "²"),
    *("-0.0", "1e39", "1e-39", "2147483647", "2147483648", "1e12", "1e999999999", *LONG),
]
WORDS = [
    *('""', '"\\ud800"', '"\\u0000"', '"\\n\\u2028"', '".."', '"../../x"', '"nope.json"', '"1e3"', '"hover"', '"fast"'),
    *('"circle"', '"pendulum"', '"quadrotor"', '"form"', '"extend"', '"from"', '"*"', '"count"', '"sample"', "@word"),
    *('"task.evaluation.tail_s"', '"task.vehicle.motors.0.spin"', '"task.preset"', '"task.reward.form"'),
]
LEAVES = (
    st.sampled_from(ODD) | st.sampled_from(WORDS) | (st.integers() | st.floats() | st.text(max_size=20)).map(json.dumps)
)
KEYS = st.sampled_from(WORDS) | st.text(max_size=20).map(json.dumps)
JSON = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4).map(lambda parts: f"[{','.join(parts)}]")
        | st.lists(st.tuples(KEYS, inner).map(":".join), max_size=4).map(lambda parts: f"{{{','.join(parts)}}}")
    ),
    max_leaves=10,
)
SPOT = st.integers(0, 2**16)  # modulo how many there are


class Whole(NamedTuple):
    """A file of these bytes."""

    text: bytes


class Change(NamedTuple):
    """To a sound file: at one place of its tree or, in how flip, cut and insert, at one byte."""

    how: str
    at: int
    other: int = 0
    text: str = ""


class Damaged(NamedTuple):
    document: int
    changes: list[Change]


MARK = st.sampled_from(["", "", "", "\ufeff"])
WHOLE = st.builds(Whole, st.binary(max_size=60) | st.builds(lambda mark, text: (mark + text).encode(), MARK, JSON))
HOW = st.sampled_from(["delete", "twice", "value", "value", "key", "copy", "flip", "flip", "cut", "insert"])
DAMAGED = st.builds(Damaged, SPOT, st.lists(st.builds(Change, HOW, SPOT, SPOT, LEAVES | JSON), min_size=1, max_size=3))


def places(node: Any) -> Iterator[tuple[list[Any], int]]:
    if isinstance(node, list):
        for i, inner in enumerate(node):
            yield node, i
            yield from places(inner[1] if isinstance(node, Pairs) else inner)


def edit(document: Any, change: Change) -> None:
    spots = list(places(document)) or [([None], 0)]
    (inside, i), (other, j) = spots[change.at % len(spots)], spots[change.other % len(spots)]
    pairs = isinstance(inside, Pairs)
    if change.how == "delete":
        del inside[i]
    elif change.how == "twice":
        inside.insert(i, copy.deepcopy(inside[i]))
    elif change.how == "key" and pairs:
        inside[i][0] = Text(change.text) if change.text in WORDS else change.text[:20]
    else:
        found = other[j][1] if isinstance(other, Pairs) else other[j]
        value = copy.deepcopy(found) if change.how == "copy" else Text(change.text)
        inside[i] = [inside[i][0], value] if pairs else value


def changed(text: bytes, change: Change) -> bytes:
    at = change.at % (len(text) + 1)
    if change.how == "flip":
        return text[:at] + bytes(byte ^ 1 << change.other % 8 for byte in text[at : at + 1]) + text[at + 1 :]
    return text[:at] + (change.text[:3].encode() + text[at:] if change.how == "insert" else b"")


def lengthened(text: bytes) -> bytes:
    for name, meant in (LONG | MANY).items():
        text = text.replace(name.encode(), meant.encode())
    return text


def content(kind: Kind, garbage: Whole | Damaged) -> bytes:
    if isinstance(garbage, Whole):
        return lengthened(garbage.text)
    document = copy.deepcopy(kind.documents[garbage.document % len(kind.documents)])
    to_bytes = [change for change in garbage.changes if change.how in ("flip", "cut", "insert")]
    for change in garbage.changes:
        if change not in to_bytes:
            edit(document, change)
    return functools.reduce(changed, to_bytes, lengthened(kind.spelled(document).encode()))


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Kind, Path]:
    """A kind of file, and where to write it."""
    kind = KINDS[request.param]
    path = tmp_path_factory.mktemp(request.param) / kind.name
    for document in kind.documents:  # and what is compiled once is compiled
        path.write_text(kind.spelled(document))
        kind.reads(path)
    return kind, path


@given(WHOLE | DAMAGED)
@example(Whole(b'{"extend": "hover", @word: "a message that is too long"}'))
@example(Whole(b'{"extend": "hover", "\\u001b[2J": "a message that clears the screen"}'))
@example(Whole(b"@deep"))
@example(Whole(b"@many"))
@example(Whole(b"\x80"))
@example(Whole(b'{"task": "hovr"}'))
@example(Whole(b'{"extend": "hover", "preset": "hovr"}'))
@example(Whole(b'{"task": {"name": "../../x", "spec": {"extend": "hover"}}}'))
@example(Whole(b'{"task": {"name": "a\\u0000", "spec": {"extend": "hover"}}}'))
@example(Whole(b'{"learner": {"observation_scale": [1]}}'))
@example(Whole(b'{"seeds": 2147483647}'))
@example(Whole(b'{"seed": 2147483647, "seeds": 2}'))
@example(Whole(b'{"task": "hover", "axes": {"gamma": [0.9]}, "seeds": @power}'))
@example(Whole(b'{"task": "hover", "axes": {"gamma": @range, "lam": @range}}'))  # 10^12 points
@example(Damaged(0, [Change("delete", 0)]))  # a table without its header, among others
@example(Damaged(0, [Change("value", 14, 0, "Infinity")]))  # seconds
@example(Damaged(0, [Change("flip", 63)]))  # a column of another name
@example(Damaged(0, [Change("flip", 233)]))  # a number of another value
def test_any_file_is_read_or_refused_in_a_line(kind: tuple[Kind, Path], garbage: Whole | Damaged) -> None:
    """Nothing else is raised, nothing hangs, and what is read can start."""
    loader, path = kind
    path.write_bytes(content(loader, garbage))
    try:
        loader.reads(path)
    except loader.refusal as error:
        line = str(error)
        assert line.isprintable(), line
        assert str(path) in line, line
        assert len(line) - len(str(path)) <= LONGEST, len(line)

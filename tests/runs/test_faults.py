"""Whatever happens to disk, folder or checkpoints: it is said in one line, and nothing already saved is harmed."""

import functools
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from brax.envs.base import Env
from hypothesis import given, settings
from hypothesis import strategies as st

import fault_injection
from cli_helpers import qrl
from fault_injection import REPORTS, STEPS, TORTURE, TRAIN, Ended
from qrl.runs import checkpoint, files
from qrl.runs.checkpoint import Checkpoint
from qrl.runs.integrity import FORMAT, NAME, Damaged, Foreign, Record
from qrl.training import driver, restore
from qrl.training.state import TrainState, member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds
from small_run import run_config, train

FAULTS: list[str] = []  # injected so far; fuzzed files, which hypothesis counts, are not among them


@pytest.fixture(scope="module", autouse=True)
def _count(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    fault_injection.tell(request, f"{len(FAULTS)} faults, 0 lost updates")


@pytest.fixture(scope="module")
def pendulum() -> Env:
    return worlds.make("pendulum")


@pytest.fixture(scope="module")
def like(pendulum: Env) -> TrainState:
    """Shapes and types of the state of a run of one seed."""
    learner = run_config().learner
    return restore.abstract_states(make_trainer(pendulum, learner), stack([member_inputs(pendulum, learner)]))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, pendulum: Env) -> Path:
    """A run with checkpoints at 200, 400 … 1200 (one of them goes, unless it is the best)."""
    out = tmp_path_factory.mktemp("small") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "CHUNK_SECONDS", 1e-4)
        train(out, run_config(), pendulum)
    return out


def copy(run: Path, to: Path) -> Path:
    shutil.rmtree(to, ignore_errors=True)
    return shutil.copytree(run, to)


def newest(run: Path) -> Path:
    return run / "checkpoints" / str(checkpoint.steps(run)[0])


def all_files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


# -- damage --------------------------------------------------------------------------------------------------


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def replace_by_a_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGE: list[Callable[[Path], None]] = [truncate, flip, empty, Path.unlink, replace_by_a_directory]


def does_nothing(how: Callable[[Path], None], path: Path) -> bool:
    """Some of Orbax's files are empty."""
    return path.stat().st_size == 0 and how in (truncate, flip, empty)


_READ: dict[tuple[Path, int], Checkpoint] = {}


def assert_restores(run: Path, env_steps: int, like: TrainState, small: Path) -> list[str]:
    """`latest` gives this checkpoint, equal to what the whole run holds; its notes."""
    found = restore.restore_common([run], [run_config()], like)
    assert found.env_steps == env_steps
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), like)
    wanted = (
        checkpoint.read(small, run_config(), env_steps, one)
        if (small, env_steps) not in _READ
        else _READ[small, env_steps]
    )
    _READ[small, env_steps] = wanted
    for a, b in zip(jax.tree.leaves(found.states), jax.tree.leaves(wanted.state), strict=True):
        np.testing.assert_array_equal(a[0], b)
    assert found.records == [wanted.record]
    return found.notes


@pytest.mark.parametrize("how", DAMAGE, ids=lambda how: how.__name__)
def test_damaged_checkpoint_is_found_and_the_one_before_used(
    tmp_path: Path, small: Path, like: TrainState, how: Callable[[Path], None]
) -> None:
    """Every file of the newest one: named in a note, the rest set aside as it is, the one before restored."""
    last, before = checkpoint.steps(small)[:2]
    names = all_files(newest(small))
    for name in names if TORTURE else {*names[DAMAGE.index(how) :: 4], NAME}:
        run = copy(small, tmp_path / "run")
        victim = newest(run) / name
        if does_nothing(how, victim):
            continue
        how(victim)
        FAULTS.append(f"{how.__name__} {name}")
        left = fault_injection.digest(newest(run)) if name != NAME or how != Path.unlink else None
        notes = assert_restores(run, before, like, small)
        assert str(last) not in [path.name for path in (run / "checkpoints").iterdir()]
        if left is not None:  # what has no seal counts for nothing, and needs no word
            assert len(notes) == 1
            assert f"checkpoints/{last}" in notes[0]
            assert Path(name).name in notes[0]
            assert f"going on from the checkpoint at step {before:,}" in notes[0]
            assert fault_injection.digest(run / "checkpoints" / f"aside-{last}") == left
        if TORTURE:
            assert assert_restores(run, before, like, small) == []  # and once more: nothing is left to say


def test_all_damaged_starts_afresh(tmp_path: Path, small: Path, like: TrainState) -> None:
    """It is said of each, and what there is stays, set aside."""
    run = copy(small, tmp_path / "run")
    for i, env_steps in enumerate(checkpoint.steps(run)):
        DAMAGE[i % 3](run / "checkpoints" / str(env_steps) / NAME)
        FAULTS.append(f"all damaged: {env_steps}")
    found = restore.restore_common([run], [run_config()], like)
    assert (found.env_steps, found.states, found.records) == (0, None, [])
    assert len(found.notes) == len(checkpoint.steps(small))
    assert all("starting afresh" in note for note in found.notes)
    aside = {path.name for path in (run / "checkpoints").iterdir()}
    assert aside == {f"aside-{env_steps}" for env_steps in checkpoint.steps(small)}


def test_newest_step_that_is_whole_for_all_seeds_is_used(tmp_path: Path, small: Path, like: TrainState) -> None:
    """One seed lacks the last, the other's last but one is damaged: both go on from the one before these."""
    first, second = copy(small, tmp_path / "first"), copy(small, tmp_path / "second")
    last, other, both = checkpoint.steps(small)[:3]
    (first / "checkpoints" / str(last) / NAME).unlink()
    flip(second / "checkpoints" / str(other) / NAME)
    FAULTS.extend(["no seal of one seed", "damage of the other"])
    pair = jax.tree.map(lambda x: jax.ShapeDtypeStruct((2, *x.shape[1:]), x.dtype), like)
    found = restore.restore_common([first, second], [run_config()] * 2, pair)
    assert found.env_steps == both
    assert len(found.notes) == 1
    assert str(second) in found.notes[0]
    assert [len(record.rows) for record in found.records] == [both // 200] * 2
    assert checkpoint.steps(first)[0] == checkpoint.steps(second)[0] == both


def test_killed_while_a_checkpoint_is_removed(tmp_path: Path, small: Path, like: TrainState) -> None:
    """Any number of its files are gone, the seal first or not: it is passed over."""
    before = checkpoint.steps(small)[1]
    names = [NAME, *[name for name in all_files(newest(small)) if name != NAME]]
    for order in (names, names[::-1]):
        for count in range(1, len(names) + 1, 1 if TORTURE else 3):
            run = copy(small, tmp_path / "run")
            last = newest(run)
            for name in order[:count]:
                (last / name).unlink()
            FAULTS.append(f"{count} files removed")
            assert_restores(run, before, like, small)


def test_checkpoint_of_another_run_is_not_taken(small: Path, like: TrainState) -> None:
    """Of the same shapes, and of another seed or discount: nothing would notice but that it says whose it is."""
    before = fault_injection.digest(small)
    for other in (run_config(seed=1), run_config(gamma=0.5)):
        FAULTS.append("another run's checkpoint")
        with pytest.raises(Foreign, match=r"of another run than config\.json"):
            restore.restore_common([small], [other], like)
    assert fault_injection.digest(small) == before


def test_folder_made_anew_is_not_written_to(tmp_path: Path) -> None:
    """Removed, and made again by somebody else while the run goes on: it is theirs."""
    folder = tmp_path / "run"
    folder.mkdir()
    writer = checkpoint.Writer(folder, run_config())
    save(folder, writer, [{"env_steps": 1, "success": 0.0, "return_mean": 0.0}])
    shutil.rmtree(folder)
    folder.mkdir()
    FAULTS.append("folder made anew")
    with pytest.raises(OSError, match="the run folder is gone"):
        writer.check()
    with pytest.raises(OSError, match="the run folder is gone"):
        save(folder, writer, [{"env_steps": 2, "success": 0.0, "return_mean": 0.0}])
    writer.close()
    assert list(folder.iterdir()) == []


def save(folder: Path, writer: checkpoint.Writer, rows: list[dict[str, float | int]]) -> None:
    state = {"step": np.int32(rows[-1]["env_steps"])}
    writer.save(Checkpoint(int(rows[-1]["env_steps"]), state, Record(rows=rows, train_seconds=0, report_seconds=0)))
    writer.wait()


@pytest.mark.parametrize("resume_after", [0, 4, 8])
@pytest.mark.parametrize(
    ("reports", "best"),
    [
        ([(0.0, -9), (0.5, -5), (0.5, -4), (0.4, -1), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0)], 3),
        ([(np.nan, r) for r in (-9, -1, -8, -7, -6, -5, -5, -4, -3, -2)], 2),  # a foreign world: no success
        ([(0.0, np.nan), (0.0, -3), *[(0.0, np.nan)] * 8], 2),
    ],
    ids=["success, then return", "return alone", "no number is the worst"],
)
def test_the_last_five_and_the_best_are_kept(
    tmp_path: Path, reports: list[tuple[float, float]], best: int, resume_after: int
) -> None:
    """A resume forgets none of it."""
    rows: list[dict[str, float | int]] = []
    writer = checkpoint.Writer(tmp_path, run_config())
    for i, (success, value) in enumerate(reports, start=1):
        rows.append({"env_steps": i, "success": success, "return_mean": value})
        save(tmp_path, writer, rows)
        if i == resume_after:
            writer.close()
            found = checkpoint.read(tmp_path, run_config(), i, {"step": jax.ShapeDtypeStruct((), np.int32)})
            rows = list(found.record.rows)
            writer = checkpoint.Writer(tmp_path, run_config())
    writer.close()
    assert checkpoint.steps(tmp_path) == [10, 9, 8, 7, 6, best]


# -- fuzz ----------------------------------------------------------------------------------------------------

NASTY = st.sampled_from(
    ["", "../../../../etc/passwd", "/etc/passwd", "..", ".", "state", "a\nb", "a\0b", "\ud800", "x" * 5000, "nan"]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | NASTY | st.just(10**400),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text() | NASTY, inner, max_size=4),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def victim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sealed checkpoint at step 7."""
    folder = tmp_path_factory.mktemp("victim")
    writer = checkpoint.Writer(folder, run_config())
    state = {"weights": np.arange(6, dtype=np.float32).reshape(2, 3), "step": np.int32(7)}
    rows: list[dict[str, float | int]] = [{"env_steps": 7, "success": float("nan"), "return_mean": -1.5}]
    writer.save(Checkpoint(7, state, Record(rows=rows, train_seconds=1.25, report_seconds=0.5)))
    writer.wait()
    writer.close()
    return folder


LIKE = {"weights": jax.ShapeDtypeStruct((2, 3), np.float32), "step": jax.ShapeDtypeStruct((), np.int32)}


class Part(NamedTuple):
    weights: Any = None
    step: Any = None
    bias: Any = None


def test_a_part_is_read_alone(victim: Path) -> None:
    """What is asked for, whatever lies beside it."""

    def read(part: Part) -> Part:
        return checkpoint.read(victim, run_config(), 7, part, part=True).state

    np.testing.assert_array_equal(read(Part(weights=LIKE["weights"])).weights, np.arange(6).reshape(2, 3))
    assert read(Part(step=LIKE["step"])) == Part(step=7)


@pytest.mark.parametrize("part", [False, True])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"weights": jax.ShapeDtypeStruct((3, 2), np.float32)}, r"weights is float32\[2, 3\], not float32\[3, 2\]"),
        ({"step": jax.ShapeDtypeStruct((), np.float32)}, r"step is int32\[\], not float32\[\]"),
        ({"bias": jax.ShapeDtypeStruct((), np.int32)}, "bias"),
        ({"weights": {"kernel": jax.ShapeDtypeStruct((2, 3), np.float32)}}, "weights"),
    ],
)
def test_another_state_is_foreign(victim: Path, change: dict[str, Any], says: str, part: bool) -> None:
    """Another shape, another type, a leaf that is not there or has another name, in all of it or in a part."""
    with pytest.raises(Foreign, match=f"of another version of qrl.*{says}"):
        checkpoint.read(victim, run_config(), 7, {**LIKE, **change}, part=part)


def test_a_resume_leaves_nothing_unread(victim: Path) -> None:
    with pytest.raises(Foreign, match=r"of another version of qrl.*weights"):
        checkpoint.read(victim, run_config(), 7, {"step": LIKE["step"]})
    assert checkpoint.read(victim, run_config(), 7, {"step": LIKE["step"]}, part=True).state == {"step": 7}


def read_or_complaint(folder: Path) -> Checkpoint | str:
    try:
        return checkpoint.read(folder, run_config(), 7, LIKE)
    except (Damaged, Foreign) as error:
        return str(error)


def read_cleanly(folder: Path) -> bool:
    """Whether the checkpoint can be read; it is then what was saved, and otherwise one line says what is wrong."""
    found = read_or_complaint(folder)
    if isinstance(found, str):
        assert "\n" not in found
        assert len(found) < len(str(folder)) + 300
        assert found.startswith(str(folder / "checkpoints" / "7"))
        return False
    np.testing.assert_array_equal(found.state["weights"], np.arange(6).reshape(2, 3))
    assert found.state["step"] == 7
    assert found.record.rows[0]["return_mean"] == -1.5
    assert (found.record.train_seconds, found.record.report_seconds) == (1.25, 0.5)
    return True


def places(data: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value."""
    inner = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [at, *[place for key, value in inner for place in places(value, (*at, key))]]


def put(data: Any, at: tuple[Any, ...], value: Any) -> Any:
    if not at:
        return value
    data[at[0]] = put(data[at[0]], at[1:], value)
    return data


@functools.cache
def sealed(victim: Path) -> bytes:
    return (victim / "checkpoints" / "7" / NAME).read_bytes()


def with_seal(victim: Path, data: bytes) -> bool:
    path = victim / "checkpoints" / "7" / NAME
    original = sealed(victim)
    path.write_bytes(data)
    try:
        return read_cleanly(victim)
    finally:
        path.write_bytes(original)


def mutated(draw: st.DrawFn, data: bytes) -> bytes:
    """Some bytes changed, left out or put in, or an end cut off."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        out = draw(st.integers(0, 4) | st.just(len(data)))
        data = data[:at] + draw(st.binary(max_size=4)) + data[at + out :]
    return data


@settings(deadline=None)
@given(st.data())
def test_seal_of_other_bytes(victim: Path, data: st.DataObject) -> None:
    """Changed anywhere, it is refused in one line, or reads as what was saved."""
    with_seal(victim, mutated(data.draw, sealed(victim)))


@settings(deadline=None)
@given(st.data())
def test_seal_of_other_json(victim: Path, data: st.DataObject) -> None:
    """Any JSON in any place of it: refused in one line, or no change at all."""
    seal = json.loads(sealed(victim))
    at = data.draw(st.sampled_from(places(seal)))
    text = json.dumps(put(seal, at, data.draw(JSON)))
    if data.draw(st.booleans()):
        seal = put(seal, at, {**seal, data.draw(NASTY): 1} if not at else data.draw(NASTY))
        text = json.dumps(seal)
    with_seal(victim, text.encode())


@settings(deadline=None)
@given(st.one_of(st.text() | NASTY, st.sampled_from([*all_files(Path(__file__).parent)[:1], "state/_METADATA"])))
def test_seal_that_names_other_files(victim: Path, name: str) -> None:
    """A path that leads out of the checkpoint is not followed."""
    seal = json.loads(sealed(victim))
    seal["sha256"][name] = "0" * 64
    assert not with_seal(victim, json.dumps(seal).encode())


@settings(deadline=None)
@given(st.one_of(st.integers(), st.integers(2), st.floats(), st.booleans(), st.sampled_from([10**4299, 1e400])))
def test_seal_of_another_format(victim: Path, number: float) -> None:
    """It is not read, but for the number itself."""
    seal = json.loads(sealed(victim))
    seal["format"] = number
    assert with_seal(victim, json.dumps(seal).encode()) == (type(number) in (int, float) and number == FORMAT)


@pytest.mark.parametrize("depth", [10, 1_000, 100_000])
@pytest.mark.parametrize(
    "begin", ["[", '{"a":', f'{{"format":{FORMAT},"record":[', f'{{"format":{FORMAT},"sha256":{{"a":[']
)
def test_seal_of_great_depth(victim: Path, depth: int, begin: str) -> None:
    assert not with_seal(victim, (begin * depth).encode())


@settings(deadline=None)
@given(st.data())
def test_other_files_of_other_bytes(victim: Path, data: st.DataObject) -> None:
    """Not one of them reaches Orbax."""
    path = victim / "checkpoints" / "7"
    name = data.draw(st.sampled_from([name for name in all_files(path) if name != NAME]))
    original = (path / name).read_bytes()
    changed = mutated(data.draw, original)
    (path / name).write_bytes(changed)
    try:
        assert read_cleanly(victim) == (changed == original)
    finally:
        (path / name).write_bytes(original)


# -- the command line ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fault_injection.whole_run(tmp_path_factory)


LATE = STEPS * 9 // REPORTS  # of what is kept to the end, two are not later


def refused(capfd: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """The one line of exit code 2; from a process of its own where all is run."""
    if TORTURE:
        return fault_injection.complaint(fault_injection.qrl(*words), 2)
    capfd.readouterr()
    code = qrl(*words)
    captured = capfd.readouterr()
    return fault_injection.complaint(Ended(code, captured.out, captured.err), 2)


@pytest.fixture
def stopped(tmp_path: Path, whole: Path) -> Path:
    """A run that has come some way."""
    return fault_injection.unfinished(whole, tmp_path / "stopped", LATE)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["hover"], "not the same task"),
        (
            ["pendulum", *TRAIN[2:], "--policy-hidden-layer-sizes", "[16]"],
            "key 'learner.policy_hidden_layer_sizes' is (8,), asked for (16,)",
        ),
        (["pendulum", "--seed", "7"], "key 'seed' is 0, found 7"),
    ],
    ids=["task", "network", "seed"],
)
def test_resume_of_something_else_touches_nothing(
    capfd: pytest.CaptureFixture[str], stopped: Path, words: list[str], says: str
) -> None:
    before = fault_injection.digest(stopped)
    FAULTS.append(says)
    assert says in refused(capfd, "train", *words, "--out", stopped, "--resume")
    assert fault_injection.digest(stopped) == before


@pytest.mark.parametrize(("number", "when"), [(FORMAT + 1, "a later"), (FORMAT - 1, "an earlier")])
def test_checkpoint_of_another_format_touches_nothing(
    capfd: pytest.CaptureFixture[str], stopped: Path, number: int, when: str
) -> None:
    """This version must not read it, and must not take it for a damaged one either."""
    seal = newest(stopped) / NAME
    data = json.loads(seal.read_text())
    seal.write_text(json.dumps({**data, "format": number, "more": []}))
    before = fault_injection.digest(stopped)
    FAULTS.append("another format")
    assert f"of {when} version of qrl (format {number};" in refused(capfd, *TRAIN, "--out", stopped, "--resume")
    assert fault_injection.digest(stopped) == before


def test_checkpoint_of_another_network_touches_nothing(
    capfd: pytest.CaptureFixture[str], stopped: Path, small: Path
) -> None:
    """Whole, sealed, and of a run with other shapes."""
    shutil.copytree(newest(small), stopped / "checkpoints" / str(STEPS))
    before = fault_injection.digest(stopped)
    FAULTS.append("checkpoint of another network")
    assert "of another run than config.json" in refused(capfd, *TRAIN, "--out", stopped, "--resume")
    assert fault_injection.digest(stopped) == before


def test_second_process_on_a_folder_is_refused(capfd: pytest.CaptureFixture[str], stopped: Path) -> None:
    """While another holds the lock; with it gone, the folder can be had."""
    before = fault_injection.digest(stopped)
    FAULTS.append("second process")
    with files.locked(stopped / "lock", "busy"):
        line = refused(capfd, *TRAIN, "--out", stopped, "--resume")
    assert f"{stopped}: another process is at work in it" in line
    assert fault_injection.digest(stopped) == before
    with files.locked(stopped / "lock", "busy"):
        pass


def goes_on(run: Path, whole: Path) -> None:
    """Resumed, it ends as a run that never met the fault; in a process of its own where all is run."""
    words = [*TRAIN, "--out", run, "--resume"]
    if TORTURE:
        fault_injection.done(fault_injection.qrl(*words))
    else:
        assert qrl(*words) == 0
    fault_injection.assert_same_run(run, whole)


def sealed_steps(folder: Path) -> int:
    return len(checkpoint.steps(folder)) if (folder / "checkpoints").is_dir() else 0


def test_full_disk_at_the_first_checkpoint(tmp_path: Path, whole: Path) -> None:
    """One line and exit code 1; with more room the run goes on and ends as one that never met it."""
    with fault_injection.small_disk(tmp_path / "disk", "1m") as disk:
        words = [*TRAIN, "--out", disk.path / "run"]
        FAULTS.append("disk full at the first checkpoint")
        line = fault_injection.complaint(fault_injection.qrl(*words, inside=disk.inside), 1)
        assert "the checkpoint could not be written (No space left on device)" in line
        assert sealed_steps(disk.seen / "run") == 0
        disk.remount("size=20m")
        goes_on(disk.seen / "run", whole)


@pytest.mark.parametrize("room", ["some", *(["none"] if TORTURE else [])])
def test_full_disk_after_several_checkpoints(tmp_path: Path, whole: Path, room: str) -> None:
    """Those that were made stay readable, and with more room the run goes on from the last of them."""
    with fault_injection.small_disk(tmp_path / "disk", "20m") as disk:
        run = fault_injection.unfinished(whole, disk.seen / "run", LATE)
        before = {name: value for name, value in fault_injection.digest(run).items() if name.startswith("checkpoints/")}
        disk.remount(f"size={used_kib(disk.seen) + 900}k")
        words = [*TRAIN, "--out", disk.path / "run", "--resume"]
        FAULTS.append(f"full disk, {room} left")
        process = fault_injection.start(*words, inside=disk.inside)
        if room == "none":
            fault_injection.wait_for(process, lambda: len(list((run / "tensorboard").iterdir())) > 1)
            disk.fill()
        assert str(disk.path / "run") in fault_injection.complaint(fault_injection.end(process), 1)
        left = fault_injection.digest(run)
        assert before.items() <= left.items()
        assert checkpoint.steps(run)[0] == LATE
        disk.remount("size=40m")
        goes_on(run, whole)


def used_kib(path: Path) -> int:
    at = os.statvfs(path)
    return (at.f_blocks - at.f_bfree) * at.f_frsize // 1024


@pytest.mark.skipif(not TORTURE, reason="part of make torture")
@pytest.mark.parametrize("name", ["metrics.csv", "summary.json", "learning_curve.png", "flight.png", "tensorboard"])
def test_file_that_cannot_be_written(tmp_path: Path, whole: Path, name: str) -> None:
    """A directory is in its place: one line names it, and once it is gone the run ends as if it had never been."""
    run = fault_injection.unfinished(whole, tmp_path / "run", LATE)
    if name == "tensorboard":
        shutil.rmtree(run / name)
        (run / name).write_text("")
    else:
        (run / name).unlink(missing_ok=True)
        (run / name / "inside").mkdir(parents=True)
    FAULTS.append(f"{name} in the way")
    words = [*TRAIN, "--out", run, "--resume"]
    assert str(run / name) in fault_injection.complaint(fault_injection.qrl(*words), 1)
    shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()
    goes_on(run, whole)


SAVED = "checkpoints/"


def saved(run: Path) -> dict[str, str]:
    return {name: value for name, value in fault_injection.digest(run).items() if name.startswith(SAVED)}


@pytest.mark.parametrize("when", ["before", *(["compiling", "training"] if TORTURE else [])])
def test_folder_that_becomes_read_only(tmp_path: Path, whole: Path, when: str) -> None:
    """One line names what could not be written; everything saved is as it was."""
    with fault_injection.small_disk(tmp_path / "disk", "20m") as disk:
        run = fault_injection.unfinished(whole, disk.seen / "run", LATE)
        if when == "training":
            checkpoint.clear_after(run, 0)
        before = saved(run)
        words = [*TRAIN, "--out", disk.path / "run", "--resume"]
        FAULTS.append(f"read-only: {when}")
        events = len(list((run / "tensorboard").iterdir()))
        if when == "before":
            disk.read_only("run")
        process = fault_injection.start(*words, inside=disk.inside)
        if when == "compiling":
            fault_injection.wait_for(process, lambda: len(list((run / "tensorboard").iterdir())) > events)
        if when == "training":
            fault_injection.wait_for(process, lambda: sealed_steps(run) > 0)
        if when != "before":
            disk.read_only("run")
        line = fault_injection.complaint(fault_injection.end(process), 1)
        assert str(disk.path / "run") in line
        assert "Read-only file system" in line
        assert before.items() <= saved(run).items()
        disk.read_only("run", undo=True)
        goes_on(run, whole)


@pytest.mark.parametrize("how", ["moved", *(["removed"] if TORTURE else [])])
def test_folder_that_vanishes_while_training(tmp_path: Path, whole: Path, how: str) -> None:
    """One line; no run is made in its place. Moved back, the run goes on."""
    run, away = tmp_path / "run", tmp_path / "away"
    words = [*TRAIN, "--out", run, "--resume"]
    process = fault_injection.start(*words)
    fault_injection.wait_for(process, lambda: sealed_steps(run) > 0)
    run.rename(away)
    FAULTS.append(f"vanished: {how}")
    kept = checkpoint.steps(away)
    if how == "removed":
        shutil.rmtree(away)
    assert str(run) in fault_injection.complaint(fault_injection.end(process), 1)
    if run.exists():  # in the midst of a save, Orbax makes its own way
        assert [path.name for path in run.iterdir()] == ["checkpoints"]
        assert sealed_steps(run) == 0
        shutil.rmtree(run)
    if how == "moved":
        assert checkpoint.steps(away)[-len(kept) :] == kept
        away.rename(run)
    goes_on(run, whole)

"""Checkpoints: every damage is detected and named, valid ones are used and kept, others are refused in one line."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fault_injection import digest
from qrl.runs import checkpoint, integrity, orbax_files
from qrl.runs.checkpoint import Checkpoint, Record
from qrl.runs.files import Row
from qrl.runs.integrity import FORMAT, MANIFEST, CorruptCheckpoint, IncompatibleCheckpoint
from qrl.training import restore
from small_run import run_config

TARGET = {"weights": jax.ShapeDtypeStruct((2, 3), np.float32), "step": jax.ShapeDtypeStruct((), np.int32)}
STEPS = [1, 2, 3]


def batched(members: int) -> dict[str, jax.ShapeDtypeStruct]:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((members, *x.shape), x.dtype), TARGET)


def checkpoint_at(step: int, reports: list[tuple[float, float]] | None = None) -> Checkpoint:
    reports = reports or [(0.0, -1.5 * i) for i in range(1, step + 1)]
    rows: list[Row] = [{"env_steps": i, "success": s, "return_mean": r} for i, (s, r) in enumerate(reports[:step], 1)]
    state = {"weights": np.arange(step, step + 6, dtype=np.float32).reshape(2, 3), "step": np.int32(step)}
    return Checkpoint(step, state, Record(rows, train_seconds=1.25 * step, report_seconds=0.5))


def save(folder: Path, *checkpoints: Checkpoint) -> Path:
    folder.mkdir(exist_ok=True)
    writer = checkpoint.Writer(folder, run_config(), ThreadPoolExecutor(1))
    for one in checkpoints:
        writer.save(one)
    writer.wait()
    writer.close()
    return folder


def assert_equal(found: Checkpoint, step: int) -> None:
    wanted = checkpoint_at(step)
    assert found.env_steps == step
    assert found.record == wanted.record
    for name, leaf in wanted.state.items():
        assert found.state[name].dtype == leaf.dtype
        np.testing.assert_array_equal(found.state[name], leaf)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints at STEPS."""
    return save(tmp_path_factory.mktemp("saved") / "run", *map(checkpoint_at, STEPS))


@pytest.fixture
def run(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "run")


def at(folder: Path, step: int) -> Path:
    return folder / "checkpoints" / str(step)


def all_files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def latest(*folders: Path) -> restore.Restored:
    return restore.restore_common(list(folders), [run_config()] * len(folders), batched(len(folders)))


def assert_resumes(found: restore.Restored, step: int) -> None:
    states: Any = found.states
    assert found.records
    for i, record in enumerate(found.records):
        state = {name: leaf[i] for name, leaf in states.items()}
        assert_equal(Checkpoint(found.env_steps, state, record), step)


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


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: damage.__name__)
def test_corrupt_checkpoint_is_named_and_quarantined_and_the_one_before_used(
    tmp_path: Path, saved: Path, damage: Callable[[Path], None]
) -> None:
    """Any damage to any file."""
    for name in all_files(at(saved, 3)):
        if (at(saved, 3) / name).stat().st_size == 0 and damage in (truncate, flip, empty):
            continue  # no change
        run = shutil.copytree(saved, tmp_path / name.replace("/", "."))
        damage(at(run, 3) / name)
        before = digest(at(run, 3))
        found = latest(run)
        assert_resumes(found, 2)
        assert not at(run, 3).exists()
        if name == MANIFEST and damage == Path.unlink:  # was never complete
            assert found.notes == []
            continue
        (note,) = found.notes
        assert str(at(run, 3)) in note
        assert Path(name).name in note
        assert digest(run / "checkpoints" / "corrupt-3") == before
        assert latest(run).notes == []


def test_with_every_checkpoint_corrupt_training_starts_from_scratch(run: Path) -> None:
    for damage, step in zip(DAMAGE, STEPS, strict=False):
        damage(at(run, step) / MANIFEST)
    found = latest(run)
    assert (found.env_steps, found.states, found.records) == (0, None, [])
    assert [str(at(run, step)) in note for step, note in zip(STEPS[::-1], found.notes, strict=True)] == [True] * 3
    assert {path.name for path in (run / "checkpoints").iterdir()} == {f"corrupt-{step}" for step in STEPS}


def test_the_last_step_valid_for_all_seeds_is_used(tmp_path: Path, run: Path, saved: Path) -> None:
    """One seed lacks the last, the last but one of the other is corrupt."""
    other = shutil.copytree(saved, tmp_path / "other")
    (at(run, 3) / MANIFEST).unlink()
    flip(at(other, 2) / MANIFEST)
    found = latest(run, other)
    assert_resumes(found, 1)
    assert len(found.records) == 2
    (note,) = found.notes
    assert str(other) in note
    assert checkpoint.saved_steps(run) == checkpoint.saved_steps(other) == [1]


@pytest.mark.parametrize(
    ("place", "name"), [(Path, "read_bytes"), (integrity, "_sha256"), (orbax_files, "read_record")]
)
def test_a_fault_of_the_disk_is_no_corruption(
    run: Path, monkeypatch: pytest.MonkeyPatch, place: Any, name: str
) -> None:
    """In a manifest, a file, or while Orbax reads. Nothing is changed: the next command may read it."""

    def fail(*_: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    before = digest(run)
    with monkeypatch.context() as patch:
        patch.setattr(place, name, fail)
        with pytest.raises(OSError, match=rf"^{at(run, 3)}.*: cannot be read \(Input/output error\)$") as raised:
            latest(run)
    assert not isinstance(raised.value, CorruptCheckpoint)
    assert digest(run) == before
    assert_resumes(latest(run), 3)


@pytest.mark.parametrize("name", ["checkpoints", "state"])
def test_a_folder_that_cannot_be_read_is_not_empty(run: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    before = digest(run)
    with monkeypatch.context() as patch:
        for inner in (os.listdir, os.scandir):

            def denied(path: Any = ".", inner: Callable[[Any], Any] = inner) -> Any:
                if Path(path).name == name:
                    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
                return inner(path)

            patch.setattr(os, inner.__name__, denied)
        with pytest.raises(PermissionError, match=name):
            latest(run)
    assert digest(run) == before


def test_a_step_that_was_skipped_is_kept(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if a moment later it is as it was written."""
    before, read = digest(at(run, 3)), checkpoint.read

    def corrupt_once(folder: Path, of: Any, env_steps: int, target: Any) -> Checkpoint:
        if env_steps == 3:
            raise CorruptCheckpoint(f"{at(run, 3)}: is corrupt")
        return read(folder, of, env_steps, target)

    monkeypatch.setattr(checkpoint, "read", corrupt_once)
    assert_resumes(latest(run), 2)
    assert digest(run / "checkpoints" / "corrupt-3") == before


@pytest.mark.parametrize("first", [True, False])
def test_a_half_removed_checkpoint_is_not_used(run: Path, saved: Path, first: bool) -> None:
    """Killed while it was removed, the manifest first or last."""
    names = [name for name in all_files(at(saved, 3)) if name != MANIFEST]
    for count in range(1, len(names), 3):
        shutil.rmtree(run)
        shutil.copytree(saved, run)
        for name in [*([MANIFEST] if first else []), *names[:count]]:
            (at(run, 3) / name).unlink()
        assert_resumes(latest(run), 2)


# -- other runs and versions ---------------------------------------------------------------------------------


def test_checkpoint_of_another_run_is_refused(saved: Path) -> None:
    """The shapes are the same; only the fingerprint differs."""
    before = digest(saved)
    for other in (run_config(seed=1), run_config(gamma=0.5)):
        with pytest.raises(IncompatibleCheckpoint, match=r"of another run than config\.json"):
            restore.restore_common([saved], [other], batched(1))
    assert digest(saved) == before


def test_checkpoint_of_another_format_is_refused(run: Path) -> None:
    """An older or newer one is neither read nor taken for a corrupt one; nothing is changed."""
    manifest = at(run, 3) / MANIFEST
    data = json.loads(manifest.read_text())
    for number, when in ((FORMAT + 1, "a later"), (FORMAT - 1, "an earlier")):
        manifest.write_text(json.dumps({**data, "format": number, "more": []}))
        before = digest(run)
        with pytest.raises(IncompatibleCheckpoint, match=f"by {when} version of qrl .format {number}; this one reads"):
            latest(run)
        assert digest(run) == before
    manifest.rename(manifest.with_name("seal.json"))
    before = digest(run)
    with pytest.raises(IncompatibleCheckpoint, match="by an earlier version of qrl"):
        latest(run)
    assert digest(run) == before


class Part(NamedTuple):
    weights: Any = None
    step: Any = None
    bias: Any = None


def test_a_part_is_read_alone(saved: Path) -> None:
    def read(part: Part) -> Part:
        return checkpoint.read(saved, run_config(), 3, part, part=True).state

    np.testing.assert_array_equal(read(Part(weights=TARGET["weights"])).weights, checkpoint_at(3).state["weights"])
    assert read(Part(step=TARGET["step"])) == Part(step=3)


@pytest.mark.parametrize("part", [False, True])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": jax.ShapeDtypeStruct((3, 2), np.float32)}, r"weights is float32\[2, 3\], not float32\[3, 2\]"),
        ({"step": jax.ShapeDtypeStruct((), np.float32)}, r"step is int32\[\], not float32\[\]"),
        ({"bias": jax.ShapeDtypeStruct((), np.int32)}, "bias is missing"),
        ({"weights": {"kernel": jax.ShapeDtypeStruct((2, 3), np.float32)}}, r"weights.* is (missing|unknown)"),
    ],
    ids=["shape", "type", "missing", "renamed"],
)
def test_another_state_is_refused(saved: Path, change: dict[str, Any], message: str, part: bool) -> None:
    with pytest.raises(IncompatibleCheckpoint, match=f"of another version of qrl.*{message}"):
        checkpoint.read(saved, run_config(), 3, {**TARGET, **change}, part=part)


def test_a_resume_leaves_nothing_unread(saved: Path) -> None:
    with pytest.raises(IncompatibleCheckpoint, match="weights is unknown"):
        checkpoint.read(saved, run_config(), 3, {"step": TARGET["step"]})


# -- writing -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lr=0.01,hidden=[64,64]", "[a]*?"])
def test_any_path_works(tmp_path: Path, name: str) -> None:
    """Orbax globs below the path that it is given, and does not escape it."""
    run = save(tmp_path / name, checkpoint_at(1), checkpoint_at(2))
    (run / "checkpoints" / "3.orbax-checkpoint-tmp").mkdir()  # of a killed process
    save(run, checkpoint_at(3))
    assert_equal(checkpoint.read(run, run_config(), 2, TARGET), 2)
    assert_equal(checkpoint.read(run, run_config(), 3, TARGET), 3)
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"1", "2", "3"}


@pytest.mark.parametrize("again", [True, False])
def test_a_removed_or_replaced_folder_is_not_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: bool
) -> None:
    """`again`: someone else has created it again. During a save, Orbax creates it again; it gets no manifest."""
    folder = save(tmp_path / "run", checkpoint_at(1))
    writer = checkpoint.Writer(folder, run_config(), ThreadPoolExecutor(1))

    def remove() -> None:
        shutil.rmtree(folder)
        if again:
            folder.mkdir()

    orbax_save = orbax_files.ocp.CheckpointManager.save
    with monkeypatch.context() as patch:
        patch.setattr(orbax_files.ocp.CheckpointManager, "save", lambda *a, **k: (orbax_save(*a, **k), remove()))
        writer.save(checkpoint_at(2))
        with pytest.raises(OSError, match="the run folder is gone"):
            writer.wait()
    assert not list(tmp_path.glob("run/*"))
    with pytest.raises(OSError, match="the run folder is gone"):
        writer.check()
    writer.close()


@pytest.mark.parametrize(
    ("resume_after", "reports", "best"),
    [
        (8, [(0.0, -9), (0.5, -5), (0.5, -4), (0.4, -1), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0)], 3),
        (4, [(np.nan, r) for r in (-9, -1, -8, -7, -6, -5, -5, -4, -3, -2)], 2),  # without success
        (0, [(0.0, np.nan), (0.0, -3), *[(0.0, np.nan)] * 8], 2),
    ],
    ids=["success, then return", "return alone", "NaN ranks last"],
)
def test_the_last_five_and_the_best_are_kept(
    tmp_path: Path, resume_after: int, reports: list[tuple[float, float]], best: int
) -> None:
    """Also over a resume."""
    each = [checkpoint_at(step, reports) for step in range(1, 11)]
    save(tmp_path, *each[:resume_after])
    save(tmp_path, *each[resume_after:])
    assert checkpoint.saved_steps(tmp_path) == [10, 9, 8, 7, 6, best]


# -- fuzz ----------------------------------------------------------------------------------------------------

NASTY = st.sampled_from(
    ["", "../../../../etc/passwd", "/etc/passwd", "..", ".", "state", "a\nb", "a\0b", "\ud800", "x" * 5000, "nan"]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | NASTY | st.just(10**400),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text() | NASTY, inner, max_size=4),
    max_leaves=8,
)


def reads(folder: Path) -> bool:
    """Whether the checkpoint at 3 can be read, as it was saved; otherwise one line names it."""
    try:
        found = checkpoint.read(folder, run_config(), 3, TARGET)
    except (CorruptCheckpoint, IncompatibleCheckpoint) as error:
        line = str(error)
        assert "\n" not in line
        assert len(line) < len(str(folder)) + 300
        assert line.startswith(str(at(folder, 3)))
        return False
    assert_equal(found, 3)
    return True


def reads_with(folder: Path, name: str, data: bytes) -> bool:
    path = at(folder, 3) / name
    original = path.read_bytes()
    path.write_bytes(data)
    try:
        return reads(folder)
    finally:
        path.write_bytes(original)


def mutated(draw: st.DrawFn, data: bytes) -> bytes:
    """Some bytes changed, removed or inserted, or an end cut off."""
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        out = draw(st.integers(0, 4) | st.just(len(data)))
        data = data[:place] + draw(st.binary(max_size=4)) + data[place + out :]
    return data


@settings(deadline=None)
@given(st.data())
def test_no_changed_file_is_read(saved: Path, data: st.DataObject) -> None:
    """Changed bytes of a manifest are refused in one line, or state the same; those of other files are refused."""
    name = data.draw(st.sampled_from([MANIFEST, *all_files(at(saved, 3))]))
    original = (at(saved, 3) / name).read_bytes()
    changed = mutated(data.draw, original)
    assert not (reads_with(saved, name, changed) and name != MANIFEST and changed != original)


@settings(deadline=None)
@given(st.data())
def test_manifest_of_other_json(saved: Path, data: st.DataObject) -> None:
    """Any JSON anywhere in it; a path that leads out of the checkpoint is not followed."""
    manifest = json.loads((at(saved, 3) / MANIFEST).read_text())
    files = manifest["sha256"]
    valid = False
    match data.draw(st.sampled_from(["all", "format", "sha256", "file", "more"])):
        case "all":
            manifest = data.draw(JSON)
        case "format":
            manifest["format"] = data.draw(JSON | st.integers(2, 4) | st.just(10**4299))
            valid = manifest["format"] == FORMAT
        case "sha256":
            manifest["sha256"] = data.draw(JSON)
            valid = manifest["sha256"] == {}
        case "file":
            files[data.draw(st.sampled_from(sorted(files)))] = data.draw(JSON)
        case _:
            files[data.draw(st.text() | NASTY)] = "0" * 64
    assert reads_with(saved, MANIFEST, json.dumps(manifest).encode()) == valid


@pytest.mark.parametrize("begin", ["[", '{"a":', f'{{"format":{FORMAT},"sha256":{{"a":['])
def test_manifest_of_great_depth(saved: Path, begin: str) -> None:
    for depth in (10, 100_000):
        assert not reads_with(saved, MANIFEST, (begin * depth).encode())

"""Faults of disk, folder and processes on the command line: one line names each, and no checkpoint is harmed."""

import errno
import fcntl
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import fault_injection
from cli_helpers import qrl
from fault_injection import REPORTS, STEPS, STRESS, TRAIN, Ended
from qrl.runs import checkpoint, files
from qrl.runs.integrity import MANIFEST

FAULTS: list[str] = []  # injected so far
LATE = STEPS * 9 // REPORTS  # two of the checkpoints that are kept to the end are not later


@pytest.fixture(scope="module", autouse=True)
def _count(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    fault_injection.tell(request, f"{len(FAULTS)} faults, 0 lost updates")


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fault_injection.whole_run(tmp_path_factory)


@pytest.fixture
def stopped(tmp_path: Path, complete: Path) -> Path:
    """A run that was stopped at LATE."""
    return fault_injection.unfinished(complete, tmp_path / "stopped", LATE)


def checkpoints(run: Path) -> dict[str, str]:
    return {name: value for name, value in fault_injection.digest(run).items() if name.startswith("checkpoints/")}


def events(run: Path) -> int:
    return len(list((run / "tensorboard").iterdir()))


def assert_refused(capfd: pytest.CaptureFixture[str], run: Path, message: str, *words: str) -> None:
    """A resume ends with exit code 2 and one line, and changes no file. In a process of its own under STRESS."""
    before = fault_injection.digest(run)
    FAULTS.append(message)
    command = [*(words or TRAIN), "--out", run, "--resume"]
    if STRESS:
        ended = fault_injection.qrl(*command)
    else:
        capfd.readouterr()
        code = qrl(*command)
        ended = Ended(code, *capfd.readouterr())
    assert message in fault_injection.complaint(ended, 2)
    assert fault_injection.digest(run) == before


def assert_resumes(run: Path, complete: Path) -> None:
    """Resumed, the run ends as one without a fault. In a process of its own under STRESS."""
    words = [*TRAIN, "--out", run, "--resume"]
    if STRESS:
        fault_injection.done(fault_injection.qrl(*words))
    else:
        assert qrl(*words) == 0
    fault_injection.assert_same_run(run, complete)


def failed(disk: fault_injection.Disk, process: subprocess.Popen[str]) -> str:
    """The one line of exit code 1, which names the run folder."""
    line = fault_injection.complaint(fault_injection.end(process), 1)
    assert str(disk.path / "run") in line
    return line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "hover"], "not the same task"),
        (
            [*TRAIN, "--policy-hidden-layer-sizes", "[16]"],
            "key 'learner.policy_hidden_layer_sizes' is (8,), asked for (16,)",
        ),
        (["train", "pendulum", "--seed", "7"], "key 'seed' is 0, found 7"),
    ],
    ids=["task", "network", "seed"],
)
def test_resume_of_another_run_is_refused(
    capfd: pytest.CaptureFixture[str], stopped: Path, words: list[str], message: str
) -> None:
    assert_refused(capfd, stopped, message, *words)


def test_checkpoint_of_a_former_format_is_refused(capfd: pytest.CaptureFixture[str], stopped: Path) -> None:
    manifest = stopped / "checkpoints" / str(LATE) / MANIFEST
    manifest.rename(manifest.with_name("seal.json"))
    assert_refused(capfd, stopped, f"checkpoints/{LATE}: written by an earlier version of qrl")


def test_second_process_on_a_folder_is_refused(capfd: pytest.CaptureFixture[str], stopped: Path) -> None:
    """Until the first releases the lock."""
    with files.locked(stopped / "lock", "busy"):
        assert_refused(capfd, stopped, f"{stopped}: in use by another process")
    with files.locked(stopped / "lock", "busy"):
        pass


def test_a_file_system_without_locks_gets_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def cannot_lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", cannot_lock)
    with files.locked(tmp_path / "lock", "busy"):
        warning = capsys.readouterr().err
    assert warning.startswith(f"qrl: warning: {tmp_path}/lock: the file system cannot lock (No locks available)")
    assert warning.count("\n") == 1


def test_a_path_with_brackets_works(tmp_path: Path, complete: Path) -> None:
    """Resumed from, saved to and evaluated: Orbax alone reads brackets as a pattern."""
    run = fault_injection.unfinished(complete, tmp_path / "lr=0.01,hidden=[64,64]", LATE)
    assert_resumes(run, complete)
    assert qrl("evaluate", run, "--starts", "5") == 0


def test_full_disk_at_the_first_checkpoint(tmp_path: Path, complete: Path) -> None:
    with fault_injection.small_disk(tmp_path / "disk", "1m") as disk:
        FAULTS.append("disk full at the first checkpoint")
        line = failed(disk, fault_injection.start(*TRAIN, "--out", disk.path / "run", inside=disk.inside))
        assert "the checkpoint could not be written (No space left on device)" in line
        assert checkpoint.saved_steps(disk.seen / "run") == []
        disk.remount("size=20m")
        assert_resumes(disk.seen / "run", complete)


@pytest.mark.parametrize("room", ["some", *(["none"] if STRESS else [])])
def test_full_disk_after_several_checkpoints(tmp_path: Path, complete: Path, room: str) -> None:
    with fault_injection.small_disk(tmp_path / "disk", "20m") as disk:
        run = fault_injection.unfinished(complete, disk.seen / "run", LATE)
        before = checkpoints(run)
        at = os.statvfs(disk.seen)
        disk.remount(f"size={(at.f_blocks - at.f_bfree) * at.f_frsize // 1024 + 900}k")
        FAULTS.append(f"full disk, {room} left")
        process = fault_injection.start(*TRAIN, "--out", disk.path / "run", "--resume", inside=disk.inside)
        if room == "none":
            fault_injection.wait_for(process, lambda: events(run) > 1)
            disk.fill()
        failed(disk, process)
        assert before.items() <= checkpoints(run).items()
        assert checkpoint.saved_steps(run)[0] == LATE
        disk.remount("size=40m")
        assert_resumes(run, complete)


@pytest.mark.skipif(not STRESS, reason="part of make stress")
@pytest.mark.parametrize("name", ["metrics.csv", "summary.json", "learning_curve.png", "flight.png", "tensorboard"])
def test_file_that_cannot_be_written(stopped: Path, complete: Path, name: str) -> None:
    """A directory is in its place, or a file in place of a directory."""
    if name == "tensorboard":
        shutil.rmtree(stopped / name)
        (stopped / name).write_text("")
    else:
        (stopped / name).unlink(missing_ok=True)
        (stopped / name / "inside").mkdir(parents=True)
    FAULTS.append(f"{name} in the way")
    ended = fault_injection.qrl(*TRAIN, "--out", stopped, "--resume")
    assert str(stopped / name) in fault_injection.complaint(ended, 1)
    shutil.rmtree(stopped / name) if (stopped / name).is_dir() else (stopped / name).unlink()
    assert_resumes(stopped, complete)


@pytest.mark.parametrize("when", ["before", *(["compiling", "training"] if STRESS else [])])
def test_folder_that_becomes_read_only(tmp_path: Path, complete: Path, when: str) -> None:
    with fault_injection.small_disk(tmp_path / "disk", "20m") as disk:
        run = fault_injection.unfinished(complete, disk.seen / "run", LATE)
        if when == "training":
            checkpoint.discard_after(run, 0)
        before, files_of_events = checkpoints(run), events(run)
        FAULTS.append(f"read-only: {when}")
        if when == "before":
            disk.read_only("run")
        process = fault_injection.start(*TRAIN, "--out", disk.path / "run", "--resume", inside=disk.inside)
        if when == "compiling":
            fault_injection.wait_for(process, lambda: events(run) > files_of_events)
        if when == "training":
            fault_injection.wait_for(process, lambda: checkpoint.saved_steps(run) != [])
        if when != "before":
            disk.read_only("run")
        assert "Read-only file system" in failed(disk, process)
        assert before.items() <= checkpoints(run).items()
        disk.read_only("run", undo=True)
        assert_resumes(run, complete)


@pytest.mark.parametrize("how", ["moved", *(["removed"] if STRESS else [])])
def test_folder_that_vanishes_while_training(tmp_path: Path, complete: Path, how: str) -> None:
    """No run is made in its place. Moved back, the run resumes."""
    run, away = tmp_path / "run", tmp_path / "away"
    process = fault_injection.start(*TRAIN, "--out", run, "--resume")
    fault_injection.wait_for(process, lambda: checkpoint.saved_steps(run) != [])
    run.rename(away)
    FAULTS.append(f"vanished: {how}")
    kept = checkpoint.saved_steps(away)
    if how == "removed":
        shutil.rmtree(away)
    assert str(run) in fault_injection.complaint(fault_injection.end(process), 1)
    if run.exists():  # Orbax creates missing parents during a save
        assert [path.name for path in run.iterdir()] == ["checkpoints"]
        assert checkpoint.saved_steps(run) == []
        shutil.rmtree(run)
    if how == "moved":
        assert checkpoint.saved_steps(away)[-len(kept) :] == kept
        away.rename(run)
    assert_resumes(run, complete)

"""What the proofs of faults share: the command line as a process of its own, what a run comes to, a disk that fills."""

import contextlib
import csv
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

import once
from qrl.runs import checkpoint, orbax_files
from qrl.runs.integrity import MANIFEST

STRESS = os.environ.get("QRL_STRESS") == "1"  # all of it, not a sample
PATIENCE = 400.0  # seconds: whatever takes longer hangs

# One configuration for all, so that its programs are compiled once.
SIZES = (
    "--num-envs 16 --unroll-length 20 --replay-unrolls 4 --warmup-unrolls 2 --updates-per-unroll 4 --batch-size 8"
    " --policy-hidden-layer-sizes [8] --critic-hidden-layer-sizes [8] --num-evals 12"
    " --num-eval-envs 4 --num-timesteps 7.68e4"
)
STEPS, REPORTS = 76_800, 12
TRAIN = ["train", "pendulum", *SIZES.split()]
LONG_STEPS, LONG_REPORTS = 2_048_000, 160  # for many kills in a row: a second of training between two
LONG = [*TRAIN, "--num-timesteps", str(LONG_STEPS), "--num-evals", str(LONG_REPORTS)]


class Ended(NamedTuple):
    code: int
    out: str
    error: str


def environment(**changes: str) -> dict[str, str]:
    """Of a process that shares this one's compiled programs."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}  # pyright: ignore[reportAttributeAccessIssue]
    return os.environ | cache | changes


def start(*words: str | Path, inside: tuple[str, ...] = (), **changes: str) -> subprocess.Popen[str]:
    """`qrl words`; `inside`: the words of another command that runs it."""
    command = [*inside, sys.executable, "-m", "qrl", *map(str, words)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(**changes)
    )


def end(process: subprocess.Popen[str], patience: float = PATIENCE) -> Ended:
    try:
        out, error = process.communicate(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        out, error = process.communicate()
        pytest.fail(f"hangs: {out[-500:]} {error[-500:]}")
    return Ended(process.returncode, out, error)


def qrl(*words: str | Path, inside: tuple[str, ...] = (), **changes: str) -> Ended:
    return end(start(*words, inside=inside, **changes))


def complaint(ended: Ended, code: int) -> str:
    """The one line on stderr."""
    assert ended.code == code, ended
    assert ended.error.count("\n") == 1, ended.error
    assert ended.error.startswith("qrl: ")
    return ended.error


def done(ended: Ended) -> None:
    assert ended.code == 0, ended
    assert "Traceback" not in ended.error


# -- what a run comes to -------------------------------------------------------------------------------------


def metrics(folder: Path) -> list[dict[str, str]]:
    """metrics.csv without its clocks."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if not k.endswith(("_seconds", "_per_second"))}
            for row in csv.DictReader(file)
        ]


def leaves(folder: Path, env_steps: int | None = None) -> dict[str, np.ndarray]:
    """Every leaf of a checkpoint, the last where nothing is said, read by Orbax alone."""
    path = folder / "checkpoints" / str(env_steps or checkpoint.saved_steps(folder)[0]) / orbax_files.STATE
    with orbax_files.plain_path(path) as plain, ocp.StandardCheckpointer() as orbax:
        return {name: np.asarray(leaf) for name, leaf in orbax.restore(plain).items()}


def assert_same_leaves(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    assert found.keys() == wanted.keys()
    for name, leaf in wanted.items():
        assert (found[name].dtype, found[name].shape) == (leaf.dtype, leaf.shape), name
        assert found[name].tobytes() == leaf.tobytes(), name


def assert_same_run(folder: Path, whole: Path) -> None:
    """No update is lost: every number is that of a run never stopped, bit for bit, clocks aside; nothing lies about."""
    assert metrics(folder) == metrics(whole)
    assert checkpoint.saved_steps(folder)[0] == checkpoint.saved_steps(whole)[0]
    assert_same_leaves(leaves(folder), leaves(whole))
    assert not [*folder.rglob("*.tmp"), *folder.rglob("*orbax-checkpoint-tmp*")]


def digest(folder: Path) -> dict[str, str]:
    """Everything in a folder, by name."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sorted(folder.rglob("*"))
    }


def whole_run(factory: pytest.TempPathFactory) -> Path:
    """A run never stopped, once for all tests."""
    return once.made_once(factory, "whole run", lambda out: done(qrl(*TRAIN, "--out", out / "run"))) / "run"


def unfinished(whole: Path, to: Path, env_steps: int) -> Path:
    """A copy of a run as it was when it had come so far."""
    shutil.copytree(whole, to)
    checkpoint.discard_after(to, env_steps)
    for name in ("summary.json", "learning_curve.png", "flight.png"):
        (to / name).unlink(missing_ok=True)
    return to


# -- kills ---------------------------------------------------------------------------------------------------

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)


def wait_for(process: subprocess.Popen[str], what: Callable[[], bool], seconds: float = PATIENCE) -> bool:
    """Until `what` or the process has come to pass, or time is up; whether the process still runs."""
    until = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < until and not what():
        time.sleep(0.01)
    return process.poll() is None


def killed_again_and_again(
    words: list[str | Path],
    folders: list[Path],
    kills: int,
    draw: random.Random,
    seconds: float,
    whole_steps: int,
    **changes: str,
) -> int:
    """Start, kill at any moment, go on, until `kills` kills have happened; then to the end. How many did happen.

    `seconds`: what a run takes about. Where it has come further than its share of the kills, it dies young or soon
    after another checkpoint: otherwise it could end before enough kills have happened. Where it comes no further, it
    may live longer. The second kill falls between two checkpoints, the last between the last of them and the end.
    """
    happened, span = 0, seconds
    while happened < kills:
        before = [checkpoint.saved_steps(folder)[:1] for folder in folders]
        reached = max((steps[0] for steps in before if steps), default=0)
        process = start(*words, **changes)
        if happened == kills - 1:
            wait_for(process, lambda: (folders[0] / "checkpoints" / str(whole_steps) / MANIFEST).exists())
            wait_for(process, lambda: False, draw.uniform(0.0, 0.5))
        else:
            ahead = reached / whole_steps > (happened + 1) / kills
            moment = PATIENCE if happened == 1 else draw.uniform(0.0, seconds / 4 if ahead else span)
            goal = reached + (whole_steps - reached) // (kills - happened + 1)
            wait_for(process, lambda goal=goal: checkpoint.saved_steps(folders[0])[:1] > [goal], moment)
            wait_for(process, lambda: False, draw.uniform(0.0, 0.2))
        which = SIGNALS[happened % len(SIGNALS)]
        if process.poll() is None:
            process.send_signal(which)
        ended = end(process)
        if ended.code == 0:  # too late
            done(ended)
            break
        happened += 1
        assert ended.code in (1, -which), (which, ended)
        assert "Traceback" not in ended.error, ended.error
        after = [checkpoint.saved_steps(folder)[:1] for folder in folders]
        assert all(now >= earlier for now, earlier in zip(after, before, strict=True)), "a checkpoint is lost"
        if after == before:
            span *= 1.1
    done(qrl(*words, **changes))
    return happened


# -- a small disk --------------------------------------------------------------------------------------------


class Disk(NamedTuple):
    inside: tuple[str, ...]  # what a command has to be run by, to see it
    path: Path  # where such a command sees it
    seen: Path  # where this process does

    def remount(self, options: str) -> None:
        subprocess.run([*self.inside, "mount", "-o", f"remount,{options}", str(self.path)], check=True)

    def read_only(self, name: str, *, undo: bool = False) -> None:
        """This folder, for whoever opens something in it from now on; no matter what is open already."""
        folder = str(self.path / name)
        again = [["umount", "-l", folder]]
        bind = [["mount", "--bind", folder, folder], ["mount", "-o", "remount,bind,ro", folder]]
        for words in again if undo else bind:
            subprocess.run([*self.inside, *words], check=True)

    def fill(self) -> None:
        """Not a byte is left."""
        with contextlib.suppress(OSError), (self.seen / "filler").open("wb", buffering=0) as file:
            for size in (2**16, 2**10, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))


@contextlib.contextmanager
def small_disk(where: Path, size: str) -> Iterator[Disk]:
    """A tmpfs of so many bytes; in a name space of its own, where this user may mount nothing else."""
    where.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(where)]
    if subprocess.run(mount, capture_output=True).returncode == 0:
        try:
            yield Disk((), where, where)
        finally:
            subprocess.run(["umount", "-l", str(where)], check=True)
        return
    keeper = subprocess.Popen(
        ["unshare", "-rm", "sh", "-c", '"$@" && echo mounted && exec cat', "sh", *mount],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert keeper.stdin
    assert keeper.stdout
    try:
        if keeper.stdout.readline() != b"mounted\n":
            pytest.skip("neither mount nor unshare -rm may mount a tmpfs here")
        inside = ("nsenter", "--target", str(keeper.pid), "--user", "--mount", "--preserve-credentials")
        yield Disk(inside, where, Path(f"/proc/{keeper.pid}/root{where}"))
    finally:
        keeper.stdin.close()  # what it was waiting for
        keeper.wait()


# -- how many ------------------------------------------------------------------------------------------------


def tell(request: pytest.FixtureRequest, line: str) -> None:
    """Through the terminal, whatever pytest captures."""
    capture: Any = request.config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled() if capture else contextlib.nullcontext():
        print(f"\nstress: {line}", flush=True)

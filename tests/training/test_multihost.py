"""Two processes train as one does on two devices; when one is killed, the other ends, and both go on from the disk."""

import random
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

import fault_injection
from fault_injection import STRESS
from qrl.runs import checkpoint
from qrl.runs.integrity import FORMAT, MANIFEST
from qrl.training import multihost
from qrl_envs.specfile import BadInput

SURVIVOR_SECONDS = 60.0  # in which the other has to end
STEPS = 32_000
TRAIN = [*fault_injection.TRAIN, "--num-timesteps", str(STEPS), "--num-evals", "5"]
# Compiled in haste, which takes half the time: each of the two compiles all of it, again and again.
HASTE = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
TWO_DEVICES = {"JAX_NUM_CPU_DEVICES": "2", **HASTE}


def pair(*words: str | Path) -> list[subprocess.Popen[str]]:
    """Processes 0 and 1 of a run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    return [
        fault_injection.start(*words, "--processes", "2", "--process-id", str(i), "--coordinator", address, **HASTE)
        for i in range(2)
    ]


def both_done(*words: str | Path) -> None:
    for process in pair(*words):
        fault_injection.done(fault_injection.end(process))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One process with two devices."""
    out = tmp_path_factory.mktemp("processes") / "one"
    fault_injection.done(fault_injection.qrl(*TRAIN, "--out", out, **TWO_DEVICES))
    return out


@pytest.mark.skipif(not STRESS, reason="part of make stress; those that are killed prove it too")
def test_two_processes_equal_two_devices(tmp_path: Path, whole: Path) -> None:
    """Bit for bit, clocks aside; the first alone writes."""
    both_done(*TRAIN, "--out", tmp_path / "run")
    fault_injection.assert_same_run(tmp_path / "run", whole)


@pytest.mark.parametrize("killed", [1, *([0, 1, 0] if STRESS else [])])
def test_killed_pair_goes_on(request: pytest.FixtureRequest, tmp_path: Path, whole: Path, killed: int) -> None:
    """Killed between two checkpoints: the other ends by itself; started again, all ends as if never killed.

    By one process on as many devices, which is quick; under STRESS by two as well.
    """
    run = tmp_path / "run"
    processes = pair(*TRAIN, "--out", run)
    there = fault_injection.wait_for(processes[0], lambda: complete(run) > 1)
    assert there, [fault_injection.end(process) for process in processes]
    time.sleep(random.Random(request.node.name).uniform(0.0, 0.2))
    processes[killed].send_signal(signal.SIGKILL)
    begun = time.monotonic()
    ended = [fault_injection.end(process, SURVIVOR_SECONDS) for process in processes]
    took = time.monotonic() - begun
    assert ended[killed].code == -signal.SIGKILL
    assert ended[1 - killed].code != 0
    if killed == 1:
        assert ended[0].code == 1
        assert ended[0].error.startswith("qrl: ")
    alone = shutil.copytree(run, tmp_path / "alone")
    fault_injection.done(fault_injection.qrl(*TRAIN, "--out", alone, "--resume", **TWO_DEVICES))
    fault_injection.assert_same_run(alone, whole)
    if STRESS:
        both_done(*TRAIN, "--out", run, "--resume")
        fault_injection.assert_same_run(run, whole)
    fault_injection.tell(
        request, f"1 kill of process {killed} of 2 (the other ended {took:.1f} s later), 0 lost updates"
    )


def complete(run: Path) -> int:
    return len(checkpoint.saved_steps(run)) if (run / "checkpoints").is_dir() else 0


@pytest.mark.skipif(not STRESS, reason="part of make stress")
def test_a_refused_checkpoint_leaves_nobody_waiting(tmp_path: Path, whole: Path) -> None:
    """Found when all are at work: the first says why, and both end."""
    run = fault_injection.unfinished(whole, tmp_path / "run", STEPS // 2)
    manifest = run / "checkpoints" / str(checkpoint.saved_steps(run)[0]) / MANIFEST
    manifest.write_text(manifest.read_text().replace(f'"format": {FORMAT},', f'"format": {FORMAT + 1},'))
    first, second = (fault_injection.end(p, SURVIVOR_SECONDS) for p in pair(*TRAIN, "--out", run, "--resume"))
    assert first.code == 2
    assert "later version of qrl" in first.error
    assert second.code != 0


def test_wrong_input_is_told_once(tmp_path: Path) -> None:
    """By the first process; the other ends by itself, and nothing is made."""
    first, second = (
        fault_injection.end(process, SURVIVOR_SECONDS) for process in pair("train", "hoverr", "--out", tmp_path / "run")
    )
    assert "unknown task 'hoverr' (did you mean 'hover'?)" in fault_injection.complaint(first, 2)
    assert (second.code, second.error) == (2, "")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("flags", "env", "expected"),
    [
        ((None, None, None), {}, (0, 1, "")),
        ((1, 4, "host:1"), {}, (1, 4, "host:1")),
        (
            (None, None, None),
            {"JAX_PROCESS_ID": "2", "JAX_NUM_PROCESSES": "3", "JAX_COORDINATOR_ADDRESS": "h:1"},
            (2, 3, "h:1"),
        ),
        (
            (0, None, None),
            {"JAX_PROCESS_ID": "2", "JAX_NUM_PROCESSES": "3", "JAX_COORDINATOR_ADDRESS": "h:1"},
            (0, 3, "h:1"),
        ),
        ((None, None, None), {"SLURM_PROCID": "1", "SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS": "2"}, (1, 2, "")),
        ((None, None, None), {"SLURM_PROCID": "0", "SLURM_NTASKS": "2"}, (0, 1, "")),  # a batch script, without srun
    ],
)
def test_a_process_knows_which_it_is(flags: tuple, env: dict, expected: tuple) -> None:
    assert multihost.this_process(*flags, env) == expected


@pytest.mark.parametrize(
    ("flags", "env", "words"),
    [
        ((2, 2, "h:1"), {}, "--process-id below --processes, found 2 of 2"),
        ((1, None, "h:1"), {}, "--process-id below --processes"),
        ((0, 2, None), {}, "--coordinator is missing"),
        ((None, None, "h:1"), {}, "--processes is missing"),
        ((None, None, None), {"JAX_PROCESS_ID": "one"}, "--process-id: expected a number, found 'one'"),
    ],
)
def test_a_process_that_cannot_know_is_refused(flags: tuple, env: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        multihost.this_process(*flags, env)

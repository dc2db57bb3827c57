"""How many threads XLA has: one for little work, the machine's own otherwise, and whatever the user says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from qrl import processes, runs
from qrl.config import Config


def config(**changes: object) -> Config:
    return Config.model_validate(runs.preset("hover") | changes, strict=False)


@pytest.mark.parametrize(
    ("changes", "limited"),
    [
        ({}, False),  # 1,600 samples of 64 units
        ({"minibatch_lanes": 16}, True),
        ({"unroll_steps": 25}, True),
        ({"minibatch_lanes": 16, "critic_hidden": [256, 256]}, False),
        ({"minibatch_lanes": 16, "lanes": 4096}, False),
    ],
    ids=["much", "few trajectories", "short ones", "a wide critic", "many lanes"],
)
def test_one_thread_for_little_work(changes: dict, limited: bool) -> None:
    """And nothing else is said to XLA."""
    environment: dict[str, str] = {}
    processes.limit_threads(config(**changes), environment)
    assert environment == ({"PJRT_NPROC": "1"} if limited else {})


@pytest.mark.parametrize("said", [{"PJRT_NPROC": "3"}, {"NPROC": "3"}], ids=lambda said: next(iter(said)))
def test_threads_that_are_said_stay(said: dict) -> None:
    """XLA reads either."""
    environment = dict(said)
    processes.limit_threads(config(minibatch_lanes=16), environment)
    assert environment == said


PROGRAM = """
from pathlib import Path
from qrl import processes, runs
from qrl.config import Config
processes.limit_threads(Config.model_validate(runs.preset("hover") | {"minibatch_lanes": %d}, strict=False))
import jax
jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((512, 512))))
print(sum("Eigen" in name.read_text() for name in Path("/proc/self/task").glob("*/comm")))
"""


def _told(program: str, environment: dict[str, str]) -> str:
    """Its output, of which Brax may have lines of its own before."""
    words = [sys.executable, "-c", program]
    return subprocess.run(words, env=environment, capture_output=True, check=True, text=True).stdout


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the system does not show a process's threads")
def test_xla_does_as_it_is_told() -> None:
    """The variable is no documented one: counted are the threads that there are."""
    cores = len(os.sched_getaffinity(0))
    if cores == 1:
        pytest.skip("one core has one thread anyway")
    alone = {k: v for k, v in os.environ.items() if k not in ("PJRT_NPROC", "NPROC", "XLA_FLAGS")}
    found = [int(_told(PROGRAM % lanes, alone).split()[-1]) for lanes in (16, 32)]
    assert found[0] < found[1]
    assert found[1] >= cores

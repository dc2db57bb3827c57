"""How a run uses a CPU's cores: as devices, with one thread, or as the user says."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from qrl import processes, request, runs
from qrl.config import Config
from qrl.runs import ConfigFile, RunConfig

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
LITTLE = {"minibatch_lanes": 8}  # 400 samples of 64 units


def config(**changes: object) -> Config:
    return Config.model_validate(runs.preset("hover") | changes, strict=False)


@pytest.mark.parametrize(
    ("changes", "seeds", "cores", "devices"),
    [
        ({}, 1, 1, 1),
        ({}, 1, 2, 2),  # 800 samples of 64 units each
        ({}, 1, 16, 4),
        ({"minibatch_lanes": 16}, 1, 2, 2),  # 400
        (LITTLE, 1, 2, 1),
        (LITTLE | {"critic_hidden": [256, 256]}, 1, 2, 2),
        (LITTLE | {"lanes": 4096}, 1, 2, 2),
        (LITTLE, 2, 2, 2),  # a member each
        (LITTLE, 6, 4, 3),
        (LITTLE, 3, 2, 1),
        ({}, 3, 2, 2),
        ({"shards": 1}, 1, 2, 1),
        ({}, 1, 3, 2),  # three cannot divide eight shards
    ],
)
def test_as_many_devices_as_have_enough_to_do(changes: dict, seeds: int, cores: int, devices: int) -> None:
    assert processes.cpu_devices(config(**changes), seeds, cores) == devices


def run(**changes: object) -> RunConfig:
    return request.run_config("hover", None, ConfigFile(learner=dict(changes)), {}, 0, 1)


@pytest.mark.parametrize("name", processes.SAID)
def test_what_is_said_stays(name: str) -> None:
    environment = {name: "3"}
    processes.use_cores(run(**LITTLE), [], environment)
    assert environment == {name: "3"}


@pytest.mark.parametrize(
    ("changes", "environment"),
    [(LITTLE, {"PJRT_NPROC": "1"}), ({"shards": 1}, {}), ({"shards": 1, "minibatch_lanes": 8, "lanes": 4096}, {})],
    ids=["little", "much", "many lanes"],
)
def test_one_thread_for_little_work(changes: dict, environment: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it cannot be parted, and nothing is said of what would gain by more."""
    monkeypatch.setattr(processes, "_cores", lambda: 2)
    said: dict[str, str] = {}
    processes.use_cores(run(**changes), [], said)
    assert said == environment


PROGRAM = """
import json, sys
from pathlib import Path
from qrl import processes, request
from qrl.runs import ConfigFile
changes, before = json.loads(sys.argv[1])
processes.use_cores(request.run_config("hover", None, ConfigFile(learner=changes), {}, 0, 1), before)
import jax
jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((512, 512))))
threads = sum("Eigen" in name.read_text() for name in Path("/proc/self/task").glob("*/comm"))
print(json.dumps([jax.device_count(), threads]))
"""


def found(changes: dict, before: list[str], **environment: str) -> tuple[int, int]:
    """The devices and the threads of XLA's that there are where a run with `changes` has begun."""
    alone = {name: x for name, x in os.environ.items() if name not in (*processes.SAID, "XLA_FLAGS")}
    words = [sys.executable, "-c", PROGRAM, json.dumps([changes, before])]
    said = subprocess.run(words, env=alone | environment, capture_output=True, check=True, text=True).stdout
    devices, threads = json.loads(said.splitlines()[-1])
    return devices, threads


@pytest.mark.skipif(CORES < 2, reason="one core is one device and one thread anyway")
def test_jax_does_as_it_is_told() -> None:
    """A run that goes on has the devices that it had; XLA's flag for their number is the user's word too."""
    assert found({}, [])[0] == processes.cpu_devices(config(), 1, CORES) > 1
    assert found({}, ["TFRT_CPU_0"])[0] == 1
    assert found(LITTLE, ["TFRT_CPU_0", "TFRT_CPU_1"])[0] == 2
    assert found({}, ["NVIDIA H100"])[0] > 1
    assert found({}, [], XLA_FLAGS="--xla_force_host_platform_device_count=3")[0] == 3


@pytest.mark.skipif(CORES < 2, reason="one core is one device and one thread anyway")
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the system does not show a process's threads")
def test_xla_does_as_it_is_told() -> None:
    """The variable is no documented one: counted are the threads that there are."""
    few, many = (found(changes, [])[1] for changes in (LITTLE, {"shards": 1}))
    assert few < many
    assert many >= CORES

"""How a run uses a CPU's cores: as devices, with one thread, or as the user says."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fault_injection
from cli_helpers import TINY, TINY_VALUES
from qrl import request
from qrl.config import Config, load_preset
from qrl.runs.record import ConfigFile, RunConfig
from qrl.training import devices as processes

CORES = processes.cores()
LITTLE = {"batch_size": 8}  # 400 samples of 64 units


def config(**changes: object) -> Config:
    return Config.model_validate(load_preset("hover") | changes, strict=False)


@pytest.mark.parametrize(
    ("changes", "seeds", "cores", "devices"),
    [
        ({}, 1, 1, 1),
        ({}, 1, 2, 2),  # 800 samples of 64 units each
        ({}, 1, 16, 2),  # more parts of a member were not measured
        ({"batch_size": 16}, 1, 2, 2),  # 400
        (LITTLE, 1, 2, 1),
        (LITTLE | {"critic_hidden_layer_sizes": [256, 256]}, 1, 2, 2),
        (LITTLE | {"num_envs": 4096}, 1, 2, 2),
        (LITTLE, 2, 2, 2),  # a member each
        (LITTLE, 6, 4, 3),
        (LITTLE, 3, 2, 1),
        ({}, 3, 2, 2),
        ({"num_shards": 1}, 1, 2, 1),
        ({}, 1, 3, 2),  # three cannot divide eight shards
        ({"policy_hidden_layer_sizes": []}, 1, 2, 2),
        ({"policy_hidden_layer_sizes": [], "critic_hidden_layer_sizes": [64]}, 1, 2, 2),
        ({"policy_hidden_layer_sizes": [], "critic_hidden_layer_sizes": []}, 1, 2, 1),
    ],
)
def test_as_many_devices_as_have_enough_to_do(changes: dict, seeds: int, cores: int, devices: int) -> None:
    assert processes.cpu_devices(config(**changes), seeds, cores) == devices


def run(**changes: object) -> RunConfig:
    return request.run_config("hover", None, ConfigFile(learner=dict(changes)), {}, 0, 1)


ONE_THREAD = {"PJRT_NPROC": "1"}


@pytest.mark.parametrize(
    ("said", "added"),
    [
        ({"PJRT_NPROC": "3"}, {}),
        ({"NPROC": "3"}, {}),
        ({"JAX_NUM_CPU_DEVICES": "3"}, {}),
        ({"XLA_FLAGS": "--a --xla_force_host_platform_device_count=3"}, {}),
        ({"JAX_NUM_CPU_DEVICES": "1"}, ONE_THREAD),
        ({"XLA_FLAGS": "--xla_force_host_platform_device_count=1 --a"}, ONE_THREAD),
    ],
    ids=str,
)
def test_what_is_said_stays(said: dict, added: dict) -> None:
    """A device may have one thread, whoever wants it to be one."""
    environment = dict(said)
    processes.configure_cpu(run(**LITTLE), [], environment)
    assert environment == said | added


@pytest.mark.parametrize(
    ("changes", "environment"),
    [(LITTLE, ONE_THREAD), ({"num_shards": 1}, {}), ({"num_shards": 1, "batch_size": 8, "num_envs": 4096}, {})],
    ids=["little", "much", "many lanes"],
)
def test_one_thread_for_little_work(changes: dict, environment: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it cannot be parted, and nothing is said of what would gain by more."""
    monkeypatch.setattr(processes, "cores", lambda: 2)
    said: dict[str, str] = {}
    processes.configure_cpu(run(**changes), [], said)
    assert said == environment


PROGRAM = """
import json, sys
from pathlib import Path
from qrl import request
from qrl.training import devices as processes
from qrl.runs.record import ConfigFile
changes, before = json.loads(sys.argv[1])
processes.configure_cpu(request.run_config("hover", None, ConfigFile(learner=changes), {}, 0, 1), before)
import jax
jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((512, 512))))
threads = sum("Eigen" in name.read_text() for name in Path("/proc/self/task").glob("*/comm"))
print(json.dumps([jax.device_count(), threads]))
"""


def found(changes: dict, before: list[str], **environment: str) -> tuple[int, int]:
    """The devices and the threads of XLA's that there are where a run with `changes` has begun."""
    said = ("JAX_NUM_CPU_DEVICES", "XLA_FLAGS", *processes.THREADS)
    alone = {name: x for name, x in os.environ.items() if name not in said} | {"JAX_PLATFORMS": "cpu"}
    words = [sys.executable, "-c", PROGRAM, json.dumps([changes, before])]
    said = subprocess.run(words, env=alone | environment, capture_output=True, check=True, text=True).stdout
    devices, threads = json.loads(said.splitlines()[-1])
    return devices, threads


@pytest.mark.parametrize(
    ("changes", "before", "devices"),
    [({}, [], [2]), ({}, ["TFRT_CPU_0"], []), (LITTLE, ["TFRT_CPU_0", "TFRT_CPU_1"], [2]), ({}, ["NVIDIA H100"], [2])],
    ids=str,
)
def test_a_run_that_goes_on_asks_for_the_devices_that_it_had(
    changes: dict, before: list[str], devices: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where they were of a CPU."""
    asked = []
    monkeypatch.setattr(processes, "cores", lambda: 2)
    monkeypatch.setattr(processes.jax.config, "update", lambda _, count: asked.append(count))
    processes.configure_cpu(run(**changes), before, {})
    assert asked == devices


@pytest.mark.skipif(CORES < 2, reason="one core is one device and one thread anyway")
def test_jax_does_as_it_is_told() -> None:
    """XLA's flag for the number of devices is the user's word too."""
    assert found({}, [])[0] == processes.cpu_devices(config(), 1, CORES) > 1
    assert found({}, [], XLA_FLAGS="--xla_force_host_platform_device_count=3")[0] == 3


@pytest.mark.skipif(CORES < 2, reason="one core is one device and one thread anyway")
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the system does not show a process's threads")
def test_xla_does_as_it_is_told() -> None:
    """The variable is no documented one: counted are the threads that there are."""
    few, many = (found(changes, [])[1] for changes in (LITTLE, {"num_shards": 1}))
    assert few < many
    assert many >= CORES


@pytest.mark.skipif(CORES < 2, reason="one core is one device anyway")
def test_a_run_has_the_devices_that_it_had(tmp_path: Path) -> None:
    """Where a command of its own would make one: as it goes on, and as its config.json repeats it."""
    tiny = Config.model_validate(load_preset("pendulum") | TINY_VALUES, strict=False)
    assert processes.cpu_devices(tiny, 1, CORES) == 1

    def began(*words: str | Path, **environment: str) -> str:
        """What it says before it compiles. It is not run to its end."""
        process = fault_injection.start("train", *words, **environment)
        try:
            assert process.stdout
            return next(line for line in process.stdout if " CPU device" in line)
        finally:
            process.kill()
            process.communicate()

    first, again = tmp_path / "first", tmp_path / "again"
    assert "on 2 CPU devices" in began("pendulum", *TINY.split(), "--out", first, JAX_NUM_CPU_DEVICES="2")
    assert "on 2 CPU devices" in began("--config", first / "config.json", "--out", tmp_path / "repeated")
    again.mkdir()
    (again / "config.json").write_bytes((first / "config.json").read_bytes())
    assert "on 2 CPU devices" in began("pendulum", *TINY.split(), "--out", again, "--resume")


def test_a_seed_of_several_is_repeated_as_it_was_trained() -> None:
    """Seeds part first: two on four devices have two each, three on two share both."""
    devices = [f"TFRT_CPU_{i}" for i in range(4)]
    for seeds, there, each in ((2, 4, 2), (4, 4, 1), (3, 2, 2), (1, 2, 2), (2, 1, 1), (2, 0, 0)):
        both = run().model_copy(update={"seeds": seeds, "devices": devices[:there]})
        assert both.member(0).devices == devices[:each]


@pytest.mark.parametrize("task", ["any", "hover"])
def test_a_run_is_planned_before_jax_has_its_devices(task: str) -> None:
    """Else it would have one, whatever `cpu_devices` says: JAX refuses another number once it has made them."""
    plan = (
        "import jax; from qrl import request; from qrl.runs.record import ConfigFile;"
        f"request.run_config({task!r}, None, ConfigFile(), {{}}, 0, 1, {{'vehicle': 'crazyflie'}});"
        "jax.config.update('jax_num_cpu_devices', 2); print(len(jax.devices()))"
    )
    unset = {"JAX_NUM_CPU_DEVICES", "XLA_FLAGS"}
    env = {name: value for name, value in os.environ.items() if name not in unset}
    done = subprocess.run([sys.executable, "-c", plan], env=env, capture_output=True, text=True, check=False)
    assert done.stdout == "2\n", done.stderr

"""Devices and memory that a command uses."""

import math
import os
import re
from collections.abc import Mapping, MutableMapping, Sequence
from contextlib import suppress
from typing import Any

import jax

from qrl.config import Config
from qrl.runs.record import RunConfig
from qrl.training.sharding import make_mesh
from qrl_envs.specfile import BadInput

# Multiply-adds of an update's largest product. Measured with two cores (docs/profile.md): another device is worth its
# exchanges where each has 400 samples of 64 units or more; one thread is as fast as XLA's own up to twice that.
DEVICE_WORK, THREAD_WORK = 400 * 64**2, 1000 * 64**2
DEVICE_LANES = 512  # lanes per device that are worth another device, whatever the updates
MAX_DEVICES_PER_MEMBER = 2  # more was not measured
THREADS = ("PJRT_NPROC", "NPROC")  # variables that set XLA's number of threads


def configure_cpu(run: RunConfig, before: Sequence[str], environment: MutableMapping[str, str] = os.environ) -> None:
    """Set JAX's number of CPU devices, or XLA's number of threads, for a run, unless the user has.

    A run that is repeated or resumed gets as many devices as `before` names, if there are so many cores, so that its
    bits are the same. To be called before JAX initializes its devices.
    """
    if any(name in environment for name in THREADS):
        return
    count = cpu_devices(run.learner, run.seeds, cores())
    if before and all("cpu" in name.lower() for name in before):
        count = min(len(before), cores())
    if requested := _requested_devices(environment):
        count = requested
    elif count > 1:
        with suppress(RuntimeError):  # initialized already, by an earlier command of this process
            jax.config.update("jax_num_cpu_devices", count)
    if count == 1 and _work(run.learner) <= THREAD_WORK and run.learner.num_envs <= DEVICE_LANES:
        environment["PJRT_NPROC"] = "1"  # the threads of so small a product would mostly wait


def threads(environment: Mapping[str, str] = os.environ) -> str:
    """XLA's number of threads in a process of this one's environment."""
    return next((environment[name] for name in THREADS if name in environment), str(cores()))


def cpu_devices(learner: Config, seeds: int, cores: int) -> int:
    """Number of devices for a run on `cores`: each has a member of its own, or enough of one's work."""
    for count in range(cores, 1, -1):
        parts = count // math.gcd(seeds, count)  # devices of one member
        much = _work(learner) >= parts * DEVICE_WORK or learner.num_envs >= parts * DEVICE_LANES
        if parts == 1 or (much and parts <= MAX_DEVICES_PER_MEMBER and learner.shard_count % parts == 0):
            return count
    return 1


def _requested_devices(environment: Mapping[str, str]) -> int:
    """Number of CPU devices that the user asks for, by JAX's variable or XLA's flag; 0: none."""
    flag = re.findall(r"--xla_force_host_platform_device_count=(\d+)", environment.get("XLA_FLAGS", ""))
    text = environment.get("JAX_NUM_CPU_DEVICES", flag[-1] if flag else "")
    return int(text) if text.isdigit() else 0


def _work(learner: Config) -> int:
    """Multiply-adds of an update's largest product."""
    widest = max((1, *learner.policy_hidden_layer_sizes, *learner.critic_hidden_layer_sizes))
    return learner.batch_size * learner.unroll_length * widest**2


def workers() -> list[Any]:
    """The device of each worker: an accelerator has one; a CPU one for each core that this process may use.

    A program keeps about one core busy, and the CPU runs several at a time. So workers share a device, and the program
    and its bits are those of a single run on one device with as many threads.
    """
    devices = jax.local_devices()
    return devices if devices[0].platform != "cpu" else devices[:1] * cores()


def cores() -> int:
    """Cores that this process may use; a scheduler may restrict them."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> float:
    """Default memory of a sweep: half of what the devices have."""
    first = jax.local_devices()[0]
    if first.platform == "cpu":
        return host_bytes()
    return (first.memory_stats() or {}).get("bytes_limit", 8e9) * len(jax.local_devices()) / 2


def host_bytes() -> float:
    """Half of this machine's memory; initializes no device."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2


def _num_used(run: RunConfig) -> int:
    mesh = make_mesh(jax.devices(), run.seeds, run.learner.shard_count)
    return mesh.size if mesh else 1


def describe_devices(run: RunConfig) -> str:
    count, available = _num_used(run), jax.device_count()
    of = f" of {available}" if count < available else ""
    return f"{count}{of} {jax.default_backend().upper()} device{'s' * (count > 1 or bool(of))}"


def check_devices(run: RunConfig) -> None:
    """Raise BadInput if one of several processes would have no part in the run."""
    if jax.process_count() > 1 and _num_used(run) < jax.device_count():
        raise BadInput(
            f"key 'num_shards': expected a multiple of the processes' {jax.device_count()} devices,"
            f" found {run.learner.shard_count}"
        )


def device_names() -> list[str]:
    return [str(device) for device in jax.devices()]

"""What a command runs on: devices, every core of a CPU, the other processes of the command, and those of others."""

import math
import os
import re
from collections.abc import Mapping, MutableMapping, Sequence
from contextlib import suppress
from typing import Any

import jax

from qrl.config import Config
from qrl.runs.record import RunConfig
from qrl.training.sharding import spread
from qrl_envs.specfile import BadInput

# Multiply-adds of an update's largest product. Measured with two cores (docs/profile.md): a device more is worth its
# exchanges where each has 400 samples of 64 units or more; one thread is as fast as XLA's own up to twice that.
DEVICE_WORK, THREAD_WORK = 400 * 64**2, 1000 * 64**2
DEVICE_LANES = 512  # stepped by each: worth a device too
MOST_PARTS = 2  # of a member: with more cores it was not measured
THREADS = ("PJRT_NPROC", "NPROC")  # by which a user says how many XLA has


def use_cores(run: RunConfig, before: Sequence[str], environment: MutableMapping[str, str] = os.environ) -> None:
    """Say to JAX how a run uses a CPU's cores, unless the user has: as devices, or with one thread.

    A run that is repeated or goes on has as many devices as `before` names, if there are so many cores: so that its
    bits are the same. JAX takes no more advice once it was asked for its devices: to be called before.
    """
    if any(name in environment for name in THREADS):
        return
    count = cpu_devices(run.learner, run.seeds, _cores())
    if before and all("cpu" in name.lower() for name in before):
        count = min(len(before), _cores())
    if said := _devices_said(environment):
        count = said
    elif count > 1:
        with suppress(RuntimeError):  # it was asked already, by a command before in this process
            jax.config.update("jax_num_cpu_devices", count)
    if count == 1 and _work(run.learner) <= THREAD_WORK and run.learner.num_envs <= DEVICE_LANES:
        environment["PJRT_NPROC"] = "1"  # what so little work gains by a second core, threads lose in waiting


def cpu_devices(learner: Config, seeds: int, cores: int) -> int:
    """As how many devices a run uses so many cores: each has a member of its own, or enough of one's work."""
    for count in range(cores, 1, -1):
        parts = count // math.gcd(seeds, count)  # of a member
        much = _work(learner) >= parts * DEVICE_WORK or learner.num_envs >= parts * DEVICE_LANES
        if parts == 1 or (much and parts <= MOST_PARTS and learner.shard_count % parts == 0):
            return count
    return 1


def _devices_said(environment: Mapping[str, str]) -> int:
    """How many devices of a CPU the user asks for, by JAX's variable or XLA's flag; 0: nothing is said."""
    flag = re.findall(r"--xla_force_host_platform_device_count=(\d+)", environment.get("XLA_FLAGS", ""))
    said = environment.get("JAX_NUM_CPU_DEVICES", flag[-1] if flag else "")
    return int(said) if said.isdigit() else 0


def _work(learner: Config) -> int:
    """Multiply-adds of an update's largest product."""
    return (
        learner.batch_size
        * learner.unroll_length
        * max(*learner.policy_hidden_layer_sizes, *learner.critic_hidden_layer_sizes) ** 2
    )


def workers() -> list[Any]:
    """The device of each worker: an accelerator has one; a CPU one for each core that this process may use.

    A program of ours keeps about one core busy, and the CPU runs several programs at a time: they need no devices of
    their own, and so the program is the one that a single run on one device compiles, and its results are the same bits
    where that has as many threads.
    """
    devices = jax.local_devices()
    return devices if devices[0].platform != "cpu" else devices[:1] * _cores()


def _cores() -> int:
    """Those that this process may use: a scheduler may have given it a part of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> float:
    """The memory that a sweep takes where nobody says otherwise: half of what the devices have."""
    first = jax.local_devices()[0]
    if first.platform == "cpu":
        return host_bytes()
    return (first.memory_stats() or {}).get("bytes_limit", 8e9) * len(jax.local_devices()) / 2


def host_bytes() -> float:
    """Half of this machine's memory; asks no device, which must not be done before `join`."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2


def devices(run: RunConfig) -> str:
    """What a run trains on here, in words."""
    mesh = spread(jax.devices(), run.seeds, run.learner.shard_count)
    count, there = mesh.size if mesh else 1, jax.device_count()
    of = f" of {there}" if count < there else ""
    return f"{count}{of} {jax.default_backend()} device{'s' * (count > 1 or bool(of))}"


def check_devices(run: RunConfig) -> None:
    """Whether every one of several processes has a part in the run."""
    mesh = spread(jax.devices(), run.seeds, run.learner.shard_count)
    if jax.process_count() > 1 and (mesh.size if mesh else 1) < jax.device_count():
        raise BadInput(
            f"key 'shards': expected shares that the processes' {jax.device_count()} devices can divide among them,"
            f" found {run.learner.shard_count}"
        )


def device_names() -> list[str]:
    """Those of all processes."""
    return [str(device) for device in jax.devices()]

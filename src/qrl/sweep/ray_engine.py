"""Chunks as Ray tasks, on any node of a cluster: one whose node dies is trained again on another.

A task has all that it needs as its argument and returns its results; the process that began the sweep records them. So
nodes share no file system, and a chunk is recorded once, whichever of its attempts came through.
"""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import ray
from ray import exceptions

from qrl.runs import record
from qrl.sweep import runner
from qrl.sweep.runner import Chunk, ChunkDone
from qrl.training import devices
from qrl_envs.specfile import BadInput

RETRIES = 20  # of a chunk whose node or process dies; a cluster of nodes that may be taken away loses many
POLL_SECONDS = 0.5
CONNECT_SECONDS = 10.0
OBJECT_STORE_BYTES = 200_000_000  # of a cluster that a sweep starts itself: chunks and results are small
PROCESS_BYTES = 1_000_000_000  # of a worker process beside its members: Python, JAX, programs
TASK_BYTES = {"CPU": 2e9, "GPU": 8e9}  # default memory of a task's members
QUIETLY: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
PASSED_ON = ("JAX_", "XLA_")  # beginnings of the variables that a worker process has of this one's


class Ray:
    """The cluster that RAY_ADDRESS names, else one that runs on this machine, else one of its own, of all its cores."""

    def __init__(self, task_bytes: float | None) -> None:
        _connect()
        found = ray.cluster_resources()
        self.on_cpu = not found.get("GPU") or os.environ.get("JAX_PLATFORMS") == "cpu"
        self._unit = "CPU" if self.on_cpu else "GPU"
        self.workers = max(1, int(found.get(self._unit, 0)))
        self.grid_bytes = devices.host_bytes()
        self.memory_bytes = (task_bytes or TASK_BYTES[self._unit]) * self.workers
        self._nodes = sum(node["Alive"] for node in ray.nodes())

    def describe(self) -> str:
        several = [f"{n:,} {what}{'s' * (n != 1)}" for n, what in ((self.workers, self._unit), (self._nodes, "node"))]
        return f"Ray, {several[0]} of {several[1]}"

    def close(self) -> None:
        ray.shutdown()

    def run(self, chunks: Sequence[Chunk], folder: Path, stopped: Callable[[], bool]) -> Iterator[ChunkDone]:
        """Results as they come. Where it is stopped, chunks that are under way are lost."""
        needs = [PROCESS_BYTES + (chunk.memory_bytes if self.on_cpu else 0) for chunk in chunks]
        self._check_memory(max(needs, default=0))
        place: dict[str, Any] = {"num_cpus": 1, "num_gpus": 0 if self.on_cpu else 1, "max_retries": RETRIES}
        place |= {"runtime_env": {"env_vars": _variables(self.on_cpu)}}
        task, versions = ray.remote(_train), record.versions()
        waiting: list[Any] = []
        if not stopped():
            waiting = [
                task.options(memory=need, **place).remote(chunk, versions)
                for chunk, need in zip(chunks, needs, strict=True)
            ]
        try:
            while waiting and not stopped():
                ready, waiting = ray.wait(waiting, timeout=POLL_SECONDS)
                for reference in ready:
                    done = _result(reference)
                    runner.keep(folder, done)
                    yield done
        finally:
            for reference in waiting:
                ray.cancel(reference, force=True)

    def _check_memory(self, need: int) -> None:
        """BadInput if no node could ever run a task: Ray would wait in silence. A cluster that is yet to grow may."""
        found = [node["Resources"] for node in ray.nodes() if node["Alive"] and self._unit in node["Resources"]]
        if found and all(resources.get("memory", 0) < need for resources in found):
            most = max(resources.get("memory", 0) for resources in found)
            raise BadInput(
                f"--memory-gb: expected tasks that a node of the cluster has memory for, found {need / 1e9:.2g} GB for"
                f" a task ({PROCESS_BYTES / 1e9:g} of them for its process) and at most {most / 1e9:.2g} GB of a node"
            )


def _connect() -> None:
    """OSError if there is no cluster at RAY_ADDRESS, or none can be started; BadInput if that is no address."""
    address = os.environ.get("RAY_ADDRESS", "")
    host, _, port = address.rpartition(":")
    try:
        if host and port.isdigit() and "://" not in address:  # Ray itself would wait for minutes
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
        ray.init(address or "auto", **QUIETLY)
    except ValueError as error:
        raise BadInput(f"RAY_ADDRESS={address}: {error}") from None
    except OSError as error:
        if address:
            raise OSError(f"RAY_ADDRESS={address}: no Ray cluster can be reached there: {error}") from None
        _start()


def _start() -> None:
    """A cluster of this machine alone, for as long as this process lives."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's 15 starves beside other work
    own = {"num_cpus": devices.cores(), "object_store_memory": OBJECT_STORE_BYTES, "include_dashboard": False}
    try:
        ray.init("local", **own, **QUIETLY)
    except Exception as error:  # Ray raises just that where it has not started in half a minute
        raise OSError(f"Ray does not start on this machine: {error}") from None


def _variables(on_cpu: bool) -> dict[str, str]:
    """The environment of a worker process: as many threads of XLA as the local engine would have here, so that the bits
    are the same, and a cache of compiled programs.
    """
    passed = {name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)}
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.values["jax_compilation_cache_dir"] or ""),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    # A list that begins with an accelerator is an error where there is none; JAX would train on the CPU in silence.
    platforms = "cpu" if on_cpu else os.environ.get("JAX_PLATFORMS", "cuda,cpu")
    return passed | cache | {"JAX_PLATFORMS": platforms, "PJRT_NPROC": devices.threads(), "OPENBLAS_NUM_THREADS": "1"}


def _train(chunk: Chunk, versions: dict[str, str]) -> ChunkDone:
    """What a worker process does."""
    if (here := record.versions()) != versions:
        other = ", ".join(
            f"{name} {here.get(name)} for {versions.get(name)}" for name in versions if here.get(name) != versions[name]
        )
        raise BadInput(f"Ray node {socket.gethostname()}: expected the versions of the sweep, found {other}")
    done = runner.train(chunk, jax.local_devices()[0], lambda: False, lambda event: None)
    assert done  # nothing halts it
    return done


def _result(reference: Any) -> ChunkDone:
    try:
        return ray.get(reference)
    except exceptions.RayTaskError as error:
        raise error.cause from None
    except exceptions.RayError as error:
        raise OSError(f"Ray gave up a chunk; the same command goes on: {error}") from None

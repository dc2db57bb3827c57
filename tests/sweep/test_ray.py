"""A sweep on a cluster: a node is killed in the middle, nothing is lost, and the results are those of one machine."""

import importlib.util
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE

import jax
import pytest

from cli_helpers import TINY_VALUES, complaint, qrl
from qrl.runs import record
from qrl.sweep import runner
from qrl.sweep.grid import load
from qrl_envs.specfile import BadInput
from sweep_helpers import chunk_of, rows_of, write_grid

# CI has it: a test that is skipped for want of a tool is a failure there.
if not importlib.util.find_spec("ray") and not os.environ.get("QRL_REQUIRE_CROSS"):
    pytest.skip("Ray is not installed: pip install 'qrl[ray]'", allow_module_level=True)

import ray_nodes

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")

AXES = {"learning_rate": [1e-3, 1e-2], "task.rod.mass_kg": [1.3, 1.0]}
FIXED = {**TINY_VALUES, "num_timesteps": 20_000}


class Nodes:
    """The cluster of ray_nodes.py; it starts while others work."""

    def __init__(self) -> None:
        command = [sys.executable, ray_nodes.__file__]
        self.process = subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=subprocess.DEVNULL, text=True)
        self._address = ""

    @property
    def address(self) -> str:
        if not self._address:
            line = self._said("cluster ")
            _, self._address, raylet = line.split()
            self.raylet = int(raylet)
        return self._address

    def kill_second(self) -> None:
        assert self.process.stdin
        self.process.stdin.write("kill\n")
        self.process.stdin.flush()
        self._said("killed")

    def _said(self, begin: str) -> str:
        assert self.process.stdout
        return next(line for line in self.process.stdout if line.startswith(begin))


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    found = Nodes()
    try:
        yield found
    finally:
        found.process.communicate(timeout=60)  # closes its input


def trains(raylet: int) -> bool:
    """Whether a worker process of this node is at a task: Ray writes its name into the process's title."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rpartition(")")[2].split()[1])
            if parent == raylet and b"_train" in (status.parent / "cmdline").read_bytes():
                return True
        except OSError:  # gone meanwhile
            continue
    return False


def test_a_node_killed_in_mid_sweep_costs_nothing(
    nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every member has its result, equal to the bit to that of the local engine. What was recorded stays as it is."""
    monkeypatch.setattr(runner, "CPU_CHUNK", 1)
    grid, here, out = write_grid(tmp_path, AXES, fixed=FIXED), tmp_path / "local", tmp_path / "ray"
    assert qrl("sweep", grid, "--out", here) == 0
    (out / "chunks").mkdir(parents=True)
    for path in [here / "grid.json", here / "chunks" / "0000003.json"]:  # an interrupted sweep's
        (out / path.relative_to(here)).write_bytes(path.read_bytes())
    os.utime(out / "chunks" / "0000003.json", (1, 1))
    monkeypatch.setenv("RAY_ADDRESS", nodes.address)
    killed_at: list[int] = []

    def kill() -> None:
        until = time.monotonic() + 200
        while time.monotonic() < until:
            recorded = len(list((out / "chunks").glob("*.json")))
            if recorded > 1 and trains(nodes.raylet):
                nodes.kill_second()
                killed_at.append(recorded)
                return
            time.sleep(0.1)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    capsys.readouterr()
    assert qrl("sweep", grid, "--out", out, "--engine", "ray") == 0
    killer.join()
    assert killed_at
    assert killed_at[0] < 8
    assert "Ray, 2 CPUs of 2 nodes" in capsys.readouterr().out
    for table in ("results.csv", "curves.csv"):
        assert rows_of(out / table) == rows_of(here / table)
    assert (out / "best.json").read_text() == (here / "best.json").read_text()
    assert (out / "chunks" / "0000003.json").stat().st_mtime == 1
    assert sorted(runner.finished(out / "chunks")) == list(range(8))


def test_a_task_too_large_for_every_node_is_refused(
    nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ray would wait for a node that has room, without a word."""
    monkeypatch.setenv("RAY_ADDRESS", nodes.address)
    fixed = {name: value for name, value in FIXED.items() if name != "replay_unrolls"}
    grid = write_grid(tmp_path, {"gamma": [0.9], "replay_unrolls": [1_000_000]}, fixed=fixed, seeds=1)
    said = complaint(capsys, "sweep", grid, "--out", tmp_path / "out", "--engine", "ray", "--memory-gb", "50")
    assert "--memory-gb: expected tasks that a node of the cluster has memory for" in said
    assert "at most 4 GB of a node" in said


def test_a_node_of_other_versions_is_refused(tmp_path: Path) -> None:
    """Its bits would be others."""
    from qrl.sweep import ray_engine

    chunk = chunk_of(load(write_grid(tmp_path, {"gamma": [0.9]}), 1e9), 1)
    versions = record.versions() | {"jax": "0.1"}
    with pytest.raises(BadInput, match=rf"expected the versions of the sweep, found jax {jax.__version__} for 0.1$"):
        ray_engine._train(chunk, versions)


@pytest.mark.parametrize(
    ("address", "code", "words"),
    [
        ("127.0.0.1:1", 1, "RAY_ADDRESS=127.0.0.1:1: no Ray cluster can be reached there"),
        ("somewhere", 2, "RAY_ADDRESS=somewhere: Invalid address"),
    ],
)
def test_a_cluster_that_is_not_there_is_said_in_a_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    address: str,
    code: int,
    words: str,
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    grid = write_grid(tmp_path, {"gamma": [0.9]})
    assert qrl("sweep", grid, "--out", tmp_path / "out", "--engine", "ray") == code
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()

"""The Python API: train a run, load one, fly, evaluate and export its policy. The commands do the same."""

import argparse
import json
import time
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

import chex
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from qrl.algorithm.flights import Flights, summarize
from qrl.cli import train as command
from qrl.cli.export import export_run
from qrl.cli.main import configure_jax
from qrl.cli.terminal import console
from qrl.config import Config
from qrl.evaluation.starts import evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs.record import RunConfig


class DeployedPolicy:
    """The deterministic policy of a run.

    Called, it is NumPy in SI units: observations [..., F] -> actions [..., A]. `apply` is a pure function in JAX with
    explicit memory, to be jitted, vmapped or differentiated; its actions are in [−1, 1], as environments take them.
    """

    def __init__(self, run: TrainedRun) -> None:
        self._numpy = run.float_policy()
        self._run = run

    def __call__(self, observation: ArrayLike) -> NDArray[np.float64]:
        return self._numpy(np.asarray(observation))

    def init_memory(self) -> tuple[()]:
        """Memory at the start of a flight; empty for a feed-forward policy."""
        return ()

    def apply(self, memory: Any, observation: chex.Array) -> tuple[Any, chex.Array]:
        """Next memory and action; [..., F] -> [..., A]."""
        return memory, jnp.clip(self._run.policy_mean(observation), -1.0, 1.0)


class Run:
    """A trained run: its folder, and the policy of its last checkpoint."""

    def __init__(self, folder: Path) -> None:
        self._trained = TrainedRun.load(folder)
        self.folder = folder

    @property
    def config(self) -> RunConfig:
        return self._trained.config

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json: the last report and the seconds of the command."""
        return json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))

    @cached_property
    def policy(self) -> DeployedPolicy:
        return DeployedPolicy(self._trained)

    def fly(self, starts: int = 1000) -> Flights:
        """Flights of the policy from the first `starts` evaluation starts, in NumPy; leading axis: starts."""
        return self._trained.fly(evaluation_starts(starts))

    def evaluate(self, starts: int = 1000) -> dict[str, float]:
        """Return, success, settle times and steady-state errors from that many evaluation starts."""
        return summarize(self.fly(starts))

    def export(self, starts: int = 1000, vectors: int = 2000) -> Path:
        """Write the C kernel to `folder/export`, verified on `vectors` inputs and flown from `starts`; that folder.

        Raises BadInput for a network that the kernel cannot represent, AccumulatorOverflow and VerificationFailed.
        """
        export_run(self._trained, starts, vectors, lambda line: None)
        return self.folder / "export"


def load(folder: str | Path) -> Run:
    """The run of one seed in `folder`; BadInput, in one line, if there is none that can be read."""
    configure_jax()
    return Run(Path(folder))


def train(
    task: str,
    *,
    preset: str | None = None,
    config: Config | str | Path | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    quiet: bool = False,
    **hyperparameters: Any,
) -> Run:
    """Train a policy and return the run.

    task: a name (`qrl tasks` lists them), a path to a .json, or "module:factory" of an environment of your own
    preset: hyperparameters by name, in place of the task's preset
    config: a Config, or a config.json, whole or in part
    out: the run folder, by default runs/TASK; `resume` continues a run that it holds
    quiet: print nothing
    hyperparameters: fields of `Config`, such as gamma=0.97

    Raises BadInput where the input is wrong; NotFinite where training diverges.
    """
    configure_jax()
    if isinstance(config, Config):
        hyperparameters, config = config.model_dump() | hyperparameters, None
    flags = {f"learner.{name}": value for name, value in hyperparameters.items()}
    request: dict[str, Any] = {"task": task, "preset": preset, "config": Path(config) if config else None}
    request |= {"seed": seed, "seeds": 1, "out": Path(out) if out else None, "resume": resume}
    before, console.quiet = console.quiet, quiet
    try:
        with ExitStack() as stack:
            start_time = time.perf_counter()
            if plan := command.make_plan(argparse.Namespace(**request, **flags), stack):
                finished = command.run(plan, lambda: False)
                assert finished
                command.write_results(plan, finished, time.perf_counter() - start_time)
    finally:
        console.quiet = before
    return load(plan.out if plan else request["out"])

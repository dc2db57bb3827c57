"""The Python API: train a run, load one, fly, evaluate and export its policy. The commands do the same.

`train` and `load` set what holds for the whole process: JAX's persistent compilation cache (its folder, unless one is
configured already, and that all programs are kept), a filter that ignores warnings from within Brax, and, until JAX
initializes its devices, the number of CPU devices that suits the first run. Environment variables: OPENBLAS_NUM_THREADS
is set to 1 where it is unset; those that `train` sets for XLA are restored.
"""

import argparse
import json
import os
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError

from qrl import tasks
from qrl.algorithm.flights import Flights, summarize
from qrl.cli import train as command
from qrl.cli.export import export_run
from qrl.cli.main import configure_jax
from qrl.cli.terminal import console
from qrl.config import FORMER_NAMES, Config, current_names
from qrl.evaluation.starts import evaluation_starts
from qrl.evaluation.trained_run import TrainedRun, inputs_in_si
from qrl.runs import shipped
from qrl.runs.record import RunConfig
from qrl_envs.specfile import BadInput, CountOrZero, nearest

CACHE = "jax_compilation_cache_dir"
THREADS = "PJRT_NPROC"  # XLA's number of threads, which a run with small products sets


class DeployedPolicy:
    """The deterministic policy of a run.

    Called, it is NumPy in SI units: observations [..., F] -> actions [..., A]; not of a recurrent policy, which
    needs its memory. `apply` is a pure function in JAX with
    explicit memory, to be jitted, vmapped or differentiated; its actions are in [−1, 1], as environments take them.
    """

    def __init__(self, run: TrainedRun) -> None:
        self._numpy = run.float_policy()
        self._run = run

    def __call__(self, observation: ArrayLike) -> NDArray[np.float64]:
        if self._numpy.unit:
            raise TypeError("a recurrent policy: expected `apply`, with the memory that `init_memory` begins with")
        return self._numpy(inputs_in_si(self._numpy, np.asarray(observation)))

    def init_memory(self, *lanes: int) -> Any:
        """Memory at the start of so many flights, [*lanes, H]; () of a feed-forward policy."""
        return self._run.initial_memory(*lanes)

    def apply(self, memory: Any, observation: chex.Array) -> tuple[Any, chex.Array]:
        """Next memory and action; [..., F] -> [..., A]."""
        memory, action = self._run.act(memory, jnp.asarray(observation))
        return memory, jnp.clip(action, -1.0, 1.0)


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

    def export(self, starts: int = 1000, vectors: int = 2000, name: str | None = None) -> Path:
        """Write the C kernel to `folder/export`, verified on `vectors` inputs and flown from `starts`; that folder.

        name: prefix of all its names in C, by default `qrl_` and the task's name

        Raises BadInput for a network that the kernel cannot represent, AccumulatorOverflow and VerificationFailed.
        """
        export_run(self._trained, starts, vectors, lambda line: None, name)
        return self.folder / "export"


def load(folder: str | Path) -> Run:
    """The run of one seed in `folder`; BadInput, in one line, if there is none that can be read."""
    _configure_jax()
    return Run(shipped.run_folder(Path(folder)))


def train(
    task: str | Path,
    vehicle: str | Path | None = None,
    config: Config | str | Path | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    *,
    uncertainty: str | Path | None = None,
    reference: str | Path | None = None,
    preset: str | None = None,
    init: str | Path | None = None,
    resume: bool = False,
    quiet: bool = False,
    **hyperparameters: Any,
) -> Run:
    """Train a policy and return the run.

    task: a name (`qrl tasks` lists them), a path to a .json, or "module:factory" of an environment of your own
    vehicle: a shipped vehicle's name or a path to a .json, in place of the task's own
    config: a Config, or a config.json, whole or in part
    seed: by default that of the config.json or of the run that is resumed, else 0
    out: the run folder, by default runs/TASK
    uncertainty: what differs from flight to flight, a shipped name or a path to a .json, in place of the task's own
    reference: what a task tracks and is judged on, a shipped name or a path to a .json or .csv, in place of its own
    preset: hyperparameters by name, in place of the task's preset; not together with a Config, which has them all
    init: begin with the policy of that run, its folder or the name of one that ships; the preset is "fine_tune" then
    resume: continue the run that the folder holds; one that is complete is loaded
    quiet: print nothing
    hyperparameters: fields of `Config`, such as gamma=0.97; NumPy values are welcome

    Raises BadInput, in one line, where the input is wrong; NotFinite where training diverges.
    """
    _configure_jax()
    parts = {
        key: None if value is None else str(value)
        for key, value in (("vehicle", vehicle), ("uncertainty", uncertainty), ("reference", reference))
    }
    if isinstance(config, Config):
        if preset is not None:
            raise BadInput("qrl.train: expected preset or a Config, found both: a Config has all hyperparameters")
        hyperparameters, config = dict(config) | _checked(hyperparameters), None
    flags = {f"learner.{name}": value for name, value in _checked(hyperparameters).items()}
    folder = Path(out) if out else Path("runs") / tasks.folder_name(tasks.task_record(str(task), parts))
    if not resume and (folder / "config.json").exists():
        raise BadInput(f"{folder}: holds a run already; give another out, or resume=True to resume it")
    request = argparse.Namespace(
        task=str(task),
        **parts,
        config=Path(config) if config else None,
        seed=None if seed is None else _valid("seed", CountOrZero, seed),
        seeds=1,
        out=folder,
        preset=preset,
        init=None if init is None else str(init),
        resume=resume,
        **flags,
    )
    before, console.quiet = console.quiet, quiet
    try:
        with ExitStack() as stack:
            stack.enter_context(_environment_restored())
            start_time = time.perf_counter()
            if plan := command.make_plan(request, stack):
                finished = command.run(plan, lambda: False)
                assert finished
                command.write_results(plan, finished, time.perf_counter() - start_time)
    finally:
        console.quiet = before
    return load(folder)


def _checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters in plain Python under their current names; BadInput names the argument that is wrong."""
    hints = get_type_hints(Config, include_extras=True)
    for name in values:
        if name in FORMER_NAMES:
            warnings.warn(f"{name} is now {FORMER_NAMES[name]}", FutureWarning, stacklevel=3)
    values = current_names(values, "qrl.train")
    for name in values:
        if name not in Config.model_fields:
            known = [*Config.model_fields, "preset", "init", "resume", "quiet"]
            raise BadInput(f"qrl.train: unknown argument '{name}'{nearest(name, known)}")
    return {name: _valid(name, hints[name], value) for name, value in values.items()}


def _valid(name: str, kind: Any, value: Any) -> Any:
    """`value`, a NumPy or JAX one too, as the annotated type `kind`; no coercion between types."""
    adapter = TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))
    try:
        return adapter.validate_python(_plain(value))
    except ValidationError as error:
        problem = error.errors()[0]
        if problem["type"] == "value_error":  # of our own validators, whose messages are complete
            raise BadInput(f"qrl.train: {name}: {problem.get('ctx', {})['error']}") from None
        expected = problem["msg"].replace("Input should be", "expected")
        raise BadInput(f"qrl.train: {name}: {expected[0].lower()}{expected[1:]}, found {value!r:.60}") from None


def _plain(value: Any) -> Any:
    """NumPy's and JAX's scalars and arrays as Python's numbers and tuples."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        value = value.tolist()
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def _configure_jax() -> None:
    """As the commands do, but a cache folder that the program has configured stays."""
    folder = getattr(jax.config, CACHE)
    configure_jax()
    if folder is not None:
        jax.config.update(CACHE, folder)


@contextmanager
def _environment_restored() -> Iterator[None]:
    """A run's number of threads is not the user's: the next run, or a child process, is not to take it for that."""
    before = os.environ.get(THREADS)
    try:
        yield
    finally:
        os.environ.pop(THREADS, None)
        if before is not None:
            os.environ[THREADS] = before

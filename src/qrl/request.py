"""From what the user asked (task, flags, CONFIG, run folder) to a run that can start; BadInput if it cannot."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from qrl import tasks
from qrl.config import Config, with_defaults
from qrl.runs import record as records
from qrl.runs.record import ConfigFile, Init, RunConfig, TaskRecord
from qrl.training.devices import device_names
from qrl_envs import specfile
from qrl_envs.specfile import BadInput
from qrl_envs.task import shipped


def config_file(path: Path | None) -> ConfigFile:
    """What CONFIG holds, its task checked, a learner that is whole with all it leaves out; nothing without a CONFIG."""
    if path is None:
        return ConfigFile()
    file = specfile.build(ConfigFile, records.with_current_names(specfile.read(path), str(path)), str(path))
    record = file.task
    if isinstance(record, str):
        record = tasks.task_named(record, path)
    elif record:
        record = tasks.check_task_record(record, str(path))
    return file.model_copy(update={"task": record, "learner": with_defaults(file.learner)})


def run_config(
    task: str | None,
    config: Path | None,
    file: ConfigFile,
    flags: dict[str, Any],
    seed: int | None,
    seeds: int | None,
    parts: Mapping[str, str | None] = MappingProxyType({}),
    preset: str | None = None,
    init: tuple[Init, Config] | None = None,
) -> RunConfig:
    """The run asked for: flags over CONFIG (`file`, read from `config`) over `preset`, or the task's, over the default.

    `parts`: names or paths of the task's vehicle, uncertainty and reference, in place of its own. The run names no
    devices yet: JAX has not been asked for them. `init`: the policy that it begins with, and the learner of its run.
    """
    record = file.task
    assert not isinstance(record, str)  # config_file saw to it
    if task:
        asked = tasks.task_record(task, parts)
        if record and record != asked:
            raise BadInput(f"{config}: key 'task': expected the task asked for, '{task}', found '{record.name}'")
        record = asked
    elif given := next((name for name, value in parts.items() if value is not None), None):
        raise BadInput(f"--{given}: expected a TASK too")
    if not record:
        raise BadInput(f"no task given (known: {', '.join(shipped())}; all: qrl tasks)")
    run = RunConfig(
        task=record,
        learner=_learner(record, task or str(config), config, file.learner, flags, preset, init and init[1]),
        init=init and init[0],
        seed=next((s for s in (seed, file.seed) if s is not None), 0),
        seeds=seeds or file.seeds or 1,
        versions=records.versions(),
        devices=[],
    )
    return tasks.check_seed_range(run, str(config or "command line"))


def _learner(
    record: TaskRecord,
    where: str,
    config: Path | None,
    learner: dict[str, Any],
    flags: dict[str, Any],
    preset: str | None,
    known: Config | None,
) -> Config:
    base = tasks.task_preset(record, "--preset" if preset else where, preset, known) | learner
    file = f"{config}: learner" if config else f"preset of {record.name}"
    try:
        return specfile.build(Config, base | flags, "command line")
    except BadInput:
        specfile.build(Config, base, file)  # the file's fault, if it is wrong without the flags too
        raise


def changed_since(run: RunConfig) -> str:
    """Which packages and devices are others than those that a run began with."""
    now = records.versions()
    names = sorted(run.versions.keys() | now.keys())
    changed = [
        f"{name} was {run.versions.get(name, 'none')}, is {now.get(name, 'none')}"
        for name in names
        if run.versions.get(name) != now.get(name)
    ]
    if (here := device_names()) != run.devices:
        changed.append(f"devices were {', '.join(run.devices)}, are {', '.join(here)}")
    return "; ".join(changed)


def resumed(folder: Path, asked: RunConfig, given: dict[str, Any], seed: int | None, seeds: int | None) -> RunConfig:
    """The stored run, if what was asked does not differ from it."""
    run = tasks.load_run_config(folder)
    wrong = f"{folder / 'config.json'}: cannot resume:"
    if run.task != asked.task:
        raise BadInput(f"{wrong} it is a run of '{run.task.name}', and '{asked.task.name}' is not the same task")
    for name, found, wanted in (("seed", run.seed, seed), ("seeds", run.seeds, seeds)):
        if wanted is not None and wanted != found:
            raise BadInput(f"{wrong} key '{name}' is {found}, found {wanted} on the command line")
    if asked.init and asked.init != run.init:
        raise BadInput(f"{wrong} key 'init' is {run.init and run.init.run}, asked for {asked.init.run}")
    for name in given:
        found, wanted = getattr(run.learner, name), getattr(asked.learner, name)
        if found != wanted:
            raise BadInput(f"{wrong} key 'learner.{name}' is {found}, asked for {wanted}")
    return run

"""From what the user asked (task, flags, CONFIG, run folder) to a run that can start; BadInput if it cannot."""

from pathlib import Path
from typing import Any

import jax
from brax import envs
from brax.envs.base import Env

from qrl import runs
from qrl.config import Config
from qrl.runs import ConfigFile, RunConfig, TaskRecord
from qrl_envs import env as worlds
from qrl_envs import specfile
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput


def foreign_tasks() -> list[str]:
    """Brax's own environments, which can be trained by name too."""
    return sorted(set(envs._envs) - set(tasks.shipped()))  # Brax offers no public list


def task_record(name: str) -> TaskRecord:
    """The task of a shipped name, a `.json` path or one of Brax's names."""
    if name in foreign_tasks():
        return TaskRecord(name=name, spec=None)
    if name not in tasks.shipped() and not name.endswith(".json"):
        raise BadInput(f"unknown task '{name}'{specfile.nearest(name, [*tasks.shipped(), *foreign_tasks()])}")
    return TaskRecord(name=Path(name).stem, spec=tasks.load(name).model_dump(mode="json", exclude_none=True))


def environment(record: TaskRecord) -> Env:
    """The Brax environment of a recorded task."""
    if record.spec is None:
        return envs.get_environment(record.name)
    return worlds.from_task(tasks.from_data(record.spec, record.name))


def run_config(
    task: str | None, config: Path | None, flags: dict[str, Any], seed: int | None, seeds: int | None
) -> RunConfig:
    """The run asked for: flags over CONFIG over the task's preset over the default preset."""
    where = str(config)
    file = specfile.build(ConfigFile, specfile.read(config), where) if config else ConfigFile()
    record = task_record(file.task) if isinstance(file.task, str) else file.task
    if task:
        asked = task_record(task)
        if record and record != asked:
            raise BadInput(f"{where}: key 'task': expected the task asked for, '{task}', found '{record.name}'")
        record = asked
    if not record:
        raise BadInput(f"no task given (known: {', '.join(tasks.shipped())}; all: qrl tasks)")
    preset = record.spec["preset"] if record.spec else "default"
    if preset not in runs.presets():
        raise BadInput(f"{task}: key 'preset': no preset '{preset}'{specfile.nearest(preset, runs.presets())}")
    base = runs.preset(preset) | file.learner
    if file.learner:
        specfile.build(Config, base, f"{where}: learner")
    return RunConfig(
        task=record,
        learner=specfile.build(Config, base | flags, "command line" if flags else f"preset {preset}"),
        seed=next((s for s in (seed, file.seed) if s is not None), 0),
        seeds=seeds or file.seeds or 1,
        versions=runs.versions(),
        devices=[str(device) for device in jax.devices()],
    )


def check(env: Env, learner: Config) -> None:
    """Whether the learner can train on this environment at all."""
    size = env.observation_size
    if not isinstance(size, int):
        raise BadInput("this environment's observation is not one flat vector, which is all that qrl trains on")
    given = len(learner.observation_scale or ())
    if given not in (0, size):
        raise BadInput(f"key 'observation_scale': expected {size} numbers, one for each observation, found {given}")


def stored(folder: Path) -> RunConfig:
    """The config.json of a run folder."""
    path = folder / "config.json"
    if not path.exists():
        raise BadInput(f"{folder}: not a run folder (no config.json)")
    return specfile.build(RunConfig, specfile.read(path), str(path))


def resumed(folder: Path, asked: RunConfig, given: dict[str, Any], seed: int | None, seeds: int | None) -> RunConfig:
    """The stored run, if what was asked does not differ from it."""
    run = stored(folder)
    wrong = f"{folder / 'config.json'}: cannot resume:"
    if run.task != asked.task:
        raise BadInput(f"{wrong} it is a run of '{run.task.name}', and '{asked.task.name}' is not the same task")
    for name, found, wanted in (("seed", run.seed, seed), ("seeds", run.seeds, seeds)):
        if wanted is not None and wanted != found:
            raise BadInput(f"{wrong} key '{name}' is {found}, found {wanted} on the command line")
    for name in given:
        found, wanted = getattr(run.learner, name), getattr(asked.learner, name)
        if found != wanted:
            raise BadInput(f"{wrong} key 'learner.{name}' is {found}, asked for {wanted}")
    return run

"""From what the user asked (task, flags, CONFIG, run folder) to a run that can start; BadInput if it cannot."""

import contextlib
import io
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import jax

from qrl import runs
from qrl.config import Config
from qrl.runs import ConfigFile, RunConfig, TaskRecord
from qrl.state import spread
from qrl.types import Env
from qrl_envs import env as worlds
from qrl_envs import specfile
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput

MOST_SEEDS = 10_000  # of one program


def _brax_envs() -> ModuleType:
    """`brax.envs`: over a second to import, and wanted for its own environments alone."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints which optional packages it does not find
        from brax import envs

    return envs


def foreign_tasks() -> list[str]:
    """Brax's own environments, which can be trained by name too."""
    return sorted(set(_brax_envs()._envs) - set(tasks.shipped()))  # Brax offers no public list


def task_record(name: str) -> TaskRecord:
    """The task of a shipped name, a `.json` path or one of Brax's names."""
    if name not in tasks.shipped() and not name.endswith(".json"):
        if name in foreign_tasks():
            return TaskRecord(name=name, spec=None)
        raise BadInput(f"unknown task '{name}'{specfile.nearest(name, [*tasks.shipped(), *foreign_tasks()])}")
    spec = tasks.load(name).model_dump(mode="json", exclude_none=True)
    return TaskRecord(name=_folder(Path(name).stem, name), spec=spec)


def task_named(name: str, path: Path) -> TaskRecord:
    """The task that the file at `path` names."""
    try:
        return task_record(name)
    except BadInput as error:
        raise BadInput(f"{path}: key 'task': {error}") from None


def _folder(name: str, where: str) -> str:
    """A task's name, which its run's folder bears too."""
    if not name.strip(".") or set("/\0") & set(name) or len(os.fsencode(name)) > 255:
        raise BadInput(f"{where}: expected a task whose name can be a folder's, found '{name}'")
    return name


def environment(record: TaskRecord) -> Env:
    """The Brax environment of a recorded task."""
    if record.spec is None:
        return _brax_envs().get_environment(record.name)
    return worlds.from_task(spec(record))


def spec(record: TaskRecord) -> tasks.Task:
    """The task of a record of one of our own worlds."""
    assert record.spec is not None
    return tasks.from_data(record.spec, record.name)


def config_file(path: Path | None) -> ConfigFile:
    """What CONFIG holds, its task checked; nothing where there is no CONFIG."""
    if path is None:
        return ConfigFile()
    file = specfile.build(ConfigFile, specfile.read(path), str(path))
    record = file.task
    if isinstance(record, str):
        record = task_named(record, path)
    elif record:
        record = _checked(record, str(path))
    return file.model_copy(update={"task": record})


def _checked(record: TaskRecord, where: str) -> TaskRecord:
    if record.spec is not None:
        spec = tasks.from_data(record.spec, f"{where}: task.spec").model_dump(mode="json", exclude_none=True)
        return TaskRecord(name=_folder(record.name, f"{where}: key 'task.name'"), spec=spec)
    if record.name not in foreign_tasks():
        raise BadInput(f"{where}: key 'task.name': unknown task '{record.name}'")
    return record


def run_config(
    task: str | None, config: Path | None, file: ConfigFile, flags: dict[str, Any], seed: int | None, seeds: int | None
) -> RunConfig:
    """The run asked for: flags over CONFIG (`file`, read from `config`) over the task's preset over the default.

    It names no devices yet: JAX has not been asked for them.
    """
    record = file.task
    assert not isinstance(record, str)  # config_file saw to it
    if task:
        asked = task_record(task)
        if record and record != asked:
            raise BadInput(f"{config}: key 'task': expected the task asked for, '{task}', found '{record.name}'")
        record = asked
    if not record:
        raise BadInput(f"no task given (known: {', '.join(tasks.shipped())}; all: qrl tasks)")
    run = RunConfig(
        task=record,
        learner=_learner(record, task or str(config), config, file.learner, flags),
        seed=next((s for s in (seed, file.seed) if s is not None), 0),
        seeds=seeds or file.seeds or 1,
        versions=runs.versions(),
        devices=[],
    )
    return _countable(run, str(config or "command line"))


def _countable(run: RunConfig, where: str) -> RunConfig:
    """`run`, if each of its seeds can have its folder, and its number in the program."""
    if run.seeds > MOST_SEEDS or run.seed + run.seeds > 2**31:
        raise BadInput(
            f"{where}: expected at most {MOST_SEEDS:,} seeds, all of them below {2**31:,},"
            f" found {run.seeds:,} from {run.seed:,}"
        )
    return run


def preset(name: str, where: str) -> dict[str, Any]:
    """The preset of that name, which `where` names: all of the learner's values."""
    if name not in runs.presets():
        raise BadInput(f"{where}: no preset '{name}'{specfile.nearest(name, runs.presets())}")
    return runs.preset(name)


def task_preset(record: TaskRecord, where: str) -> dict[str, Any]:
    """The learner's defaults for a task, which `where` names."""
    return preset(record.spec["preset"] if record.spec else "default", f"{where}: the task's key 'preset'")


def _learner(
    record: TaskRecord, where: str, config: Path | None, learner: dict[str, Any], flags: dict[str, Any]
) -> Config:
    base = task_preset(record, where) | learner
    file = f"{config}: learner" if config else f"preset of {record.name}"
    try:
        return specfile.build(Config, base | flags, "command line")
    except BadInput:
        specfile.build(Config, base, file)  # the file's fault, if it is wrong without the flags too
        raise


def check(env: Env, learner: Config, where: str) -> None:
    """Whether the learner can train on this environment at all; `where` is who asks for it."""
    size = env.observation_size
    if not isinstance(size, int):
        raise BadInput(
            f"{where}: this environment's observation is not one flat vector, which is all that qrl trains on"
        )
    given = len(learner.observation_scale or ())
    if given not in (0, size):
        raise BadInput(
            f"{where}: key 'observation_scale': expected {size} numbers, one for each observation, found {given}"
        )
    try:
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_size,), jax.numpy.float32))
    except Exception as error:  # somebody else's environment: whatever it raises, it cannot be trained on
        raise BadInput(f"{where}: this environment does not work with jax {jax.__version__}: {error}") from None
    if learner.climbs and not hasattr(env, "evaluation"):  # ours are differentiable
        try:
            jax.eval_shape(
                jax.grad(lambda action: env.step(env.reset(jax.random.PRNGKey(0)), action).reward.sum()),
                jax.ShapeDtypeStruct((env.action_size,), jax.numpy.float32),
            )
        except Exception as error:
            raise BadInput(
                f"{where}: key 'apg_fraction': expected 0, for this environment cannot be differentiated: {error}"
            ) from None


def devices(run: RunConfig) -> str:
    """What a run trains on here, in words."""
    mesh = spread(jax.devices(), run.seeds, run.learner.logical_shards)
    count, there = mesh.size if mesh else 1, jax.device_count()
    of = f" of {there}" if count < there else ""
    return f"{count}{of} {jax.default_backend()} device{'s' * (count > 1 or bool(of))}"


def check_devices(run: RunConfig) -> None:
    """Whether every one of several processes has a part in the run."""
    mesh = spread(jax.devices(), run.seeds, run.learner.logical_shards)
    if jax.process_count() > 1 and (mesh.size if mesh else 1) < jax.device_count():
        raise BadInput(
            f"key 'shards': expected shares that the processes' {jax.device_count()} devices can divide among them,"
            f" found {run.learner.logical_shards}"
        )


def changed_since(run: RunConfig) -> str:
    """Which packages and devices are others than those that a run began with."""
    now = runs.versions()
    names = sorted(run.versions.keys() | now.keys())
    changed = [
        f"{name} was {run.versions.get(name, 'none')}, is {now.get(name, 'none')}"
        for name in names
        if run.versions.get(name) != now.get(name)
    ]
    if (here := device_names()) != run.devices:
        changed.append(f"devices were {', '.join(run.devices)}, are {', '.join(here)}")
    return "; ".join(changed)


def device_names() -> list[str]:
    """Those of all processes."""
    return [str(device) for device in jax.devices()]


def stored(folder: Path) -> RunConfig:
    """The config.json of a run folder."""
    path = folder / "config.json"
    if not path.exists():
        raise BadInput(f"{folder}: not a run folder (no config.json)")
    run = specfile.build(RunConfig, specfile.read(path), str(path))
    return _countable(run.model_copy(update={"task": _checked(run.task, str(path))}), str(path))


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

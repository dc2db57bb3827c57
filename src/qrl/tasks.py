"""From a task's name or file to an environment that can be trained: where learner and worlds meet."""

import contextlib
import importlib
import io
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import jax
import numpy as np

from qrl.algorithm.adapter import adapt
from qrl.algorithm.types import Env
from qrl.config import Config, load_preset
from qrl.runs.record import RunConfig, TaskRecord, with_current_names
from qrl_envs import env as worlds
from qrl_envs import specfile
from qrl_envs import task as task_spec
from qrl_envs.quadrotor_env import observed
from qrl_envs.reference import reference_data
from qrl_envs.specfile import BadInput
from qrl_envs.uncertainty import uncertainty_data
from qrl_envs.vehicle import vehicle_data

PRESET_RECOVERY_S = 0.6  # and the time scale of their vehicle, the paper's (Vehicle.recovery_s)
BASE_OBSERVATIONS = {"quadrotor": 18, "pendulum": 3}  # that each task of the world begins with
PRESET_PERIOD_S = {"quadrotor": 0.01, "pendulum": 0.05}  # control periods that the presets are made for


def _brax_envs() -> ModuleType:
    """`brax.envs`: over a second to import, and wanted for its own environments alone."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints which optional packages it does not find
        from brax import envs

    return envs


def foreign_tasks() -> list[str]:
    """Brax's own environments, which can be trained by name too."""
    return sorted(set(_brax_envs()._envs) - set(task_spec.shipped()))  # Brax offers no public list


def task_record(name: str, parts: Mapping[str, str | None] = MappingProxyType({})) -> TaskRecord:
    """The task of a shipped name, a `.json` path, one of Brax's names, or "module:factory"; of a task of our own worlds
    with other `parts`, a vehicle, an uncertainty and a reference, by name or file.
    """
    asked = {key: value for key, value in parts.items() if value is not None}
    own = name in task_spec.shipped() or name.endswith(".json")
    for key, value in asked.items():
        if not own:
            raise BadInput(f"task '{name}': has no {key} to replace by '{value}'")
    if ":" in name and not name.endswith(".json"):
        _call_factory(name)
        return TaskRecord(name=name, spec=None)
    if name not in task_spec.shipped() and not name.endswith(".json"):
        if name in foreign_tasks():
            return TaskRecord(name=name, spec=None)
        raise BadInput(f"unknown task '{name}'{specfile.nearest(name, [*task_spec.shipped(), *foreign_tasks()])}")
    folder = _folder("_".join(Path(part).stem for part in (name, *asked.values())), name)
    task = task_spec.load(name, **{key: value for key, value in asked.items() if key != "vehicle"})
    if vehicle := asked.get("vehicle"):
        if isinstance(task, task_spec.QuadrotorTask) and task.distribution:
            spread = uncertainty_data(asked.get("uncertainty", "default"))
            return _of_vehicle(TaskRecord(name=folder, spec=_spec_data(task)), vehicle, spread)
        task = task_spec.load(name, **asked)
    return TaskRecord(name=folder, spec=_spec_data(task))


def _spec_data(task: task_spec.Task) -> dict[str, Any]:
    return task.model_dump(mode="json", exclude_none=True)


def _call_factory(name: str) -> Env:
    """The environment that "module:factory" returns; modules in the current folder are found too. BadInput if none."""
    module_name, _, factory_name = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    stage = f"module '{module_name}' cannot be imported"
    try:
        module = importlib.import_module(module_name)
        if not callable(factory := getattr(module, factory_name, None)):
            near = specfile.nearest(factory_name, [n for n in dir(module) if not n.startswith("_")])
            raise BadInput(f"task '{name}': module '{module_name}' has no function '{factory_name}'{near}")
        stage = f"{factory_name}() failed"
        env: Any = factory()
        missing = [a for a in ("reset", "step", "observation_size", "action_size") if not hasattr(env, a)]
    except BadInput:
        raise
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise BadInput(f"task '{name}': {stage}: {type(error).__name__}: {error}") from None
    if missing:
        raise BadInput(
            f"task '{name}': expected an environment with Brax's reset and step, found {type(env).__name__}"
            f" without {', '.join(missing)}"
        )
    return env


def folder_name(record: TaskRecord) -> str:
    """Default name of a run folder: the task's, or its factory's."""
    return record.name if record.spec else record.name.rpartition(":")[2]


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
    if ":" in record.name and record.spec is None:
        return _call_factory(record.name)
    if record.spec is None:
        return _brax_envs().get_environment(record.name)
    return worlds.from_task(spec(record))


def spec(record: TaskRecord) -> task_spec.Task:
    """The task of a record of one of our own worlds."""
    assert record.spec is not None
    return task_spec.from_data(record.spec, record.name)


def following(record: TaskRecord, reference: str | None = None, vehicle: str | None = None) -> TaskRecord:
    """The task flown with the reference and the vehicle of these names or files, in place of its own; None: its own.

    Another vehicle is for a policy of any vehicle, whose motors it takes in the order that the policy knows.
    """
    if reference is None and vehicle is None:
        return record
    if reference is not None:
        if "reference" not in (given := record.spec or {}):
            raise BadInput(f"--reference: expected a task that tracks one, found '{record.name}'")
        given = task_spec.with_reference(given, reference_data(reference))
        task = task_spec.from_data(given, f"{record.name} with reference {reference}")
        record = TaskRecord(name=record.name, spec=_spec_data(task))
    return record if vehicle is None else _of_vehicle(record, vehicle, {})


def _of_vehicle(record: TaskRecord, vehicle: str, uncertainty: dict[str, Any]) -> TaskRecord:
    """A task of any vehicle, of this one alone."""
    if "distribution" not in (given := record.spec or {}):
        raise BadInput(f"--vehicle: expected a policy of any vehicle, found one of '{record.name}'")
    own = vehicle_data(vehicle)
    motors = _like(own.get("motors", []), given["vehicle"]["motors"], vehicle)
    given = {key: value for key, value in given.items() if key != "distribution"}
    given |= {"vehicle": {**own, "motors": motors}, "uncertainty": uncertainty}
    task = task_spec.from_data(given, f"{record.name} with vehicle {vehicle}")
    return TaskRecord(name=record.name, spec=_spec_data(task))


def _like(motors: list[Any], known: list[dict[str, Any]], where: str) -> list[dict[str, Any]]:
    """`motors` in the order of those `known`: each in its quarter about body z, with its spin."""

    def quarter(motor: dict[str, Any]) -> tuple[bool, bool, int]:
        x, y = motor["position_m"][:2]
        return x > 0, y > 0, motor["spin"]

    try:
        found = {quarter(motor): motor for motor in motors}
        if len(motors) == len(known) and all(_along_z(motor) for motor in motors):
            return [found[quarter(motor)] for motor in known]
    except (KeyError, TypeError, ValueError):
        pass
    places = ", ".join(f"x {p['position_m'][0]:+.2g}, y {p['position_m'][1]:+.2g}: {p['spin']:+d}" for p in known)
    raise BadInput(
        f"{where}: key 'motors': expected one along body z in each quarter about it, with the spins of {places}"
    )


def _along_z(motor: dict[str, Any]) -> bool:
    x, y, _ = motor.get("axis", (0.0, 0.0, 1.0))
    return x == y == 0.0


def check_task_record(record: TaskRecord, where: str) -> TaskRecord:
    if record.spec is not None:
        spec = _spec_data(task_spec.from_data(record.spec, f"{where}: task.spec"))
        return TaskRecord(name=_folder(record.name, f"{where}: key 'task.name'"), spec=spec)
    if ":" in record.name:
        try:
            _call_factory(record.name)
        except BadInput as error:
            raise BadInput(f"{where}: key 'task.name': {error}") from None
    elif record.name not in foreign_tasks():
        raise BadInput(f"{where}: key 'task.name': unknown task '{record.name}'")
    return record


def preset(name: str, where: str) -> dict[str, Any]:
    """The preset of that name, which `where` names: all of the learner's values."""
    try:
        return load_preset(name)
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


# Of a learner's values those that say what the policy's network is.
NETWORK = (
    "policy_hidden_layer_sizes",
    "policy_gru_size",
    "activation",
    "observation_scale",
    "observation_limit",
    "normalize_observations",
)
FINE_TUNING = "fine_tune"  # the preset of a run that begins with a trained policy


def task_preset(record: TaskRecord, where: str, name: str | None = None, known: Config | None = None) -> dict[str, Any]:
    """The learner's defaults for a task, which `where` names: its preset, or that of `name`, carried over to it.

    A run that begins with a policy which the learner `known` trained has its network, and a preset of its own.
    """
    if known:
        name = name or FINE_TUNING
    if record.spec is None:
        values = preset(name or "default", where)
        return values | {key: getattr(known, key) for key in NETWORK} if known else values
    values = preset(name or record.spec["preset"], where if name else f"{where}: the task's key 'preset'")
    if known:
        scale = known.observation_scale
        values |= {key: getattr(known, key) for key in NETWORK}
        values["observation_scale"] = scale and list(scale[: BASE_OBSERVATIONS[record.spec["world"]]])
    return _carried_over(values, spec(record))


def _carried_over(values: dict[str, Any], task: task_spec.Task) -> dict[str, Any]:
    """A preset made for the shipped task of its world, for another one: durations keep their seconds at another control
    period, APG flies longer with a slower vehicle, and scales follow the size and the speed of a circle.
    """
    rate = PRESET_PERIOD_S[task.world] / task.control_period_s
    steps = ("num_timesteps", "episode_length", "unroll_length", "apg_episode_length")
    values = values | {name: max(1, round(values[name] * rate)) for name in steps if values[name]}
    if parts := values.get("apg_split", 1):
        values["apg_episode_length"] = parts * max(1, round(values["apg_episode_length"] / parts))
    values["gamma"] = float(values["gamma"]) ** (1.0 / rate)
    if isinstance(task, task_spec.QuadrotorTask) and task.distribution is None:
        slower = task.vehicle.recovery_s / PRESET_RECOVERY_S
        # Flights of APG that are over before the vehicle has settled teach it nothing about precision.
        longer = min(4, 2 ** max(0, round(np.log2(slower))))
        flights = max(values["apg_num_envs"] // longer, 8)
        values |= {"apg_episode_length": values["apg_episode_length"] * longer, "apg_num_envs": flights}
        if not (vehicle := task.vehicle).ideal:
            each = vehicle.action_scale_N * len(vehicle.motors) / vehicle.mass_kg
            values["apg_learning_rate"] *= min(1.0, PRESET_ACTION_M_S2 / each)
    if isinstance(task, task_spec.QuadrotorTask) and not task.ideal and values["observation_scale"]:
        values["observation_scale"] = [*values["observation_scale"], *_other_scales(task)]
    reward = task.reward
    if isinstance(reward, task_spec.CircleReward) and values["observation_scale"]:
        length, speed = max(1.0, reward.radius_m), max(1.0, abs(reward.speed_m_s) / 2.0)
        rotation, position, velocity, other = np.split(np.array(values["observation_scale"]), [9, 12, 15])
        scale = np.concatenate([rotation, position / length, velocity / speed, other])
        values |= {"observation_scale": scale.tolist(), "reward_scaling": values["reward_scaling"] / length}
    return values


# What a unit of action accelerates a vehicle by, up to which APG has its preset's step size. At the Hummingbird's 90 it
# lost a policy that flew.
PRESET_ACTION_M_S2 = 22.1
INTEGRAL_SCALE_1_M_S = 6.0
PREVIEW_SCALE_S_M = 0.5


def _other_scales(task: task_spec.QuadrotorTask) -> list[float]:
    """Scales of what an environment of a real vehicle observes beside the 18 numbers of the paper's."""
    of = observed(task)
    known = [PREVIEW_SCALE_S_M] * of.preview + [1.0] * of.previous_action + [INTEGRAL_SCALE_1_M_S] * of.integral
    return known + [1.0] * of.critic


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
    if (given := len(learner.observation_limit or ())) > size:
        raise BadInput(f"{where}: key 'observation_limit': expected at most {size} numbers, found {given}")
    _check_frame(env, learner, where)
    try:
        adapt(env)
    except ValueError as error:
        raise BadInput(f"{where}: {error}") from None
    try:
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_size,), jax.numpy.float32))
    except Exception as error:  # somebody else's environment: whatever it raises, it cannot be trained on
        raise BadInput(f"{where}: this environment does not work with jax {jax.__version__}: {error}") from None
    if learner.num_apg_updates and not adapt(env).differentiable:
        try:
            jax.eval_shape(
                jax.grad(lambda action: env.step(env.reset(jax.random.PRNGKey(0)), action).reward.sum()),
                jax.ShapeDtypeStruct((env.action_size,), jax.numpy.float32),
            )
        except Exception as error:
            raise BadInput(
                f"{where}: key 'apg_fraction': expected 0, for this environment cannot be differentiated: {error}"
            ) from None


def _check_frame(env: Env, learner: Config, where: str) -> None:
    """Whether what a policy is given in the body frame is scaled alike along all axes."""
    if (view := getattr(env, "body_view", None)) is None:
        return
    if learner.normalize_observations:
        raise BadInput(f"{where}: key 'normalize_observations': expected false for a task with policy_frame 'body'")
    scale = learner.observation_scale or (1.0,) * (env.observation_size)
    if {*scale[:9]} != {1.0}:
        raise BadInput(
            f"{where}: key 'observation_scale': expected 1 for the rotation matrix, for a task with policy_frame"
            f" 'body'; found {list(scale[:9])}"
        )
    seen = getattr(env, "policy_observation_size", None) or 18
    vectors = [slice(at, at + 3) for at in (9, 12, *range(18, 18 + 3 * view.vectors, 3))]
    for part in [*vectors, slice(seen - view.last, seen)]:
        if len({*scale[part]}) > 1:
            raise BadInput(
                f"{where}: key 'observation_scale': expected the same of numbers {part.start + 1} to {part.stop}, which"
                f" are a vector, for a task with policy_frame 'body'; found {list(scale[part])}"
            )


MOST_SEEDS = 10_000  # of one program


def check_seed_range(run: RunConfig, where: str) -> RunConfig:
    """`run`, if each of its seeds can have its folder, and its number in the program."""
    if run.seeds > MOST_SEEDS or run.seed + run.seeds > 2**31:
        raise BadInput(
            f"{where}: expected at most {MOST_SEEDS:,} seeds, all of them below {2**31:,},"
            f" found {run.seeds:,} from {run.seed:,}"
        )
    return run


def load_run_config(folder: Path) -> RunConfig:
    """The config.json of a run folder."""
    path = folder / "config.json"
    if not path.exists():
        raise BadInput(f"{folder}: not a run folder (no config.json)")
    run = specfile.build(RunConfig, with_current_names(specfile.read(path), str(path)), str(path))
    return check_seed_range(run.model_copy(update={"task": check_task_record(run.task, str(path))}), str(path))

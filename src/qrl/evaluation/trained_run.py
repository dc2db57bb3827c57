"""A trained run: load a checkpoint, fly its policy in any environment, and get it as a value to export."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import chex
import numpy as np
from numpy.typing import NDArray

from qrl import tasks
from qrl.algorithm.adapter import adapt
from qrl.algorithm.flights import Flights
from qrl.algorithm.learner import MAX_NORMALIZED, LearnerState
from qrl.algorithm.running_statistics import std
from qrl.algorithm.types import Env
from qrl.evaluation import calibration
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.evaluation.host_flights import HostFlights
from qrl.evaluation.starts import calibration_starts
from qrl.export.policy import (
    ActionSpec,
    BodyFrame,
    GatedUnit,
    Integral,
    Layer,
    Memory,
    ObservationSpec,
    Policy,
    Provenance,
)
from qrl.runs import record
from qrl.runs.record import RunConfig
from qrl_envs import io_spec
from qrl_envs import task as task_spec
from qrl_envs.plant import integrator
from qrl_envs.quadrotor_env import RealQuadrotorEnv
from qrl_envs.specfile import BadInput
from qrl_envs.task import QuadrotorTask, Task
from qrl_envs.vehicle import shipped_vehicles

POSITION = 9  # index of the position in an observation
HostStep = Callable[[Any, NDArray[np.float32]], tuple[Any, NDArray[np.floating]]]
"""Memory and observation [n, I] of n flights -> next memory, and action [n, A] in SI units."""


class TrainedRun:
    """The policy of one seed at one checkpoint."""

    def __init__(
        self, folder: Path, config: RunConfig, programs: FlightPrograms, learner: LearnerState, env_steps: int
    ) -> None:
        self.folder = folder
        self.config = config
        self.env = programs.env
        self.env_steps = env_steps  # of training
        self.max_episode_steps = programs.max_episode_steps
        self.task = tasks.spec(config.task) if config.task.spec else None  # None: not one of qrl_envs
        self._programs = programs
        self._learner = learner
        self._on_host: dict[bool, HostFlights] = {}  # by whether they calibrate

    @classmethod
    def load(cls, folder: Path, checkpoint: int = -1, programs: FlightPrograms | None = None) -> "TrainedRun":
        """The run in `folder`, which holds one seed, at a checkpoint: −1 the last, −2 the one before, and so on.

        `programs` of a run with the same configuration avoid compiling again. Raises BadInput, in one line, if there is
        no such checkpoint or it cannot be read.
        """
        found = next(islice(cls.checkpoints(folder, -checkpoint, programs), -checkpoint - 1, None), None)
        if found is None:
            raise BadInput(f"{folder}: expected {-checkpoint} checkpoints or more")
        return found

    @classmethod
    def checkpoints(cls, folder: Path, most: int, programs: FlightPrograms | None = None) -> "Iterator[TrainedRun]":
        """The last `most` checkpoints, newest first, each read when it is needed; otherwise as `load`."""
        config = tasks.load_run_config(folder)
        if config.seeds > 1:
            one = record.member_folders(folder, config)[0]
            raise BadInput(f"{folder}: holds {config.seeds} seeds; name one of them, such as RUN={one}")
        programs = programs or FlightPrograms(tasks.environment(config.task), config.learner)
        try:
            for learner, env_steps in programs.checkpoints(config, folder, most):
                yield cls(folder, config, programs, learner, env_steps)
        except OSError as error:
            raise BadInput(str(error)) from None

    @property
    def deployed(self) -> LearnerState:
        """The learner in NumPy, float64, with the policy that is deployed."""
        return self._programs.deployed(self._learner)

    def fly(self, starts: chex.PRNGKey, env: Env | None = None) -> Flights:
        """Deterministic flights of the float policy in NumPy, leading axis: starts; `env`: by default the run's own."""
        return self._programs.fly(self._learner, env or self.env, starts)

    def fly_host_policy(
        self, step: HostStep, memory: Any, starts: chex.PRNGKey, from_envelope: float = 0.0, calibrating: bool = False
    ) -> Flights:
        """Flights of a NumPy policy in the run's environment; a fraction `from_envelope` starts in the envelope. Where
        the task tracks a reference, `calibrating` follows those of training.

        `memory`, of all starts, is that of the first step. Compiled once for each number of starts.
        """
        _, actions = self._specs()
        offset, scale = (np.array([getattr(action, name) for action in actions]) for name in ("offset", "scale"))

        def normalized(memory: Any, observation: NDArray[np.float32]) -> tuple[Any, NDArray[np.floating]]:
            memory, action = step(memory, observation)
            return memory, (action - offset) / scale

        if calibrating not in self._on_host:
            env = self.env.calibrating() if calibrating and isinstance(self.env, RealQuadrotorEnv) else self.env
            self._on_host[calibrating] = HostFlights(env, self.max_episode_steps)
        return self._on_host[calibrating].fly(normalized, memory, starts, from_envelope)

    def initial_memory(self, *lanes: int) -> Any:
        """The policy's memory at the start of a flight; [*lanes, H], or () of a feed-forward policy."""
        return self._programs.initial_memory(*lanes)

    def act(self, memory: Any, observation: chex.Array) -> tuple[Any, chex.Array]:
        """Next memory and mean action of the deployed policy as a pure JAX function; [..., F] -> [..., A]."""
        return self._programs.act(self._learner, memory, observation)

    def policy(self, memory: Memory | None = None) -> Policy:
        """The policy to deploy, calibrated on observations of its own flights. BadInput without a control period.

        `memory`: as `float_policy` takes it.
        """
        policy, flown = self.float_policy(memory), []

        def step(h: NDArray[np.floating], observation: NDArray[np.float32]) -> tuple[Any, NDArray[np.floating]]:
            inputs = np.concatenate([inputs_in_si(policy, observation), h], axis=-1)  # the environment keeps the rest
            flown.append(inputs.astype(np.float32))
            return policy.respond(inputs)

        starts = calibration_starts(calibration.STARTS)
        h = np.zeros((len(starts), policy.memory.units if policy.memory else 0))
        flights = self.fly_host_policy(step, h, starts, from_envelope=calibration.FROM_ENVELOPE, calibrating=True)
        inputs = np.stack(flown, axis=1)
        ended = np.isnan(np.asarray(flights.observations)[:, :-1]).any(axis=-1, keepdims=True)
        return replace(policy, calibration=calibration.select(np.where(ended, np.nan, inputs)))

    def float_policy(self, memory: Memory | None = None) -> Policy:
        """The policy as a value in SI units, without observations to calibrate on.

        With `memory`, by default the task's, the environment's observation is the measured one [F], then what `Memory`
        says in its order: the previous action a [A] in [−1, 1], the integral [k] in m·s; then what the policy does not
        see, if anything.
        """
        config, deployed = self.config.learner, self.deployed
        units = config.policy_gru_size or 0
        memory = replace(memory, units=units) if memory else self._memory(units)
        layers, unit = _layers(deployed.params.policy["params"], recurrent=bool(config.policy_gru_size))
        view = getattr(self.env, "body_view", None)
        body_frame = BodyFrame(*view) if view else None
        normalize = config.normalize_observations
        observations, actions = self._specs()
        size = len(layers[0][0])  # of what the policy sees
        if body_frame:
            size = body_frame.measured + (memory.size(len(actions)) if memory else 0)
        mean = np.asarray(deployed.statistics.mean)[:size] if normalize else np.zeros(size)
        gain = 1.0 / np.asarray(std(deployed.statistics))[:size] if normalize else np.ones(size)
        offset_si, scale_si = _units(actions, size, memory)
        return Policy(
            provenance=Provenance(
                run=self.folder.resolve().name,
                task=self.config.task.name,
                description=self.task.description if self.task else "an environment without a task file",
                vehicle=vehicle_name(self.task),
                commit=self.config.versions.get("commit", "unknown"),
                seed=self.config.seed,
                env_steps=self.env_steps,
            ),
            control_period_s=self._control_period_s(),
            observations=observations,
            actions=actions,
            observation_offset=offset_si + scale_si * mean,
            observation_gain=gain / scale_si,
            observation_clip=np.full(size, MAX_NORMALIZED)
            if normalize
            else config.observation_limits(size).astype(float),
            observation_scale=np.asarray(config.observation_scale or np.ones(size))[:size],
            layers=layers,
            activation=config.activation,
            calibration=np.zeros((0, size + (memory.units if memory else 0)), np.float32),
            memory=memory,
            body_frame=body_frame,
            unit=unit,
        )

    def tail_steps(self) -> int:
        """Steps at the end of a flight in which success is measured."""
        if self.task is None:
            return self.max_episode_steps // 4
        return round(self.task.evaluation.tail_s / self.task.control_period_s)

    def _memory(self, units: int) -> Memory | None:
        """The memory that the task gives its policy, and that of a recurrent one."""
        if not isinstance(self.task, QuadrotorTask) or self.task.memory == task_spec.Memory():
            return Memory(previous_action=False, integral=None, units=units) if units else None
        integral = integrator(self.task)
        return Memory(
            units=units,
            previous_action=self.task.memory.previous_action,
            integral=integral
            and Integral(
                tuple(POSITION + axis for axis in range(3)), integral.radius_m, integral.limit_m_s, integral.circle_m
            ),
        )

    def _control_period_s(self) -> float:
        period = self.task.control_period_s if self.task else adapt(self.env).control_period_s
        if period is None:
            raise BadInput(f"{self.folder}: the environment '{self.config.task.name}' does not define `dt`")
        return float(period)

    def _specs(self) -> tuple[tuple[ObservationSpec, ...], tuple[ActionSpec, ...]]:
        if self.task:
            return (
                tuple(ObservationSpec(**spec._asdict()) for spec in io_spec.observations(self.task)),
                tuple(ActionSpec(**spec._asdict()) for spec in io_spec.actions(self.task)),
            )
        sizes: Any = self.env.observation_size, self.env.action_size
        frame = "as the environment defines it"
        action = ActionSpec("", "?", frame, offset=0.0, scale=1.0, low=-1.0, high=1.0, safe=0.0)
        return (
            tuple(ObservationSpec(f"o{i}", "?", frame) for i in range(sizes[0])),
            tuple(replace(action, name=f"a{i}") for i in range(sizes[1])),
        )


def _layers(params: dict[str, Any], recurrent: bool) -> tuple[tuple[Layer, ...], GatedUnit | None]:
    """The layers of a policy network's parameters, and its recurrent unit."""

    def layer(name: str) -> Layer:
        return params[name]["kernel"], params[name]["bias"]

    if not recurrent:
        return tuple(layer(f"Dense_{i}") for i in range(len(params))), None
    hidden = tuple(layer(f"layers_{i}") for i in range(sum(name.startswith("layers_") for name in params)))
    own, candidate = params["of_memory"]["kernel"], params["candidate_bias"]
    unit = GatedUnit(layer("of_input"), (own, np.pad(candidate, (2 * len(own), 0))))
    return (*hidden, layer("of_output")), unit


def vehicle_name(task: Task | None) -> str | None:
    """The name of the shipped vehicle that the task flies; None if it flies another, or none."""
    if not isinstance(task, QuadrotorTask):
        return None
    shipped = {name: task_spec.load("hover", name) for name in shipped_vehicles()}
    return next((name for name, hover in shipped.items() if getattr(hover, "vehicle", None) == task.vehicle), None)


def inputs_in_si(policy: Policy, observation: NDArray[np.floating]) -> NDArray[np.float64]:
    """The policy's inputs [..., I] in SI units, of the environment's observation, which begins with them."""
    size = len(policy.observation_scale)
    offset, scale = _units(policy.actions, size, policy.memory)
    return offset + scale * observation[..., :size]


def flown_inputs(policy: Policy, flights: Flights) -> NDArray[np.float32]:
    """The policy's inputs [n, steps, I] in SI units at each step of its flights, NaN from where one ended early.

    Made of the actions and of what was recorded, the truth: with noisy sensors not what the policy was given.
    """
    measured = np.asarray(flights.observations)[:, :-1, : len(policy.observations)]
    parts = [measured]
    if policy.memory and policy.memory.previous_action:
        actions = policy.to_si(np.asarray(flights.actions))
        first = policy.initial_memory(len(actions))[:, None, : actions.shape[-1]]
        parts.append(np.concatenate([first, actions[:, :-1]], axis=1))
    if policy.memory and policy.memory.integral:
        totals = [np.zeros((len(measured), policy.memory.integral.size))]
        for observation in measured.swapaxes(0, 1):
            totals.append(policy.integrated(totals[-1], observation))
        parts.append(np.stack(totals[1:], axis=1))
    inputs = np.concatenate(parts, axis=-1).astype(np.float32)
    if policy.unit is None:
        return inputs
    remembered = [np.zeros((len(inputs), policy.memory.units if policy.memory else 0))]
    for now in inputs.swapaxes(0, 1):
        remembered.append(policy.respond(np.concatenate([now, remembered[-1]], axis=-1))[0])
    return np.concatenate([inputs, np.stack(remembered[:-1], axis=1)], axis=-1).astype(np.float32)


def _units(actions: tuple[ActionSpec, ...], size: int, memory: Memory | None) -> tuple[Any, Any]:
    """Offset and scale [I] from the environment's observation to SI units: those of the action for the previous one."""
    offset, scale = np.zeros(size), np.ones(size)
    if memory and memory.previous_action:
        first = size - memory.size(len(actions))
        at = slice(first, first + len(actions))
        offset[at], scale[at] = [port.offset for port in actions], [port.scale for port in actions]
    return offset, scale

"""From a run folder to the policy as a value, flown in float and in integers, and to its export folder."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from qrl import tasks
from qrl.algorithm import flights as evaluate
from qrl.algorithm import learner
from qrl.algorithm.adapter import adapt
from qrl.algorithm.flights import Flights, summarize
from qrl.algorithm.learner import MAX_NORMALIZED
from qrl.algorithm.running_statistics import std
from qrl.algorithm.types import Env, State
from qrl.export import baseline, emit
from qrl.export import kernel as integer
from qrl.export.accuracy import Answer, accuracy
from qrl.export.kernel import Kernel
from qrl.export.policy import Acted, Observed, Origin, Policy
from qrl.export.prove import Proof, prove
from qrl.export.quantise import Inexpressible, quantise, si_layers
from qrl.export.report import Flown, Measured, report
from qrl.runs import record
from qrl.training import restore
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import io_spec
from qrl_envs.specfile import BadInput

EVALUATION_STARTS_SEED = 1_000_003  # other starts than the reports'
STARTS = 1000  # that `qrl evaluate` flies; a start's index is its place among them
CALIBRATION_STARTS_SEED = 7_000_003  # and others again
CALIBRATION_STARTS = 1000
ENVELOPE = 0.2  # of them that are the envelope's, not the task's own
TRANSIENT_STEPS = 200  # of a flight's start
SAMPLES = 32_768
SHARES = {"transient": 0.7, "settled": 0.2, "envelope": 0.1}


class Run:
    """The last checkpoint of one seed, ready to fly. BadInput, in a line, where there is none that can be read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = tasks.load_run_config(folder)
        if self.config.seeds > 1:
            one = record.member_folders(folder, self.config)[0]
            raise BadInput(f"{folder}: holds {self.config.seeds} seeds; name one of them, such as RUN={one}")
        self.env: Env = tasks.environment(self.config.task)
        try:
            self.trainer = make_trainer(self.env, self.config.learner)
            found = restore.iter_learners(self.trainer.setup.spec, self.config, folder, 1)
            self.learner, self.env_steps = next(found)
        except OSError as error:
            raise BadInput(str(error)) from None
        self._task = tasks.spec(self.config.task) if self.config.task.spec else None
        self._fly = jax.jit(self._flights, static_argnums=0)

    def fly(self, starts: chex.PRNGKey) -> Flights:
        """Flights of the float policy as `qrl evaluate` makes them; leading axis: starts."""
        points = stack([member_inputs(self.env, self.config.learner)])
        return jax.tree.map(lambda x: np.asarray(x[0]), self.trainer.fly(self.learner, points, starts))

    def fly_with(self, policy: Policy, answer: Answer, starts: chex.PRNGKey, envelope: float = 0.0) -> Flights:
        """Flights with `answer` in the policy's place; the last starts, that fraction, are of the envelope."""

        def ask(observation: NDArray[np.float32]) -> NDArray[np.float32]:
            return ((answer(np.asarray(observation)) - policy.offset) / policy.scale).astype(np.float32)

        self._ask = ask
        wide = jnp.arange(len(starts)) >= (1.0 - envelope) * len(starts)
        return jax.tree.map(np.asarray, self._fly(len(policy.acted), starts, wide))

    def _flights(self, action_size: int, starts: chex.PRNGKey, wide: chex.Array) -> Flights:
        """One program whoever answers: the host is asked at every step."""

        def mean(observation: chex.Array) -> chex.Array:
            shape = jax.ShapeDtypeStruct((*observation.shape[:-1], action_size), jnp.float32)
            return jax.pure_callback(lambda o: self._ask(o), shape, observation)

        def start(env: Env, wide: chex.Array, key: chex.PRNGKey) -> State:
            return jax.tree.map(lambda a, b: jnp.where(wide, a, b), adapt(env).reset_calibration(key), env.reset(key))

        return evaluate.fly(
            self.env,
            mean,
            starts,
            self.trainer.setup.max_episode_steps,
            lambda env, keys: jax.vmap(partial(start, env))(wide, keys),
        )

    def policy(self) -> Policy:
        """The policy that ships, with observations of its own flights to calibrate on."""
        config, spec = self.config.learner, self.trainer.setup.spec
        shipped = jax.tree.map(lambda x: np.asarray(x[0], np.float64), learner.deployed(spec, self.learner))
        layers = shipped.params.policy["params"]
        size = spec.observation_size
        deviation = np.asarray(std(shipped.statistics))
        observed, acted = self._ports()
        policy = Policy(
            origin=self._origin(),
            control_period_s=self._task.control_period_s if self._task else self._foreign_period_s(),
            observed=observed,
            acted=acted,
            observation_offset=shipped.statistics.mean if config.normalize_observations else np.zeros(size),
            observation_gain=1.0 / deviation if config.normalize_observations else np.ones(size),
            observation_clip=MAX_NORMALIZED if config.normalize_observations else np.inf,
            observation_scale=np.asarray(config.observation_scale or np.ones(size)),
            layers=tuple((layers[f"Dense_{i}"]["kernel"], layers[f"Dense_{i}"]["bias"]) for i in range(len(layers))),
            activation=config.activation,
            calibration=np.zeros((0, size), np.float32),
        )
        return replace(policy, calibration=self._calibration(policy))

    def _calibration(self, policy: Policy) -> NDArray[np.float32]:
        """Observations [n, F] of flights, transients more densely than the rest, and the largest of each number met.

        Most are of the task's own starts: those of the envelope, many of which no policy can save, would have the
        rounding serve tumbling vehicles.
        """
        starts = jax.random.split(jax.random.PRNGKey(CALIBRATION_STARTS_SEED), CALIBRATION_STARTS)
        flown = np.asarray(self.fly_with(policy, policy, starts, envelope=ENVELOPE).observations[:, :-1])
        own = round(len(flown) * (1.0 - ENVELOPE))
        parts = {
            "transient": flown[:own, :TRANSIENT_STEPS],
            "settled": flown[:own, TRANSIENT_STEPS:],
            "envelope": flown[own:, :TRANSIENT_STEPS],
            "largest": flown,
        }
        seen = {name: part[np.isfinite(part).all(axis=2)] for name, part in parts.items()}
        largest = seen.pop("largest")
        drawn = [_thinned(part, round(SAMPLES * SHARES[name])) for name, part in seen.items()]
        return np.concatenate([*drawn, largest[np.abs(largest).argmax(axis=0)]])

    def _foreign_period_s(self) -> float:
        period = getattr(self.env, "dt", None)
        if period is None:
            raise BadInput(f"{self.folder}: the environment '{self.config.task.name}' does not say its control period")
        return float(period)

    def tail_steps(self) -> int:
        """The last steps of a flight, in which it is judged."""
        if self._task is None:
            return self.trainer.setup.max_episode_steps // 4
        return round(self._task.evaluation.tail_s / self._task.control_period_s)

    def _origin(self) -> Origin:
        task = self.config.task
        return Origin(
            run=self.folder.resolve().name,
            task=task.name,
            description=self._task.description if self._task else "an environment of Brax",
            commit=self.config.versions.get("commit", "unknown"),
            seed=self.config.seed,
            env_steps=self.env_steps,
        )

    def _ports(self) -> tuple[tuple[Observed, ...], tuple[Acted, ...]]:
        if self._task is None:  # all that Brax tells
            observed = (Observed(f"o{i}", "?", "as the environment has it") for i in range(self.env.observation_size))
            acted = (
                Acted(f"a{i}", "?", "as the environment has it", 0.0, 1.0, -1.0, 1.0, 0.0)
                for i in range(self.env.action_size)
            )
            return tuple(observed), tuple(acted)
        return (
            tuple(Observed(*port) for port in io_spec.observations(self._task)),
            tuple(Acted(*port) for port in io_spec.actions(self._task)),
        )


def _thinned(x: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    return x[:: max(1, -(-len(x) // most))]


def flown(policy: Policy, flights: Flights, tail_steps: int) -> Flown:
    """What a report says of flights, with how much the actions jitter once the vehicle has settled."""
    low, high = policy.limits
    actions = policy.in_units(np.asarray(flights.actions[:, -tail_steps:])) / (high - low)
    return Flown(
        summary=summarize(flights),
        success=np.asarray(flights.measures["success"]) > 0.5 if "success" in flights.measures else None,
        jitter=float(np.abs(np.diff(actions, axis=1)).mean()),
        starts=len(flights.returns),
    )


class Exported(NamedTuple):
    """An export that came about."""

    policy: Policy
    measured: Measured
    folder: Path


def export(run: Run, starts: int, vectors: int, say: Callable[[str], None]) -> Exported:
    """Quantise, emit, prove and fly the policy of `run`, into its folder `export`: whole, or not at all.

    Raises BadInput for a network that the kernel cannot express, PossibleOverflow and ProofFailed where a proof
    does not hold; whatever was in `export` before is then still there.
    """
    say("flying to calibrate")
    policy = run.policy()
    try:
        kernel = quantise(policy)
    except Inexpressible as error:
        raise BadInput(f"{run.folder}: {error}") from None
    target = run.folder / "export"
    with TemporaryDirectory(dir=run.folder, prefix=".export-") as scratch, ThreadPoolExecutor(1) as pool:
        folder = Path(scratch) / "export"
        _write(folder, emit.files(policy, kernel, emit.golden(policy, kernel)))
        say("compiling and proving; flying")
        proving = pool.submit(prove, policy, kernel, folder, vectors)
        measured = _measured(run, policy, kernel, starts, proving.result)
        _write(folder, {"report.md": report(policy, kernel, measured)})
        before = Path(scratch) / "before"
        if target.exists():
            target.replace(before)
        try:
            folder.replace(target)
        except OSError:
            if before.exists():
                before.replace(target)
            raise
    return Exported(policy, measured, target)


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def _measured(run: Run, policy: Policy, kernel: Kernel, starts: int, proof: Callable[[], Proof]) -> Measured:
    """Fly both from the evaluation's starts, then wait for the proof."""
    keys = jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), starts)
    floats = run.fly(keys)

    def answer(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return integer.step(kernel, observation)[1]

    plain = baseline.naive(si_layers(policy), policy.activation, policy.calibration)

    def naive(observation: NDArray[np.float32]) -> NDArray[np.floating]:
        return np.clip(baseline.infer(plain, baseline.to_int8(plain, observation)) * plain.act_scale, *policy.limits)

    integers = run.fly_with(policy, answer, keys)
    # Every step of the transient, where the errors are; a settled vehicle sees the same again and again.
    observed = np.asarray(floats.observations[:, :-1])
    parts = observed[:, : 2 * TRANSIENT_STEPS], observed[:, 2 * TRANSIENT_STEPS :: 4]
    seen = np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts])
    seen = seen[np.isfinite(seen).all(axis=1)]
    some = _thinned(seen, SAMPLES)
    tail = run.tail_steps()
    return Measured(
        accuracy=accuracy(policy, answer, seen),
        naive=accuracy(policy, naive, some),
        flown_float=flown(policy, floats, tail),
        flown_integer=flown(policy, integers, tail),
        proof=proof(),
    )

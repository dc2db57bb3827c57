"""What `make gpu` measures, a section in a process of its own: `python -m experiments.gpu.sections NAME --until T`.

Each measurement is a line as the baselines print it (`judge.report`): {"figure", "per_second"}, or {"figure",
"seconds"} and more; one that fails is {"figure", "failed"}. The largest sizes come first, since time may run out.
"""

import argparse
import gc
import math
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.gpu import trace
from experiments.gpu.run import CALL_STEPS, add_sizes
from experiments.profiling import throughput
from qrl import request, tasks
from qrl.algorithm.flights import summarize
from qrl.cli.verdict import FLIES
from qrl.evaluation.starts import evaluation_starts
from qrl.runs import record
from qrl.training import driver
from qrl.training.devices import host_bytes
from qrl.training.sharding import make_mesh
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer
from qrl_envs.task_env import TaskEnv

from judge import report  # isort: skip  (throughput adds the baselines to the path)

FIRST_SEED = 100
SAMPLES_A_STEP = 32  # of a call of the learner, for one of a rollout
FEWER_STARTS = 100  # of each seed, where there are more than a few
MANY_SEEDS = 16
RESERVED_SECONDS = 12.0  # of a section's time, for what comes after training
CACHE_HIT = "/jax/compilation_cache/cache_hits"
COPIES = (
    3  # of an unroll in memory: in the replay buffer, numbers of each step before they are transposed, one to spare
)


class Sizes(NamedTuple):
    """What is measured (`run.SIZES`), and until when."""

    lanes: tuple[int, ...]
    minibatches: tuple[int, ...]  # samples
    flights: tuple[int, ...]
    seeds: tuple[int, ...]
    training_lanes: tuple[int, ...]
    call_steps: int = CALL_STEPS  # environment steps of a timed call
    deadline: float = math.inf  # of `time.time()`


def attempt(sizes: Sizes, figure: str, measure: Callable[..., None], *args: Any, **more: Any) -> None:
    """One measurement, which may fail, or come too late to be begun."""
    if time.time() >= sizes.deadline:
        report({"figure": figure, "failed": "not reached"})
        return
    try:
        measure(*args, **more)
    except Exception as error:  # out of memory, most likely: the smaller ones that follow may fit
        line = (str(error).strip().splitlines() or [""])[0][:200]
        report({"figure": figure, "failed": f"{type(error).__name__}: {line}"})
    gc.collect()  # its arrays


def key() -> jax.Array:
    return jax.random.PRNGKey(FIRST_SEED)


def largest_first(sizes: tuple[int, ...]) -> list[int]:
    return sorted(sizes, reverse=True)


def device_bytes() -> float:
    """Memory of one device; of a CPU half of the machine's, shared by its devices."""
    first = jax.local_devices()[0]
    if first.platform == "cpu":
        return host_bytes() / len(jax.local_devices())
    return float((first.memory_stats() or {}).get("bytes_limit", 8e9))


# -- rates ---------------------------------------------------------------------------------------------------


def run_of(task: str, vehicle: str | None = None, preset: str | None = None, **learner: Any) -> record.RunConfig:
    """A run of the task with its preset, or another, and these hyperparameters."""
    parts = {"vehicle": vehicle}
    return request.run_config(task, None, record.ConfigFile(), learner, FIRST_SEED, 1, parts, preset)


def real_hover(**learner: Any) -> record.RunConfig:
    return run_of("hover", throughput.VEHICLE, **learner)


def world(run: record.RunConfig) -> TaskEnv:
    env = tasks.environment(run.task)
    assert isinstance(env, TaskEnv)
    return env


def unroll_length(lanes: int, observation_size: int, limit: float) -> int:
    """Steps of an unroll of so many lanes whose copies take half of `limit` bytes; at least 1."""
    transition_bytes = 4 * (observation_size + 16)
    return max(1, min(throughput.UNROLL_STEPS, int(limit / 2 / (COPIES * transition_bytes * lanes))))


def plant(sizes: Sizes) -> None:
    real = world(real_hover())
    for lanes in largest_first(sizes.lanes):
        for figure, env in (("plant, real", real), ("plant, ideal", None)):
            name = f"{figure}, {lanes:,} lanes"
            attempt(sizes, name, throughput.physics, lanes, key(), env, figure, sizes.call_steps)


def acting(sizes: Sizes) -> None:
    """With the policies of their presets: recurrent for the real vehicle, 64-64 for the ideal one."""
    devices, limit = len(jax.devices()), device_bytes()
    for lanes in largest_first(sizes.lanes):
        for name, run in (("acting, real", real_hover), ("acting, ideal", partial(run_of, "hover"))):
            steps = unroll_length(lanes // devices or 1, world(run()).observation_size, limit)
            one = partial(run, num_envs=lanes, replay_unrolls=1, unroll_length=steps, apg_fraction=0.0)
            figure = f"{name}, T {steps}"
            measure = lambda one=one, lanes=lanes, figure=figure: throughput.acting(  # noqa: E731
                lanes, key(), one(num_timesteps=10**9), figure, sizes.call_steps
            )
            attempt(sizes, f"{figure}, {lanes:,} lanes", measure)


def learner(sizes: Sizes) -> None:
    for samples in largest_first(sizes.minibatches):
        trajectories = max(1, samples // throughput.UNROLL_STEPS)
        updates = max(4, min(throughput.UPDATES, SAMPLES_A_STEP * sizes.call_steps // samples))
        name = f"learning, {samples:,} samples a minibatch"
        attempt(sizes, name, throughput.learning, trajectories, key(), updates)


def apg(sizes: Sizes) -> None:
    for flights in largest_first(sizes.flights):
        for name, run in (("APG, real", real_hover), ("APG, ideal", partial(run_of, "hover"))):
            figure = f"{name}, {flights:,} flights"
            attempt(sizes, figure, measure_apg, figure, run, flights, sizes.call_steps // 4)


def measure_apg(figure: str, run_of: Callable[..., record.RunConfig], flights: int, call_steps: int) -> None:
    """Environment steps/s of APG updates on so many flights of 200 steps, the way back included."""
    steps = 200
    run = run_of(
        num_timesteps=min(10**5, 2**31 // (flights * steps) - 1) * flights * steps,
        num_envs=flights,
        unroll_length=steps,
        replay_unrolls=1,
        batch_size=math.gcd(8, flights),
        apg_fraction=1.0,
        apg_num_envs=flights,
        apg_episode_length=steps,
        apg_split=1,
        apg_split_fraction=0.0,
    )
    trainer, states, points = throughput.make_run(run)
    advance = driver.compile_apg(trainer, states, points)
    updates = max(1, call_steps // (flights * steps))

    def call(carry: Any) -> Any:
        states, done = carry
        return advance(states, points, np.int32(done + updates)), done + updates

    throughput.rate(figure, updates * flights * steps, call, (states, 0), jax.block_until_ready)


def training(sizes: Sizes) -> None:
    """The training loop of hover at Brax PPO's sample reuse and unroll length, beside `brax_speed.py`."""
    for lanes in largest_first(sizes.training_lanes):
        figure = f"training loop, {lanes:,} lanes"
        attempt(sizes, figure, throughput.training, 10, key(), lanes, figure)


# -- time until it flies -------------------------------------------------------------------------------------


def flown(task: str) -> Callable[[Sizes], None]:
    """The section that trains the task with the preset for a GPU, once."""
    return lambda sizes: attempt(sizes, f"{task}_gpu, 1 seed", train, sizes, task, 1)


def seeds(sizes: Sizes) -> None:
    for count in largest_first(sizes.seeds):
        attempt(sizes, f"hover_gpu, {count} seed{'s' * (count > 1)}", train, sizes, "hover", count)


def train(sizes: Sizes, task: str, count: int) -> None:
    """So many seeds in one program: seconds of compiling and training, and what the deployed policies do."""
    hits: list[str] = []
    jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event == CACHE_HIT else None)
    begun = time.perf_counter()
    trainer, inputs = make_trainer_of(run_of(task, preset=f"{task}_gpu"), count)
    config = trainer.config
    states = jax.block_until_ready(trainer.init(driver.seeds(FIRST_SEED, count), inputs))

    def without_records(fly: Any) -> Any:
        """Flights without what they record: gigabytes, of many seeds."""
        bare = lambda *args: fly.__wrapped__(*args)._replace(observations=(), actions=())  # noqa: E731
        return jax.jit(bare, compiler_options=trainer.effort("fly"))

    with ThreadPoolExecutor() as pool:
        apg = pool.submit(driver.compile_apg, trainer, states, inputs)
        reports = pool.submit(without_records(driver.report_flights(trainer)).lower(states.learner, inputs).compile)
        programs = driver.Programs(
            pool.submit(driver.compile_train, trainer, states, inputs).result,
            apg.result,
            reports.result,
            trainer.gather,
        )
    compiling, cache_hits = time.perf_counter() - begun, len(hits)
    flies_at: list[float | None] = [None] * count
    chunk = None
    late = lambda: time.time() > sizes.deadline - RESERVED_SECONDS  # noqa: E731
    for chunk in driver.run_chunks(states, inputs, programs, config, driver.Clock(), late):
        states = chunk.states
        for i, row in enumerate(chunk.rows):
            if flies_at[i] is None and row["success"] >= FLIES:
                flies_at[i] = chunk.clock.train_seconds
    if chunk is None:
        raise TimeoutError(f"compiled in {compiling:.1f} s, and no time was left to train")
    starts = evaluation_starts() if count <= MANY_SEEDS else evaluation_starts(FEWER_STARTS)
    flights = trainer.gather(without_records(trainer.fly)(states.learner, inputs, starts))
    success = [summarize(jax.tree.map(lambda x, i=i: x[i], flights))["success"] for i in range(count)]
    first = [seconds for seconds in flies_at if seconds is not None]
    report(
        {
            "figure": f"{task}_gpu, {count} seed{'s' * (count > 1)}",
            "seconds": chunk.clock.train_seconds,
            "compile_seconds": compiling,
            "cache_hits": cache_hits,
            "first_flies_at_seconds": min(first) if first else None,
            "last_flies_at_seconds": max(first) if len(first) == count else None,  # by the reports' starts
            "fly": sum(value >= FLIES for value in success),
            "success_mean": float(np.mean(success)),
            "success_min": float(np.min(success)),
            "starts": len(starts),
            "env_steps": chunk.env_steps,
            "done": chunk.env_steps / (config.num_unrolls * config.steps_per_unroll),
            "faults": [fault for fault in chunk.faults if fault][:1],
        }
    )


def make_trainer_of(run: record.RunConfig, count: int = 1) -> tuple[Trainer, Any]:
    """The trainer of so many seeds of a run on all devices, and its inputs."""
    env = tasks.environment(run.task)
    trainer = make_trainer(env, run.learner, make_mesh(jax.devices(), count, run.learner.shard_count))
    return trainer, stack([member_inputs(env, run.learner)] * count)


# -- where the time goes -------------------------------------------------------------------------------------


def profile(sizes: Sizes) -> None:
    for task in ("hover", "any"):
        for phase in ("train", "apg"):
            figure = f"profile of {task}_gpu, {phase}"
            attempt(sizes, figure, measure_profile, figure, run_of(task, preset=f"{task}_gpu"), phase)


def measure_profile(figure: str, run: record.RunConfig, phase: str) -> None:
    """Two unrolls with their updates, or an APG update: how long, how much of it the device is busy, and with what."""
    trainer, points = make_trainer_of(run)
    config = trainer.config
    states = trainer.init(driver.seeds(FIRST_SEED, 1), points)
    if phase == "apg":
        if not config.num_apg_updates:
            raise ValueError("the preset has no APG")
        states = states._replace(unrolls=states.learning_unrolls + 0)
        advance, done = driver.compile_apg(trainer, states, points), config.learning_unrolls
        more = config.unrolls_per_apg_update
    else:
        advance, done, more = driver.compile_train(trainer, states, points), 0, 2
        warm = min(config.learning_unrolls - more, max(config.replay_unrolls, config.warmup_unrolls))
        states, done = advance(states, points, np.int32(warm)), warm
    states = jax.block_until_ready(states)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            begun = time.perf_counter()
            jax.block_until_ready(advance(states, points, np.int32(done + more)))
            seconds = time.perf_counter() - begun
        found, origins = trace.read(Path(folder)), trace.origins(advance.as_text())
    report(
        {
            "figure": figure,
            "seconds": seconds,
            "busy": found.busy,
            "launches": found.launches,
            "operations": [{**o._asdict(), "origin": origins.get(o.name, "")} for o in found.operations],
        }
    )


MEASURES: dict[str, Callable[[Sizes], None]] = {
    "plant": plant,
    "acting": acting,
    "hover": flown("hover"),
    "any": flown("any"),
    "seeds": seeds,
    "learner": learner,
    "apg": apg,
    "circle": flown("circle"),
    "track": flown("track"),
    "profile": profile,
    "training": training,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("section", choices=MEASURES)
    parser.add_argument("--until", type=float, default=math.inf, metavar="T", help="time.time() of the end")
    add_sizes(parser)
    args = vars(parser.parse_args())
    section, until, call_steps = args.pop("section"), args.pop("until"), args.pop("call_steps")
    sizes = Sizes(**{k: tuple(v) for k, v in args.items()}, call_steps=call_steps, deadline=until)
    MEASURES[section](sizes)


if __name__ == "__main__":
    main()

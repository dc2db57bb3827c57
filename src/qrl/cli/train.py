"""`qrl train`: from a request to a run that can start, its progress on the screen, and what it leaves."""

import argparse
import json
import math
import os
import shlex
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from qrl import request, tasks
from qrl.algorithm.running_statistics import RunningStatistics
from qrl.cli.terminal import (
    DONE,
    FAILED,
    STARTED,
    WRONG_INPUT,
    clock,
    console,
    print_error,
    progress_bar,
    stop_requested,
)
from qrl.cli.verdict import FLIES, verdict
from qrl.config import Config
from qrl.evaluation import initial
from qrl.runs import files, record
from qrl.runs.files import Row
from qrl.runs.record import RunConfig
from qrl.training import devices, loop, multihost
from qrl.training.traced import Store
from qrl_envs.specfile import BadInput

PICTURE_FLIGHTS = 5
FORMER_NORM = 8.0  # up to which a bound on gradients is likely one of the mean's, as it was
_HEADER = f"{'steps':>12} {'steps/s':>10} {'return':>20} {'success':>16} {'train time':>10} {'ETA':>6}"


class Plan(NamedTuple):
    config: RunConfig
    out: Path
    exists: bool  # the folder holds this run already


def train(args: argparse.Namespace) -> int:
    """Train, and write the run folder; of several processes the coordinator plans, and the others follow."""
    start_time = time.perf_counter()
    process = multihost.this_process(args.process_id, args.processes, args.coordinator, os.environ)
    console.quiet = process.number != multihost.COORDINATOR
    multihost.join(process)
    with ExitStack() as stack:
        plan: Plan | None = None
        error: Exception | None = None
        if not jax.distributed.is_initialized() or multihost.is_coordinator():
            try:
                plan = make_plan(args, stack)
            except Exception as raised:  # raised again once the other processes, which wait, know
                error = raised
        code = WRONG_INPUT if isinstance(error, BadInput) else FAILED if error else DONE
        code, go, exists = map(int, multihost.broadcast(np.array([code, plan is not None, bool(plan and plan.exists)])))
        if error:
            raise error
        if not go:
            return code
        if jax.process_count() > 1:
            text = multihost.broadcast_text(plan.config.model_dump_json() if plan else "")
            plan = Plan(RunConfig.model_validate_json(text), plan.out if plan else Path(), bool(exists))
        assert plan
        with stop_requested() as stopped:
            finished = run(plan, stopped)
    if finished is None:
        asked = {"TASK": args.task, "CONFIG": args.config, "VEHICLE": args.vehicle, "UNCERTAINTY": args.uncertainty}
        asked |= {"REFERENCE": args.reference, "INIT": args.init}
        subject = " ".join(f"{name}={shlex.quote(str(value))}" for name, value in asked.items() if value)
        console.print(f"stopped and saved; to resume: make train {subject} OUT={shlex.quote(str(plan.out))} RESUME=1")
        return FAILED
    if multihost.is_coordinator():
        write_results(plan, finished, time.perf_counter() - start_time)
    return DONE


def make_plan(args: argparse.Namespace, stack: ExitStack) -> Plan | None:
    """What to train, and where; None: it is complete. The folder is locked until `stack` closes."""
    flags = _flags(args)
    file = request.config_file(args.config)
    parts = {"vehicle": args.vehicle, "uncertainty": args.uncertainty, "reference": args.reference}
    first = initial.load(args.init) if args.init else initial.recorded(file.init) if file.init else None
    known = first and (first.init, first.run.learner)
    config = request.run_config(args.task, args.config, file, flags, args.seed, args.seeds, parts, args.preset, known)
    out: Path = args.out or Path("runs") / tasks.folder_name(config.task)
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: expected a folder, or a name for a new one; it is a file")
    exists = (out / "config.json").exists()
    if exists and not args.resume:
        raise BadInput(f"{out}: holds a run already; give another OUT, or RESUME=1 to resume it")
    if exists:
        seed = args.seed if args.seed is not None else file.seed
        preset = tasks.task_preset(config.task, "--preset", args.preset) if args.preset else {}
        config = request.resumed(out, config, preset | file.learner | flags, seed, args.seeds or file.seeds)
        if loop.finished(out, config):
            console.print(f"{out}: complete already; nothing to do")
            return None
    if not jax.distributed.is_initialized():  # the other processes, which do not know the run yet, have a device each
        devices.configure_cpu(config, config.devices if exists else file.devices)
    if not exists:
        config = config.model_copy(update={"devices": devices.device_names()})
    elif changed := request.changed_since(config):
        console.print(f"environment changed since the run began; results may not be bit-identical: {changed}")
    if (norm := config.learner.apg_cotangent_norm) is not None and norm <= FORMER_NORM:
        each = f"times apg_num_envs, {norm * config.learner.apg_num_envs:g}"
        print_error(
            f"warning: apg_cotangent_norm {norm:g}: of one flight's gradient; a number of before is that {each}"
        )
    for warning in tasks.spec(config.task).warnings() if config.task.spec else []:
        print_error(f"warning: {config.task.name}: {warning}")
    given = {"observation_scale", "observation_limit"} & {*flags}
    where = "command line" if given else str(args.config or config.task.name)
    env = tasks.environment(config.task)
    longest = config.learner.episode_length or getattr(env, "episode_steps", math.inf)
    steps = config.learner.unroll_length
    if longest < steps:
        print_error(
            f"warning: unroll_length {steps}, episodes of {longest}: at an unroll's truncations after the"
            f" first V is that of the observation one step earlier; expected at most {longest}"
        )
    if first:
        initial.check(first, config, env)
    tasks.check(env, config.learner, where)
    devices.check_devices(config)
    if (share := config.learner.apg_fraction) and not config.learner.num_apg_updates:
        least = config.learner.unrolls_per_apg_update * config.learner.steps_per_unroll
        print_error(
            f"warning: apg_fraction {share:g}: no update of APG, which takes {least:,} steps, fits into that share of"
            f" {config.learner.num_timesteps:,}"
        )
    out.mkdir(parents=True, exist_ok=True)
    stack.enter_context(files.locked(out / "lock", f"{out}: in use by another process"))
    if exists != (out / "config.json").exists():
        raise BadInput(f"{out}: another process has just used it; try again")
    _write_configs(out, config, exists)
    return Plan(config, out, exists)


def run(plan: Plan, stopped: Callable[[], bool]) -> loop.Finished | None:
    """Train with progress on the screen; None: stopped."""
    config = plan.config
    seeds = f"seed {config.seed}" if config.seeds == 1 else f"{config.seeds} seeds from {config.seed}"
    where = devices.describe_devices(config)
    console.print(f"{config.task.name}: {_describe_steps(config.learner)}, {seeds}, on {where} -> {plan.out}")
    env = tasks.environment(config.task)
    finished, start_time = None, time.perf_counter()
    with progress_bar(config.learner.num_unrolls * config.learner.steps_per_unroll) as update:
        first, store = _first_policy(config), Store.of_run(config, STARTED)
        for event in loop.train(env, config, plan.out, resume=plan.exists, stopped=stopped, policy=first, store=store):
            match event:
                case loop.Compiling():
                    console.print("compiling")
                case loop.Compiled():
                    console.print(f"compiled in {time.perf_counter() - start_time:.1f} s")
                    if config.seeds > 1:
                        console.print("return and success over seeds: median [min … max]")
                    console.print(_HEADER)
                case loop.Resumed():
                    for note in event.notes:
                        print_error(f"warning: {note}")
                    step = f"resuming from step {event.env_steps:,}"
                    console.print(step if event.env_steps else "no valid checkpoint; starting from scratch")
                case loop.Progress():
                    note = f"{event.steps_per_second:,.0f} steps/s, ETA {clock(event.seconds_left)}"
                    update(event.env_steps, note)
                case loop.LearningExtended():
                    for seed, steps in event.until.items():
                        console.print(f"seed {seed} does not fly yet: it learns on, to step {steps:,} before APG")
                case loop.Reported():
                    update(int(event.rows[0]["env_steps"]), "")
                    console.print(_report(event.rows, event.seconds_left))
                case loop.Finished():
                    finished = event
    return finished


def _first_policy(config: RunConfig) -> Callable[[], tuple[Any, RunningStatistics]] | None:
    """What a run that begins with a trained policy begins with, read when it is called."""
    if (init := config.init) is None:
        return None

    def read() -> tuple[Any, RunningStatistics]:
        found = initial.recorded(init)
        return found.policy, found.statistics

    return read


def write_results(plan: Plan, finished: loop.Finished, seconds: float) -> None:
    """Pictures, then summary.json of each seed, then that of all."""
    # Imported here: matplotlib takes a second.
    from qrl.runs import learning_curve
    from qrl_envs.plots import flights

    config, out, history = plan.config, plan.out, finished.rows
    folders = record.member_folders(out, config)
    for i, folder in enumerate(folders):
        title = f"{config.task.name}, seed {config.seed + i}"
        with files.writing(folder / "learning_curve.png"):
            learning_curve.learning_curve(folder / "learning_curve.png", [history[i]], title)
        if config.task.spec:
            shown = np.asarray(finished.flights.observations[i, :PICTURE_FLIGHTS])
            with files.writing(folder / "flight.png"):
                flights.draw(folder / "flight.png", tasks.spec(config.task), shown)
        said = verdict(config.task, history[i][-1]["success"])
        summary = {"result": history[i][-1], **said.entry, "command_seconds": round(seconds, 1)}
        files.write_json(folder / "summary.json", summary)
    if len(folders) > 1:
        title = f"{config.task.name}, {len(folders)} seeds"
        with files.writing(out / "learning_curve.png"):
            learning_curve.learning_curve(out / "learning_curve.png", history, title)
        last = [rows[-1] for rows in history]
        spread = {
            name: {"median": float(np.median(v)), "min": float(np.min(v)), "max": float(np.max(v))}
            for name in last[0]
            if (v := [row.get(name, float("nan")) for row in last])
        }
        files.write_json(out / "summary.json", {"seeds": spread, "command_seconds": round(seconds, 1)})
    console.print(f"done in {clock(seconds)}: {out}/summary.json, learning_curve.png; next: make evaluate RUN={out}")
    for i, rows in enumerate(history):
        if rows[-1]["success"] < FLIES:
            console.print(f"seed {config.seed + i} {_shortfall(rows[-1], config)}")
        elif reason := verdict(config.task, rows[-1]["success"]).reason:
            console.print(f"seed {config.seed + i} does not fly its vehicle: {reason}")


def _shortfall(last: Row, run: RunConfig) -> str:
    """What a policy that does not do its task does, and what to try."""
    ends = f", and {last['ended_early']:.0%} of its episodes left the bounds" if last["ended_early"] > 0.01 else ""
    easier = ", starts within a smaller tilt (start.tilt_rad in the task file), a vehicle with more thrust"
    return (
        f"does its task from only {last['success']:.0%} of the reports' starts{ends}. To try: --num-timesteps"
        f" {2 * run.learner.num_timesteps}, another SEED{easier if 'vehicle' in (run.task.spec or {}) else ''}"
    )


def _describe_steps(config: Config) -> str:
    if not config.num_apg_updates:
        return f"{config.num_timesteps:,} steps"
    learning = config.learning_unrolls * config.steps_per_unroll
    split = math.ceil(config.num_apg_updates * config.apg_split_fraction) * (config.apg_split - 1)
    apg = f"{config.num_apg_updates + split:,} APG updates"
    return f"{config.num_timesteps:,} steps ({learning:,} of the paper's method, then {apg})"


def _flags(args: argparse.Namespace) -> dict[str, Any]:
    """The hyperparameters given as flags, each read as JSON or a number where it is one, else as text."""
    prefix = "learner."
    return {name.removeprefix(prefix): _value(x) for name, x in vars(args).items() if name.startswith(prefix)}


def _value(text: Any) -> Any:
    for read in (json.loads, float) if isinstance(text, str) else ():  # float: .95, which is not JSON
        with suppress(ValueError, RecursionError):
            return read(text)
    return text


def _write_configs(out: Path, config: RunConfig, exists: bool) -> None:
    for i, folder in enumerate(record.member_folders(out, config)):
        folder.mkdir(parents=True, exist_ok=True)
        if exists:
            files.remove_leftovers(folder)
        else:
            files.write_json(folder / "config.json", config.member(i).model_dump(mode="json"))
    if exists:
        files.remove_leftovers(out)
    else:
        files.write_json(out / "config.json", config.model_dump(mode="json"))


def _report(rows: list[Row], seconds_left: float) -> str:
    first = rows[0]
    return (
        f"{first['env_steps']:>12,} {first['steps_per_second']:>10,.0f} {_spread(rows, 'return_mean', '.2f'):>20}"
        f" {_spread(rows, 'success', '.3f'):>16} {clock(first['train_seconds']):>10} {clock(seconds_left):>6}"
    )


def _spread(rows: list[Row], name: str, form: str) -> str:
    """The value, or over seeds median [min … max]; a dash where it is not measured."""
    values = np.array([row.get(name, float("nan")) for row in rows])
    if np.isnan(values).all():
        return "–"
    if len(values) == 1:
        return format(values[0], form)
    return f"{np.median(values):{form}} [{values.min():{form}} … {values.max():{form}}]"

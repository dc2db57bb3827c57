"""The command `train`: what is asked to a run that can start, its progress on the screen, and what it leaves."""

import argparse
import json
import os
import shlex
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.progress import BarColumn, Progress, TextColumn

from qrl import request, tasks
from qrl.cli.terminal import DONE, FAILED, WRONG_INPUT, clock, complain, console, stop_requested
from qrl.config import Config
from qrl.runs import files, record
from qrl.runs.files import Row
from qrl.runs.record import RunConfig
from qrl.training import devices, loop, multihost
from qrl.training import devices as processes
from qrl_envs.specfile import BadInput

PICTURE_FLIGHTS = 5


def train(args: argparse.Namespace) -> int:
    begun = time.perf_counter()
    process = multihost.this_process(args.process_id, args.processes, args.coordinator, os.environ)
    console.quiet = process.number != multihost.COORDINATOR
    multihost.join(process)
    with ExitStack() as until_done:
        plan: _Plan | None = None
        wrong: Exception | None = None
        if not jax.distributed.is_initialized() or multihost.is_coordinator():
            try:
                plan = _plan(args, until_done)
            except Exception as error:  # raised once the others, who wait, have heard
                wrong = error
        code = WRONG_INPUT if isinstance(wrong, BadInput) else FAILED if wrong else DONE
        code, going, held = map(
            int, multihost.broadcast(np.array([code, plan is not None, plan is not None and plan.held]))
        )
        if wrong:
            raise wrong
        if not going:
            return code
        config = RunConfig.model_validate_json(multihost.broadcast_text(plan.config.model_dump_json() if plan else ""))
        return _train(config, plan.out if plan else Path(), bool(held), args, begun)


class _Plan(NamedTuple):
    config: RunConfig
    out: Path
    held: bool  # the folder holds this run already


def _plan(args: argparse.Namespace, until_done: ExitStack) -> _Plan | None:
    """What is to be trained, and where, the folder ours `until_done`; None: nothing is left to do."""
    flags = _flags(args)
    file = request.config_file(args.config)
    if args.preset:
        file = file.model_copy(update={"learner": tasks.preset(args.preset, "--preset") | file.learner})
    config = request.run_config(args.task, args.config, file, flags, args.seed, args.seeds)
    out: Path = args.out or Path("runs") / config.task.name
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: expected a folder, or a name for a new one; it is a file")
    held = (out / "config.json").exists()
    if held and not args.resume:
        raise BadInput(f"{out}: holds a run already; give another OUT, or RESUME=1 to go on with it")
    if held:
        seed = args.seed if args.seed is not None else file.seed
        config = request.resumed(out, config, file.learner | flags, seed, args.seeds or file.seeds)
        if loop.finished(out, config):
            console.print(f"{out}: finished already; nothing to do")
            return None
    if not jax.distributed.is_initialized():  # others, who do not know the run yet, have a device each
        processes.configure_cpu(config, config.devices if held else file.devices)
    if not held:
        config = config.model_copy(update={"devices": devices.device_names()})
    elif changed := request.changed_since(config):
        console.print(f"not as it began, so the bits may differ: {changed}")
    env = tasks.environment(config.task)
    where = "command line" if "observation_scale" in flags else str(args.config or config.task.name)
    tasks.check(env, config.learner, where)
    devices.check_devices(config)
    out.mkdir(parents=True, exist_ok=True)
    until_done.enter_context(files.locked(out / "lock", f"{out}: another process is at work in it"))
    if held != (out / "config.json").exists():
        raise BadInput(f"{out}: another process was at work in it just now; try again")
    _prepare(out, config, held)
    return _Plan(config, out, held)


def _train(config: RunConfig, out: Path, held: bool, args: argparse.Namespace, begun: float) -> int:
    seeds = f"seed {config.seed}" if config.seeds == 1 else f"{config.seeds} seeds from {config.seed}"
    console.print(
        f"{config.task.name}: {_steps(config.learner)}, {seeds}, on {devices.describe_devices(config)} -> {out}"
    )
    env = tasks.environment(config.task)
    with stop_requested() as stopped:
        finished = _follow(loop.train(env, config, out, resume=held, stopped=stopped), config)
    if finished is None:
        what = f"TASK={shlex.quote(args.task)}" if args.task else f"CONFIG={shlex.quote(str(args.config))}"
        console.print(f"stopped and saved; to go on: make train {what} OUT={shlex.quote(str(out))} RESUME=1")
        return FAILED
    if multihost.is_coordinator():
        _finish(out, config, finished, time.perf_counter() - begun)
    return DONE


def _steps(config: Config) -> str:
    if not config.num_apg_updates:
        return f"{config.num_timesteps:,} steps"
    learning = config.learning_unrolls * config.steps_per_unroll
    apg = f"{config.num_apg_updates:,} APG updates"
    return f"{config.num_timesteps:,} steps ({learning:,} of the paper's method, then {apg})"


def _flags(args: argparse.Namespace) -> dict[str, Any]:
    """The learner's flags that were given, each read as JSON or a number where it is one, else as text."""
    given: dict[str, Any] = {}
    for name, text in vars(args).items():
        if name.startswith("learner.") and text is not None:
            given[name.removeprefix("learner.")] = _value(text)
    return given


def _value(text: str) -> Any:
    for read in (json.loads, float):  # float: .95, which JSON does not know
        with suppress(ValueError, RecursionError):
            return read(text)
    return text


def _prepare(out: Path, config: RunConfig, held: bool) -> None:
    for i, folder in enumerate(record.member_folders(out, config)):
        folder.mkdir(parents=True, exist_ok=True)
        if held:
            files.remove_leftovers(folder)
        else:
            files.write_json(folder / "config.json", config.member(i).model_dump(mode="json"))
    if held:
        files.remove_leftovers(out)
    else:
        files.write_json(out / "config.json", config.model_dump(mode="json"))


def _follow(events: Iterator[loop.Event], config: RunConfig) -> loop.Finished | None:
    """Show what happens, a line a report; returns how it ended, if it came to its end."""
    finished, started = None, time.perf_counter()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=config.learner.num_unrolls * config.learner.steps_per_unroll, note="")
        for event in events:
            if isinstance(event, loop.Compiling):
                console.print("compiling")
            elif isinstance(event, loop.Compiled):
                console.print(f"compiled in {time.perf_counter() - started:.1f} s\n{_HEADER}")
            elif isinstance(event, loop.Resumed):
                for note in event.notes:
                    complain(f"warning: {note}")
                whence = f"step {event.env_steps:,}" if event.env_steps else "the start: no checkpoint is whole"
                console.print(f"going on from {whence}")
            elif isinstance(event, loop.Progress):
                note = f"{event.steps_per_second:,.0f} steps/s, {clock(event.seconds_left)} left"
                bar.update(task, completed=event.env_steps, note=note)
            elif isinstance(event, loop.Finished):
                finished = event
            else:
                bar.update(task, completed=event.rows[0]["env_steps"])
                console.print(_line(event.rows, event.seconds_left))
    return finished


_HEADER = f"{'steps':>12} {'steps/s':>10} {'return':>20} {'success':>16} {'trained':>8} {'left':>7}"


def _line(rows: list[Row], seconds_left: float) -> str:
    first = rows[0]
    return (
        f"{first['env_steps']:>12,} {first['steps_per_second']:>10,.0f} {_spread(rows, 'return_mean', '.2f'):>20}"
        f" {_spread(rows, 'success', '.3f'):>16} {clock(first['train_seconds']):>8} {clock(seconds_left):>7}"
    )


def _spread(rows: list[Row], name: str, form: str) -> str:
    """The value, or median and [least … greatest] over seeds; a dash where it is not measured."""
    values = np.array([row.get(name, float("nan")) for row in rows])
    if np.isnan(values).all():
        return "–"
    if len(values) == 1:
        return format(values[0], form)
    return f"{np.median(values):{form}} [{values.min():{form}} … {values.max():{form}}]"


def _finish(out: Path, config: RunConfig, finished: loop.Finished, seconds: float) -> None:
    """Pictures, then summary.json of each seed, then that of the whole."""
    # Only now: a second of matplotlib.
    from qrl.runs import learning_curve
    from qrl_envs.plots import flights

    folders = record.member_folders(out, config)
    history = finished.rows
    for i, folder in enumerate(folders):
        title = f"{config.task.name}, seed {config.seed + i}"
        with files.writing(folder / "learning_curve.png"):
            learning_curve.learning_curve(folder / "learning_curve.png", [history[i]], title)
        if config.task.spec:
            shown = np.asarray(finished.flights.observations[i, :PICTURE_FLIGHTS])
            with files.writing(folder / "flight.png"):
                flights.draw(folder / "flight.png", tasks.spec(config.task), shown)
        files.write_json(folder / "summary.json", {"result": history[i][-1], "command_seconds": round(seconds, 1)})
    if len(folders) > 1:
        with files.writing(out / "learning_curve.png"):
            learning_curve.learning_curve(
                out / "learning_curve.png", history, f"{config.task.name}, {len(folders)} seeds"
            )
        last = [rows[-1] for rows in history]
        spread = {
            name: {"median": float(np.median(v)), "min": float(np.min(v)), "max": float(np.max(v))}
            for name in last[0]
            if (v := [row.get(name, float("nan")) for row in last])
        }
        files.write_json(out / "summary.json", {"seeds": spread, "command_seconds": round(seconds, 1)})
    console.print(f"done in {clock(seconds)}: {out}/summary.json, learning_curve.png; next: make evaluate RUN={out}")

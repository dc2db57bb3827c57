"""The commands behind the command line: train, evaluate, export, tasks; sweep has a module of its own."""

import argparse
import json
import os
import shlex
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.progress import BarColumn, Progress, TextColumn

from qrl import deploy, loop, peers, plots, processes, request, restore, runs, sweep_command
from qrl.checkpoint import Foreign
from qrl.deploy import EVALUATION_STARTS_SEED
from qrl.evaluate import summarise
from qrl.exits import DONE, FAILED, WRONG_INPUT, complain
from qrl.export.kernel import PossibleOverflow
from qrl.export.report import gates
from qrl.export.targets import ProofFailed
from qrl.runs import Row, RunConfig
from qrl.terminal import clock, console, stop_requested
from qrl.train import point, stack
from qrl_envs import picture
from qrl_envs import task as tasks
from qrl_envs.specfile import BadInput

PICTURE_FLIGHTS = 5


def run(args: argparse.Namespace) -> int:
    """Run the parsed command and map what goes wrong to one line and an exit code."""
    commands = {
        "train": train,
        "evaluate": evaluate,
        "export": export,
        "sweep": sweep_command.sweep,
        "tasks": list_tasks,
    }
    code = FAILED
    try:
        return commands[args.command](args)
    except BadInput as error:  # every process hears of it
        complain(str(error))
        return WRONG_INPUT
    except Foreign as error:
        complain(str(error))
        code = WRONG_INPUT
    except (loop.NotFinite, PossibleOverflow, ProofFailed) as error:
        complain(str(error))
    except OSError as error:
        complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except jax.errors.JaxRuntimeError as error:  # out of memory, above all
        complain(str(error))
    except KeyboardInterrupt:
        complain("interrupted")
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, ValueError) and "Gloo" in str(error):  # how JAX says it on CPUs
            complain(f"another process of the run is gone: {error}")
        else:
            traceback.print_exc()
    if jax.distributed.is_initialized():  # Python's own end would wait for the others, and they for this process
        sys.stdout.flush()
        os._exit(code)
    return code


def list_tasks(_: argparse.Namespace) -> int:
    for name in tasks.shipped():
        console.print(f"{name:<10} {tasks.load(name).description}")
    console.print(f"\nBrax's own: {', '.join(request.foreign_tasks())}")
    console.print("Your own: a .json file that extends one of the first, such as experiments/vehicles/crazyflie.json")
    return DONE


# -- train ---------------------------------------------------------------------------------------------------


def train(args: argparse.Namespace) -> int:
    begun = time.perf_counter()
    process = processes.this_process(args.process_id, args.processes, args.coordinator, os.environ)
    console.quiet = process.number != peers.FIRST
    processes.join(process)
    with ExitStack() as until_done:
        plan: _Plan | None = None
        wrong: Exception | None = None
        if peers.first():
            try:
                plan = _plan(args, until_done)
            except Exception as error:  # raised once the others, who wait, have heard
                wrong = error
        code = WRONG_INPUT if isinstance(wrong, BadInput) else FAILED if wrong else DONE
        code, going, held = map(int, peers.firsts(np.array([code, plan is not None, plan is not None and plan.held])))
        if wrong:
            raise wrong
        if not going:
            return code
        config = RunConfig.model_validate_json(peers.firsts_text(plan.config.model_dump_json() if plan else ""))
        return _train(config, plan.out if plan else Path(), bool(held), args, begun)


class _Plan(NamedTuple):
    config: RunConfig
    out: Path
    held: bool  # the folder holds this run already


def _plan(args: argparse.Namespace, until_done: ExitStack) -> _Plan | None:
    """What is to be trained, and where, the folder ours `until_done`; None: nothing is left to do."""
    flags = _flags(args)
    file = request.config_file(args.config)
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
        if changed := request.changed_since(config):
            console.print(f"not as it began, so the bits may differ: {changed}")
    env = request.environment(config.task)
    where = "command line" if "observation_scale" in flags else str(args.config or config.task.name)
    request.check(env, config.learner, where)
    request.check_devices(config)
    out.mkdir(parents=True, exist_ok=True)
    until_done.enter_context(processes.locked(out / "lock", f"{out}: another process is at work in it"))
    if held != (out / "config.json").exists():
        raise BadInput(f"{out}: another process was at work in it just now; try again")
    _prepare(out, config, held)
    return _Plan(config, out, held)


def _train(config: RunConfig, out: Path, held: bool, args: argparse.Namespace, begun: float) -> int:
    seeds = f"seed {config.seed}" if config.seeds == 1 else f"{config.seeds} seeds from {config.seed}"
    devices = request.devices(config)
    console.print(f"{config.task.name}: {config.learner.steps:,} steps, {seeds}, on {devices} -> {out}")
    env = request.environment(config.task)
    with stop_requested() as stopped:
        finished = _follow(loop.train(env, config, out, resume=held, stopped=stopped), config)
    if finished is None:
        what = f"TASK={shlex.quote(args.task)}" if args.task else f"CONFIG={shlex.quote(str(args.config))}"
        console.print(f"stopped and saved; to go on: make train {what} OUT={shlex.quote(str(out))} RESUME=1")
        return FAILED
    if peers.first():
        _finish(out, config, finished, time.perf_counter() - begun)
    return DONE


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
    for i, folder in enumerate(runs.members(out, config)):
        folder.mkdir(parents=True, exist_ok=True)
        if held:
            runs.tidy(folder)
        else:
            runs.write_json(folder / "config.json", config.member(i).model_dump(mode="json"))
    if held:
        runs.tidy(out)
    else:
        runs.write_json(out / "config.json", config.model_dump(mode="json"))


def _follow(events: Iterator[loop.Event], config: RunConfig) -> loop.Finished | None:
    """Show what happens, a line a report; returns how it ended, if it came to its end."""
    finished, started = None, time.perf_counter()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=config.learner.unrolls * config.learner.unroll_size, note="")
        compiling = ""
        for event in events:
            if compiling and not isinstance(event, loop.Compiling):
                console.print(_HEADER)
                compiling = ""
            if isinstance(event, loop.Compiling):
                compiling = event.what
                console.print(f"compiling {event.what} ({time.perf_counter() - started:.1f} s)")
            elif isinstance(event, loop.GoingOn):
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
    folders = runs.members(out, config)
    history = finished.rows
    for i, folder in enumerate(folders):
        title = f"{config.task.name}, seed {config.seed + i}"
        with runs.writing(folder / "learning_curve.png"):
            plots.learning_curve(folder / "learning_curve.png", [history[i]], title)
        if config.task.spec:
            shown = np.asarray(finished.flights.observations[i, :PICTURE_FLIGHTS])
            with runs.writing(folder / "flight.png"):
                picture.flights(folder / "flight.png", _task(config), shown)
        runs.write_json(folder / "summary.json", {"result": history[i][-1], "command_seconds": round(seconds, 1)})
    if len(folders) > 1:
        with runs.writing(out / "learning_curve.png"):
            plots.learning_curve(out / "learning_curve.png", history, f"{config.task.name}, {len(folders)} seeds")
        last = [rows[-1] for rows in history]
        spread = {
            name: {"median": float(np.median(v)), "min": float(np.min(v)), "max": float(np.max(v))}
            for name in last[0]
            if (v := [row.get(name, float("nan")) for row in last])
        }
        runs.write_json(out / "summary.json", {"seeds": spread, "command_seconds": round(seconds, 1)})
    console.print(f"done in {clock(seconds)}: {out}/summary.json, learning_curve.png; next: make evaluate RUN={out}")


def _task(config: RunConfig) -> tasks.Task:
    assert config.task.spec is not None
    return tasks.from_data(config.task.spec, config.task.name)


# -- evaluate ------------------------------------------------------------------------------------------------


def evaluate(args: argparse.Namespace) -> int:
    """Fly every seed of a run from fresh starts; print a table, leave evaluation.json and a plot in each folder."""
    config = request.stored(args.run)
    env = request.environment(config.task)
    starts = jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), args.starts)
    table: list[dict[str, Any]] = []
    for i, folder in enumerate(runs.members(args.run, config)):
        try:
            trainer, state, env_steps = restore.last(env, config.member(i), folder)
        except OSError as error:
            raise BadInput(str(error)) from None
        flights = jax.tree.map(lambda x: x[0], trainer.fly(state.learner, stack([point(env, config.learner)]), starts))
        result = {"seed": config.seed + i, "env_steps": env_steps, "starts": args.starts, **summarise(flights)}
        runs.write_json(folder / "evaluation.json", result)
        if config.task.spec:
            picture.errors(folder / "evaluation.png", _task(config), np.asarray(flights.observations))
        table.append(result)
    if config.seeds > 1:
        runs.write_json(args.run / "evaluation.json", table)
    _print_results(table, config)
    return DONE


def _print_results(table: list[dict[str, Any]], config: RunConfig) -> None:
    console.print(f"{config.task.name}: {table[0]['starts']:,} fresh starts, deterministic policy")
    names = [name for name in table[0] if name not in ("seed", "starts") and not _missing(table[0][name])]
    width = max(len(name) for name in names)
    console.print(f"{'seed':<{width}} " + " ".join(f"{row['seed']:>11}" for row in table))
    for name in names:
        console.print(f"{name:<{width}} " + " ".join(f"{_cell(name, row[name]):>11}" for row in table))


def _missing(value: Any) -> bool:
    return isinstance(value, float) and np.isnan(value)


def _cell(name: str, value: float) -> str:
    if name == "env_steps":
        return f"{value:,}"
    return f"{value:.2f}" if name.startswith("return") else f"{value:.4f}"


# -- export --------------------------------------------------------------------------------------------------


def export(args: argparse.Namespace) -> int:
    """Emit, prove and fly a run's integer policy; print gates and costs, leave it all in RUN/export."""
    begun = time.perf_counter()
    done = deploy.export(deploy.Run(args.run), args.starts, args.vectors, console.print)
    proof = done.measured.proof
    for name in proof.held:
        console.print(f"held against the reference, bit for bit, on {proof.vectors:,} observations an entry: {name}")
    for what in proof.missing:
        console.print(f"NOT proved {what}")
    for gate in gates(done.measured):
        mark = "met" if gate.met else "MISSED"
        console.print(f"{gate.name:<40} {gate.measured:>9.3g} {gate.unit:<20} bar {gate.bar:<6g} {mark}")
    if proof.costs:
        console.print(
            f"{'instructions per inference':<27} {'float entry':>12} {'i16 entry':>10} {'flash':>8} {'stack':>7}"
        )
    for cost in proof.costs:
        mean, mean_i16 = cost.step[0], cost.step_i16[0]
        console.print(f"{cost.core:<27} {mean:>12,.0f} {mean_i16:>10,.0f} {cost.flash:>6,} B {max(cost.stack):>5} B")
    console.print(f"done in {clock(time.perf_counter() - begun)}: {done.folder}/qrl_policy.c, .h, report.md")
    return DONE

"""`qrl sweep`: from a grid file to a folder of results; rerun to resume."""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from qrl import tasks
from qrl.cli.terminal import DONE, FAILED, clock, console, plural, print_error, progress_bar, stop_requested
from qrl.runs import files, record
from qrl.sweep import grid as grids
from qrl.sweep import plot, results, runner
from qrl.sweep.grid import Grid
from qrl.sweep.runner import ChunkDone, Compiling, Group, Member, Progress
from qrl.training import devices, multihost
from qrl.training.multihost import Process
from qrl.training.state import member_inputs
from qrl.training.trainer import make_trainer
from qrl_envs.specfile import BadInput, read

SHOWN = 20  # points in the table on the terminal
POLL_SECONDS = 0.5  # between two checks of the other processes' results


def sweep(args: argparse.Namespace) -> int:
    start_time = time.perf_counter()
    process = multihost.this_process(args.process_id, args.processes, args.coordinator, os.environ)
    given = args.memory_gb * 1e9 if args.memory_gb is not None else None
    grid = grids.load(args.grid, given or devices.host_bytes())  # before waiting for other processes
    multihost.join(process)
    budget = given or devices.memory_bytes()
    out: Path = args.out or Path("runs") / args.grid.stem
    if _holds_sweep(out, grid) and (out / "summary.json").exists() and (out / "sweep.png").exists():
        console.print(f"{out}: complete already; nothing to do")
        return _exit_code(out)
    groups = _groups(grid, process, budget, args.grid)
    out.mkdir(parents=True, exist_ok=True)
    busy = f"{out}: in use by another sweep; wait for its end, or give another OUT"
    with files.locked(out / f"process-{process.number}.lock", busy):
        if not _holds_sweep(out, grid) and process.number == 0:
            here = {"versions": record.versions(), "devices": devices.device_names()}
            files.write_json(out / "grid.json", {**grid.record, **here})
        total = len(grid.points) * len(grid.seeds)
        console.print(
            f"{plural(len(grid.points), 'point')} × {plural(len(grid.seeds), 'seed')} = {plural(total, 'member')} in"
            f" {plural(len(groups), 'compiled program')}, {plural(len(devices.workers()), 'worker')} on"
            f" {jax.local_devices()[0].platform.upper()} -> {out}"
        )
        with stop_requested("stopping: finished chunks are kept") as stopped:
            _train_groups(groups, out, budget, stopped)
            found = _all_results(out, total, process, stopped)
        if found is None:
            console.print("stopped; rerun the same command to resume")
            return FAILED
        if process.number:
            return DONE  # process 0 writes the results
        return _finish(out, grid, found, args.grid.stem, time.perf_counter() - start_time)


def _holds_sweep(out: Path, grid: Grid) -> bool:
    """Whether `out` holds this sweep already; BadInput if it holds another."""
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: expected a folder, or a name for a new one; it is a file")
    if (out / "config.json").exists():
        raise BadInput(f"{out}: holds a run; give another OUT")
    path = out / "grid.json"
    if not path.exists():
        return False
    stored = {key: value for key, value in read(path).items() if key not in ("versions", "devices")}
    if stored != json.loads(json.dumps(grid.record)):
        raise BadInput(f"{out}: holds a sweep of another grid, or by another version of qrl ({path}); give another OUT")
    return True


def _groups(grid: Grid, process: Process, budget: float, path: Path) -> list[Group]:
    """This process's members of every program: every n-th, so that no two processes train the same one."""
    groups = []
    for indices in grid.groups():
        first = grid.points[indices[0]]
        env = tasks.environment(first.task)
        tasks.check(env, first.learner, f"{path}: at {grids.describe(first.coordinates)}")
        inputs = {i: member_inputs(tasks.environment(grid.points[i].task), grid.points[i].learner) for i in indices}
        members = [
            Member(i * len(grid.seeds) + j, seed, inputs[i]) for i in indices for j, seed in enumerate(grid.seeds)
        ]
        trainer = make_trainer(env, first.learner)
        each, workers = runner.member_bytes(trainer, members[0].inputs), len(devices.workers())
        if not runner.chunk_members(len(members), each, budget, workers):
            raise BadInput(
                f"{path}: expected members that fit into {budget / 1e9:g} GB of memory, found {len(indices):,} points"
                f" (such as {grids.describe(first.coordinates)}) of which one for each worker"
                f" needs {2 * each * workers / 1e9:.2g} GB"
            )
        groups.append(Group(trainer, members[process.number :: process.of]))
    return groups


def _train_groups(groups: list[Group], out: Path, budget: float, stopped: Callable[[], bool]) -> None:
    """Train every group with progress on the screen: a line for each chunk, and a bar."""
    kept = runner.finished(
        out / "chunks", lambda path: console.print(f"{path}: cannot be read; its members are trained again")
    )
    mine = [group.steps for group in groups for member in group.members if member.index in kept]
    work, total = sum(len(group.members) * group.steps for group in groups), sum(len(group.members) for group in groups)
    done = before = sum(mine)
    count, start_time = len(mine), time.perf_counter()

    def eta(now: float) -> str:
        spent = time.perf_counter() - start_time
        return clock(spent / (now - before) * (work - now)) if now > before else "–"

    with progress_bar(work, done) as update:
        for number, group in enumerate(groups):
            under_way: dict[int, int] = {}  # steps of chunks
            for event in runner.run(group, devices.workers(), budget, out / "chunks", stopped):
                match event:
                    case Compiling():
                        console.print(f"compiling program {number + 1} of {len(groups)}, {event.size} members at once")
                    case Progress():
                        under_way[event.chunk] = event.env_steps
                        now = done + sum(under_way.values())
                        update(now, f"{count} of {total} members, ETA {eta(now)}")
                    case ChunkDone():
                        under_way.pop(event.chunk, None)
                        done += len(event.results) * group.steps
                        count += len(event.results)
                        diverged = sum(bool(result.diverged) for result in event.results.values())
                        console.print(
                            f"{count:>6} of {total} members done, {clock(event.seconds)} for the last"
                            f" {len(event.results)}, ETA {eta(done + sum(under_way.values()))}"
                            f"{f'; {diverged} diverged' if diverged else ''}"
                        )


def _all_results(out: Path, total: int, process: Process, stopped: Callable[[], bool]) -> dict[int, Any] | None:
    """Every member's result, once all processes are done; None if stopped before."""
    found = runner.finished(out / "chunks")
    if len(found) < total and process.of > 1 and not stopped():
        console.print(f"process {process.number}: waiting for the other processes")
    while len(found) < total and process.of > 1 and not stopped():
        time.sleep(POLL_SECONDS)
        found = runner.finished(out / "chunks")
    return found if len(found) == total else None


def _finish(out: Path, grid: Grid, found: dict[int, Any], name: str, seconds: float) -> int:
    summaries = results.summaries(grid, found)
    results.write(out, grid, found, summaries, seconds)
    _print_table(summaries, len(grid.seeds))
    plot.sweep(out / "sweep.png", summaries, f"{name}: {grid.points[0].task.name}, {len(grid.seeds)} seeds")
    code = _exit_code(out)
    if code == DONE:
        console.print(
            f"done in {clock(seconds)}: {out}/results.csv, summary.json, sweep.png;"
            f" the best point again: make train CONFIG={out}/best.json OUT=…"
        )
    return code


def _exit_code(out: Path) -> int:
    if (out / "best.json").exists():
        return DONE
    print_error(f"{out}: every member diverged; see results.csv")
    return FAILED


def _print_table(summaries: list[results.Summary], seeds: int) -> None:
    """The best points, best first: median and quartiles over seeds."""
    rows = [
        [*(grids.text(v) for v in f["at"].values()), _spread(f["return_mean"], ".2f"), _spread(f["success"], ".3f")]
        + [f"{f['diverged']} of {seeds}" if f["diverged"] else ""]
        for f in results.ranked(summaries)[:SHOWN]
    ]
    rows.insert(0, [*summaries[0]["at"], "return", "success", "diverged"])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        console.print("  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    if len(summaries) > SHOWN:
        console.print(f"… and {len(summaries) - SHOWN:,} more in summary.json")


def _spread(quartiles: dict[str, float], form: str) -> str:
    if quartiles["median"] != quartiles["median"]:
        return "–"
    return f"{quartiles['median']:{form}} [{quartiles['q1']:{form}} … {quartiles['q3']:{form}}]"

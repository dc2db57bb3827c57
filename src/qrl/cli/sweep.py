"""`qrl sweep`: from a grid file to a folder of results; rerun to resume."""

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from qrl import tasks
from qrl.algorithm.flights import FlightPlan
from qrl.cli.terminal import DONE, FAILED, clock, console, plural, print_error, progress_bar, stop_requested
from qrl.runs import files, record
from qrl.sweep import grid as grids
from qrl.sweep import plot, results, runner
from qrl.sweep.grid import Grid, GridPoint
from qrl.sweep.runner import Chunk, ChunkDone, Compiling, Member, Progress, Result
from qrl.sweep.search import Proposals
from qrl.training import devices
from qrl.training.state import member_inputs
from qrl.training.trainer import make_trainer
from qrl_envs.specfile import BadInput, read

SHOWN = 20  # points in the table on the terminal


def sweep(args: argparse.Namespace) -> int:
    start_time = time.perf_counter()
    given = args.memory_gb * 1e9 if args.memory_gb is not None else None
    if args.engine == "ray":
        if not importlib.util.find_spec("ray"):
            raise BadInput("--engine ray: needs Ray: pip install 'qrl[ray]'")
        jax.config.update("jax_platforms", "cpu")  # the accelerators are for the cluster's tasks
        from qrl.sweep.ray_engine import Ray

        engine = Ray(given)  # first of all: it may fork, which a process that has JAX's threads must not
    else:
        engine = runner.Local(given)
    try:
        return _sweep(args, engine, start_time)
    finally:
        engine.close()


def _sweep(args: argparse.Namespace, engine: runner.Engine, start_time: float) -> int:
    grid = grids.load(args.grid, engine.grid_bytes)
    out: Path = args.out or Path("runs") / args.grid.stem
    if _holds_sweep(out, grid) and (out / "summary.json").exists() and (out / "sweep.png").exists():
        console.print(f"{out}: complete already; nothing to do")
        return _exit_code(out)
    plan = Plan(grid, engine, args.grid)
    out.mkdir(parents=True, exist_ok=True)
    with files.locked(out / "sweep.lock", f"{out}: in use by another sweep; wait for its end, or give another OUT"):
        if not _holds_sweep(out, grid):
            here = {"versions": record.versions(), "devices": devices.device_names()}
            files.write_json(out / "grid.json", {**grid.record, **here})
        console.print(f"{plan.describe()}, {engine.describe()} -> {out}")
        with stop_requested("stopping: finished chunks are kept") as stopped:
            found = _train(plan, engine, out / "chunks", stopped)
        if found is None:
            console.print("stopped; rerun the same command to resume")
            return FAILED
        return _finish(out, plan.grid, found, args.grid.stem, time.perf_counter() - start_time)


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
        version = "qrl or Optuna" if grid.file.search else "qrl"
        raise BadInput(
            f"{out}: holds a sweep of another grid, or by another version of {version} ({path}); give another OUT"
        )
    return True


class Program(NamedTuple):
    """A compiled program: a point that it is made from, its number, and the bytes of each member."""

    point: GridPoint
    number: int
    member_bytes: int

    def chunk(self, members: list[Member], size: int) -> Chunk:
        at, room = self.point, runner.chunk_bytes(size, self.member_bytes)
        return Chunk(at.task, at.learner, at.static, members, size, self.number, room)


class Plan:
    """What a sweep has to train: all points of a grid, or a search's, batch by batch."""

    def __init__(self, grid: Grid, engine: runner.Engine, path: Path) -> None:
        """BadInput if a point cannot be trained, or does not fit into memory; of a search, if one of the probes."""
        self._given, self._engine, self._path = grid, engine, path
        self._programs: dict[str, Program] = {}  # by what is static of a point
        for indices in grid.groups():
            self._program(grid.points[indices[0]], len(indices))
        search = grid.file.search
        if search and search.maximize == "success":
            self._check_success(grid.points[0])
        self._search = Proposals(search, grid.space.axes) if search and grid.space else None
        self._points = [] if self._search else grid.points
        self._batch: range | None = None  # points of the batch under way
        self._trials = search.trials if search else len(grid.points)

    def _check_success(self, point: GridPoint) -> None:
        """BadInput if success is not measured: every trial would be as bad as the others."""
        if FlightPlan.of(tasks.environment(point.task), 1).measure is None:
            raise BadInput(
                f"{self._path}: key 'search.maximize': expected return_mean, for task '{point.task.name}' measures no"
                " success"
            )

    @property
    def grid(self) -> Grid:
        """With the points that were trained."""
        return replace(self._given, points=self._points)

    @property
    def members(self) -> int:
        return self._trials * len(self._given.seeds)

    @property
    def programs(self) -> int:
        return len(self._programs)

    def describe(self) -> str:
        what = plural(self._trials, "trial" if self._search else "point")
        programs = "" if self._search else f" in {plural(self.programs, 'compiled program')}"
        return f"{what} × {plural(len(self._given.seeds), 'seed')} = {plural(self.members, 'member')}{programs}"

    def next_batch(self, found: dict[int, Result], failed: Callable[[ChunkDone], None]) -> list[Chunk] | None:
        """The chunks of the next batch, without the members that have a result; None if there is no next.

        `failed` is to record a trial that cannot be trained, as results without reports. BadInput if none can.
        """
        if not self._search:
            if self._batch is not None:
                return None
            self._batch = range(len(self._points))
            return [chunk for indices in self._given.groups() for chunk in self._group(indices, found)]
        if self._batch is not None:
            results = [[found[index] for index in self._members(i)] for i in self._batch]
            self._search.tell(
                results, [self.grid.pruned(i, seeds) for i, seeds in zip(self._batch, results, strict=True)]
            )
        asked, first = self._search.ask(), len(self._points)
        if not asked and not any(result.rows for result in found.values()):
            raise BadInput(found[self.members - 1].diverged)
        chunks = [chunk for values in asked for chunk in self._proposed(values, found, failed)]
        self._batch = range(first, len(self._points))
        return sorted(chunks, key=lambda chunk: chunk.program) if asked else None

    def complete(self, found: dict[int, Result]) -> bool:
        """Whether all members of the batch under way have a result."""
        return all(index in found for i in self._batch or () for index in self._members(i))

    def _members(self, point: int) -> range:
        seeds = len(self._given.seeds)
        return range(point * seeds, (point + 1) * seeds)

    def _group(self, indices: list[int], found: dict[int, Result]) -> list[Chunk]:
        """The chunks of points that share a program."""
        program = self._program(self._points[indices[0]], len(indices))
        members = [m for i in indices for m in self._trained(i) if m.index not in found]
        if not members:
            return []
        size = self._size(len(members), program.member_bytes)
        return [program.chunk(members[i : i + size], size) for i in range(0, len(members), size)]

    def _proposed(
        self, values: list[Any], found: dict[int, Result], failed: Callable[[ChunkDone], None]
    ) -> list[Chunk]:
        """Make a proposal the next point, and of it a chunk where it has no result yet and can be trained."""
        space, number = self._given.space, len(self._points)
        assert space
        known = found.get(self._members(number)[0])
        at = {axis.name: value for axis, value in zip(space.axes, values, strict=True)}
        self._points.append(replace(self._given.points[0], coordinates=at))  # stands for one that cannot be
        try:
            self._points[number] = space.point(values)
            return [] if known else [self._trial(number)]
        except BadInput as error:
            if known and known.rows:
                raise
            if not known:  # recorded, since it may be the memory of this machine that it does not fit into
                lost = Result([], str(error))
                failed(ChunkDone(self._members(number)[0], dict.fromkeys(self._members(number), lost), 0.0))
            return []

    def _trial(self, point: int) -> Chunk:
        """All seeds of a trial, which is judged by them all."""
        assert self._search
        members = self._trained(point)
        chunk = self._program(self._points[point], 1).chunk(members, len(members))
        return replace(chunk, pruning=self._search.pruning())

    def _trained(self, point: int) -> list[Member]:
        at, seeds = self._points[point], self._given.seeds
        inputs = member_inputs(tasks.environment(at.task), at.learner)
        return [Member(index, seed, inputs) for index, seed in zip(self._members(point), seeds, strict=True)]

    def _size(self, members: int, each_bytes: int) -> int:
        engine = self._engine
        return runner.chunk_members(members, each_bytes, engine.memory_bytes, engine.workers, on_cpu=engine.on_cpu)

    def _program(self, point: GridPoint, points: int) -> Program:
        if point.static not in self._programs:
            env = tasks.environment(point.task)
            tasks.check(env, point.learner, f"{self._path}: at {grids.describe(point.coordinates)}")
            each = runner.member_bytes(make_trainer(env, point.learner), member_inputs(env, point.learner))
            engine, seeds = self._engine, len(self._given.seeds) if self._given.file.search else 1
            need = runner.chunk_bytes(seeds, each) * engine.workers
            if need > engine.memory_bytes:
                trial = f"{plural(seeds, 'seed')} of " if seeds > 1 else ""
                raise BadInput(
                    f"{self._path}: expected members that fit into {engine.memory_bytes / 1e9:g} GB of memory, found"
                    f" {points:,} points (such as {grids.describe(point.coordinates)}) of which {trial}one for each"
                    f" worker needs {need / 1e9:.2g} GB"
                )
            self._programs[point.static] = Program(point, len(self._programs), each)
        return self._programs[point.static]


def _train(plan: Plan, engine: runner.Engine, folder: Path, stopped: Callable[[], bool]) -> dict[int, Result] | None:
    """Train batch by batch with progress on the screen: a line for each chunk, and a bar. None if stopped before."""
    found = runner.finished(
        folder, lambda path: console.print(f"{path}: cannot be read; its members are trained again")
    )

    def failed(trial: ChunkDone) -> None:
        runner.keep(folder, trial)
        console.print(f"a trial failed: {trial.results[trial.chunk].diverged}")

    total, before, start_time = plan.members, None, time.perf_counter()
    with progress_bar(total, 0) as update:
        while (chunks := plan.next_batch(found, failed)) is not None:
            of = {chunk.index: chunk for chunk in chunks}
            count = len(plan.grid.points) * len(plan.grid.seeds) - sum(len(chunk.members) for chunk in chunks)
            before = count if before is None or not chunks else before
            under_way: dict[int, float] = {}  # members' worth of chunks
            for event in engine.run(chunks, folder, stopped):
                match event:
                    case Compiling():
                        which = f"{event.program + 1} of {plan.programs}"
                        console.print(f"compiling program {which}, {event.size} members at once")
                    case Progress():
                        under_way[event.chunk] = event.env_steps / of[event.chunk].steps
                    case ChunkDone():
                        under_way.pop(event.chunk, None)
                        count += len(event.results)
                spent, now = time.perf_counter() - start_time, count + sum(under_way.values())
                eta = f"ETA {clock(spent / (now - before) * (total - now)) if now > before else '–'}"
                update(now, f"{count} of {total} members, {eta}")
                if isinstance(event, ChunkDone):
                    diverged = sum(bool(result.diverged) for result in event.results.values())
                    pruned = any(
                        result.rows[-1]["env_steps"] < of[event.chunk].steps for result in event.results.values()
                    )
                    console.print(
                        f"{count:>6} of {total} members done, {clock(event.seconds)} for the last"
                        f" {len(event.results)}, {eta}{'; pruned' if pruned else ''}"
                        f"{f'; {diverged} diverged' if diverged else ''}"
                    )
            found = runner.finished(folder)
            if not plan.complete(found):
                return None
    return found


def _finish(out: Path, grid: Grid, found: dict[int, Any], name: str, seconds: float) -> int:
    found = {index: result for index, result in found.items() if result.rows}  # without trials that failed
    summaries = results.summaries(grid, found)
    results.write(out, grid, found, summaries, seconds)
    _print_table(grid, summaries)
    of = ", ".join(dict.fromkeys(point.asked or point.task.name for point in grid.points))
    with files.replacing(out / "sweep.png") as picture:
        plot.sweep(picture, summaries, f"{name}: {of}, {len(grid.seeds)} seeds")
    code = _exit_code(out)
    if code == DONE:
        best = ", ".join(str(path) for path in sorted(out.glob("best*.json")))
        console.print(
            f"done in {clock(seconds)}: {out}/results.csv, summary.json, sweep.png;"
            f" the best point again: make train CONFIG={best} OUT=…"
        )
    return code


def _exit_code(out: Path) -> int:
    if any(out.glob("best*.json")):
        return DONE
    print_error(f"{out}: every member diverged; see results.csv")
    return FAILED


def _print_table(grid: Grid, summaries: list[results.Summary]) -> None:
    """The best points, best first, of several tasks task after task: median and quartiles over seeds."""
    ranked = [summary for these in results.by_task(grid, summaries).values() for summary in results.ranked(these)]
    search = ["pruned"] if grid.file.search else []
    rows = [
        [*(grids.text(v) for v in f["at"].values()), _spread(f["return_mean"], ".2f"), _spread(f["success"], ".3f")]
        + [f"{f['diverged']} of {f['seeds']}" if f["diverged"] else ""]
        + ["yes" if f.get("pruned") else ""] * len(search)
        for f in ranked[:SHOWN]
    ]
    rows.insert(0, [*summaries[0]["at"], "return", "success", "diverged", *search])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        console.print("  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    if len(summaries) > SHOWN:
        console.print(f"… and {len(summaries) - SHOWN:,} more in summary.json")


def _spread(quartiles: dict[str, float], form: str) -> str:
    if quartiles["median"] != quartiles["median"]:
        return "–"
    return f"{quartiles['median']:{form}} [{quartiles['q1']:{form}} … {quartiles['q3']:{form}}]"

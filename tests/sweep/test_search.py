"""An adaptive search: it finds, it ends trials early by Optuna's rule, and it resumes to the same bits."""

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count, product
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from cli_helpers import TINY_VALUES, complaint, qrl
from qrl.cli import sweep
from qrl.sweep import results, runner
from qrl.sweep.grid import Grid, Search, Space, load
from qrl.sweep.runner import Chunk, ChunkDone, Result
from qrl.sweep.search import Proposals, Pruning
from qrl.training.trainer import Trainer
from qrl_envs.specfile import BadInput
from sweep_helpers import chunk_of, rows_of, write_grid

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")

RANGE = {"from": 1e-4, "to": 1e-1, "spacing": "log"}
FIXED = {**TINY_VALUES, "num_timesteps": 1200, "num_evals": 3}


def searched(tmp_path: Path, **search: Any) -> Path:
    about = {"trials": 9, "batch": 3, **search}
    axes = {"learning_rate": RANGE, "task.rod.mass_kg": [1.0, 1.3]}
    return write_grid(tmp_path, axes, fixed=FIXED, seeds=2, search=about)


def proposed(grid: Grid, search: Search) -> Proposals:
    assert grid.space
    return Proposals(search, grid.space.axes)


def report(step: int, value: float) -> dict[str, Any]:
    return {"env_steps": step, "updates": 1, "return_mean": value, "return_min": value, "success": math.nan}


# -- what is proposed ----------------------------------------------------------------------------------------


def test_it_comes_nearer_to_an_optimum_than_chance(tmp_path: Path) -> None:
    """A parabola over the logarithm of a step size, with a penalty for one of three named settings: of ten searches of
    40 trials the median best is worth less than a third of the loss of the best of 40 random points.
    """
    axes = {"learning_rate": RANGE, "m": {"a": {"gamma": 0.9}, "b": {"gamma": 0.8}, "c": {"gamma": 0.7}}}
    grid = load(write_grid(tmp_path, axes, search={"trials": 40}), 1e9)

    def loss(rate: float, name: str) -> float:
        return (math.log10(rate) + 1.5) ** 2 + {"a": 1.0, "b": 0.0, "c": 2.0}[name]

    def best(seed: int) -> float:
        found, proposals = [], proposed(grid, Search(trials=40, seed=seed))
        while batch := proposals.ask():
            found += [loss(*values) for values in batch]
            proposals.tell([[([report(1, -loss(*values))], "")] for values in batch], [False] * len(batch))
        assert len(found) == 40
        return min(found)

    random = np.random.default_rng(0)
    by_chance = [
        min(loss(10 ** random.uniform(-4, -1), random.choice(["a", "b", "c"])) for _ in range(40)) for _ in range(100)
    ]
    assert np.median([best(seed) for seed in range(10)]) < np.median(by_chance) / 3


def test_values_are_those_of_the_axes(tmp_path: Path) -> None:
    """Ranges within their ends, by their spacing; of lists their values."""
    grid = load(searched(tmp_path, trials=60), 1e9)
    proposals = proposed(grid, Search(trials=60, batch=60))
    rates, masses = zip(*proposals.ask(), strict=True)
    logs = np.log(np.array(rates) / 1e-4) / np.log(1e3)
    assert 0 <= logs.min() < 0.1 < 0.9 < logs.max() <= 1
    assert {*masses} == {1.0, 1.3}
    assert proposals.ask() == []


# -- what is ended early -------------------------------------------------------------------------------------


def test_a_trial_ends_where_it_is_below_the_median_of_the_others(tmp_path: Path) -> None:
    """NumPy's median of five curves, at each of two reports; the median over a trial's seeds is what is compared."""
    curves = [{10: float(v), 20: 10.0 * v} for v in (1, 2, 3, 4, 9)]
    for first, second in product((2.9, 3.1), (29.0, 31.0)):
        prune = Pruning("return_mean", curves).rule()
        at = [prune([report(step, value - 50), report(step, value), report(step, value + 1)], [""] * 3)
              for step, value in ((10, first), (20, second))]  # fmt: skip
        best_so_far = (first, max(first, second))
        assert at == [b < np.median([c[s] for c in curves]) for b, s in zip(best_so_far, (10, 20), strict=True)]


def test_no_trial_ends_before_there_is_a_median() -> None:
    assert not Pruning("return_mean", [{10: 5.0}] * 4).rule()([report(10, -100.0)], [""])


def test_seeds_that_diverge_count_as_the_worst() -> None:
    for diverged, ends in ((["", "", "NaN"], False), (["", "NaN", "NaN"], True)):
        prune = Pruning("return_mean", [{10: -1e9}] * 5).rule()
        assert prune([report(10, 1.0)] * 3, diverged) == ends


@pytest.mark.parametrize(("others", "reports"), [(1e9, 1), (-1e9, 3)])
def test_training_ends_with_the_trial(tmp_path: Path, others: float, reports: int) -> None:
    """After the first of three reports, or not at all; what was trained is what is trained without a search."""
    grid = load(write_grid(tmp_path, {"gamma": [0.9]}, fixed=FIXED), 1e9)
    chunk, device = chunk_of(grid, 2), jax.devices()[0]
    pruning = Pruning("return_mean", [{400: others, 800: others, 1200: others}] * 5)
    alone = runner.train(chunk, device, lambda: False, lambda _: None)
    found = runner.train(replace(chunk, pruning=pruning), device, lambda: False, lambda _: None)
    assert alone
    assert found
    for index in (0, 1):
        rows = [without_clock(row) for row in found.results[index].rows]
        assert rows == [without_clock(row) for row in alone.results[index].rows[:reports]]


def without_clock(row: dict[str, Any]) -> dict[str, str]:
    return {name: repr(value) for name, value in row.items() if name != "train_seconds"}  # NaN equals NaN as text


def test_a_pruned_trial_is_never_the_best(tmp_path: Path) -> None:
    """However good its last report was: the others had longer to fall."""
    grid = load(searched(tmp_path), 1e9)
    grid = Grid(grid.file, grid.points[:2], grid.space)
    early, late = Result([report(400, 9.0)], ""), Result([report(400, 1.0), report(1200, 2.0)], "")
    summaries = results.summaries(grid, {0: early, 1: late, 2: late, 3: late})
    assert [s["pruned"] for s in summaries] == [True, False]
    assert results.best(summaries) == 1


# -- from the command line -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("search")
    assert qrl("sweep", searched(folder), "--out", folder / "out") == 0
    return folder / "out"


def test_every_trial_has_its_rows(done: Path) -> None:
    rows = rows_of(done / "results.csv")
    assert [(int(row["point"]), int(row["seed"])) for row in rows] == list(product(range(9), range(2)))
    for row in rows:
        assert (row["pruned"] == "True") == (int(row["env_steps"]) < 1200)
    with (done / "curves.csv").open() as file:
        assert sum(row["env_steps"] == "400" for row in csv.DictReader(file)) == 18
    summary = json.loads((done / "summary.json").read_text())
    whole = [p for p in summary["points"] if not p["pruned"]]
    assert summary["best"] == max(whole, key=lambda p: p["return_mean"]["median"])["point"]


@pytest.mark.parametrize("kept", [(), (0, 2, 6), (0, 2, 4, 6, 8, 10)])
def test_an_interrupted_search_goes_on_to_the_same_bits(
    done: Path, tmp_path: Path, kept: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the trials of its first batch, some of the second, and none; also where trials end in another order."""
    out = tmp_path / "out"
    (out / "chunks").mkdir(parents=True)
    for path in [done / "grid.json", *(done / "chunks" / f"{index:07d}.json" for index in kept)]:
        (out / path.relative_to(done)).write_bytes(path.read_bytes())
    run = runner.Local.run
    monkeypatch.setattr(runner.Local, "run", lambda self, chunks, *rest: run(self, chunks[::-1], *rest))
    assert qrl("sweep", searched(tmp_path), "--out", out) == 0
    for table in ("results.csv", "curves.csv"):
        assert rows_of(out / table) == rows_of(done / table)
    assert (out / "best.json").read_text() == (done / "best.json").read_text()


class Instant:
    """An engine that trains nothing: what a member comes to is its number."""

    on_cpu, workers, grid_bytes = True, 1, 1e9

    def __init__(self, memory_bytes: float = 1e9) -> None:
        self.memory_bytes = memory_bytes
        self.trained: list[int] = []  # the first member of each chunk

    def run(self, chunks: Sequence[Chunk], folder: Path, stopped: Callable[[], bool]) -> Iterator[ChunkDone]:
        for chunk in chunks:
            self.trained.append(chunk.index)
            each = {member.index: Result([report(chunk.steps, -member.index)], "") for member in chunk.members}
            runner.keep(folder, ChunkDone(chunk.index, each, 0.0))
            yield ChunkDone(chunk.index, each, 0.0)

    def describe(self) -> str:
        return "nowhere"

    def close(self) -> None: ...


@pytest.fixture
def excluding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Path]:
    """A search of so many steps over two settings, of which 16 and 8 need more than 400, and 128 bytes a member."""

    def bytes_of(trainer: Trainer, _: Any) -> int:
        return trainer.config.num_envs * trainer.config.warmup_unrolls

    monkeypatch.setattr(runner, "member_bytes", bytes_of)
    axes = {"num_envs": [4, 16], "warmup_unrolls": [2, 8], "gamma": {"from": 0.5, "to": 0.9}}
    fixed = {name: value for name, value in TINY_VALUES.items() if name not in axes}

    def write(steps: int) -> Path:
        search = {"trials": 12, "batch": 3}
        return write_grid(tmp_path, axes, fixed={**fixed, "num_timesteps": steps}, search=search)

    return write


@pytest.mark.parametrize("steps", [400, 4000])
def test_a_trial_that_cannot_be_trained_fails_alone(
    excluding: Callable[[int], Path], tmp_path: Path, steps: int
) -> None:
    """For want of steps or of memory: Optuna and the tables do without it. A search that goes on, even where there is
    memory, has the same numbers.
    """
    path, out = excluding(steps), tmp_path / "out"
    grid = load(path, 1e9)

    def search(engine: Instant) -> tuple[sweep.Plan, dict[int, Result]]:
        plan = sweep.Plan(grid, engine, path)
        return plan, sweep._train(plan, engine, out / "chunks", lambda: False) or {}

    small, large = Instant(memory_bytes=100.0), Instant()
    plan, found = search(small)
    at = [point.coordinates for point in plan.grid.points]
    lost = {i for i, place in enumerate(at) if (place["num_envs"], place["warmup_unrolls"]) == (16, 8)}
    assert 0 < len(lost) < 12
    assert plan._search
    assert [trial.state.name == "FAIL" for trial in plan._search._study.trials] == [i in lost for i in range(12)]
    assert sorted(small.trained) == [2 * i for i in range(12) if i not in lost]

    for chunk in sorted((out / "chunks").glob("*.json"))[6:]:
        chunk.unlink()
    assert repr(search(small)[1]) == repr(found)
    assert repr(search(large)[1]) == repr(found)
    assert not large.trained

    assert sweep._finish(out, plan.grid, found, "grid", 1.0) == 0
    rows = rows_of(out / "results.csv")[::2]
    assert [(int(row["point"]), float(row["gamma"])) for row in rows] == [
        (i, at[i]["gamma"]) for i in range(12) if i not in lost
    ]


def test_where_no_trial_can_be_trained_the_last_says_why(
    excluding: Callable[[int], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time."""
    path, asked = excluding(400), count(1)
    grid = load(path, 1e9)

    def refuse(self: Space, values: Any) -> None:
        raise BadInput(f"no {next(asked)}")

    monkeypatch.setattr(Space, "point", refuse)
    for _ in range(2):
        plan = sweep.Plan(grid, Instant(), path)
        with pytest.raises(BadInput, match=r"^no 12$"):
            sweep._train(plan, Instant(), tmp_path / "chunks", lambda: False)


def test_a_success_that_is_not_measured_is_no_goal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = searched(tmp_path, maximize="success")
    sweep.Plan(load(path, 1e9), Instant(), path)
    fast = {"task": "fast", "fixed": {**FIXED, "episode_length": 20}, "search": {"trials": 2, "maximize": "success"}}
    said = complaint(capsys, "sweep", write_grid(tmp_path, {"gamma": [0.8, 0.9]}, **fast), "--out", tmp_path / "out")
    assert "grid.json: key 'search.maximize': expected return_mean, for task 'fast' measures no success" in said
    assert not (tmp_path / "out").exists()


def test_a_search_needs_optuna(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = complaint(capsys, "sweep", searched(tmp_path), "--out", tmp_path / "out")
    assert "key 'search': needs Optuna: pip install 'qrl[search]'" in said

"""An adaptive search: it finds, it ends trials early by Optuna's rule, and it resumes to the same bits."""

import csv
import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from cli_helpers import TINY_VALUES, complaint, qrl
from qrl.sweep import results, runner
from qrl.sweep.grid import Grid, Search, load
from qrl.sweep.runner import Result
from qrl.sweep.search import Proposals, Pruning
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


def test_a_search_needs_optuna(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = complaint(capsys, "sweep", searched(tmp_path), "--out", tmp_path / "out")
    assert "key 'search': needs Optuna: pip install 'qrl[search]'" in said

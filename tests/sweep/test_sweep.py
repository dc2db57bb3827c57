"""A sweep's members are single runs: the same bits, whoever ran beside them, however often it was interrupted."""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from cli_helpers import TINY_VALUES, complaint, qrl
from qrl.cli import sweep
from qrl.config import FORMER_NAMES
from qrl.runs import files
from qrl.sweep import plot, results, runner
from qrl.sweep.grid import load
from qrl.sweep.runner import Local, Progress, Result
from qrl.training import driver, sharding
from qrl.training.state import TrainState, member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds
from qrl_envs.specfile import BadInput
from sweep_helpers import Rows, chunk_of, rows_of, write_grid

pytestmark = pytest.mark.usefixtures("quick_compilation_of_module")

AXES = {"learning_rate": [1e-3, 1e-2, 1e30], "task.rod.mass_kg": [1.3, 1.0]}  # the last step size diverges


def at(rows: Rows, **place: str) -> dict[str, str]:
    """The row of a point and seed, without its number in the grid."""
    (row,) = [r for r in rows if all(r[name] == value for name, value in place.items())]
    return {name: value for name, value in row.items() if name != "point"}


@pytest.fixture(scope="module")
def compiled() -> Iterator[list[str]]:
    """Names of the programs that XLA compiled or took from its cache, as JAX's own monitoring tells them."""
    names: list[str] = []

    def listen(event: str, _: float, **about: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, compiled: list[str]) -> Path:
    """A sweep of twelve members, of which four diverge, in chunks of three."""
    folder = tmp_path_factory.mktemp("sweep")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "CPU_CHUNK", 3)
        compiled.clear()
        assert qrl("sweep", write_grid(folder, AXES), "--out", folder / "out") == 0
    (folder / "compiled.json").write_text(json.dumps(compiled))
    return folder / "out"


def test_one_program_for_points_that_differ_in_traced_values(done: Path) -> None:
    """Step sizes and masses travel: training was compiled once, and so were its first state and evaluation."""
    names = json.loads((done.parent / "compiled.json").read_text())
    for program in ("init", "train", "fly"):
        assert names.count(f"jit({program})") == 1, names


def test_one_program_for_each_static_value(tmp_path: Path, compiled: list[str]) -> None:
    compiled.clear()
    axes = {"gamma": [0.9, 0.99], "normalize_advantage": [True, False]}
    assert qrl("sweep", write_grid(tmp_path, axes), "--out", tmp_path / "out") == 0
    assert compiled.count("jit(train)") == 2
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["programs"] == 2


def test_results_hold_every_point_and_seed(done: Path) -> None:
    rows = rows_of(done / "results.csv")
    places = [(float(r["learning_rate"]), float(r["task.rod.mass_kg"]), int(r["seed"])) for r in rows]
    assert places == [
        (rate, mass, seed) for rate in AXES["learning_rate"] for mass in AXES["task.rod.mass_kg"] for seed in (0, 3)
    ]
    assert {row["env_steps"] for row in rows} == {"400"}
    assert len({row["return_mean"] for row in rows if not row["diverged"]}) == 8  # no two members are the same
    assert [r["env_steps"] for r in rows_of(done / "curves.csv")] == ["200", "400"] * 12


def test_no_axis_may_be_called_like_a_column(done: Path, tmp_path: Path) -> None:
    with (done / "results.csv").open() as file:
        columns = set(csv.DictReader(file).fieldnames or ())
    for name in columns - AXES.keys():
        with pytest.raises(BadInput, match="another name"):
            load(write_grid(tmp_path, {name: {"a": {"gamma": 0.9}}}), 1e9)


def test_best_json_repeats_its_row_bit_for_bit(done: Path, tmp_path: Path) -> None:
    """The winner, trained by itself, makes the same metrics.csv that the sweep's member made."""
    assert qrl("train", "--config", done / "best.json", "--out", tmp_path / "best") == 0
    best = json.loads((done / "best.json").read_text())
    # Not of the vehicle from which the environment of the whole group was made: a member has its own.
    assert best["task"]["spec"]["rod"]["mass_kg"] != AXES["task.rod.mass_kg"][0]
    place = {
        "learning_rate": repr(best["learner"]["learning_rate"]),
        "task.rod.mass_kg": repr(best["task"]["spec"]["rod"]["mass_kg"]),
        "seed": str(best["seed"]),
    }
    swept, single = at(rows_of(done / "results.csv"), **place), rows_of(tmp_path / "best" / "metrics.csv")
    assert single[-1].items() <= swept.items()
    assert swept.keys() - single[-1].keys() == {"learning_rate", "task.rod.mass_kg", "seed", "diverged"}
    curve = [r for r in rows_of(done / "curves.csv") if all(r[name] == value for name, value in place.items())]
    assert [r["return_mean"] for r in curve] == [r["return_mean"] for r in single]


def test_a_vehicle_is_evaluated_by_its_own_physics(done: Path) -> None:
    """Points that differ in mass alone fly differently under nearly the same first policies."""
    rows = rows_of(done / "curves.csv")
    first = [r["return_mean"] for r in rows if r["env_steps"] == "200" and r["learning_rate"] == "0.001"]
    assert len(set(first)) == 4


def test_a_member_that_diverges_is_marked_and_disturbs_nobody(done: Path, tmp_path: Path) -> None:
    """The others' results are those of a sweep without it, bit for bit."""
    rows = rows_of(done / "results.csv")
    assert {bool(r["diverged"]) for r in rows if r["learning_rate"] == "1e+30"} == {True}
    assert "is not finite in update" in rows[-1]["diverged"]
    well = {"learning_rate": [1e-2], "task.rod.mass_kg": AXES["task.rod.mass_kg"]}
    assert qrl("sweep", write_grid(tmp_path, well), "--out", tmp_path / "well") == 0
    for row in rows_of(tmp_path / "well" / "results.csv"):
        place = {name: row[name] for name in ("learning_rate", "task.rod.mass_kg", "seed")}
        assert not row["diverged"]
        assert at([row], **place) == at(rows, **place)


def test_summary_says_what_diverged_and_which_is_best(done: Path) -> None:
    summary = json.loads((done / "summary.json").read_text())
    assert [p["diverged"] for p in summary["points"]] == [0, 0, 0, 0, 2, 2]
    assert summary["points"][4]["return_mean"] == {"median": None, "q1": None, "q3": None}  # JSON has no −infinity
    rows = rows_of(done / "results.csv")
    medians = [np.median([float(r["return_mean"]) for r in rows[2 * i : 2 * i + 2]]) for i in range(4)]
    assert [p["return_mean"]["median"] for p in summary["points"][:4]] == medians
    assert summary["best"] == int(np.argmax(medians))  # no success in so short a training


# -- interruption --------------------------------------------------------------------------------------------


def test_an_interrupted_sweep_goes_on_and_runs_no_chunk_again(done: Path, tmp_path: Path) -> None:
    """What SIGKILL leaves: some chunks, half of another under its temporary name, no results."""
    out = tmp_path / "out"
    (out / "chunks").mkdir(parents=True)
    kept = sorted((done / "chunks").glob("*.json"))[:2]
    for path in [done / "grid.json", *kept]:
        target = out / path.relative_to(done)
        target.write_bytes(path.read_bytes())
        os.utime(target, (1, 1))
    (out / "chunks" / "0000006.json.tmp").write_text('{"members": {"6"')
    assert len(runner.finished(out / "chunks")) == 6
    assert qrl("sweep", write_grid(tmp_path, AXES), "--out", out) == 0
    assert [(out / "chunks" / path.name).stat().st_mtime for path in kept] == [1, 1]
    made = set(runner.finished(out / "chunks"))
    assert made == set(range(12))
    in_files = [n for p in (out / "chunks").glob("*.json") for n in json.loads(p.read_text())["members"]]
    assert len(in_files) == 12
    assert rows_of(out / "results.csv") == rows_of(done / "results.csv")
    assert (out / "best.json").read_text() == (done / "best.json").read_text()


def test_a_finished_sweep_is_left_as_it_is(done: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in done.rglob("*")}
    assert qrl("sweep", write_grid(tmp_path, AXES), "--out", done) == 0
    assert {path: path.stat().st_mtime_ns for path in done.rglob("*")} == before


@pytest.mark.parametrize(("laps", "recorded"), [(0, 0), (7, 0), (10, 2)])
def test_a_chunk_is_recorded_whole_or_not_at_all(tmp_path: Path, laps: int, recorded: int) -> None:
    """Stopped before its end, even after its first report (lap 5 of 10), it leaves nothing."""
    grid = load(write_grid(tmp_path, {"gamma": [0.9]}), 1e9)
    asked, events = iter(range(100)), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qrl.training.driver.CHUNK_SECONDS", 1e-9)  # a lap is one unroll
        done = runner.train(chunk_of(grid, 2), jax.devices()[0], lambda: next(asked) >= laps, events.append)
    assert sum(isinstance(event, Progress) for event in events) == laps
    assert (len(done.results) if done else 0) == recorded


def test_ctrl_c_ends_with_exit_code_1_and_keeps_its_chunks(tmp_path: Path) -> None:
    """A real process, a real SIGINT, after the first chunk of many; it leaves no results that look whole."""
    grid = write_grid(
        tmp_path, {"gamma": {"from": 0.5, "to": 0.99, "count": 200}}, fixed={**TINY_VALUES, "num_timesteps": 4000}
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "qrl", "sweep", grid, "--out", tmp_path / "out"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 120
    while not list((tmp_path / "out" / "chunks").glob("*.json")) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (1, "")
    assert "rerun the same command to resume" in out
    assert 0 < len(runner.finished(tmp_path / "out" / "chunks")) < 400
    assert not (tmp_path / "out" / "summary.json").exists()


@pytest.mark.parametrize("text", ["", '{"members": {"0": {"rows": [], "diverged": ""}}}'])
def test_a_chunk_that_cannot_be_read_is_made_anew(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    """As a full disk or a crash may leave one: it is said, once, and the results are the same."""
    out = tmp_path / "out"
    (out / "chunks").mkdir(parents=True)
    for path in [done / "grid.json", *(done / "chunks").glob("*.json")]:
        (out / path.relative_to(done)).write_bytes(path.read_bytes())
    (out / "chunks" / "0000003.json").write_text(text)
    capsys.readouterr()
    assert qrl("sweep", write_grid(tmp_path, AXES), "--out", out) == 0
    assert " ".join(capsys.readouterr().out.split()).count("cannot be read; its members are trained again") == 1
    assert rows_of(out / "results.csv") == rows_of(done / "results.csv")


def test_two_sweeps_do_not_work_in_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid, out = write_grid(tmp_path, {"gamma": [0.9]}), tmp_path / "out"
    out.mkdir()
    with files.locked(out / "sweep.lock", ""):
        assert "in use by another sweep" in complaint(capsys, "sweep", grid, "--out", out)
    assert not (out / "grid.json").exists()


def test_ray_is_asked_for_by_the_name_of_its_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    grid = write_grid(tmp_path, {"gamma": [0.9]})
    said = complaint(capsys, "sweep", grid, "--out", tmp_path / "out", "--engine", "ray")
    assert said == "qrl: --engine ray: needs Ray: pip install 'qrl[ray]'\n"


def test_where_all_diverged_the_exit_code_is_1_each_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid, out = write_grid(tmp_path, {"learning_rate": [1e30]}), tmp_path / "out"
    for _ in range(2):
        assert qrl("sweep", grid, "--out", out) == 1
        assert "every member diverged" in capsys.readouterr().err


def test_a_plot_that_fails_costs_no_result(three_points: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError("no fonts")

    monkeypatch.setattr(plot, "sweep", fail)
    with pytest.raises(OSError, match="no fonts"):
        sweep._finish(tmp_path, three_points, {i: result(1.0) for i in range(12)}, "grid", 1.0)
    assert all((tmp_path / name).exists() for name in ("results.csv", "curves.csv", "summary.json", "best.json"))


def test_half_a_picture_is_none(three_points: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk that is full while it is drawn is named with it, and the next command draws it."""

    def half(path: Path, *_: Any) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(plot, "sweep", half)
    with pytest.raises(OSError, match=rf"{tmp_path}/sweep.png: cannot be written \(No space left on device\)"):
        sweep._finish(tmp_path, three_points, {i: result(1.0) for i in range(12)}, "grid", 1.0)
    assert not list(tmp_path.glob("sweep.png*"))


def test_a_folder_of_something_else_is_refused(done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = write_grid(tmp_path, {"gamma": [0.9]})
    assert "another grid" in complaint(capsys, "sweep", other, "--out", done)
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    assert "holds a run" in complaint(capsys, "sweep", other, "--out", run)
    assert "it is a file" in complaint(capsys, "sweep", other, "--out", other)


def test_a_sweep_of_the_first_version_is_refused(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its hyperparameters have their former names: it is not this sweep, even where the grid is the same."""
    stored = json.loads((done / "grid.json").read_text())
    for point in stored["points"]:
        point["learner"] = {former: point["learner"].get(name) for former, name in FORMER_NAMES.items()}
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "grid.json").write_text(json.dumps(stored))
    said = complaint(capsys, "sweep", done.parent / "grid.json", "--out", tmp_path / "out")
    assert "by another version of qrl" in said
    assert str(tmp_path / "out" / "grid.json") in said


def test_a_fault_in_a_chunk_is_no_end_of_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever it raises reaches whoever runs the sweep."""

    def train(*_: Any) -> Any:
        raise IndexError("of our own")

    grid = load(write_grid(tmp_path, {"gamma": [0.9]}), 1e9)
    monkeypatch.setattr(runner, "train", train)
    with pytest.raises(IndexError, match="of our own"):
        list(Local(1e9).run([chunk_of(grid, 1)], tmp_path / "chunks", lambda: False))


# -- memory --------------------------------------------------------------------------------------------------


def test_a_member_too_large_for_the_budget_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It says how many points and how much memory, and leaves nothing."""
    small = {name: value for name, value in TINY_VALUES.items() if name != "replay_unrolls"}
    grid = write_grid(tmp_path, {"gamma": [0.8, 0.9], "replay_unrolls": [2, 1_000_000]}, fixed=small)
    said = complaint(capsys, "sweep", grid, "--out", tmp_path / "out", "--memory-gb", "2")
    assert "fit into 2 GB of memory, found 2 points (such as gamma 0.8, replay_unrolls 1000000)" in said
    assert "GB\n" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("members", [1, 7, 128])
@pytest.mark.parametrize("workers", [1, 2, 5])
@pytest.mark.parametrize("budget", [1e3, 1e4, 1e6])
def test_chunks_keep_to_the_budget(members: int, workers: int, budget: float) -> None:
    size = runner.chunk_members(members, 300, budget, workers, on_cpu=True)
    assert size == 0 or (size + 1) * workers * 300 <= budget
    assert size <= runner.CPU_CHUNK
    if size == 0:
        assert 2 * workers * 300 > budget


@pytest.mark.parametrize("members", [1, 8])
def test_the_estimate_of_a_chunk_covers_what_xla_needs(tmp_path: Path, members: int) -> None:
    """XLA's own account of the compiled training: arguments, results and scratch."""
    grid = load(
        write_grid(tmp_path, {"gamma": [0.9]}, fixed={**TINY_VALUES, "replay_unrolls": 50, "num_timesteps": 4000}), 1e9
    )
    env, config = worlds.make("pendulum"), grid.points[0].learner
    trainer, here = make_trainer(env, config), member_inputs(env, config)
    points = stack([here] * members)
    states = jax.eval_shape(trainer.init, driver.seeds(0, members), points)
    used: Any = driver.compile_train(trainer, states, points).memory_analysis()
    need = used.argument_size_in_bytes + used.output_size_in_bytes + used.temp_size_in_bytes - used.alias_size_in_bytes
    estimate = (members + 1) * runner.member_bytes(trainer, here)
    assert estimate / 4 <= need <= estimate


# -- batching by vmap, as on a GPU ---------------------------------------------------------------------------


def test_vmapped_members_agree_with_members_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After 9 updates, to 1e-4 of each number: the sums are taken in another order, and training amplifies that."""
    grid = load(write_grid(tmp_path, {"gamma": [0.9, 0.99], "task.rod.mass_kg": [1.0, 1.5]}), 1e9)
    config = grid.points[0].learner
    points = stack([member_inputs(worlds.from_task(_task(p)), p.learner) for p in grid.points])

    def last(in_turn: bool) -> TrainState:
        monkeypatch.setattr(sharding, "sequential_members", lambda _: in_turn)
        trainer = make_trainer(worlds.make("pendulum"), config)
        return trainer.train(trainer.init(driver.seeds(0, 4), points), points, np.int32(config.num_unrolls))

    in_turn, at_once = last(in_turn=True), last(in_turn=False)
    assert int(in_turn.learner.updates[0]) == 9
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), in_turn.learner, at_once.learner)
    for counter in ("unrolls", "buffer"):
        jax.tree.map(np.testing.assert_array_equal, getattr(in_turn, counter)[-1], getattr(at_once, counter)[-1])


def _task(point: Any) -> Any:
    from qrl_envs import task

    return task.from_data(point.task.spec, "test")


# -- results -------------------------------------------------------------------------------------------------


def result(value: float, success: float = float("nan"), diverged: str = "") -> Result:
    return Result(
        [{"env_steps": 10, "updates": 1, "return_mean": value, "return_min": value, "success": success}], diverged
    )


@pytest.fixture
def three_points(tmp_path: Path) -> Any:
    return load(write_grid(tmp_path, {"gamma": [0.7, 0.8, 0.9]}, seeds=4), 1e9)


def test_quartiles_are_numpys_and_divergence_counts_as_the_worst(three_points: Any) -> None:
    values = [[1.0, 2.0, 3.0, 10.0], [5.0, 6.0, 7.0, 8.0], [9.0, 9.0, 9.0, 9.0]]
    diverged = {(1, 2), (2, 0), (2, 1), (2, 2)}
    found = {
        4 * i + j: result(v, diverged="NaN" * ((i, j) in diverged))
        for i, vs in enumerate(values)
        for j, v in enumerate(vs)
    }
    first, second, third = results.summaries(three_points, found)
    quartiles = dict(zip(("q1", "median", "q3"), np.quantile(values[0], [0.25, 0.5, 0.75]), strict=True))
    assert first["return_mean"] == quartiles
    assert second["return_mean"]["median"] == np.median([-np.inf, 5.0, 6.0, 8.0]) == 5.5
    assert third["return_mean"]["median"] == -np.inf
    assert [f["diverged"] for f in (first, second, third)] == [0, 1, 3]
    assert results.best([first, second, third]) == 1


def test_success_ranks_before_return_and_the_middle_seed_repeats(three_points: Any) -> None:
    values = [[(9.0, 0.5)] * 4, [(4.0, 1.0), (1.0, 1.0), (3.0, 1.0), (2.0, 1.0)], [(1.0, 1.0)] * 4]
    found = {4 * i + j: result(*v) for i, vs in enumerate(values) for j, v in enumerate(vs)}
    findings = results.summaries(three_points, found)
    assert results.best(findings) == 1
    assert [f["point"] for f in results.ranked(findings)] == [1, 2, 0]
    assert results.best_run_config(three_points, found, 1).seed == 3  # of returns 4, 1, 3, 2 the lower median, 2


@pytest.mark.parametrize(
    ("values", "quartiles"),
    [
        ([1.0, 2.0, np.inf], (2.0, 1.5, np.inf)),
        ([1.0, np.inf, np.inf], (np.inf, np.inf, np.inf)),
        ([-np.inf, -np.inf, 3.0, 5.0], (-np.inf, -np.inf, 3.5)),
        ([1.0, 2.0, np.nan], (np.nan, np.nan, np.nan)),
    ],
)
def test_quartiles_of_infinities(values: list[float], quartiles: tuple) -> None:
    found = results._quartiles(values)
    np.testing.assert_equal((found["median"], found["q1"], found["q3"]), quartiles)


def test_a_seed_that_diverged_never_settled(three_points: Any) -> None:
    """It is the worst in every measure; a success that nobody measured stays unmeasured."""
    found = {i: result(1.0, diverged="NaN" * (i < 5)) for i in range(12)}
    for kept in found.values():
        kept.rows[0]["settle_median_s"] = kept.rows[0]["rms_m"] = 2.0
    findings = results.summaries(three_points, found)
    for name in ("settle_median_s", "rms_m"):
        assert [(f[name]["median"], f[name]["q3"]) for f in findings] == [(np.inf, np.inf), (2.0, np.inf), (2.0, 2.0)]
    assert all(np.isnan(f["success"]["median"]) for f in findings)
    assert [f["point"] for f in results.ranked(findings)] == [1, 2, 0]
    found[11].rows[0]["success"] = 0.0
    assert results.summaries(three_points, found)[0]["success"]["median"] == 0.0


def test_where_all_diverge_there_is_no_best(three_points: Any) -> None:
    found = {i: result(1.0, diverged="NaN") for i in range(12)}
    assert results.best(results.summaries(three_points, found)) is None


@pytest.mark.parametrize(
    ("places", "panels"),
    [
        ([{"a": 1e-4}, {"a": 1e-3}, {"a": 1e-1}], 1),
        ([{"m": "ours"}, {"m": "PPO $x$"}], 1),
        ([{"a": a, "b": b} for a in (1.0, 2.0) for b in ("x", "y")], 1),
        ([{"a": 0.1, "b": 3}, {"a": 0.2, "b": 1}, {"a": 0.25, "b": 9}], 2),
        ([{"a": 1, "b": 2, "c": c} for c in (None, [1.0, 2.0], True)], 3),
    ],
    ids=["curve", "names", "heat map", "sample of two axes", "three axes"],
)
def test_the_plot_fits_the_axes(tmp_path: Path, places: list[dict], panels: int) -> None:
    """One panel for a curve or a heat map, else one for each axis; the medians are what is drawn."""
    numbers = [{"median": float(i), "q1": i - 0.5, "q3": i + 0.5} for i in range(len(places))]
    none = {"median": -np.inf, "q1": -np.inf, "q3": np.nan}
    found = [{"at": place, "return_mean": n, "success": none} for place, n in zip(places, numbers, strict=True)]
    figure = plot.sweep_figure(found, "title")
    drawn = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    assert len(drawn) == panels
    if drawn[0].images:
        np.testing.assert_array_equal(drawn[0].images[0].get_array(), np.arange(4.0).reshape(2, 2))
    else:
        heights = np.concatenate([line.get_ydata() for line in drawn[0].lines])
        assert {0.0, 1.0} <= set(heights)
    plot.sweep(tmp_path / "sweep.png", found, "title")
    assert (tmp_path / "sweep.png").stat().st_size > 1000

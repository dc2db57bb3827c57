"""The paper's figures and the ablation's table: when a run is current, what is drawn, and what is told of it."""

import itertools
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from experiments.figures import ablation, captions
from experiments.figures import flights as figure_flights
from experiments.figures import make as figures
from experiments.figures import plots as draw
from experiments.figures import runs as figure_runs
from experiments.figures.captions import CONFIRMED, EXCEEDED, NOT, Provenance
from experiments.figures.flights import PolicyFlights
from experiments.figures.plots import Curves, Rate
from experiments.figures.runs import CODE, RunSpec
from qrl.algorithm.learner import LearnerState
from qrl.config import load_preset
from qrl.evaluation.starts import evaluation_starts
from qrl.runs import files, record
from qrl.training import restore
from qrl.training.driver import seeds
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds
from qrl_envs import task

HOVER = RunSpec("hover", "hover", "hover_fast", {"num_timesteps": 320_000}, 2)


def folder_of(path: Path, one: RunSpec, *, finished: bool = True, **changes: Any) -> Path:
    """A run's folder as `make` leaves it, but for its checkpoints; `changes` to its config.json."""
    path.mkdir(parents=True, exist_ok=True)
    files.write_json(path / "config.json", one.config().model_dump(mode="json") | changes)
    (path / CODE).write_text(figure_runs.sha256())
    if finished:
        files.write_json(path / "summary.json", {})
    return path


def with_metrics(path: Path, one: RunSpec, returns: list[list[float]], success: list[list[float]]) -> Path:
    """A finished run of which each seed reported `returns` and `success` [seeds][x], every 100 steps."""
    folder = folder_of(path, one)
    for seed, (r, s) in enumerate(zip(returns, success, strict=True)):
        (folder / f"seed-{one.seed + seed}").mkdir()
        rows = [
            {"env_steps": 100 * (i + 1), "updates": i, "return_mean": a, "return_min": a, "success": b}
            | {"train_seconds": 1.0}
            for i, (a, b) in enumerate(zip(r, s, strict=True))
        ]
        files.write_metrics(folder / f"seed-{one.seed + seed}", rows)
    return folder


def curves(*returns: list[float], success: tuple[list[float], ...] = (), label: str = "") -> Curves:
    values = np.array(returns, float)
    shares = np.array(success, float) if success else np.full(values.shape, np.nan)
    return Curves(label, 100.0 * np.arange(1, values.shape[1] + 1), values, shares)


def flown(name: str, observations: np.ndarray, succeed: list[bool]) -> PolicyFlights:
    n = len(succeed)
    sizes = {f"rms_{what}_m": np.arange(1, n + 1) / 1000.0 for what in ("position", "radius", "height")}
    settle_s = np.where(succeed, 1.25, np.inf)
    measures = sizes | {"success": np.array(succeed, float), "settle_s": settle_s}
    return PolicyFlights(3, 1_234_000, task.load(name), observations, measures)


def circling(n: int, vx: float = 2.0, vy: float = 2.0) -> np.ndarray:
    """Flights of 12 s round the circle at 2 rad/s, each half a meter higher up x than the one before."""
    t = np.arange(1201) * 0.01
    found = np.zeros((n, 1201, 18))
    found[..., 9], found[..., 10] = np.cos(2 * t) + 0.5 * np.arange(n)[:, None], np.sin(2 * t)
    found[..., 12], found[..., 13] = -vx * np.sin(2 * t), vy * np.cos(2 * t)
    return found


# Whether a run is current


def test_a_run_is_current_only_if_all_that_decides_it_is_the_same(tmp_path: Path) -> None:
    config = HOVER.config()
    stored = config.model_dump(mode="json")
    assert figure_runs.is_current(folder_of(tmp_path / "same", HOVER), config)
    assert not figure_runs.is_current(tmp_path / "none", config)
    assert not figure_runs.is_current(folder_of(tmp_path / "unfinished", HOVER, finished=False), config)
    assert figure_runs.is_same(tmp_path / "unfinished", config)
    for i, change in enumerate(
        (
            {"learner": stored["learner"] | {"gamma": 0.5}},
            {"task": stored["task"] | {"name": "circle"}},
            {"seeds": 3},
            {"seed": 1},
            {"versions": stored["versions"] | {"jax": "0.1"}},
        )
    ):
        assert not figure_runs.is_current(folder_of(tmp_path / f"other {i}", HOVER, **change), config)
    elsewhere = {"devices": ["another"], "versions": stored["versions"] | {"commit": "another"}}
    assert figure_runs.is_current(folder_of(tmp_path / "elsewhere", HOVER, **elsewhere), config)


def test_a_run_of_other_code_or_a_damaged_one_is_not_current(tmp_path: Path) -> None:
    config = HOVER.config()
    (folder_of(tmp_path / "code", HOVER) / CODE).write_text("of another code")
    (folder_of(tmp_path / "damaged", HOVER) / "config.json").write_text("[1, {")
    (folder_of(tmp_path / "odd", HOVER) / "config.json").write_text("[]")
    (folder_of(tmp_path / "codeless", HOVER) / CODE).unlink()
    for name in ("code", "damaged", "odd", "codeless"):
        assert not figure_runs.is_current(tmp_path / name, config)


def test_the_code_of_a_run_is_what_decides_its_numbers() -> None:
    found = figure_runs.sources()
    assert {
        "qrl.algorithm.learner",
        "qrl.algorithm.vtrace",
        "qrl.algorithm.objective",
        "qrl.algorithm.flights",
        "qrl_envs.quadrotor",
    } <= found.keys()
    assert not {"qrl.runs.learning_curve", "qrl.cli.main", "qrl.sweep.runner", "qrl_envs.plots"} & found.keys()


def test_an_unfinished_run_goes_on_and_a_stale_one_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[list[str]] = []
    monkeypatch.setattr(figure_runs, "qrl", lambda words, *_: called.append(words))
    unfinished = folder_of(tmp_path / "unfinished", HOVER, finished=False)
    stale = folder_of(tmp_path / "stale", HOVER, seeds=3)
    for folder in (unfinished, stale, tmp_path / "new"):
        (folder.mkdir() if not folder.exists() else (folder / "kept").touch())
        figure_runs.train(HOVER, folder)
        assert (folder / CODE).read_text() == figure_runs.sha256()
    words = [
        "train",
        "hover",
        "--seed",
        "100",
        "--seeds",
        "2",
        "--preset",
        "hover_fast",
        "--num-timesteps",
        "320000",
        "--out",
    ]
    assert called == [
        [*words, str(unfinished), "--resume"],
        [*words, str(stale)],
        [*words, str(tmp_path / "new")],
    ]
    assert (unfinished / "kept").exists()
    assert not (stale / "kept").exists()
    assert not (stale / "config.json").exists()


def test_a_current_run_is_not_made_again_unless_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []
    monkeypatch.setattr(figure_runs, "qrl", lambda words, *_: called.append(words))
    folder = folder_of(tmp_path / "run", HOVER)
    figures.ensure_run(HOVER, folder, fresh=False)
    assert called == []
    figures.ensure_run(HOVER, folder, fresh=True)
    assert len(called) == 1
    assert "--resume" not in called[0]


def test_a_run_that_fails_gets_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", "false")
    assert figures.main(["--fast", "--only", "hover", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("figures: qrl train hover")
    assert said.endswith("exit code 1\n")
    assert said.count("\n") == 1


@pytest.mark.parametrize("fast", [False, True])
def test_every_figure_has_its_runs(fast: bool) -> None:
    plan = figure_runs.plan(fast=fast)
    assert len({one.name for one in plan}) == len(plan)
    for name in figures.FIGURES:
        for one in figures.needed(name, plan):
            one.config()  # flags that the learner knows
            assert one.seeds >= (1 if one.name.endswith("-flight") else 2 if fast else 10)
            assert one.seed >= 100  # held out
    by_name = {one.name: one for one in plan}
    assert figures.needed("hover", plan) == [by_name["hover"]]
    assert figures.needed("circle_velocity", plan) == [by_name["circle" if fast else "circle-flight"]]


def test_the_pendulums_rates() -> None:
    """The paper's own, and two in their ratio; PPO at each."""
    plan = {one.name: one for one in figure_runs.plan(fast=False)}
    rates = {name: one.flags["learning_rate"] for name, one in plan.items() if one.task == "pendulum"}
    assert (rates["pendulum-paper-high"], rates["pendulum-paper-low"]) == (1e-4, 0.5e-5)
    assert rates["pendulum-high"] / rates["pendulum-low"] == pytest.approx(20.0)
    for name, one in plan.items():
        if name.endswith("-ppo"):
            assert one.flags == plan[name.removesuffix("-ppo")].flags | figure_runs.PPO


# What is drawn


def line(axes: Axes, label: str) -> np.ndarray:
    """The [n, 2] points of the line that bears `label`."""
    return np.asarray(next(line for line in axes.lines if line.get_label() == label).get_xydata())


def band(axes: Axes, x: float, which: int = 0) -> tuple[float, float]:
    """A filled band's lowest and highest vertex at `x`."""
    vertices = np.asarray(axes.collections[which].get_paths()[0].vertices)
    y = vertices[np.isclose(vertices[:, 0], x), 1]
    return y.min(), y.max()


SEEDS = ([10.0, 20.0], [30.0, 40.0], [50.0, 90.0], [70.0, 60.0], [90.0, 80.0])
SUCCESS = ([0.0, 1.0], [0.1, 1.0], [0.2, 0.5], [0.3, 0.9], [0.4, 0.98])


def six_figures() -> dict[str, Figure]:
    many, ppo = curves(*SEEDS, success=SUCCESS, label="ours, 1"), curves([1.0, 2.0], [3.0, 4.0], label="PPO, 1")
    trial = np.zeros((6, 801, 18))
    trial[..., 9:12] = np.arange(6)[:, None, None] + np.array([0.1, 0.2, 0.3])
    return {
        "pendulum": draw.pendulum([Rate("these: 1", many, ppo), Rate("those: 1", ppo, many)]),
        "hover": draw.hover(many),
        "hover_trial": draw.trial(flown("hover", trial, [True] * 6)),
        "circle": draw.circle(many),
        "circle_from_above": draw.from_above(flown("circle", circling(6), [True] * 6)),
        "circle_velocity": draw.velocity(flown("circle", circling(6), [True] * 6)),
    }


def test_every_axis_has_its_unit_and_no_letter_is_small() -> None:
    drawn = six_figures()
    assert drawn.keys() == figures.FIGURES.keys()
    for figure in drawn.values():
        assert figure.get_size_inches()[0] == 3.4
        for i, axes in enumerate(figure.axes):
            last = i == len(figure.axes) - 1
            for label in (axes.get_ylabel(), *([axes.get_xlabel()] if last else [])):
                assert re.search(r" \[(1|%|s|m|m/s)\]$", label), label
        figure.set_layout_engine("none")  # which takes the longest
        figure.draw_without_rendering()  # ticks have no letters before
        texts: list[Any] = figure.findobj(Text)
        assert min(text.get_fontsize() for text in texts if text.get_text()) >= 8.0


def test_a_figure_is_saved_as_png_and_svg(tmp_path: Path) -> None:
    draw.save(six_figures()["circle_velocity"], tmp_path / "a")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert "<svg" in (tmp_path / "a.svg").read_text()[:1000]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "a.svg"]


def test_learning_curves_are_interquartile_means() -> None:
    """The band is the interval of all 5⁵ resamples, of each of which the middle three count."""
    every = np.sort([np.mean(np.sort(one)[1:4]) for one in itertools.product((10, 30, 50, 70, 90), repeat=5)])
    drawn = six_figures()
    upper, lower = drawn["hover"].axes
    np.testing.assert_array_equal(line(upper, "ours, 1"), [[100, 50], [200, 60]])
    np.testing.assert_allclose(band(upper, 100.0), np.quantile(every, (0.025, 0.975)), atol=2.0)  # of 9,999 drawn
    np.testing.assert_array_equal(line(upper, "published checkpoints")[[0, -1]], [[2e6, 151], [10e6, 162.9]])
    np.testing.assert_allclose(lower.lines[0].get_ydata(), [20.0, 96.0])
    np.testing.assert_array_equal(line(drawn["circle"].axes[0], "ours, 1"), [[100, 50], [200, 60]])
    these, those = drawn["pendulum"].axes
    np.testing.assert_array_equal(line(these, "PPO, 1"), [[100, 2], [200, 3]])
    np.testing.assert_array_equal(line(those, "ours, 1"), [[100, 50], [200, 60]])


def test_flights_are_drawn_as_they_were_flown() -> None:
    drawn = six_figures()
    axes = drawn["hover_trial"].axes[0]
    for name, height in zip("xyz", (0.1, 0.2, 0.3), strict=True):
        np.testing.assert_allclose(line(axes, name)[[0, -1]], [[0, height], [8, height]])
    assert len(axes.lines) == 3 * 5
    axes = drawn["circle_from_above"].axes[0]
    np.testing.assert_allclose(np.linalg.norm(line(axes, "1 m reference"), axis=1), 1.0)
    paths = [path for path in axes.lines if len(np.asarray(path.get_xdata())) == 1201]
    np.testing.assert_allclose([path.get_xydata()[0] for path in paths], [[1 + 0.5 * k, 0] for k in range(5)])
    axes = drawn["circle_velocity"].axes[0]
    np.testing.assert_allclose(line(axes, "vy")[0], [0, 2])
    assert line(axes, "vx")[79, 1] == pytest.approx(-2 * np.sin(1.58))
    assert sorted(float(y[0]) for y in (x.get_ydata() for x in axes.lines) if len(y) == 2) == [-2.0, 2.0]


def test_the_trial_differs_from_the_first_starts_in_what_the_paper_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Position and velocity are the paper's, the rest that of the first starts of `make evaluate`."""
    small = HOVER._replace(flags={"policy_hidden_layer_sizes": (4,), "critic_hidden_layer_sizes": (4,)}, seeds=1)
    folder, config = folder_of(tmp_path / "run", small), small.config()

    def untrained(*_: object) -> Iterator[tuple[LearnerState, int]]:
        env = worlds.make("hover")
        inputs = stack([member_inputs(env, config.learner)])
        yield make_trainer(env, config.learner).init(seeds(0, 1), inputs).learner, 7

    monkeypatch.setattr(restore, "iter_learners", untrained)
    trial, nominal = (figure_flights.fly_policy(folder, trial=trial, starts=2) for trial in (True, False))
    for began in trial.observations[:, 0]:
        np.testing.assert_allclose(began[9:15], [-1.58, 0.99, 1.45, -2.39, 6.20, 0.77], rtol=1e-6)
    others = [*range(9), 15, 16, 17]
    np.testing.assert_allclose(
        trial.observations[:, 0, others], nominal.observations[:, 0, others], rtol=1e-5, atol=1e-6
    )
    env = worlds.make("hover").evaluation().env
    starts = jax.jit(jax.vmap(env.reset))(evaluation_starts(2)).obs  # those of `qrl evaluate`
    np.testing.assert_allclose(nominal.observations[:, 0], starts, rtol=1e-5, atol=1e-6)
    assert (trial.seed, trial.env_steps, trial.observations.shape) == (100, 7, (2, 801, 18))
    assert trial.measures["success"].shape == (2,)


# What is told


def test_a_caption_says_how_it_was_made_and_its_numbers_are_the_runs(tmp_path: Path) -> None:
    folder = with_metrics(
        tmp_path / "hover", HOVER, [[10.0, 30.5, 150.0], [20.0, 40.5, 160.0]], [[0.0, 0.99, 1.0], [0.0, 0.5, 1.0]]
    )
    caption = captions.hover(figures.curves(figures.Source(HOVER, folder)))
    page = captions.page(caption, Provenance("make figures FAST=1", "abc123", "; a note", [(HOVER, folder)]))
    # By hand: of 150 and 160 the mean, and the extremes of all resamples; 99 % first at the second report and third.
    assert "return 155.0 [150.0, 160.0], success 100 [100, 100] %" in page
    assert "2 of 2 seeds" in page
    assert "after 200 [200 … 300] (median, range) steps" in page
    assert "**Verdict: exceeded.**" in page
    assert "`make figures FAST=1` at commit abc123; a note" in page
    assert (
        "- `hover`: `qrl train hover --seed 100 --seeds 2 --preset hover_fast --num-timesteps 320000`, seeds 100–101"
        in page
    )
    for name, version in record.versions().items():
        assert f"{name} {version}" in page
    devices = [f"TFRT_CPU_{i}" for i in range(2)]
    files.write_json(folder / "config.json", HOVER.config().model_dump(mode="json") | {"devices": devices})
    page = captions.page(caption, Provenance("make figures", "abc123", "", [(HOVER, folder)]))
    assert "`JAX_NUM_CPU_DEVICES=2 qrl train hover --seed 100 --seeds 2" in page


def test_hover_is_held_against_ten_million_steps() -> None:
    def verdict(*first_at: float) -> str:
        steps = np.array([1e6, 1e7, 2e7])
        success = (steps >= np.array(first_at)[:, None]).astype(float)
        return captions.hover(Curves("", steps, np.zeros(success.shape), success)).verdict

    assert verdict(1e6, 1e6, 1e6) == EXCEEDED
    assert verdict(1e6, 1e7, 2e7) == CONFIRMED
    assert verdict(1e6, 2e7, np.inf) == NOT


def test_solved_is_held_to_the_end() -> None:
    found = captions.solved_at(curves([0.0] * 4, [0.0] * 4, success=([0.0, 1.0, 0.5, 1.0], [1.0, 1.0, 1.0, 0.9])))
    assert found.tolist() == [400.0, np.inf]


def test_the_circle_is_counted_in_episodes() -> None:
    """Of the paper's 200 steps, however long ours are."""
    caption = captions.circle(curves(*SEEDS, success=SUCCESS), episode_steps=50)
    assert any("episodes of 200 steps that is never [1 … never]" in found for found in caption.found)
    assert any("2 of 5 seeds" in found for found in caption.found)
    assert caption.verdict == NOT
    assert captions.circle(curves(*SEEDS[:2], success=SUCCESS[:2]), 50).verdict == EXCEEDED


def test_the_pendulum_is_held_against_ppo() -> None:
    """Over the rates at which one of the two learns."""
    high, low = curves([-1500.0, -140.0], [-1500.0, -150.0]), curves([-1500.0, -200.0], [-1500.0, -160.0])
    mixed = curves(*([-1500.0, end] for end in (-148.0, -149.0, -152.0, -153.0, -201.0, -250.0, -145.0, -146.0)))
    idle, as_idle = curves([-1500.0, -1490.0], [-1500.0, -1480.0]), curves([-1500.0, -1400.0], [-1500.0, -1410.0])
    lower = curves([-1500.0, -300.0], [-1500.0, -310.0])

    def verdict(*rates: tuple[Curves, Curves]) -> str:
        return captions.pendulum([Rate(f"{i}", *pair) for i, pair in enumerate(rates)]).verdict

    assert verdict((high, lower)) == EXCEEDED
    assert verdict((curves(*([-1500.0, end] for end in (*[-170.0] * 7, -141.0))), lower)) == EXCEEDED
    above = curves(*([-1500.0, end] for end in (*[-140.0] * 7, -170.0)))
    assert verdict((above, low)) == CONFIRMED  # its interval is, its worst seed is not
    assert verdict((mixed, low)) == NOT  # its mean is above, the intervals overlap
    assert verdict((high, lower), (low, high)) == NOT
    assert verdict((high, lower), (idle, as_idle)) == EXCEEDED
    found = captions.pendulum([Rate("x: 1", high, low), Rate("y: 2", idle, as_idle)]).found
    assert "| x: 1 | -145.0 [-150.0, -140.0] | -180.0 [-200.0, -160.0] | ours, every seed |" in found
    assert "Within these steps hardly anything is learned by either at: y: 2." in found


def test_flights_are_told_with_their_verdicts() -> None:
    still = np.zeros((100, 801, 18))
    first, rest = [True], [True] * 98 + [False]
    caption = captions.trial(flown("hover", still, first + rest))
    assert caption.verdict == EXCEEDED
    assert "settles after 1.25 s within 0.1 m; RMS distance in the last 2 s: 1.0 mm" in caption.found[0]
    assert "From 100 attitudes and body rates: success 99.0%" in caption.found[1]
    assert captions.trial(flown("hover", still[:2], [True, False])).verdict == CONFIRMED
    caption = captions.trial(flown("hover", still[:2], [False, True]))
    assert caption.verdict == NOT
    assert "never settles" in caption.found[0]
    caption = captions.from_above(flown("circle", circling(6), [True] * 5 + [False]), 5)
    assert caption.verdict == CONFIRMED
    assert "5 of the 5 succeed" in caption.found[0]
    assert "1.0 mm, 2.0 mm, 3.0 mm, 4.0 mm, 5.0 mm" in caption.found[0]
    assert captions.from_above(flown("circle", circling(6), [False] + [True] * 5), 5).verdict == NOT


def test_a_harmonic_motion_is_known_by_its_sinusoids() -> None:
    off = flown("circle", circling(1, vx=2.05, vy=1.8), [True])
    amplitudes, rest, frequency = captions.harmonic(off)
    np.testing.assert_allclose([*amplitudes, frequency], [2.05, 1.8, 2.0], rtol=2e-3)
    assert rest < 0.01
    assert captions.velocity(off).verdict == NOT
    assert captions.velocity(flown("circle", circling(1, 2.05, 1.95), [True])).verdict == CONFIRMED
    square = circling(1)
    square[..., 12:14] = 2.0 * np.sign(square[..., 12:14])
    assert captions.velocity(flown("circle", square, [True])).verdict == NOT
    nothing = np.full((1, 1201, 18), np.nan)
    assert captions.velocity(flown("circle", nothing, [False])).verdict == NOT


# The ablation


def test_the_ablations_table_is_the_sweeps(tmp_path: Path) -> None:
    (tmp_path / "results.csv").write_text(
        "point,objective,seed,diverged,return_mean,success\n"
        "0,ours,0,,-150.04,1.0\n0,ours,1,,-160,0.5\n0,ours,2,,-140,1\n"
        "1,PPO,0,,-900,0\n1,PPO,1,value at step 7,-1,1\n1,PPO,2,,-800,0.25\n"
    )
    page = ablation.page({"pendulum": ablation.rows(tmp_path), "hover": {}})
    assert "| ours | -150.0 [-160.0, -140.0] | 83 [50, 100] | – | – |" in page
    assert "| PPO | -inf [-inf, -800.0]; 1 of 3 diverged | 8 [0, 25] | – | – |" in page
    assert "hover: 640,000 steps, seeds 100–109, `qrl sweep experiments/grids/ablation_hover.json`" in page


@pytest.mark.parametrize("name", ablation.TASKS)
def test_both_grids_hold_the_rows_that_the_table_explains(name: str) -> None:
    file = json.loads(ablation.grid(name).read_text())
    assert file["axes"]["objective"].keys() == ablation.ROWS.keys()
    preset = load_preset(name) | file["fixed"]
    assert file["axes"]["objective"]["constant margin"]["xi"] == preset["epsilon"]
    ppo = preset | file["axes"]["objective"]["PPO"]
    assert ppo["updates_per_unroll"] * ppo["batch_size"] == 8 * ppo["num_envs"]  # eight passes, as the figure's
    same = figure_runs.PPO.keys() - {"updates_per_unroll", "batch_size"}
    assert {key: ppo[key] for key in same} == {key: figure_runs.PPO[key] for key in same}


def test_a_stale_sweep_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []
    monkeypatch.setattr(figure_runs, "qrl", lambda words, *_: called.append(words))
    grid, out = tmp_path / "grid.json", tmp_path / "out"
    grid.write_text("{}")
    for text, kept in (("{}", False), ("{}", True), ('{"seeds": 2}', False)):
        grid.write_text(text)
        (out / "chunks").mkdir(parents=True) if kept else None
        ablation.sweep(grid, out, fresh=False)
        assert (out / "chunks").exists() == kept
    assert called == [["sweep", str(grid), "--out", str(out)]] * 3


# Wrong input


@pytest.mark.parametrize(
    ("main", "words", "says"),
    [
        (figures.main, ["--only", "hoover"], "no figure 'hoover' (did you mean 'hover'?)"),
        (figures.main, ["--onyl", "hover"], "unrecognized arguments"),
        (figures.main, ["--out", __file__], "is a file"),
        (ablation.main, ["--only", "circle"], "invalid choice: 'circle'"),
        (ablation.main, ["--out", __file__], "is a file"),
    ],
)
def test_wrong_input_gets_one_line(main: Any, words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert says in said
    assert said.count("\n") == 1

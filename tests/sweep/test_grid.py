"""Grid files: which points they stand for, and one clear line for every way they can be wrong."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qrl import request, tasks
from qrl.config import Config, Hyperparameters, load_preset
from qrl.runs.record import ConfigFile
from qrl.sweep import grid, results
from qrl.sweep.axes import Axis
from qrl.sweep.runner import Result
from qrl_envs.specfile import BadInput

GRIDS = Path(__file__).resolve().parents[2] / "experiments" / "grids"


def load(folder: Path, data: Any, budget: float = 1e9) -> grid.Grid:
    path = folder / "grid.json"
    path.write_text(json.dumps(data))
    return grid.load(path, budget)


def spec(point: grid.GridPoint) -> dict[str, Any]:
    assert point.task.spec is not None
    return point.task.spec


def test_every_hyperparameter_is_declared_traced_or_static() -> None:
    """Once each; counts, shapes and choices can only be static, and what is traced is a number or numbers."""
    for name, field in Config.model_fields.items():
        assert len({"traced", "static"} & set(field.metadata)) == 1, name
    config = Config.model_validate(tasks.task_preset(tasks.task_record("hover"), ""), strict=False)
    traced = {name for name, field in Config.model_fields.items() if "traced" in field.metadata}
    assert traced == set(Hyperparameters._fields)
    assert {name for name, x in config.hyperparameters._asdict().items() if x is None} == {"xi", "apg_cotangent_norm"}
    assert not set(config.static) & traced


@pytest.mark.parametrize("path", sorted(GRIDS.glob("*.json")), ids=lambda path: path.stem)
def test_shipped_grids_are_valid(path: Path) -> None:
    """Each can start, is of the paper's method alone, and asks for the programs that its static axes make."""
    found = grid.load(path, 1e9)
    programs = {"pendulum_lr": 2, "epsilon_replay": 4, "circle_weights": 1, "ablation_pendulum": 7, "ablation_hover": 7}
    assert len(found.groups()) == programs[path.stem]
    for point in found.points:
        assert point.learner.num_timesteps <= 3e6
        assert not point.learner.num_apg_updates
        tasks.check(tasks.environment(point.task), point.learner, "")


def test_the_three_grids_of_the_paper_ship() -> None:
    assert {"pendulum_lr", "epsilon_replay", "circle_weights"} <= {path.stem for path in GRIDS.glob("*.json")}


def test_points_are_the_product_of_the_axes(tmp_path: Path) -> None:
    """Every combination once, in the axes' order, laid over `fixed`, over the task's preset."""
    axes = {"gamma": [0.9, 0.95], "task.rod.mass_kg": [1.0, 2.0], "num_envs": [8, 16]}
    found = load(tmp_path, {"task": "pendulum", "fixed": {"sigma": 0.7}, "axes": axes, "seeds": [3, 5]})
    seen = [(p.learner.gamma, spec(p)["rod"]["mass_kg"], p.learner.num_envs) for p in found.points]
    assert seen == list(itertools.product(*axes.values()))
    assert {(p.learner.sigma, p.learner.activation) for p in found.points} == {(0.7, "tanh")}
    assert found.seeds == (3, 5)
    assert [[found.points[i].learner.num_envs for i in group] for group in found.groups()] == [[8] * 4, [16] * 4]


@pytest.mark.parametrize("spacing", ["lin", "log"])
def test_ranges_are_evenly_spaced(tmp_path: Path, spacing: str) -> None:
    """As NumPy spaces them, both ends exact."""
    span = {"from": 1e-4, "to": 1e-2, "count": 5, "spacing": spacing}
    found = [p.learner.sigma for p in load(tmp_path, {"task": "hover", "axes": {"sigma": span}}).points]
    expected = np.geomspace(1e-4, 1e-2, 5) if spacing == "log" else np.linspace(1e-4, 1e-2, 5)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert (found[0], found[-1]) == (1e-4, 1e-2)


def test_samples_are_uniform_and_repeatable(tmp_path: Path) -> None:
    """Draws of a range spread evenly over it (log: over its logarithm); the same seed draws the same points."""
    data = {
        "task": "hover",
        "axes": {"sigma": {"from": 1e-4, "to": 1.0, "spacing": "log"}, "gamma": {"from": 0.5, "to": 1.0}},
        "sample": {"count": 400, "seed": 7},
    }
    found = load(tmp_path, data)
    logs = np.array([math.log(p.learner.sigma / 1e-4) / math.log(1e4) for p in found.points])
    gammas = np.array([(p.learner.gamma - 0.5) / 0.5 for p in found.points])
    for draws in (logs, gammas):  # Kolmogorov–Smirnov at 1 in 10,000
        assert np.max(np.abs(np.sort(draws) - np.arange(400) / 400)) < 2.2 / 20
    assert abs(np.corrcoef(logs, gammas)[0, 1]) < 0.2
    assert [p.coordinates for p in load(tmp_path, data).points] == [p.coordinates for p in found.points]
    data["sample"] = {"count": 400, "seed": 8}
    assert [p.coordinates for p in load(tmp_path, data).points] != [p.coordinates for p in found.points]


def test_a_path_reaches_into_the_vehicle(tmp_path: Path) -> None:
    """One motor by its number, all by *; what is not named stays, and the shipped task is not changed."""
    one = load(tmp_path, {"task": "hover", "axes": {"task.vehicle.motors.2.max_N": [5.0, 6.0]}})
    assert [[m["max_N"] for m in spec(p)["vehicle"]["motors"]] for p in one.points] == [
        [8.0, 8.0, 5.0, 8.0],
        [8.0, 8.0, 6.0, 8.0],
    ]
    every = load(tmp_path, {"task": "hover", "axes": {"task.vehicle.motors.*.max_N": [5.0, 6.0]}})
    assert [m["max_N"] for m in spec(every.points[0])["vehicle"]["motors"]] == [5.0] * 4
    assert len(one.groups()) == len(every.groups()) == 1


def test_named_settings_set_several_at_once(tmp_path: Path) -> None:
    named = {"ours": {}, "PPO": {"replay_unrolls": 1, "lam": 0.93}}
    preset = load_preset("pendulum")
    ours = ("ours", preset["replay_unrolls"], preset["lam"])
    found = load(tmp_path, {"task": "pendulum", "axes": {"method": named, "gamma": [0.9, 0.99]}})
    assert [(p.coordinates["method"], p.learner.replay_unrolls, p.learner.lam) for p in found.points] == [
        ours,
        ours,
        ("PPO", 1, 0.93),
        ("PPO", 1, 0.93),
    ]


@pytest.mark.parametrize(
    ("axis", "values", "programs"),
    [
        ("task.reward.w1_attitude", [0.1, 0.2], 1),
        ("task.vehicle.inertia_kg_m2", [[0.002, 0.002, 0.003], [0.0023, 0.0025, 0.0037]], 1),
        ("task.start.position_m", [0.5, 2.0], 1),
        ("task.bounds.distance_m", [5.0, 20.0], 1),
        ("observation_scale", [[0.5] * 18, [1.0] * 18], 1),
        ("observation_scale", [None, [1.0] * 18], 2),
        ("xi", [0.1, 0.2], 1),
        ("xi", [None, 0.2], 2),
        ("task.episode_s", [1.0, 2.0], 2),
        ("form", ["ratio", "difference"], 2),
        ("batch_size", [8, 16], 2),
    ],
)
def test_only_static_values_make_programs(tmp_path: Path, axis: str, values: list, programs: int) -> None:
    """Numbers travel; shapes, counts, choices and whether an optional one is there make groups."""
    assert len(load(tmp_path, {"task": "hover", "axes": {axis: values}}).groups()) == programs


def test_ranges_that_shape_a_flights_state_make_programs(tmp_path: Path) -> None:
    """Gusts or none, fixes of another reach, more set-points that are late; other ranges travel. A range that came
    later is no part of a record that says nothing of it, and can be set.
    """
    (tmp_path / "real.json").write_text('{"extend": "hover", "vehicle": "crazyflie"}')
    for name, values, programs in (
        ("mass_factor", [[1, 1], [1, 2]], 1),
        ("gust_m_s", [[0, 1], [1, 2]], 1),
        ("gust_m_s", [[0, 0], [1, 2]], 2),
        ("position_period_s", [[0.02, 0.02], [0.0, 0.04]], 2),
        ("latency_s", [[0, 0.005], [0, 0.008]], 1),
        ("latency_s", [[0, 0.005], [0, 0.02]], 2),
    ):
        axes = {f"task.uncertainty.{name}": values}
        found = load(tmp_path, {"task": str(tmp_path / "real.json"), "axes": axes})
        assert len(found.groups()) == programs, name
        assert [spec(p)["uncertainty"].get(name) or [0, 0] for p in found.points] == values


def test_a_task_that_is_judged_as_it_trains_cannot_change_that(tmp_path: Path) -> None:
    """Null starts and rewards of an evaluation are those of training; ours, which say theirs, may train otherwise."""
    evaluation = {"start": None, "reward": None}
    task = tmp_path / "task.json"
    task.write_text(json.dumps({"extend": "pendulum", "evaluation": evaluation}))
    for axis, what in (("task.reward.w_torque_1_N2m2", "reward"), ("task.start.angle_rad", "start")):
        axes = {axis: [0.1, 0.2]}
        assert len(load(tmp_path, {"task": "pendulum", "axes": axes}).points) == 2
        with pytest.raises(BadInput, match=f"evaluated alike, found another {what}"):
            load(tmp_path, {"task": str(task), "axes": axes})
    load(tmp_path, {"task": "pendulum", "axes": {"episode_length": [100, 200]}})


def test_whole_tasks_and_vehicles_are_axes(tmp_path: Path) -> None:
    """Each point is the run that `qrl train TASK --vehicle VEHICLE` is, and has a program of its own."""
    axes = {"task": ["hover", "circle"], "vehicle": ["crazyflie", "x500"], "gamma": [0.97, 0.98]}
    found = load(tmp_path, {"axes": axes, "fixed": {"uncertainty": "none"}})
    assert [list(point.coordinates.values()) for point in found.points] == [
        list(v) for v in itertools.product(*axes.values())
    ]
    assert [len(group) for group in found.groups()] == [2] * 4
    for point in found.points:
        at = point.coordinates
        parts = {"vehicle": at["vehicle"], "uncertainty": "none"}
        run = request.run_config(at["task"], None, ConfigFile(), {"gamma": at["gamma"]}, None, None, parts)
        assert (point.task, point.learner) == (run.task, run.learner)


def test_named_settings_may_hold_a_task(tmp_path: Path) -> None:
    """And values of what another has not."""
    cases = {"rod": {"task": "pendulum", "task.rod.mass_kg": 2.0}, "x500": {"task": "hover", "vehicle": "x500"}}
    rod, x500 = load(tmp_path, {"axes": {"case": cases}}).points
    assert spec(rod)["rod"]["mass_kg"] == 2.0
    assert x500.task == tasks.task_record("hover", {"vehicle": "x500"})


def test_points_of_one_task_alone_are_compared(tmp_path: Path) -> None:
    """Of each of two tasks there is a best, and a file that repeats it."""
    axes = {"task": ["hover", "circle"], "gamma": [0.8, 0.9]}
    found = load(tmp_path, {"axes": axes, "seeds": 1})
    ends = {
        i: Result([{"env_steps": 1, "updates": 1, "return_mean": x, "return_min": x, "success": 0.5}], "")
        for i, x in enumerate((-1.0, -2.0, -400.0, -300.0))
    }
    results.write(tmp_path, found, ends, results.summaries(found, ends), 1.0)
    assert json.loads((tmp_path / "summary.json").read_text())["best"] == {"hover": 0, "circle": 3}
    for point, name in ((0, "hover"), (3, "circle")):
        best = json.loads((tmp_path / f"best-{point}.json").read_text())
        assert (best["task"]["name"], best["learner"]["gamma"]) == (name, found.points[point].learner.gamma)


GAMMA = {"gamma": [0.9, 0.99]}
WRONG: dict[str, tuple[dict, str]] = {
    "unknown vehicle": (
        {"task": "hover", "axes": {"vehicle": ["x500", "x50"]}},
        r"at vehicle x50: .*'x50' \(did you mean 'x500'\?\)",
    ),
    "a vehicle for a rod": ({"axes": {"vehicle": ["x500"]}}, r"at vehicle x500: "),
    "a task twice": ({"axes": {"task": ["hover"]}}, r"key 'axes.task': 'task' is set in 'task' too"),
    "the same task twice": (
        {"task": "", "axes": {"task": ["hover", "hover"]}},
        r"each point once, found task hover and task hover",
    ),
    "a number for a vehicle": (
        {"task": "hover", "axes": {"vehicle": [5]}},
        r"at vehicle 5: expected a name or a file, found 5",
    ),
    "a range of vehicles": (
        {"axes": {"vehicle": {"from": 1, "to": 2, "count": 2}}},
        r"key 'axes.vehicle': expected a list of names or files",
    ),
    "no task anywhere": ({"task": "", "axes": GAMMA}, r"key 'task' is missing"),
    "a path that a task lacks": (
        {"task": "", "axes": {"task": ["hover", "pendulum"], "task.rod.mass_kg": [1.0]}},
        r"at task hover, task.rod.mass_kg 1.0: key 'task.rod.mass_kg': task 'hover' has none",
    ),
    "vehicles judged otherwise": (
        {"task": "hover", "axes": {"v": {"a": {}, "b": {"vehicle": "x500", "num_eval_envs": 7}}}},
        r"evaluated alike, found another number of flights",
    ),
    "a search and a sample": (
        {"axes": {"gamma": [0.5, 0.9]}, "sample": {"count": 1}, "search": {"trials": 1}},
        r"expected 'sample' or 'search', found both",
    ),
    "a search with count": (
        {"axes": {"gamma": {"from": 0.5, "to": 0.9, "count": 3}}, "search": {"trials": 2}},
        r"expected no count where points are sampled",
    ),
    "more trials than points": (
        {"axes": {"gamma": [0.5, 0.9]}, "search": {"trials": 3}},
        r"key 'search.trials': expected no more trials than the axes hold points, found 3; they hold 2",
    ),
    "a search over tasks": (
        {"task": "", "axes": {"task": ["hover", "circle"]}, "search": {"trials": 2}},
        r"expected one task for a search",
    ),
    "a search over fractions of a count": (
        {"axes": {"num_envs": {"from": 8, "to": 16}}, "search": {"trials": 2}},
        r"at num_envs 11.056: key 'num_envs'",
    ),
    "a measure that is none": (
        {"axes": GAMMA, "search": {"trials": 1, "maximize": "speed"}},
        r"key 'search.maximize'",
    ),
    "misspelt axis": ({"axes": {"gama": [0.9]}}, r"axes.gama: unknown key 'gama' \(did you mean 'gamma'\?\)"),
    "misspelt path": (
        {"axes": {"task.rod.mas_kg": [1.0]}},
        r"unknown key 'task.rod.mas_kg' \(did you mean 'task.rod.mass_kg'\?\)",
    ),
    "misspelt in fixed": ({"axes": GAMMA, "fixed": {"sigm": 1.0}}, r"fixed: unknown key 'sigm' .*'sigma'"),
    "misspelt key": ({"axis": {}, "axes": GAMMA}, r"unknown key 'axis' \(did you mean 'axes'\?\)"),
    "misspelt in a range": (
        {"axes": {"gamma": {"from": 0.1, "too": 0.2, "count": 2}}},
        r"axes.gamma: unknown key 'too' \(did you mean 'to'\?\)",
    ),
    "misspelt in named settings": ({"axes": {"m": {"a": {"gama": 1}}}}, r"unknown key 'gama'.*'gamma'"),
    "no task": ({"task": None, "axes": GAMMA}, r"key 'task': expected a valid string, found null"),
    "unknown task": ({"task": "pendulm", "axes": GAMMA}, r"unknown task 'pendulm' \(did you mean 'pendulum'"),
    "no axes": ({}, r"key 'axes' is missing"),
    "axes empty": ({"axes": {}}, r"key 'axes'"),
    "empty axis": ({"axes": {"gamma": []}}, r"key 'axes.gamma': expected at least one value, found none"),
    "empty named settings": ({"axes": {"m": {}}}, r"key 'axes.m': expected at least one value"),
    "wrong type of axis": ({"axes": {"gamma": 0.9}}, r"key 'axes.gamma': expected a list of values, .* found 0.9"),
    "a number for a list of layers": (
        {"axes": {"policy_hidden_layer_sizes": [64, [64, 64]]}},
        r"at policy_hidden_layer_sizes 64: key 'policy_hidden_layer_sizes': expected a list .* such as \[64\]",
    ),
    "wrong type of value": ({"axes": {"gamma": ["much"]}}, r"at gamma much: key 'gamma': expected a valid number"),
    "wrong sense": ({"axes": {"sigma": [0.5, -1.0]}}, r"at sigma -1.0: key 'sigma': expected greater than 0"),
    "not a number": ({"axes": {"sigma": [float("nan")]}}, r"key 'sigma': expected a finite number"),
    "a fraction of a count": ({"axes": {"num_envs": [8, 8.5]}}, r"at num_envs 8.5: key 'num_envs'"),
    "wrong sense in the task": ({"axes": {"task.rod.mass_kg": [-1.0]}}, r"key 'rod.mass_kg': expected greater than 0"),
    "how it is judged": ({"axes": {"task.evaluation.tail_s": [1.0]}}, r"all points of a grid have the same evaluation"),
    "duplicate values": ({"axes": {"gamma": [0.9, 0.9]}}, r"expected each point once, found gamma 0.9 and gamma 0.9"),
    "duplicate by another way": (
        {"axes": {"num_envs": [16, 16.0]}},
        r"each point once, found num_envs 16.0 and num_envs 16",
    ),
    "called like a column": (
        {"axes": {"seeds": {"a": {"gamma": 0.9}}}},
        r"key 'axes.seeds': expected another name than that of a setting or a column of results.csv",
    ),
    "called like a measure": (
        {"axes": {"rms_angle_rad": {"a": {"gamma": 0.9}}}},
        r"'axes.rms_angle_rad': expected another name",
    ),
    "an axis without a name": ({"axes": {"": {"a": {"gamma": 0.9}}}}, r"expected a name for the axis, found \"\""),
    "settings without a name": ({"axes": {"m": {"": {"gamma": 0.9}}}}, r"'axes.m': expected a name for each of its"),
    "too large for single precision": (
        {"axes": {"sigma": [0.5, 1e300]}},
        r"at sigma 1e\+300: key 'sigma': expected a magnitude that single precision holds",
    ),
    "too small for single precision": ({"axes": {"xi": [1e-60]}}, r"at xi 1e-60: key 'xi': .* single precision holds"),
    "the same in single precision": (
        {"axes": {"gamma": [0.9, 0.900000001]}},
        r"each point once, found gamma 0.900000001 and gamma 0.9, the same in single precision",
    ),
    "another period": (
        {"axes": {"task.control_period_s": [0.05, 0.02]}},
        r"evaluated alike, found another control period of its flights at task.control_period_s 0.05 and at",
    ),
    "returns of other lengths": (
        {"axes": {"task.episode_s": [2.0, 1.0]}},
        r"evaluated alike, found another duration of its return at task.episode_s 2.0 and at",
    ),
    "flights of other lengths": (
        {"task": "inverted_pendulum", "axes": {"episode_length": [200, 100]}},
        r"evaluated alike, found another length of a flight \(episode_length\) at episode_length 200 and at",
    ),
    "other starts": (
        {"axes": {"num_eval_envs": [10, 20]}},
        r"evaluated alike, found another number of flights",
    ),
    "fixed and axis": ({"axes": GAMMA, "fixed": {"gamma": 0.9}}, r"'axes.gamma': 'gamma' is set in 'fixed' too"),
    "two axes": ({"axes": {**GAMMA, "m": {"a": {"gamma": 0.5}}}}, r"'gamma' is set in 'axes.gamma' too"),
    "range upside down": (
        {"axes": {"gamma": {"from": 0.9, "to": 0.5, "count": 3}}},
        r"axes.gamma: expected from < to, found 0.9 and 0.5",
    ),
    "log of zero": (
        {"axes": {"gamma": {"from": 0, "to": 0.5, "count": 3, "spacing": "log"}}},
        r"expected from > 0 with log spacing",
    ),
    "a range without count": ({"axes": {"gamma": {"from": 0.5, "to": 0.9}}}, r"expected a count, or else 'sample'"),
    "a sample with count": (
        {"axes": {"gamma": {"from": 0.5, "to": 0.9, "count": 3}}, "sample": {"count": 2}},
        r"expected no count where points are sampled",
    ),
    "more samples than points": (
        {"axes": {"gamma": [0.5, 0.9]}, "sample": {"count": 3}},
        r"key 'sample.count': .* found 3; 2 different",
    ),
    "seeds twice": ({"axes": GAMMA, "seeds": [1, 1]}, r"key 'seeds': expected each seed once"),
    "no seeds": ({"axes": GAMMA, "seeds": 0}, r"key 'seeds'"),
    "seeds of a wrong type": ({"axes": GAMMA, "seeds": "four"}, r"key 'seeds': expected .* found \"four\""),
    "too large": (
        {"axes": {name: {"from": 0.1, "to": 0.9, "count": 1000} for name in ("gamma", "lam", "sigma")}},
        r"fits into 1 GB of memory, found 1,000,000,000 points × 1 seeds, which need 95,000.0 GB",
    ),
    "a range too long to be listed": (
        {"axes": {"gamma": {"from": 0.1, "to": 0.9, "count": 2_000_000_000}}},
        r"found 2,000,000,000 points × 1 seeds, which need 190,000.0 GB",
    ),
    "too many seeds": ({"axes": GAMMA, "seeds": 1_000_000}, r"found 2 points × 1,000,000 seeds, which need 150.0 GB"),
}


@pytest.mark.parametrize(("data", "words"), WRONG.values(), ids=WRONG.keys())
def test_wrong_grids_are_refused_in_a_line(tmp_path: Path, data: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words) as refused:
        load(tmp_path, {"task": "pendulum", **data})
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "grid.json"))


def test_a_sample_that_its_axes_cannot_fill_is_refused_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once nothing new has come for long, however many were asked for."""
    drawn, draw = [], Axis.draw
    monkeypatch.setattr(Axis, "draw", lambda self, rng: drawn.append(1) or draw(self, rng))
    with pytest.raises(BadInput, match=r"found 9,000; 2 different ones were drawn"):
        load(tmp_path, {"task": "pendulum", "axes": {"gamma": [0.5, 0.9]}, "sample": {"count": 9000}})
    assert len(drawn) < 2000

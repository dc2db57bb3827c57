"""The benchmark's own instruments: its judge, its clock, its arithmetic, and what it does without a baseline."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs

import brax_ppo
import judge
import qrl_command
import qrl_cores
from experiments.bench import run as bench
from experiments.bench.contestants import CONTESTANTS, Contestant, chosen
from experiments.bench.install import fingerprint, python_of
from experiments.bench.plot import bars, plot
from experiments.bench.tables import Spread, cell, derived, first_at, page, ratios, speed, spread, to_solve
from qrl_envs import env as worlds


def run(contestant: str, seed: int, *lines: dict, group: str = "pendulum", outcome: str = "done") -> dict:
    return {
        "contestant": contestant,
        "group": group,
        "seed": seed,
        "outcome": outcome,
        "error": "",
        "lines": list(lines),
    }


def check(steps: int, value: float, seconds: float) -> dict:
    clocks = {"train_seconds": seconds, "compile_seconds": 1.0, "total_seconds": seconds + 3.0}
    return {"steps": steps, "return_mean": value, **clocks}


def test_the_judges_pendulum_is_ours() -> None:
    """Over whole episodes, under a policy that swings through both limits."""
    theta, rate = (x[::16] for x in judge.pendulum_starts())

    def act(observation: np.ndarray) -> np.ndarray:
        return np.sign(observation[:, 2:] * observation[:, :1] + 0.1) * (1.2 - observation[:, 1:2])

    env = worlds.make("pendulum")
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), len(theta)))
    lane = start.pipeline_state
    x = lane.x._replace(pose=jnp.asarray(theta, jnp.float32), twist=jnp.asarray(rate, jnp.float32))
    observed = jnp.stack([jnp.cos(x.pose), jnp.sin(x.pose), x.twist], axis=1)
    state = start.replace(pipeline_state=lane._replace(x=x), obs=observed)
    step, total = jax.jit(jax.vmap(env.step)), np.zeros(len(theta))
    alone = theta, rate
    for _ in range(30):  # in single precision these flights part later on
        action = act(np.asarray(state.obs, np.float64))
        state = step(state, jnp.asarray(action, jnp.float32))
        *alone, reward = judge.pendulum_step(*alone, action[:, 0])
        np.testing.assert_allclose(state.reward, reward, atol=2e-3)
        total += reward
    np.testing.assert_allclose(state.obs[:, 2], alone[1], atol=2e-3)
    assert np.abs(alone[1]).max() > 4.0


def test_the_judges_starts_stand_for_the_tasks() -> None:
    """Within its ranges, evenly: a fair policy's mean return is what it is over twenty times as many."""
    theta, rate = judge.pendulum_starts()
    assert len(theta) == len(rate) == 1000
    start: Any = worlds.make("pendulum").task.start
    assert 0.97 < np.abs(theta).max() / start.angle_rad < 1.0
    assert 0.95 < np.abs(rate).max() / start.rate_rad_s < 1.0

    def swing_up(o: np.ndarray) -> np.ndarray:
        angle, energy = np.arctan2(o[:, 1], o[:, 0]), o[:, 2] ** 2 / 6.0 + 5.0 * (o[:, 0] - 1.0)
        pump = np.where(o[:, 2] < 0, -1.0, 1.0) * np.clip(-2.0 * energy, -1.0, 1.0)
        return np.where(np.abs(angle) < 0.6, np.clip(-6.0 * angle - 1.5 * o[:, 2], -1.0, 1.0), pump)[:, None]

    u = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 20_000))
    assert abs(judge.pendulum_return(swing_up) - judge.pendulum_return(swing_up, np.pi * u[0], u[1])) < 1.5


def test_a_policy_that_is_not_finite_is_never_solved() -> None:
    assert math.isnan(judge.pendulum_return(lambda o: np.full((len(o), 1), np.nan)))
    assert first_at(run("baseline", 0, check(1, math.nan, 1.0)), "return_mean", -150.0) is None


def test_overlapping_spans_count_once() -> None:
    assert judge.covered([(0.0, 4.0), (1.0, 2.0), (3.0, 5.0), (7.0, 8.0)]) == 6.0
    assert judge.covered([]) == 0.0


def test_the_clock_leaves_out_checks_and_compilation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr(judge.time, "time", lambda: now[0])
    monkeypatch.setenv("BENCH_SPAWNED", "90")

    def measure(_: object) -> dict[str, float]:
        now[0] += 50.0
        return {"return_mean": -200.0 if now[0] < 200 else -140.0}

    clock = judge.Judge(measure, lambda found: found["return_mean"] >= -150.0)
    with clock.compiling():
        now[0] += 2.0
    clock.start()
    now[0] += 5.0
    with clock.compiling():
        now[0] += 3.0
    assert not clock.check(10, None)
    now[0] += 4.0
    assert clock.check(20, None)
    lines = [json.loads(line.removeprefix(bench.MARK)) for line in capsys.readouterr().out.splitlines()]
    assert [line["train_seconds"] for line in lines] == [5.0, 9.0]
    assert [line["compile_seconds"] for line in lines] == [5.0, 5.0]
    assert [line["total_seconds"] for line in lines] == [20.0, 24.0]


def test_brax_is_told_of_truncations() -> None:
    """Out of bounds, and not otherwise; and its lane starts anew all the same."""
    env = brax_ppo.wrap(envs.get_environment("hover"), episode_length=2)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    lane = state.pipeline_state
    pose = lane.x.pose
    far = lane.x._replace(pose=pose._replace(position_m=pose.position_m.at[1].set(1e3)))
    step = jax.jit(env.step)
    state = step(state.replace(pipeline_state=lane._replace(x=far)), jnp.zeros((3, 4)))
    np.testing.assert_array_equal(state.done, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(state.info["truncation"], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(state.obs[1], state.info["first_obs"][1])
    state = step(state, jnp.zeros((3, 4)))  # the time limit of the others
    np.testing.assert_array_equal(state.info["truncation"], [1.0, 0.0, 1.0])


def test_solved_is_the_first_check_that_reaches_the_bar() -> None:
    checks = check(10, -200.0, 1.0), check(20, -149.0, 2.0), check(30, -300.0, 3.0), check(40, -140.0, 4.0)
    assert to_solve(run("baseline", 0, *checks), "steps") == 20
    assert to_solve(run("baseline", 0, *checks), "train_seconds", -145.0) == 4.0
    assert to_solve(run("baseline", 0, *checks), "steps", -100.0) == math.inf
    assert to_solve(run("baseline", 0), "steps") == math.inf
    assert to_solve(run("baseline", 0, {"steps": 10, "return_mean": None}), "steps") == math.inf


def test_spreads_and_ratios() -> None:
    assert spread([3.0, 1.0, math.inf]) == Spread(3.0, 1.0, math.inf)
    assert ratios({0: 10.0, 1: 8.0, 2: math.inf}, {0: 2.0, 1: 4.0, 2: 1.0}) == Spread(5.0, 2.0, math.inf)
    assert ratios({0: 10.0}, {0: math.inf}) is None
    assert ratios({0: 10.0}, {1: 1.0}) is None
    assert cell(Spread(5.0, 2.0, math.inf), "×") == "5× [2 … –]"
    assert cell(Spread(math.inf, math.inf, math.inf)) == "not"


RUNS = [
    *(run("qrl", seed, check(1000, -145.0, 2.0 + seed)) for seed in range(3)),
    *(run("Brax PPO", seed, check(1000, -200.0, 1.0), check(90_000, -149.0, 6.0 + seed)) for seed in range(3)),
    *(run("rejax PPO", seed, check(1000, -900.0, 30.0)) for seed in range(3)),
    run("qrl", 0, {"figure": "physics, 256 lanes", "per_second": 2e6}, group="speed"),
    run("crazyflow", 0, {"figure": "physics, 256 lanes", "per_second": 1e6}, group="speed"),
    run("qrl train hover", 0, {"steps": 100, "success": 1.0}, group="commands"),
    run("sbx SAC", 0, group="pendulum", outcome="exit code 1"),
]


def test_the_page_tells_all(tmp_path: Path) -> None:
    text = page(RUNS, {"rltools": "no compiler"}, {"CPU": "abacus"})
    row = next(line for line in text.splitlines() if line.startswith("| Brax PPO"))
    assert "3 of 3" in row
    assert "2.33× [2 … 3]" in row  # 6/2, 7/3, 8/4
    assert "| rejax PPO | 0 of 3 | not |" in text
    assert "crazyflow | 1M [1M … 1M] | 2× [2 … 2]" in text
    assert "rltools: not installed: no compiler" in text
    assert "sbx SAC, seed 0: exit code 1" in text
    assert "abacus" in text
    plot(tmp_path / "bench.png", RUNS)
    assert (tmp_path / "bench.png").stat().st_size > 10_000


def test_rates_are_held_against_each_other() -> None:
    def rates(name: str, seed: int, **found: float) -> dict:
        lines = [{"figure": figure.replace("_", ", "), "per_second": value} for figure, value in found.items()]
        return run(name, seed, *lines, group="speed")

    acting = {"acting_256": 4.0, "acting_1024": 5.0, "acting_4096": 4.5, "real plant_acting_256": 2.0}
    one = [rates("qrl", s, training=10.0 + s, **acting) for s in range(3)]
    told = [rates("qrl, one core", s, training=5.0) for s in range(2)]
    apart = [rates("qrl, a process a core", s, training=9.5) for s in range(2)]
    baseline = [rates("Brax", 0, training=2.0), rates("Brax, two devices", 0, training=4.0)]
    text = derived([*one, *told, *apart, *baseline])
    assert "| training, its default over one core | qrl | 2.1× [2 … 2.2] |" in text
    assert "| training, a process a core, over one core | qrl | 1.9× [1.9 … 1.9] |" in text
    assert "| training, two devices, over its default | Brax | 2× [2 … 2] |" in text
    assert "| training, two devices | Brax | 4 [4 … 4] | 2.5× [2.5 … 2.5] |" in speed([*one, *told, *baseline])
    assert "| real plant, acting, 256, over the ideal plant | qrl | 0.5× [0.5 … 0.5] |" in text
    assert "highest cost over its lowest, of 3 numbers of lanes | qrl | 1.25× [1.25 … 1.25] |" in text
    assert derived([]) == ""


def test_rates_of_processes_are_added_up() -> None:
    output = 'compiling\nBENCH {"figure": "training", "per_second": 2.5, "elapsed": 1}\n'
    found = qrl_cores.rates(output)
    assert qrl_cores.summed([found, {"training": 4.0}]) == {"training": 6.5}


def test_a_command_tells_the_worst_of_its_checkpoints() -> None:
    checkpoints = [{"rms_position_m": 0.001}, {"rms_position_m": 0.004}, {"rms_position_m": 0.002}]
    nominal = {"success": 1.0, "rms_position_m": 0.001, "return_min": 3.0}
    off = {"latency": {"success": 0.99}, "noise": {"success": 0.98}}
    assert qrl_command.summary({**nominal, "checkpoints": checkpoints, "off_nominal": off}) == {
        "success": 1.0,
        "rms_position_m": 0.001,
        "worst_of_3_rms_position_m": 0.004,
        "off_nominal_success_latency": 0.99,
        "off_nominal_success_noise": 0.98,
    }
    assert (
        qrl_command.summary({**nominal, "checkpoints": [{"rms_position_m": None}]})["worst_of_1_rms_position_m"] is None
    )


def test_a_baseline_that_never_solves_gets_a_bound_in_the_picture() -> None:
    bar = next(bar for bar in bars(RUNS) if bar.label == "pendulum: rejax PPO" and bar.kind == "training")
    assert bar.bound
    assert bar.ratio.median == 10.0  # 30 s against 3


def test_a_baseline_that_cannot_be_installed_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = subprocess.CompletedProcess([], 1, stdout="", stderr="collecting\nERROR: no ghost-1.0\n")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    (tmp_path / "ghost.txt").write_text("ghost==1.0\n")
    baseline = Contestant("ghost", "pendulum", "ghost.py", (), "ghost")
    pythons, absent = bench.installed([baseline], tmp_path, tmp_path / "environments")
    assert pythons == {None: Path(sys.executable)}
    assert absent == {"ghost": "ERROR: no ghost-1.0"}
    assert "skipped" in capsys.readouterr().out
    assert not (tmp_path / "environments" / "ghost" / "installed").exists()


def test_an_environment_is_reused_until_its_pins_change(tmp_path: Path) -> None:
    pins, folder = tmp_path / "baseline.txt", tmp_path / "environment"
    (tmp_path / "lock.txt").write_text("# none\n")
    pins.write_text("-c lock.txt\n")
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").touch()
    (folder / "installed").write_text(fingerprint(pins))
    assert python_of(pins, folder) == folder / "bin" / "python"
    (tmp_path / "lock.txt").write_text("# another\n")
    assert (folder / "installed").read_text() != fingerprint(pins)


def test_a_run_leaves_its_lines_and_ends_on_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "BASELINES", tmp_path)
    monkeypatch.setattr(bench, "GRACE_SECONDS", 0.0)
    (tmp_path / "other.py").write_text("import time\nprint('BENCH {\"steps\": 1}', flush=True)\ntime.sleep(60)\n")
    (tmp_path / "broken.py").write_text("print('BENCH {\"steps\": 2}')\nraise ValueError('a reason')\n")
    found = bench.run_contestant(Contestant("baseline", "pendulum", "other.py"), Path(sys.executable), 3, 2.0, tmp_path)
    assert (found["outcome"], found["lines"], found["seed"]) == ("out of time", [{"steps": 1}], 3)
    found = bench.run_contestant(Contestant("broken", "pendulum", "broken.py"), Path(sys.executable), 0, 60.0, tmp_path)
    assert (found["outcome"], found["lines"]) == ("exit code 1", [{"steps": 2}])
    assert found["error"] == "ValueError: a reason"


def test_a_run_is_made_once(tmp_path: Path) -> None:
    """And again if it failed, was asked for otherwise, or elsewhere."""
    baseline, path = Contestant("qrl", "pendulum", "qrl_train.py", ("--steps", "1")), tmp_path / "run.json"
    assert not bench.is_current(path, baseline, 60.0)
    here = bench.run_fingerprint(baseline)
    assert "commit" not in here
    asked = {"command": ["qrl_train.py", "--steps", "1"], "budget_seconds": 60.0}
    kept = asked | {"fingerprint": here, "outcome": "done"}
    path.write_text(json.dumps(kept))
    assert bench.is_current(path, baseline, 60.0)
    assert not bench.is_current(path, baseline, 90.0)
    assert not bench.is_current(path, baseline._replace(words=("--steps", "2")), 60.0)
    assert not bench.is_current(path, baseline._replace(devices=2), 60.0)
    for other in ({"CPU": "abacus"}, {"jax": "0.1"}, {"requirements": "others"}, {"code": "other"}):
        path.write_text(json.dumps(kept | {"fingerprint": here | other}))
        assert not bench.is_current(path, baseline, 60.0)
    path.write_text(json.dumps(asked | {"outcome": "done"}))
    assert not bench.is_current(path, baseline, 60.0)
    path.write_text(json.dumps(kept | {"outcome": "exit code 1"}))
    assert not bench.is_current(path, baseline, 60.0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--only", "pendulm"], "unknown contestant 'pendulm'"),
        (["--seeds", "0"], "--seeds of at least 1"),
        (["--budget-seconds", "nan"], "--budget-seconds above 0"),
        (["--onyl", "x"], "unrecognized arguments"),
        (["--out", __file__], "is a file"),
    ],
)
def test_wrong_input_gets_one_line(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        bench.main(words)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert says in said
    assert said.count("\n") == 1


def test_every_contestant_is_there() -> None:
    assert len({(c.group, c.name) for c in CONTESTANTS}) == len(CONTESTANTS)
    for contestant in CONTESTANTS:
        assert (bench.BASELINES / contestant.script).is_file()
        assert contestant.environment is None or (bench.BASELINES / f"{contestant.environment}.txt").is_file()
    named = [c.name for c in chosen(["pendulum/brax-ppo", "circle"])]
    assert named == ["Brax PPO", "qrl", "qrl without APG", "Brax PPO"]

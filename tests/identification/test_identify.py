"""`qrl identify` against flights that NumPy alone simulated (`flown_logs`): what flew is inside the intervals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import flown_logs
from cli_helpers import complaint, qrl
from flown_logs import Truth
from qrl.identification import fit as fitting
from qrl.identification import flight_log, model, report
from qrl_envs import specfile
from qrl_envs.vehicle import Vehicle, vehicle_data, with_default_scale

START = vehicle_data("crazyflie")
FACTORS = (1.12, 0.93, 1.05, 0.9)
CHANGES: dict[str, Any] = {
    "thrust_factors": FACTORS,
    "thrust_curve": 0.25,
    "rotor_rise_s": 0.05,
    "rotor_fall_s": 0.09,
    "drag_N_s_m": [0.012, 0.015, 0.009],
    "drag_height_m": 0.012,
    "inertia_kg_m2": [1.3 * x for x in START["inertia_kg_m2"]],
    "yaw_moment_m": 0.028,
}
FLIGHTS, SECONDS = 5, 6.0
NOISE = np.repeat([5e-4, 5e-3, 1e-2], 3)  # of position, velocity, body rates; attitude: 1 mrad


def measured(states: np.ndarray, seed: int) -> np.ndarray:
    """States [..., 13] with sensor noise."""
    rng = np.random.default_rng(seed)
    noisy = states.copy()
    noisy[..., [0, 1, 2, 7, 8, 9, 10, 11, 12]] += NOISE * rng.standard_normal((*states.shape[:-1], 9))
    noisy[..., 4:7] += 5e-4 * rng.standard_normal((*states.shape[:-1], 3))
    noisy[..., 3:7] /= np.linalg.norm(noisy[..., 3:7], axis=-1, keepdims=True)
    return noisy


def truth_of(rows: list[dict[str, Any]] | list[report.Row], changes: dict[str, Any]) -> dict[str, float]:
    """What flew, by the name of its row."""
    found = {f"motors[{i + 1}].max_N": f * START["motors"][i]["max_N"] for i, f in enumerate(FACTORS)}
    found |= {f"drag_N_s_m {axis}": changes["drag_N_s_m"][i] for i, axis in enumerate("xyz")}
    found |= {f"inertia_kg_m2 {axis}": changes["inertia_kg_m2"][i] for i, axis in enumerate(("xx", "yy", "zz"))}
    return found | {"latency [s]": 0.0, **{k: x for k, x in changes.items() if isinstance(x, float)}}


@pytest.fixture(scope="module")
def flown() -> tuple[np.ndarray, np.ndarray]:
    """States [F, K + 1, 13] and commands [F, K, 4] of the vehicle that is to be found."""
    return flown_logs.fly(Truth(START, **CHANGES), SECONDS, FLIGHTS, seed=1)


@pytest.fixture(scope="module")
def logs(flown: tuple[np.ndarray, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    states = measured(flown[0], 7)
    return [flown_logs.write(folder / f"f{i}.csv", states[i], flown[1][i]) for i in range(FLIGHTS)]


def test_the_vehicle_is_found_and_predicts_flights_it_has_not_seen(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine.json"
    assert qrl("identify", *logs, "--vehicle", "crazyflie", "--out", out) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "mine_report.json").read_text())
    rows = {row["name"]: row for row in found["parameters"]}
    truth = truth_of(found["parameters"], CHANGES)
    assert truth.keys() == rows.keys()
    fitted = {name: row for name, row in rows.items() if not row["kept"]}
    assert fitted.keys() >= {
        "thrust_curve",
        "rotor_rise_s",
        "rotor_fall_s",
        "drag_N_s_m x",
        "inertia_kg_m2 xx",
        "motors[1].max_N",
    }
    inside = [row["low"] <= truth[name] <= row["high"] for name, row in fitted.items()]
    assert np.mean(inside) >= 0.75, fitted
    for name, row in fitted.items():
        assert abs(row["value"] - truth[name]) < 1.2 * (row["high"] - row["low"]), name
        assert row["high"] - row["low"] < 0.6 * abs(truth[name]) or name in (
            "latency [s]",
            "thrust_curve",
            "drag_height_m",
        ), row
    held = found["held_out"]
    assert held["ratio"] < 0.2
    assert held["fitted_mm"] < held["constant_velocity_mm"] / 3
    assert f"ratio {held['ratio']:.3f}" in said
    assert "f2.csv" in held["of"]  # a whole flight
    vehicle = specfile.build(Vehicle, with_default_scale(json.loads(out.read_text())), "mine")
    assert vehicle.rotor_rise_s == pytest.approx(rows["rotor_rise_s"]["value"], rel=1e-5)
    assert vehicle.mass_kg == START["mass_kg"]
    assert (tmp_path / "mine.png").read_bytes()[:4] == b"\x89PNG"


def test_intervals_cover(flown: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    """Over sensor noise drawn anew, the intervals hold what flew nearly as often as they say."""
    vehicle = specfile.build(Vehicle, with_default_scale(START), "crazyflie")
    program, inside = None, []
    for seed in range(3):
        states = measured(flown[0][:3], seed)
        paths = [flown_logs.write(tmp_path / f"{i}.csv", states[i], flown[1][i]) for i in range(3)]
        read = flight_log.read(paths, np.array([motor.max_N for motor in vehicle.motors]))
        free = model.model(vehicle, False, read[0].period_s)
        segments = flight_log.segments(read, 0.3, [(0.0, 1.0)] * 3, [np.ones(len(log.time_s)) for log in read])
        program = program or fitting.compiled(free)
        rows = report.rows(free, fitting.fit(free, segments, program=program))
        truth = truth_of(rows, CHANGES)
        inside += [row.low <= truth[row.name] <= row.high for row in rows if not row.kept]
    assert np.mean(inside) > 0.8


def test_what_a_still_hover_leaves_open_is_kept_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands that do not change: lag, thrust curve and drag stay; the thrust that hovers is found."""
    states, commands = flown_logs.fly(Truth(START, **CHANGES), SECONDS, 2, seed=3, shake=0.0)
    states, commands = measured(states[:, 60:], 3), commands[:, 60:]
    paths = [flown_logs.write(tmp_path / f"{i}.csv", states[i], commands[i]) for i in range(2)]
    assert qrl("identify", *paths, "--vehicle", "crazyflie", "--out", tmp_path / "mine.json") == 0
    mine = json.loads((tmp_path / "mine.json").read_text())
    assert (mine["rotor_rise_s"], mine["thrust_curve"]) == (START["rotor_rise_s"], 0.0)
    assert mine["drag_N_s_m"] == START["drag_N_s_m"]
    rows = {row["name"]: row for row in json.loads((tmp_path / "mine_report.json").read_text())["parameters"]}
    assert "kept" in rows["rotor_rise_s"]["kept"]
    lifted = sum(motor["max_N"] for motor in mine["motors"]) * np.mean(commands**2)
    assert lifted == pytest.approx(START["mass_kg"] * 9.81, rel=0.02)
    assert "thrust over mass only" in capsys.readouterr().out


def test_thrusts_tell_the_mass(tmp_path: Path) -> None:
    """A log of thrusts: a payload beside the middle is weighed, and found."""
    heavy = {
        "mass_kg": 0.036,
        "motors": [{**m, "position_m": [m["position_m"][0] - 0.002, m["position_m"][1]]} for m in START["motors"]],
    }
    truth = Truth({**START, "thrust_curve": 0.0}, **heavy)
    states, commands = flown_logs.fly(truth, SECONDS, 2, seed=4)
    states = measured(states, 4)
    paths = [flown_logs.write(tmp_path / f"{i}.csv", states[i], truth.thrust(commands[i]), "f{}_N") for i in range(2)]
    assert qrl("identify", *paths, "--vehicle", "crazyflie", "--out", tmp_path / "mine.json") == 0
    mine = json.loads((tmp_path / "mine.json").read_text())
    assert mine["mass_kg"] == pytest.approx(0.036, rel=0.01)
    assert mine["motors"][0]["position_m"][0] == pytest.approx(START["motors"][0]["position_m"][0] - 0.002, abs=2e-4)
    assert mine["motors"][0]["max_N"] == START["motors"][0]["max_N"]


def test_velocity_and_rates_that_are_not_logged_are_slopes(
    flown: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    path = flown_logs.write(tmp_path / "a.csv", flown[0][0], flown[1][0], rates=False)
    (log,) = flight_log.read([path], np.full(4, 0.14375))
    assert log.estimated == ("velocity", "rate")
    inner = slice(10, -10)
    n = len(log.time_s)
    assert np.abs(log.velocity_m_s - flown[0][0, :n, 7:10])[inner].max() < 0.03
    assert np.sqrt(np.mean((log.body_rate_rad_s - flown[0][0, :n, 10:13])[inner] ** 2)) < 0.3


def test_body_rates_are_scipys() -> None:
    """Between two attitudes, at a constant rate."""
    first, rate = Rotation.random(rng=np.random.default_rng(0)), np.array([0.3, -1.1, 0.7])
    turning = Slerp([0.0, 1.0], Rotation.concatenate([first, first * Rotation.from_rotvec(rate)]))
    q = turning(np.linspace(0.0, 1.0, 2001)).as_quat(scalar_first=True)
    q *= np.sign(q @ q[0])[:, None]
    np.testing.assert_allclose(
        flight_log.body_rate(q, np.gradient(q, 0.0005, axis=0))[5:-5], np.tile(rate, (1991, 1)), atol=1e-4
    )


def changed(text: str, line: int, column: str, value: str) -> str:
    lines = [row.split(",") for row in text.splitlines()]
    lines[line - 1][lines[0].index(column)] = value
    return "\n".join(map(",".join, lines))


def scaled(text: str, names: tuple[str, ...], factor: float) -> str:
    rows = [row.split(",") for row in text.splitlines()]
    at = [rows[0].index(name) for name in names]
    for row in rows[1:]:
        for i in at:
            row[i] = str(factor * float(row[i]))
    return "\n".join(map(",".join, rows))


BAD = {
    "not a number": (
        lambda t: changed(t, 17, "y_m", "abc"),
        "line 17, column 'y_m': expected a finite number, found 'abc'",
    ),
    "not finite": (lambda t: changed(t, 5, "qw", "nan"), "line 5, column 'qw': expected a finite number, found 'nan'"),
    "time goes back": (lambda t: changed(t, 9, "time_s", "0.01"), "line 9, column 'time_s': expected a time after"),
    "no unit quaternion": (lambda t: changed(t, 4, "qw", "3"), "line 4, column 'qw': expected a unit quaternion"),
    "PWM": (lambda t: changed(t, 4, "u2", "40000"), "line 4, column 'u2': expected a fraction of the rotor's greatest"),
    "a column is missing": (lambda t: t.replace("z_m,", "z,", 1), "line 1: column 'z_m' is missing"),
    "a motor is missing": (lambda t: t.replace(",u4", ",x4", 1), "line 1: column 'u4' is missing"),
    "a motor too many": (lambda t: t.replace("u4\n", "u4,u5\n", 1), "line 1: column 'u5': expected u1, u2, u3, u4"),
    "two kinds of command": (lambda t: t.replace(",u4", ",f4_N", 1), "line 1: expected commands u1 … or f1_N …"),
    "twice": (lambda t: t.replace("y_m", "x_m", 1), "line 1: column 'x_m' stands twice"),
    "a short line": (lambda t: t.replace("\n", "\n1,2\n", 1), "line 2: expected 18 values, as in line 1, found 2"),
    "degrees": (
        lambda t: scaled(t, flight_log.RATE, 57.3),
        "body rates 'wx_rad_s', …: expected rad/s in the body frame",
    ),
    "z down": (lambda t: scaled(t, flight_log.VELOCITY, -1.0), "velocity 'vx_m_s', …: expected m/s in the world frame"),
    "too short": (lambda t: "\n".join(t.splitlines()[:60]), "expected a flight of at least 1.1 s"),
    "empty": (lambda t: "", "line 1: column 'time_s' is missing"),
}


@pytest.mark.parametrize(("change", "words"), BAD.values(), ids=BAD.keys())
def test_a_malformed_log_is_refused(
    change, words: str, logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text(change(logs[0].read_text()), encoding="utf-8")
    line = complaint(capsys, "identify", bad, "--vehicle", "crazyflie", "--out", tmp_path / "x.json")
    assert line.startswith(f"qrl: {bad}: ")
    assert words in line


def test_wrong_flags_are_refused(logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str | Path) -> str:
        return complaint(capsys, "identify", *words, "--out", tmp_path / "x.json")

    assert "unknown vehicle 'crazyfly' (did you mean 'crazyflie'?)" in said(logs[0], "--vehicle", "crazyfly")
    assert "--hold-out: expected logs, or one share of 0.05 to 0.8, found 2" in said(
        logs[0], "--vehicle", "crazyflie", "--hold-out", "2"
    )
    assert "stands twice" in said(logs[0], "--vehicle", "crazyflie", "--hold-out", logs[0])
    assert "cannot be read" in said(tmp_path / "none.csv", "--vehicle", "crazyflie")

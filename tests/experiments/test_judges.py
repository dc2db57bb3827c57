"""The judges' mappings: motor order, frames, starts, and what counts as a success. Their simulators are not here."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.baselines import estimates, kernel_flights
from experiments.baselines.kernel_flights import RAPTOR_ROTORS, Rotors, State
from experiments.bench import judges
from experiments.bench.contestants import JUDGES, Contestant
from qrl_envs import off_nominal

# Front left, front right, back right, back left, as rotorpy numbers them.
ROTORPY = Rotors(0.0304 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]), np.array([1, -1, 1, -1]))


def test_motors_are_matched_by_place_and_spin() -> None:
    order = kernel_flights.motor_order(RAPTOR_ROTORS, ROTORPY)
    np.testing.assert_array_equal(order, [3, 0, 1, 2])  # as rotorpy's own adapter of RAPTOR has it
    thrusts = np.array([10.0, 20.0, 30.0, 40.0])  # front right, back right, back left, front left
    np.testing.assert_array_equal(thrusts[order], [40.0, 10.0, 20.0, 30.0])
    with pytest.raises(ValueError, match="spin -1, is none of ours"):
        kernel_flights.motor_order(RAPTOR_ROTORS, ROTORPY._replace(spin=-ROTORPY.spin))
    plus = ROTORPY._replace(position_m=np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(ValueError, match="is none of ours"):
        kernel_flights.motor_order(RAPTOR_ROTORS, plus)


def test_the_observation_is_row_major_body_to_world() -> None:
    quarter = np.array([[np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]])  # the nose to the left: body x is world y
    rotation = kernel_flights.matrices(quarter)
    np.testing.assert_allclose(rotation[0] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    numbers = np.arange(9.0).reshape(3, 1, 3)
    seen = kernel_flights.observations(State(rotation, *numbers))
    np.testing.assert_allclose(seen[0, :9], [0, -1, 0, 1, 0, 0, 0, 0, 1], atol=1e-7)
    np.testing.assert_array_equal(seen[0, 9:], np.arange(9.0))


def test_starts_are_those_that_are_said() -> None:
    start = kernel_flights.moderate(400)
    tilt = np.degrees(np.arccos(kernel_flights.matrices(start.quaternion)[:, 2, 2]))
    assert 30.0 < tilt.max() < 48.0  # of roll and pitch of 34° together
    assert np.abs(start.position_m).max() <= 1.0
    upright = kernel_flights.matrices(kernel_flights.any_attitude(400).quaternion)[:, 2, 2]
    assert upright.min() < -0.9
    assert abs(upright.mean()) < 0.1


def test_a_lost_flight_is_no_success() -> None:
    near, far = np.full(800, 0.05), np.full(800, 0.05)
    far[:100] = 1.0
    lost, late = near.copy(), near.copy()
    lost[300:] = np.inf
    late[700] = 0.2
    found = kernel_flights.summary(np.array([near, far, lost, late]))
    assert (found["success"], found["lost"]) == (0.5, 0.25)
    assert found["settle_s"] == pytest.approx((1.0 + 7.01) / 2)
    assert kernel_flights.summary(np.full((1, 800), np.nan))["success"] == 0.0


def test_a_controller_on_the_reference_has_no_error_and_sees_what_is_ahead(tmp_path: Path) -> None:
    """A vehicle that is carried along each reference, as it is written and read: its distance stays 0."""
    path = tmp_path / "references.npz"
    kernel_flights.write_references(path, judges.references())
    found = kernel_flights.read_references(path)
    assert [each.name for each in found] == ["hover", *judges.FIGURES]
    for reference in found:
        seen: list[list[float]] = []
        still = kernel_flights.Start(np.eye(4)[:1], *np.zeros((3, 1, 3)))
        carried, watcher = Carried(reference), Watcher(seen)
        distances = kernel_flights.fly(carried, watcher, still, reference)
        assert distances.shape == (1, reference.steps)
        assert distances.max() < 1e-12
        np.testing.assert_allclose(np.array(seen)[:, :6], 0.0, atol=1e-12)
        velocity = reference.velocity_m_s
        np.testing.assert_allclose(seen[7][6:], velocity[57] - velocity[7])


class Carried:
    """A vehicle that is where the reference is."""

    def __init__(self, reference: kernel_flights.Reference) -> None:
        self._reference, self._at = reference, 0

    def start(self, states: State) -> None:
        np.testing.assert_allclose(states.position_m, self._reference.position_m[:1])

    def states(self) -> State:
        here = self._reference.position_m[[self._at]], self._reference.velocity_m_s[[self._at]]
        return State(np.eye(3)[None], *here, np.zeros((1, 3)))

    def step(self, set_points: np.ndarray, flying: np.ndarray) -> None:
        self._at += 1


class Watcher:
    """A controller that notes the errors and the preview of 0.5 s."""

    def __init__(self, seen: list[list[float]]) -> None:
        self._seen = seen

    def reset(self, flights: int) -> None:
        pass

    def act(self, states: State, target: kernel_flights.Target) -> np.ndarray:
        error = kernel_flights.relative(states, target)
        self._seen.append([*error.position_m[0], *error.velocity_m_s[0], *target.preview_m_s([50])])
        return np.zeros((1, 4))


def moving(time_s: float) -> State:
    """Three vehicles that are level and accelerate each in its own way."""
    acceleration = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, -1.0], [0.0, 3.0, 0.0]])
    velocity = np.array([[1.0, -2.0, 0.5], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    position = np.array([[0.0, 1.0, 2.0]]).T + velocity * time_s + 0.5 * acceleration * time_s**2
    return State(np.tile(np.eye(3), (3, 1, 1)), position, velocity + acceleration * time_s, np.zeros((3, 3)))


def test_noise_has_the_deviations_that_are_said() -> None:
    still = State(np.tile(np.eye(3), (4000, 1, 1)), *np.zeros((3, 4000, 3)))
    told = estimates.Noise(4000).told(still, 0.0)
    angles = np.stack([told.rotation[:, 2, 1], told.rotation[:, 0, 2], told.rotation[:, 1, 0]], axis=1)
    for found, size in zip((angles, *told[1:]), (0.01, 0.01, 0.02, 0.02), strict=True):
        np.testing.assert_allclose(found.std(axis=0), size, rtol=0.05)
    np.testing.assert_allclose(told.rotation @ told.rotation.transpose(0, 2, 1), still.rotation, atol=1e-12)


def test_judges_err_as_our_own_evaluation_does() -> None:
    """In two files, since a judge's environment has no qrl_envs."""
    noise = {
        "position_noise_m": estimates.POSITION_M,
        "velocity_noise_m_s": estimates.VELOCITY_M_S,
        "attitude_noise_rad": estimates.ATTITUDE_RAD,
        "body_rate_noise_rad_s": estimates.BODY_RATE_RAD_S,
    }
    fixes = {
        "position_period_s": estimates.FIX_PERIOD_S,
        "position_delay_s": estimates.FIX_DELAY_S,
        "bias_wander_m": estimates.WANDER_M,
    }
    assert (noise, fixes) == (off_nominal.NOISE, off_nominal.FIXES)


def test_fixes_are_late_and_the_velocity_is_of_the_last_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steady motion is told as it is; under an acceleration the velocity is that of half a period before the fix."""
    monkeypatch.setattr(estimates, "WANDER_M", 0.0)
    fixes, late = estimates.Fixes(3), []
    for step in range(100):
        time_s = 0.01 * step
        true, told = moving(time_s), fixes.told(moving(time_s), time_s)
        np.testing.assert_allclose(told.position_m[0], true.position_m[0], atol=1e-12)
        np.testing.assert_allclose(told.velocity_m_s[0], true.velocity_m_s[0], atol=1e-9)
        late.append((true.velocity_m_s - told.velocity_m_s)[1:] / [[2.0, 1.0, 1.0], [1.0, 3.0, 1.0]])
    ages_s = np.array(late)[10:, [0, 1], [0, 1]]  # of the middle of the last two fixes
    assert 0.01 + 1 / 60 - 1e-3 < ages_s.min() < 0.01 + 1 / 60 + 0.01
    assert 0.01 + 3 / 60 - 0.01 < ages_s.max() < 0.01 + 3 / 60 + 1e-3


def test_the_bias_is_in_what_is_told_and_wanders_as_is_said() -> None:
    still = State(np.tile(np.eye(3), (2000, 1, 1)), *np.zeros((3, 2000, 3)))
    fixes, biases = estimates.Fixes(2000), []
    for step in range(520):
        told = fixes.told(still, 0.01 * step)
        biases.append(fixes.bias_m())
        # Within what the velocity of two biases makes of a fix's age, which is 43 ms at most.
        np.testing.assert_allclose(told.position_m, biases[-1], atol=0.01)
    assert np.std(biases[0]) == pytest.approx(0.005, rel=0.05)
    assert np.std(biases[-1]) == pytest.approx(0.005, rel=0.05)
    alike = np.mean(biases[0] * biases[500]) / 0.005**2  # after five seconds, one correlation time
    assert alike == pytest.approx(np.exp(-1.0), abs=0.06)


def test_our_plant_hovers_under_the_thrusts_of_hover() -> None:
    """In the frames and units of a judge's rollouts."""
    vehicle = judges.vehicle_of("crazyflie")
    given = judges.given_for(vehicle)
    count = 2
    still = kernel_flights.Start(np.eye(4)[:1].repeat(count, 0), *np.zeros((3, count, 3)))
    hover = np.broadcast_to(vehicle.hover_thrusts_N, (count, 5, 4))
    there = judges.ours(vehicle, given._replace(starts=still, thrusts_N=hover), drag=True)
    np.testing.assert_allclose(there.position_m, 0.0, atol=1e-5)
    np.testing.assert_allclose(there.rotation, np.broadcast_to(np.eye(3), there.rotation.shape), atol=1e-5)
    left = hover * np.array([1.0, 1.1, 1.1, 1.0])  # more on the right: rolls to the left, about −x
    assert (
        judges.ours(vehicle, given._replace(starts=still, thrusts_N=left), drag=True).body_rate_rad_s[0, -1, 0] < -0.1
    )


def test_differences_of_plants_are_in_the_units_that_are_said() -> None:
    def after(angle_rad: float, moved: float) -> State:
        turned = np.array([[np.cos(angle_rad / 2), 0.0, np.sin(angle_rad / 2), 0.0]])
        rotation = np.broadcast_to(kernel_flights.matrices(turned), (2, 30, 3, 3))
        return State(rotation, *(np.broadcast_to([moved, 0.0, 0.0], (2, 30, 3)) for _ in range(3)))

    first, *_ = judges.differences("stage", after(np.radians(3.0), 0.002), after(0.0, 0.0))
    assert first[1:] == pytest.approx((0.01, 2.0, 2.0, 3.0, 0.002))


def test_a_judge_is_asked_once_and_its_lines_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a judge that flies nothing, and that cannot roll its plant out."""
    line = {"starts": "moderate", "flights": 3, "condition": "nominal", "controller": "qrl"}
    line |= {"success": 1.0, "rmse_mm": 0.41, "settle_s": None, "lost": 0.0}
    (tmp_path / "stub.txt").write_text("")
    (tmp_path / "stub.py").write_text(
        f"import sys\nassert '--given' not in sys.argv\nprint('BENCH ' + {json.dumps(line)!r})\n"
        f"print(len(open({str(tmp_path / 'asked')!r}, 'a').write('x') * 'x'))\n"
    )
    monkeypatch.setattr(judges, "BASELINES", tmp_path)
    monkeypatch.setattr(judges, "kernel_of", lambda task, vehicle, run, folder: None)
    stub = Contestant("stub crazyflie", JUDGES, "stub.py", ("crazyflie",), "stub")
    for _ in range(2):
        judges.judge([stub], {"stub": Path(sys.executable)}, tmp_path / "out", 3, {}, fresh=False)
    assert (tmp_path / "asked").read_text() == "x"
    (kept,) = json.loads((tmp_path / "out" / "judges" / "judges.json").read_text())
    assert (kept["flights"], kept["plants"], kept["outcome"]) == ([line], [], "done")
    assert "| nominal | 0.4; 100 %; – |" in (tmp_path / "out" / "judges" / "judges.md").read_text()

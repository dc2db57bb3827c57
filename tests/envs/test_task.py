"""Task files: what ships loads, files extend it, and every kind of mistake gets one clear line."""

import copy
import json
import re
from pathlib import Path

import numpy as np
import pytest

from qrl_envs import task
from qrl_envs.specfile import BadInput
from qrl_envs.vehicle import vehicle_data

SHIPPED = {name: task.load(name).model_dump(mode="json") for name in task.shipped()}
MOTOR = '{"position_m": [0.1, 0.1], "spin": %s, "max_N": %s}'


def motors(spin: str = "1", max_N: str = "8.0") -> str:
    """Four motors in a square, the spin given for the first."""
    at = ["[0.1, 0.1]", "[-0.1, 0.1]", "[-0.1, -0.1]", "[0.1, -0.1]"]
    spins = [spin, "-1", "1", "-1"]
    each = [(MOTOR % (s, max_N)).replace(at[0], p) for s, p in zip(spins, at, strict=True)]
    return "[" + ", ".join(each) + "]"


def hover(keys: str) -> str:
    """A file that extends hover with the given keys."""
    return f'{{"extend": "hover", {keys}}}'


def circle(keys: str) -> str:
    return f'{{"extend": "circle", {keys}}}'


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file that every test here writes anew."""
    return tmp_path_factory.mktemp("tasks") / "mine.json"


def load(path: Path, text: str | bytes) -> task.Task:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return task.load(str(path))


@pytest.mark.parametrize("name", ["circle", "hover", "pendulum"])
def test_shipped_tasks_load_by_name(name: str) -> None:
    """And are all there is under that name."""
    assert name in task.shipped()
    assert task.load(name).reward.form == name


def test_the_shipped_vehicle_is_fields(path: Path) -> None:
    """FIELD.md, Sec. 1: the paper-era vehicle, its reset and its period, for hover and circle alike."""
    for name in ("hover", "circle"):
        spec = SHIPPED[name]
        vehicle = spec["vehicle"]
        assert (vehicle["mass_kg"], vehicle["inertia_kg_m2"]) == (0.667, [0.0023, 0.0025, 0.0037])
        assert (vehicle["yaw_moment_m"], vehicle["action_scale_N"]) == (0.016, 6.0)
        assert [motor["max_N"] for motor in vehicle["motors"]] == [8.0] * 4
        for motor in vehicle["motors"]:
            x, y = motor["position_m"]
            assert (x**2 + y**2) ** 0.5 == pytest.approx(0.105, rel=1e-3)
            assert abs(x) == abs(y)
            assert motor["spin"] == (1 if x * y > 0 else -1)  # diagonal pairs turn alike
        assert spec["control_period_s"] == 0.01
        start = {"position_m": 2.0, "velocity_m_s": 1.0, "body_rate_rad_s": 1.0, "tilt_rad": np.pi}
        assert spec["evaluation"]["start"] == start
        assert spec["bounds"] == {"distance_m": 20.0, "body_rate_rad_s": 100.0}


def test_a_file_that_says_it_all_needs_no_base(path: Path) -> None:
    """Each shipped task written out in full reads back as itself."""
    for name, spec in SHIPPED.items():
        assert load(path, json.dumps(spec)) == task.load(name)


def test_extending_changes_what_is_said_and_nothing_else(path: Path) -> None:
    """Objects merge key by key, at any depth."""
    mine = load(path, hover('"vehicle": {"mass_kg": 0.03}, "evaluation": {"start": {"position_m": 0.5}}'))
    expected = copy.deepcopy(SHIPPED["hover"])
    expected["vehicle"]["mass_kg"] = 0.03
    expected["evaluation"]["start"]["position_m"] = 0.5
    assert mine.model_dump(mode="json") == expected


def test_extending_replaces_lists_whole(path: Path) -> None:
    """Four motors in the file are the four motors."""
    mine = load(path, hover(f'"vehicle": {{"motors": {motors(max_N="3")}}}'))
    assert isinstance(mine, task.QuadrotorTask)
    assert [motor.max_N for motor in mine.vehicle.motors] == [3.0] * 4


def test_a_reward_of_another_form_replaces_the_old_one(path: Path) -> None:
    """Nothing of the circle's weights is left over where hover's are asked for, and the weights are needed."""
    weights = {"form": "hover", "w1_attitude": 1, "w2_position_1_m": 2, "w3_action": 3}
    evaluation = {"reward": weights, "speed_m_s": None}
    mine = load(path, json.dumps({"extend": "circle", "reward": weights, "evaluation": evaluation}))
    assert mine.reward == task.HoverReward(form="hover", w1_attitude=1, w2_position_1_m=2, w3_action=3)
    with pytest.raises(BadInput, match=r"key 'reward\.w2_position_1_m' is missing"):
        load(path, circle('"reward": {"form": "hover", "w1_attitude": 1}'))


def test_durations_of_the_first_version_are_read(path: Path) -> None:
    """It counted them in steps of the control period."""
    mine = load(path, hover('"control_period_s": 0.005, "episode_steps": 300, "evaluation": {"return_steps": 2e2}'))
    assert isinstance(mine, task.QuadrotorTask)
    assert (mine.episode_s, mine.episode_steps, mine.evaluation.return_s) == (1.5, 300, 1.0)


def test_a_flat_plate_is_a_body(path: Path) -> None:
    """Where one moment is the sum of the other two, however the sum rounds."""
    for x, y, z in [(0.1, 0.2, 0.3), (0.0001, 0.0003, 0.0004), (0.0022, 0.0001, 0.0021)]:
        plate = load(path, hover(f'"vehicle": {{"inertia_kg_m2": [{x}, {y}, {z}]}}'))
        assert isinstance(plate, task.QuadrotorTask)
        assert plate.vehicle.inertia_kg_m2 == (x, y, z)


# What is wrong -> the file, and the words that its one line must hold.
MISTAKES: dict[str, tuple[str | bytes, list[str]]] = {
    "negative mass": (hover('"vehicle": {"mass_kg": -0.5}'), ["'vehicle.mass_kg'", "greater than 0", "-0.5"]),
    "zero mass": (hover('"vehicle": {"mass_kg": 0}'), ["'vehicle.mass_kg'", "greater than 0"]),
    "zero inertia": (
        hover('"vehicle": {"inertia_kg_m2": [0.1, 0, 0.1]}'),
        ["'vehicle.inertia_kg_m2'", "greater than 0", "found 0"],
    ),
    "inertia of no body": (
        hover('"vehicle": {"inertia_kg_m2": [0.001, 0.001, 0.003]}'),
        ["'vehicle'", "inertia_kg_m2", "rigid body", "0.003"],
    ),
    "two moments": (
        hover('"vehicle": {"inertia_kg_m2": [0.1, 0.1]}'),
        ["'vehicle.inertia_kg_m2'", "3 moments", "found 2"],
    ),
    "too weak motors": (
        hover(f'"vehicle": {{"motors": {motors(max_N="1.6")}}}'),
        ["'vehicle'", "motors that can lift", "6.4 N", "6.543 N"],
    ),
    "two motors": (
        hover('"vehicle": {"motors": [%s]}' % ", ".join([MOTOR % (1, 8)] * 2)),  # noqa: UP031
        ["'vehicle.motors'", "3"],
    ),
    "a lag of one way": (hover('"vehicle": {"rotor_rise_s": 0.05}'), ["'vehicle'", "rotor_fall_s", "both 0"]),
    "an axis of no length": (
        hover('"vehicle": {"motors": [%s]}' % ", ".join([MOTOR[:-1] % (1, 8) + ', "axis": [0, 0, 0]}'] * 4)),  # noqa: UP031
        ["'vehicle.motors.0'", "axis"],
    ),
    "a range the wrong way round": (
        hover('"uncertainty": {"mass_factor": [1.2, 0.8]}'),
        ["'uncertainty.mass_factor'", "[least, greatest]", "1.2"],
    ),
    "an uncertainty of no name": (hover('"uncertainty": "defaul"'), ["'uncertainty'", "defaul"]),
    "latency of a second": (hover('"uncertainty": {"latency_s": [0, 1]}'), ["'uncertainty'", "latency_s", "0.1"]),
    "five motors": (hover('"vehicle": {"motors": [%s]}' % ", ".join([MOTOR % (1, 8)] * 5)), ["motors"]),  # noqa: UP031
    "spin of two": (
        hover(f'"vehicle": {{"motors": {motors(spin="2")}}}'),
        ["'vehicle.motors.0.spin'", "1 or -1", "found 2"],
    ),
    "unknown key": (hover('"epsiode_s": 3'), ["unknown key", "'epsiode_s'", "did you mean 'episode_s'"]),
    "unknown key, deep": (hover('"vehicle": {"mass": 3}'), ["unknown key", "'vehicle.mass'", "'mass_kg'"]),
    "unknown key, in a list": (
        hover('"vehicle": {"motors": %s}' % motors().replace("max_N", "maxN")),  # noqa: UP031
        ["unknown key", "'vehicle.motors.0.maxN'", "did you mean 'max_N'"],
    ),
    "unknown key of the form": (
        circle('"reward": {"w4_distance": 1}'),
        ["unknown key", "'reward.w4_distance'", "did you mean 'w4_distance_1_m'"],
    ),
    "key of another world": (hover('"rod": {"mass_kg": 1}'), ["unknown key", "'rod'"]),
    "text for a number": (hover('"vehicle": {"mass_kg": "heavy"}'), ["'vehicle.mass_kg'", "number", '"heavy"']),
    "true for a number": (hover('"control_period_s": true'), ["'control_period_s'", "number", "true"]),
    "null for a number": (hover('"control_period_s": null'), ["'control_period_s'", "number", "null"]),
    "number for text": (hover('"description": 3'), ["'description'", "string", "found 3"]),
    "list for an object": (hover('"vehicle": []'), ["'vehicle'", "object", "[]"]),
    "object for a list": (hover('"vehicle": {"motors": {}}'), ["'vehicle.motors'", "{}"]),
    "no step": (hover('"episode_s": 0'), ["'episode_s'", "greater than 0", "found 0"]),
    "negative range": (hover('"start": {"velocity_m_s": -1}'), ["'start.velocity_m_s'", "0", "-1"]),
    "negative weight": (hover('"reward": {"w3_action": -0.1}'), ["'reward.w3_action'", "0", "-0.1"]),
    "missing key": ('{"world": "pendulum"}', ["missing"]),
    "key twice": (hover('"episode_s": 3, "episode_s": 4'), ["'episode_s'", "twice"]),
    "key twice, deep": (hover('"vehicle": {"mass_kg": 3, "mass_kg": 4}'), ["'mass_kg'", "twice"]),
    "NaN": (hover('"control_period_s": NaN'), ["'control_period_s'", "NaN"]),
    "infinity": (hover('"control_period_s": -Infinity'), ["'control_period_s'", "-Infinity"]),
    "beyond all doubles": (hover('"control_period_s": 1e999'), ["'control_period_s'", "finite"]),
    "more digits than Python reads": (hover(f'"control_period_s": {"9" * 5000}'), []),
    "not JSON": ("{'extend': 'hover'}", ["line 1, column 2", "not JSON"]),
    "cut off": ('{"extend": "hover",', ["line 1", "not JSON"]),
    "empty": ("", ["not JSON"]),
    "not text": (b"\xff\xfe\x00{", ["not JSON"]),
    "nested without end": ("[" * 100_000, ["not JSON"]),
    "a list": ("[1, 2]", ["JSON object", "list"]),
    "nothing said": ("{}", ["'world'", "'quadrotor'", "'pendulum'"]),
    "extends what is not shipped": ('{"extend": "hovr"}', ["'extend'", "'hovr'", "did you mean 'hover'"]),
    "extends a number": ('{"extend": 3}', ["'extend'", "'3'", "hover"]),
    "unknown world": (hover('"world": "sea"'), ["'world'", "'quadrotor'", "sea"]),
    "unknown form": (hover('"reward": {"form": "loop"}'), ["'reward.form'", "'hover'", "'circle'", "loop"]),
    "form of another world": (hover('"reward": {"form": "pendulum"}'), ["'reward.form'", "'hover'", "pendulum"]),
    "trained for one form, judged by another": (
        hover(
            '"reward": {"form": "circle", "w4_distance_1_m": 1, "w5_direction_s_m2": 1, "w6_action": 1,'
            ' "radius_m": 1, "speed_m_s": 2}'
        ),
        ["reward.form", "evaluation.reward.form"],
    ),
    "another circle judged than wanted": (circle('"reward": {"radius_m": 0.5}'), ["reward.radius_m", "evaluation"]),
    "tail longer than the flight": (hover('"evaluation": {"tail_s": 9}'), ["evaluation.tail_s", "8.0", "9.0"]),
    "speed tolerance for hover": (hover('"evaluation": {"speed_m_s": 0.2}'), ["'evaluation'", "speed_m_s", "circle"]),
    "no speed tolerance for the circle": (
        circle('"evaluation": {"speed_m_s": null}'),
        ["'evaluation'", "speed_m_s", "circle"],
    ),
    "pendulum of no length": ('{"extend": "pendulum", "rod": {"length_m": 0}}', ["'rod.length_m'", "greater than 0"]),
    "a key over two lines": (hover('"a\\nb": 1'), ["unknown key"]),
    "a key over two lines, twice": (hover('"a\\nb": 1, "a\\nb": 2'), ["twice"]),
    "extends two lines": ('{"extend": "hover\\ncircle"}', ["'extend'"]),
    "text for a number, over two lines": (hover('"vehicle": {"mass_kg": "a\\nb"}'), ["'vehicle.mass_kg'"]),
    # Numbers that the world's float32, or its step counters, cannot hold.
    "mass that rounds to zero": (hover('"vehicle": {"mass_kg": 1e-60}'), ["mass_kg"]),
    "inertia that rounds to zero": (hover('"vehicle": {"inertia_kg_m2": [1e-60, 1e-60, 1e-60]}'), ["inertia_kg_m2"]),
    "motor beyond single precision": (
        hover('"vehicle": {"motors": %s}' % motors().replace("[0.1, 0.1]", "[1e39, 0.1]")),  # noqa: UP031
        ["position_m", "1e+39"],
    ),
    "constant beyond single precision": (hover('"reward": {"constant": -1e39}'), ["'reward.constant'", "-1e+39"]),
    "endless episode": (hover('"episode_s": 1e300'), ["episode_s"]),
    "period longer than the flight": (hover('"control_period_s": 20'), ["control_period_s"]),
}


@pytest.mark.parametrize(("text", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_gets_one_line_with_file_key_and_what_was_expected(
    text: str | bytes, words: list[str], path: Path
) -> None:
    """No traceback, and the nearest name where there is one."""
    with pytest.raises(BadInput) as caught:
        load(path, text)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert line.splitlines() == [line]
    assert len(line) < len(str(path)) + 300
    for word in words:
        assert word in line.removeprefix(str(path))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("circel", ["'circel'", "did you mean 'circle'"]),
        ("Hover", ["'Hover'", "did you mean 'hover'"]),
        ("walk", ["'walk'", "circle, hover, pendulum"]),
        ("", ["circle, hover, pendulum"]),
        ("ho\nver", ["unknown task"]),
        ("no/such.json", ["no/such.json", "No such file"]),
        ("circel.json", ["circel.json", "No such file"]),
    ],
)
def test_an_unknown_task_gets_the_nearest_name(name: str, words: list[str]) -> None:
    """Or the names that there are; a path that leads nowhere says so."""
    with pytest.raises(BadInput) as caught:
        task.load(name)
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert all(word in line for word in words)


def test_a_folder_is_not_a_task(tmp_path: Path) -> None:
    """Even one that is called like a file."""
    folder = tmp_path / "folder.json"
    folder.mkdir()
    with pytest.raises(BadInput, match=r"folder\.json: cannot be read"):
        task.load(str(folder))


def vehicle(changes: dict) -> str:
    """A file of hover with the paper's vehicle, changed."""
    return hover(f'"vehicle": {json.dumps(changes)}')


def four(*positions: tuple[float, float], spins: tuple[int, ...] = (1, -1, 1, -1)) -> list[dict]:
    return [{"position_m": p, "spin": s, "max_N": 8.0} for p, s in zip(positions, spins, strict=True)]


CANNOT_FLY = {
    "center of mass outside": (
        {"motors": four((-0.02, 0.1), (-0.3, 0.1), (-0.3, -0.1), (-0.02, -0.1))},
        "around the center of mass, and spins",
    ),
    "more than a motor has": (
        {"motors": four((0.01, 0.1), (-0.3, 0.1), (-0.3, -0.1), (0.01, -0.1)), "mass_kg": 2.0},
        "motor 1 would need",
    ),
    "no arms": ({"motors": four(*[(0.0, 0.0)] * 4)}, "turn the vehicle about body x"),
    "millimeters": (
        {"motors": four((74.0, 74.0), (-74.0, 74.0), (-74.0, -74.0), (74.0, -74.0))},
        "position_m in meters",
    ),
    "a fraction for newtons": ({"action_scale_N": 0.002}, "action_scale_N in newtons"),
}


@pytest.mark.parametrize(("changes", "words"), CANNOT_FLY.values(), ids=CANNOT_FLY.keys())
def test_a_vehicle_that_cannot_fly_is_refused_with_the_reason(changes: dict, words: str, path: Path) -> None:
    with pytest.raises(BadInput, match=words):
        load(path, vehicle(changes))


def test_what_can_only_just_fly_is_warned_about(path: Path) -> None:
    """Little thrust to spare, or that actions reach; yaw that comes with roll only; hardly any yaw; a wrong spin. The
    paper's vehicle gets no warning.
    """
    for changes, words in (
        ({"mass_kg": 2.7}, "can only just hover"),
        (
            {"motors": four((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), spins=(1, 1, -1, -1))},
            "all axes independently",
        ),
        ({"yaw_moment_m": 1e-9}, "hardly turn about body z"),
        ({"action_scale_N": 20.0}, "nearly every action is a motor's limit"),
        ({"action_scale_N": 0.3}, "actions reach 1.18 of the weight, and its motors 4.89"),
        (
            {"motors": four((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), spins=(1, 1, 1, -1))},
            "in hover motor 1 carries 0 N and motor 2 3.3 N: check motors.position_m and motors.spin",
        ),
    ):
        (warning,) = load(path, vehicle(changes)).warnings()
        assert words in warning
    assert task.load("hover").warnings() == []


@pytest.mark.parametrize(
    ("uncertainty", "words"),
    [
        ('{"rotor_lag_s": [0.0, 0.05]}', r"rotor_lag_s \[0, 0.05\] leaves out the vehicle's own lag of 72 ms"),
        ('{"rotor_lag_s": [0.08, 0.2]}', "rotor_lag_s"),
        ('{"rotor_lag_factor": [1.1, 2.0]}', "rotor_lag_factor"),
        ('{"rotor_lag_s": [0.02, 0.072]}', None),
        ('{"rotor_lag_factor": [0.6, 1.6]}', None),
    ],
)
def test_a_lag_that_is_not_trained_with_is_warned_about(uncertainty: str, words: str | None, path: Path) -> None:
    """The crazyflie's 72 ms; of the cf21_brushless both 57 and 62 ms count; a vehicle without lag has none."""
    found = load(path, hover(f'"vehicle": "crazyflie", "uncertainty": {uncertainty}'))
    assert isinstance(found, task.QuadrotorTask)
    if words is None:
        assert (found.warnings(), found.lag_not_trained) == ([], None)
    else:
        (warning,) = found.warnings()
        assert re.search(words, warning)
    between = load(path, hover('"vehicle": "cf21_brushless", "uncertainty": {"rotor_lag_s": [0.058, 0.07]}'))
    assert "57 and 62 ms" in between.warnings()[0]
    papers = load(path, hover('"uncertainty": {"rotor_lag_factor": [2.0, 3.0]}'))
    assert papers.warnings() == []


def test_hover_thrusts_balance_an_off_center_mass() -> None:
    """Forces and moments by statics; mg/4 each on the paper's vehicle."""
    hover = task.load("hover")
    assert isinstance(hover, task.QuadrotorTask)
    np.testing.assert_allclose(hover.vehicle.hover_thrusts_N, 0.667 * 9.81 / 4, rtol=1e-12)


def test_a_rounded_inertia_is_taken(path: Path) -> None:
    """Up to 5 % over a rigid body's bound, no more."""
    load(path, vehicle({"inertia_kg_m2": [0.001, 0.001, 0.00205]}))
    with pytest.raises(BadInput, match="rigid body"):
        load(path, vehicle({"inertia_kg_m2": [0.001, 0.001, 0.0022]}))


def test_a_task_names_its_vehicle_and_another_may_fly_it(path: Path) -> None:
    """By a shipped name, or a file beside the task's; the argument replaces the task's own."""
    crazyflie = task.load("circle", "crazyflie")
    assert isinstance(crazyflie, task.QuadrotorTask)
    assert crazyflie.vehicle.mass_kg == 0.03
    (path.parent / "light.json").write_text(json.dumps({**SHIPPED["hover"]["vehicle"], "mass_kg": 0.5}))
    mine = load(path, hover('"vehicle": "light.json"'))
    assert isinstance(mine, task.QuadrotorTask)
    assert mine.vehicle.mass_kg == 0.5
    with pytest.raises(BadInput, match="did you mean 'crazyflie'"):
        task.load("hover", "crazyfly")
    with pytest.raises(BadInput, match="has no vehicle"):
        task.load("pendulum", "crazyflie")


def test_a_real_vehicle_has_uncertainty_and_memory_unless_the_file_says_other(path: Path) -> None:
    real = task.load("hover", "crazyflie")
    assert isinstance(real, task.QuadrotorTask)
    assert not real.ideal
    assert real.memory == task.Memory(previous_action=True, integral=task.Integral())
    assert real.uncertainty
    assert real.uncertainty.mass_factor == (0.8, 1.3)
    plain = load(path, hover('"vehicle": "crazyflie", "uncertainty": "none", "memory": {}'))
    assert isinstance(plain, task.QuadrotorTask)
    assert plain.uncertainty == type(real.uncertainty)()
    assert plain.memory == task.Memory()
    again = task.from_data(plain.model_dump(mode="json", exclude_none=True), "record")
    assert again == plain
    papers = task.load("hover")
    assert isinstance(papers, task.QuadrotorTask)
    assert papers.ideal
    drawn = task.load("hover", uncertainty="default")  # what is uncertain has to be found out, whatever the vehicle
    assert isinstance(drawn, task.QuadrotorTask)
    assert (drawn.memory, drawn.policy_frame, drawn.preset) == (real.memory, "body", "hover_real")
    assert task.load("hover", uncertainty="none").preset == "hover"
    with pytest.raises(BadInput, match="unknown uncertainty 'non'"):
        task.load("hover", uncertainty="non")


@pytest.mark.parametrize("motors", [6, 4], ids=["hexarotor", "tilted"])
def test_other_multirotors_hover(motors: int, path: Path) -> None:
    """Six motors; four that are all tilted forward, which hover tilted backward by as much."""
    axis = [0.17, 0.0, 0.98] if motors == 4 else [0.0, 0.0, 1.0]
    angles = np.pi / motors * (2 * np.arange(motors) + 1)
    made = [
        {"position_m": [0.2 * np.cos(a), 0.2 * np.sin(a)], "spin": (-1) ** i, "max_N": 7.0, "axis": axis}
        for i, a in enumerate(angles)
    ]
    vehicle = {"mass_kg": 1.3, "inertia_kg_m2": [0.012, 0.014, 0.02], "motors": made, "yaw_moment_m": 0.015}
    (path.parent / "other.json").write_text(json.dumps(vehicle))
    found = load(path, hover('"vehicle": "other.json"'))
    assert isinstance(found, task.QuadrotorTask)
    np.testing.assert_allclose(found.vehicle.hover_thrusts_N, 1.3 * 9.81 / motors, rtol=1e-6)


def test_a_vehicles_action_scale_reaches_its_farther_limit(path: Path) -> None:
    """Where the file gives none."""
    spec = {key: value for key, value in SHIPPED["hover"]["vehicle"].items() if key != "action_scale_N"}
    (path.parent / "plain.json").write_text(json.dumps(spec))
    mine = load(path, hover('"vehicle": "plain.json"'))
    assert isinstance(mine, task.QuadrotorTask)
    assert mine.vehicle.action_scale_N == pytest.approx(8.0 - 0.667 * 9.81 / 4)


def circle_of(radius: float, speed: float, **keys: object) -> str:
    ring = {"radius_m": radius, "speed_m_s": speed}
    return json.dumps({"extend": "circle", "reward": ring, "evaluation": {"reward": ring}, **keys})


def test_circles_of_any_size_and_sense(path: Path) -> None:
    """A speed error costs the same on every circle; what no thrust can hold is refused."""
    for radius, speed in ((5.0, 3.0), (1.0, -2.0)):
        mine = load(path, circle_of(radius, speed))
        assert isinstance(mine.reward, task.CircleReward)
        assert mine.reward.w5_direction_s_m2 == 0.5 / radius
        assert f"a {radius:g} m circle at {abs(speed):g} m/s, {'counter-' * (speed > 0)}clockwise," in mine.description
    for radius, speed, words in ((0.2, 6.0, "180 m/s²"), (1.0, 0.0, "clockwise"), (30.0, 3.0, "bounds.distance_m")):
        with pytest.raises(BadInput, match=words):
            load(path, circle_of(radius, speed))


def test_bounds_within_the_starts_are_refused(path: Path) -> None:
    with pytest.raises(BadInput, match=r"bounds\.distance_m beyond the starts"):
        load(path, hover('"bounds": {"distance_m": 1.5}'))
    with pytest.raises(BadInput, match=r"bounds\.body_rate_rad_s beyond the starts, which reach 1\.73 rad/s"):
        load(path, hover('"bounds": {"body_rate_rad_s": 1.5}'))


def test_a_lagged_vehicle_brings_no_weights_to_a_reward_of_another_form(path: Path) -> None:
    ring = {"form": "circle", "w4_distance_1_m": 1.0, "w6_action": 0.01, "radius_m": 1.0, "speed_m_s": 1.0}
    judged = {"reward": ring, "speed_m_s": 0.2}
    mine = load(path, json.dumps({"extend": "hover", "vehicle": "crazyflie", "reward": ring, "evaluation": judged}))
    assert mine.reward == task.CircleReward(**ring, w5_direction_s_m2=0.5)


def test_the_vehicle_of_a_task_is_read_by_object_or_name(path: Path) -> None:
    for given in ("crazyflie", vehicle_data("crazyflie")):
        path.write_text(json.dumps({"extend": "hover", "vehicle": given}))
        assert vehicle_data(str(path)) == vehicle_data("crazyflie")


def test_an_ideal_vehicle_is_written_as_it_was_before_it_could_lag(path: Path) -> None:
    """So runs of before keep their fingerprint; what lags is written whole."""
    written = task.load("hover").model_dump(mode="json", exclude_none=True)
    assert written["vehicle"].keys() == {"mass_kg", "inertia_kg_m2", "motors", "yaw_moment_m", "action_scale_N"}
    assert written["vehicle"]["motors"][0].keys() == {"position_m", "spin", "max_N"}
    assert "memory" not in written
    drag = load(path, hover('"vehicle": {"drag_N_s_m": [0.0, 0.0, 1.0]}')).model_dump(mode="json", exclude_none=True)
    assert drag["vehicle"]["drag_N_s_m"] == [0.0, 0.0, 1.0]
    assert drag["memory"]["previous_action"]

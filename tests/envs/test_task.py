"""Task files: what ships loads, files extend it, and every kind of mistake gets one clear line."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest

from qrl_envs import task
from qrl_envs.specfile import BadInput

SHIPPED = {name: task.load(name).model_dump(mode="json") for name in task.shipped()}
MOTOR = '{"position_m": [0.1, 0.1], "spin": %s, "max_N": %s}'


def motors(spin: str = "1", max_N: str = "8.0") -> str:
    return "[" + ", ".join([MOTOR % (spin, max_N)] * 4) + "]"


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
        ["'vehicle.inertia_kg_m2.1'", "greater than 0", "found 0"],
    ),
    "inertia of no body": (
        hover('"vehicle": {"inertia_kg_m2": [0.001, 0.001, 0.003]}'),
        ["'vehicle'", "inertia_kg_m2", "rigid body", "0.003"],
    ),
    "two moments": (hover('"vehicle": {"inertia_kg_m2": [0.1, 0.1]}'), ["'vehicle.inertia_kg_m2.2'", "missing"]),
    "too weak motors": (
        hover(f'"vehicle": {{"motors": {motors(max_N="1.6")}}}'),
        ["'vehicle'", "motors that can lift", "6.4 N", "6.543 N"],
    ),
    "three motors": (
        hover('"vehicle": {"motors": [%s]}' % ", ".join([MOTOR % (1, 8)] * 3)),  # noqa: UP031
        ["'vehicle.motors.3'", "missing"],
    ),
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

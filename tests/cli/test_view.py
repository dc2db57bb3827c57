"""The page of flights: what it holds is what was flown, and in a real browser it is drawn, plays and can be steered.

Without Chromium and its driver (Debian: chromium, chromium-driver) those tests are skipped; QRL_REQUIRE_CROSS=1 makes
that a failure.
"""

import io
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image
from selenium import webdriver
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select

from cli_helpers import complaint, qrl, untrained
from cross_targets import need
from experiments.gallery import browser
from qrl.cli.export import fly_kernel
from qrl.evaluation.starts import evaluation_starts
from qrl.evaluation.trained_run import TrainedRun
from qrl.export.quantize import quantize
from qrl.runs import files
from qrl_envs import measures, viewer
from qrl_envs import task as tasks
from qrl_envs.viewer import Recording

Array = np.ndarray
Build = Callable[[str], Path]

TASKS = ("hover", "circle", "pendulum")
STARTS = (4, 0, 917)
MOST_BYTES = 8e6
each_task = pytest.mark.parametrize("name", TASKS)


def rotations(angle: Array, axis: Array) -> Array:
    """Rodrigues' formula: angles [...], one axis [3] -> matrices [..., 3, 3]."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    s, c = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + s * k + (1 - c) * k @ k


def made_up(name: str, n: int = 3, seed: int = 0) -> Recording:
    """Flights as long as an evaluation's that approach the wanted motion; actions are noise, some beyond ±1."""
    task, rng = tasks.load(name), np.random.default_rng(seed)
    steps = round(task.evaluation.duration_s / task.control_period_s)
    t = np.arange(steps + 1) * task.control_period_s
    left = np.exp(-rng.uniform(1.0, 3.0, (n, 1)) * t)
    if name == "pendulum":
        theta = rng.uniform(-9.0, 9.0, (n, 1)) * left
        observations = np.stack([np.cos(theta), np.sin(theta), np.gradient(theta, t, axis=1)], -1)
    else:
        phase = rng.uniform(-np.pi, np.pi, (n, 1)) + 2.0 * t
        wanted = np.stack([np.cos(phase), np.sin(phase), 0 * phase], -1) * (name == "circle")
        position = wanted + rng.uniform(-2, 2, (n, 1, 3)) * left[..., None]
        attitude = rotations(rng.uniform(0.5, 3.0, (n, 1)) * left, rng.normal(size=3)).reshape(n, -1, 9)
        rate = rng.normal(size=(n, steps + 1, 3)) * left[..., None]
        observations = np.concatenate([attitude, position, np.gradient(position, t, axis=1), rate], -1)
    actions = rng.normal(size=(n, steps, 1 if name == "pendulum" else 4)).clip(-1.0, 1.0)
    starts = [*STARTS, *range(1, 1000)][:n]
    return Recording(starts, observations.astype(np.float32), actions.astype(np.float32))


def data_of(page: str) -> dict[str, Any]:
    """What the page's scripts are told."""
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)


def column(values: list[Any]) -> Array:
    return np.array(values, float)  # null: NaN


# What the page holds


@each_task
def test_the_page_holds_the_flights(name: str) -> None:
    task, flown = tasks.load(name), made_up(name)
    data = data_of(viewer.page(task, "mine", flown))
    found = measures.of_flights(task, flown.observations)
    assert [flight["start"] for flight in data["flights"]] == list(STARTS)
    assert data["period_s"] == task.control_period_s
    assert (data["end_s"], data["tail_s"]) == (task.evaluation.duration_s, task.evaluation.tail_s)
    for i, flight in enumerate(data["flights"]):
        seen = flown.observations[i].astype(float)
        assert flight["samples"] == len(seen)
        assert flight["success"] == found.success[i]
        last, *others = flight["panels"][::-1]
        if name == "pendulum":
            theta = np.arctan2(seen[:, 1], seen[:, 0])
            np.testing.assert_allclose(flight["angle_rad"], theta, atol=1e-4)
            turned = np.array(others[1][0]) - theta
            np.testing.assert_allclose(turned, 2 * np.pi * np.round(turned / (2 * np.pi)), atol=1e-3)
            np.testing.assert_allclose(others[0][0], seen[:, 2], atol=1e-3)
            np.testing.assert_allclose(last[0], 2.0 * flown.actions[i, :, 0], atol=1e-3)
            continue
        np.testing.assert_allclose(np.transpose(flight["position_m"]), seen[:, 9:12], atol=1e-4)
        body_to_world = seen[:, :9].reshape(-1, 3, 3)
        np.testing.assert_allclose(np.transpose(flight["forward"]), body_to_world[:, :, 0], atol=1e-4)
        np.testing.assert_allclose(np.transpose(flight["up"]), body_to_world[:, :, 2], atol=1e-4)
        x, y, z, vx, vy, vz = seen[:, 9:15].T
        speed, distance = np.sqrt(vx**2 + vy**2 + vz**2), np.sqrt(x**2 + y**2 + z**2)
        if name == "circle":
            speed, distance = (x * vy - y * vx) / np.hypot(x, y), np.hypot(np.hypot(x, y) - 1.0, z)
        np.testing.assert_allclose(others[1][0], speed, atol=2e-3)
        np.testing.assert_allclose(others[0][0], distance, atol=1e-4)
        thrust = np.clip(0.667 * 9.81 / 4 + 6.0 * flown.actions[i], 0.0, 8.0)
        np.testing.assert_allclose(np.transpose(last), thrust, atol=5e-3)


@each_task
def test_the_kernels_flights_are_beside(name: str) -> None:
    task, flown, other = tasks.load(name), made_up(name), made_up(name, seed=1)
    data = data_of(viewer.page(task, "mine", flown._replace(beside=other.observations)))
    alone = data_of(viewer.page(task, "mine", other))
    for flight, same in zip(data["flights"], alone["flights"], strict=True):
        for panel, known in zip(flight["panels"][:-1], same["panels"][:-1], strict=True):
            np.testing.assert_allclose(column(panel[1]), column(known[0]), atol=2e-3)
        if name != "pendulum":
            assert flight["beside_m"] == same["position_m"]
    assert [line["name"] for line in data["panels"][0]["lines"]] == ["float", "kernel"]


def test_the_speed_of_a_clockwise_circle_has_an_axis_the_right_way_up() -> None:
    wanted = {"reward": {"speed_m_s": -2.0}}
    task = tasks.from_data({"extend": "circle", **wanted, "evaluation": wanted}, "mine")
    flown = made_up("circle")
    flown.observations[..., [10, 13]] *= -1.0  # mirrored: the flights are clockwise too
    low, high = data_of(viewer.page(task, "mine", flown))["panels"][0]["limits"]
    assert -6.5 < low <= -3.0 < high < 2.5


def test_motors_are_told_apart_by_their_place() -> None:
    data = data_of(viewer.page(tasks.load("hover"), "mine", made_up("hover")))
    motors, lines = data["vehicle"]["motors"], data["panels"][-1]["lines"]
    assert [motor["color"] for motor in motors] == [line["color"] for line in lines]
    assert len({motor["color"] for motor in motors}) == 4
    for motor, line in zip(motors, lines, strict=True):
        x, y = motor["position_m"]
        assert line["description"] == f"the {'front' if x > 0 else 'rear'} {'left' if y > 0 else 'right'} motor"
        assert line["name"].endswith({(1, 1): "↖", (-1, 1): "↙", (-1, -1): "↘", (1, -1): "↗"}[np.sign(x), np.sign(y)])
        assert (motor["color"] in viewer.FRONT) == (x > 0)


@each_task
def test_a_flight_that_ends_early(name: str) -> None:
    flown = made_up(name)
    flown.observations[1, 41:] = np.nan
    ended, whole = data_of(viewer.page(tasks.load(name), "mine", flown))["flights"][1::-1]
    assert (ended["samples"], ended["success"]) == (41, False)
    assert ended["outcome"] == f"fails: ends after {41 * tasks.load(name).control_period_s:.2f} s"
    first = ended["panels"][0][0]
    assert np.isfinite(column(first[:41])).all()
    assert first[41:] == [None] * (len(first) - 41)
    assert whole["samples"] == flown.observations.shape[1]


@each_task
def test_a_page_of_any_size_is_small(name: str) -> None:
    """The most that `qrl view` takes, and flights of thousands of samples: every so many are left out."""
    flown = made_up(name, 50)
    page = viewer.page(tasks.load(name), "mine", flown)
    assert len(page.encode()) <= MOST_BYTES
    data = data_of(page)
    stride = round(data["period_s"] / tasks.load(name).control_period_s)
    samples = flown.observations.shape[1]
    assert stride == -(-50 * samples // viewer.MAX_SAMPLES)
    assert [len(flight["panels"][0][0]) for flight in data["flights"]] == [-(-samples // stride)] * 50
    assert data["flights"][0]["samples"] == -(-samples // stride)


def test_nothing_is_fetched() -> None:
    page = viewer.page(tasks.load("circle"), "mine", made_up("circle"))
    assert viewer.POLICY.startswith("default-src 'none';")
    assert "connect-src" not in viewer.POLICY
    assert f'Content-Security-Policy" content="{viewer.POLICY.replace(chr(39), "&#x27;")}"' in page
    ours = page.replace(resources.files("plotly").joinpath("package_data/plotly.min.js").read_text("utf-8"), "")
    assert len(ours) < len(page) - 4e6
    assert not re.findall(r"""https?:|//\w+\.\w|@import|url\(|\bsrc=|\bhref=|fetch\(|import\(""", ours)


def test_a_title_is_text_and_no_markup() -> None:
    odd = tasks.load("hover").model_copy(update={"description": "</script><b>{{data}} & {{library}}"})
    page = viewer.page(odd, "<i>{{script}}", made_up("hover"))
    assert page.count("</script>") == 3
    assert data_of(page)["description"] == odd.description
    assert "<title>&lt;i&gt;{{script}}</title>" in page


# The command


def view(*words: str | Path) -> dict[str, Any]:
    assert qrl("view", *words) == 0
    run, out = Path(words[0]), [Path(words[i + 1]) for i, word in enumerate(words) if word == "--out"]
    return data_of((out[0] if out else run / "view.html").read_text(encoding="utf-8"))


def test_the_flights_are_those_of_evaluate(trained: Path, tmp_path: Path) -> None:
    """All 1,000 of them flown as `qrl export` does; the starts asked for are the ones of these indices."""
    run = shutil.copytree(trained, tmp_path / "run")
    data = view(run, "--starts", "917", "3", "917")
    flights = TrainedRun.load(run).fly(evaluation_starts())
    assert [flight["start"] for flight in data["flights"]] == [917, 3]
    for flight in data["flights"]:
        seen = flights.observations[flight["start"]]
        np.testing.assert_allclose(np.cos(flight["angle_rad"]), seen[:, 0], atol=1e-3)
        np.testing.assert_allclose(np.sin(flight["angle_rad"]), seen[:, 1], atol=1e-3)
        np.testing.assert_allclose(flight["panels"][-1][0], 2.0 * flights.actions[flight["start"], :, 0], atol=3e-3)
    saved = max(int(path.name) for path in (run / "checkpoints").iterdir())
    assert data["title"] == f"pendulum, seed 0, step {saved:,}"


def test_the_kernel_is_that_of_an_export(trained: Path, tmp_path: Path) -> None:
    run = shutil.copytree(trained, tmp_path / "run")
    data = view(run, "--starts", "917", "--kernel")
    steps = TrainedRun.load(run)
    flights = fly_kernel(steps, policy := steps.policy(), quantize(policy), evaluation_starts()[np.full(8, 917)])
    seen, (flight,) = flights.observations[0], data["flights"]
    np.testing.assert_allclose(flight["panels"][1][1], seen[:, 2], atol=1e-3)
    assert np.abs(np.array(flight["panels"][1][0]) - seen[:, 2]).max() > 0  # not the float policy's


def test_starts_that_fail_come_first(trained: Path, tmp_path: Path) -> None:
    run = shutil.copytree(trained, tmp_path / "run")
    starts = [flight["start"] for flight in view(run, "--out", tmp_path / "page.html")["flights"]]
    assert starts == [0, 1, 2, 3, 4, 5, 6, 7]
    assert not (run / "view.html").exists()
    files.write_json(run / "evaluation.json", {"failures": [{"start": 500}, {"start": 2}, {"start": 5000}]})
    assert [flight["start"] for flight in view(run)["flights"]] == [500, 2, 0, 1, 3, 4, 5, 6]
    for odd in ("[]", '{"failures": [{"begin": 1}]}', '{"failures": 3}', "no JSON"):
        (run / "evaluation.json").write_text(odd)
        assert [flight["start"] for flight in view(run)["flights"]] == starts


def test_each_seed_has_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = untrained(tmp_path / "two", "pendulum", "--seeds", "2", "--seed", "5")
    assert qrl("view", run, "--starts", "1") == 0
    one, other = (data_of((run / f"seed-{seed}" / "view.html").read_text("utf-8")) for seed in (5, 6))
    assert "seed 6" in other["title"]
    assert one["flights"][0]["start"] == other["flights"][0]["start"] == 1
    assert one["flights"][0]["panels"][-1] != other["flights"][0]["panels"][-1]
    assert "--out: holds 2 seeds" in complaint(capsys, "view", run, "--out", tmp_path / "page.html")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--starts", "1000"], "--starts: expected indices below 1,000, found 1000"),
        (["--starts", *(str(i) for i in range(51))], "at most 50 of them, found 51"),
        (["--starts", "-1"], "--starts"),
        (["--starts", "few"], "few"),
        (["--start", "1"], "--starts"),
    ],
)
def test_wrong_starts_are_refused(
    words: list[str], says: str, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in complaint(capsys, "view", trained, *words)


def test_what_is_no_run_of_ours_is_refused(
    trained_foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "not a run folder" in complaint(capsys, "view", tmp_path)
    run = shutil.copytree(trained_foreign, tmp_path / "run")
    assert "expected a run of one of our own tasks, found another environment, 'fast'" in complaint(capsys, "view", run)
    shutil.rmtree(run / "checkpoints")
    config = json.loads((run / "config.json").read_text())
    config["task"] = {"name": "pendulum", "spec": tasks.load("pendulum").model_dump(mode="json", exclude_none=True)}
    files.write_json(run / "config.json", config)
    assert "no checkpoint" in complaint(capsys, "view", run)


# In a browser


@pytest.fixture(scope="module")
def chromium() -> Iterator[webdriver.Chrome]:
    need(browser.missing())
    with browser.chromium({"browser": "ALL", "performance": "ALL"}) as driver:
        yield driver


class Shown:
    """A page in the browser."""

    def __init__(self, driver: webdriver.Chrome, path: Path) -> None:
        self.driver, self.path = driver, path

    def open(self, address: str = "") -> None:
        """Load the page anew, and wait until its first start is drawn."""
        self.driver.get("about:blank")
        for kind in ("browser", "performance"):
            self.driver.get_log(kind)  # what was before is not this page's
        wrong = browser.drawn(self.driver, f"{self.path.as_uri()}{address}")
        assert wrong is None, wrong

    def ask(self, expression: str) -> Any:
        return self.driver.execute_script(f"return {expression}")

    def until(self, condition: str | Callable[[], bool]) -> None:
        """An expression of the page, or a function: what has been asked of the drawing is seen some frames later."""
        end = time.monotonic() + 120
        while not (condition() if callable(condition) else self.ask(condition)):
            assert time.monotonic() < end, f"never: {condition}"
            time.sleep(0.05)

    def seek(self, time_s: float) -> None:
        """As a user who moves the slider."""
        drawn = self.ask("qrlView.state.frames")
        self.driver.execute_script(
            "const slider = document.getElementById('scrub'); slider.value = arguments[0];"
            "slider.dispatchEvent(new Event('input'))",
            time_s,
        )
        self.until(f"qrlView.state.frames > {drawn}")

    def find(self, css: str) -> Any:
        return self.driver.find_element(By.CSS_SELECTOR, css)

    def size(self, width: int, height: int) -> None:
        """Until the drawing fills the new window."""
        browser.size(self.driver, width, height)
        self.until("document.querySelector('#scene .main-svg').clientWidth === $('scene').clientWidth")

    def pixels(self, css: str) -> Array:
        """What an element looks like, [height, width, 3] of 0 … 255."""
        browser.wait_for(self.driver, browser.NEXT_FRAME)
        picture = image.imread(io.BytesIO(self.find(css).screenshot_as_png), format="png")
        return np.round(255 * picture[..., :3]).astype(int)

    def until_changed(self, css: str, before: Array) -> None:
        """Until an element looks different from what it did, in more than 300 pixels."""
        self.until(lambda: (np.abs(self.pixels(css) - before).max(axis=-1) > 30).sum() > 300)

    def cursors(self) -> list[float]:
        return self.ask("[...document.querySelectorAll('.cursor')].map(c => c.getBoundingClientRect().left)")

    def errors(self) -> list[str]:
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def requests(self) -> list[str]:
        """What the page asked for, beside itself."""
        messages = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        sent = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
        return [url for url in sent if not url.startswith(("data:", "blob:", self.path.as_uri()))]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """The page of made-up flights of a task, in a folder whose name has to be quoted in an address."""
    folder = tmp_path_factory.mktemp("a page #1")

    def built(name: str) -> Path:
        path = folder / f"{name}.html"
        if not path.exists():
            path.write_text(viewer.page(tasks.load(name), f"{name}, made up", made_up(name)), encoding="utf-8")
        return path

    return built


@pytest.fixture(scope="module")
def page(chromium: webdriver.Chrome, build: Build, request: pytest.FixtureRequest) -> Shown:
    """Loading takes longest: once for all tests of a page, where one process runs them."""
    page = Shown(chromium, build(request.param))
    page.open()
    return page


@pytest.fixture
def shown(page: Shown) -> Shown:
    """The page as it is opened."""
    if page.ask("document.getElementById('follow').checked"):
        page.find("#follow").click()
    browser.wait_for(page.driver, f"qrlView.choose({STARTS[0]}, 0)")
    return page


@pytest.fixture
def small_window(shown: Shown) -> Iterator[None]:
    """For what plays: a processor draws it, pixel by pixel."""
    shown.size(480, 360)
    yield
    shown.size(browser.WIDTH, browser.HEIGHT)


def parts_of(pixels: Array) -> int:
    """How many colors there are."""
    return len(np.unique(pixels.reshape(-1, 3), axis=0))


def of_color(pixels: Array, color: str, near: int = 40) -> int:
    """How many pixels are close to a color "#rrggbb"."""
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(pixels - wanted).max(axis=-1) <= near).sum())


each_page = pytest.mark.parametrize("page", TASKS, indirect=True, scope="module")
each_vehicle = pytest.mark.parametrize("page", ["hover", "pendulum"], indirect=True, scope="module")


@each_page
def test_it_is_drawn(shown: Shown) -> None:
    shown.seek(0.5)
    scene = shown.pixels("#scene")
    assert parts_of(scene) > 100
    assert scene.std() > 5
    motors = shown.ask("qrlView.page.vehicle?.motors.map(m => m.color)") or ["#3a3f45", "#D55E00"]
    assert min(of_color(scene, color) for color in motors) > 20
    assert of_color(scene, "#9fdcc8" if shown.ask("!!qrlView.page.vehicle") else "#bfe7dc", 60) > 200  # where to be
    for i in (1, 2, 3):
        assert parts_of(shown.pixels(f".panel:nth-of-type({i}) .plot")) > 30
    titles = shown.ask("[...document.querySelectorAll('.annotation-text, .xtitle')].map(t => t.textContent)")
    units = [re.fullmatch(r".+ \[(.+)\]", title) for title in titles]
    assert all(units)
    assert len(titles) >= 4
    assert shown.errors() == []
    assert shown.requests() == []


@each_vehicle
def test_scrubbing_moves_all_of_it(shown: Shown) -> None:
    before, place, cursors = shown.pixels("#scene"), shown.ask("qrlView.place()"), shown.cursors()
    shown.seek(1.0)
    moved = np.array(shown.cursors()) - cursors
    width = shown.ask("document.querySelector('.plot').clientWidth") - 72
    np.testing.assert_allclose(moved, width / shown.ask("qrlView.page.end_s"), atol=1.0)
    flight = shown.ask("qrlView.page.flights[0]")
    k = round(1.0 / shown.ask("qrlView.page.period_s"))
    if "angle_rad" in flight:
        angle = flight["angle_rad"][k]
        np.testing.assert_allclose(shown.ask("qrlView.place()"), [-np.sin(angle), np.cos(angle)], atol=1e-3)
    else:
        assert np.linalg.norm(np.subtract(shown.ask("qrlView.place()"), np.transpose(flight["position_m"])[k])) < 0.3
    assert shown.ask("qrlView.place()") != place
    shown.until_changed("#scene", before)
    assert f"1.00 / {shown.ask('qrlView.page.end_s'):.2f} s" == shown.find("#clock").text
    said = shown.ask("[...document.querySelectorAll('.panel h2 span')].map(s => s.textContent)")
    values = [column[k] for panel in flight["panels"] for column in panel]
    numbers = [float(re.findall(r"−?[\d.]+(?= \S)", text)[-1].replace("−", "-")) for text in said]
    np.testing.assert_allclose(numbers, values, atol=6e-3)
    assert shown.errors() == []


@pytest.mark.parametrize("page", ["hover"], indirect=True, scope="module")
def test_it_plays_and_pauses(shown: Shown, small_window: None) -> None:
    def rate(text: str) -> None:
        Select(shown.find("#rate")).select_by_visible_text(text)
        shown.driver.execute_script("document.activeElement.blur()")

    rate("×0.25")  # so that it is not over before a slow machine comes to press a key
    begun = time.monotonic()
    ActionChains(shown.driver).send_keys(" ").perform()
    shown.until("qrlView.state.time > 0.2")
    ActionChains(shown.driver).send_keys(" ").perform()
    shown.until("!qrlView.state.playing")
    stopped = shown.ask("qrlView.state.time")
    assert 0.2 < stopped <= 0.25 * (time.monotonic() - begun)
    assert shown.ask("qrlView.state.frames") > 3
    time.sleep(0.3)
    assert shown.ask("qrlView.state.time") == stopped
    rate("×4")
    shown.seek(7.9)
    shown.find("#play").click()
    shown.until("!qrlView.state.playing")
    assert shown.ask("qrlView.state.time") == pytest.approx(8.0)
    rate("×0.25")
    shown.find("#play").click()  # from the start again
    shown.until("qrlView.state.time < 6")
    shown.find("#play").click()
    rate("×1")
    assert shown.errors() == []


@each_vehicle
def test_another_start_is_another_scene(shown: Shown) -> None:
    before, place = shown.pixels("#scene"), shown.ask("qrlView.place()")
    charts = shown.pixels("#charts")
    Select(shown.find("#start")).select_by_value("917")
    shown.until("qrlView.state.flight.start === 917")
    shown.until("location.hash === '#start=917&t=0'")
    assert shown.ask("qrlView.place()") != place
    shown.until_changed("#scene", before)
    shown.until_changed("#charts", charts)
    assert len(Select(shown.find("#start")).options) == 3
    assert shown.errors() == []


@pytest.mark.parametrize("page", ["hover"], indirect=True, scope="module")
def test_an_address_names_start_and_time(shown: Shown) -> None:
    shown.open("#start=0&t=2.5")
    assert shown.ask("[qrlView.state.flight.start, qrlView.state.time]") == [0, 2.5]
    shown.driver.execute_script("location.hash = 'start=4&t=1'")
    shown.until("qrlView.state.flight.start === 4 && qrlView.state.time === 1")
    shown.open("#start=77&t=nonsense")
    assert shown.ask("[qrlView.state.flight.start, qrlView.state.time]") == [4, 0]
    assert shown.errors() == []


@pytest.mark.parametrize("page", ["hover"], indirect=True, scope="module")
def test_a_click_in_a_plot_jumps_there(shown: Shown) -> None:
    plot = shown.find(".panel:nth-of-type(2) .plot")
    ActionChains(shown.driver).move_to_element(plot).click().perform()
    shown.until("qrlView.state.time > 0")
    left, right = 62, 10  # margins
    middle = (plot.rect["width"] / 2 - left) / (plot.rect["width"] - left - right) * 8.0
    assert shown.ask("qrlView.state.time") == pytest.approx(middle, abs=0.05)


@pytest.mark.parametrize("page", ["circle"], indirect=True, scope="module")
def test_the_camera_follows(shown: Shown) -> None:
    """Near the vehicle, whose motors are then larger, and along with it; back to where it was."""
    center = "document.getElementById('scene').layout.scene.camera.center"
    colors = shown.ask("qrlView.page.vehicle.motors.map(m => m.color)")

    def motors() -> int:
        seen = shown.pixels("#scene")
        return sum(of_color(seen, color) for color in colors)

    far = motors()
    shown.find("#follow").click()
    shown.until(lambda: motors() > 3 * far)
    near, before = motors(), shown.ask(center)
    shown.seek(1.0)
    assert shown.ask(center) != before
    shown.find("#follow").click()
    shown.until(lambda: near > 3 * motors())
    assert shown.errors() == []


@each_vehicle
def test_it_fits_the_window(shown: Shown) -> None:
    """A laptop's, and then a phone's, on which a page scrolls."""
    try:
        for width, height in ((1280, 800), (390, 844)):
            shown.size(width, height)
            page = shown.ask("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
            assert page[0] <= width
            assert page[1] <= height or width == 390
            for css in ("#play", "#scrub", "#clock", "#start", "#scale"):
                box = shown.find(css).rect
                assert 0 <= box["x"] < box["x"] + box["width"] <= width + 0.5, css
            drawing, caption = shown.find("#scene .main-svg").rect, shown.find("#scale").rect
            assert drawing["y"] + drawing["height"] <= caption["y"] + 1
    finally:
        shown.size(browser.WIDTH, browser.HEIGHT)

"""Pictures of flights and learning curves, drawn on made-up data and read back from the PNG and from the axes."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qrl.runs import learning_curve
from qrl_envs import task
from qrl_envs.plots import errors as errors_of
from qrl_envs.plots import flights as flights_of
from qrl_envs.plots import frame, settle

Array = np.ndarray
Row = dict[str, float | str]

TASKS = ("hover", "circle", "pendulum")
FLIGHTS, SAMPLES = 21, 101  # n, K + 1: the same throughout, so that what JAX compiles is compiled once
each_task = pytest.mark.parametrize("name", TASKS)


def approach(name: str, n: int = FLIGHTS, seed: int = 0) -> Array:
    """Flights [n, SAMPLES, F] that begin anywhere and approach the wanted motion, each at its own pace."""
    rng = np.random.default_rng(seed)
    t = np.arange(SAMPLES) * (0.05 if name == "pendulum" else 0.01)
    left = np.exp(-rng.uniform(1.0, 4.0, (n, 1)) * t)
    if name == "pendulum":
        theta = rng.uniform(-np.pi, np.pi, (n, 1)) * left + 2 * np.pi * rng.integers(-1, 2, (n, 1)) * left
        return np.stack([np.cos(theta), np.sin(theta), np.gradient(theta, t, axis=1)], -1)
    phase = rng.uniform(-np.pi, np.pi, (n, 1)) + 2.0 * t
    wanted = np.stack([np.cos(phase), np.sin(phase), 0 * phase], -1) * (name == "circle")
    position = wanted + rng.uniform(-2, 2, (n, 1, 3)) * left[..., None]
    flights = np.zeros((n, SAMPLES, 18))
    flights[..., 8] = np.cos(rng.uniform(0, np.pi, (n, 1)) * left)
    flights[..., 9:12], flights[..., 12:15] = position, np.gradient(position, t, axis=1)
    return flights


def with_faults(flights: Array) -> Array:
    """The first flight without a single number, the next two with NaN and infinity from some time on."""
    flights = flights.copy()
    flights[0], flights[1, 20:], flights[2, 30:] = np.nan, np.nan, np.inf
    return flights


def is_picture(path: Path) -> bool:
    pixels = image.imread(path)
    height, width, _ = pixels.shape
    return (
        path.read_bytes().startswith(b"\x89PNG\r\n")
        and 1000 <= width <= 2000
        and 400 <= height <= 1500
        and float(pixels[..., :3].std()) > 0.05
    )


def can_be_drawn(figure: Figure) -> bool:
    figure.set_layout_engine("none")  # which takes the longest
    figure.draw_without_rendering()
    return True


def lines(axes: Axes, label: str) -> list[Array]:
    """The y data of all lines in `axes` that bear `label`."""
    return [np.asarray(line.get_ydata(), float) for line in axes.lines if line.get_label() == label]


def drawn(axes: Axes) -> list[Array]:
    """The y data of the lines in `axes` that have a point for each sample."""
    return [y for line in axes.lines if (y := np.asarray(line.get_ydata(), float)).shape == (SAMPLES,)]


def tolerances(figure: Figure) -> list[list[float]]:
    return [sorted(float(y[0]) for y in lines(axes, "tolerance")) for axes in figure.axes]


def band(axes: Axes, x: float) -> tuple[float, float]:
    """The filled band's lowest and highest vertex at `x`."""
    vertices = np.asarray(axes.collections[0].get_paths()[0].vertices)
    y = vertices[np.isclose(vertices[:, 0], x), 1]
    return y.min(), y.max()


@each_task
@pytest.mark.parametrize("draw", [flights_of.draw, errors_of.draw])
def test_a_picture_is_drawn_whatever_the_numbers(name: str, draw, tmp_path: Path) -> None:
    draw(tmp_path / "a.png", task.load(name), with_faults(approach(name)))
    assert is_picture(tmp_path / "a.png")


@pytest.mark.filterwarnings("error")
@each_task
def test_nothing_but_faults(name: str) -> None:
    nothing = np.full(approach(name).shape, np.nan)
    assert flights_of.figure(task.load(name), nothing).axes[1].get_title() == "0 of 21 flights succeed"
    assert max(drawn(errors_of.figure(task.load(name), nothing).axes[-1])[0]) == 0.0


def test_one_flight_is_enough() -> None:
    odd = task.load("circle").model_copy(update={"description": "a title is no mathematics: $\\frac$"})
    figure = flights_of.figure(odd, approach("circle", 1))
    assert can_be_drawn(figure)
    assert figure.axes[0].get_title() == ""
    assert errors_of.figure(task.load("circle"), approach("circle", 1)).axes[0].get_title() == "all 1 flights"


def test_the_title_says_the_task_and_the_counts() -> None:
    flights = with_faults(np.zeros((FLIGHTS, SAMPLES, 18)))
    figure = flights_of.figure(task.load("hover"), flights)
    assert figure.get_suptitle() == f"hover: {task.load('hover').description}"
    assert [axes.get_title() for axes in figure.axes[:2]] == ["the first 5 of 21 flights", "18 of 21 flights succeed"]


OTHER: dict[str, tuple[dict, list[list[float]], list[list[float]]]] = {  # task file; lines in flights, in errors
    "hover": ({"evaluation": {"distance_m": 0.25}}, [[], [0.25], []], [[0.25], []]),
    "circle": (
        {
            "reward": {"speed_m_s": 1.5, "radius_m": 1.25},
            "evaluation": {"distance_m": 0.3, "speed_m_s": 0.5, "reward": {"speed_m_s": 1.5, "radius_m": 1.25}},
        },
        [[], [0.3], [1.0, 2.0]],
        [[0.3], [0.3], [0.5], []],
    ),
    "pendulum": (
        {"evaluation": {"angle_rad": 0.2, "rate_rad_s": 0.4}},
        [[], [-0.2, 0.2], [-0.4, 0.4]],
        [[0.2], []],
    ),
}


@each_task
def test_tolerances_are_the_tasks(name: str) -> None:
    changes, in_flights, in_errors = OTHER[name]
    other = task.from_data({"extend": name, **changes}, "other.json")
    figure = flights_of.figure(other, approach(name))
    assert tolerances(figure) == in_flights
    assert tolerances(errors_of.figure(other, approach(name))) == in_errors
    for line in figure.axes[0].lines:
        if line.get_label() == "target circle":
            np.testing.assert_allclose(np.linalg.norm(line.get_xydata(), axis=1), 1.25)


def test_what_is_drawn_is_what_was_flown() -> None:
    flights = approach("circle")
    above, distance, speed = flights_of.figure(task.load("circle"), flights).axes
    x, y, z, vx, vy = np.moveaxis(flights[:5, :, 9:14], -1, 0)
    np.testing.assert_allclose(drawn(above), y, rtol=1e-5)
    wanted = np.hypot(np.hypot(x, y) - 1, z)
    np.testing.assert_allclose(drawn(distance), np.maximum(wanted, distance.get_ylim()[0]), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(drawn(speed), (x * vy - y * vx) / np.hypot(x, y), rtol=1e-3, atol=1e-4)


def test_a_start_upside_down_is_marked() -> None:
    flights = approach("hover")
    flights[:5, 0, 8] = [0.9, -0.9, -0.2, -1.0, np.nan]
    upright, upside_down = flights_of.figure(task.load("hover"), flights).axes[0].collections
    np.testing.assert_allclose(upright.get_offsets(), flights[:1, 0, 9:11])
    np.testing.assert_allclose(upside_down.get_offsets(), flights[1:4, 0, 9:11])


def test_no_line_jumps_where_the_angle_wraps() -> None:
    t = np.linspace(0, 1, SAMPLES)
    theta = np.stack([9 * np.sin(5 * t), np.pi + 0.05 * np.sin(90 * t + 1)])  # round and round; to and fro at the seam
    flights = np.full((FLIGHTS, SAMPLES, 3), np.nan)
    flights[:2] = np.stack([np.cos(theta), np.sin(theta), np.gradient(theta, t, axis=1)], -1)
    portrait, angle, _ = flights_of.figure(task.load("pendulum"), flights).axes
    copies = np.array(drawn(angle))
    assert np.abs(np.diff(copies, axis=1)).max() < 1.0
    jumps = [np.abs(np.diff(np.asarray(line.get_xdata(), float))).max(initial=0.0) for line in portrait.lines]
    assert max(jumps) < 1.0
    # Each sample of both flights is in view, once.
    wrapped = np.arctan2(np.sin(theta), np.cos(theta))
    np.testing.assert_array_equal((np.abs(copies) <= np.pi + 1e-9).sum(axis=0), 2)
    for one in wrapped:
        assert np.abs(copies - one).min(axis=0).max() < 1e-5


def test_errors_are_ranked_over_all_flights_by_their_size() -> None:
    height = np.linspace(0.2, 2.2, FLIGHTS)  # so that 5 %, 50 % and 95 % fall on flights
    height[::2] *= -1.0
    flights = approach("circle")
    flights[..., 11] = np.random.default_rng(0).permutation(height)[:, None]
    axes = errors_of.figure(task.load("circle"), flights).axes[1]
    assert axes.get_ylabel() == "height error [m]"
    np.testing.assert_allclose(lines(axes, "median flight")[0], 1.2, rtol=1e-6)
    np.testing.assert_allclose(band(axes, 0.5), (0.3, 2.1), rtol=1e-6)


def test_a_fault_ranks_last() -> None:
    flights = np.zeros((FLIGHTS, SAMPLES, 18))
    flights[..., 9] = 0.05
    flights[10:, 30:] = np.nan
    axes = errors_of.figure(task.load("hover"), flights).axes[0]
    (median,) = lines(axes, "median flight")
    np.testing.assert_allclose(median[:30], 0.05, rtol=1e-6)
    np.testing.assert_allclose(median[30:], axes.get_ylim()[1])


def test_settled_is_a_share_of_all_starts() -> None:
    flights = np.zeros((FLIGHTS, SAMPLES, 18))
    flights[:, :, 9] = 1.0
    flights[0, 30:, 9] = flights[1, 60:, 9] = 0.0
    flights[2, 20:80, 9] = 0.0  # leaves again
    flights[3, :, 9], flights[3, 10, 9] = 0.0, np.nan
    (share,) = drawn(errors_of.figure(task.load("hover"), flights).axes[-1])
    np.testing.assert_allclose(share[[0, 29, 30, 59, 60, 100]], np.array([0, 0, 1, 1, 2, 2]) * 100 / FLIGHTS)


def test_others_are_drawn_beside_by_their_medians() -> None:
    """Of another that is twice as far off at each time; its share settled is its own."""
    flights, other = np.zeros((FLIGHTS, SAMPLES, 18)), np.zeros((FLIGHTS, SAMPLES, 18))
    flights[..., 9], other[..., 9] = 0.05, 0.2
    distance, share = errors_of.figure(task.load("hover"), flights, {"another": other}).axes
    np.testing.assert_allclose(lines(distance, "median of another")[0], 0.2, rtol=1e-6)
    np.testing.assert_allclose(lines(distance, "median flight")[0], 0.05, rtol=1e-6)
    assert lines(share, "median of another")[0].max() == 0.0
    assert drawn(share)[0].min() == 100.0


def test_a_path_is_told_by_as_little_of_its_end_as_tells_it_apart() -> None:
    flights = np.zeros((FLIGHTS, SAMPLES, 18))
    others = dict.fromkeys(["experiments/out/gallery/circle-ppo", "a/b", "runs/a/b"], flights)
    figure = errors_of.figure(task.load("hover"), flights, others)
    labels = {line.get_label() for axes in figure.axes for line in axes.lines}
    assert {"median of circle-ppo", "median of a/b", "median of runs/a/b"} <= labels


def test_the_map_has_medians_by_tilt_and_speed() -> None:
    """In the cell of their start; with too few flights it is empty, and half that never settle make it infinite."""
    tilt = np.array([1.0, 2.0, 3.0, 170.0, 180.0, 175.0, 40.0, 40.0])
    speed = np.array([0.1, 0.2, 0.3, 0.9, 0.9, 0.9, 0.1, 0.1])
    settled = np.array([1.0, 5.0, 2.0, 3.0, np.inf, np.inf, 1.0, 1.0])
    cells = settle.medians(tilt, speed, settled, np.array([0.0, 0.5, 1.0]))
    assert cells[0, 0] == 2.0
    assert np.isposinf(cells[1, -1])
    assert np.isnan(cells).sum() == cells.size - 2


@pytest.mark.filterwarnings("error")
def test_the_map_marks_the_starts_that_fail(tmp_path: Path) -> None:
    flights = approach("hover")
    flights[..., 9:12] = 0.0
    flights[4:7, :, 9] = 5.0
    (marks,) = settle.figure(task.load("hover"), flights).axes[0].lines
    tilt = np.degrees(np.arccos(flights[4:7, 0, 8]))
    np.testing.assert_allclose(marks.get_xdata(), tilt)
    np.testing.assert_allclose(marks.get_ydata(), np.linalg.norm(flights[4:7, 0, 12:15], axis=1))
    settle.draw(tmp_path / "a.png", task.load("hover"), with_faults(flights))
    assert is_picture(tmp_path / "a.png")
    assert can_be_drawn(settle.figure(task.load("hover"), np.full((3, SAMPLES, 18), np.nan)))


def rows(returns: list[float], success: list[float | str] | None = None, every: float = 1e5) -> list[Row]:
    """Rows of metrics.csv, as text where it comes from a file."""
    table: list[Row] = [
        {"env_steps": str(int((i + 1) * every)), "return_mean": str(mean), "return_min": mean - 20.0}
        for i, mean in enumerate(returns)
    ]
    for row, share in zip(table, success or [], strict=False):
        row["success"] = share
    return table


def test_a_learning_curve_is_drawn(tmp_path: Path) -> None:
    learning_curve.learning_curve(tmp_path / "a.png", [rows([1.0, 50.0, 90.0], ["0.0", "0.5", "1.0"])], "hover, seed 0")
    assert is_picture(tmp_path / "a.png")


def test_a_single_row_is_enough() -> None:
    figure = learning_curve.learning_curve_figure([rows([3.0], ["0.5"])], "one report")
    assert can_be_drawn(figure)
    for axes, value in zip(figure.axes, (3.0, 0.5), strict=True):
        np.testing.assert_array_equal(axes.lines[-1].get_xydata(), [[1e5, value]])
        assert axes.lines[-1].get_marker() == "o"  # a line through one point is not to be seen


@pytest.mark.parametrize("success", [None, ["", ""], [float("nan")], ["nan", ""]])
def test_no_success_no_panel(success: list[float | str] | None) -> None:
    assert len(learning_curve.learning_curve_figure([rows([3.0, 4.0], success)], "foreign environment").axes) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "runs", [[], [[], rows([1.0, 2.0])], [rows([np.nan, np.inf])], [[{"env_steps": 0.0, "return_mean": 1.0}]]]
)
def test_hardly_any_row(runs: list[list[Row]]) -> None:
    assert can_be_drawn(learning_curve.learning_curve_figure(runs, "a title is no mathematics: $\\frac$"))


def test_of_one_seed_the_worst_flight_is_drawn_too() -> None:
    (axes,) = learning_curve.learning_curve_figure([rows([1.0, 50.0, 90.0])], "one seed").axes
    np.testing.assert_array_equal(lines(axes, "worst flight")[0], [-19.0, 30.0, 70.0])
    np.testing.assert_array_equal(lines(axes, "mean of flights")[0], [1.0, 50.0, 90.0])


def test_the_band_covers_the_seeds() -> None:
    returns = np.random.default_rng(0).normal(size=(5, 8)).cumsum(axis=1)
    success = np.random.default_rng(1).uniform(size=(5, 8))
    runs = [rows(list(mean), list(share)) for mean, share in zip(returns, success, strict=True)]
    runs[4] = runs[4][:6]  # still running
    for axes, values in zip(learning_curve.learning_curve_figure(runs, "five").axes, (returns, success), strict=True):
        values[4, 6:] = np.nan
        for i in range(8):
            assert band(axes, (i + 1) * 1e5) == (np.nanmin(values[:, i]), np.nanmax(values[:, i]))
        np.testing.assert_allclose(lines(axes, "median of 5 seeds")[0], np.nanmedian(values, axis=0))


def test_seeds_that_reported_at_other_times_are_interpolated() -> None:
    steps, values = learning_curve.aligned([rows([0.0, 10.0]), rows([0.0, 5.0, 7.0], every=0.75e5)], "return_mean")
    np.testing.assert_array_equal(steps, [0.75e5, 1e5, 1.5e5, 2e5, 2.25e5])
    np.testing.assert_allclose(values[0], [np.nan, 0, 5, 10, np.nan])
    np.testing.assert_allclose(values[1], [0, 5 / 3, 5, 5 + 4 / 3, 7])


def test_the_speed_of_a_clockwise_circle_is_shown_the_right_way_up() -> None:
    for speed in (2.0, -2.0):
        wanted = {"reward": {"speed_m_s": speed}}
        spec = task.from_data({"extend": "circle", **wanted, "evaluation": wanted}, "mine")
        mirrored = approach("circle") * np.where(np.isin(np.arange(18), (10, 13)), np.sign(speed), 1.0)
        low, high = flights_of.figure(spec, mirrored).axes[2].get_ylim()
        assert min(-speed, 3 * speed) <= low < speed < high <= max(-speed, 3 * speed)


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_arrows_on_the_circle_point_along_the_flight(speed: float) -> None:
    wanted = {"reward": {"speed_m_s": speed}}
    spec = task.from_data({"extend": "circle", **wanted, "evaluation": wanted}, "mine")
    arrows = [each for each in flights_of.figure(spec, approach("circle")).axes[0].texts if each.get_text() == ""]
    for arrow in arrows:
        (x, y), (from_x, from_y) = arrow.xy, arrow.xyann  # pyright: ignore[reportAttributeAccessIssue]
        assert np.sign(from_x * y - from_y * x) == np.sign(speed)
    assert len(arrows) == 2


@pytest.mark.parametrize(("comes_to", "lowest"), [(0.003, 0.001), (1e-9, 2e-5), (0.1, 0.002), (np.nan, 0.002)], ids=str)
def test_a_logarithmic_axis_reaches_down_to_what_the_lines_come_to(comes_to: float, lowest: float) -> None:
    """A third of it, within 1e-4 to 1e-2 of the tolerance, here 0.2 m; not of how they begin."""
    values = np.full((3, SAMPLES), comes_to)
    values[:, :20] = 5.0
    low, high = frame.logarithmic("distance", "m", values, tolerance=0.2).limits
    assert low == pytest.approx(lowest)
    assert high == pytest.approx(6.0)

"""The first flights: their paths, and two quantities over time."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qrl_envs import measures
from qrl_envs.plots.frame import (
    COLORS,
    INK,
    Panel,
    empty,
    finish,
    in_pi,
    legend,
    logarithmic,
    over_time,
    save,
    successes,
)
from qrl_envs.task import CircleReward, PendulumTask, QuadrotorTask, Task

SHOWN = 5  # flights


def draw(path: Path, task: Task, observations: np.ndarray) -> None:
    save(path, figure(task, observations))


def figure(task: Task, observations: np.ndarray) -> Figure:
    """The first flights of `observations` [n, K + 1, F], in SI units. Axes: paths, and two quantities over time."""
    found = measures.of_flights(task, observations)
    shown = np.where(np.isfinite(observations), observations, np.nan)[:SHOWN]
    figure = empty(task, height_in=5.0)
    left, upper, lower = figure.subplot_mosaic("AB;AC", width_ratios=(1.0, 1.2)).values()
    if isinstance(task, PendulumTask):
        _phase_portrait(left, task, shown)
        panels = _pendulum_panels(task, shown)
    else:
        _seen_from_above(left, task, measures.in_world(task, shown))
        panels = _quadrotor_panels(task, shown, found.errors)
    for axes, panel in zip((upper, lower), panels, strict=True):
        times = over_time(axes, task, panel)
        for color, values in zip(COLORS, panel.values, strict=False):
            for line in _turns(values) if panel.scale == "angle" else [values]:
                axes.plot(times, line, color=color, linewidth=1.4)
    finish(left, f"the first {len(shown)} of {len(observations):,} flights" if len(shown) < len(observations) else "")
    finish(upper, successes(found))
    finish(lower)
    legend(figure)
    return figure


# Paths


def _seen_from_above(axes: Axes, task: QuadrotorTask, shown: np.ndarray) -> None:
    """Paths of `shown` [few, K + 1, 18] from above; the triangle at a start points up or down like body z."""
    reward, reach = task.evaluation.reward, 0.0
    for color, path in zip(COLORS, shown[:, :, 9:11], strict=False):
        axes.plot(*path.T, color=color, linewidth=1.4)
    starts, up = shown[:, 0, 9:11], shown[:, 0, 8]  # r33: the body's z axis along the world's
    for marker, label, among in (("^", "start upright", up >= 0), ("v", "start upside down", up < 0)):
        colors = np.array(COLORS)[: len(among)][among]
        axes.scatter(*starts[among].T, c=colors, marker=marker, s=90, edgecolors="white", zorder=4)
        if among.any():
            axes.plot([], [], marker, color=INK, markersize=8, label=label)
    if isinstance(reward, CircleReward):
        _circle(axes, reward)
        reach = reward.radius_m
    elif followed := task.evaluation.reference:
        path = followed.at(np.arange(shown.shape[1]) * task.control_period_s).position_m
        axes.plot(*path.T[:2], "--", color="black", linewidth=1.5, zorder=5, label="reference")
        reach = float(np.abs(path[:, :2]).max())
    else:
        axes.plot(0, 0, "+", color="black", markersize=15, markeredgewidth=2, zorder=5, label="target position")
    # Shows target and starts; distant parts of the paths are cut off.
    extent = np.max(np.abs(shown[:, :, 9:11]), initial=0.0, where=np.isfinite(shown[:, :, 9:11]))
    half = 1.12 * max(min(extent, 2.0 * (task.evaluation.start.position_m + reach)), reach, 0.1)
    axes.set(xlabel="x [m], seen from above", ylabel="y [m]", aspect="equal", xlim=(-half, half), ylim=(-half, half))


def _circle(axes: Axes, target: CircleReward) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    x, y = target.radius_m * np.cos(angle), target.radius_m * np.sin(angle)
    axes.plot(x, y, "--", color="black", linewidth=1.5, zorder=5, label="target circle")
    arrow = {"arrowstyle": "-|>", "color": "black", "mutation_scale": 22, "shrinkA": 0, "shrinkB": 0}
    for k in (22, 112):
        to = k + (3 if target.speed_m_s > 0.0 else -3)
        axes.annotate("", xy=(x[to], y[to]), xytext=(x[k], y[k]), arrowprops=arrow, zorder=6)
    axes.text(0, 0, f"{target.speed_m_s:g} m/s", ha="center", va="center", color=INK, fontsize=11)


def _phase_portrait(axes: Axes, task: PendulumTask, shown: np.ndarray) -> None:
    """Rate over angle for `shown` [few, K + 1, 3]."""
    for color, theta, rate in zip(COLORS, _angle(shown), shown[:, :, 2], strict=False):
        for line in _turns(theta):
            axes.plot(line, rate, color=color, linewidth=1.4)
        axes.plot(theta[0], rate[0], "o", color=color, markeredgecolor="white", markersize=10, zorder=4)
    axes.plot([], [], "o", color=INK, markersize=8, label="start")
    axes.plot(0, 0, "+", color="black", markersize=15, markeredgewidth=2, zorder=5, label="upright, at rest")
    top = 1.1 * task.rod.max_rate_rad_s
    axes.set(xlabel="angle from upright [rad]", ylabel="rate [rad/s]", xlim=(-np.pi, np.pi), ylim=(-top, top))
    in_pi(axes.xaxis)


def _angle(shown: np.ndarray) -> np.ndarray:
    """Angle from upright in ±π, for `shown` [n, K + 1, 3]: [n, K + 1]."""
    return np.arctan2(shown[:, :, 1], shown[:, :, 0])


def _turns(angle: np.ndarray) -> list[np.ndarray]:
    """Lines for an axis of ±π: the unwrapped `angle` [K + 1], shifted by each multiple of 2π that makes a part visible.

    So no line jumps across the axis or stops before its edge.
    """
    unwrapped = np.unwrap(angle)
    turns = np.round(unwrapped[np.isfinite(unwrapped)] / (2.0 * np.pi))
    return [unwrapped - 2.0 * np.pi * turn for turn in np.unique(turns)]


# Quantities over time


def _quadrotor_panels(task: QuadrotorTask, shown: np.ndarray, errors: dict[str, np.ndarray]) -> tuple[Panel, Panel]:
    spec, reward = task.evaluation, task.evaluation.reward
    few = {name: np.where(np.isfinite(error), error, np.nan)[: len(shown)] for name, error in errors.items()}
    if isinstance(reward, CircleReward) and spec.speed_m_s is not None:
        distance, speed = np.hypot(few["radius_m"], few["height_m"]), few["speed_m_s"] + reward.speed_m_s
        return (
            logarithmic("distance to circle", "m", distance, spec.distance_m),
            Panel("tangential speed", "m/s", speed, _limits(speed, reward.speed_m_s), reward.speed_m_s, spec.speed_m_s),
        )
    return (
        logarithmic(
            f"distance to {'reference' if spec.reference else 'target'}", "m", few["position_m"], spec.distance_m
        ),
        Panel("tilt", "°", measures.tilt_deg(shown), (0.0, 180.0)),
    )


def _pendulum_panels(task: PendulumTask, shown: np.ndarray) -> tuple[Panel, Panel]:
    spec, top = task.evaluation, 1.1 * task.rod.max_rate_rad_s
    return (
        Panel("angle", "rad", _angle(shown), (-np.pi, np.pi), 0.0, spec.angle_rad, "angle"),
        Panel("rate", "rad/s", shown[:, :, 2], (-top, top), 0.0, spec.rate_rad_s),
    )


def _limits(speed: np.ndarray, target: float) -> tuple[float, float]:
    """Axis limits that show `speed` between −1 and 3 times the target, which is negative for a clockwise circle."""
    finite, size = np.isfinite(speed), abs(target)
    low = np.min(speed, initial=target - 0.5 * size, where=finite)
    high = np.max(speed, initial=target + 0.5 * size, where=finite)
    lowest, highest = sorted((-target, 3.0 * target))
    return max(low - 0.1 * size, lowest), min(high + 0.1 * size, highest)

"""Flights as one HTML page that needs nothing else: the vehicle in 3D and its quantities over time, played together.

The page is view.html with the style, the scripts, Plotly's own library and the flights put into it. What is measured
is what measures.py measures, and every tolerance drawn is the task's; the scripts only draw. A policy on the page
forbids the browser to fetch anything.
"""

import html
import json
import re
from collections.abc import Sequence
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from qrl_envs import io_spec, measures
from qrl_envs.measures import Measured
from qrl_envs.task import CircleReward, Motor, PendulumTask, QuadrotorTask, Task

SAMPLES_AT_MOST = 25_000  # of all flights together: what keeps a page below 8 MB
BLUE, ORANGE = "#0072B2", "#D55E00"  # of Okabe and Ito's, for any eye
FRONT, REAR = ("#D55E00", "#E69F00"), ("#0072B2", "#56B4E9")  # motors: warm ones in front
LEAST = 0.01  # what a logarithmic axis shows at least, in tolerances
SCRIPTS = ("vehicle.js", "rod.js", "charts.js", "view.js")
POLICY = "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:"


class Flown(NamedTuple):
    """Flights to look at, as `qrl.algorithm.flights.Flights` has them; n flights of K control periods."""

    starts: Sequence[int]  # [n] by which the page names them
    observations: np.ndarray  # [n, K + 1, F] SI units; NaN from where a flight ended early
    actions: np.ndarray  # [n, K, A] in [−1, 1]


class Line(NamedTuple):
    name: str
    colour: str
    values: np.ndarray  # [n, K + 1], or [n, K] of what is held over a control period
    says: str = ""  # what it is, where the name is too short to say


class Panel(NamedTuple):
    """One quantity over time, and what is asked of it."""

    label: str
    axis: str  # the same in short
    unit: str
    lines: list[Line]
    limits: tuple[float, float]
    resolution: float  # to which the page holds values
    decimals: int  # to which it writes them
    band: tuple[float, float] | None = None  # within tolerance
    scale: str = "linear"
    ticks: tuple[tuple[float, str], ...] = ()
    held: bool = False


def page(task: Task, title: str, flown: Flown) -> str:
    """The page's HTML; `title` says whose flights these are."""
    folder = resources.files("qrl_envs").joinpath("viewer")
    parts = {
        "policy": html.escape(POLICY),
        "title": html.escape(title),
        "style": folder.joinpath("view.css").read_text(encoding="utf-8"),
        "library": _library(),
        "data": json.dumps(_data(task, title, flown), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "script": '"use strict";\n' + "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    # In one pass, so that nothing is looked for in what was put in.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], folder.joinpath("view.html").read_text("utf-8"))


def _library() -> str:
    """plotly.js as Plotly's Python package ships it; read as a file, for the package takes time to import."""
    return resources.files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")


def _data(task: Task, title: str, flown: Flown) -> dict[str, Any]:
    """What the scripts are told. A number that is not finite is null."""
    observations = np.asarray(flown.observations, float)
    n, samples, _ = observations.shape
    stride = -(-n * samples // SAMPLES_AT_MOST)
    found = measures.of_flights(task, flown.observations)
    actions = _in_units(task, np.asarray(flown.actions, float))
    if isinstance(task, PendulumTask):
        world, panels = _rod(task), _pendulum_panels(task, observations, actions)
        motion = {"angle_rad": _plain(np.arctan2(observations[..., 1], observations[..., 0])[:, ::stride], 1e-4)}
    else:
        world, panels = _vehicle(task), _quadrotor_panels(task, observations, actions, found)
        motion = {  # [n, 3, samples]: coordinates apart, as the scene wants them
            "position_m": _plain(observations[:, ::stride, 9:12].swapaxes(1, 2), 1e-4),
            "forward": _plain(observations[:, ::stride, [0, 3, 6]].swapaxes(1, 2), 1e-4),
            "up": _plain(observations[:, ::stride, [2, 5, 8]].swapaxes(1, 2), 1e-4),
        }
    columns = [[_plain(line.values[:, ::stride], panel.resolution) for line in panel.lines] for panel in panels]
    finite = np.all(np.isfinite(observations), axis=2)
    lengths = np.where(np.all(finite, axis=1), samples, np.argmin(finite, axis=1))  # up to the first that is not
    ends_s = np.where(lengths < samples, lengths * task.control_period_s, np.inf)
    return {
        "title": title,
        "description": task.description,
        "period_s": task.control_period_s * stride,
        "end_s": (samples - 1) * task.control_period_s,
        "tail_s": task.evaluation.tail_s,
        **world,
        "panels": [_described(panel) for panel in panels],
        "flights": [
            {
                "start": int(flown.starts[i]),
                "label": f"{flown.starts[i]}: {_start(task, observations[i, 0])}, {_outcome(found, i, ends_s[i])}",
                "outcome": _outcome(found, i, ends_s[i]),
                "success": bool(found.success[i]),
                "samples": max(1, -(-int(lengths[i]) // stride)),
                **{name: values[i] for name, values in motion.items()},
                "panels": [[column[i] for column in panel] for panel in columns],
            }
            for i in range(n)
        ],
    }


def _plain(values: np.ndarray, resolution: float) -> list[Any]:
    """Nested lists of `values`, rounded to the decimals that `resolution` needs; None for what is not finite."""
    decimals = max(0, int(np.ceil(-np.log10(resolution) - 1e-9)))
    rounded = np.round(np.asarray(values, float), decimals) + 0.0  # no −0
    plain = rounded.astype(object)
    plain[~np.isfinite(rounded)] = None
    return plain.tolist()


def _described(panel: Panel) -> dict[str, Any]:
    told = {name: value for name, value in panel._asdict().items() if name not in ("lines", "resolution")}
    return told | {"lines": [{"name": line.name, "colour": line.colour, "says": line.says} for line in panel.lines]}


def _in_units(task: Task, actions: np.ndarray) -> np.ndarray:
    """The N or N m applied for `actions` [..., A] in [−1, 1]."""
    acted = io_spec.actions(task)
    offset, scale, low, high = (
        np.array([getattr(port, name) for port in acted]) for name in ("offset", "scale", "low", "high")
    )
    return np.clip(offset + scale * actions, low, high)


def _start(task: Task, observation: np.ndarray) -> str:
    """How a flight begins, in a few words."""
    if isinstance(task, PendulumTask):
        return f"{np.degrees(np.arctan2(observation[1], observation[0])):.0f}°, {observation[2]:.1f} rad/s"
    tilt = np.degrees(np.arccos(np.clip(observation[8], -1.0, 1.0)))
    away, speed = np.linalg.norm(observation[9:12]), np.linalg.norm(observation[12:15])
    return f"tilt {tilt:.0f}°, {away:.1f} m away, {speed:.1f} m/s"


def _outcome(found: Measured, i: int, end_s: float) -> str:
    """What became of flight i, whose numbers end at `end_s`."""
    if np.isfinite(end_s):
        return f"fails: ends after {end_s:.2f} s"
    if not found.success[i]:
        return "fails"
    return f"settles after {found.settle_s[i]:.2f} s"


# What the scene is drawn from


def _vehicle(task: QuadrotorTask) -> dict[str, Any]:
    wanted = task.evaluation.reward
    return {
        "vehicle": {
            "motors": [
                {"position_m": motor.position_m, "max_N": motor.max_N, "colour": line.colour}
                for motor, line in zip(task.vehicle.motors, _motors(task), strict=True)
            ]
        },
        "wanted": {
            "radius_m": wanted.radius_m if isinstance(wanted, CircleReward) else 0.0,
            "tolerance_m": task.evaluation.distance_m,
        },
    }


def _motors(task: QuadrotorTask) -> list[Line]:
    """Names, colours and places of the motors, no values: warm colours in front, the darker ones on the left."""
    return [
        Line(f"f{i} {arrow}", colour, np.zeros(0), f"the {place} motor")
        for i, (arrow, colour, place) in enumerate((_place(motor) for motor in task.vehicle.motors), 1)
    ]


def _place(motor: Motor) -> tuple[str, str, str]:
    """Arrow from the body's centre as seen from above, nose up; colour; words."""
    eighth = round(np.arctan2(motor.position_m[1], motor.position_m[0]) / (np.pi / 4.0)) % 8
    # A cross has its motors on the axes.
    arrow = "↑↖←↙↓↘→↗"[eighth]
    place = ("front", "front left", "left", "rear left", "rear", "rear right", "right", "front right")[eighth]
    colour = (FRONT[1], FRONT[0], FRONT[0], REAR[0], REAR[0], REAR[1], REAR[1], FRONT[1])[eighth]
    return arrow, colour, place


def _rod(task: PendulumTask) -> dict[str, Any]:
    rod = {"length_m": task.rod.length_m, "max_torque_N_m": task.rod.max_torque_N_m}
    return {"rod": rod, "wanted": {"angle_rad": task.evaluation.angle_rad}}


# Quantities over time; the actions come last, and the scene is drawn from them too


def _quadrotor_panels(
    task: QuadrotorTask, observations: np.ndarray, actions: np.ndarray, found: Measured
) -> list[Panel]:
    spec, wanted, error = task.evaluation, task.evaluation.reward, found.errors
    if isinstance(wanted, CircleReward) and spec.speed_m_s is not None:
        target, distance = "circle", np.hypot(error["radius_m"], error["height_m"])
        label, speed = "tangential speed", error["speed_m_s"] + wanted.speed_m_s
        band = wanted.speed_m_s - spec.speed_m_s, wanted.speed_m_s + spec.speed_m_s
        limits = (
            max(-wanted.speed_m_s, _least(speed)),
            min(3.0 * wanted.speed_m_s, _most(speed, 1.5 * wanted.speed_m_s)),
        )
    else:
        target, distance, band = "target", error["position_m"], None
        label, speed = "speed", np.linalg.norm(observations[..., 12:15], axis=-1)
        limits = 0.0, _most(speed)
    least = LEAST * spec.distance_m
    most_N = max(motor.max_N for motor in task.vehicle.motors)
    thrusts = [line._replace(values=actions[..., i]) for i, line in enumerate(_motors(task))]
    return [
        Panel(label, "speed", "m/s", [Line("", BLUE, speed)], _roomy(*limits), 1e-3, 2, band),
        Panel(
            *(f"distance to the {target}", "distance", "m", [Line("", BLUE, distance)]),
            limits=(least, 1.3 * max(_most(distance), 10.0 * spec.distance_m)),
            resolution=1e-3 * least,
            decimals=3,
            band=(least, spec.distance_m),
            scale="log",
        ),
        Panel(
            *("thrust", "thrust", "N", thrusts, _roomy(0.0, most_N)),
            resolution=5e-4 * most_N,
            decimals=3 if most_N < 1.0 else 2,
            held=True,
        ),
    ]


def _pendulum_panels(task: PendulumTask, observations: np.ndarray, actions: np.ndarray) -> list[Panel]:
    spec, rod = task.evaluation, task.rod
    angle = np.unwrap(np.arctan2(observations[..., 1], observations[..., 0]), axis=1)
    last = [each[np.isfinite(each)][-1:].sum() for each in angle]
    angle -= 2.0 * np.pi * np.round(np.array(last) / (2.0 * np.pi))[:, None]  # those that come upright end at zero
    limits = min(-np.pi, _least(angle)), max(np.pi, _most(angle))
    turns = np.arange(np.ceil(limits[0] / np.pi), np.floor(limits[1] / np.pi) + 1.0)
    ticks = tuple((float(turn * np.pi), _in_pi(int(turn))) for turn in turns)
    angles, rates = (-spec.angle_rad, spec.angle_rad), (-spec.rate_rad_s, spec.rate_rad_s)
    most_rate, most_torque = rod.max_rate_rad_s, rod.max_torque_N_m
    rate, torque = observations[..., 2], Line("", ORANGE, actions[..., 0])
    return [
        Panel(
            "angle from upright", "angle", "rad", [Line("", BLUE, angle)], _roomy(*limits), 1e-4, 2, angles, ticks=ticks
        ),
        Panel("rate", "rate", "rad/s", [Line("", BLUE, rate)], _roomy(-most_rate, most_rate), 1e-3, 2, rates),
        Panel("torque", "torque", "N m", [torque], _roomy(-most_torque, most_torque), 5e-4 * most_torque, 2, held=True),
    ]


def _in_pi(turns: int) -> str:
    return {0: "0", 1: "π", -1: "−π"}.get(turns, f"{turns}π".replace("-", "−"))


def _least(values: np.ndarray) -> float:
    return float(np.min(values, initial=0.0, where=np.isfinite(values)))


def _most(values: np.ndarray, initial: float = 0.0) -> float:
    return float(np.max(values, initial=initial, where=np.isfinite(values)))


def _roomy(low: float, high: float) -> tuple[float, float]:
    """Limits of an axis that shows these two apart from its edges."""
    room = 0.06 * (high - low) or 1.0
    return low - room, high + room

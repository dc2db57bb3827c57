"""Flights as one self-contained HTML page: an animated 3D view, and quantities over time.

The page is view.html with the style, the scripts, Plotly's library and the flights inserted. Errors are those of
`measures`, tolerances those of the task; the scripts only draw. A Content-Security-Policy blocks all requests.
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
from qrl_envs.task import CircleReward, PendulumTask, QuadrotorTask, Task

MAX_SAMPLES = 25_000  # of all flights together; keeps a page below 8 MB
BLUE, ORANGE = "#0072B2", "#D55E00"  # Okabe and Ito: safe for color-blind readers
FRONT, REAR = ("#D55E00", "#E69F00"), ("#0072B2", "#56B4E9")  # motor colors: warm in front
MIN_SHOWN = 0.01  # lower limit of a logarithmic axis, in tolerances
SCRIPTS = ("vehicle.js", "rod.js", "charts.js", "view.js")
POLICY = "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:"


class Recording(NamedTuple):
    """n flights of K control periods."""

    starts: Sequence[int]  # [n] their indices, as labels
    observations: np.ndarray  # [n, K + 1, F] SI units; NaN after an early end
    actions: np.ndarray  # [n, K, A] in [−1, 1]
    beside: np.ndarray | None = None  # [n, K + 1, F] of the int8 kernel, from the same starts


class Line(NamedTuple):
    name: str
    color: str
    values: np.ndarray  # [n, K + 1], or [n, K] if constant over a control period
    description: str = ""  # longer than the name


class Panel(NamedTuple):
    """One quantity over time, and its tolerance."""

    label: str
    axis: str  # the label in short
    unit: str
    lines: list[Line]
    limits: tuple[float, float]
    resolution: float  # of the values in the page
    decimals: int  # of the displayed numbers
    band: tuple[float, float] | None = None  # within tolerance
    scale: str = "linear"
    ticks: tuple[tuple[float, str], ...] = ()
    held: bool = False


def page(task: Task, title: str, recording: Recording) -> str:
    folder = resources.files("qrl_envs").joinpath("viewer")
    data = json.dumps(_data(task, title, recording), separators=(",", ":"), allow_nan=False)
    parts = {
        "policy": html.escape(POLICY),
        "title": html.escape(title),
        "style": folder.joinpath("view.css").read_text(encoding="utf-8"),
        # A file of Plotly's Python package, which is slow to import.
        "library": resources.files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8"),
        "data": data.replace("<", "\\u003c"),
        "script": '"use strict";\n' + "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    # In one pass, so that inserted text is not searched again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], folder.joinpath("view.html").read_text("utf-8"))


def _data(task: Task, title: str, recording: Recording) -> dict[str, Any]:
    """The data of the scripts. Non-finite numbers are null."""
    observations = np.asarray(recording.observations, float)
    n, samples, _ = observations.shape
    stride = -(-n * samples * (1 if recording.beside is None else 2) // MAX_SAMPLES)
    found = measures.of_flights(task, recording.observations)
    actions = _in_units(task, np.asarray(recording.actions, float))
    beside = None if recording.beside is None else np.asarray(recording.beside, float)
    if isinstance(task, PendulumTask):
        world, panels = _rod(task), _pendulum_panels(task, observations, actions, beside)
        motion = {"angle_rad": _plain(np.arctan2(observations[..., 1], observations[..., 0])[:, ::stride], 1e-4)}
    else:
        there = measures.in_world(task, observations)
        world, panels = _vehicle(task, samples, stride), _quadrotor_panels(task, there, actions, found, beside)
        motion = {  # [n, 3, samples], as the scene needs them
            "position_m": _plain(there[:, ::stride, 9:12].swapaxes(1, 2), 1e-4),
            "forward": _plain(observations[:, ::stride, [0, 3, 6]].swapaxes(1, 2), 1e-4),
            "up": _plain(observations[:, ::stride, [2, 5, 8]].swapaxes(1, 2), 1e-4),
        }
        if beside is not None:
            motion["beside_m"] = _plain(measures.in_world(task, beside)[:, ::stride, 9:12].swapaxes(1, 2), 1e-4)
    columns = [[_plain(line.values[:, ::stride], panel.resolution) for line in panel.lines] for panel in panels]
    finite = np.all(np.isfinite(observations), axis=2)
    lengths = np.where(np.all(finite, axis=1), samples, np.argmin(finite, axis=1))  # up to the first non-finite sample
    ends_s = np.where(lengths < samples, lengths * task.control_period_s, np.inf)
    return {
        "title": title,
        "description": task.description,
        "period_s": task.control_period_s * stride,
        "end_s": (samples - 1) * task.control_period_s,
        "tail_s": task.evaluation.tail_s,
        **world,
        "panels": [panel._asdict() | {"lines": [_described(line) for line in panel.lines]} for panel in panels],
        "flights": [
            {
                "start": int(recording.starts[i]),
                "label": f"{recording.starts[i]}: {_start(task, observations[i, 0])}, {_outcome(found, i, ends_s[i])}",
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
    """Nested lists of `values`, rounded to `resolution`; None for non-finite numbers."""
    decimals = max(0, int(np.ceil(-np.log10(resolution) - 1e-9)))
    rounded = np.round(np.asarray(values, float), decimals) + 0.0  # no −0
    plain = rounded.astype(object)
    plain[~np.isfinite(rounded)] = None
    return plain.tolist()


def _described(line: Line) -> dict[str, str]:
    return {"name": line.name, "color": line.color, "description": line.description}


def _in_units(task: Task, actions: np.ndarray) -> np.ndarray:
    """The applied thrusts [N] or torque [N m] for `actions` [..., A] in [−1, 1]."""
    ports = [(port.offset, port.scale, port.low, port.high) for port in io_spec.actions(task)]
    offset, scale, low, high = np.array(ports).T
    return np.clip(offset + scale * actions, low, high)


def _start(task: Task, observation: np.ndarray) -> str:
    if isinstance(task, PendulumTask):
        return f"{np.degrees(np.arctan2(observation[1], observation[0])):.0f}°, {observation[2]:.1f} rad/s"
    tilt, speed = measures.tilt_deg(observation), measures.speed_m_s(observation)
    return f"tilt {tilt:.0f}°, {np.linalg.norm(observation[9:12]):.1f} m away, {speed:.1f} m/s"


def _outcome(found: Measured, i: int, end_s: float) -> str:
    """The outcome of flight i; `end_s` is the time of an early end, or infinite."""
    if np.isfinite(end_s):
        return f"fails: ends after {end_s:.2f} s"
    if not found.success[i]:
        return "fails"
    return f"settles after {found.settle_s[i]:.2f} s"


# Data of the 3D scene


def _vehicle(task: QuadrotorTask, samples: int, stride: int) -> dict[str, Any]:
    wanted, path = task.evaluation.reward, None
    if followed := task.evaluation.reference:  # [3, samples]
        times = np.arange(0, samples, stride) * task.control_period_s
        path = _plain(followed.at(times).position_m.T, 1e-4)
    return {
        "vehicle": {
            "motors": [
                {"position_m": motor.position_m, "most": _most_action(task, motor.max_N), "color": line.color}
                for motor, line in zip(task.vehicle.motors, _motors(task), strict=True)
            ]
        },
        "acted": {"name": "speed", "unit": "of the greatest"}
        if task.action == "rotor_speed"
        else {"name": "thrust", "unit": "N"},
        "wanted": {
            "radius_m": wanted.radius_m if isinstance(wanted, CircleReward) else 0.0,
            "clockwise": isinstance(wanted, CircleReward) and wanted.speed_m_s < 0.0,
            "path_m": path,
            "tolerance_m": task.evaluation.distance_m,
        },
    }


def _most_action(task: QuadrotorTask, max_N: float) -> float:
    return 1.0 if task.action == "rotor_speed" else max_N


def _motors(task: QuadrotorTask) -> list[Line]:
    """Names, colors and places of the motors, without values: warm colors in front, darker ones on the left."""
    lines = []
    for i, motor in enumerate(task.vehicle.motors, 1):
        # Eighths of a turn as seen from above, nose up; a plus frame has its motors on the axes.
        eighth = round(np.arctan2(motor.position_m[1], motor.position_m[0]) / (np.pi / 4.0)) % 8
        place = ("front", "front left", "left", "rear left", "rear", "rear right", "right", "front right")[eighth]
        color = (FRONT[1], FRONT[0], FRONT[0], REAR[0], REAR[0], REAR[1], REAR[1], FRONT[1])[eighth]
        lines.append(Line(f"f{i} {'↑↖←↙↓↘→↗'[eighth]}", color, np.zeros(0), f"the {place} motor"))
    return lines


def _rod(task: PendulumTask) -> dict[str, Any]:
    rod = {"length_m": task.rod.length_m, "max_torque_N_m": task.rod.max_torque_N_m}
    return {"rod": rod, "wanted": {"angle_rad": task.evaluation.angle_rad}}


# Quantities over time; the actions come last, and the scene shows them too


def _both(values: np.ndarray, beside: np.ndarray | None) -> list[Line]:
    """A quantity of the policy's flights, and of the kernel's where they are there."""
    if beside is None:
        return [Line("", BLUE, values)]
    return [Line("float", BLUE, values), Line("kernel", ORANGE, beside, "the int8 kernel")]


def _motion(task: QuadrotorTask, there: np.ndarray, found: Measured) -> tuple[np.ndarray, np.ndarray]:
    """The distance [m] to where the task wants a vehicle, and its speed [m/s]; on a circle along it. [n, K + 1]"""
    wanted, error = task.evaluation.reward, found.errors
    if isinstance(wanted, CircleReward) and task.evaluation.speed_m_s is not None:
        return np.hypot(error["radius_m"], error["height_m"]), error["speed_m_s"] + wanted.speed_m_s
    return error["position_m"], np.linalg.norm(there[..., 12:15], axis=-1)


def _quadrotor_panels(
    task: QuadrotorTask, there: np.ndarray, actions: np.ndarray, found: Measured, beside: np.ndarray | None
) -> list[Panel]:
    spec, wanted = task.evaluation, task.evaluation.reward
    distance, speed = _motion(task, there, found)
    other = None, None
    if beside is not None:
        other = _motion(task, measures.in_world(task, beside), measures.of_flights(task, beside))
    if isinstance(wanted, CircleReward) and spec.speed_m_s is not None:
        target, label = "circle", "tangential speed"
        band = wanted.speed_m_s - spec.speed_m_s, wanted.speed_m_s + spec.speed_m_s
        lowest, highest = sorted((-wanted.speed_m_s, 3.0 * wanted.speed_m_s))
        beyond = 1.5 * wanted.speed_m_s  # below 0 for a clockwise circle
        limits = max(lowest, _least(speed, min(0.0, beyond))), min(highest, _most(speed, max(0.0, beyond)))
    else:
        target = "reference" if spec.reference else "target"
        label, band = "speed", None
        limits = 0.0, _most(speed)
    least = (0.1 if spec.reference else 1.0) * MIN_SHOWN * spec.distance_m
    rotor_speed = task.action == "rotor_speed"
    most = 1.0 if rotor_speed else max(motor.max_N for motor in task.vehicle.motors)
    acted = ("rotor speed, of its greatest", "rotor speed", "1") if rotor_speed else ("thrust", "thrust", "N")
    thrusts = [line._replace(values=actions[..., i]) for i, line in enumerate(_motors(task))]
    return [
        Panel(label, "speed", "m/s", _both(speed, other[1]), _roomy(*limits), 1e-3, 2, band),
        Panel(
            *(f"distance to the {target}", "distance", "m", _both(distance, other[0])),
            limits=(least, 1.3 * max(_most(distance), 10.0 * spec.distance_m)),
            resolution=1e-3 * least,
            decimals=3,
            band=(least, spec.distance_m),
            scale="log",
        ),
        Panel(
            *acted,
            lines=thrusts,
            limits=_roomy(0.0, most),
            resolution=5e-4 * most,
            decimals=3 if most < 1.0 or rotor_speed else 2,
            held=True,
        ),
    ]


def _angle_rad(observations: np.ndarray) -> np.ndarray:
    """Angles from upright without jumps, [n, K + 1]; of flights that come upright the end is at zero."""
    angle = np.unwrap(np.arctan2(observations[..., 1], observations[..., 0]), axis=1)
    last = [each[np.isfinite(each)][-1:].sum() for each in angle]
    return angle - 2.0 * np.pi * np.round(np.array(last) / (2.0 * np.pi))[:, None]


def _pendulum_panels(
    task: PendulumTask, observations: np.ndarray, actions: np.ndarray, beside: np.ndarray | None
) -> list[Panel]:
    spec, rod = task.evaluation, task.rod
    angle, other = _angle_rad(observations), None if beside is None else _angle_rad(beside)
    limits = min(-np.pi, _least(angle)), max(np.pi, _most(angle))
    turns = np.arange(np.ceil(limits[0] / np.pi), np.floor(limits[1] / np.pi) + 1.0)
    ticks = tuple((float(turn * np.pi), _in_pi(int(turn))) for turn in turns)
    angles, rates = (-spec.angle_rad, spec.angle_rad), (-spec.rate_rad_s, spec.rate_rad_s)
    most_rate, most_torque = rod.max_rate_rad_s, rod.max_torque_N_m
    rate, torque = observations[..., 2], Line("", ORANGE, actions[..., 0])
    return [
        Panel("angle from upright", "angle", "rad", _both(angle, other), _roomy(*limits), 1e-4, 2, angles, ticks=ticks),
        Panel(
            "rate",
            "rate",
            "rad/s",
            _both(rate, None if beside is None else beside[..., 2]),
            _roomy(-most_rate, most_rate),
            1e-3,
            2,
            rates,
        ),
        Panel("torque", "torque", "N m", [torque], _roomy(-most_torque, most_torque), 5e-4 * most_torque, 2, held=True),
    ]


def _in_pi(turns: int) -> str:
    return {0: "0", 1: "π", -1: "−π"}.get(turns, f"{turns}π".replace("-", "−"))


def _least(values: np.ndarray, initial: float = 0.0) -> float:
    return float(np.min(values, initial=initial, where=np.isfinite(values)))


def _most(values: np.ndarray, initial: float = 0.0) -> float:
    return float(np.max(values, initial=initial, where=np.isfinite(values)))


def _roomy(low: float, high: float) -> tuple[float, float]:
    """Axis limits with a margin around low … high."""
    room = 0.06 * (high - low) or 1.0
    return low - room, high + room

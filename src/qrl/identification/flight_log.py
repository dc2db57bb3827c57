"""Flight logs: CSV files with units in the names of their columns, checked, on one time grid, cut into segments."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter

from qrl_envs.specfile import BadInput, nearest

TIME, POSITION, ATTITUDE = ("time_s",), ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
VELOCITY, RATE = ("vx_m_s", "vy_m_s", "vz_m_s"), ("wx_rad_s", "wy_rad_s", "wz_rad_s")
SMOOTHING_S = 0.11  # window of the cubic whose slope stands for a velocity or rate that is not logged
GAP_PERIODS = 4.0  # time between two rows, in median periods, above which no segment spans them
PERIOD_S = (0.005, 0.05)  # of the grid; a log that is coarser than the second says too little about rotors
WARM_UP_S = 0.6  # of commands before a segment, in which rotors reach their speeds
HORIZON_S = 0.5  # of a segment
LEAD_S = 0.05  # between the times of a segment at which prediction and log are compared


class FlightLog(NamedTuple):
    """A log on a grid of equal periods, T rows; SI units, world frame with z up, quaternions body -> world."""

    name: str
    period_s: float
    time_s: np.ndarray  # [T] from the first row on
    position_m: np.ndarray  # [T, 3] world
    attitude: np.ndarray  # [T, 4]
    velocity_m_s: np.ndarray  # [T, 3] world
    body_rate_rad_s: np.ndarray  # [T, 3] body
    command: np.ndarray  # [T, N] mean over the period that begins at the row: speed fraction, or thrust [N]
    sound: np.ndarray  # [T] bool: no gap around this row
    thrust: bool  # whether `command` is thrust
    estimated: tuple[str, ...]  # what was estimated from position or attitude


class Segments(NamedTuple):
    """S pieces of flights: the commands before and during each, and what the log says, from its start on. float32."""

    command: np.ndarray  # [S, W + H, N]
    measured: np.ndarray  # [S, H + 1, 13] position, attitude, velocity, body rates
    flight: np.ndarray  # [S] int: which log


def leads(period_s: float) -> np.ndarray:
    """Lead times of the comparison, in periods from the start of a segment; [L]."""
    return np.unique(np.round(np.arange(LEAD_S, HORIZON_S + LEAD_S / 2, LEAD_S) / period_s).astype(int))


def warm_up_steps(period_s: float) -> int:
    """W, the periods of commands before a segment's start."""
    return round(WARM_UP_S / period_s)


def read(paths: Sequence[Path], max_N: np.ndarray) -> list[FlightLog]:
    """Logs of a vehicle with motors of `max_N` [N], on one grid; BadInput with one line for what is malformed."""
    raw = [_columns(path, max_N) for path in paths]
    period_s = float(np.clip(np.median([np.median(np.diff(r["time_s"][:, 0])) for r in raw]), *PERIOD_S))
    kinds = {"f" in r for r in raw}
    if len(kinds) > 1:
        raise BadInput(
            f"{paths[0]}: expected the same kind of command in all logs, found u1 … in some and f1_N … in others"
        )
    return [_on_grid(path, r, period_s) for path, r in zip(paths, raw, strict=True)]


def _columns(path: Path, max_N: np.ndarray) -> dict[str, np.ndarray]:
    """The numbers of a file by group (time_s, position, attitude, u or f, velocity, rate), each [rows, k], checked."""
    motors = len(max_N)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = list(csv.reader(file, strict=True)) or [[]]
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: not a CSV file that can be read ({error})") from None
    header = [name.strip() for name in header]
    if double := [name for name in header if header.count(name) > 1]:
        raise BadInput(f"{path}: line 1: column '{double[0]}' stands twice")
    thrusts, speeds = (tuple(pattern.format(i + 1) for i in range(motors)) for pattern in ("f{}_N", "u{}"))
    given = [name for name in header if name[:1] in ("u", "f") and name[1:].removesuffix("_N").isdigit()]
    kind = {name[0] for name in given}
    if len(kind) > 1:
        raise BadInput(f"{path}: line 1: expected commands u1 … or f1_N …, found both")
    expected = thrusts if kind == {"f"} else speeds
    if extra := [name for name in given if name not in expected]:
        raise BadInput(
            f"{path}: line 1: column '{extra[0]}': expected {', '.join(expected)}: the vehicle has {motors} motors"
        )
    groups = {"time_s": TIME, "position": POSITION, "attitude": ATTITUDE, "f" if kind == {"f"} else "u": expected}
    groups |= {key: names for key, names in (("velocity", VELOCITY), ("rate", RATE)) if set(names) & set(header)}
    for name in (name for names in groups.values() for name in names):
        if name not in header:
            hint = nearest(name, header) if header else ""
            raise BadInput(f"{path}: line 1: column '{name}' is missing{hint if 'did you mean' in hint else ''}")
    for i, row in enumerate(rows):
        if len(row) != len(header):
            raise BadInput(f"{path}: line {i + 2}: expected {len(header)} values, as in line 1, found {len(row)}")
    found = {
        key: np.stack([_numbers(path, name, [row[header.index(name)] for row in rows]) for name in names], axis=-1)
        for key, names in groups.items()
    }
    _check(path, found, groups, max_N)
    return found


def _numbers(path: Path, name: str, texts: list[str]) -> np.ndarray:
    try:
        values = np.array(texts, float)
        wrong = np.flatnonzero(~np.isfinite(values))
    except ValueError:
        wrong = [i for i, text in enumerate(texts) if not _is_number(text)]
        values = np.zeros(0)
    if len(wrong):
        i = int(wrong[0])
        raise BadInput(f"{path}: line {i + 2}, column '{name}': expected a finite number, found '{texts[i]}'")
    return values


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _check(path: Path, found: dict[str, np.ndarray], groups: dict[str, tuple[str, ...]], max_N: np.ndarray) -> None:
    """What numbers must be, row by row."""

    def refuse(wrong: np.ndarray, key: str, expected: str) -> None:
        if wrong.any():
            row, column = (int(x) for x in np.argwhere(wrong.reshape(len(wrong), -1))[0])
            raise BadInput(
                f"{path}: line {row + 2}, column '{groups[key][column]}': expected {expected}, found"
                f" {found[key][row, column]:.6g}"
            )

    times = found["time_s"]
    if len(times) < 2 or times[-1, 0] - times[0, 0] < WARM_UP_S + HORIZON_S:
        raise BadInput(f"{path}: expected a flight of at least {WARM_UP_S + HORIZON_S:g} s, found {len(times)} rows")
    refuse(np.diff(times, axis=0, prepend=times[:1] - 1.0) <= 0.0, "time_s", "a time after that of the line before")
    if (period_s := float(np.median(np.diff(times[:, 0])))) > PERIOD_S[1]:
        raise BadInput(
            f"{path}: column 'time_s': expected at least {1 / PERIOD_S[1]:.0f} lines a second, found {1 / period_s:.3g}"
        )
    norm = np.linalg.norm(found["attitude"], axis=1, keepdims=True)
    refuse(abs(norm - 1.0) > 0.05, "attitude", "a unit quaternion [qw, qx, qy, qz]")
    if "u" in found:
        refuse((found["u"] < -1e-3) | (found["u"] > 1.001), "u", "a fraction of the rotor's greatest speed, 0 to 1")
    else:
        refuse(
            (found["f"] < -1e-6) | (found["f"] > 1.001 * max_N),
            "f",
            f"a thrust of 0 to {max(max_N):g} N, the vehicle's max_N",
        )


def _on_grid(path: Path, raw: dict[str, np.ndarray], period_s: float) -> FlightLog:
    time_s = raw["time_s"][:, 0] - raw["time_s"][0, 0]
    grid = np.arange(0.0, time_s[-1] - 1e-9, period_s)

    def at_grid(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(grid, time_s, column) for column in values.T], axis=-1)

    q = raw["attitude"]
    # A sign that does not jump, so that interpolation and slopes mean something.
    sign = np.cumprod(np.where(np.sum(q * np.roll(q, 1, axis=0), axis=1) < 0, -1.0, 1.0))
    attitude = at_grid(q * (sign * sign[0])[:, None])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    position = at_grid(raw["position"])
    slope, turning = _slope(position, period_s), body_rate(attitude, _slope(attitude, period_s))
    velocity = at_grid(raw["velocity"]) if "velocity" in raw else slope
    rate = at_grid(raw["rate"]) if "rate" in raw else turning
    _agree(path, "velocity 'vx_m_s', …", velocity, slope, 0.2, "m/s in the world frame, the slope of 'x_m', …")
    _agree(
        path,
        "body rates 'wx_rad_s', …",
        rate,
        turning,
        0.2,
        "rad/s in the body frame, the turning of 'qw', … (body -> world)",
    )
    # Each row's command holds to the next row: its mean over a period is exact by its integral.
    commands = raw["f"] if "f" in raw else raw["u"]
    total = np.concatenate([np.zeros_like(commands[:1]), np.cumsum(commands[:-1] * np.diff(time_s)[:, None], axis=0)])
    edges = np.append(grid, grid[-1] + period_s)
    at_edges: np.ndarray = np.stack([np.interp(edges, time_s, c) for c in total.T], axis=-1)
    command = (at_edges[1:] - at_edges[:-1]) / period_s
    gaps = np.flatnonzero(np.diff(time_s) > GAP_PERIODS * max(period_s, float(np.median(np.diff(time_s)))))
    sound = np.ones(len(grid), bool)
    for i in gaps:
        sound[(grid > time_s[i] - period_s) & (grid < time_s[i + 1] + period_s)] = False
    command = command[:-1]  # the last period ends beyond the log
    n, estimated = len(command), tuple(key for key in ("velocity", "rate") if key not in raw)
    states = (position[:n], attitude[:n], velocity[:n], rate[:n])
    return FlightLog(path.name, period_s, grid[:n], *states, command, sound[:n], "f" in raw, estimated)


def _slope(values: np.ndarray, period_s: float) -> np.ndarray:
    """The time derivative of [T, k] by a sliding cubic."""
    window = max(5, 2 * round(SMOOTHING_S / period_s / 2) + 1)
    return np.asarray(
        savgol_filter(values, min(window, len(values) - 1 + len(values) % 2), 3, deriv=1, delta=period_s, axis=0)
    )


def body_rate(attitude: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Body rates of quaternions [T, 4] that change by `slope` [T, 4] a second: the vector of 2 q⁻¹ ⊗ dq/dt; [T, 3]."""
    (w, x, y, z), (a, b, c, d) = attitude.T, slope.T
    return 2.0 * np.stack(
        [w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a], axis=-1
    )


def _agree(path: Path, what: str, given: np.ndarray, slope: np.ndarray, least: float, expected: str) -> None:
    """Refuse columns that are not the rate of change they should be: another unit, frame or sign."""
    size = np.sqrt(np.mean(slope**2))
    share = np.sum(given * slope) / max(np.sum(slope**2), 1e-12)
    if size > least and not 0.4 < share < 2.5:
        raise BadInput(f"{path}: {what}: expected {expected}, found {share:.3g} of that")


def segments(
    logs: Sequence[FlightLog], weight_N: float, spans: Sequence[tuple[float, float]], static_N: Sequence[np.ndarray]
) -> Segments:
    """The segments of logs, end to end, within a span of each log's time (as fractions of it); without those that have
    a gap, or in which the vehicle stands on the ground: at rest, with commands whose steady thrust `static_N` (for each
    log [T]) is under half of its weight.
    """
    parts: list[Segments] = []
    for i, (log, (low, high), thrust) in enumerate(zip(logs, spans, static_N, strict=True)):
        warm, steps = warm_up_steps(log.period_s), int(leads(log.period_s)[-1])
        states = np.concatenate([log.position_m, log.attitude, log.velocity_m_s, log.body_rate_rad_s], axis=1)
        still = (np.linalg.norm(log.velocity_m_s, axis=1) < 0.05) & (thrust < 0.5 * weight_N)
        last = min(int(high * len(log.time_s)), len(log.time_s)) - steps - 1
        starts = np.arange(max(warm, int(low * len(log.time_s))), last + 1, steps)
        fine = [log.sound[s - warm : s + steps + 1].all() and not still[s : s + steps + 1].any() for s in starts]
        starts = starts[np.array(fine, bool)]
        commands, measured = (
            log.command[starts[:, None] + np.arange(-warm, steps)],
            states[starts[:, None] + np.arange(steps + 1)],
        )
        parts.append(Segments(commands, measured, np.full(len(starts), i)))
    command, measured, flight = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Segments(command.astype(np.float32), measured.astype(np.float32), flight)

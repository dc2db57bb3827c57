"""References to follow, as data of a task: a point, a circle, a Lissajous figure, waypoints, polynomials, samples of a
file, or smooth random motion to train on. World frame, SI units; heading is no part of a reference.

Those that are known beforehand give position, velocity and acceleration at any time; `target` has them in flight.
"""

import abc
import csv
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from qrl_envs import specfile
from qrl_envs.specfile import BadInput, Fraction, NonNegative, Positive, Real, Spec
from qrl_envs.vehicle import STANDARD_GRAVITY_M_S2, Vehicle

Vector = tuple[Real, Real, Real]
SETTLE_S = 2.0  # of an evaluation, before the error counts, unless the first lap takes longer
LEAST_MEASURED_S = 6.0  # of an evaluation of a reference that repeats
LONGEST_S = 120.0
FARTHEST_M = 1000.0
FASTEST_1_S = 10.0  # cycles of a figure in a second
MOST_THRUST = 0.95  # share of a vehicle's thrust that a reference may take
FINEST_S = 1e-3  # least distance of two times of a reference


class Kinematics(NamedTuple):
    """A reference at n times: float64 [n, 3] each."""

    position_m: np.ndarray
    velocity_m_s: np.ndarray
    acceleration_m_s2: np.ndarray


class Base(Spec):
    """What references known beforehand have in common; each has `at(times_s [n]) -> Kinematics`, too."""

    @property
    def lap_s(self) -> float | None:
        """Time after which it repeats, or None."""
        return None

    @property
    def duration_s(self) -> float | None:
        """Time after which it stays where it is, or None."""
        return None


class Point(Base):
    """Stays at a point."""

    form: Literal["point"]
    position_m: Vector = (0.0, 0.0, 0.0)

    def at(self, times_s: np.ndarray) -> Kinematics:
        zero = np.zeros((len(times_s), 3))
        return Kinematics(zero + self.position_m, zero, zero)


class Sine(NamedTuple):
    """center + amplitude·sin(rate·t + phase) along each axis; float64 [3] each."""

    center_m: np.ndarray
    amplitude_m: np.ndarray
    rate_rad_s: np.ndarray
    phase_rad: np.ndarray


class Periodic(Base):
    """What repeats: a sine along each axis."""

    @property
    @abc.abstractmethod
    def sine(self) -> Sine: ...

    def at(self, times_s: np.ndarray) -> Kinematics:
        center, size, rate, phase = self.sine
        angle = rate * np.asarray(times_s)[:, None] + phase
        return Kinematics(center + size * np.sin(angle), size * rate * np.cos(angle), -size * rate**2 * np.sin(angle))


class Lissajous(Periodic):
    """center + amplitude_m·sin(2π·cycles·t/period_s + phase_rad) along each axis.

    A figure-eight has the cycles 1, 2, 0; a circle 1, 1, 0 and a phase of π/2 along x.
    """

    form: Literal["lissajous"]
    amplitude_m: tuple[NonNegative, NonNegative, NonNegative]
    cycles: tuple[NonNegative, NonNegative, NonNegative]  # whole numbers, in a period
    phase_rad: Vector = (0.0, 0.0, 0.0)
    center_m: Vector = (0.0, 0.0, 0.0)
    period_s: Positive

    @model_validator(mode="after")
    def _repeats(self) -> "Lissajous":
        if any(cycles % 1 for cycles in self.cycles):
            raise ValueError(f"expected whole numbers of cycles, found {list(self.cycles)}")
        if not FINEST_S <= self.period_s <= LONGEST_S:
            raise ValueError(f"expected a period_s from {FINEST_S:g} to {LONGEST_S:g}, found {self.period_s:g}")
        if max(self.cycles) > FASTEST_1_S * self.period_s:
            raise ValueError(f"expected at most {FASTEST_1_S:g} cycles in a second, found {list(self.cycles)}")
        return self

    @property
    def lap_s(self) -> float | None:
        return self.period_s

    @property
    def sine(self) -> Sine:
        rate = 2.0 * np.pi * np.array(self.cycles) / self.period_s
        return Sine(np.array(self.center_m), np.array(self.amplitude_m), rate, np.array(self.phase_rad))


class Circle(Periodic):
    """A horizontal circle about center_m; a speed above 0 is counter-clockwise seen from above."""

    form: Literal["circle"]
    radius_m: Positive
    speed_m_s: Real
    center_m: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _moves(self) -> "Circle":
        if not 0.0 < 2.0 * np.pi * self.radius_m <= LONGEST_S * abs(self.speed_m_s):
            raise ValueError(f"expected a speed_m_s that makes a lap within {LONGEST_S:g} s, found {self.speed_m_s:g}")
        return self

    @property
    def lap_s(self) -> float | None:
        return 2.0 * np.pi * self.radius_m / abs(self.speed_m_s)

    @property
    def sine(self) -> Sine:
        size, quarter = np.array([self.radius_m, self.radius_m, 0.0]), np.array([np.pi / 2.0, 0.0, 0.0])
        return Sine(np.array(self.center_m), size, np.full(3, self.speed_m_s / self.radius_m), quarter)


class Waypoints(Base):
    """The motion of least snap through points at given times, from rest to rest, as a spline of degree 7."""

    form: Literal["waypoints"]
    position_m: Annotated[tuple[Vector, ...], Field(min_length=2, max_length=1000)]
    times_s: tuple[NonNegative, ...] | None = None  # of the points, the first 0; or
    speed_m_s: Positive | None = None  # by which straight lines between them would be flown

    @model_validator(mode="after")
    def _timed(self) -> "Waypoints":
        if (self.times_s is None) == (self.speed_m_s is None):
            raise ValueError("expected either times_s or speed_m_s")
        _check_times(tuple(self._times), len(self.position_m))  # also by speed: points in one place have one time
        return self

    @property
    def _times(self) -> np.ndarray:
        if self.times_s is not None:
            return np.array(self.times_s)
        legs = np.linalg.norm(np.diff(np.array(self.position_m), axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(legs)]) / (self.speed_m_s or 1.0)

    @property
    def duration_s(self) -> float | None:
        return float(self._times[-1])

    def at(self, times_s: np.ndarray) -> Kinematics:
        from scipy.interpolate import make_interp_spline  # takes half a second to import

        # The interpolant of least integral of the squared snap has pieces of degree 7, with six continuous derivatives
        # at the points (Mellinger and Kumar 2011).
        rest = [(order, np.zeros(3)) for order in (1, 2, 3)]
        spline = make_interp_spline(self._times, np.array(self.position_m), k=7, bc_type=(rest, rest))
        inside = np.clip(times_s, 0.0, self._times[-1])
        return Kinematics(*(np.asarray(spline(inside, order)) for order in (0, 1, 2)))


class Segment(Spec):
    """position = Σ c_i·tⁱ along each axis for duration_s; t from the segment's beginning."""

    duration_s: Positive
    x_m: Annotated[tuple[Real, ...], Field(min_length=1, max_length=16)]
    y_m: Annotated[tuple[Real, ...], Field(min_length=1, max_length=16)]
    z_m: Annotated[tuple[Real, ...], Field(min_length=1, max_length=16)]

    def at(self, t: np.ndarray) -> np.ndarray:
        """Position, velocity, acceleration; [3, n, 3]."""
        series = [np.polynomial.Polynomial(c) for c in (self.x_m, self.y_m, self.z_m)]
        return np.stack([np.stack([(s.deriv(order) if order else s)(t) for s in series], -1) for order in (0, 1, 2)])


class Polynomials(Base):
    """Polynomials one after the other, as trajectory planners and the Crazyflie's firmware give them."""

    form: Literal["polynomials"]
    segments: Annotated[tuple[Segment, ...], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _joined(self) -> "Polynomials":
        if (total_s := sum(segment.duration_s for segment in self.segments)) > LONGEST_S:
            raise ValueError(f"expected segments of at most {LONGEST_S:g} s together, found {total_s:g} s")
        for i, (one, after) in enumerate(zip(self.segments, self.segments[1:], strict=False)):
            end, begin = one.at(np.array([one.duration_s]))[0, 0], after.at(np.zeros(1))[0, 0]
            if not np.allclose(end, begin, atol=1e-2):
                raise ValueError(f"expected segments that join, found {end} m at the end of {i} and {begin} m after it")
        return self

    @property
    def duration_s(self) -> float | None:
        return sum(segment.duration_s for segment in self.segments)

    def at(self, times_s: np.ndarray) -> Kinematics:
        ends = np.cumsum([segment.duration_s for segment in self.segments])
        inside = np.clip(times_s, 0.0, ends[-1])
        index = np.minimum(np.searchsorted(ends, inside, side="right"), len(ends) - 1)
        found = np.zeros((3, len(inside), 3))
        for i, segment in enumerate(self.segments):
            here = index == i
            found[:, here] = segment.at(inside[here] - (ends[i] - segment.duration_s))
        found[1:, np.asarray(times_s) > ends[-1]] = 0.0
        return Kinematics(*found)


class Samples(Base):
    """Positions at times, joined by a cubic spline; as a CSV file with the columns time_s, x_m, y_m, z_m has them."""

    form: Literal["samples"]
    times_s: Annotated[tuple[NonNegative, ...], Field(min_length=4, max_length=100_000)]
    position_m: Annotated[tuple[Vector, ...], Field(min_length=4, max_length=100_000)]

    @model_validator(mode="after")
    def _timed(self) -> "Samples":
        _check_times(self.times_s, len(self.position_m))
        return self

    @property
    def duration_s(self) -> float | None:
        return self.times_s[-1]

    def at(self, times_s: np.ndarray) -> Kinematics:
        from scipy.interpolate import make_interp_spline  # takes half a second to import

        spline = make_interp_spline(np.array(self.times_s), np.array(self.position_m), k=3, bc_type="natural")
        inside = np.clip(times_s, 0.0, self.times_s[-1])
        found = [np.asarray(spline(inside, order)) for order in (0, 1, 2)]
        for part in found[1:]:
            part[np.asarray(times_s) > self.times_s[-1]] = 0.0
        return Kinematics(*found)


class Random(Spec):
    """To train on: two sines of random rate, amplitude and phase along each axis, or a point."""

    form: Literal["random"]
    moving: Fraction = 0.5  # share of the flights; the others stay at the origin
    rate_rad_s: tuple[Positive, Positive] = (0.3, 4.0)  # log-uniform
    amplitude_m: Positive = 0.6  # standard deviation; the vertical one is VERTICAL of it
    speed_m_s: Positive = 3.5  # of a sine, at most
    acceleration_share: Fraction = 0.5  # of the horizontal acceleration that the vehicle has at constant height


VERTICAL = 0.4
Fixed = Point | Circle | Lissajous | Waypoints | Polynomials | Samples
FixedReference = Annotated[Fixed, Field(discriminator="form")]
Reference = Annotated[Fixed | Random, Field(discriminator="form")]


def _check_times(times_s: tuple[float, ...], points: int) -> None:
    if len(times_s) != points:
        raise ValueError(f"expected a time for each of {points} points, found {len(times_s)}")
    if times_s[0] != 0.0 or np.diff(times_s).min() < FINEST_S or times_s[-1] > LONGEST_S:
        raise ValueError(
            f"expected times from 0 on, each at least {FINEST_S:g} s after the one before, to at most {LONGEST_S:g} s"
        )


def evaluation_s(reference: Fixed) -> tuple[float, float]:
    """How long an evaluation flies a reference, and for how long of that, at the end, its error counts [s].

    Not before the first lap is over, or 2 s, whichever is longer.
    """
    if (lap_s := reference.lap_s) is not None:
        before = max(lap_s, SETTLE_S)
        tail = lap_s * np.ceil(LEAST_MEASURED_S / lap_s)
    else:
        before, tail = SETTLE_S, max((reference.duration_s or 0.0) - SETTLE_S, LEAST_MEASURED_S)
    return float(before + tail), float(tail)


def check(reference: Fixed, vehicle: Vehicle) -> None:
    """ValueError if the vehicle has too little thrust for a reference, or it leads too far away."""
    total_s = reference.duration_s or evaluation_s(reference)[0]  # where it ends it may stop at once
    times = np.linspace(0.0, total_s, round(total_s * 200) + 2)
    found = reference.at(times)
    if not np.abs(found.position_m).max() <= FARTHEST_M:
        raise ValueError(f"expected a reference within {FARTHEST_M:g} m, found {np.abs(found.position_m).max():g} m")
    # A velocity that jumps takes an acceleration that no derivative shows.
    steps = np.diff(found.velocity_m_s, axis=0, append=found.velocity_m_s[-1:]) / times[1]
    up = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
    needed = [np.linalg.norm(acceleration + up, axis=1) for acceleration in (found.acceleration_m_s2, steps)]
    worst = int(np.argmax(np.maximum(*needed)))
    share = float(max(each[worst] for each in needed)) * vehicle.mass_kg / vehicle.total_thrust_N
    if not share <= MOST_THRUST:
        raise ValueError(
            f"expected a reference that the vehicle can follow: at {times[worst]:.2f} s it takes {share:.2f} of its"
            f" thrust, of which {MOST_THRUST:g} may be used"
        )


def reference_data(name_or_path: str) -> dict[str, Any]:
    """The contents of a shipped reference, of a `.json`, or of a `.csv` with the columns time_s, x_m, y_m, z_m;
    BadInput with one line if there is none.
    """
    if name_or_path.lower().endswith(".csv"):
        return _csv(Path(name_or_path))
    return specfile.named("reference", "references", name_or_path)


def shipped_references() -> list[str]:
    """Names of the shipped references."""
    return specfile.shipped("references")


COLUMNS = ("time_s", "x_m", "y_m", "z_m")


def _csv(path: Path) -> dict[str, Any]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: cannot be read ({error})") from None
    if not rows or not set(COLUMNS) <= set(rows[0]):
        raise BadInput(f"{path}: expected rows with the columns {', '.join(COLUMNS)}")
    numbers = np.zeros((len(rows), 4))
    for i, row in enumerate(rows):
        for j, column in enumerate(COLUMNS):
            try:
                numbers[i, j] = float(row[column])
            except (TypeError, ValueError):
                raise BadInput(f"{path}: row {i + 2}: {column}: expected a number, found '{row[column]}'") from None
    return {"form": "samples", "times_s": numbers[:, 0].tolist(), "position_m": numbers[:, 1:].tolist()}

"""Flights of an exported kernel in other people's simulators, from the same starts as other controllers.

NumPy and ctypes only: each judge's script imports it in an environment of its own. World: x forward, y left, z up.
Body: x forward, y left, z up. All flights of a batch are flown side by side; n is their number, N that of rotors.
"""

import argparse
import ctypes
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD_S = 0.01  # of control: that of the kernels, and RAPTOR's
DURATION_S, TAIL_S = 8.0, 2.0
SUCCESS_M = 0.1  # distance from the point, throughout the tail
LOST_M, LOST_RAD_S = 20.0, 200.0  # distance and body rate at which a flight is over
STARTS_SEED = 20261128
RAPTOR_MOST_M, RAPTOR_MOST_M_S = 0.5, 1.0  # to which PX4's mc_raptor clips the errors that RAPTOR is shown


class State(NamedTuple):
    """n rigid bodies; the position is relative to where the reference begins."""

    rotation: Array  # [n, 3, 3] body -> world
    position_m: Array  # [n, 3] world
    velocity_m_s: Array  # [n, 3] world
    body_rate_rad_s: Array  # [n, 3] body


class Condition(NamedTuple):
    """How a flight's vehicle differs from what its controllers were told."""

    name: str
    mass: float = 1.0  # factors
    thrust: float = 1.0  # and the reaction torque, of every rotor
    lag: float = 1.0
    wind_m_s: float = 0.0  # along world x
    late: int = 0  # control periods from set-points to rotors
    told: str = "exact"  # what controllers are told of the flight: a key of `estimates.TOLD`


CONDITIONS = (
    Condition("nominal"),
    Condition("mass × 1.3", mass=1.3),
    Condition("thrust × 0.85", thrust=0.85),
    Condition("lag × 2", lag=2.0),
    Condition("wind 2 m/s", wind_m_s=2.0),
    Condition("noise, 10 ms late, mass × 1.2, wind 2 m/s", mass=1.2, wind_m_s=2.0, late=1, told="noise"),
    Condition("position at 30 Hz, 10 ms late, bias", told="fixes"),
)


class Rotors(NamedTuple):
    """Where a vehicle's motors are, in the order of whoever numbered them."""

    position_m: Array  # [N, 2] x, y from the center of mass
    spin: Array  # [N] +1: the reaction torque is positive about body z


class Simulator(Protocol):
    """A judge: n vehicles under one condition."""

    def start(self, states: State) -> None:
        """Put the vehicles there, rotors at the speed at which the nominal vehicle hovers."""
        ...

    def states(self) -> State: ...

    def step(self, set_points: Array, flying: NDArray[np.bool_]) -> None:
        """One control period at these rotor speeds [n, N], in the judge's unit and order, of those that still fly."""
        ...


class Reference(NamedTuple):
    """What is to be followed, at each control period from 0 on, and for a while after the flight."""

    name: str
    position_m: Array  # [K, 3] world
    velocity_m_s: Array  # [K, 3] world
    acceleration_m_s2: Array  # [K, 3] world
    steps: int  # of a flight
    tail: int  # of these, at the end, in which the error counts


def _point() -> Reference:
    steps = round(DURATION_S / PERIOD_S)
    still = np.zeros((steps + 1, 3))
    return Reference("hover", still, still, still, steps, round(TAIL_S / PERIOD_S))


HOVER = _point()


class Target(NamedTuple):
    """A reference at a step of a flight."""

    reference: Reference
    step: int

    def ahead(self, periods: int) -> int:
        return min(self.step + periods, len(self.reference.position_m) - 1)

    @property
    def position_m(self) -> Array:
        return self.reference.position_m[self.ahead(0)]

    @property
    def velocity_m_s(self) -> Array:
        return self.reference.velocity_m_s[self.ahead(0)]

    @property
    def acceleration_m_s2(self) -> Array:
        return self.reference.acceleration_m_s2[self.ahead(0)]

    def preview_m_s(self, periods: list[int]) -> Array:
        """The velocities so many periods ahead minus that now, one after the other; [3k]."""
        later = [self.reference.velocity_m_s[self.ahead(each)] - self.velocity_m_s for each in periods]
        return np.concatenate([np.zeros(0), *later])


def relative(states: State, target: Target) -> State:
    """`states` with position and velocity relative to those of a target."""
    return states._replace(
        position_m=states.position_m - target.position_m, velocity_m_s=states.velocity_m_s - target.velocity_m_s
    )


class Controller(Protocol):
    """From states and what is to be followed to set-points of the rotors' speeds [n, N], in the judge's unit and
    order.
    """

    def reset(self, flights: int) -> None: ...

    def act(self, states: State, target: Target) -> Array: ...


def motor_order(ours: Rotors, theirs: Rotors) -> NDArray[np.intp]:
    """For each of their motors the index of ours that is in its place; [N]. ValueError if one has no match.

    Matched by direction from the center of mass, and checked by spin: lengths of arms may differ by a rounding.
    """
    if len(ours.spin) != len(theirs.spin):
        raise ValueError(f"{len(ours.spin)} motors of ours, {len(theirs.spin)} of theirs")
    direction = [r.position_m / np.linalg.norm(r.position_m, axis=1, keepdims=True) for r in (theirs, ours)]
    alike = direction[0] @ direction[1].T
    order = np.argmax(alike, axis=1)
    for i, j in enumerate(order):
        if alike[i, j] < math.cos(math.radians(10.0)) or theirs.spin[i] != ours.spin[j]:
            raise ValueError(f"motor {i + 1} at {theirs.position_m[i]} m, spin {theirs.spin[i]:+g}, is none of ours")
    if len(set(order.tolist())) != len(order):
        raise ValueError(f"two of their motors are one of ours: {order}")
    return order


def observations(states: State) -> NDArray[np.float32]:
    """What a kernel is passed, [n, 18]: rotation row-major, position [m], velocity [m/s], body rates [rad/s]."""
    rows = states.rotation.reshape(-1, 9)
    return np.concatenate([rows, states.position_m, states.velocity_m_s, states.body_rate_rad_s], axis=1).astype(
        np.float32
    )


class Kernel:
    """An exported kernel (format 2) in a shared library, with a memory for each flight."""

    def __init__(self, library: Path, manifest: Path) -> None:
        said = json.loads(manifest.read_text(encoding="utf-8"))
        units = {(port["unit"], port.get("quantity")) for port in said["act"]}
        self.gives_speeds = units == {("1", "rotor speed fraction")}
        if said["format"] != 2 or len(said["obs"]) < 18 or not (self.gives_speeds or units == {("N", None)}):
            raise ValueError(
                f"{manifest}: expected a kernel of format 2 from 18 measurements to thrusts or rotor speeds"
            )
        self._ahead = [round(port["ahead_s"] / PERIOD_S) for port in said["obs"][18::3]]
        if said["control_period_s"] != PERIOD_S:
            raise ValueError(f"{manifest}: expected a control period of {PERIOD_S} s")
        self.rotors = Rotors(
            np.array([port["position_m"][:2] for port in said["act"]]), np.array([port["spin"] for port in said["act"]])
        )
        loaded, name = ctypes.CDLL(str(library)), said["name"]
        self._reset, self._step = getattr(loaded, f"{name}_reset"), getattr(loaded, f"{name}_step")
        self._step.restype = ctypes.c_int
        self._state_bytes = said["state_bytes"]
        self._memories: list[Any] = []
        if getattr(loaded, f"{name}_selftest")() != 0:
            raise ValueError(f"{library}: its golden vectors are not reproduced")

    def reset(self, flights: int) -> None:
        # 8-byte words: aligned for whatever the state holds.
        self._memories = [(ctypes.c_uint64 * (self._state_bytes // 8 + 1))() for _ in range(flights)]
        for memory in self._memories:
            self._reset(memory)

    def actions(self, states: State, target: Target) -> Array:
        """Thrusts [N], or rotor speeds of their greatest if it `gives_speeds`; [n, N] in the kernel's order."""
        preview = np.tile(target.preview_m_s(self._ahead).astype(np.float32), (len(states.position_m), 1))
        seen = np.ascontiguousarray(np.concatenate([observations(relative(states, target)), preview], axis=1))
        given = np.zeros((len(seen), len(self.rotors.spin)), np.float32)
        numbers = ctypes.POINTER(ctypes.c_float)
        for memory, row, out in zip(self._memories, seen, given, strict=True):
            self._step(memory, row.ctypes.data_as(numbers), out.ctypes.data_as(numbers))
        return given.astype(np.float64)


class KernelController:
    """A kernel whose thrusts become set-points by the vehicle's nominal thrust curve; speeds are set-points."""

    def __init__(self, kernel: Kernel, theirs: Rotors, speed_of: Any, least: float, most: float) -> None:
        """`speed_of`: thrust [N] -> rotor speed in the judge's unit, any shape; `least`, `most`: in that unit."""
        self._kernel, self._speed_of, self._limits = kernel, speed_of, (least, most)
        self._order = motor_order(kernel.rotors, theirs)

    def reset(self, flights: int) -> None:
        self._kernel.reset(flights)

    def act(self, states: State, target: Target) -> Array:
        actions = self._kernel.actions(states, target)[:, self._order]
        if self._kernel.gives_speeds:
            return np.clip(actions * self._limits[1], *self._limits)
        return self._speed_of(np.maximum(actions, 0.0))


# Front right, back right, back left, front left; spins as those of the Crazyflies that it was trained on.
RAPTOR_ROTORS = Rotors(np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]), np.array([-1, 1, -1, 1]))


class RaptorController:
    """RAPTOR (foundation-policy), which is told nothing but which speeds are the least and the greatest."""

    def __init__(self, theirs: Rotors, least: float, most: float) -> None:
        from foundation_policy import Raptor  # in the judge's environment

        self._policy = Raptor()
        self._order = motor_order(RAPTOR_ROTORS, theirs)
        self._least, self._most = least, most
        self._previous = np.zeros((0, 4))

    def reset(self, flights: int) -> None:
        self._policy.reset()
        self._previous = np.zeros((flights, 4))

    def act(self, states: State, target: Target) -> Array:
        states = relative(states, target)
        seen = np.concatenate(
            [
                np.clip(states.position_m, -RAPTOR_MOST_M, RAPTOR_MOST_M),
                states.rotation.reshape(-1, 9),
                np.clip(states.velocity_m_s, -RAPTOR_MOST_M_S, RAPTOR_MOST_M_S),
                states.body_rate_rad_s,
                self._previous,
            ],
            axis=1,
        )
        self._previous = np.clip(self._policy.evaluate_step(seen), -1.0, 1.0)
        return self._least + (self._most - self._least) * (self._previous[:, self._order] + 1.0) / 2.0


def matrices(quaternions: Array) -> Array:
    """Rotation matrices [n, 3, 3] of unit quaternions [n, 4], w first."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


class Start(NamedTuple):
    """n starts."""

    quaternion: Array  # [n, 4] body -> world, w first
    position_m: Array  # [n, 3] world, from the point
    velocity_m_s: Array  # [n, 3] world
    body_rate_rad_s: Array  # [n, 3] body

    def states(self) -> State:
        return State(matrices(self.quaternion), self.position_m, self.velocity_m_s, self.body_rate_rad_s)


def moderate(count: int, seed: int = STARTS_SEED) -> Start:
    """Within ±1 m, ±34° of yaw, pitch and roll each, ±0.5 m/s, ±1 rad/s."""
    u = np.random.default_rng(seed).uniform(-1.0, 1.0, (4, count, 3))
    (cr, cp, cy), (sr, sp, sy) = (f(math.radians(34.0) * u[0] / 2.0).T for f in (np.cos, np.sin))
    quaternion = np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )
    return Start(quaternion, u[1], 0.5 * u[2], u[3])


def any_attitude(count: int, seed: int = STARTS_SEED) -> Start:
    """The start ranges of qrl's evaluation of hover: any attitude, uniformly, ±2 m, ±1 m/s, ±1 rad/s."""
    draws = np.random.default_rng(seed + 1)
    quaternion = draws.normal(size=(count, 4))
    u = draws.uniform(-1.0, 1.0, (3, count, 3))
    return Start(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), 2.0 * u[0], u[1], u[2])


STARTS = {"moderate": moderate, "any attitude": any_attitude}


def fly(
    simulator: Simulator,
    controller: Controller,
    starts: Start,
    reference: Reference = HOVER,
    told: Any = None,
    late: int = 0,
) -> Array:
    """Distances from the reference [n, steps] in meters after each period; infinite once lost. The starts are about
    where it begins, and at its velocity.

    The controller is `told` of the flight what an `estimates.Exact` says, by default what is; from the position that
    it is told so the bias that nobody can know is taken. Its set-points act so many periods `late`.
    """
    count, origin = len(starts.quaternion), Target(reference, 0)
    begun = starts.states()._replace(
        position_m=starts.position_m + origin.position_m, velocity_m_s=starts.velocity_m_s + origin.velocity_m_s
    )
    simulator.start(begun)
    controller.reset(count)
    flying = np.ones(count, bool)
    states, distances, waiting = begun, [], []
    with np.errstate(all="ignore"):  # a lost flight may overflow
        for step in range(reference.steps):
            target = Target(reference, step)
            seen = _level_where_lost(states, flying)
            seen = told.told(seen, step * PERIOD_S) if told else seen
            waiting.append(controller.act(seen, target))
            simulator.step(waiting.pop(0) if len(waiting) > late else waiting[0], flying)
            states = simulator.states()
            error = relative(states, Target(reference, step + 1))
            distance = np.linalg.norm(error.position_m + (told.bias_m() if told else 0.0), axis=1)
            rate = np.linalg.norm(error.body_rate_rad_s, axis=1)
            flying &= (distance < LOST_M) & (rate < LOST_RAD_S)  # a NaN is not less
            distances.append(np.where(flying, distance, np.inf))
    return np.array(distances).T


def _level_where_lost(states: State, flying: NDArray[np.bool_]) -> State:
    """`states` with those of lost flights replaced by a vehicle that hovers, so that controllers are passed numbers."""
    still = State(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    return State(*(np.where(flying.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(states, still, strict=True)))


def summary(distances: Array, tail_steps: int = HOVER.tail) -> dict[str, float]:
    """Of flights [n, steps]: success, RMSE over the tail (median, [mm]) and time to settle (median, [s]).

    Success: within SUCCESS_M throughout the tail. RMSE and settle are infinite for a flight that was lost or did not
    settle, and enter the median so.
    """
    tail = distances[:, -tail_steps:]
    outside = ~(distances < SUCCESS_M)
    after = np.array([0.0 if not row.any() else (np.flatnonzero(row)[-1] + 1) * PERIOD_S for row in outside])
    settle = np.where(outside[:, -1], np.inf, after)
    return {
        "success": float((tail < SUCCESS_M).all(axis=1).mean()),
        "rmse_mm": 1e3 * _median(np.sqrt((tail**2).mean(axis=1))),
        "settle_s": _median(settle),
        "lost": float((~np.isfinite(distances[:, -1])).mean()),
    }


def tournament(
    simulator: Callable[[Condition, str], Simulator],
    controllers: dict[str, Controller],
    starts: int,
    references: list[Reference],
) -> None:
    """Report a line for each reference, kind of starts, condition and controller; `simulator`: of a condition and a
    controller. Figures are flown from moderate starts.
    """
    # Beside this file, where it is a script's; experiments.bench.judges needs neither.
    from estimates import TOLD
    from judge import report

    for reference in references:
        for kind, draw in STARTS.items():
            if kind != "moderate" and reference.name != HOVER.name:
                continue
            for condition in CONDITIONS:
                for name, controller in controllers.items():
                    told = TOLD[condition.told](starts)
                    flown = fly(simulator(condition, name), controller, draw(starts), reference, told, condition.late)
                    said = {"reference": reference.name, "starts": kind, "flights": starts}
                    said |= {"condition": condition.name, "controller": name}
                    report(said | summary(flown, reference.tail))


def _median(values: Array) -> float:
    """Where the two in the middle are finite and infinite: infinite, not NaN."""
    ordered = np.sort(values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return float(low if low == high else (low + high) / 2.0)


class Given(NamedTuple):
    """Open-loop commands from starts, for our plant and a judge's: what `experiments.bench.judges` writes."""

    starts: Start
    thrusts_N: Array  # [n, steps, N]
    rotors: Rotors  # ours, the order of the thrusts


def read_given(path: Path) -> Given:
    with np.load(path) as stored:
        starts = Start(*(stored[name] for name in Start._fields))
        return Given(starts, stored["thrusts_N"], Rotors(stored["rotor_position_m"], stored["rotor_spin"]))


def rollout(simulator: Simulator, given: Given, theirs: Rotors, speed_of: Any) -> State:
    """The states after each control period, each field [n, steps, …]; positions relative to the hover point."""
    order = motor_order(given.rotors, theirs)
    simulator.start(given.starts.states())
    flying = np.ones(len(given.thrusts_N), bool)
    states = []
    for step in range(given.thrusts_N.shape[1]):
        simulator.step(speed_of(given.thrusts_N[:, step, order]), flying)
        states.append(simulator.states())
    return State(*(np.stack(field, axis=1) for field in zip(*states, strict=True)))


def write_rollouts(path: Path, found: dict[str, State]) -> None:
    """Of each variant of a judge's plant, under "VARIANT/FIELD"."""
    flat = {f"{variant}/{name}": array for variant, s in found.items() for name, array in s._asdict().items()}
    np.savez(path, **flat)  # pyright: ignore[reportArgumentType]


def read_rollouts(path: Path) -> dict[str, State]:
    with np.load(path) as stored:
        variants = dict.fromkeys(key.split("/")[0] for key in stored.files)
        return {v: State(*(stored[f"{v}/{name}"] for name in State._fields)) for v in variants}


def write_references(path: Path, references: list[Reference]) -> None:
    flat: dict[str, Any] = {}
    for each in references:
        flat |= {f"{each.name}/{name}": value for name, value in each._asdict().items() if name != "name"}
    np.savez(path, **flat)


def read_references(path: Path) -> list[Reference]:
    with np.load(path) as stored:
        found = []
        for name in dict.fromkeys(key.split("/")[0] for key in stored.files):
            position, velocity, acceleration = (stored[f"{name}/{field}"] for field in Reference._fields[1:4])
            steps, tail = (int(stored[f"{name}/{field}"]) for field in Reference._fields[4:])
            found.append(Reference(name, position, velocity, acceleration, steps, tail))
        return found


class Job(NamedTuple):
    """What a judge's script was asked for on its command line."""

    vehicle: str
    kernel: Kernel | None
    starts: int
    given: Path | None
    rollouts: Path | None
    references: list[Reference]


def job(vehicles: tuple[str, ...]) -> Job:
    """Parse `SCRIPT VEHICLE [--kernel FOLDER] [--starts N] [--references FILE.npz] [--given FILE.npz --rollouts
    FILE.npz]`.

    FOLDER holds kernel.so and manifest.json; without it the other controllers fly alone. --references: what is to be
    followed, by default a point. --given: fly nothing, but
    write to --rollouts where the judge's plant goes from its starts under its commands.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("vehicle", choices=vehicles)
    parser.add_argument("--kernel", type=Path)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--references", type=Path)
    parser.add_argument("--given", type=Path)
    parser.add_argument("--rollouts", type=Path)
    args = parser.parse_args()
    kernel = Kernel(args.kernel / "kernel.so", args.kernel / "manifest.json") if args.kernel else None
    references = read_references(args.references) if args.references else [HOVER]
    return Job(args.vehicle, kernel, args.starts, args.given, args.rollouts, references)

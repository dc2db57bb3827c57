"""What the app for a Crazyflie orders and who flies, step by step, against the integer reference."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.firmware.crazyflie_loop import CORNERS, App, Floats, Reference, corner, numbers, starts
from qrl.export import kernel as reference
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy

POLICY = 1  # `qrl.state`, as docs/crazyflie.md lists it
UNARMED, SETPOINT, SETPOINT_OLD, STATE_OLD, NOT_FINITE = 0, 2, 3, 4, 5
CURVES = {0.12: -0.1041, 0.2: -0.0339}  # c of the rotors' thrust by THRUST_MAX [N]: crazyflow's cf2x_L250, cf21B_500
LEAST_N = {0.12: 0.01281758, 0.2: 0.02136263}  # THRUST_MIN
TOLERANCE = 0.004  # of a force: a step or two of the integer network's inputs, which float rounding may move
PLACE, VELOCITY, YAW, KIND, AGE = 13, 16, 25, 30, 31  # of the set-point, in `App.tick`'s numbers
MOVING = Reference(*np.array([[0.3, -0.2, 0.5], [0.4, 0.2, -0.1], [0.8, -0.6, 0.4], [1.0, 2.0, -1.5]]), yaw_deg=35.0)


class Expected(NamedTuple):
    """An oracle of what a policy orders."""

    policy: Policy
    kernel: Kernel
    thrust_max_N: float

    def observation(self, state: Floats, now: Reference) -> NDArray[np.float32]:
        """Of a state [13] (`crazyflie_loop.numbers`), in the world turned by the heading that is asked for."""
        yaw = np.deg2rad(now.yaw_deg)
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        axis, w = state[7:10], state[6]
        cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        attitude = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
        parts = [
            (turn @ attitude).ravel(),
            turn @ (state[0:3] - now.position_m),
            turn @ (state[3:6] - now.velocity_m_s),
        ]
        parts.append(state[10:13])
        for port in self.policy.observations[18::3]:
            t = port.ahead_s or 0.0
            parts.append(turn @ (t * now.acceleration_m_s2 + t * t / 2.0 * now.jerk_m_s3))
        return np.concatenate(parts)[None].astype(np.float32)

    def forces(self, memory: NDArray[np.int64], state: Floats, now: Reference) -> tuple[NDArray[np.int64], Floats]:
        """Memory after the step, and of M1 to M4 the fractions of THRUST_MAX [4]."""
        memory, _, action = reference.step(self.kernel, memory, self.observation(state, now))
        places = [corner(port.position_m) for port in self.policy.actions]
        ordered = action[0, [places.index(place) for place in CORNERS]].astype(float)
        key = round(self.thrust_max_N, 4)
        c = CURVES[key]
        share = ordered * (c + (1 - c) * ordered) if self.policy.actions[0].quantity else ordered / self.thrust_max_N
        return memory, np.clip(share, LEAST_N[key] / self.thrust_max_N, 1.0)

    def fresh(self) -> NDArray[np.int64]:
        return reference.initial_state(self.kernel, 1)


def states(n: int, seed: int) -> Floats:
    """n states that an estimator could report, each another."""
    return starts(n, seed, distance_m=0.8, speed_m_s=1.0, tilt_rad=1.2)


def faults(make: Callable[[], App], policy: Policy, kernel: Kernel) -> Iterator[str]:
    """What is wrong with the apps that `make` boots, unarmed; none if nothing is."""
    for case in CASES:
        yield from (f"{case.__name__}: {line}" for line in case(make(), policy, kernel))


def _armed(app: App) -> App:
    app.arm()
    return app


def _forces(app: App, expected: Expected, seed: int, steps: int = 60, gap: int = 1) -> Iterator[str]:
    """Faults of flying on from a fresh memory, a new state each step."""
    every, memory = round(expected.policy.control_period_s * 1e3), expected.fresh()
    force = np.zeros(4)
    for k, state in enumerate(states(steps, seed)):
        if k % every == 0:
            memory, force = expected.forces(memory, state, MOVING)
        found = app.tick(numbers(state[None], MOVING)[0], gap if k == 0 else 1)
        if found[4] != POLICY or not found[5]:
            yield f"the policy does not fly at step {k}: state {found[4]}"
            return
        if found[:4].min() / 65535 * app.thrust_max_N < app.thrust_min_N:
            yield f"a motor is ordered less than THRUST_MIN, and stops, at step {k}"
            return
        if (error := np.abs(found[:4] / 65535 - force).max()) > TOLERANCE:
            yield f"a force differs by {error:.3f} at step {k}"
            return


def orders(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """Forces, hold and period."""
    yield from _forces(_armed(app), Expected(policy, kernel, app.thrust_max_N), seed=1)


def takes_over(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """Its memory is as after a reset whenever it takes up control, and it runs at once."""
    expected = Expected(policy, kernel, app.thrust_max_N)
    yield from _forces(_armed(app), expected, 2, steps=34)
    app.arm(False)
    for state in states(3, 3):
        if app.tick(numbers(state[None], MOVING)[0])[4] != UNARMED:
            yield "it flies unarmed"
    yield from _forces(_armed(app), expected, 4, steps=26)
    yield from _forces(app, expected, 5, steps=26, gap=700)  # another controller flew between


def stock(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """Unarmed the stock controller flies, and nothing of the policy's forces is left in what it orders."""
    rows = numbers(states(40, 6), MOVING)
    wanted = [app.tick(row) for row in rows[:20]]
    if any(found[4] != UNARMED or found[5] for found in wanted):
        yield "it flies unarmed"
    app.arm()
    for row in rows[20:32]:
        app.tick(row)
    app.arm(False)
    if not np.array_equal(app.tick(rows[32])[:4], wanted[-1][:4]) and app.simple_stock:
        yield "the stock controller's first order is mixed with the policy's"


def set_points(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """It flies to absolute positions with a heading, and to no other; the policy takes up control again."""
    rows = iter(numbers(states(100, 7), MOVING))
    for kind, age, wanted in (
        (1, 0, POLICY),
        (0, 0, SETPOINT),
        (1, 0, POLICY),
        (3, 0, SETPOINT),
        (2, 0, POLICY),
        (1, 240, POLICY),
        (1, 260, SETPOINT_OLD),
        (1, 3, POLICY),
    ):
        row = next(rows)
        row[[KIND, AGE]] = kind, age
        found = _armed(app).tick(row)
        if found[4] != wanted or bool(found[5]) != (wanted == POLICY):
            yield f"state {found[4]} at a set-point of kind {kind}, {age} ms old; expected {wanted}"
    if app.counts()[0] != 4:
        yield f"{app.counts()[0]} take-overs, expected 4"


def full_state(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """The heading of a full-state set-point is that of its quaternion, tilted or not."""
    expected = Expected(policy, kernel, app.thrust_max_N)
    half, lean = np.deg2rad(MOVING.yaw_deg) / 2.0, 0.2
    state = states(1, 8)
    row = numbers(state, MOVING._replace(yaw_deg=-100.0))[0]
    # A rotation about z by the yaw, after one about the body's y axis.
    c, s, u, v = np.cos(half), np.sin(half), np.cos(lean), np.sin(lean)
    row[26:30] = -s * v, c * v, s * u, c * u
    row[KIND] = 2
    found = _armed(app).tick(row)
    _, force = expected.forces(expected.fresh(), state[0], MOVING)
    if found[4] != POLICY or np.abs(found[:4] / 65535 - force).max() > TOLERANCE:
        yield "the heading of a full state is not that of its quaternion"


def old_state(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """An estimate that stands still gives control to the stock controller, until the policy is armed anew."""
    rows = numbers(states(200, 9), MOVING)
    _armed(app).tick(rows[0])
    found = [app.tick(rows[0])[4] for _ in range(60)]
    if found != [POLICY] * 50 + [STATE_OLD] * 10:
        yield f"{found.count(POLICY)} ms until an old state is found, expected 50"
    if any(app.tick(row)[4] != STATE_OLD for row in rows[1:20]):
        yield "the fault is forgotten"
    app.arm(False)
    app.tick(rows[20])
    if _armed(app).tick(rows[21])[4] != POLICY:
        yield "it does not fly when armed anew"


def not_finite(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """Each number of the state and the gyro that is not finite, and a quaternion that is none: at once, until armed
    anew, and kept from the stock controller. Of the set-point, when the policy runs.
    """
    rows = iter(numbers(states(200, 10), MOVING))
    numbered = (*range(13), PLACE, VELOCITY, YAW)
    bad = [(i, value) for i in numbered for value in (np.nan, np.inf)] + [(slice(6, 10), 0.0), (slice(6, 10), 3.0)]
    for place, value in bad:
        app.arm(False)
        app.tick(next(rows))
        app.arm()
        row = next(rows)
        row[place] = value
        found = app.tick(row), app.tick(next(rows))
        if any(tick[4] != NOT_FINITE or tick[5] or (app.simple_stock and not tick[0]) for tick in found):
            yield f"number {place} = {value}: states {found[0][4]}, {found[1][4]}"


def kept_from_stock(app: App, policy: Policy, kernel: Kernel) -> Iterator[str]:
    """Whatever the stock controller flies for, it is given no number that is not finite, of the state or asked for."""
    rows = iter(numbers(states(200, 11), MOVING))
    for arm, kind, age, wanted in ((False, 1, 0, UNARMED), (True, 3, 0, SETPOINT), (True, 1, 260, SETPOINT_OLD)):
        app.arm(arm)
        for place in (*range(13), PLACE if kind == 1 else VELOCITY, YAW):
            good, bad = next(rows), next(rows)
            good[[KIND, AGE]] = bad[[KIND, AGE]] = kind, age
            bad[place] = np.nan
            found = app.tick(good), app.tick(bad)
            if any(tick[4] != wanted or (app.simple_stock and not tick[0]) for tick in found):
                yield f"number {place} is NaN: state {found[1][4]}, expected {wanted}, motors {found[1][:4]}"
    slow, fast = next(rows), next(rows)
    slow[KIND] = fast[KIND] = 3
    fast[[PLACE, VELOCITY]] = np.nan, 0.9
    if app.simple_stock and app.tick(slow)[0] == app.tick(fast)[0]:
        yield "a velocity without a place is not followed"


CASES = (orders, takes_over, stock, set_points, full_state, old_state, not_finite, kept_from_stock)

"""Mistakes in the source of an app for a Crazyflie, by what is wrong then; NAME is its policy's name in capitals."""

from experiments.firmware.crazyflie_loop import Mutant
from qrl.export.policy import Policy

Mistakes = dict[str, tuple[Mutant, ...]]
Q = "const quaternion_t q = state->attitudeQuaternion;"
Q_ORDER = Q.replace(" q ", " p ") + " const quaternion_t q = {.x = p.y, .y = p.z, .z = p.w, .w = p.x};"
STOCK = "controllerPid(&stock, setpoint, sensors, state, takes_over ? 0 : step);\n    *control = stock;"
TO_BODY = """for (int i = 0; i < 3; ++i) {
        axis[i] = 0.0f;
        for (int j = 0; j < 3; ++j) axis[i] += axes[i][j] * obs[at + j];
    } for (int i = 0; i < 3; ++i) obs[at + i] = axis[i];"""


def mistakes(NAME: str, policy: Policy) -> Mistakes:
    """All of them: of orders, and of who flies."""
    return of_orders(NAME, policy) | of_control(NAME)


def of_orders(NAME: str, policy: Policy) -> Mistakes:
    """Units, orders and signs: a flight is to go wrong too."""
    found = {
        "gyro in deg/s": each_axis("gyro.{} * RAD_PER_DEG", "gyro.{}"),
        **{f"gyro.{axis} the other way": one(f"gyro.{axis} *", f"gyro.{axis} * -") for axis in "xyz"},
        "quaternion w x y z": one(Q, Q_ORDER),
        "quaternion conjugated": one(Q, Q.replace("const ", "") + " q.w = -q.w;"),
        "matrix by columns": one("R11 + 3 * row + column", "R11 + 3 * column + row"),
        **swaps(),
        "motors mirrored: spins reversed": motors(3, 2, 1, 0),
        "motors turned by one": motors(1, 2, 3, 0),
        "position the other way": one("state->position.x - setpoint->position.x", "-state->position.x"),
        "position absolute": each_axis("state->position.{0} - setpoint->position.{0}", "state->position.{0}"),
        "velocity absolute": each_axis("state->velocity.{0} - setpoint->velocity.{0}", "state->velocity.{0}"),
        "velocity in the body frame": in_body_frame("VX", NAME),
        "position in the body frame": in_body_frame("PX", NAME),
        "heading ignored": one("setpoint->attitude.yaw * RAD_PER_DEG", "0.0f"),
        "heading the other way": one("setpoint->attitude.yaw *", "-setpoint->attitude.yaw *"),
        "heading in rad": one("attitude.yaw * RAD_PER_DEG", "attitude.yaw"),
        "forces of another unit": one(": share;", ": 1.5f * share;"),
        "each millisecond": one("step + PERIOD_STEPS", "step + 1"),
        "half as often": one("step + PERIOD_STEPS", "step + 2 * PERIOD_STEPS"),
        "motors may stop": one("share < LEAST_FRACTION ? LEAST_FRACTION", "share < 0.0f ? 0.0f"),
        "forces as torques": one("controlModeForce;", "controlModeForceTorque;"),
    }
    if len(policy.observations) > 18:
        as_given = "rotated((const float[]){1.0f, 0.0f}, setpoint->acc"
        found |= {
            "no acceleration ahead": each_axis("setpoint->acceleration.{} * t", "0.0f * t"),
            "no jerk ahead": one("half = 0.5f * t * t", "half = 0.0f"),
            "acceleration not rotated": one("rotated(heading, setpoint->acc", as_given),
        }
    if policy.actions[0].quantity:
        return found | {"speed as force": one("action * (c + (1.0f - c) * action)", "action")}
    return found | {"THRUST_MAX of another platform": one("action / THRUST_MAX;", "action / (0.6f * THRUST_MAX);")}


def of_control(NAME: str) -> Mistakes:
    """Who flies, and from what memory."""
    not_usable = "if (!usable(state, sensors)) {\n            who"
    return {
        "no reset": one(f"{NAME.lower()}_reset(&memory);", ""),
        "no reset after a gap": one("before != POLICY || !continued", "before != POLICY"),
        "not at once": one("next_step = step;", "next_step = step + 3;"),
        "flies unarmed": one("if (!arm)", "if (0)"),
        "any set-point": one("return STOCK_SETPOINT;", ";"),
        "set-point of any age": one("return STOCK_SETPOINT_OLD;", ";"),
        "state of any age": one("> state_ms", "> 100000u"),
        "any number": (
            *one(not_usable, not_usable.replace("!usable(state, sensors)", "0")),
            *one("(status == 2)", "(0)"),
        ),
        "status 2 ignored": one("if (status == 2)", "if (0)"),
        "any quaternion": one("square > 0.9f && square < 1.1f", "true"),
        "stock given a state that is not finite": one("&last_sensors, &last_state, step", "sensors, state, step"),
        "stock given a set-point that is not finite": one("control, &last_setpoint,", "control, setpoint,"),
        "a set-point is to have what it does not ask for": one("(!place || ", "("),
        "faults forgotten": one("if (fault != STOCK_UNARMED)", "if (0)"),
        "stock output mixed": one(STOCK, "controllerPid(control, setpoint, sensors, state, step);"),
    }


def one(old: str, new: str) -> tuple[Mutant, ...]:
    return (Mutant(old, new),)


def each_axis(old: str, new: str) -> tuple[Mutant, ...]:
    """With each of x, y, z in both."""
    return tuple(Mutant(old.format(axis), new.format(axis)) for axis in "xyz")


def motors(*places: int) -> tuple[Mutant, ...]:
    """M1 to M4 ordered as if they were these."""
    return tuple(Mutant(f"held[{i}] = ", f"held[{place}] = ") for i, place in enumerate(places))


def swaps() -> Mistakes:
    """Each pair of motors."""
    pairs = [(i, j) for i in range(4) for j in range(i)]
    return {f"M{j + 1} and M{i + 1} swapped": motors(*({i: j, j: i}.get(k, k) for k in range(4))) for i, j in pairs}


def in_body_frame(what: str, NAME: str) -> tuple[Mutant, ...]:
    """Position or velocity turned into the body frame."""
    before = f"    obs[{NAME}_OBS_WX] ="
    return one(before, f"    {{ const int at = {NAME}_OBS_{what}; {TO_BODY} }}\n{before}")

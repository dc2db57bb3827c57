"""What firmware needs to know of a policy: whether it flies a vehicle, on what it is told, and with which motors."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from qrl.export.policy import UP, WORLD_SIZE, Policy

TEMPLATES = Path(__file__).parent / "templates"
MEASURED = [
    *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    *(f"{quantity}{axis}" for quantity in "pvw" for axis in "xyz"),
]
GRAVITY_M_S2 = 9.81


class Corner(NamedTuple):
    """A motor of a firmware's quadrotor, with the numbering and the spins that it is set up with."""

    name: str
    x: int  # signs of its place, body x forward
    y: int  # and y left
    spin: int  # sign of the reaction torque about body z, up


def orders_speeds(policy: Policy) -> bool:
    """Whether actions are fractions of each rotor's greatest speed, so that a policy is bound to no vehicle."""
    return all(port.quantity == "rotor speed fraction" for port in policy.actions)


def misfit(policy: Policy) -> str | None:
    """Why a policy fits no quadrotor that is told its state and a set-point, in one line; None if it fits."""
    ahead = policy.observations[WORLD_SIZE:]
    measured = [port.name for port in policy.observations[:WORLD_SIZE]] == MEASURED
    if not measured or len(ahead) % 3 or any(port.ahead_s is None for port in ahead):
        return "the observation is not a vehicle's state, and previews of a reference"
    if len(policy.actions) != 4:
        return f"it orders four motors, and the policy has {len(policy.actions)} actions"
    if not (orders_speeds(policy) or all(port.unit == "N" for port in policy.actions)):
        return "the motors are ordered neither thrusts [N] nor fractions of their greatest speed"
    return tilted(policy)


def tilted(policy: Policy) -> str | None:
    """Why a policy fits no vehicle whose motors all push along body z; None if it does."""
    names = ", ".join(port.name for port in policy.actions if port.axis != UP)
    return f"all motors push along body z, and the vehicle's are tilted ({names})" if names else None


def flies(policy: Policy) -> bool:
    """Whether the actions are motors."""
    return all(port.spin is not None for port in policy.actions)


def by_place(policy: Policy, corners: Sequence[Corner]) -> list[int] | str:
    """The action of each corner, by the motors' positions; or why there is none."""
    signs = [_quadrant(port.position_m) for port in policy.actions]
    order = []
    for corner in corners:
        there = [i for i, place in enumerate(signs) if place == (corner.x, corner.y)]
        if len(there) != 1:
            return f"there is one motor {corner.name}, and the vehicle has {len(there)}"
        order.append(there[0])
    return order


def by_place_and_spin(policy: Policy, corners: Sequence[Corner]) -> list[int] | str:
    """As `by_place`; and the spins must be those of the corners."""
    order = by_place(policy, corners)
    if isinstance(order, str):
        return order
    for corner, i in zip(corners, order, strict=True):
        port = policy.actions[i]
        if port.spin != corner.spin:
            return f"the motor {corner.name} has spin {corner.spin:+d}, and the vehicle's ({port.name}) {port.spin:+d}"
    return order


def _quadrant(position_m: tuple[float, ...] | None) -> tuple[int, int] | None:
    """Signs of a motor's x and y; None if it has no place off the axes."""
    if position_m is None or 0.0 in position_m[:2]:
        return None
    x, y = (int(math.copysign(1, value)) for value in position_m[:2])
    return x, y


def arm_m(policy: Policy) -> float:
    """Mean distance of the motors from the body's z axis."""
    return sum(math.hypot(*(port.position_m or (0.0, 0.0))[:2]) for port in policy.actions) / len(policy.actions)


def mass_kg(policy: Policy) -> float:
    """That the hover thrusts lift."""
    return sum(port.safe for port in policy.actions) / GRAVITY_M_S2


def facts(policy: Policy) -> list[str]:
    """What to know of any policy before flight, a sentence each."""
    run, about = policy.provenance, policy.observations[9].frame
    return [
        f"{' '.join(run.task.split())}: {' '.join(run.description.split())}.",
        f"The set-point's position is {about.removeprefix('world: position from ')}.",
        f"The policy runs every {policy.control_period_s * 1e3:g} ms; the motors hold between.",
    ]


# Texts of templates


def filled(folder: str, values: dict[str, str], name: str) -> dict[str, str]:
    """The templates of a folder: path in it, NAME replaced -> text, each @placeholder@ replaced by its value."""
    root = TEMPLATES / folder
    return {
        path.relative_to(root).as_posix().replace("NAME", name): re.sub(
            r"@(\w+)@", lambda match: values[match[1]], path.read_text(encoding="utf-8")
        )
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def c_float(value: float) -> str:
    """A literal of C's float."""
    text = f"{value:.9g}"
    return f"{text}f" if set(text) & set(".e") else f"{text}.0f"


def preview(policy: Policy, name: str, acceleration: str, jerk: str) -> str:
    """C that fills in the previews; nothing where there are none.

    `acceleration`, `jerk`: C of a component of the set-point's, with {axis} for x, y, z and {i} for 0, 1, 2.
    """
    ports = policy.observations[WORLD_SIZE::3]
    if not ports:
        return ""
    along = [
        f"{acceleration.format(axis=axis, i=i)} * t + {jerk.format(axis=axis, i=i)} * half"
        for i, axis in enumerate("xyz")
    ]
    return PREVIEW.format(
        NAME=name.upper(),
        times=", ".join(c_float(port.ahead_s or 0.0) for port in ports),
        count=len(ports),
        along=",\n               ".join(along),
    )


PREVIEW = """

    /* A set-point does not tell what comes: the reference is taken to go on with its acceleration and jerk. */
    static const float ahead_s[] = {{{times}}};
    for (int k = 0; k < {count}; ++k) {{
        const float t = ahead_s[k], half = 0.5f * t * t;
        rotated(heading, {along}, &obs[{NAME}_OBS_D1X + 3 * k]);
    }}"""

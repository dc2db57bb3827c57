"""The hook for Betaflight and its relatives: a kernel behind north, east, down (docs/betaflight.md).

Facts of Indiflight, whose neural controller it can be, are those of its `src/main/flight/nn_control.c` and
`src/main/fc/core.c` at 15b7626; the order and the spins of motors those of Betaflight's mixer QUADX.
"""

import re
from pathlib import Path

from qrl.export import crazyflie
from qrl.export.policy import Policy

TEMPLATES = Path(__file__).parent / "firmware" / "betaflight"
FOLDER = "betaflight"
# Its motors 1 to 4: the signs of body x (front) and y (left), and of the reaction torque about body z (up) with
# propellers that turn inwards at the front, as it is set up at first.
MOTORS = ((-1, -1, 1), (1, -1, -1), (-1, 1, -1), (1, 1, 1))
NAMES = ("rear right", "front right", "rear left", "front left")


def refusal(policy: Policy) -> str | None:
    """Why there is no hook for a policy, in one line; None if there is."""
    if not crazyflie.observes_vehicle(policy):
        return "the observation is not a vehicle's state, and previews of a reference"
    if len(policy.actions) != 4:
        return f"it orders four motors, and the policy has {len(policy.actions)} actions"
    if not (crazyflie.any_vehicle(policy) or all(port.unit == "N" for port in policy.actions)):
        return "the motors are ordered neither thrusts [N] nor fractions of their greatest speed"
    found = motors(policy)
    return found if isinstance(found, str) else None


def motors(policy: Policy) -> tuple[list[int], bool] | str:
    """The action of each of motors 1 to 4, and whether they turn the other way than Betaflight's do at first; or why
    there are none.
    """
    places = [crazyflie.quadrant(port) for port in policy.actions]
    order, reversed_ = [], set[bool]()
    for number, (x, y, spin) in enumerate(MOTORS, 1):
        there = [i for i, place in enumerate(places) if place and place[:2] == (x, y)]
        if len(there) != 1:
            return f"a quad X has one motor {NAMES[number - 1]} ({number}), and the vehicle {len(there)}"
        order.append(there[0])
        reversed_.add(policy.actions[there[0]].spin != spin)
    if len(reversed_) > 1:
        return "its motors do not turn as a quad X's do, one diagonal each way"
    return order, reversed_.pop()


def files(policy: Policy, kernel: dict[str, str], name: str) -> dict[str, str]:
    """The hook of a policy: path in the export folder -> text; none with a `refusal`. `kernel`: NAME.c and NAME.h."""
    if refusal(policy):
        return {}
    values = _values(policy, name)
    hook = {
        f"{FOLDER}/{path.name.replace('NAME', name)}": re.sub(
            r"@(\w+)@", lambda match: values[match[1]], path.read_text(encoding="utf-8")
        )
        for path in sorted(TEMPLATES.iterdir())
    }
    return hook | {f"{FOLDER}/{file}": kernel[file] for file in (f"{name}.c", f"{name}.h")}


def section(policy: Policy) -> str:
    """What report.md says of it; nothing of a policy that flies no vehicle."""
    if any(port.spin is None for port in policy.actions):
        return ""
    reason = refusal(policy)
    said = f"No hook: {reason}." if reason else f"`{FOLDER}/` has a hook; its README says where to put it."
    return f"\n## Betaflight, Indiflight\n\n{said}\n"


def _values(policy: Policy, name: str) -> dict[str, str]:
    """Values of the templates' @placeholders@."""
    found = motors(policy)
    assert not isinstance(found, str), found
    order, reversed_ = found
    ports = [policy.actions[i] for i in order]
    return {
        "name": name,
        "NAME": name.upper(),
        "period_ms": f"{policy.control_period_s * 1e3:g}",
        "rate_hz": f"{1.0 / policy.control_period_s:.0f}",
        **{f"m{number}": port.name.upper() for number, port in enumerate(ports, 1)},
        **{f"most{number}": _float(port.high) for number, port in enumerate(ports, 1)},
        "preview": _preview(policy, name),
        "fraction": SPEED if crazyflie.any_vehicle(policy) else THRUST.format(c=_float(ports[0].thrust_curve)),
        "command": "the rotor's speed, of its greatest, 0 to 1",
        "spins": OUTWARDS if reversed_ else INWARDS,
        "facts": "\n".join(f"- {line}" for line in facts(policy)),
    }


def _float(value: float) -> str:
    """As a literal of C's float."""
    text = f"{value:.9g}"
    return f"{text}f" if set(text) & set(".e") else f"{text}.0f"


INWARDS = "the front propellers turn inwards (yaw_motors_reversed = OFF)"
OUTWARDS = "the front propellers turn outwards (yaw_motors_reversed = ON)"
SPEED = "    const float share = of_most; /* it is a rotor's speed */"
THRUST = """\
    /* A thrust, of the greatest: c w + (1 - c) w^2 of a rotor's speed w, as the vehicle was trained with. */
    const float c = {c}, thrust = of_most > 0.0f ? of_most : 0.0f;
    const float share = c < 1.0f ? (sqrtf(c * c + 4.0f * (1.0f - c) * thrust) - c) / (2.0f * (1.0f - c)) : thrust;"""


def _preview(policy: Policy, name: str) -> str:
    """C that fills in the previews."""
    ports = policy.observations[18::3]
    if not ports:
        return ""
    times = ", ".join(_float(port.ahead_s or 0.0) for port in ports)
    return PREVIEW.format(NAME=name.upper(), times=times, count=len(ports))


PREVIEW = """

    /* A set-point does not tell what comes: the reference is taken to go on with its acceleration and jerk. */
    static const float ahead_s[] = {{{times}}};
    const float *a = setpoint->acceleration_m_s2, *j = setpoint->jerk_m_s3;
    for (int k = 0; k < {count}; ++k) {{
        const float t = ahead_s[k], half = 0.5f * t * t;
        turned(heading, a[0] * t + j[0] * half, a[1] * t + j[1] * half, a[2] * t + j[2] * half,
               &obs[{NAME}_OBS_D1X + 3 * k]);
    }}"""


def facts(policy: Policy) -> list[str]:
    """What to know of the policy before flight, a sentence each."""
    run, about = policy.provenance, policy.observations[9].frame
    found = [
        f"{' '.join(run.task.split())}: {' '.join(run.description.split())}.",
        f"The set-point's position is {about.removeprefix('world: position from ')}.",
        f"The policy runs every {policy.control_period_s * 1e3:g} ms; the commands hold between.",
    ]
    if crazyflie.any_vehicle(policy):
        found.append("It was trained on many vehicles and is told nothing of yours.")
    else:
        most_N = max(port.high for port in policy.actions)
        found.append(
            f"Trained to fly {crazyflie.mass_kg(policy) * 1e3:.0f} g with motors {crazyflie.arm_m(policy) * 1e3:.0f} mm"
            f" from the center and of up to {most_N:.3g} N each. Weigh yours, and measure its thrust."
        )
    if len(policy.observations) > 18:
        found.append(
            "It looks ahead: give the set-point's acceleration and jerk, or the reference is taken to go straight on."
        )
    return found

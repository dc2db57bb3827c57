"""The hook: a kernel behind north, east, down and front, right, down, with a clock and time-outs, for any firmware."""

from collections.abc import Sequence
from typing import NamedTuple

from qrl.export.firmware import vehicle
from qrl.export.firmware.vehicle import Corner, c_float
from qrl.export.policy import WORLD_SIZE, Policy


class Firmware(NamedTuple):
    """For which the hook is."""

    title: str
    quad: str  # whose motors are in its order
    position_us: int  # ages above which a policy does not fly
    attitude_us: int
    setpoint_us: int


def files(policy: Policy, name: str, of: Firmware, corners: Sequence[Corner], order: Sequence[int]) -> dict[str, str]:
    """NAME_hook.c and NAME_hook.h; `order`: the action of each corner."""
    ports = [policy.actions[i] for i in order]
    values = {
        "name": name,
        "NAME": name.upper(),
        "firmware": of.title,
        "order": f"{of.quad}: " + ", ".join(corner.name for corner in corners),
        "position_us": str(of.position_us),
        "attitude_us": str(of.attitude_us),
        "setpoint_us": str(of.setpoint_us),
        "period_ms": f"{policy.control_period_s * 1e3:g}",
        **{f"motor{number}": corner.name for number, corner in enumerate(corners, 1)},
        **{f"m{number}": port.name.upper() for number, port in enumerate(ports, 1)},
        **{f"most{number}": c_float(port.high) for number, port in enumerate(ports, 1)},
        "preview": vehicle.preview(policy, name, "setpoint->acceleration_m_s2[{i}]", "setpoint->jerk_m_s3[{i}]"),
        "fraction": SPEED if vehicle.orders_speeds(policy) else THRUST.format(c=c_float(ports[0].thrust_curve)),
        "command": COMMAND,
    }
    return vehicle.filled("ned", values, name)


COMMAND = "the rotor's speed, of its greatest, 0 to 1"
SPEED = "    const float share = of_most; /* it is a rotor's speed */"
THRUST = """\
    /* A thrust, of the greatest: c w + (1 - c) w^2 of a rotor's speed w, as the vehicle was trained with. */
    const float c = {c}, thrust = of_most > 0.0f ? of_most : 0.0f;
    /* Rationalized, so that a c near 1 does not cancel; with c below 0 no thrust would be 0 / 0. */
    const float root = sqrtf(c * c + 4.0f * (1.0f - c) * (thrust > 1e-6f ? thrust : 1e-6f));
    const float share = 2.0f * thrust / (c + root);"""


def facts(policy: Policy) -> list[str]:
    """What to know of the policy before flight, a sentence each."""
    found = vehicle.facts(policy)
    if vehicle.orders_speeds(policy):
        found.append("It was trained on many vehicles and is told nothing of yours.")
    else:
        most_N = max(port.high for port in policy.actions)
        found.append(
            f"Trained to fly {vehicle.mass_kg(policy) * 1e3:.0f} g with motors {vehicle.arm_m(policy) * 1e3:.0f} mm"
            f" from the center and of up to {most_N:.3g} N each. Weigh yours, and measure its thrust."
        )
    if len(policy.observations) > WORLD_SIZE:
        found.append(
            "It looks ahead: give the set-point's acceleration and jerk, or the reference is taken to go straight on."
        )
    return found

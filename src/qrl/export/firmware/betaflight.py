"""The hook for Betaflight and its relatives: a kernel behind north, east, down (docs/betaflight.md).

Facts of Indiflight, whose neural controller it can be, are those of its `src/main/flight/nn_control.c` and
`src/main/fc/core.c` at 15b7626; the order and the spins of motors those of Betaflight's mixer QUADX.
"""

from qrl.export.firmware import ned, vehicle
from qrl.export.firmware.vehicle import Corner
from qrl.export.policy import Policy

TITLE, FOLDER = "Betaflight, Indiflight", "betaflight"
WHAT = "a hook"
MOTORS = (  # with propellers that turn inwards at the front, as it is set up at first
    Corner("rear right (1)", -1, -1, 1),
    Corner("front right (2)", 1, -1, -1),
    Corner("rear left (3)", -1, 1, -1),
    Corner("front left (4)", 1, 1, 1),
)
HOOK = ned.Firmware("Betaflight and its relatives", "Betaflight's quad X", 250_000, 20_000, 1_000_000)


def refusal(policy: Policy) -> str | None:
    """Why there is no hook for a policy, in one line; None if there is."""
    if reason := vehicle.misfit(policy):
        return reason
    found = motors(policy)
    return found if isinstance(found, str) else None


def motors(policy: Policy) -> tuple[list[int], bool] | str:
    """The action of each of motors 1 to 4, and whether they turn the other way than Betaflight's do at first; or why
    there are none.
    """
    order = vehicle.by_place(policy, MOTORS)
    if isinstance(order, str):
        return f"of a quad X's motors, {order}"
    reversed_ = {policy.actions[i].spin != corner.spin for corner, i in zip(MOTORS, order, strict=True)}
    if len(reversed_) > 1:
        return "its motors do not turn as a quad X's do, one diagonal each way"
    return order, reversed_.pop()


def files(policy: Policy, kernel: dict[str, str], name: str) -> dict[str, str]:
    """The hook of a policy: path in the export folder -> text; none with a `refusal`. `kernel`: NAME.c and NAME.h."""
    if refusal(policy):
        return {}
    found = motors(policy)
    assert not isinstance(found, str), found
    order, reversed_ = found
    texts = ned.files(policy, name, HOOK, MOTORS, order)
    texts |= vehicle.filled(FOLDER, _values(policy, name, reversed_), name)
    texts |= {file: kernel[file] for file in (f"{name}.c", f"{name}.h")}
    return {f"{FOLDER}/{path}": text for path, text in texts.items()}


def section(policy: Policy) -> str:
    """What report.md says of it; nothing of a policy that flies no vehicle."""
    if not vehicle.flies(policy):
        return ""
    reason = refusal(policy)
    said = f"No hook: {reason}." if reason else f"`{FOLDER}/` has a hook; its README says where to put it."
    return f"\n## {TITLE}\n\n{said}\n"


def _values(policy: Policy, name: str, reversed_: bool) -> dict[str, str]:
    """Values of the templates' @placeholders@."""
    return {
        "name": name,
        "NAME": name.upper(),
        "period_ms": f"{policy.control_period_s * 1e3:g}",
        "rate_hz": f"{1.0 / policy.control_period_s:.0f}",
        "command": ned.COMMAND,
        "spins": OUTWARDS if reversed_ else INWARDS,
        "facts": "\n".join(f"- {line}" for line in ned.facts(policy)),
    }


INWARDS = "the front propellers turn inwards (yaw_motors_reversed = OFF)"
OUTWARDS = "the front propellers turn outwards (yaw_motors_reversed = ON)"

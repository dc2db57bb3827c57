"""The app for a Crazyflie: an out-of-tree controller of crazyflie-firmware around a kernel (docs/crazyflie.md).

Facts of the firmware are those of its release 2026.08: `src/platform/interface/platform_defaults_*.h`,
`src/modules/src/power_distribution_quadrotor.c`.
"""

import math
from typing import NamedTuple

from qrl.export.emit import widest
from qrl.export.firmware import vehicle
from qrl.export.firmware.vehicle import Corner, arm_m, mass_kg
from qrl.export.policy import WORLD_SIZE, Policy

TITLE, FOLDER = "Crazyflie", "crazyflie"
WHAT = "an app for its firmware"
RELEASE = "2026.08"
MOTORS = (
    Corner("front right (M1)", 1, -1, -1),
    Corner("back right (M2)", -1, -1, 1),
    Corner("back left (M3)", -1, 1, -1),
    Corner("front left (M4)", 1, 1, 1),
)
MOST_ARM_RATIO = 1.3  # of a motor's distance from the center, by which a vehicle may differ from the platform
MOST_HOVER = 0.8  # of a motor's greatest thrust
MAIN_LOOP_US = 1000
STABILIZER_STACK, OTHER_FRAMES = 1800, 400  # bytes of its task; those around the kernel's two buffers
APP_STACK, APP_WIDTH = 600, 64  # words of the app's task, for buffers of so many numbers


class Platform(NamedTuple):
    """A build of the firmware."""

    title: str
    defconfig: str
    config: str  # besides, in app-config
    guard: str  # true in the preprocessor for this build
    thrust_max_N: float  # of each motor
    mass_kg: float
    arm_m: float  # from the center to a motor
    thrust_curve: float  # c of thrust/max = c·w + (1 − c)·w², w the rotor speed/max: crazyflow 0.4.0, identified


PLATFORMS = (
    Platform(
        "Crazyflie 2.1+ or 2.X with its propellers",
        "cf2_defconfig",
        "CONFIG_CRAZYFLIE_21_PLUS=y",
        "defined(CONFIG_PLATFORM_CF2) && !defined(CONFIG_CRAZYFLIE_THRUST_UPGRADE_KIT)",
        0.12,
        0.029,
        0.046,
        -0.1041,
    ),
    Platform(
        "Crazyflie 2.1 with the thrust upgrade kit",
        "cf2_defconfig",
        "CONFIG_CRAZYFLIE_THRUST_UPGRADE_KIT=y",
        "defined(CONFIG_PLATFORM_CF2) && defined(CONFIG_CRAZYFLIE_THRUST_UPGRADE_KIT)",
        0.18,
        0.0325,
        0.046,
        -0.1041,
    ),
    Platform(
        "Crazyflie 2.1 Brushless",
        "cf21bl_defconfig",
        "",
        "defined(CONFIG_PLATFORM_CF21BL)",
        0.2,
        0.0393,
        0.050,
        -0.0339,
    ),
)


def refusal(policy: Policy) -> str | None:
    """Why a policy cannot fly on a Crazyflie, in one line; None if it can."""
    if reason := vehicle.misfit(policy):
        return reason
    period_us = round(policy.control_period_s * 1e6)
    if period_us % MAIN_LOOP_US or period_us < MAIN_LOOP_US:
        return f"a control period of {policy.control_period_s * 1e3:g} ms is no whole number of the main loop's 1 ms"
    if (frame := 4 * widest(policy)) + OTHER_FRAMES > STABILIZER_STACK:
        return f"its two buffers take {frame:,} of the stabilizer's {STABILIZER_STACK:,} bytes of stack"
    order = vehicle.by_place_and_spin(policy, MOTORS)
    if isinstance(order, str):
        return f"of a Crazyflie's motors, {order}"
    if vehicle.orders_speeds(policy):
        return None
    hover_N = max(port.safe for port in policy.actions)
    most_N = max(platform.thrust_max_N for platform in PLATFORMS)
    if hover_N > MOST_HOVER * most_N:
        return f"hover takes {hover_N:.3g} N of a motor, and a Crazyflie's have at most {most_N:g} N"
    if not _fitting(policy):
        least, greatest = (f"{pick(p.arm_m for p in PLATFORMS) * 1e3:.0f}" for pick in (min, max))
        return (
            f"the motors are {arm_m(policy) * 1e3:.0f} mm from the center, and a Crazyflie's {least} to {greatest} mm"
        )
    return None


def _fitting(policy: Policy) -> list[Platform]:
    """The platforms that a policy in newtons can fly on, the nearest in mass, size and thrust first."""
    hover_N, limit_N = max(port.safe for port in policy.actions), max(port.high for port in policy.actions)

    def distance(platform: Platform) -> float:
        pairs = (mass_kg(policy), platform.mass_kg), (arm_m(policy), platform.arm_m), (limit_N, platform.thrust_max_N)
        return sum(abs(math.log(a / b)) for a, b in pairs)

    fit = [
        platform
        for platform in PLATFORMS
        if hover_N <= MOST_HOVER * platform.thrust_max_N
        and 1 / MOST_ARM_RATIO <= arm_m(policy) / platform.arm_m <= MOST_ARM_RATIO
    ]
    return sorted(fit, key=distance)


def platform(policy: Policy) -> Platform | None:
    """The build that a policy is for; None: any of `PLATFORMS`."""
    return None if vehicle.orders_speeds(policy) else _fitting(policy)[0]


def files(policy: Policy, kernel: dict[str, str], name: str) -> dict[str, str]:
    """The app of a policy: path in the export folder -> text; none with a `refusal`. `kernel`: NAME.c and NAME.h."""
    if refusal(policy):
        return {}
    texts = vehicle.filled(FOLDER, _values(policy, name), name)
    texts |= {f"src/{file}": kernel[file] for file in (f"{name}.c", f"{name}.h")}
    return {f"{FOLDER}/{path}": text for path, text in texts.items()}


def section(policy: Policy) -> str:
    """What report.md says of it; nothing of a policy that flies no vehicle."""
    if not vehicle.flies(policy):
        return ""
    reason = refusal(policy)
    lines = [f"No app: {reason}."] if reason else [f"`{FOLDER}/` is an app; its README says how to build it.", ""]
    lines += [] if reason else [f"- {fact}" for fact in facts(policy)]
    return f"\n## {TITLE}\n\n" + "\n".join(lines) + "\n"


def _values(policy: Policy, name: str) -> dict[str, str]:
    """Values of the templates' @placeholders@."""
    order = vehicle.by_place_and_spin(policy, MOTORS)
    assert not isinstance(order, str), order
    build = platform(policy)
    return {
        "name": name,
        "NAME": name.upper(),
        "period_ms": f"{policy.control_period_s * 1e3:.0f}",
        "app_stack": f"{APP_STACK + max(widest(policy) - APP_WIDTH, 0)}",
        **{f"m{number}": policy.actions[i].name.upper() for number, i in enumerate(order, 1)},
        "preview": vehicle.preview(policy, name, "setpoint->acceleration.{axis}", "setpoint->jerk.{axis}"),
        "fraction": _fraction(policy),
        "platform_guard": _guard(policy, build),
        "platform_config": f"\n{build.config}" if build and build.config else "",
        "defconfig": build.defconfig if build else "cf2_defconfig",
        "image": "build/" + (build.defconfig if build else "cf2_defconfig").replace("_defconfig", ".bin"),
        "facts": "\n".join(f"- {line}" for line in facts(policy)),
        "build": _build(build),
        "release": RELEASE,
    }


def _fraction(policy: Policy) -> str:
    """C that turns an action into a fraction of THRUST_MAX."""
    if not vehicle.orders_speeds(policy):
        return "    const float share = action / THRUST_MAX; /* newtons */"
    brushed, *_, brushless = PLATFORMS
    return FRACTION.format(brushless=f"{brushless.thrust_curve:g}f", brushed=f"{brushed.thrust_curve:g}f")


FRACTION = """\
    /* A rotor speed, of that at which the rotor gives THRUST_MAX; thrust = c w + (1 - c) w^2, c as identified. */
#ifdef CONFIG_PLATFORM_CF21BL
    const float c = {brushless};
#else
    const float c = {brushed};
#endif
    const float share = action * (c + (1.0f - c) * action);"""


def _guard(policy: Policy, build: Platform | None) -> str:
    """C that refuses a build for another platform."""
    if build is None:
        return ""
    limit_N = max(port.high for port in policy.actions)
    trained = f"{mass_kg(policy) * 1e3:.1f} g with motors of up to {limit_N:g} N"
    return f"""#if !({build.guard})
#error "Trained to fly {trained}: build for the {build.title} ({build.defconfig})"
#endif
"""


def facts(policy: Policy) -> list[str]:
    """What to know of the policy before flight, a sentence each."""
    found = vehicle.facts(policy)
    build = platform(policy)
    if build is None:
        found.append(
            "It orders rotor speeds and was trained on many vehicles: it is for each of docs/crazyflie.md's platforms."
        )
    else:
        limit_N = max(port.high for port in policy.actions)
        found.append(
            f"Trained to fly {mass_kg(policy) * 1e3:.1f} g, motors {arm_m(policy) * 1e3:.0f} mm from the center and of"
            f" up to {limit_N:g} N, for the {build.title}: {build.mass_kg * 1e3:.1f} g,"
            f" {build.arm_m * 1e3:.0f} mm, {build.thrust_max_N:g} N. Weigh yours."
        )
        if limit_N > 1.01 * build.thrust_max_N:
            found.append(
                f"Its orders above {build.thrust_max_N:g} N are cut: it has less thrust than it was trained with."
            )
        if policy.memory is None or not (policy.memory.integral or policy.memory.units):
            found.append("It has no integral and no recurrent memory: a vehicle of another mass flies at an offset.")
    if len(policy.observations) > WORLD_SIZE:
        most_s = max(port.ahead_s or 0.0 for port in policy.observations)
        found.append(
            f"It looks up to {most_s:g} s ahead, of which set-points say nothing: the reference is taken to go on with"
            " the acceleration and jerk of the set-point. That is exact at rest."
        )
    return found


def _build(build: Platform | None) -> str:
    if build is None:
        return (
            "`cf2_defconfig` for a Crazyflie 2.1+ or 2.X, `cf21bl_defconfig` for a 2.1 Brushless; with the thrust"
            " upgrade kit add `CONFIG_CRAZYFLIE_THRUST_UPGRADE_KIT=y` to `app-config`."
        )
    return f"`{build.defconfig}`: {build.title}. `src/` refuses another platform."

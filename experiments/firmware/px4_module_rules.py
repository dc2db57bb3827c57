"""The rules that the module for PX4 has to keep, as its README says them."""

from collections.abc import Callable, Iterator

import numpy as np

from experiments.firmware import crazyflie_loop as loop
from experiments.firmware.crazyflie_loop import Floats, Reference
from experiments.firmware.px4_module_loop import BEGIN_US, Module, Vehicle, here, topics_of


def faults(module: Module) -> Iterator[str]:
    """What the module does other than its README says, of a policy that remembers; nothing if all is well."""
    yield from _registration(module)
    yield from _orders(module)
    yield from _ages(module)
    yield from _set_points(module)


def _on(module: Module) -> Vehicle:
    return module.boot().register()


def _still(distance_m: float = 0.0) -> Floats:
    """Topics of a vehicle at rest so far from the origin, and a set-point there."""
    return topics_of(np.eye(13)[6:7] + distance_m * np.eye(13)[0], loop.REST)[0]


def _registration(module: Module) -> Iterator[str]:
    vehicle, c, row = module.boot(), module.c, _still()
    vehicle.tick(BEGIN_US, row, mode=0)
    if not c.asked():
        yield "it asks for no mode, or otherwise"
    vehicle.tick(BEGIN_US + 500_000, row, mode=0)
    if c.asked():
        yield "it asks again within a second"
    vehicle.tick(BEGIN_US + 1_500_000, row, mode=0)
    if not c.asked():
        yield "without a reply it asks no more"
    for granted, own in ((0, 1), (1, 0)):
        c.registered(granted, own)
        if vehicle.tick(BEGIN_US + 1_600_000, row, check=1).published or c.configured():
            yield "a refusal, or the reply to another, is taken for a registration"
    c.registered(1, 1)
    vehicle.tick(BEGIN_US + 1_700_000, row, mode=0)
    if not c.configured():
        yield "PX4's controllers stay on"
    other = _on(module)  # beside another mode, whose arming check began before; 1 lists this one, 2 does not
    for i, check in enumerate((2, 2, 1, 2, 2)):
        if not other.tick(BEGIN_US + 2_000_000 + 300_000 * i, row, mode=0, check=check).able or c.asked():
            yield "an arming check that does not list the mode is not answered, or taken for its removal"
    other.tick(BEGIN_US + 3_500_000, row, mode=0, check=2)
    orders = other.tick(BEGIN_US + 3_510_000, row).published
    if orders or not c.asked():
        yield "a mode that the commander has removed gives orders, or is not asked for again"
    if not c.stopped(vehicle.pointer):
        yield "a stop leaves the mode registered"
    c.in_place_of_offboard(1)
    module.boot().tick(BEGIN_US, row, mode=0)
    if not c.asked():
        yield "it does not take the place of Offboard"
    c.in_place_of_offboard(0)


def _orders(module: Module) -> Iterator[str]:
    if any(_on(module).tick(BEGIN_US, _still(), mode=mode, armed=armed).published for mode, armed in ((0, 1), (1, 0))):
        yield "it gives orders in another mode, or disarmed"
    for gyro_us, jitter_us in ((2500, 0), (2500, 300), (4000, 0), (1000, 0)):
        vehicle, rng = _on(module), np.random.default_rng(0)
        times = [BEGIN_US + gyro_us * i + rng.uniform(-1, 1) * jitter_us for i in range(400_000 // gyro_us)]
        out = [vehicle.tick(time, _still()) for time in times]
        steps = np.diff([time for time, each in zip(times, out, strict=True) if each.published])
        if not len(steps):
            yield "no orders"
        elif not (abs(steps.sum() - 10_000 * len(steps)) < gyro_us + 1000 and np.ptp(steps) <= 2 * gyro_us):
            yield f"with the gyro every {gyro_us} us its steps are {steps.min():.0f} to {steps.max():.0f} us"
        if not all(each.whole for each in out if each.published):
            yield "actuator_motors is not as it should be"
    vehicle = _on(module)
    first = [vehicle.tick(BEGIN_US + i * 10_000, _still(0.3 if i else 0.0)).motor for i in range(100)]
    vehicle.tick(BEGIN_US + 1_000_000, _still(), mode=0)
    again = [vehicle.tick(BEGIN_US + 1_010_000 + i * 10_000, _still(0.3 if i else 0.0)).motor for i in range(2)]
    if np.array_equal(first[1], first[-1]):
        yield "the policy of the test has no memory"
    if not np.array_equal(first[:2], again):
        yield "it remembers what was before a take-over"


def _ages(module: Module) -> Iterator[str]:
    late, row = 40_000_000_000, _still()  # [us] after boot: twice as long as a difference in 32 bits can say
    for stale in ({"position": 0}, {"position": 2}, {"position": 3}, {"attitude": 0}):
        for begin_us in (BEGIN_US, late):
            if _on(module).tick(begin_us, row, mode=0, check=1, **stale).able:
                yield f"it may be armed without {stale}"
        vehicle, most_us = _on(module), 50_000 if "attitude" in stale else 100_000
        flew = [vehicle.tick(BEGIN_US + 2500 * i, row, check=1).published for i in range(8)]
        out = [vehicle.tick(BEGIN_US + 17_500 + 2500 * i, row, check=1, **stale) for i in range(1, 60)]
        *ordered, last = [(2500 * i, each) for i, each in enumerate(out, 1) if each.published] or [(0, out[0])]
        ordered_us = ordered[-1][0] if ordered else 0
        if last[0] != most_us + 2500 or np.ptp(last[1].motor):
            yield f"with {stale} a torque is left on the motors"
        able_us = 2500 * max((i for i, each in enumerate(out, 1) if each.able), default=0)
        if not any(flew) or not most_us - 10_000 <= ordered_us <= most_us or able_us != most_us:
            yield f"with {stale} orders end after {ordered_us} us, the arming check's yes after {able_us} us"
        back = [vehicle.tick(BEGIN_US + 200_000 + 10_000 * i, row, check=1) for i in range(4)]
        if any(each.published or each.able for each in back):
            yield f"a fault is forgotten in flight, {stale}"
        vehicle.tick(BEGIN_US + 300_000, row, mode=0)
        if not vehicle.tick(BEGIN_US + 310_000, row, check=1).published:
            yield "a fault stays when the mode is left"
        for later_us in (2**31 + 1_000_000, 2**32 + 20_000):  # as differences in 32 bits: less than 0, and 20 ms
            vehicle = _on(module)
            vehicle.tick(BEGIN_US, row, mode=0)
            if vehicle.tick(BEGIN_US + later_us, row, mode=0, check=1, **stale).able:
                yield f"what is old is new when a clock of 32 bits has wrapped around, {stale}"
    if not _on(module).tick(BEGIN_US, row, mode=0, check=1).able:
        yield "it may not be armed"
    for index in range(13):
        vehicle, bad = _on(module), row.copy()
        bad[index] = np.nan
        if not vehicle.tick(BEGIN_US, row).published or not vehicle.tick(BEGIN_US + 10_000, row).published:
            yield "no orders"
        out = vehicle.tick(BEGIN_US + 20_000, bad, check=1)
        if (out.published and np.ptp(out.motor)) or out.able:
            yield f"orders of number {index} that is not one"
        vehicle.tick(BEGIN_US + 30_000, row, mode=0)
        if not vehicle.tick(BEGIN_US + 40_000, row, mode=0, check=1).able:
            yield "a number that was not one stays"
    vehicle, bad = _on(module), np.where(np.arange(27) == 0, np.nan, row)
    vehicle.tick(BEGIN_US, bad)
    vehicle.tick(BEGIN_US + 10_000, bad, mode=0)
    if not vehicle.tick(BEGIN_US + 20_000, row, mode=0, check=1).able:
        yield "a place to hold that was no number stays"


def _set_points(module: Module) -> Iterator[str]:
    """Two vehicles with the same estimates must be given the same orders: the set-points mean the same."""
    state = loop.starts(12, seed=7, distance_m=0.2, tilt_rad=0.3)
    place = here(state[0])
    elsewhere = place._replace(position_m=place.position_m + [0.3, -0.2, 0.4], yaw_deg=place.yaw_deg + 50.0)
    moving = elsewhere._replace(velocity_m_s=np.array([0.4, 0.2, -0.3]))
    nan = np.full(3, np.nan)

    def differ(asked: Callable[[int], Reference | None], meant: Callable[[int], Reference], until: int = 12) -> bool:
        orders = []
        for to in (asked, meant):
            vehicle, found = _on(module), []
            for i, now in enumerate(state[:until]):
                ask = to(i)
                row = topics_of(now[None], ask or elsewhere)[0]
                # Set-points come at 100 Hz: the first, in the very sample of the take-over, is none for this mode.
                found.append(vehicle.tick(BEGIN_US + 10_000 * i, row, asks=int(ask is not None)).motor)
            orders.append(found)
        return not np.array_equal(*orders)

    if differ(lambda i: None, lambda i: place):
        yield "without a set-point it does not hold the place and heading of the take-over"
    if differ(lambda i: elsewhere if i == 0 else None, lambda i: place):
        yield "it follows a set-point of before the take-over"
    if not differ(lambda i: elsewhere, lambda i: place) or not differ(lambda i: moving, lambda i: elsewhere):
        yield "it does not follow a set-point"
    for what, asked, meant in (
        ("position", moving._replace(position_m=np.array([np.nan, 0.1, 0.1])), place),
        ("velocity", moving._replace(velocity_m_s=nan), elsewhere),
        ("acceleration", moving._replace(acceleration_m_s2=nan), moving),
        ("jerk", moving._replace(jerk_m_s3=nan), moving),
        ("heading", moving._replace(yaw_deg=np.nan), moving._replace(yaw_deg=place.yaw_deg)),
    ):
        if differ(lambda i, asked=asked: asked, lambda i, meant=meant: meant):
            yield f"a set-point without {what} is not taken as it should be"
    vehicle, twin = _on(module), _on(module)
    orders = []
    for i in range(60):  # set-points stop after 100 ms; from 310 ms on it holds where it was then
        now = state[5] + 0.01 * i * np.eye(13)[1]
        there = here(state[5] + 0.01 * 31 * np.eye(13)[1])
        first, second = topics_of(now[None], elsewhere)[0], topics_of(now[None], elsewhere if i < 31 else there)[0]
        outs = vehicle.tick(BEGIN_US + 10_000 * i, first, asks=int(i <= 10)), twin.tick(BEGIN_US + 10_000 * i, second)
        orders.append([out.motor for out in outs])
    if not all(np.array_equal(*both) for both in orders):
        yield "set-points stop, and it does not hold the place and heading of 200 ms later"

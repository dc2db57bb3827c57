"""Wind that changes during a flight. For one flight; the caller vmaps.

Along world x and y each an Ornstein-Uhlenbeck process, which is Dryden's longitudinal turbulence (MIL-F-8785C): its
correlation time is the length scale over the mean wind. It acts through drag; on a vehicle whose file has none, by a
force of WEIGHTS_S_M of its weight for each m/s.
"""

from typing import NamedTuple

import chex
import jax.numpy as jnp

from qrl_envs import noise
from qrl_envs.quadrotor import Disturbance
from qrl_envs.sensors import Sensors

WEIGHTS_S_M = 0.025  # the shipped vehicles with drag have 0.015 to 0.051 of their weight along x, the median 0.027


class Gust(NamedTuple):
    """One flight's draw; scalars."""

    speed_m_s: chex.Array  # standard deviation, for each axis
    correlation_s: chex.Array
    force_N_s_m: chex.Array  # in place of drag, where there is none


def begin(gust: Gust | tuple[()], sensors: Sensors) -> chex.Array | tuple[()]:
    """The first gust of a flight [2], along world x and y, of its standard deviation; () without gusts."""
    if not isinstance(gust, Gust):
        return ()
    return noise.row(noise.DRIFT_TABLE, sensors.row, sensors.stride, jnp.int32(0))[3:]


def after(
    gust: Gust | tuple[()], sensors: Sensors, before: chex.Array | tuple[()], steps: chex.Array, dt_s: float
) -> chex.Array | tuple[()]:
    """The gust [2] of a flight's int32 step, from that of the step before."""
    if not isinstance(gust, Gust) or isinstance(before, tuple):
        return ()
    normal = noise.row(noise.DRIFT_TABLE, sensors.row, sensors.stride, steps)[3:]
    return noise.ornstein_uhlenbeck(before, normal, gust.correlation_s, dt_s)


def disturbance(steady: Disturbance, gust: Gust | tuple[()], blows: chex.Array | tuple[()]) -> Disturbance:
    """`steady`, and the gust that blows [2], if any."""
    if not isinstance(gust, Gust) or isinstance(blows, tuple):
        return steady
    x, y = jnp.unstack(gust.speed_m_s * blows)
    wind = jnp.stack([x, y, jnp.zeros_like(x)])
    return steady._replace(wind_m_s=steady.wind_m_s + wind, force_N=steady.force_N + gust.force_N_s_m * wind)

"""References in flight: position and velocity at each step, and the preview, which is what a policy sees of the time
ahead: the reference's velocity then minus its velocity now. For one flight; the caller vmaps, or lets flights lie along
trailing axes.

`Figure` and `Periodic` are known beforehand; `Motion` is drawn for each flight.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from qrl_envs import reference
from qrl_envs.quadrotor import Physics
from qrl_envs.reference import VERTICAL, Fixed, Random, Reference


class Target(NamedTuple):
    """The reference now, and the preview; of one flight, or of flights along trailing axes."""

    position_m: chex.Array  # [3]
    velocity_m_s: chex.Array  # [3]
    preview_m_s: chex.Array  # [3k] for k times ahead


class Known:
    """A reference known beforehand. A flight begins at a place of its own on it, or all of them at its beginning."""

    draws = 1

    def __init__(self, lasts_s: float, dt_s: float) -> None:
        """Flights begin anywhere in its first `lasts_s`."""
        self._begins, self._dt_s = round(lasts_s / dt_s), dt_s

    def draw(self, u: chex.Array, physics: Physics, thrust: chex.Array) -> Any:
        """At which of its steps a flight begins, from u [1] uniform in [0, 1); int32 []."""
        del physics, thrust
        return jnp.floor(u[0] * self._begins).astype(jnp.int32)


class Figure(Known):
    """One that ends, as a table of its steps; then it stays where it is."""

    def __init__(self, spec: Fixed, dt_s: float, ahead_s: Sequence[float], anywhere: bool) -> None:
        lasts_s = spec.duration_s or 0.0
        super().__init__(lasts_s if anywhere else 0.0, dt_s)
        self._ahead = [round(time_s / dt_s) for time_s in ahead_s]
        found = spec.at(np.arange(round(lasts_s / dt_s) + 2) * dt_s)
        self._table = np.concatenate([found.position_m, found.velocity_m_s], axis=1).astype(np.float32)

    def at(self, begin: Any, steps: chex.Array) -> Target:
        """The target of a flight that has made `steps` [...] and began at `begin` [...]."""
        table, last = jnp.asarray(self._table), len(self._table) - 1

        def row(ahead: int) -> chex.Array:
            return jnp.moveaxis(table[jnp.minimum(begin + steps + ahead, last)], -1, 0)

        now = row(0)
        preview = [row(ahead)[3:] - now[3:] for ahead in self._ahead]
        return Target(now[:3], now[3:], jnp.concatenate(preview) if preview else now[:0])


class Periodic(Known):
    """One that repeats, in closed form: for as long as a flight is."""

    def __init__(self, spec: reference.Periodic, dt_s: float, ahead_s: Sequence[float], anywhere: bool) -> None:
        super().__init__((spec.lap_s or 0.0) if anywhere else 0.0, dt_s)
        self._sine, self._ahead_s = spec.sine, [round(time_s / dt_s) * dt_s for time_s in ahead_s]

    def at(self, begin: Any, steps: chex.Array) -> Target:
        """As `Figure.at`."""
        time_s = jnp.asarray(begin + steps) * self._dt_s
        along = [jnp.asarray(x, jnp.float32).reshape(3, *[1] * time_s.ndim) for x in self._sine]
        center, size, rate, phase = along
        angle = rate * time_s + phase
        sine, cosine, speed = jnp.sin(angle), jnp.cos(angle), size * rate
        preview = []
        for later_s in self._ahead_s:  # by the sum of angles, as in `Motion.at`
            later = cosine * jnp.cos(rate * later_s) - sine * jnp.sin(rate * later_s)
            preview.append(speed * (later - cosine))
        return Target(center + size * sine, speed * cosine, jnp.concatenate(preview) if preview else sine[:0])


class Sines(NamedTuple):
    """Σ_k amplitude·sin(rate·t + phase) along each axis."""

    amplitude_m: chex.Array  # [3, 2]
    rate_rad_s: chex.Array  # [3, 2]
    phase_rad: chex.Array  # [3, 2]
    ahead: tuple[chex.Array, ...]  # cosine and sine [2, 3, 2] of rate·time, for each time ahead


class Motion:
    """Random motion in compiled code, drawn for each flight."""

    draws = 19

    def __init__(self, spec: Random, dt_s: float, ahead_s: Sequence[float]) -> None:
        self._spec, self._dt_s = spec, dt_s
        self._ahead_s = [round(time_s / dt_s) * dt_s for time_s in ahead_s]

    def draw(self, u: chex.Array, physics: Physics, thrust: chex.Array) -> Sines:
        """A flight's motion, from u [19] uniform in [0, 1); `thrust`: the greatest of all motors [N] []."""
        spec = self._spec
        rates, sizes, phases = u[1:].reshape(3, 3, 2)
        low, high = np.log(spec.rate_rad_s)
        rate = jnp.exp(low + (high - low) * rates)
        size = spec.amplitude_m * jnp.abs(jax.scipy.special.ndtri(0.5 + 0.5 * sizes))
        size = jnp.minimum(size, spec.speed_m_s / rate) * jnp.array([1.0, 1.0, VERTICAL])[:, None]
        lift = thrust / (physics.mass_kg * physics.gravity_m_s2)
        # At four fifths of the squared thrust, so that some is left for height.
        most = spec.acceleration_share * physics.gravity_m_s2 * jnp.sqrt(jnp.maximum(0.8 * lift**2 - 1.0, 0.05))
        needed = jnp.linalg.norm(jnp.sum(size * rate**2, axis=1))
        size = size * jnp.minimum(1.0, jnp.clip(most, 0.5, 8.0) / needed) * (u[0] < spec.moving)
        ahead = tuple(jnp.stack([jnp.cos(rate * time_s), jnp.sin(rate * time_s)]) for time_s in self._ahead_s)
        return Sines(size, rate, 2.0 * jnp.pi * phases, ahead)

    def at(self, motion: Sines, steps: chex.Array) -> Target:
        """As `Figure.at`."""
        size, rate, phase, ahead = motion
        angle = rate * (steps * self._dt_s) + phase
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        speed = size * rate
        velocity = jnp.sum(speed * cosine, axis=1)
        preview = []
        for turned in ahead:  # by the sum of angles: cosine and sine of the rate alone are constant during a flight
            later = cosine * turned[0] - sine * turned[1]
            preview.append(jnp.sum(speed * later, axis=1) - velocity)
        return Target(jnp.sum(size * sine, axis=1), velocity, jnp.concatenate(preview) if preview else velocity[:0])


def follow(spec: Reference, dt_s: float, ahead_s: Sequence[float], anywhere: bool) -> Figure | Periodic | Motion:
    """A reference in flight, at steps of `dt_s` and with a preview of the times `ahead_s`; flights may begin `anywhere`
    on one that is known.
    """
    if isinstance(spec, Random):
        return Motion(spec, dt_s, ahead_s)
    kind = Periodic if isinstance(spec, reference.Periodic) else Figure
    return kind(spec, dt_s, ahead_s, anywhere)  # pyright: ignore[reportArgumentType]

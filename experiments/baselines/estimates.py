"""What a controller is told of a flight in a judge: late actions, noise, and positions as an estimator gives them.

NumPy only, as `kernel_flights`; the magnitudes are those of `qrl_envs.off_nominal`. n flights side by side; all of a
flight's random numbers come from one seed.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POSITION_M, VELOCITY_M_S, ATTITUDE_RAD, BODY_RATE_RAD_S = 0.01, 0.02, 0.01, 0.02  # noise: standard deviations an axis
FIX_PERIOD_S, FIX_DELAY_S = 1.0 / 30.0, 0.01  # positions by motion capture
WANDER_M, WANDER_S = 0.005, 5.0  # their bias, an Ornstein-Uhlenbeck process for each axis
SEED = 7
KEPT = 12  # periods of which positions are kept: two fixes and their delay

State = Any  # a `kernel_flights.State`: that module is imported under two names


class Exact:
    """A controller is told what is."""

    def __init__(self, flights: int) -> None:
        del flights

    def told(self, states: State, time_s: float) -> State:
        """`states` of `time_s` after the start; called once for each control period, in order."""
        del time_s
        return states

    def bias_m(self) -> Array | float:
        """Error of the position that is told and cannot be known; [n, 3] world."""
        return 0.0


class Noise(Exact):
    """White noise on all that is measured, anew at each period."""

    def __init__(self, flights: int) -> None:
        super().__init__(flights)
        self._draws = np.random.default_rng(SEED)

    def told(self, states: State, time_s: float) -> State:
        del time_s

        def noise(size: float) -> Array:
            return size * self._draws.normal(size=states.position_m.shape)

        return states._replace(
            rotation=states.rotation @ _turns(noise(ATTITUDE_RAD)),
            position_m=states.position_m + noise(POSITION_M),
            velocity_m_s=states.velocity_m_s + noise(VELOCITY_M_S),
            body_rate_rad_s=states.body_rate_rad_s + noise(BODY_RATE_RAD_S),
        )


class Fixes(Exact):
    """Position once in FIX_PERIOD_S, known FIX_DELAY_S later, with a bias that wanders; velocity from the last two.

    Between fixes the position is moved on by that velocity. Attitude and body rates are fresh. Each flight's fixes
    have a phase of their own, and before its start it came at its velocity.
    """

    def __init__(self, flights: int) -> None:
        super().__init__(flights)
        self._draws = np.random.default_rng(SEED)
        self._phase_s = FIX_PERIOD_S * self._draws.uniform(size=flights)
        self._times_s: list[float] = []
        self._positions_m: list[Array] = []
        self._velocity_m_s = np.zeros((flights, 3))  # at the start
        self._biases_m = [WANDER_M * self._draws.normal(size=(flights, 3))]
        self._told_of = np.zeros(flights, int)  # number of the last fix that is known

    def told(self, states: State, time_s: float) -> State:
        if not self._times_s:
            self._velocity_m_s = states.velocity_m_s
        self._times_s = [*self._times_s[1 - KEPT :], time_s]
        self._positions_m = [*self._positions_m[1 - KEPT :], states.position_m]
        last = np.floor((time_s - FIX_DELAY_S - self._phase_s) / FIX_PERIOD_S).astype(int)
        self._told_of = np.maximum(last, 0)
        at_s = self._phase_s + last * FIX_PERIOD_S
        fix, before = (self._fix(at_s - k * FIX_PERIOD_S, last - k) for k in (0, 1))
        velocity = (fix - before) / FIX_PERIOD_S
        return states._replace(position_m=fix + velocity * (time_s - at_s)[:, None], velocity_m_s=velocity)

    def bias_m(self) -> Array:
        return self._bias(self._told_of)

    def _bias(self, index: NDArray[np.intp]) -> Array:
        """Of each flight's fix of that number, that of the first before the start; [n, 3]."""
        keep = math.exp(-FIX_PERIOD_S / WANDER_S)
        while len(self._biases_m) <= index.max():
            fresh = WANDER_M * math.sqrt(1.0 - keep * keep) * self._draws.normal(size=self._biases_m[0].shape)
            self._biases_m.append(keep * self._biases_m[-1] + fresh)
        return np.stack(self._biases_m)[np.maximum(index, 0), np.arange(len(index))]

    def _fix(self, at_s: Array, index: NDArray[np.intp]) -> Array:
        """Positions as fixed at the times [n]; [n, 3]."""
        past, times = np.stack(self._positions_m), np.array(self._times_s)
        after = np.clip(np.searchsorted(times, at_s), 1, max(1, len(times) - 1))
        flights = np.arange(len(at_s))
        if len(times) > 1:
            share = (np.maximum(at_s, times[0]) - times[after - 1]) / (times[after] - times[after - 1])
            position = past[after - 1, flights] + share[:, None] * (past[after, flights] - past[after - 1, flights])
        else:
            position = past[0]
        return position + np.minimum(at_s - times[0], 0.0)[:, None] * self._velocity_m_s + self._bias(index)


def _turns(angles_rad: Array) -> Array:
    """Rotation matrices [n, 3, 3] of small rotation vectors [n, 3], orthogonal to rounding (Cayley)."""
    x, y, z = 0.5 * angles_rad.T
    zero = np.zeros_like(x)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    turns: Array = np.linalg.solve(np.eye(3) - cross, np.eye(3) + cross).astype(np.float64)
    return turns


TOLD = {"exact": Exact, "noise": Noise, "fixes": Fixes}

"""Fixed-step integrators for second-order systems.

A state is a NamedTuple (pose, twist): a configuration and its rate, each any pytree. A derivative maps a state to a
state of time derivatives; the caller binds inputs and parameters into it.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax

from qrl_envs.fusion import stored

X = TypeVar("X", bound=Any)  # a NamedTuple with the fields pose and twist


def _advance(x: Any, x_dot: Any, dt_s: float) -> Any:
    return jax.tree.map(lambda value, rate: value + dt_s * rate, x, x_dot)


def semi_implicit_euler(
    derivative: Callable[[X], X], x: X, dt_s: float, limit: Callable[[Any], Any] = lambda twist: twist
) -> X:
    """One step, first order: the twist first (then `limit`), then the pose with the new twist."""
    twist = stored(limit(_advance(x.twist, derivative(x).twist, dt_s)))
    return x._replace(pose=_advance(x.pose, derivative(x._replace(twist=twist)).pose, dt_s), twist=twist)


def midpoint(start: Callable[[X], X], middle: Callable[[X], X], x: X, dt_s: float) -> X:
    """One step of the explicit midpoint method, second order: `start` and `middle` are the derivatives at its beginning
    and halfway, where inputs differ.
    """
    halfway = stored(_advance(x, start(x), dt_s / 2))
    return _advance(x, middle(halfway), dt_s)

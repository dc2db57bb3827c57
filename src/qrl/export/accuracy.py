"""The action error of an approximation of a policy, such as the integer kernel."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export.policy import Policy

CHUNK = 8192  # observations at a time: the intermediate arrays stay in the cache

PolicyFn = Callable[[NDArray[np.float32]], NDArray[np.floating]]  # observations [n, F] -> actions [n, A], SI units


class Accuracy(NamedTuple):
    """Action error as a fraction of full scale (the action's range)."""

    rmse: float
    maximum: float


def accuracy(policy: Policy, policy_fn: PolicyFn, observations: NDArray[np.float32]) -> Accuracy:
    """Error of `policy_fn` against the float policy at observations [n, F]."""
    low, high = policy.limits
    squares, maximum = 0.0, 0.0
    for i in range(0, len(observations), CHUNK):
        error = (policy_fn(observations[i : i + CHUNK]) - policy(observations[i : i + CHUNK])) / (high - low)
        squares += float(np.sum(error**2))
        maximum = max(maximum, float(np.abs(error).max()))
    return Accuracy((squares / (len(observations) * len(low))) ** 0.5, maximum)

"""How far another form of a policy is from the float policy."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from qrl.export.policy import Policy

CHUNK = 8192  # observations at a time: the intermediate arrays stay in the cache

Answer = Callable[[NDArray[np.float32]], NDArray[np.floating]]  # observations [n, F] -> actions [n, A] in SI units


class Accuracy(NamedTuple):
    """Error of the action, in full scales (greatest less least action)."""

    rmse: float
    worst: float


def accuracy(policy: Policy, answer: Answer, observations: NDArray[np.float32]) -> Accuracy:
    """Of `answer` against the float policy at observations [n, F]."""
    low, high = policy.limits
    squares, worst = 0.0, 0.0
    for i in range(0, len(observations), CHUNK):
        error = (answer(observations[i : i + CHUNK]) - policy(observations[i : i + CHUNK])) / (high - low)
        squares += float(np.sum(error**2))
        worst = max(worst, float(np.abs(error).max()))
    return Accuracy((squares / (len(observations) * len(low))) ** 0.5, worst)

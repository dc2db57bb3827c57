"""Observations to calibrate an integer policy on, selected from its flights."""

import numpy as np
from numpy.typing import NDArray

STARTS = 1000
FROM_ENVELOPE = 0.2  # fraction of the starts, the last ones
TRANSIENT_STEPS = 200  # at the start of a flight
SAMPLES = 32_768
SHARES = {"transient": 0.7, "settled": 0.2, "envelope": 0.1}


def select(observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Observations [m, F] of flights [n, T, F]: transients more densely than the rest, and the largest of each number.

    Most are of the task's own starts: a policy cannot save many of the envelope's, and the rounding would fit tumbling
    vehicles.
    """
    own = round(len(observations) * (1.0 - FROM_ENVELOPE))
    parts = {
        "transient": observations[:own, :TRANSIENT_STEPS],
        "settled": observations[:own, TRANSIENT_STEPS:],
        "envelope": observations[own:, :TRANSIENT_STEPS],
        "largest": observations,
    }
    finite = {name: part[np.isfinite(part).all(axis=2)] for name, part in parts.items()}
    largest = finite.pop("largest")
    drawn = [subsample(part, round(SAMPLES * SHARES[name])) for name, part in finite.items()]
    return np.concatenate([*drawn, largest[np.abs(largest).argmax(axis=0)]])


def subsample(x: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most `most` rows, evenly spaced."""
    return x[:: max(1, -(-len(x) // most))]

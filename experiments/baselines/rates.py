"""Timing a compiled program that is called again and again; for qrl and its peers alike."""

import time
from collections.abc import Callable
from typing import Any

from judge import report

LEAST_SECONDS = 0.5
UNHEEDED = 3
LANES = (256, 1024, 4096, 16_384)
UNROLL_STEPS = 50
# The training loop at Brax PPO's reuse, by qrl's unroll: with Brax's own, it makes as many optimiser steps too.
TRAINING = {
    50: "training loop, equal reuse; samples a minibatch: 32 × 50 of qrl, 32 × 10 of Brax",
    10: "training loop, equal reuse and optimiser steps; samples a minibatch: 32 × 10 of both",
}


def rate(figure: str, per_call: int, call: Callable[[Any], Any], state: Any, ready: Callable[[Any], Any]) -> None:
    """Report how much a second `call` (state -> state, `per_call` of what is counted) does.

    The first calls are unheeded: they compile, some peers' twice (what they return is typed otherwise than they began).
    """
    for _ in range(UNHEEDED):
        state = ready(call(state))
    calls, begun = 0, time.perf_counter()
    while (seconds := time.perf_counter() - begun) < LEAST_SECONDS:
        state = ready(call(state))
        calls += 1
    report({"figure": figure, "per_second": calls * per_call / seconds})

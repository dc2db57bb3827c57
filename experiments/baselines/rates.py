"""The rate of a compiled program over repeated calls, measured alike for qrl and the baselines."""

import time
from collections.abc import Callable
from typing import Any

from judge import report

MIN_SECONDS = 0.5
WARMUP_CALLS = 3
LANES = (256, 1024, 4096, 16_384)
UNROLL_STEPS = 50
# The training loop at Brax PPO's sample reuse, by qrl's unroll length: with Brax's, it makes as many optimizer steps.
TRAINING = {
    50: "training loop, equal reuse; samples a minibatch: 32 × 50 of qrl, 32 × 10 of Brax",
    10: "training loop, equal reuse and optimizer steps; samples a minibatch: 32 × 10 of both",
}


def rate(figure: str, per_call: int, call: Callable[[Any], Any], state: Any, ready: Callable[[Any], Any]) -> None:
    """Report the rate of `call` (state -> state), each of which counts as `per_call`.

    The first calls are not measured: they compile, some twice, as their results' types differ from their first inputs'.
    """
    for _ in range(WARMUP_CALLS):
        state = ready(call(state))
    calls, start = 0, time.perf_counter()
    while (seconds := time.perf_counter() - start) < MIN_SECONDS:
        state = ready(call(state))
        calls += 1
    report({"figure": figure, "per_second": calls * per_call / seconds})

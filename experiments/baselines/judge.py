"""How every contestant is evaluated and timed: the pendulum's 1,000 starts, and a clock that is paused for checks.

NumPy only: each baseline imports it in an environment of its own. A contestant trains with the clock running, and at
intervals passes its policy to `Judge.check`. The time of a check is in no figure; each check prints a line of JSON:

train_seconds    training, without compilation
compile_seconds  JAX: tracing, lowering and compiling while the clock ran, overlaps counted once, as `jax.monitoring`
                 reports them; elsewhere what the script marks with `Judge.compiling`
total_seconds    since the process was started: interpreter, imports, compilation and training
"""

import json
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Act = Callable[[Array], Any]  # observations [n, 3] -> actions [n, 1] in [−1, 1]: torque over the maximum torque

GRID, STEPS = (40, 25), 200  # starts, of angle and rate
GRAVITY, MASS, LENGTH, MAX_TORQUE, MAX_RATE, DT = 10.0, 1.0, 1.0, 2.0, 8.0, 0.05


def pendulum_starts() -> tuple[Array, Array]:
    """The 1,000 starts: the centers of a grid's cells over θ in ±π and rates in ±1; [n] and [n].

    Over as many random starts the mean return has a standard deviation of 2.4, whatever the policy; over these it is
    within 0.3 of the mean over all starts.
    """
    angle, rate = (2.0 * (np.arange(count) + 0.5) / count - 1.0 for count in GRID)
    return np.repeat(np.pi * angle, GRID[1]), np.tile(rate, GRID[0])


def pendulum_step(theta: Array, rate: Array, action: Array) -> tuple[Array, Array, Array]:
    """One step of Gymnasium's Pendulum-v1; (θ, rate, reward), each [n]. `action` is clipped to [−1, 1]."""
    torque = MAX_TORQUE * np.clip(action, -1.0, 1.0)
    upright = (theta + np.pi) % (2.0 * np.pi) - np.pi
    reward = -(upright**2 + 0.1 * rate**2 + 0.001 * torque**2)
    acceleration = 1.5 * GRAVITY / LENGTH * np.sin(theta) + 3.0 / (MASS * LENGTH**2) * torque
    rate = np.clip(rate + DT * acceleration, -MAX_RATE, MAX_RATE)
    return theta + DT * rate, rate, reward


def pendulum_return(act: Act, theta: Array | None = None, rate: Array | None = None) -> float:
    """Mean return of a policy over one episode from each start; NaN where an action is not finite."""
    if theta is None or rate is None:
        theta, rate = pendulum_starts()
    total = np.zeros_like(theta)
    for _ in range(STEPS):
        observation = np.stack([np.cos(theta), np.sin(theta), rate], axis=1)
        action = np.asarray(act(observation), np.float64).reshape(len(theta))
        theta, rate, reward = pendulum_step(theta, rate, action)
        total += reward
    return float(total.mean())


def covered(spans: list[tuple[float, float]]) -> float:
    """Length of the union of (begin, end) intervals."""
    length, until = 0.0, -np.inf
    for begin, end in sorted(spans):
        length += max(0.0, end - max(begin, until))
        until = max(until, end)
    return float(length)


class Judge:
    """A contestant's clock, paused until `start`; `check` pauses it, evaluates, reports, and resumes it."""

    def __init__(self, measure: Callable[[Any], dict[str, float]], solved: Callable[[dict[str, float]], bool]) -> None:
        self._measure = measure
        self._solved = solved
        self._train = self._compile = self._checks = 0.0
        self._spans: list[tuple[float, float]] = []  # compilation since the clock was last read
        self._since: float | None = None
        self._spawned = float(os.environ.get("BENCH_SPAWNED", time.time()))
        self._budget = float(os.environ.get("BENCH_BUDGET_SECONDS", "inf"))

    def listen_to_jax(self) -> "Judge":
        """Count what JAX compiles from now on."""
        import jax  # in the contestant's environment, if it has one

        def listener(event: str, duration_secs: float, **_: str | int) -> None:
            if event.startswith("/jax/core/compile/"):
                now = time.time()
                self._spans.append((now - duration_secs, now))

        jax.monitoring.register_event_duration_secs_listener(listener)
        return self

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """The body is compilation, whether the clock runs or not."""
        start = time.time()
        yield
        self._spans.append((start, time.time()))

    def start(self) -> None:
        """Start the clock; what was compiled before counts as compilation."""
        self._compile += covered(self._spans)
        self._spans.clear()
        self._since = time.time()

    def pause(self) -> None:
        """Stop the clock."""
        if self._since is None:
            return
        now, compiled = time.time(), covered([(max(a, self._since), b) for a, b in self._spans if b > self._since])
        self._train += now - self._since - compiled
        self._compile += compiled
        self._since = None

    def check(self, steps: int, policy: Any) -> bool:
        """Evaluate the policy after `steps` environment steps; whether to stop: solved, or out of time."""
        self.pause()
        start = time.time()
        found = self._measure(policy)
        total = start - self._spawned - self._checks
        clocks = {"train_seconds": self._train, "compile_seconds": self._compile, "total_seconds": total}
        report({"steps": int(steps), **clocks, **found})
        self._checks += time.time() - start
        self._spans.clear()
        self._since = time.time()
        return self._solved(found) or total >= self._budget


def pendulum_judge() -> Judge:
    """Solved: a mean return of −150 over the 1,000 starts."""
    bar = float(os.environ.get("BENCH_BAR", "-150"))
    return Judge(lambda act: {"return_mean": pendulum_return(act)}, lambda found: found["return_mean"] >= bar)


def success_judge(success: Callable[[Any], dict[str, float]]) -> Judge:
    """Solved: 99 % of the 1,000 flights that `success` makes."""
    bar = float(os.environ.get("BENCH_BAR", "0.99"))
    return Judge(success, lambda found: found["success"] >= bar)


def report(line: dict[str, Any]) -> None:
    """Print a line for the harness; a number that is not finite becomes null, as JSON has none."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
    print("BENCH " + json.dumps(plain), flush=True)

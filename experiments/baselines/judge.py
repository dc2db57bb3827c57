"""How every contestant is judged and timed: the pendulum of 1,000 starts, and a clock that the checks stop.

NumPy alone, for each peer imports it into an environment of its own. A contestant trains with the clock running and
now and then hands over its policy (`Judge.check`); what a check takes is in no figure, and each one becomes a line of
JSON on standard output:

train_seconds    running, without what was compiled meanwhile
compile_seconds  JAX: all spans of tracing, lowering and compiling while the clock ran, overlaps counted once, as
                 `jax.monitoring` tells; elsewhere what the script marks with `Judge.compiling`
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
Act = Callable[[Array], Any]  # observations [n, 3] -> actions [n, 1] in [−1, 1]: torque over the greatest torque

LATTICE, STEPS = (40, 25), 200  # starts, of angle and rate
GRAVITY, MASS, LENGTH, MAX_TORQUE, MAX_RATE, DT = 10.0, 1.0, 1.0, 2.0, 8.0, 0.05


def pendulum_starts() -> tuple[Array, Array]:
    """The 1,000 starts: the middles of a lattice's cells over θ in ±π and rates in ±1; [n] and [n].

    Drawn at random, the mean return over as many differs by 2.4 (one deviation) from draw to draw, whatever the policy;
    over these it is within 0.3 of what it is over all starts.
    """
    angle, rate = (2.0 * (np.arange(count) + 0.5) / count - 1.0 for count in LATTICE)
    return np.repeat(np.pi * angle, LATTICE[1]), np.tile(rate, LATTICE[0])


def pendulum_step(theta: Array, rate: Array, action: Array) -> tuple[Array, Array, Array]:
    """One step of Gymnasium's Pendulum-v1; (θ, rate, reward), each [n]. `action` is clipped to [−1, 1]."""
    torque = MAX_TORQUE * np.clip(action, -1.0, 1.0)
    upright = (theta + np.pi) % (2.0 * np.pi) - np.pi
    reward = -(upright**2 + 0.1 * rate**2 + 0.001 * torque**2)
    pull = 1.5 * GRAVITY / LENGTH * np.sin(theta) + 3.0 / (MASS * LENGTH**2) * torque
    rate = np.clip(rate + DT * pull, -MAX_RATE, MAX_RATE)
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
    """A contestant's clock. It stands still until `start`; `check` stops it, judges, reports, and lets it go on."""

    def __init__(self, measure: Callable[[Any], dict[str, float]], solved: Callable[[dict[str, float]], bool]) -> None:
        self._measure = measure
        self._solved = solved
        self._train = self._compile = self._checks = 0.0
        self._spans: list[tuple[float, float]] = []  # compilation since the clock was last read
        self._since: float | None = None
        self._spawned = float(os.environ.get("BENCH_SPAWNED", time.time()))
        self._budget = float(os.environ.get("BENCH_BUDGET_SECONDS", "inf"))

    def listen_to_jax(self) -> "Judge":
        """Count what JAX compiles from here on."""
        import jax  # in the contestant's environment, if it has one

        def heard(event: str, duration_secs: float, **_: str | int) -> None:
            if event.startswith("/jax/core/compile/"):
                now = time.time()
                self._spans.append((now - duration_secs, now))

        jax.monitoring.register_event_duration_secs_listener(heard)
        return self

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """What is done here is compilation, whether the clock runs or not."""
        begun = time.time()
        yield
        self._spans.append((begun, time.time()))

    def start(self) -> None:
        """Training begins. What was compiled until here counts as compilation."""
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
        """Judge a policy after so many environment steps; whether the contestant is done: solved, or out of time."""
        self.pause()
        begun = time.time()
        found = self._measure(policy)
        total = begun - self._spawned - self._checks
        clocks = {"train_seconds": self._train, "compile_seconds": self._compile, "total_seconds": total}
        report({"steps": int(steps), **clocks, **found})
        self._checks += time.time() - begun
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
    """A line for the harness; a number that is not finite becomes null, for JSON has none."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}
    print("BENCH " + json.dumps(plain), flush=True)

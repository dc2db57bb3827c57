"""rl-tools' SAC, the package on PyPI, on Gymnasium's Pendulum-v1: `rltools_sac.py --seed N [--steps N]`.

Settings: the package's own defaults, made for this task. Compilation is that of its C++, in each run.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import RescaleAction

from judge import Array, pendulum_judge

CHECK_EVERY, FIRST_CHECK = 1_000, 3_000


def batched(state: Any) -> Any:
    """The policy for a batch of observations; rltools' own takes one, and returns the action before its tanh."""

    def act(observations: Array) -> Array:
        return np.tanh([state.action(o) for o in observations])

    return act


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=float, default=2e4)
    args = parser.parse_args()
    judge = pendulum_judge()

    def environment(**options: Any) -> gymnasium.Env:
        env = RescaleAction(gymnasium.make("Pendulum-v1", **options), np.float32(-1.0), np.float32(1.0))
        env.reset(seed=args.seed)
        return env

    with tempfile.TemporaryDirectory() as cache:
        with judge.compiling():
            # It compiles into a folder of the system's temporary one, found when it is first imported.
            tempfile.tempdir = str(Path(cache))
            from rltools import SAC

            agent = SAC(environment, enable_evaluation=False, STEP_LIMIT=int(args.steps))
        judge.start()
        state = agent.State(args.seed)
        for steps in range(1, int(args.steps) + 1):
            over = state.step()
            if over or (steps >= FIRST_CHECK and steps % CHECK_EVERY == 0 and judge.check(steps, batched(state))):
                break


if __name__ == "__main__":
    main()

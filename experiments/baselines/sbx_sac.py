"""sbx's SAC (Stable-Baselines3 on JAX) on Gymnasium's Pendulum-v1: `sbx_sac.py --seed N [--steps N]`.

Settings: the RL Zoo's for SAC on Pendulum-v1 (learning rate 1e-3, all else the library's own).
"""

import argparse

import numpy as np
from sbx import SAC
from stable_baselines3.common.callbacks import BaseCallback

from judge import MAX_TORQUE, Judge, pendulum_judge

CHECK_EVERY, FIRST_CHECK = 500, 2_000


class Checked(BaseCallback):
    """Check the policy every CHECK_EVERY steps."""

    def __init__(self, judge: Judge) -> None:
        super().__init__()
        self._judge = judge

    def _on_step(self) -> bool:
        steps = self.num_timesteps
        if steps < FIRST_CHECK or steps % CHECK_EVERY:
            return True
        return not self._judge.check(steps, lambda o: self._act(o))

    def _act(self, observation: np.ndarray) -> np.ndarray:
        return self.model.predict(observation.astype(np.float32), deterministic=True)[0] / MAX_TORQUE


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=float, default=2e4)
    args = parser.parse_args()
    judge = pendulum_judge().listen_to_jax()
    judge.start()
    model = SAC("MlpPolicy", "Pendulum-v1", learning_rate=1e-3, seed=args.seed)
    model.learn(int(args.steps), callback=Checked(judge))


if __name__ == "__main__":
    main()

"""Train a little over 1, 2 and 4 of the devices that there are; what comes of it goes into a folder.

A program of its own, for `test_devices`: how many devices a CPU has is settled before JAX starts.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from qrl.config import Config, load_preset
from qrl.training import driver
from qrl.training.sharding import device_put, make_mesh
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import make_trainer
from qrl_envs import env as worlds

LITTLE = {
    "num_envs": 16,
    "unroll_length": 10,
    "episode_length": 20,
    "replay_unrolls": 3,
    "warmup_unrolls": 2,
    "updates_per_unroll": 5,
    "batch_size": 16,
    "policy_hidden_layer_sizes": [16],
    "critic_hidden_layer_sizes": [16],
    "normalize_observations": True,
    "num_eval_envs": 5,
    "apg_fraction": 0.5,
    "apg_num_envs": 16,
    "apg_episode_length": 20,
}
TEN_UPDATES = 3  # unrolls
APG_UPDATES = 3


def named(tree: Any) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree.leaves_with_path(tree)}


def main(folder: Path) -> None:
    env = worlds.make("pendulum")
    config = Config.model_validate(load_preset("pendulum") | LITTLE, strict=False)
    saved = None
    for seeds, count in ((1, 1), (1, 4), (2, 4)):
        points = stack([member_inputs(env, config)] * seeds)
        trainer = make_trainer(env, config, make_mesh(jax.devices()[:count], seeds, config.shard_count))
        states = trainer.train(trainer.init(driver.seeds(5, seeds), points), points, np.int32(TEN_UPDATES))
        flights = driver.report_flights(trainer)(states.learner, points)
        np.savez(folder / f"{seeds}-{count}.npz", **named(trainer.gather((states, flights))))
        if seeds == 1:
            saved = saved or next(trainer.members(states))  # from one device, as a checkpoint has it
            further = trainer.train(device_put(trainer.setup.mesh, stack([saved])), points, np.int32(TEN_UPDATES + 1))
            np.savez(folder / f"further-{count}.npz", **named(trainer.gather(further)))
            learnt = device_put(trainer.setup.mesh, stack([saved._replace(unrolls=np.int32(config.learning_unrolls))]))
            until = config.learning_unrolls + APG_UPDATES * config.unrolls_per_apg_update
            polished = trainer.apg(learnt, points, np.int32(until))
            np.savez(folder / f"polished-{count}.npz", **named(trainer.gather(polished)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""rejax on gymnax's Pendulum-v1: `rejax_agent.py ppo|sac --seed N [--steps N]`.

Settings: rejax's own `configs/gymnax/pendulum.yaml` (version 0.1.3), except for the number of steps. It trains in calls
of one compiled program, with its own evaluation switched off; what is evaluated is the mean of its distribution.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rejax

from judge import MAX_TORQUE, Act, pendulum_judge

COMMON: dict[str, Any] = {"env": "Pendulum-v1", "agent_kwargs": {"activation": "swish"}, "normalize_observations": True}
PPO: dict[str, Any] = COMMON | {
    "num_envs": 100,
    "num_steps": 100,
    "num_epochs": 10,
    "num_minibatches": 10,
    "learning_rate": 0.001,
    "max_grad_norm": 10,
    "gamma": 0.995,
    "gae_lambda": 0.95,
    "clip_eps": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
}
SAC: dict[str, Any] = COMMON | {
    "num_envs": 1,
    "buffer_size": 10_000,
    "fill_buffer": 256,
    "batch_size": 256,
    "learning_rate": 0.01,
    "num_epochs": 1,
    "gamma": 0.99,
    "polyak": 0.98,
    "target_entropy_ratio": None,
}
AGENTS = {"ppo": (rejax.PPO, PPO, 10_000), "sac": (rejax.SAC, SAC, 500)}  # steps between checks


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("agent", choices=AGENTS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=float, default=3e5)
    args = parser.parse_args()
    judge = pendulum_judge().listen_to_jax()
    maker, settings, every = AGENTS[args.agent]
    agent = maker.create(**settings, total_timesteps=every, eval_freq=every, skip_initial_evaluation=True)
    agent = agent.replace(eval_callback=lambda *_: jnp.float32(0.0))

    @jax.jit
    def mean(state: Any, observation: jax.Array) -> jax.Array:
        normal = agent.normalize_obs(state.obs_rms_state, observation)
        loc = agent.actor.apply(state.actor_ts.params, normal, method="_action_dist").mean()
        return loc / MAX_TORQUE if args.agent == "ppo" else jnp.tanh(loc)

    judge.start()
    state = agent.init_state(jax.random.PRNGKey(args.seed))
    train = jax.jit(lambda state: agent.train(train_state=state)[0]).lower(state).compile()
    for steps in range(every, int(args.steps) + 1, every):
        state = jax.block_until_ready(train(state))
        act: Act = lambda o, state=state: np.asarray(mean(state, jnp.asarray(o, jnp.float32)))  # noqa: E731
        if judge.check(steps, act):
            break


if __name__ == "__main__":
    main()

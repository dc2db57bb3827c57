"""Throughput of Brax on our hover: `brax_speed.py [--only acting training] [--lanes N …] --seed N`.

acting     its training wrappers with a stochastic policy 64-64: `acting.generate_unroll`
training   environment steps/s of `ppo.train` at its defaults (16 minibatches of 32 unrolls of 10 steps, two passes),
           networks 64-64, without evaluation; median over intervals after the first two, which compile. With
           --training-lanes other than 512 minibatches grow in proportion
"""

import argparse
import time
from functools import partial
from typing import Any

import jax
import numpy as np
from brax import envs
from brax.training import acting as brax_acting
from brax.training.agents.ppo import networks, train

import qrl_envs  # noqa: F401 - registers our environments with Brax
from brax_ppo import NETWORKS, add_device_put_replicated_shim
from judge import report
from rates import LANES, TRAINING, UNROLL_STEPS, rate

INTERVALS, INTERVAL_STEPS = 6, 102_400
DEFAULT_LANES, DEFAULT_BATCH = 512, 32


def acting(lanes: int, seed: int) -> None:
    env = envs.training.wrap(envs.get_environment("hover"), episode_length=200)
    network = networks.make_ppo_networks(18, 4, **NETWORKS)
    key = jax.random.PRNGKey(seed)
    params = (None, network.policy_network.init(key), network.value_network.init(key))
    policy = networks.make_inference_fn(network)(params)

    @jax.jit
    def unroll(carry: Any) -> Any:
        state, key, _ = carry
        key, subkey = jax.random.split(key)
        state, data = brax_acting.generate_unroll(
            env, state, policy, subkey, UNROLL_STEPS, extra_fields=("truncation",)
        )
        return state, key, data

    state = jax.jit(env.reset)(jax.random.split(key, lanes))
    rate(f"acting, {lanes:,} lanes", lanes * UNROLL_STEPS, unroll, (state, key, None), jax.block_until_ready)


def training(lanes: int, seed: int) -> None:
    times: list[tuple[int, float]] = []
    train.train(
        envs.get_environment("hover"),
        num_timesteps=INTERVALS * INTERVAL_STEPS * lanes // DEFAULT_LANES,
        num_evals=INTERVALS + 1,
        run_evals=False,
        num_envs=lanes,
        batch_size=DEFAULT_BATCH * lanes // DEFAULT_LANES,
        episode_length=200,
        seed=seed,
        policy_params_fn=lambda step, *_: times.append((step, time.perf_counter())),
        network_factory=partial(networks.make_ppo_networks, **NETWORKS),
    )
    (steps, seconds) = np.diff(np.array(times), axis=0).T
    # One measurement, which the bench compares with both rows of qrl's.
    for figure in TRAINING.values() if lanes == DEFAULT_LANES else [f"training loop, {lanes:,} lanes"]:
        report({"figure": figure, "per_second": float(np.median(steps[2:] / seconds[2:]))})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=["acting", "training"], default=["acting", "training"])
    parser.add_argument("--lanes", type=int, nargs="+", default=LANES, help="of acting")
    parser.add_argument("--training-lanes", type=int, nargs="+", default=[DEFAULT_LANES])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    add_device_put_replicated_shim()
    if "acting" in args.only:
        for lanes in args.lanes:
            acting(lanes, args.seed)
    if "training" in args.only:
        for lanes in args.training_lanes:
            training(lanes, args.seed)


if __name__ == "__main__":
    main()

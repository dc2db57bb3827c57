"""Throughput of Brax on our hover: `brax_speed.py [--only acting training] --seed N`.

acting     its training wrappers with a stochastic policy 64-64: `acting.generate_unroll`
training   environment steps/s of `ppo.train` at its defaults (16 minibatches of 32 unrolls of 10 steps, two passes),
           networks 64-64, without evaluation; median over intervals after the first two, which compile
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
        num_timesteps=INTERVALS * INTERVAL_STEPS,
        num_evals=INTERVALS + 1,
        run_evals=False,
        num_envs=lanes,
        episode_length=200,
        seed=seed,
        policy_params_fn=lambda step, *_: times.append((step, time.perf_counter())),
        network_factory=partial(networks.make_ppo_networks, **NETWORKS),
    )
    (steps, seconds) = np.diff(np.array(times), axis=0).T
    for figure in TRAINING.values():  # one measurement, compared with both rows of qrl's
        report({"figure": figure, "per_second": float(np.median(steps[2:] / seconds[2:]))})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=["acting", "training"], default=["acting", "training"])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    add_device_put_replicated_shim()
    if "acting" in args.only:
        for lanes in LANES:
            acting(lanes, args.seed)
    if "training" in args.only:
        training(512, args.seed)


if __name__ == "__main__":
    main()

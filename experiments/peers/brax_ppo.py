"""Brax's PPO on our own environments: `brax_ppo.py pendulum|hover --seed N [--steps N]`.

Brax ships no settings for a torque-limited pendulum. Those of its `inverted_pendulum` notebook (reward scale 10, 2,048
lanes, 2M steps) do not suit a CPU; PENDULUM has fewer lanes, a higher step size and a reward scaled to suit, found by
hand. HOVER is the same with more lanes and a longer horizon, and no more tuned than that.
"""

import argparse
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.training.agents.ppo import networks, train

import qrl_envs  # noqa: F401 - registers our environments with Brax
from judge import Act, Judge, pendulum_judge, success_judge
from qrl import evaluate

PENDULUM: dict[str, Any] = {
    "num_envs": 64,
    "episode_length": 200,
    "unroll_length": 20,
    "batch_size": 16,
    "num_minibatches": 8,
    "num_updates_per_batch": 8,
    "learning_rate": 1e-3,
    "entropy_cost": 1e-3,
    "discounting": 0.97,
    "gae_lambda": 0.95,
    "reward_scaling": 0.1,
    "normalize_observations": True,
}
HOVER: dict[str, Any] = PENDULUM | {"num_envs": 256, "batch_size": 64, "unroll_length": 25, "discounting": 0.98}
NETWORKS: dict[str, Any] = {"policy_hidden_layer_sizes": (64, 64), "value_hidden_layer_sizes": (64, 64)}
EVALUATION_STARTS_SEED = 1_000_003

Policy = tuple[Callable[[Any, jax.Array], jax.Array], Any]  # of (params, observations), and params


class Solved(Exception):
    """Thrown through `train`, which offers no other way to end early."""


def mend_jax() -> None:
    """Brax 0.14.2 calls `jax.device_put_replicated`, which JAX 0.10 no longer has."""
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(  # pyright: ignore[reportAttributeAccessIssue]
            lambda x: jnp.broadcast_to(x, (len(devices), *jnp.shape(x))), tree
        )


def pendulum_judged(policy: Policy) -> Act:
    """The deterministic policy as a function of observations in NumPy."""
    act, params = policy
    return lambda observation: np.asarray(act(params, jnp.asarray(observation, jnp.float32)))


def flights(env: Any) -> Callable[[Policy], dict[str, float]]:
    """What 1,000 deterministic flights measure, as `qrl evaluate` has it; compiled once."""
    keys = jax.random.split(jax.random.PRNGKey(EVALUATION_STARTS_SEED), 1000)
    fly = jax.jit(
        lambda act, params: evaluate.fly(env, partial(act, params), keys, env.episode_steps), static_argnums=0
    )
    return lambda policy: evaluate.summarise(fly(*policy))


def learn(task: str, seed: int, steps: int, settings: dict[str, Any], judge: Judge, every: int) -> None:
    """Train until the judge is content, a check after every `every` steps."""
    env = envs.get_environment(task)

    made: list[Any] = []  # the policy's function, which is the same at every check

    def handed(step: int, make_policy: Any, params: Any) -> None:
        if step == 0:
            return
        if not made:
            made.append(jax.jit(lambda p, o: make_policy(p, deterministic=True)(o, jax.random.PRNGKey(0))[0]))
        policy = made[0], params
        if judge.check(step, pendulum_judged(policy) if task == "pendulum" else policy):
            raise Solved

    judge.start()
    with contextlib.suppress(Solved):
        train.train(
            env,
            num_timesteps=steps,
            num_evals=steps // every + 1,
            run_evals=False,
            seed=seed,
            policy_params_fn=handed,
            network_factory=partial(networks.make_ppo_networks, **NETWORKS),
            **settings,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["pendulum", "hover"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=float, default=1e6)
    args = parser.parse_args()
    mend_jax()
    steps = int(args.steps)
    if args.task == "pendulum":
        learn("pendulum", args.seed, steps, PENDULUM, pendulum_judge().hear_jax(), every=20_480)
    else:
        env = envs.get_environment("hover")
        judge = success_judge(flights(env)).hear_jax()
        learn("hover", args.seed, steps, HOVER, judge, every=500_000)


if __name__ == "__main__":
    main()

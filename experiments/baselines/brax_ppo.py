"""Brax's PPO on our own environments: `brax_ppo.py pendulum|hover|circle --seed N [--steps N]`.

Brax ships no settings for a torque-limited pendulum. Those of its `inverted_pendulum` notebook (reward scale 10, 2,048
environments, 2M steps) do not suit a CPU; PENDULUM has fewer environments, a higher learning rate and another reward
scale, tuned by hand. QUADROTOR is the same with more environments, longer unrolls and a higher discount, not tuned
further. The circle's has another episode length, that of qrl's preset.

Brax resets an environment to its own first state, so that a run would see as many starts as it has environments: on
hover and circle `num_resets_per_eval` draws new ones after each episode's length. An end out of bounds is passed on as
the truncation that it is (`Truncating`).
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
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import qrl_envs  # noqa: F401 - registers our environments with Brax
from judge import Act, Judge, pendulum_judge, success_judge
from qrl.algorithm import flights as evaluate
from qrl.evaluation.starts import evaluation_starts

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
QUADROTOR: dict[str, Any] = PENDULUM | {"num_envs": 256, "batch_size": 64, "unroll_length": 25, "discounting": 0.98}
EPISODE_STEPS = {"hover": 200, "circle": 600}
EPISODES_PER_CHECK = {"hover": 10, "circle": 3}
NETWORKS: dict[str, Any] = {"policy_hidden_layer_sizes": (64, 64), "value_hidden_layer_sizes": (64, 64)}

Policy = tuple[Callable[[Any, jax.Array], jax.Array], Any]  # of (params, observations), and params


class Solved(Exception):
    """Raised through `train`, which offers no other way to stop early."""


def add_device_put_replicated_shim() -> None:
    """Brax 0.14.2 calls `jax.device_put_replicated`, which JAX 0.10 has removed: a copy on each device."""

    def device_put_replicated(tree: Any, devices: list[Any]) -> Any:
        sharding = NamedSharding(Mesh(np.array(devices), ("copy",)), P("copy"))
        return jax.tree.map(
            lambda x: jax.device_put(jnp.broadcast_to(x, (len(devices), *jnp.shape(x))), sharding), tree
        )

    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]


class Truncating(envs.Wrapper):
    """Marks episodes that our environments end out of bounds as truncated.

    Brax truncates at time limits only. It would take such an end for a termination with a value of 0; where rewards are
    negative, that pays a policy for leaving the bounds. It wraps Brax's own wrappers, which set `truncation` at every
    step and keep `info` at resets.
    """

    def step(self, state: Any, action: jax.Array) -> Any:
        state = self.env.step(state, action)
        own = jnp.asarray(state.info.get("truncated", 0.0), jnp.float32)
        return state.replace(info={**state.info, "truncation": jnp.maximum(state.info["truncation"], own)})


def wrap(env: Any, **settings: Any) -> Truncating:
    """As Brax wraps environments for training, with their own truncations."""
    return Truncating(envs.training.wrap(env, **settings))


def numpy_policy(policy: Policy) -> Act:
    """The deterministic policy as a function of observations in NumPy."""
    act, params = policy
    return lambda observation: np.asarray(act(params, jnp.asarray(observation, jnp.float32)))


def flights(env: Any) -> Callable[[Policy], dict[str, float]]:
    """Measures of 1,000 deterministic flights, as `qrl evaluate` takes them; compiled once."""
    keys = evaluation_starts()
    fly = jax.jit(
        lambda act, params: evaluate.fly(env, partial(act, params), keys, env.episode_steps), static_argnums=0
    )
    return lambda policy: evaluate.summarize(fly(*policy))


def learn(task: str, seed: int, steps: int, settings: dict[str, Any], judge: Judge, every: int) -> None:
    """Train until solved, with a check every `every` steps; at most `steps`, rounded down to a check."""
    env = envs.get_environment(task)
    checks = max(1, steps // every)

    compiled: list[Any] = []  # the policy's function, the same at every check

    def check(step: int, make_policy: Any, params: Any) -> None:
        if step == 0:
            return
        if not compiled:
            compiled.append(jax.jit(lambda p, o: make_policy(p, deterministic=True)(o, jax.random.PRNGKey(0))[0]))
        policy = compiled[0], params
        if judge.check(step, numpy_policy(policy) if task == "pendulum" else policy):
            raise Solved

    judge.start()
    with contextlib.suppress(Solved):
        train.train(
            env,
            num_timesteps=checks * every,
            num_evals=checks + 1,
            run_evals=False,
            seed=seed,
            policy_params_fn=check,
            wrap_env_fn=wrap,
            network_factory=partial(networks.make_ppo_networks, **NETWORKS),
            **settings,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["pendulum", "hover", "circle"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=float, default=1e6)
    args = parser.parse_args()
    add_device_put_replicated_shim()
    steps = int(args.steps)
    if args.task == "pendulum":
        learn("pendulum", args.seed, steps, PENDULUM, pendulum_judge().listen_to_jax(), every=20_480)
    else:
        steps_of, episodes = EPISODE_STEPS[args.task], EPISODES_PER_CHECK[args.task]
        settings = QUADROTOR | {"episode_length": steps_of, "num_resets_per_eval": episodes}
        judge = success_judge(flights(envs.get_environment(args.task))).listen_to_jax()
        learn(args.task, args.seed, steps, settings, judge, every=episodes * steps_of * QUADROTOR["num_envs"])


if __name__ == "__main__":
    main()

"""Brax's PPO on our own environments: `brax_ppo.py pendulum|hover|circle --seed N [--steps N]`.

Brax ships no settings for a torque-limited pendulum. Those of its `inverted_pendulum` notebook (reward scale 10, 2,048
lanes, 2M steps) do not suit a CPU; PENDULUM has fewer lanes, a higher step size and a reward scaled to suit, found by
hand. QUADROTOR is the same with more lanes and a longer horizon, and no more tuned than that. Circle's differs in the
length of its episodes, which is that of qrl's preset.

Brax restarts a lane from that lane's own first state, so that a run would see as many starts as it has lanes: here it
draws all anew whenever an episode's time is up. And an end that is no termination is told to it as the truncation that
it is (`Truncating`).
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
EPISODES_A_CHECK = {"hover": 10, "circle": 3}
NETWORKS: dict[str, Any] = {"policy_hidden_layer_sizes": (64, 64), "value_hidden_layer_sizes": (64, 64)}

Policy = tuple[Callable[[Any, jax.Array], jax.Array], Any]  # of (params, observations), and params


class Solved(Exception):
    """Thrown through `train`, which offers no other way to end early."""


def add_device_put_replicated_shim() -> None:
    """Brax 0.14.2 calls `jax.device_put_replicated`, which JAX 0.10 no longer has: a copy on each device."""

    def device_put_replicated(tree: Any, devices: list[Any]) -> Any:
        apart = NamedSharding(Mesh(np.array(devices), ("copy",)), P("copy"))
        return jax.tree.map(lambda x: jax.device_put(jnp.broadcast_to(x, (len(devices), *jnp.shape(x))), apart), tree)

    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]


class Truncating(envs.Wrapper):
    """Tells Brax that episodes which our environments end out of bounds are truncated.

    Brax knows of time limits alone. It would take such an end for a termination, worth 0 ever after; where rewards are
    below 0, that pays a policy for fleeing. To stand outside its own wrappers, which set `truncation` at every step and
    leave `info` alone when they reset.
    """

    def step(self, state: Any, action: jax.Array) -> Any:
        state = self.env.step(state, action)
        own = jnp.asarray(state.info.get("truncated", 0.0), jnp.float32)
        return state.replace(info={**state.info, "truncation": jnp.maximum(state.info["truncation"], own)})


def wrapped(env: Any, **how: Any) -> Truncating:
    """As Brax wraps environments for training, and told of their own truncations."""
    return Truncating(envs.training.wrap(env, **how))


def pendulum_judged(policy: Policy) -> Act:
    """The deterministic policy as a function of observations in NumPy."""
    act, params = policy
    return lambda observation: np.asarray(act(params, jnp.asarray(observation, jnp.float32)))


def flights(env: Any) -> Callable[[Policy], dict[str, float]]:
    """What 1,000 deterministic flights measure, as `qrl evaluate` has it; compiled once."""
    keys = evaluation_starts()
    fly = jax.jit(
        lambda act, params: evaluate.fly(env, partial(act, params), keys, env.episode_steps), static_argnums=0
    )
    return lambda policy: evaluate.summarize(fly(*policy))


def learn(task: str, seed: int, steps: int, settings: dict[str, Any], judge: Judge, every: int) -> None:
    """Train until the judge is content, a check after every `every` steps; at most `steps`, in whole checks."""
    env = envs.get_environment(task)
    checks = max(1, steps // every)

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
            num_timesteps=checks * every,
            num_evals=checks + 1,
            run_evals=False,
            seed=seed,
            policy_params_fn=handed,
            wrap_env_fn=wrapped,
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
        steps_of, episodes = EPISODE_STEPS[args.task], EPISODES_A_CHECK[args.task]
        settings = QUADROTOR | {"episode_length": steps_of, "num_resets_per_eval": episodes}
        judge = success_judge(flights(envs.get_environment(args.task))).listen_to_jax()
        learn(args.task, args.seed, steps, settings, judge, every=episodes * steps_of * QUADROTOR["num_envs"])


if __name__ == "__main__":
    main()

"""What qrl does in a second: `throughput.py [--only acting physics learning training] --seed N`.

acting     policy 64-64, noise, physics, reward, fresh starts and recording: `rollout.unroll` of hover
physics    the quadrotor's step alone, constant thrust
learning   samples through gather, both networks, V-trace, loss, clip and Adam: `Learner.update`
training   environment steps of the whole loop, each sample learnt from as often as by Brax PPO's defaults: 16
           minibatches an unroll, two passes
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "peers"))

import jax
import jax.numpy as jnp
import numpy as np

from qrl import buffer, laps, request, rollout, runs
from qrl.learner import Learner
from qrl.train import Trainer, point, spread, stack
from qrl_envs import env as worlds
from qrl_envs import quadrotor
from rates import LANES, UNROLL_STEPS, rate

BRAX_MINIBATCHES, BRAX_PASSES = 16, 2
TRAINING_LANES = 512


def hover(**learner: Any) -> runs.RunConfig:
    """Hover with the default networks and these hyperparameters."""
    file = runs.ConfigFile(learner=runs.preset("hover") | {"unroll_steps": UNROLL_STEPS} | learner)
    return request.run_config("hover", None, file, {}, 0, 1)


def acting(lanes: int, key: jax.Array) -> None:
    run = hover(lanes=lanes)
    env = request.environment(run.task)
    learner = Learner(run.learner, 18, 4)
    state = learner.init(key)
    longest = rollout.episode_steps(env, run.learner.episode_steps)

    @jax.jit
    def unroll(carry: Any) -> Any:
        now, key, _ = carry
        key, mine = jax.random.split(key)
        now, seen = rollout.unroll(
            env,
            now,
            lambda observation: learner.mean(state, observation),
            learner.sigma(state),
            mine,
            starts,
            unroll_steps=UNROLL_STEPS,
            longest=longest,
        )
        return now, key, seen

    starts = jax.random.PRNGKey(1)
    first = rollout.begin(env, starts, jnp.arange(lanes, dtype=jnp.int32), lanes, longest, UNROLL_STEPS)
    rate(f"acting, {lanes:,} lanes", lanes * UNROLL_STEPS, unroll, (first, key, None), jax.block_until_ready)


def physics(lanes: int, key: jax.Array) -> None:
    env = worlds.make("hover")
    params: Any = env.params
    dt_s = env.task.control_period_s
    thrust = quadrotor.hover_thrust_N(params.physics) * jnp.ones(4)

    @jax.jit
    def steps(bodies: Any) -> Any:
        each = jax.vmap(lambda body: quadrotor.step(params.physics, body, thrust, dt_s))
        return jax.lax.scan(lambda b, _: (each(b), None), bodies, None, UNROLL_STEPS)[0]

    bodies = jax.vmap(lambda k: quadrotor.draw(params.start, k))(jax.random.split(key, lanes))
    rate(f"physics, {lanes:,} lanes", lanes * UNROLL_STEPS, steps, bodies, jax.block_until_ready)


def learning(minibatch_lanes: int, key: jax.Array) -> None:
    run = hover(minibatch_lanes=minibatch_lanes)
    trainer, states, _ = begun(run)
    config, learner = run.learner, trainer.learner
    ring = jax.tree.map(lambda x: x[0], states.ring)._replace(inserted=jnp.int32(config.ring_unrolls))
    updates, shards = 64, config.logical_shards

    @jax.jit
    def learn(carry: Any) -> Any:
        state, key = carry
        key, mine = jax.random.split(key)
        index = buffer.draw(ring, jax.random.split(mine, shards), updates, minibatch_lanes // shards)
        return jax.lax.scan(lambda s, i: (learner.update(s, buffer.gather(ring, i))[0], None), state, index)[0], key

    samples = updates * minibatch_lanes * UNROLL_STEPS
    first = jax.tree.map(lambda x: x[0], states.learner)
    rate(
        f"learning, {minibatch_lanes * UNROLL_STEPS:,} samples a minibatch",
        samples,
        learn,
        (first, key),
        jax.block_until_ready,
    )


def training(lanes: int, key: jax.Array) -> None:
    run = hover(
        lanes=lanes,
        steps=10**9,
        ring_unrolls=1,
        warmup_unrolls=1,
        updates_per_unroll=BRAX_MINIBATCHES * BRAX_PASSES,
        minibatch_lanes=lanes // BRAX_MINIBATCHES,
    )
    trainer, states, points = begun(run)
    advance = laps.compile_advance(trainer, states, points)
    unrolls = 4

    def on(carry: Any) -> Any:
        states, done = carry
        return advance(states, points, np.int32(done + unrolls)), done + unrolls

    rate("training loop", unrolls * run.learner.unroll_size, on, (states, 0), jax.block_until_ready)


def begun(run: runs.RunConfig) -> tuple[Trainer, Any, Any]:
    env = request.environment(run.task)
    trainer = Trainer(env, run.learner, spread(jax.devices(), 1, run.learner.logical_shards))
    points = stack([point(env, run.learner)])
    return trainer, trainer.init(laps.seeds(0, 1), points), points


ROWS: dict[str, tuple[Callable[[int, jax.Array], None], tuple[int, ...]]] = {
    "acting": (acting, LANES),
    "physics": (physics, LANES),
    "learning": (learning, (8, 64, 256)),
    "training": (training, (TRAINING_LANES,)),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for name in args.only:
        measure, sizes = ROWS[name]
        for size in sizes:
            measure(size, jax.random.PRNGKey(args.seed))


if __name__ == "__main__":
    main()

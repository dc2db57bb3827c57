"""What qrl does in a second: `throughput.py [--only acting physics learning training] --seed N`.

acting     policy 64-64, noise, physics, reward, fresh starts and recording: `rollout.unroll` of hover
physics    the quadrotor's step alone, thrusts about those of a hover, in blocks of lanes as `rollout.unroll` has them
learning   samples through draw, gather, symmetries, both networks, V-trace, loss, clip and Adam: `Learner.update` on
           the ring of a run on its way
training   environment steps of the whole loop, each sample learnt from as often as by Brax PPO's defaults (16
           minibatches an unroll, two passes): with unrolls of 50 steps, and of Brax's 10, which makes as many
           optimiser steps a step of the environment
"""

import argparse
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "peers"))

import jax
import jax.numpy as jnp
import numpy as np

from qrl import buffer, laps, request, rollout, runs
from qrl.learner import Learner
from qrl.train import Trainer, effort, point, spread, stack
from qrl_envs import env as worlds
from qrl_envs import quadrotor
from rates import LANES, TRAINING, UNROLL_STEPS, rate

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

    @partial(jax.jit, compiler_options=effort(1))
    def unroll(state: Any, starts: Any, carry: Any) -> Any:
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
    act = partial(unroll, state, starts)
    rate(f"acting, {lanes:,} lanes", lanes * UNROLL_STEPS, act, (first, key, None), jax.block_until_ready)


def physics(lanes: int, key: jax.Array) -> None:
    env = worlds.make("hover")
    params: Any = env.params
    dt_s = env.task.control_period_s

    blocks = max(1, lanes // rollout.BLOCK_LANES)

    @partial(jax.jit, compiler_options=effort(1))
    def steps(params: Any, thrusts: Any, bodies: Any) -> Any:
        each = jax.vmap(lambda body, thrust: quadrotor.step(params, body, thrust, dt_s))

        def block(of: Any) -> Any:
            return jax.lax.scan(lambda b, thrust: (each(b, thrust), None), *of)[0]

        return jax.lax.map(block, (bodies, thrusts))

    draw = jax.vmap(jax.vmap(lambda k: quadrotor.draw(params.start, k)))
    bodies = draw(jax.random.split(key, (blocks, lanes // blocks)))
    about = 1.0 + 0.01 * jax.random.normal(key, (blocks, UNROLL_STEPS, lanes // blocks, 4))
    thrusts = quadrotor.hover_thrust_N(params.physics) * about
    step = partial(steps, jax.tree.map(jnp.asarray, params.physics), thrusts)
    rate(f"physics, {lanes:,} lanes", lanes * UNROLL_STEPS, step, bodies, jax.block_until_ready)


@cache
def on_its_way() -> Any:
    """A hover run's learner, full ring and point, when it has just been filled."""
    run = hover()
    trainer, states, points = begun(run)
    advance = laps.compile_advance(trainer, states, points)
    states = advance(states, points, np.int32(run.learner.ring_unrolls))
    return jax.tree.map(lambda x: jnp.array(x[0]), (states.learner, states.ring, points))


def learning(minibatch_lanes: int, key: jax.Array) -> None:
    run = hover(minibatch_lanes=minibatch_lanes)
    trainer = Trainer(request.environment(run.task), run.learner)
    updates, shards = 64, run.learner.logical_shards
    state, ring, here = on_its_way()

    @partial(jax.jit, compiler_options=effort(1))
    def learn(ring: Any, here: Any, carry: Any) -> Any:
        state, key = carry
        key, mine = jax.random.split(key)
        keys = jax.random.split(mine, shards)
        learner, env = trainer._under(here)
        index = buffer.draw(ring, keys, updates, minibatch_lanes // shards)

        def update(now: Any, drawn: Any) -> Any:
            index, turns = drawn
            return learner.update(now, trainer._turned(env, buffer.gather(ring, index), turns))

        state, terms = jax.lax.scan(update, state, (index, trainer._turns(keys, index)))
        return (state, key), terms

    samples = updates * minibatch_lanes * UNROLL_STEPS
    rate(
        f"learning, {minibatch_lanes * UNROLL_STEPS:,} samples a minibatch",
        samples,
        lambda carry: jax.block_until_ready(learn(ring, here, carry))[0],
        (state, key),
        jax.block_until_ready,
    )


def training(unroll_steps: int, key: jax.Array) -> None:
    run = hover(
        lanes=TRAINING_LANES,
        unroll_steps=unroll_steps,
        steps=10**9,
        ring_unrolls=1,
        warmup_unrolls=1,
        updates_per_unroll=BRAX_MINIBATCHES * BRAX_PASSES,
        minibatch_lanes=TRAINING_LANES // BRAX_MINIBATCHES,
    )
    trainer, states, points = begun(run)
    advance = laps.compile_advance(trainer, states, points)
    unrolls = 200 // unroll_steps

    def on(carry: Any) -> Any:
        states, done = carry
        return advance(states, points, np.int32(done + unrolls)), done + unrolls

    rate(TRAINING[unroll_steps], unrolls * run.learner.unroll_size, on, (states, 0), jax.block_until_ready)


def begun(run: runs.RunConfig) -> tuple[Trainer, Any, Any]:
    env = request.environment(run.task)
    trainer = Trainer(env, run.learner, spread(jax.devices(), 1, run.learner.logical_shards))
    points = stack([point(env, run.learner)])
    return trainer, trainer.init(laps.seeds(0, 1), points), points


ROWS: dict[str, tuple[Callable[[int, jax.Array], None], tuple[int, ...]]] = {
    "acting": (acting, LANES),
    "physics": (physics, LANES),
    "learning": (learning, (8, 32, 256)),
    "training": (training, tuple(TRAINING)),
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

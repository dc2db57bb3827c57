"""What qrl does in a second: `throughput.py [--only acting physics learning training] --seed N`.

acting     policy 64-64, noise, physics, reward, fresh starts and recording: `rollout.unroll` of hover
physics    the quadrotor's step alone, thrusts about those of a hover, in blocks of lanes as `rollout.unroll` has them
learning   samples through draw, gather, symmetries, both networks, V-trace, loss, clip and Adam, in a loop that acts
           for 1 of 128 updates
training   environment steps of the whole loop, each sample learnt from as often as by Brax PPO's defaults (16
           minibatches an unroll, two passes): with unrolls of 50 steps, and of Brax's 10, which makes as many
           optimiser steps a step of the environment

All over the devices that `qrl train hover` makes of this machine's cores, or those that JAX_NUM_CPU_DEVICES says. A
call makes as many steps, whatever the lanes, as training makes many unrolls in one.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from qrl.config import load_preset

sys.path.insert(0, str(Path(__file__).parents[1] / "baselines"))

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from qrl import request, tasks
from qrl.algorithm import replay_buffer, rollout
from qrl.runs import record
from qrl.training import devices, driver
from qrl.training.sharding import LAYOUT, MEMBER, SHARD, make_mesh, shard_map
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, collect, make_trainer, xla_effort
from qrl_envs import env as worlds
from qrl_envs import quadrotor
from rates import LANES, TRAINING, UNROLL_STEPS, rate

BRAX_MINIBATCHES, BRAX_PASSES = 16, 2
TRAINING_LANES = 512


def hover(**learner: Any) -> record.RunConfig:
    """Hover with the default networks and these hyperparameters."""
    file = record.ConfigFile(
        learner=load_preset("hover") | {"unroll_length": UNROLL_STEPS, "apg_fraction": 0.0} | learner
    )
    return request.run_config("hover", None, file, {}, 0, 1)


def acting(lanes: int, key: jax.Array) -> None:
    trainer, states, points = begun(hover(num_envs=lanes, replay_unrolls=1))
    unrolls = max(1, LANES[-1] // lanes)  # as many steps in each call, which takes time of its own

    def act(members: Any, carry: Any, key: Any) -> Any:
        (learner, starts, here), mine = jax.tree.map(lambda x: x[0], (members, carry))

        def unroll(i: Any, mine: Any) -> Any:
            now, ring = mine
            now, seen = collect(trainer.setup, here.hyper, learner, now, jax.random.fold_in(key, i), starts)
            return now, replay_buffer.add(ring, seen)

        return jax.tree.map(lambda x: x[None], jax.lax.fori_loop(0, unrolls, unroll, mine))

    places = LAYOUT.lanes, LAYOUT.buffer
    program = shard_map(trainer.setup.mesh, act, (P(MEMBER), places, P()), places)
    acted = jax.jit(program, donate_argnums=1, compiler_options=xla_effort(1))
    members = states.learner, states.start_key, points

    def on(carry: Any) -> Any:
        mine, key = carry
        key, now = jax.random.split(key)
        return acted(members, mine, now), key

    first = (states.lanes, states.buffer), key
    rate(f"acting, {lanes:,} lanes", unrolls * lanes * UNROLL_STEPS, on, first, jax.block_until_ready)


def physics(lanes: int, key: jax.Array) -> None:
    env = worlds.make("hover")
    params: Any = env.params
    dt_s = env.task.control_period_s
    mesh = make_mesh(jax.devices(), 1, hover(num_envs=lanes).learner.shard_count)
    blocks = max(mesh.size if mesh else 1, lanes // rollout.BLOCK_LANES)
    unrolls = max(1, LANES[-1] // lanes)

    def steps(params: Any, thrusts: Any, bodies: Any) -> Any:
        each = jax.vmap(lambda body, thrust: quadrotor.step(params, body, thrust, dt_s))

        def block(of: Any) -> Any:
            return jax.lax.scan(lambda b, thrust: (each(b, thrust), None), *of)[0]

        return jax.lax.fori_loop(0, unrolls, lambda _, now: jax.lax.map(block, (now, thrusts)), bodies)

    if mesh:
        steps = jax.shard_map(steps, mesh=mesh, in_specs=(P(), P(SHARD), P(SHARD)), out_specs=P(SHARD), check_vma=False)
    draw = jax.vmap(jax.vmap(lambda k: quadrotor.draw(params.start, k)))
    bodies = draw(jax.random.split(key, (blocks, lanes // blocks)))
    about = 1.0 + 0.01 * jax.random.normal(key, (blocks, UNROLL_STEPS, lanes // blocks, 4))
    thrusts = params.physics.hover_thrust_N * about
    if mesh:
        bodies, thrusts = jax.device_put((bodies, thrusts), NamedSharding(mesh, P(SHARD)))
    step = partial(jax.jit(steps, compiler_options=xla_effort(1)), jax.tree.map(jnp.asarray, params.physics), thrusts)
    rate(f"physics, {lanes:,} lanes", unrolls * lanes * UNROLL_STEPS, step, bodies, jax.block_until_ready)


def learning(batch_size: int, key: jax.Array) -> None:
    updates = 128
    run = hover(batch_size=batch_size, updates_per_unroll=updates, warmup_unrolls=1, num_timesteps=10**9)
    samples = updates * batch_size * UNROLL_STEPS
    advancing(f"learning, {batch_size * UNROLL_STEPS:,} samples a minibatch", run, 1, samples)


def training(unroll_length: int, key: jax.Array) -> None:
    run = hover(
        num_envs=TRAINING_LANES,
        unroll_length=unroll_length,
        num_timesteps=10**9,
        replay_unrolls=1,
        warmup_unrolls=1,
        updates_per_unroll=BRAX_MINIBATCHES * BRAX_PASSES,
        batch_size=TRAINING_LANES // BRAX_MINIBATCHES,
    )
    unrolls = 200 // unroll_length
    advancing(TRAINING[unroll_length], run, unrolls, unrolls * run.learner.steps_per_unroll)


def advancing(figure: str, run: record.RunConfig, unrolls: int, counted: int) -> None:
    """How much of what is `counted` in so many unrolls the training loop does."""
    trainer, states, points = begun(run)
    advance = driver.compile_train(trainer, states, points)
    full = run.learner.replay_unrolls
    states = advance(states, points, np.int32(full))

    def on(carry: Any) -> Any:
        states, done = carry
        return advance(states, points, np.int32(done + unrolls)), done + unrolls

    rate(figure, counted, on, (states, full), jax.block_until_ready)


def begun(run: record.RunConfig) -> tuple[Trainer, Any, Any]:
    env = tasks.environment(run.task)
    trainer = make_trainer(env, run.learner, make_mesh(jax.devices(), 1, run.learner.shard_count))
    points = stack([member_inputs(env, run.learner)])
    return trainer, trainer.init(driver.seeds(0, 1), points), points


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
    devices.configure_cpu(hover(), [])
    for name in args.only:
        measure, sizes = ROWS[name]
        for size in sizes:
            measure(size, jax.random.PRNGKey(args.seed))


if __name__ == "__main__":
    main()

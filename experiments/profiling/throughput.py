"""Throughput of qrl: `throughput.py [--only acting physics learning training] --seed N`.

acting     steps/s of `rollout.unroll` of hover: policy 64-64, noise, physics, reward, fresh starts and recording
physics    steps/s of the quadrotor's step by itself, at thrusts near hover, in blocks of lanes as in `rollout.unroll`
learning   samples/s through sampling, gather, symmetries, both networks, V-trace, loss, clipping and Adam, in a loop
           with one unroll per 128 updates
training   environment steps/s of the training loop at the sample reuse of Brax PPO's defaults (16 minibatches per
           unroll, two passes): with unrolls of 50 steps, and of Brax's 10, which makes as many optimizer steps per
           environment step

All on the devices that `qrl train hover` makes of this machine's cores, or as many as JAX_NUM_CPU_DEVICES says. Each
call makes the same number of environment steps whatever the number of lanes, since a training program runs many
unrolls per call.
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
    trainer, states, points = make_run(hover(num_envs=lanes, replay_unrolls=1))
    unrolls = max(1, LANES[-1] // lanes)  # the same number of steps per call, whose overhead then is the same

    def act(members: Any, carry: Any, key: Any) -> Any:
        (learner, start_key, inputs), one = jax.tree.map(lambda x: x[0], (members, carry))

        def unroll(i: Any, carry: Any) -> Any:
            lanes, buffer = carry
            noise_key = jax.random.fold_in(key, i)
            lanes, transitions = collect(trainer.setup, inputs.hyper, learner, lanes, noise_key, start_key)
            return lanes, replay_buffer.add(buffer, transitions)

        return jax.tree.map(lambda x: x[None], jax.lax.fori_loop(0, unrolls, unroll, one))

    layout = LAYOUT.lanes, LAYOUT.buffer
    program = shard_map(trainer.setup.mesh, act, (P(MEMBER), layout, P()), layout)
    compiled = jax.jit(program, donate_argnums=1, compiler_options=xla_effort(1, lanes))
    members = states.learner, states.start_key, points

    def call(carry: Any) -> Any:
        state, key = carry
        key, subkey = jax.random.split(key)
        return compiled(members, state, subkey), key

    first = (states.lanes, states.buffer), key
    rate(f"acting, {lanes:,} lanes", unrolls * lanes * UNROLL_STEPS, call, first, jax.block_until_ready)


def physics(lanes: int, key: jax.Array) -> None:
    env = worlds.make("hover")
    params: Any = env.params
    dt_s = env.task.control_period_s
    mesh = make_mesh(jax.devices(), 1, hover(num_envs=lanes).learner.shard_count)
    blocks = max(mesh.size if mesh else 1, lanes // rollout.BLOCK_LANES)
    unrolls = max(1, LANES[-1] // lanes)

    def steps(params: Any, thrusts: Any, bodies: Any) -> Any:
        each = jax.vmap(lambda body, thrust: quadrotor.step(params, body, thrust, dt_s))

        def block(inputs: Any) -> Any:
            return jax.lax.scan(lambda body, thrust: (each(body, thrust), None), *inputs)[0]

        return jax.lax.fori_loop(0, unrolls, lambda _, bodies: jax.lax.map(block, (bodies, thrusts)), bodies)

    if mesh:
        steps = jax.shard_map(steps, mesh=mesh, in_specs=(P(), P(SHARD), P(SHARD)), out_specs=P(SHARD), check_vma=False)
    draw = jax.vmap(jax.vmap(lambda k: quadrotor.draw(params.start, k)))
    bodies = draw(jax.random.split(key, (blocks, lanes // blocks)))
    factor = 1.0 + 0.01 * jax.random.normal(key, (blocks, UNROLL_STEPS, lanes // blocks, 4))
    thrusts = params.physics.hover_thrust_N * factor
    if mesh:
        bodies, thrusts = jax.device_put((bodies, thrusts), NamedSharding(mesh, P(SHARD)))
    step = partial(
        jax.jit(steps, compiler_options=xla_effort(1, lanes)), jax.tree.map(jnp.asarray, params.physics), thrusts
    )
    rate(f"physics, {lanes:,} lanes", unrolls * lanes * UNROLL_STEPS, step, bodies, jax.block_until_ready)


def learning(batch_size: int, key: jax.Array) -> None:
    updates = 128
    run = hover(batch_size=batch_size, updates_per_unroll=updates, warmup_unrolls=1, num_timesteps=10**9)
    samples = updates * batch_size * UNROLL_STEPS
    measure_advance(f"learning, {batch_size * UNROLL_STEPS:,} samples a minibatch", run, 1, samples)


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
    measure_advance(TRAINING[unroll_length], run, unrolls, unrolls * run.learner.steps_per_unroll)


def measure_advance(figure: str, run: record.RunConfig, unrolls: int, per_call: int) -> None:
    """Report the rate of the training loop, whose `unrolls` count as `per_call`."""
    trainer, states, points = make_run(run)
    advance = driver.compile_train(trainer, states, points)
    full = run.learner.replay_unrolls
    states = advance(states, points, np.int32(full))

    def call(carry: Any) -> Any:
        states, done = carry
        return advance(states, points, np.int32(done + unrolls)), done + unrolls

    rate(figure, per_call, call, (states, full), jax.block_until_ready)


def make_run(run: record.RunConfig) -> tuple[Trainer, Any, Any]:
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

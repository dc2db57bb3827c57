"""Throughput of qrl: `throughput.py [--only acting real physics learning training] --seed N`.

acting     steps/s of `rollout.unroll` of hover: policy 64-64, noise, physics, reward, fresh starts and recording
real       the same of the Crazyflie as it is, with the recurrent policy of its preset
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
from qrl.algorithm import rollout
from qrl.runs import record
from qrl.training import devices, driver
from qrl.training.sharding import LAYOUT, MEMBER, SHARD, make_mesh, shard_map
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, collect, make_trainer, xla_effort
from qrl_envs import env as worlds
from qrl_envs import quadrotor
from qrl_envs.task_env import TaskEnv
from rates import LANES, TRAINING, UNROLL_STEPS, rate

VEHICLE = "crazyflie"  # the real one: lag, drag, sensors, uncertainty
BRAX_MINIBATCHES, BRAX_PASSES = 16, 2
TRAINING_LANES = 512
CALL_STEPS = LANES[-1] * UNROLL_STEPS  # environment steps of a call, whatever the lanes: its overhead then is the same
UPDATES = 128  # of a call of `learning`


def hover(**learner: Any) -> record.RunConfig:
    """Hover with the default networks and these hyperparameters."""
    file = record.ConfigFile(
        learner=load_preset("hover") | {"unroll_length": UNROLL_STEPS, "apg_fraction": 0.0} | learner
    )
    return request.run_config("hover", None, file, {}, 0, 1)


def acting(
    lanes: int,
    key: jax.Array,
    run: record.RunConfig | None = None,
    figure: str = "acting",
    call_steps: int = CALL_STEPS,
) -> None:
    """Of hover, or of another `run` of so many lanes and a replay buffer of one unroll."""
    run = run or hover(num_envs=lanes, replay_unrolls=1)
    trainer, states, points = make_run(run)
    unrolls = max(1, call_steps // run.learner.steps_per_unroll)

    def act(members: Any, carry: Any, key: Any) -> Any:
        (learner, start_key, inputs), one = jax.tree.map(lambda x: x[0], (members, carry))

        def unroll(i: Any, carry: Any) -> Any:
            lanes, buffer = carry
            noise_key = jax.random.fold_in(key, i)
            return collect(trainer.setup, inputs, learner, lanes, buffer, noise_key, start_key)

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
    rate(f"{figure}, {lanes:,} lanes", unrolls * run.learner.steps_per_unroll, call, first, jax.block_until_ready)


def real_hover(**learner: Any) -> record.RunConfig:
    """Hover of a vehicle with lag, drag, sensors and uncertainty, and its preset, whose policy is recurrent."""
    parts = {"vehicle": VEHICLE}
    return request.run_config("hover", None, record.ConfigFile(), {"apg_fraction": 0.0} | learner, 0, 1, parts)


def acting_real(lanes: int, key: jax.Array) -> None:
    steps = {"unroll_length": UNROLL_STEPS, "num_timesteps": 10**9}
    acting(lanes, key, real_hover(num_envs=lanes, replay_unrolls=1, **steps), "real plant, acting")


def physics(
    lanes: int, key: jax.Array, env: TaskEnv | None = None, figure: str = "physics", call_steps: int = CALL_STEPS
) -> None:
    """Of the ideal quadrotor, or of the plant of `env` under its actions, without observation and reward."""
    world = env or worlds.make("hover")
    mesh = make_mesh(jax.devices(), 1, hover(num_envs=lanes).learner.shard_count)
    blocks = mesh.size if mesh else 1
    if jax.default_backend() == "cpu":
        blocks = max(blocks, lanes // rollout.BLOCK_LANES)
    unrolls = max(1, call_steps // (lanes * UNROLL_STEPS))
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(world.reset, key))

    def steps(params: Any, actions: Any, plants: Any) -> Any:
        def one(plant: Any, action: Any) -> Any:
            if env is None:
                return quadrotor.step(params.physics, plant, action, world.control_period_s)
            lane = blank.pipeline_state._replace(x=plant, params=params)
            return env.step(blank.replace(pipeline_state=lane), action).pipeline_state.x

        def block(inputs: Any) -> Any:
            return jax.lax.scan(lambda plants, actions: (jax.vmap(one)(plants, actions), None), *inputs)[0]

        return jax.lax.fori_loop(0, unrolls, lambda _, plants: jax.lax.map(block, (plants, actions)), plants)

    if mesh:
        steps = jax.shard_map(steps, mesh=mesh, in_specs=(P(), P(SHARD), P(SHARD)), out_specs=P(SHARD), check_vma=False)
    draw = jax.jit(jax.vmap(jax.vmap(lambda key: world.reset(key).pipeline_state.x)))
    plants = draw(jax.random.split(key, (blocks, lanes // blocks)))
    actions = 0.01 * jax.random.normal(key, (blocks, UNROLL_STEPS, lanes // blocks, world.action_size))
    if env is None:
        vehicle: Any = world.params.physics
        actions = vehicle.hover_thrust_N * (1.0 + actions)
    if mesh:
        plants, actions = jax.device_put((plants, actions), NamedSharding(mesh, P(SHARD)))
    step = partial(
        jax.jit(steps, compiler_options=xla_effort(1, lanes)), jax.tree.map(jnp.asarray, world.params), actions
    )
    rate(f"{figure}, {lanes:,} lanes", unrolls * lanes * UNROLL_STEPS, step, plants, jax.block_until_ready)


def learning(batch_size: int, key: jax.Array, updates: int = UPDATES) -> None:
    run = hover(batch_size=batch_size, updates_per_unroll=updates, warmup_unrolls=1, num_timesteps=10**9)
    samples = updates * batch_size * UNROLL_STEPS
    measure_advance(f"learning, {batch_size * UNROLL_STEPS:,} samples a minibatch", run, 1, samples)


def training(unroll_length: int, key: jax.Array, lanes: int = TRAINING_LANES, figure: str | None = None) -> None:
    run = hover(
        num_envs=lanes,
        unroll_length=unroll_length,
        num_timesteps=10**9,
        replay_unrolls=1,
        warmup_unrolls=1,
        updates_per_unroll=BRAX_MINIBATCHES * BRAX_PASSES,
        batch_size=lanes // BRAX_MINIBATCHES,
    )
    unrolls = 200 // unroll_length
    measure_advance(figure or TRAINING[unroll_length], run, unrolls, unrolls * run.learner.steps_per_unroll)


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
    "real": (acting_real, LANES),
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

"""Where a training run's time goes: `profile_run.py [TASK] [--repeats 9]`, a table in Markdown.

Each part of one unroll-and-learn of the task's preset is compiled alone and timed, all in turn, medians over repeats.
"Of the floor" is the share of that time which its multiply-adds alone would take, at the rate of a 64 x 64 product on
this machine at the same time.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax

from qrl import buffer, laps, request, rollout, runs
from qrl.train import Trainer, point, stack
from qrl.types import Networks
from qrl.vtrace import vtrace

REPEATED = 20  # times, within a timed call

Part = tuple[str, Callable[[], Any], int, float]  # name, call, how often an unroll makes it, multiply-adds of a call


def repeated(call: Callable[[chex.Array], Any]) -> Callable[[], Any]:
    """`call` compiled, REPEATED times in a row, its argument too small a number for any result to differ."""

    def turn(tiny: chex.Array, _: None) -> tuple[chex.Array, None]:
        first = jax.tree.leaves(call(tiny))[0].reshape(-1)[0]
        return tiny + 1e-30 * jnp.asarray(first, jnp.float32), None

    program = jax.jit(lambda: jax.lax.scan(turn, jnp.float32(0.0), None, REPEATED)[0])
    return lambda: program().block_until_ready()


def layers(sizes: list[int]) -> int:
    """Multiply-adds of one pass."""
    return sum(a * b for a, b in itertools.pairwise(sizes))


def parts(task: str) -> tuple[list[Part], Callable[[], Any], int]:
    """The parts, and the whole: unrolls of a run on its way."""
    run = request.run_config(task, None, runs.ConfigFile(), {}, 0, 1)
    env, config = request.environment(run.task), run.learner
    trainer, points = Trainer(env, config), stack([point(env, config)])
    states = trainer.init(laps.seeds(0, 1), points)
    advance = laps.compile_advance(trainer, states, points)
    states = jax.block_until_ready(advance(states, points, np.int32(min(config.unrolls, 2 * config.ring_unrolls))))
    one = jax.tree.map(lambda x: jnp.array(x[0]), states)
    learner, lanes, ring = trainer.learner, one.lanes, one.ring
    key, shards = jax.random.PRNGKey(0), config.logical_shards
    batch = buffer.gather(ring, jnp.arange(config.minibatch_lanes))
    each, updates = config.minibatch_lanes // shards, config.updates_per_unroll
    size, inputs, outputs = batch.reward.size, trainer.learner.observation_size, env.action_size
    policy = layers([inputs, *config.policy_hidden, outputs])
    critic = layers([inputs, *config.critic_hidden, 1])
    params, data = one.learner.params, jax.tree.map(lambda x: x[0], ring.data)

    def unroll(tiny: chex.Array) -> Any:
        return rollout.unroll(
            env,
            lanes,
            lambda o: learner.mean(one.learner, o + tiny),
            learner.sigma(one.learner),
            key,
            one.starts,
            unroll_steps=config.unroll_steps,
            longest=trainer.longest,
        )[1].reward

    def noise(tiny: chex.Array) -> Any:
        shape = (config.unroll_steps, outputs)
        return tiny + jax.vmap(lambda key: jax.random.normal(key, shape))(jax.random.split(key, config.lanes))

    def physics(tiny: chex.Array) -> Any:
        state = lanes.state.replace(obs=lanes.state.obs + tiny)  # pyright: ignore[reportAttributeAccessIssue]
        action = jnp.zeros((config.lanes, outputs)) + tiny
        step = jax.vmap(env.step)
        return jax.lax.scan(lambda s, _: (step(s, action), None), state, None, config.unroll_steps)[0].obs

    def acting(tiny: chex.Array) -> Any:
        observation = lanes.state.obs

        def once(total: chex.Array, _: None) -> tuple[chex.Array, None]:
            return total + learner.mean(one.learner, observation + total[0, 0]).mean() * 1e-30, None

        return jax.lax.scan(once, jnp.zeros((1, 1)) + tiny, None, config.unroll_steps)[0]

    def traced(tiny: chex.Array) -> Any:
        def trace(*x: chex.Array) -> Any:
            return vtrace(*x, gamma=config.gamma)

        zero = jnp.zeros_like(batch.reward)
        return jax.vmap(trace)(batch.reward + tiny, zero, zero, batch.terminated, batch.truncated, zero + 1.0).a_trace

    def stepped(tiny: chex.Array) -> Any:
        gradient: Networks = jax.tree.map(lambda x: x + tiny, params)
        moved = [learner._optimiser.update(g, o) for g, o in zip(gradient, one.learner.optimiser, strict=True)]
        return [optax.tree.norm(direction) for direction, _ in moved]

    def scaled(tiny: chex.Array) -> chex.Array:
        return (batch.observation * jnp.asarray(config.observation_scale or 1.0) + tiny).reshape(-1, inputs)

    def inserted(tiny: chex.Array) -> Any:
        return buffer.add(ring, data._replace(reward=data.reward + tiny)).data.reward

    def drawn(tiny: chex.Array) -> Any:
        return buffer.draw(ring, jax.random.split(key + jnp.uint32(tiny), shards), updates, each)

    def gathered(tiny: chex.Array) -> Any:
        return buffer.gather(ring, jnp.arange(config.minibatch_lanes) + jnp.int32(tiny)).observation

    def turned(tiny: chex.Array) -> Any:
        return trainer._turned(env, batch, jnp.zeros((config.minibatch_lanes, 2)) + tiny).observation

    def updated(tiny: chex.Array) -> Any:
        return learner.update(one.learner, batch._replace(reward=batch.reward + tiny))[1].value

    # Backwards: as much again for the weights, and for the inputs of all layers but the first.
    first = inputs * (config.policy_hidden[0] + config.critic_hidden[0])
    backwards = 2 * (policy + critic) - first
    rows: list[Part] = [
        ("acting", repeated(unroll), 1, policy * config.unroll_size),
        ("acting: policy", repeated(acting), 1, policy * config.unroll_size),
        ("acting: noise", repeated(noise), 1, 0),
        ("acting: physics, reward", repeated(physics), 1, 0),
        ("ring: insert", repeated(inserted), 1, 0),
        ("ring: draw", repeated(drawn), 1, 0),
        ("ring: gather", repeated(gathered), updates, 0),
        ("symmetries", repeated(turned), updates, 0),
        ("update", repeated(updated), updates, (policy + critic + backwards) * size),
        ("update: policy forward", repeated(lambda t: learner.policy.apply(params.policy, scaled(t))), updates, 0),
        ("update: critic forward", repeated(lambda t: learner.critic.apply(params.critic, scaled(t))), updates, 0),
        ("update: V-trace", repeated(traced), updates, 0),
        ("update: clip and Adam", repeated(stepped), updates, 0),
    ]
    box = [states]

    def whole() -> None:
        done = int(box[0].unrolls[0])
        box[0] = jax.block_until_ready(advance(box[0], points, np.int32(done + 2)))

    return rows, whole, config.unroll_size


def product_rate() -> float:
    """Multiply-adds a second of [1600, 64] x [64, 64]."""
    a, b = jnp.ones((1600, 64)), jnp.ones((64, 64))
    program = jax.jit(lambda a: jax.lax.fori_loop(0, 200, lambda _, x: (x @ b) * 0.015, a))
    program(a).block_until_ready()
    times = []
    for _ in range(9):
        begun = time.perf_counter()
        program(a).block_until_ready()
        times.append(time.perf_counter() - begun)
    return 200 * 1600 * 64 * 64 / float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", default="hover")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    rows, whole, unroll_size = parts(args.task)
    seconds: dict[str, list[float]] = {name: [] for name, *_ in rows} | {"whole": []}
    rates = []
    for _ in range(args.repeats + 1):  # the first compiles
        for name, call, count, _ in rows:
            begun = time.perf_counter()
            call()
            seconds[name].append((time.perf_counter() - begun) / REPEATED * count)
        begun = time.perf_counter()
        whole()
        seconds["whole"].append((time.perf_counter() - begun) / 2)
        rates.append(product_rate())
    took = {name: float(np.median(values[1:])) for name, values in seconds.items()}
    rate = float(np.median(rates))
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}; {2e-9 * rate:.0f} GFLOP/s in [1600, 64] x [64, 64]\n"
    )
    print("| part | ms an unroll | share | of the floor |\n|---|---|---|---|")
    for name, _, count, adds in rows:
        floor = f"{adds * count / rate / took[name]:.0%}" if adds else ""
        print(f"| {name} | {1e3 * took[name]:.2f} | {took[name] / took['whole']:.1%} | {floor} |")
    print(f"| the whole | {1e3 * took['whole']:.2f} | 100 % | |")
    print(f"\n{unroll_size / took['whole']:,.0f} env steps/s")


if __name__ == "__main__":
    main()

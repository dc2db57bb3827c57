"""Where a training run's time goes: `profile_run.py [TASK] [--repeats 9]`, a table in Markdown.

Each part of one unroll-and-learn of the task's preset is compiled alone, as a Trainer's programs are, and timed, all in
turn, medians over repeats. So that nothing of a part is left out, its whole result is what the next repeat begins with,
and what it is made from differs from repeat to repeat. Parts of parts are indented. "Of the floor" is the share of that
time which its multiply-adds alone would take, at the rate of a 64 x 64 product on this machine at the same time.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from qrl import buffer, laps, request, rollout, runs
from qrl.learner import Learner
from qrl.train import Trainer, TrainState, effort, point, stack
from qrl.types import Networks, Transition
from qrl.vtrace import vtrace

REPEATED = 20  # times, within a timed call
WHOLE = 4  # unrolls of the whole, within a timed call


class Now(NamedTuple):
    """What the parts are made from: arguments of their programs, so that nothing of it is known when they compile."""

    state: TrainState
    point: Any
    minibatches: chex.Array  # [REPEATED, B] trajectories of minibatches
    turns: chex.Array  # [REPEATED, B, 2] their symmetries
    batch: Transition  # leaves [B, T, ...]


class Part(NamedTuple):
    name: str
    call: Callable[[], Any]
    times: int  # how often an unroll makes it
    adds: float  # multiply-adds of a call


def repeated(call: Callable[[Now, Any, chex.Array, chex.Array], Any], now: Now, first: Any = None) -> Callable[[], Any]:
    """`call` (now, last, i, tiny) compiled, REPEATED times in a row: each result, whole, is the next one's `last`.

    `tiny` changes no result, but XLA cannot know. Without a `first`, the first `last` is zeros.
    """

    def turn(now: Now, last: Any, i: chex.Array) -> Any:
        result = call(now, last, i, 1e-30 * (i + 1).astype(jnp.float32))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), result)  # types that are said, not weak

    if first is None:
        result = jax.eval_shape(lambda now: call(now, None, jnp.int32(0), jnp.float32(0.0)), now)
        first = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), result)

    def all_of_it(now: Now, last: Any) -> Any:
        return jax.lax.scan(lambda last, i: (turn(now, last, i), None), last, jnp.arange(REPEATED))[0]

    program = jax.jit(all_of_it, donate_argnums=1, compiler_options=effort(1))
    box = [jax.tree.map(jnp.array, first)]

    def timed() -> None:
        box[0] = jax.block_until_ready(program(now, box[0]))

    return timed


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
    shards, updates = config.logical_shards, config.updates_per_unroll
    each = config.minibatch_lanes // shards
    keys = jax.random.split(jax.random.PRNGKey(0), shards)
    index = buffer.draw(one.ring, keys, REPEATED, each)
    batch = buffer.gather(one.ring, index[0])
    now = Now(one, jax.tree.map(lambda x: jnp.array(x[0]), points), index, trainer._turns(keys, index), batch)
    size, inputs, outputs = batch.reward.size, trainer.learner.observation_size, env.action_size
    policy = layers([inputs, *config.policy_hidden, outputs])
    critic = layers([inputs, *config.critic_hidden, 1])

    def under(now: Now) -> Learner:
        return trainer._under(now.point)[0]

    def slightly(tree: Any, tiny: chex.Array) -> Any:
        return jax.tree.map(lambda x: x + tiny, tree)

    def unroll(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        lanes, _ = last
        state, key = now.state, jax.random.fold_in(now.state.key, i)
        return trainer._collect(under(now), state.learner, lanes, key, state.starts)

    def unrolled(now: Now) -> Any:
        """The newest unroll's observations and actions, [T, N, ...]."""
        newest = (now.state.ring.inserted - 1) % config.ring_unrolls
        data = now.state.ring.data
        return [jnp.swapaxes(x[newest], 0, 1) for x in (data.observation, data.action)]

    def noise(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        key, shape = jax.random.fold_in(now.state.key, i), (config.unroll_steps, outputs)
        return jax.vmap(lambda n: jax.random.normal(jax.random.fold_in(key, n), shape))(now.state.lanes.number)

    def physics(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        def step(state: Any, action: chex.Array) -> Any:
            state = jax.vmap(env.step)(state, jnp.clip(action, -1.0, 1.0))
            return state, (state.obs, state.reward, state.done)

        return jax.lax.scan(step, now.state.lanes.state, unrolled(now)[1] + tiny)

    def starts(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        over = jnp.ones(config.lanes, bool)
        lanes = now.state.lanes._replace(ended=over, used=over, start=now.state.lanes.start + i)
        return rollout._restart(env, lanes, now.state.starts)

    def acting(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        learner, state = under(now), now.state.learner
        state = state._replace(params=slightly(state.params, tiny))
        return jax.lax.scan(lambda _, o: (None, learner.mean(state, o)), None, unrolled(now)[0])[1]

    def inserted(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        data = jax.tree.map(lambda x: x[0], now.state.ring.data)
        return buffer.add(last, slightly(data, tiny))

    def drawn(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        keys = jax.vmap(lambda shard: jax.random.fold_in(jax.random.fold_in(now.state.key, i), shard))(
            jnp.arange(shards)
        )
        index = buffer.draw(now.state.ring, keys, updates, each)
        return index, trainer._turns(keys, index)

    def gathered(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        return buffer.gather(now.state.ring, now.minibatches[i])

    def turned(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        after = trainer._turned(env, now.batch, now.turns[i])
        return after.observation + tiny, after.next_observation + tiny, after.action + tiny

    def updated(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        return under(now).update(last[0], slightly(now.batch, tiny))

    def scaled(now: Now, tiny: chex.Array) -> chex.Array:
        return under(now).scale(now.state.learner, now.batch.observation.reshape(-1, inputs)) + tiny

    def policy_forward(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        return trainer.learner.policy.apply(now.state.learner.params.policy, scaled(now, tiny))

    def critic_forward(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        return trainer.learner.critic.apply(now.state.learner.params.critic, scaled(now, tiny))

    def traced(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        hyper, batch = under(now).hyper, now.batch
        clips = {name: hyper[name] for name in ("gamma", "lam", "rho_bar", "c_bar")}
        value, rho = batch.log_mu + tiny, jnp.exp(batch.log_mu + tiny)
        trajectories = batch.reward, value, value + 1.0, batch.terminated, batch.truncated, rho
        return jax.vmap(lambda *x: vtrace(*x, **clips))(*trajectories)

    def stepped(now: Now, last: Any, i: chex.Array, tiny: chex.Array) -> Any:
        optimiser: Any = under(now)._optimiser

        def descend(params: Any, gradient: Any, opt: Any) -> Any:  # as within Learner.update
            flat, whole = ravel_pytree(gradient)
            direction, opt = optimiser.update(flat, opt)
            norm = jnp.linalg.norm(flat)
            return jax.tree.map(lambda p, d: p - 1e-6 * d, params, whole(direction)), opt, norm

        gradient: Networks = slightly(now.state.learner.params, tiny)
        return [descend(p, g, o) for (p, o, _), g in zip(last, gradient, strict=True)]

    # Backwards: as much again for the weights, and for the inputs of all layers but the first.
    first = inputs * (config.policy_hidden[0] + config.critic_hidden[0])
    backwards = 2 * (policy + critic) - first
    newest = jax.tree.map(lambda x: x[0], one.ring.data)
    zero = jnp.float32(0.0)
    step = [(p, o, zero) for p, o in zip(one.learner.params, one.learner.optimiser, strict=True)]
    terms = jax.eval_shape(trainer.learner.update, one.learner, batch)[1]
    learnt = one.learner, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), terms)
    rows = [
        Part("acting", repeated(unroll, now, (one.lanes, newest)), 1, policy * config.unroll_size),
        Part("– policy", repeated(acting, now), 1, policy * config.unroll_size),
        Part("– noise", repeated(noise, now), 1, 0),
        Part("– physics, reward", repeated(physics, now), 1, 0),
        Part("– one draw of all lanes' starts", repeated(starts, now), 1, 0),
        Part("ring: insert", repeated(inserted, now, one.ring), 1, 0),
        Part("draws of minibatches and symmetries", repeated(drawn, now), 1, 0),
        Part("ring: gather", repeated(gathered, now), updates, 0),
        Part("symmetries", repeated(turned, now), updates, 0),
        Part("update", repeated(updated, now, learnt), updates, (policy + critic + backwards) * size),
        Part("– policy forward", repeated(policy_forward, now), updates, policy * size),
        Part("– critic forward", repeated(critic_forward, now), updates, critic * size),
        Part("– V-trace", repeated(traced, now), updates, 0),
        Part("– clip and Adam", repeated(stepped, now, step), updates, 0),
    ]
    box = [states]

    def whole() -> None:
        done = int(box[0].unrolls[0])
        box[0] = jax.block_until_ready(advance(box[0], points, np.int32(done + WHOLE)))

    return rows, whole, config.unroll_size


def product_rate() -> float:
    """Multiply-adds a second of [1600, 64] x [64, 64], at its best: what others take beside us is no floor."""
    a, b = jnp.ones((1600, 64)), jnp.full((64, 64), 1.0 / 64.0)
    program = jax.jit(lambda a, b: jax.lax.fori_loop(0, 200, lambda _, x: x @ b, a), compiler_options=effort(1))
    program(a, b).block_until_ready()
    times = []
    for _ in range(9):
        begun = time.perf_counter()
        program(a, b).block_until_ready()
        times.append(time.perf_counter() - begun)
    return 200 * 1600 * 64 * 64 / min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", default="hover")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    rows, whole, unroll_size = parts(args.task)
    seconds: dict[str, list[float]] = {part.name: [] for part in rows} | {"whole": []}
    rates = []
    for _ in range(args.repeats + 1):  # the first compiles
        for name, call, times, _ in rows:
            begun = time.perf_counter()
            call()
            seconds[name].append((time.perf_counter() - begun) / REPEATED * times)
        begun = time.perf_counter()
        whole()
        seconds["whole"].append((time.perf_counter() - begun) / WHOLE)
        rates.append(product_rate())
    took = {name: float(np.median(values[1:])) for name, values in seconds.items()}
    rate = float(np.median(rates))
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}; {2e-9 * rate:.0f} GFLOP/s in [1600, 64] x [64, 64]\n"
    )
    print("| part | ms an unroll | share | of the floor |\n|---|---|---|---|")
    for name, _, times, adds in rows:
        floor = f"{adds * times / rate / took[name]:.0%}" if adds else ""
        print(f"| {name} | {1e3 * took[name]:.2f} | {took[name] / took['whole']:.1%} | {floor} |")
    together = sum(took[part.name] for part in rows if not part.name.startswith("–"))
    print(f"| these together | {1e3 * together:.2f} | {together / took['whole']:.1%} | |")
    print(f"| the whole | {1e3 * took['whole']:.2f} | 100.0% | |")
    print(f"\n{unroll_size / took['whole']:,.0f} env steps/s")


if __name__ == "__main__":
    main()

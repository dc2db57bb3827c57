"""The parts of one unroll-and-learn that `profile_run.py` times: acting's, the ring's and minibatches', the update's.

What makes a part is a function of the trainer and a `Turn`.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm import augmentation, learner, replay_buffer, rollout
from qrl.algorithm.types import Networks, Transition
from qrl.algorithm.vtrace import vtrace
from qrl.training.state import MemberInputs, TrainState
from qrl.training.trainer import Trainer, collect

REPEATED = 20  # times, within a timed call


class Now(NamedTuple):
    """What the parts are made from: arguments of their programs, so that nothing of it is known when they compile."""

    state: TrainState  # one member's
    point: MemberInputs
    minibatches: chex.Array  # [REPEATED, B] trajectories of minibatches
    turns: chex.Array  # [REPEATED, B, 2] their symmetries
    batch: Transition  # leaves [B, T, ...]


class Turn(NamedTuple):
    """One of the REPEATED times."""

    now: Now
    last: Any  # what the time before has made
    i: chex.Array  # int32 []
    tiny: chex.Array  # float32 []: changes no result that it is added to, but XLA cannot know


class Part(NamedTuple):
    name: str  # with a dash before it: a part of the last that has none
    make: Callable[[Trainer, Turn], Any]
    times: int = 1  # how often an unroll makes it
    adds: int = 0  # multiply-adds of one time
    first: Any = None  # what the first time finds as its `last`; None: zeros


def now_of(trainer: Trainer, states: TrainState, points: MemberInputs) -> Now:
    """Copies of what the parts need of a run of one member: the run may go on, and donate its states."""
    one, here = jax.tree.map(lambda x: jnp.array(x[0]), (states, points))
    shards = trainer.config.shard_count
    keys = jax.random.split(jax.random.PRNGKey(0), shards)
    index = replay_buffer.sample(one.buffer, keys, REPEATED, trainer.config.batch_size // shards)
    return Now(
        one,
        here,
        index,
        augmentation.sample(keys, REPEATED, trainer.config.batch_size // shards),
        replay_buffer.gather(one.buffer, index[0]),
    )


def parts(trainer: Trainer, now: Now) -> list[Part]:
    return [*acting_parts(trainer, now), *minibatch_parts(trainer, now), *update_parts(trainer, now)]


def slightly(tree: Any, tiny: chex.Array) -> Any:
    return jax.tree.map(lambda x: x + tiny, tree)


def pass_adds(trainer: Trainer) -> tuple[int, int]:
    """Multiply-adds of one pass of the policy, and of the critic."""
    config, inputs = trainer.config, trainer.setup.spec.observation_size
    policy, critic = (
        [inputs, *config.policy_hidden_layer_sizes, trainer.setup.env.action_size],
        [inputs, *config.critic_hidden_layer_sizes, 1],
    )
    return layers(policy), layers(critic)


def layers(sizes: list[int]) -> int:
    return sum(a * b for a, b in itertools.pairwise(sizes))


# -- acting --------------------------------------------------------------------------------------------------


def acting_parts(trainer: Trainer, now: Now) -> list[Part]:
    adds = pass_adds(trainer)[0] * trainer.config.steps_per_unroll
    slot = jax.tree.map(lambda x: x[0], now.state.buffer.data)
    return [
        Part("acting", acted, adds=adds, first=(now.state.lanes, slot)),
        Part("– policy", policy_alone, adds=adds),
        Part("– noise", noise),
        Part("– physics, reward", physics),
        Part("– one draw of all lanes' starts", starts),
    ]


def acted(trainer: Trainer, turn: Turn) -> Any:
    lanes, _ = turn.last
    state, key = turn.now.state, jax.random.fold_in(turn.now.state.key, turn.i)
    return collect(trainer.setup, turn.now.point.hyper, state.learner, lanes, key, state.start_key)


def unrolled(trainer: Trainer, now: Now) -> Any:
    """The newest unroll's observations and actions, [T, N, ...]."""
    newest = (now.state.buffer.inserted - 1) % trainer.config.replay_unrolls
    data: Any = now.state.buffer.data
    return [jnp.swapaxes(x[newest], 0, 1) for x in (data.observation, data.action)]


def policy_alone(trainer: Trainer, turn: Turn) -> Any:
    state, hyper = turn.now.state.learner, turn.now.point.hyper
    state = state._replace(params=slightly(state.params, turn.tiny))

    def step(_: None, observation: chex.Array) -> Any:
        return None, learner.policy_mean(trainer.setup.spec, hyper, state, observation)

    return jax.lax.scan(step, None, unrolled(trainer, turn.now)[0])[1]


def noise(trainer: Trainer, turn: Turn) -> Any:
    key, shape = (
        jax.random.fold_in(turn.now.state.key, turn.i),
        (trainer.config.unroll_length, trainer.setup.env.action_size),
    )
    return jax.vmap(lambda n: jax.random.normal(jax.random.fold_in(key, n), shape))(turn.now.state.lanes.lane_id)


def physics(trainer: Trainer, turn: Turn) -> Any:
    def step(state: Any, action: chex.Array) -> Any:
        state = jax.vmap(trainer.setup.env.step)(state, jnp.clip(action, -1.0, 1.0))
        return state, (state.obs, state.reward, state.done)

    return jax.lax.scan(step, turn.now.state.lanes.state, unrolled(trainer, turn.now)[1] + turn.tiny)


def starts(trainer: Trainer, turn: Turn) -> Any:
    over, lanes = jnp.ones(trainer.config.num_envs, bool), turn.now.state.lanes
    lanes = lanes._replace(done=over, next_state_used=over, reset_count=lanes.reset_count + turn.i)
    return rollout.restart(trainer.setup.env, lanes, turn.now.state.start_key)


# -- from an unroll to minibatches ---------------------------------------------------------------------------


def minibatch_parts(trainer: Trainer, now: Now) -> list[Part]:
    updates = trainer.config.updates_per_unroll
    return [
        Part("ring: insert", inserted, first=now.state.buffer),
        Part("draws of minibatches and symmetries", drawn),
        Part("ring: gather", gathered, updates),
        Part("symmetries", turned, updates),
    ]


def inserted(trainer: Trainer, turn: Turn) -> Any:
    slot = jax.tree.map(lambda x: x[0], turn.now.state.buffer.data)
    return replay_buffer.add(turn.last, slightly(slot, turn.tiny))


def drawn(trainer: Trainer, turn: Turn) -> Any:
    config, state = trainer.config, turn.now.state
    shards = config.shard_count
    keys = jax.vmap(lambda shard: jax.random.fold_in(jax.random.fold_in(state.key, turn.i), shard))(jnp.arange(shards))
    index = replay_buffer.sample(state.buffer, keys, config.updates_per_unroll, config.batch_size // shards)
    return index, augmentation.sample(keys, config.updates_per_unroll, config.batch_size // shards)


def gathered(trainer: Trainer, turn: Turn) -> Any:
    return replay_buffer.gather(turn.now.state.buffer, turn.now.minibatches[turn.i])


def turned(trainer: Trainer, turn: Turn) -> Any:
    after = augmentation.augment(trainer.setup.env, turn.now.batch, turn.now.turns[turn.i])
    return after.observation + turn.tiny, after.next_observation + turn.tiny, after.action + turn.tiny


# -- update --------------------------------------------------------------------------------------------------


def update_parts(trainer: Trainer, now: Now) -> list[Part]:
    config, spec, state = trainer.config, trainer.setup.spec, now.state.learner
    updates, size = config.updates_per_unroll, now.batch.reward.size
    policy, critic = pass_adds(trainer)
    # Backwards: as much again for the weights, and for the inputs of all layers but the first.
    backwards = 2 * (policy + critic) - spec.observation_size * (
        config.policy_hidden_layer_sizes[0] + config.critic_hidden_layer_sizes[0]
    )
    terms = jax.eval_shape(lambda *x: learner.update(spec, now.point.hyper, *x), state, now.batch)[1]
    no_terms = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), terms)
    step = [(p, o, jnp.float32(0.0)) for p, o in zip(state.params, state.optimizer, strict=True)]
    return [
        Part("update", updated, updates, (policy + critic + backwards) * size, first=(state, no_terms)),
        Part("– policy forward", policy_forward, updates, policy * size),
        Part("– critic forward", critic_forward, updates, critic * size),
        Part("– V-trace", traced, updates),
        Part("– clip and Adam", stepped, updates, first=step),
    ]


def updated(trainer: Trainer, turn: Turn) -> Any:
    batch = slightly(turn.now.batch, turn.tiny)
    return learner.update(trainer.setup.spec, turn.now.point.hyper, turn.last[0], batch)


def policy_forward(trainer: Trainer, turn: Turn) -> Any:
    return trainer.setup.spec.policy.apply(turn.now.state.learner.params.policy, scaled(trainer, turn))


def critic_forward(trainer: Trainer, turn: Turn) -> Any:
    return trainer.setup.spec.critic.apply(turn.now.state.learner.params.critic, scaled(trainer, turn))


def scaled(trainer: Trainer, turn: Turn) -> chex.Array:
    """The minibatch's observations as the networks see them, [B·T, F]."""
    flat = turn.now.batch.observation.reshape(-1, turn.now.batch.observation.shape[-1])
    return learner.preprocess(trainer.setup.spec, turn.now.point.hyper, turn.now.state.learner, flat) + turn.tiny


def traced(trainer: Trainer, turn: Turn) -> Any:
    hyper, batch = turn.now.point.hyper, turn.now.batch
    clips = {name: getattr(hyper, name) for name in ("gamma", "lam", "rho_bar", "c_bar")}
    value, rho = batch.log_mu + turn.tiny, jnp.exp(batch.log_mu + turn.tiny)
    trajectories = batch.reward, value, value + 1.0, batch.terminated, batch.truncated, rho
    return jax.vmap(lambda *x: vtrace(*x, **clips))(*trajectories)


def stepped(trainer: Trainer, turn: Turn) -> Any:
    hyper, rate = turn.now.point.hyper, jnp.float32(1e-6)
    gradient: Networks = slightly(turn.now.state.learner.params, turn.tiny)
    pairs = zip(turn.last, gradient, strict=True)
    return [learner.apply_gradient(hyper, params, g, optimizer, rate) for (params, optimizer, _), g in pairs]

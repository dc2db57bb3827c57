"""The parts of one training step that `experiments.profiling.run` times: acting, replay buffer and minibatches, update.

A part is a function of the trainer and a `Call`.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl.algorithm import augmentation, learner, replay_buffer, rollout
from qrl.algorithm.carried import lanes_last
from qrl.algorithm.types import Networks, Transition
from qrl.algorithm.vtrace import vtrace
from qrl.training.state import MemberInputs, TrainState
from qrl.training.trainer import Trainer, collect

REPEATS = 20  # times, within a timed call


class Inputs(NamedTuple):
    """Arguments of all parts' programs, so that XLA folds none of it into a constant."""

    state: TrainState  # one member's
    member: MemberInputs
    minibatches: chex.Array  # [REPEATS, B] trajectories of minibatches
    symmetries: chex.Array  # [REPEATS, B, 2] uniform draws, one symmetry for each trajectory
    batch: Transition  # leaves [B, T, ...]


class Call(NamedTuple):
    """The arguments of one repetition."""

    inputs: Inputs
    last: Any  # result of the repetition before
    i: chex.Array  # int32 []
    tiny: chex.Array  # float32 []: changes no result that it is added to, but XLA cannot know


class Part(NamedTuple):
    name: str  # with a dash before it: a part of the last one without
    make: Callable[[Trainer, Call], Any]
    times: int = 1  # per unroll
    adds: int = 0  # multiply-adds of one call
    first: Any = None  # the `last` of the first repetition; None: zeros


def make_inputs(trainer: Trainer, states: TrainState, points: MemberInputs) -> Inputs:
    """Copies of what the parts need of a run of one member: the run may continue, and donate its states."""
    one, member = jax.tree.map(lambda x: jnp.array(x[0]), (states, points))
    shards = trainer.config.shard_count
    keys = jax.random.split(jax.random.PRNGKey(0), shards)
    index = replay_buffer.sample(one.buffer, keys, REPEATS, trainer.config.batch_size // shards)
    return Inputs(
        one,
        member,
        index,
        augmentation.sample(keys, REPEATS, trainer.config.batch_size // shards),
        replay_buffer.gather(one.buffer, index[0]),
    )


def parts(trainer: Trainer, inputs: Inputs) -> list[Part]:
    return [*acting_parts(trainer, inputs), *minibatch_parts(trainer, inputs), *update_parts(trainer, inputs)]


def perturb(tree: Any, tiny: chex.Array) -> Any:
    return jax.tree.map(lambda x: x + tiny, tree)


def pass_adds(trainer: Trainer) -> tuple[int, int]:
    """Multiply-adds of one pass of the policy, and of the critic."""
    config, size = trainer.config, trainer.setup.spec.observation_size
    policy, critic = (
        [size, *config.policy_hidden_layer_sizes, trainer.setup.env.action_size],
        [size, *config.critic_hidden_layer_sizes, 1],
    )
    return layers(policy), layers(critic)


def layers(sizes: list[int]) -> int:
    return sum(a * b for a, b in itertools.pairwise(sizes))


# -- acting --------------------------------------------------------------------------------------------------


def acting_parts(trainer: Trainer, inputs: Inputs) -> list[Part]:
    adds = pass_adds(trainer)[0] * trainer.config.steps_per_unroll
    return [
        Part("acting", act, adds=adds, first=(inputs.state.lanes, inputs.state.buffer)),
        Part("– policy", act_policy, adds=adds),
        Part("– noise", draw_noise),
        Part("– physics, reward", step_physics),
        Part("– one draw of all lanes' starts", draw_starts),
    ]


def act(trainer: Trainer, call: Call) -> Any:
    lanes, buffer = call.last
    state, key = call.inputs.state, jax.random.fold_in(call.inputs.state.key, call.i)
    return collect(trainer.setup, call.inputs.member, state.learner, lanes, buffer, key, state.start_key)


def newest_unroll(inputs: Inputs) -> Any:
    """The newest unroll's observations and actions, [T, N, ...]."""
    newest: Any = replay_buffer.newest(inputs.state.buffer)
    return [jnp.swapaxes(x, 0, 1) for x in (newest.observation, newest.action)]


def act_policy(trainer: Trainer, call: Call) -> Any:
    spec, state = trainer.setup.spec, call.inputs.state.learner
    state = state._replace(params=perturb(state.params, call.tiny))
    acting = learner.with_scale_in_weights(spec, call.inputs.member.hyper, state)

    def step(_: None, observation: chex.Array) -> Any:
        return None, learner.act(spec, *acting, (), observation)[1]

    return jax.lax.scan(step, None, newest_unroll(call.inputs)[0])[1]


def draw_noise(trainer: Trainer, call: Call) -> Any:
    key = jax.random.fold_in(call.inputs.state.key, call.i)
    lanes, size = call.inputs.state.lanes.lane_id, trainer.setup.env.action_size
    return rollout.normal(key, lanes, trainer.config.unroll_length, size)


def step_physics(trainer: Trainer, call: Call) -> Any:
    def step(state: Any, action: chex.Array) -> Any:
        state = jax.vmap(trainer.setup.env.step)(state, jnp.clip(action, -1.0, 1.0))
        return state, (state.obs, state.reward, state.done)

    return jax.lax.scan(step, call.inputs.state.lanes.state, newest_unroll(call.inputs)[1] + call.tiny)


def draw_starts(trainer: Trainer, call: Call) -> Any:
    over, lanes = jnp.ones(trainer.config.num_envs, bool), call.inputs.state.lanes
    lanes = lanes._replace(done=over, next_state_used=over, reset_count=lanes.reset_count + call.i)
    steps = rollout.Steps(trainer.setup.env, lanes)
    return steps.restart(steps.pack(lanes), lanes_last(lanes.state), call.inputs.state.start_key)


# -- from an unroll to minibatches ---------------------------------------------------------------------------


def minibatch_parts(trainer: Trainer, inputs: Inputs) -> list[Part]:
    updates = trainer.config.updates_per_unroll
    return [
        Part("draws of minibatches and symmetries", sample),
        Part("replay buffer: gather", gather, updates),
        Part("symmetries", augment, updates),
    ]


def sample(trainer: Trainer, call: Call) -> Any:
    config, state = trainer.config, call.inputs.state
    shards = config.shard_count
    keys = jax.vmap(lambda shard: jax.random.fold_in(jax.random.fold_in(state.key, call.i), shard))(jnp.arange(shards))
    index = replay_buffer.sample(state.buffer, keys, config.updates_per_unroll, config.batch_size // shards)
    return index, augmentation.sample(keys, config.updates_per_unroll, config.batch_size // shards)


def gather(trainer: Trainer, call: Call) -> Any:
    return replay_buffer.gather(call.inputs.state.buffer, call.inputs.minibatches[call.i])


def augment(trainer: Trainer, call: Call) -> Any:
    after = augmentation.augment(trainer.setup.env, call.inputs.batch, call.inputs.symmetries[call.i])
    return after.observation + call.tiny, after.final_observation + call.tiny, after.action + call.tiny


# -- update --------------------------------------------------------------------------------------------------


def update_parts(trainer: Trainer, inputs: Inputs) -> list[Part]:
    config, spec, state = trainer.config, trainer.setup.spec, inputs.state.learner
    updates, size = config.updates_per_unroll, inputs.batch.reward.size
    policy, critic = pass_adds(trainer)
    # Backward: as much again for the weights, and for the inputs of all layers but the first.
    backward = 2 * (policy + critic) - spec.observation_size * (
        config.policy_hidden_layer_sizes[0] + config.critic_hidden_layer_sizes[0]
    )
    terms = jax.eval_shape(lambda *x: learner.update(spec, inputs.member.hyper, *x), state, inputs.batch)[1]
    no_terms = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), terms)
    step = [(p, o, jnp.float32(0.0)) for p, o in zip(state.params, state.optimizer, strict=True)]
    return [
        Part("update", update, updates, (policy + critic + backward) * size, first=(state, no_terms)),
        Part("– policy forward", policy_forward, updates, policy * size),
        Part("– critic forward", critic_forward, updates, critic * size),
        Part("– V-trace", v_trace, updates),
        Part("– clip and Adam", apply_gradient, updates, first=step),
    ]


def update(trainer: Trainer, call: Call) -> Any:
    batch = perturb(call.inputs.batch, call.tiny)
    return learner.update(trainer.setup.spec, call.inputs.member.hyper, call.last[0], batch)


def policy_forward(trainer: Trainer, call: Call) -> Any:
    return trainer.setup.spec.policy.apply(call.inputs.state.learner.params.policy, scaled(trainer, call))


def critic_forward(trainer: Trainer, call: Call) -> Any:
    return trainer.setup.spec.critic.apply(call.inputs.state.learner.params.critic, scaled(trainer, call))


def scaled(trainer: Trainer, call: Call) -> chex.Array:
    """The minibatch's observations as the networks see them, [B·T, F]."""
    flat = call.inputs.batch.observation.reshape(-1, call.inputs.batch.observation.shape[-1])
    return learner.preprocess(trainer.setup.spec, call.inputs.member.hyper, call.inputs.state.learner, flat) + call.tiny


def v_trace(trainer: Trainer, call: Call) -> Any:
    hyper, batch = call.inputs.member.hyper, call.inputs.batch
    clips = {name: getattr(hyper, name) for name in ("gamma", "lam", "rho_bar", "c_bar")}
    value, rho = batch.log_mu + call.tiny, jnp.exp(batch.log_mu + call.tiny)
    trajectories = batch.reward, value, value + 1.0, batch.terminated, batch.truncated, rho
    return jax.vmap(lambda *x: vtrace(*x, **clips))(*trajectories)


def apply_gradient(trainer: Trainer, call: Call) -> Any:
    hyper, rate = call.inputs.member.hyper, jnp.float32(1e-6)
    gradient: Networks = perturb(call.inputs.state.learner.params, call.tiny)
    pairs = zip(call.last, gradient, strict=True)
    return [learner.apply_gradient(hyper, params, g, optimizer, rate) for (params, optimizer, _), g in pairs]

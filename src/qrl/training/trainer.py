"""The train loop: rollout -> replay buffer -> updates, then APG; a report interval is one compiled program.

`train_step` and `apg_step` are pure functions of one member's state. `make_trainer` maps them over members and devices
and compiles them.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from qrl.algorithm import analytic_gradient, augmentation, flights, learner, replay_buffer, rollout
from qrl.algorithm.adapter import adapt
from qrl.algorithm.flights import Flights
from qrl.algorithm.learner import LearnerSpec, LearnerState, UpdateMetrics
from qrl.algorithm.replay_buffer import ReplayBuffer
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import Env, TaskEnv, Transition
from qrl.config import Config
from qrl.training import sharding
from qrl.training.sharding import LAYOUT, MEMBER, SHARD
from qrl.training.state import FAULT_TERMS, MemberInputs, Totals, TrainState

MANY_LANES = 256  # from which acting takes a good part of a CPU's time
DONATED = {"train": 0, "apg": 0}  # by program, the argument that it may overwrite
MAX_SKIPPED_IN_A_ROW = 20  # APG updates whose gradient is not finite, after which a run stops


class Setup(NamedTuple):
    """What shapes the programs of a run."""

    env: TaskEnv
    config: Config
    mesh: Mesh | None = None

    @property
    def spec(self) -> LearnerSpec:
        axis = SHARD if self.mesh else None
        return LearnerSpec(
            self.config,
            int(self.env.observation_size),
            self.env.action_size,
            axis,
            self.env.policy_observation_size,
            self.env.policy_view,
        )

    @property
    def max_episode_steps(self) -> int:
        return self.config.episode_length or self.env.episode_steps

    def env_of(self, inputs: MemberInputs) -> TaskEnv:
        return adapt(self.env.with_params(inputs.env_params))


def init_state(setup: Setup, seed: chex.Array, inputs: MemberInputs) -> TrainState:
    """The first state of a member; int32 [] seed."""
    config, hyper = setup.config, inputs.hyper
    learner_key, start_key, key = jax.random.split(jax.random.PRNGKey(seed), 3)
    lane_ids = sharding.local_indices(setup.mesh, config.num_envs)
    lanes = rollout.init(
        setup.env_of(inputs),
        start_key,
        lane_ids,
        config.num_envs,
        setup.max_episode_steps,
        config.unroll_length,
        learner.initial_memory(setup.spec, len(lane_ids)),
    )
    first = learner.init(setup.spec, hyper, learner_key)
    transitions = rollout.transitions_of(lanes, setup.env.action_size, config.unroll_length)
    buffer = replay_buffer.create(transitions, config.replay_unrolls)
    zero = jnp.float32(0.0)
    metrics = UpdateMetrics(*[zero] * len(UpdateMetrics._fields))
    totals = Totals(rewards=zero, steps=zero, episodes=zero, early=zero, updates=zero, skipped=zero, metrics=metrics)
    state = TrainState(
        learner=first,
        buffer=buffer,
        lanes=lanes,
        key=key,
        start_key=start_key,
        unrolls=jnp.int32(0),
        learning_unrolls=jnp.int32(config.learning_unrolls),
        skipped_in_a_row=jnp.int32(0),
        fault_update=jnp.int32(-1),
        fault_term=jnp.int32(-1),
        totals=totals,
    )
    # Explicit types, not weak ones: a restored state has no others, and would need a program of its own.
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)


def collect(
    setup: Setup,
    inputs: MemberInputs,
    state: LearnerState,
    lanes: Lanes,
    buffer: ReplayBuffer,
    noise_key: chex.PRNGKey,
    start_key: chex.PRNGKey,
) -> tuple[Lanes, ReplayBuffer]:
    spec = setup.spec
    acting = learner.with_scale_in_weights(spec, inputs.hyper, state)
    return rollout.unroll(
        setup.env_of(inputs),
        lanes,
        buffer,
        partial(learner.act, spec, *acting),
        learner.sigma(inputs.hyper, state),
        noise_key,
        start_key,
        max_episode_steps=setup.max_episode_steps,
    )


def train_step(setup: Setup, inputs: MemberInputs, state: TrainState) -> TrainState:
    """One unroll of all lanes into the replay buffer, and the updates that follow it (Algorithm 2)."""
    noise_key, sample_key = jax.random.split(jax.random.fold_in(state.key, state.unrolls))
    lanes, buffer = collect(setup, inputs, state.learner, state.lanes, state.buffer, noise_key, state.start_key)
    transitions = replay_buffer.newest(buffer)
    observed = learner.update_statistics(setup.spec, state.learner, transitions.observation, transitions.reward)
    learned, metrics = jax.lax.cond(
        state.unrolls + 1 >= setup.config.warmup_unrolls,
        lambda now: _updates(setup, inputs, now, buffer, sample_key),
        lambda now: (now, jnp.zeros((setup.config.updates_per_unroll, len(UpdateMetrics._fields)))),
        observed,
    )
    sums = _sums(setup, transitions, lanes.num_early - state.lanes.num_early)
    fault_update, fault_term = _first_fault(sums[3:] == 0, metrics, observed.updates)
    is_first = (state.fault_update < 0) & (fault_update >= 0)
    added = Totals(
        rewards=sums[0],
        steps=jnp.float32(setup.config.steps_per_unroll),
        episodes=sums[1],
        early=sums[2],
        updates=(learned.updates - observed.updates).astype(jnp.float32),
        skipped=jnp.float32(0.0),
        metrics=UpdateMetrics(*jnp.sum(metrics, axis=0)),
    )
    return state._replace(
        learner=learned,
        buffer=buffer,
        lanes=lanes,
        unrolls=state.unrolls + 1,
        fault_update=jnp.where(is_first, fault_update, state.fault_update),
        fault_term=jnp.where(is_first, fault_term, state.fault_term),
        totals=jax.tree.map(jnp.add, state.totals, added),
    )


def _updates(
    setup: Setup, inputs: MemberInputs, state: LearnerState, buffer: ReplayBuffer, key: chex.PRNGKey
) -> tuple[LearnerState, chex.Array]:
    """The updates of one unroll on augmented minibatches, and their metrics [updates, len(UpdateMetrics)]."""
    config, env = setup.config, setup.env_of(inputs)

    targets: Any = None  # or, of all trajectories in the buffer, those that stay fixed during the updates
    if config.sampling == "epochs":
        lanes = jax.tree.map(lambda x: x[0], buffer.data)  # of the only slot
        targets = learner.targets_of(setup.spec, inputs.hyper, state, lanes)

    def one(now: LearnerState, sample: tuple[chex.Array, chex.Array]) -> tuple[LearnerState, chex.Array]:
        index, draws = sample
        batch = replay_buffer.gather(buffer, index)
        if config.symmetries:
            batch = augmentation.augment(env, batch, draws)
        fixed = jax.tree.map(lambda x: x[index], targets)
        now, metrics = learner.update(setup.spec, inputs.hyper, now, batch, fixed)
        return now, jnp.stack(metrics)

    shard_ids = sharding.local_indices(setup.mesh, config.shard_count)
    keys = jax.vmap(lambda shard: jax.random.split(jax.random.fold_in(key, shard)))(shard_ids)
    each = config.batch_size // config.shard_count
    draw = replay_buffer.epochs if config.sampling == "epochs" else replay_buffer.sample
    index = draw(buffer, keys[:, 0], config.updates_per_unroll, each)
    return jax.lax.scan(one, state, (index, augmentation.sample(keys[:, 1], config.updates_per_unroll, each)))


def _sums(setup: Setup, transitions: Transition, early: chex.Array) -> chex.Array:
    """Over all lanes: rewards, ends, early ends, and places where rewards and observations are not finite; [5]."""
    values = [
        jnp.sum(transitions.reward),
        jnp.sum(transitions.terminated + transitions.truncated),
        jnp.sum(early).astype(jnp.float32),
        _not_finite(transitions.reward),
        _not_finite(transitions.observation) + _not_finite(transitions.final_observation),
    ]
    return sharding.sum_over_shards(setup.mesh, jnp.stack(values))


def _not_finite(x: chex.Array) -> chex.Array:
    """0 if all of x [N, T, ...] is finite; []. Sums of numbers are faster than of tests; 0 times any other is NaN."""
    return jnp.sum(~jnp.isfinite(jnp.sum(0.0 * x, axis=0))).astype(jnp.float32)


def _first_fault(collected: chex.Array, metrics: chex.Array, updates: chex.Array) -> tuple[chex.Array, chex.Array]:
    """(update, index into FAULT_TERMS) of the first number that is not finite; (−1, −1) if all are.

    `collected` [2]: whether all rewards and observations of the unroll are finite; `metrics`: each update's."""
    finite = jnp.concatenate([jnp.tile(collected, (len(metrics), 1)), jnp.isfinite(metrics)], axis=1)
    first = jnp.argmin(finite.reshape(-1))
    update, term = first // finite.shape[1], first % finite.shape[1]
    ok = jnp.all(finite)
    return jnp.where(ok, -1, updates + update), jnp.where(ok, -1, term)


def apg_step(setup: Setup, inputs: MemberInputs, step: chex.Array, state: TrainState, parts: int = 1) -> TrainState:
    """APG update number `step` (int32 []), or in its place so many `parts`, updates of flights as many times shorter;
    the counter of unrolls is left to the caller.
    """
    config = setup.config
    updates = (config.num_unrolls - state.learning_unrolls) // config.unrolls_per_apg_update
    key = jax.random.fold_in(state.key, state.learning_unrolls + step)
    if parts == 1:
        return _apg_update(setup, inputs, key, step / jnp.maximum(1, updates), config.apg_episode_length, state)

    def part(i: chex.Array, state: TrainState) -> TrainState:
        progress = (step + i / parts) / jnp.maximum(1, updates)
        length = config.apg_episode_length // parts
        return _apg_update(setup, inputs, jax.random.fold_in(key, i), progress, length, state)

    return jax.lax.fori_loop(0, parts, part, state)


def split_apg_updates(config: Config, learning_unrolls: chex.Array) -> chex.Array:
    """How many APG updates are split, the first ones; int32 []."""
    updates = (config.num_unrolls - learning_unrolls) // config.unrolls_per_apg_update
    return jnp.ceil(updates * config.apg_split_fraction).astype(jnp.int32)


def _apg_update(
    setup: Setup, inputs: MemberInputs, key: chex.PRNGKey, progress: chex.Array, length: int, state: TrainState
) -> TrainState:
    """One APG update on flights of `length` steps, drawn with `key`."""
    config, spec, env = setup.config, setup.spec, setup.env_of(inputs)
    lanes = sharding.local_indices(setup.mesh, config.apg_num_envs)
    keys = jax.vmap(lambda lane: jax.random.fold_in(key, lane))(lanes)

    def returns_of(now: LearnerState) -> tuple[chex.Array, chex.Array]:
        noise = learner.sigma(inputs.hyper, now) * analytic_gradient.decay(progress)
        act, memory = partial(learner.act, spec, inputs.hyper, now), learner.initial_memory(spec, len(keys))
        return analytic_gradient.returns(env, act, memory, noise, keys, length, inputs.hyper.apg_cotangent_norm)

    now, metrics, (rewards, complete), skipped = analytic_gradient.update(
        spec, inputs.hyper, state.learner, returns_of, progress
    )
    added = Totals(
        rewards=rewards,
        steps=jnp.float32(config.apg_num_envs * length),
        episodes=jnp.float32(config.apg_num_envs),
        early=config.apg_num_envs - complete,
        updates=jnp.float32(1.0),
        skipped=skipped.astype(jnp.float32),
        metrics=metrics,
    )
    in_a_row = jnp.where(skipped, state.skipped_in_a_row + 1, 0)
    bad_reward = ~jnp.isfinite(metrics.policy_loss)
    fault = (bad_reward | (in_a_row >= MAX_SKIPPED_IN_A_ROW)) & (state.fault_update < 0)
    term = jnp.where(bad_reward, FAULT_TERMS.index("reward"), FAULT_TERMS.index("policy_gradient"))
    return state._replace(
        learner=now,
        skipped_in_a_row=in_a_row,
        fault_update=jnp.where(fault, state.learner.updates, state.fault_update),
        fault_term=jnp.where(fault, term, state.fault_term),
        totals=jax.tree.map(jnp.add, state.totals, added),
    )


def fly(setup: Setup, state: LearnerState, inputs: MemberInputs, keys: chex.PRNGKey) -> Flights:
    """Flights of a member's deployed policy, one for each of `keys`."""
    spec, now = setup.spec, learner.deployed(setup.spec, state)
    act, memory = partial(learner.act, spec, inputs.hyper, now), learner.initial_memory(spec, len(keys))
    return flights.fly_with_memory(setup.env_of(inputs), act, memory, keys, setup.max_episode_steps)


class Trainer(NamedTuple):
    """The jitted programs of a run, over M members; `train` and `apg` donate the states.

    init   (seeds [M], inputs [M])         -> states [M]
    train  (states [M], inputs [M], until) -> states [M] after `until` unrolls; members in their APG phase stay
    apg    (states [M], inputs [M], until) -> states [M] after `until` unrolls; members still learning stay
    fly    (learners [M], inputs [M], keys) -> Flights [M]

    No member's phase may change between where it is and `until`.
    """

    setup: Setup
    init: Any
    train: Any
    apg: Any
    fly: Any
    effort: Callable[[str], dict[str, Any]]  # compiler options of a program, by its name
    gather: Callable[[Any], Any]  # values of the programs -> NumPy, from all devices and processes
    members: Callable[[TrainState], Iterator[TrainState]]  # the state of one after the other in NumPy, copies

    @property
    def config(self) -> Config:
        return self.setup.config


def _init_members(setup: Setup, seeds: chex.Array, inputs: MemberInputs) -> TrainState:
    return sharding.map_members(lambda m: init_state(setup, *m), (seeds, inputs))


def _train_members(setup: Setup, states: TrainState, inputs: MemberInputs, until: chex.Array) -> TrainState:
    def one(state: TrainState, inputs: MemberInputs, until: chex.Array) -> TrainState:
        return jax.lax.fori_loop(state.unrolls, until, lambda _, now: train_step(setup, inputs, now), state)

    return sharding.map_states(one, states, inputs, until, states.unrolls < states.learning_unrolls)


def _apg_members(setup: Setup, states: TrainState, inputs: MemberInputs, until: chex.Array) -> TrainState:
    config = setup.config

    def one(state: TrainState, inputs: MemberInputs, until: chex.Array) -> TrainState:
        first = (state.unrolls - state.learning_unrolls) // config.unrolls_per_apg_update
        count = (until - state.unrolls) // config.unrolls_per_apg_update
        split = jnp.int32(0)
        if config.apg_split > 1 and config.apg_split_fraction:  # two loops: a condition would run both under vmap
            split = jnp.clip(split_apg_updates(config, state.learning_unrolls) - first, 0, count)
            parts = lambda i, now: apg_step(setup, inputs, first + i, now, config.apg_split)  # noqa: E731
            state = jax.lax.fori_loop(0, split, parts, state)
        step = lambda i, now: apg_step(setup, inputs, first + i, now)  # noqa: E731
        return jax.lax.fori_loop(split, count, step, state)._replace(unrolls=until)

    # Not a member that has just been brought to `until`, where its APG begins.
    active = (states.unrolls >= states.learning_unrolls) & (states.unrolls < until)
    return sharding.map_states(one, states, inputs, until, active)


def _fly_members(setup: Setup, learners: LearnerState, inputs: MemberInputs, keys: chex.PRNGKey) -> Flights:
    return sharding.map_members(lambda m: fly(setup, m[0], m[1], keys), (learners, inputs))


def _fly_padded(setup: Setup, learners: LearnerState, inputs: MemberInputs, keys: chex.PRNGKey) -> Flights:
    """Every device flies as many starts: a few are flown twice, and dropped."""
    count, devices = len(keys), sharding.num_shard_devices(setup.mesh)
    padded = jnp.resize(keys, (-(-count // devices) * devices, *keys.shape[1:]))
    specs = (P(MEMBER), P(MEMBER), P(SHARD)), P(MEMBER, SHARD)
    program = sharding.shard_map(setup.mesh, partial(_fly_members, setup), *specs)
    return jax.tree.map(lambda x: x[:, :count], program(learners, inputs, padded))


def make_trainer(env: Env, config: Config, mesh: Mesh | None = None) -> Trainer:
    """The programs of an environment and a configuration, on one device or over a mesh whose member axis divides M."""
    setup = Setup(adapt(env), config, mesh)

    def over_mesh(program: Callable[..., Any], in_specs: Any) -> Callable[..., Any]:
        return sharding.shard_map(mesh, partial(program, setup), in_specs, LAYOUT)

    everywhere = sharding.replicated(mesh)
    replicate = jax.jit(lambda tree: tree, out_shardings=everywhere)
    one_member = jax.jit(lambda states, i: jax.tree.map(lambda x: x[i], states), out_shardings=everywhere)
    steps = (LAYOUT, P(MEMBER), P())

    def effort(name: str) -> dict[str, Any]:
        # `init` runs once.
        return xla_effort(0 if name == "init" else 1, config.num_envs if name == "train" else 0)

    def gather(tree: Any) -> Any:
        if not all(x.is_fully_addressable for x in jax.tree.leaves(tree)):
            return jax.tree.map(np.asarray, replicate(tree))
        return jax.tree.map(np.array, tree)  # a live view of a device array would cancel its donation

    def members(states: TrainState) -> Iterator[TrainState]:
        count = len(states.unrolls)
        if not states.unrolls.is_fully_addressable:  # one at a time: all of a member is brought to every process
            yield from (jax.tree.map(np.asarray, one_member(states, i)) for i in range(count))
            return
        copy = gather(states)
        yield from (jax.tree.map(lambda x, i=i: x[i], copy) for i in range(count))

    def jitted(name: str, program: Callable[..., Any]) -> Any:
        def named(*args: Any) -> Any:
            return program(*args)

        named.__name__ = name  # in compile caches and profiles
        return jax.jit(named, donate_argnums=DONATED.get(name, ()), compiler_options=effort(name))

    return Trainer(
        setup,
        init=jitted("init", over_mesh(_init_members, (P(MEMBER), P(MEMBER)))),
        train=jitted("train", over_mesh(_train_members, steps)),
        apg=jitted("apg", over_mesh(_apg_members, steps)),
        fly=jitted("fly", partial(_fly_padded, setup)),
        effort=effort,
        gather=gather,
        members=members,
    )


def xla_effort(level: int, lanes: int = 0) -> dict[str, Any]:
    """Compiler options for an XLA optimization level on a CPU, where 1 compiles in two thirds of the default's time.

    With XLA's newer emitters of fused loops compiling takes twice as long and a step of many `lanes` four fifths; an
    update no less, and the gradient of a flight more (docs/profile.md).
    """
    if jax.default_backend() != "cpu" or jax.config.read("jax_disable_most_optimizations"):
        return {}
    return {"xla_backend_optimization_level": level, "xla_cpu_use_fusion_emitters": lanes >= MANY_LANES}

"""The train loop: rollout -> ring -> updates, a whole report interval in one compiled program.

Every value carries a leading member axis (one seed or grid point each). On a CPU members run one after the
other inside the program (`lax.map`), which is faster there than batching small networks; elsewhere `vmap`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from brax.envs.base import Env

from qrl import buffer, evaluate, rollout
from qrl.buffer import Ring
from qrl.config import Config
from qrl.learner import Learner, LearnerState, Terms
from qrl.rollout import Lanes
from qrl.types import Transition

FAULT_TERMS = ("reward", "observation", *Terms._fields)


class Totals(NamedTuple):
    """Sums since the last report; scalars."""

    rewards: chex.Array
    steps: chex.Array
    episodes: chex.Array  # that ended
    early: chex.Array  # of these, before their last step (fled, tumbled, or terminated)
    updates: chex.Array
    terms: Terms


class TrainState(NamedTuple):
    """Everything a run needs to go on: what a checkpoint holds."""

    learner: LearnerState
    ring: Ring
    lanes: Lanes
    key: chex.PRNGKey
    unrolls: chex.Array  # int32 []
    fault_update: chex.Array  # int32 []: the update in which a number was first not finite; −1: none
    fault_term: chex.Array  # int32 []: which (FAULT_TERMS)
    totals: Totals  # since the last report; whoever reports sets them to zero


class Trainer:
    """The compiled programs of one environment and configuration."""

    def __init__(self, env: Env, config: Config) -> None:
        self.env = env
        self.config = config
        self.longest = rollout.episode_steps(env, config.episode_steps)
        self.learner = Learner(config, int(env.observation_size), env.action_size)  # pyright: ignore[reportArgumentType]
        # Run once, so compiled in haste: a third of the time.
        haste = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}
        self.init = jax.jit(lambda seeds: _over_members(self._init, seeds), compiler_options=haste)
        self.advance = jax.jit(
            lambda states, until: _over_members(lambda state: self._advance(state, until), states), donate_argnums=0
        )
        self.fly = jax.jit(lambda learners, keys: _over_members(lambda learner: self._fly(learner, keys), learners))

    def _init(self, seed: chex.Array) -> TrainState:
        learner_key, lanes_key, key = jax.random.split(jax.random.PRNGKey(seed), 3)
        lanes = rollout.begin(self.env, lanes_key, self.config.lanes, self.longest, self.config.unroll_steps)
        learner = self.learner.init(learner_key)
        _, transitions = jax.eval_shape(self._collect, learner, lanes, key)
        ring = buffer.create(transitions, self.config.ring_unrolls)
        zero = jnp.float32(0.0)
        totals = Totals(zero, zero, zero, zero, zero, Terms(*[zero] * len(Terms._fields)))
        return TrainState(learner, ring, lanes, key, jnp.int32(0), jnp.int32(-1), jnp.int32(-1), totals)

    def _collect(self, learner: LearnerState, lanes: Lanes, key: chex.PRNGKey) -> tuple[Lanes, Transition]:
        return rollout.unroll(
            self.env,
            lanes,
            lambda observation: self.learner.mean(learner, observation),
            self.learner.sigma(learner),
            key,
            unroll_steps=self.config.unroll_steps,
            longest=self.longest,
        )

    def _advance(self, state: TrainState, until: chex.Array) -> TrainState:
        """Go on until `until` unrolls have been made; where it pauses on the way changes nothing."""
        return jax.lax.fori_loop(state.unrolls, until, lambda _, state: self._unroll_and_learn(state), state)

    def _unroll_and_learn(self, state: TrainState) -> TrainState:
        collect_key, learn_key = jax.random.split(jax.random.fold_in(state.key, state.unrolls))
        lanes, transitions = self._collect(state.learner, state.lanes, collect_key)
        learner = self.learner.observe(state.learner, transitions.observation)
        ring = buffer.add(state.ring, transitions)

        def update(learner: LearnerState, index: chex.Array) -> tuple[LearnerState, Terms]:
            return self.learner.update(learner, buffer.gather(ring, index))

        def learn(learner: LearnerState) -> tuple[LearnerState, Terms]:
            minibatches = (self.config.updates_per_unroll, self.config.minibatch_lanes)
            return jax.lax.scan(update, learner, buffer.draw(ring, learn_key, minibatches))

        def wait(learner: LearnerState) -> tuple[LearnerState, Terms]:
            zeros = jnp.zeros(self.config.updates_per_unroll)
            return learner, Terms(*[zeros] * len(Terms._fields))

        warm = state.unrolls + 1 >= self.config.warmup_unrolls
        learned, terms = jax.lax.cond(warm, learn, wait, learner)
        fault_update, fault_term = self._fault(transitions, terms, learner.updates)
        fresh = (state.fault_update < 0) & (fault_update >= 0)
        seen = Totals(
            rewards=jnp.sum(transitions.reward),
            steps=jnp.float32(self.config.unroll_size),
            episodes=jnp.sum(transitions.terminated + transitions.truncated),
            early=jnp.sum(lanes.early - state.lanes.early).astype(jnp.float32),
            updates=(learned.updates - learner.updates).astype(jnp.float32),
            terms=jax.tree.map(jnp.sum, terms),
        )
        return TrainState(
            learner=learned,
            ring=ring,
            lanes=lanes,
            key=state.key,
            unrolls=state.unrolls + 1,
            fault_update=jnp.where(fresh, fault_update, state.fault_update),
            fault_term=jnp.where(fresh, fault_term, state.fault_term),
            totals=jax.tree.map(jnp.add, state.totals, seen),
        )

    def _fault(self, seen: Transition, terms: Terms, updates: chex.Array) -> tuple[chex.Array, chex.Array]:
        """(update, index into FAULT_TERMS) of the first number that is not finite; (−1, −1) if all are."""
        collected = jnp.stack([jnp.all(jnp.isfinite(x)) for x in (seen.reward, seen.next_observation)])
        finite = jnp.concatenate(
            [jnp.tile(collected, (self.config.updates_per_unroll, 1)), jnp.isfinite(jnp.stack(terms, axis=1))], axis=1
        )
        first = jnp.argmin(finite.reshape(-1))
        update, term = first // finite.shape[1], first % finite.shape[1]
        ok = jnp.all(finite)
        return jnp.where(ok, -1, updates + update), jnp.where(ok, -1, term)

    def _fly(self, learner: LearnerState, keys: chex.PRNGKey) -> evaluate.Flights:
        shipped = self.learner.shipped(learner)
        return evaluate.fly(self.env, lambda observation: self.learner.mean(shipped, observation), keys, self.longest)


def _over_members(one: Callable[[Any], Any], members: Any) -> Any:
    return jax.lax.map(one, members) if jax.default_backend() == "cpu" else jax.vmap(one)(members)

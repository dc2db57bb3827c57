"""The train loop: rollout -> ring -> updates, a whole report interval in one compiled program.

Every value carries a leading member axis (one seed or grid point each). On a CPU members run one after the
other inside the program (`lax.map`), which is faster there than batching small networks; elsewhere `vmap`.

Over several devices (`state.spread`) members part first, and then each member's lanes, with their part of ring and
minibatch.
"""

import functools
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from qrl.algorithm import analytic_gradient, flights, replay_buffer, rollout
from qrl.algorithm.learner import Learner, LearnerState, Terms
from qrl.algorithm.replay_buffer import Ring
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import Env, Transition
from qrl.config import Config
from qrl.training.sharding import LAYOUT, MEMBER, SHARD
from qrl.training.state import FAULT_TERMS, Point, Totals, TrainState


class Trainer:
    """The compiled programs of one environment and configuration, for any values of what a `Point` holds.

    init     (seeds [M], points [M])          -> states [M]
    advance  (states [M], points [M], until)  -> states [M]; donates the states; `until` config.learning_unrolls
    climb    (states [M], points [M], until)  -> states [M]; donates the states; from there on
    fly      (learners [M], points [M], keys) -> Flights [M]

    On one device, or over those of a `mesh` (`state.spread`), whose member axis divides M.
    """

    def __init__(self, env: Env, config: Config, mesh: Mesh | None = None) -> None:
        self.env = env
        self.config = config
        self.mesh = mesh
        self.longest = rollout.episode_steps(env, config.episode_length)
        sizes = int(env.observation_size), env.action_size  # pyright: ignore[reportArgumentType]
        self.learner = Learner(config, *sizes, SHARD if mesh else None)
        init = self._over_mesh(self._init_all, (P(MEMBER), P(MEMBER)), LAYOUT)
        advance, climb = (
            self._over_mesh(every, (LAYOUT, P(MEMBER), P()), LAYOUT) for every in (self._advance_all, self._climb_all)
        )
        self.init = jax.jit(init, compiler_options=xla_effort(0))  # it runs once
        self.advance = jax.jit(advance, donate_argnums=0, compiler_options=xla_effort(1))
        self.climb = jax.jit(climb, donate_argnums=0, compiler_options=xla_effort(1))
        self.fly = jax.jit(self._fly_evenly, compiler_options=xla_effort(1))
        everywhere = NamedSharding(mesh, P()) if mesh else None
        self._everywhere = jax.jit(lambda tree: tree, out_shardings=everywhere)
        self._member = jax.jit(lambda states, i: jax.tree.map(lambda x: x[i], states), out_shardings=everywhere)

    def place(self, states: TrainState) -> TrainState:
        """States in NumPy put where the programs want them."""
        if not (mesh := self.mesh):
            return jax.tree.map(jnp.array, states)

        def put(spec: P, part: Any) -> Any:
            where = NamedSharding(mesh, spec)
            return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, where, np.asarray(x).__getitem__), part)

        return jax.tree.map(put, LAYOUT, states, is_leaf=lambda x: isinstance(x, P))

    def laid_out(self, states: TrainState) -> TrainState:
        """Shapes and types of states, with where `place` would put them."""
        if not (mesh := self.mesh):
            return states

        def lay(spec: P, part: Any) -> Any:
            where = NamedSharding(mesh, spec)
            return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), part)

        return jax.tree.map(lay, LAYOUT, states, is_leaf=lambda x: isinstance(x, P))

    def on_host(self, tree: Any) -> Any:
        """Values of the programs in NumPy, wherever their parts are."""
        return jax.tree.map(np.asarray, self._everywhere(tree) if self.mesh else tree)

    def member(self, states: TrainState, index: int) -> TrainState:
        """One member's state in NumPy: a copy, for a live view of a device array would cancel its donation."""
        return jax.tree.map(np.asarray, self._member(states, index))

    def _over_mesh(self, program: Callable[..., Any], specs: Any, out_specs: Any) -> Callable[..., Any]:
        if not self.mesh:
            return program
        # Unchecked: gradients are averaged by hand, all in one exchange.
        return jax.shard_map(program, mesh=self.mesh, in_specs=specs, out_specs=out_specs, check_vma=False)

    @property
    def _parts(self) -> int:
        """How many devices share a member's lanes."""
        return self.mesh.shape[SHARD] if self.mesh else 1

    def _share(self, count: int) -> chex.Array:
        """This device's of `count` consecutive numbers."""
        mine = count // self._parts
        first = jax.lax.axis_index(SHARD) * mine if self.mesh else 0
        return first + jnp.arange(mine, dtype=jnp.int32)

    def _sum(self, values: Any) -> Any:
        return jax.lax.psum(values, SHARD) if self.mesh else values

    def _init_all(self, seeds: chex.Array, points: Point) -> TrainState:
        return _over_members(lambda m: self._init(m[0], m[1]), (seeds, points))

    def _advance_all(self, states: TrainState, points: Point, until: chex.Array) -> TrainState:
        return self._go_on(self._advance, states, points, until)

    def _climb_all(self, states: TrainState, points: Point, until: chex.Array) -> TrainState:
        return self._go_on(self._climb, states, points, until)

    def _go_on(
        self,
        one: Callable[[TrainState, Point, chex.Array], TrainState],
        states: TrainState,
        points: Point,
        until: chex.Array,
    ) -> TrainState:
        if _in_turn(len(states.unrolls)):
            return _over_members(lambda m: one(m[0], m[1], until), (states, points))
        # All members are equally far, and their counters stay without a member axis: batched, they would turn every
        # insert into the ring into a scatter, and the loop into a selection over the whole state.
        axes: Any = TrainState(*[0] * len(TrainState._fields))._replace(ring=Ring(0, None), unrolls=None)  # pyright: ignore[reportArgumentType]
        members = states._replace(
            unrolls=states.unrolls[0], ring=states.ring._replace(inserted=states.ring.inserted[0])
        )
        after = jax.vmap(one, in_axes=(axes, 0, None), out_axes=axes)(members, points, until)
        count = states.unrolls.shape
        ring = after.ring._replace(inserted=jnp.broadcast_to(after.ring.inserted, count))
        return after._replace(unrolls=jnp.broadcast_to(after.unrolls, count), ring=ring)

    def _fly_evenly(self, learners: LearnerState, points: Point, keys: chex.PRNGKey) -> flights.Flights:
        """Every device flies as many starts: a few are flown twice, and dropped."""
        count = len(keys)
        even = jnp.resize(keys, (-(-count // self._parts) * self._parts, *keys.shape[1:]))
        fly = self._over_mesh(self._fly_all, (P(MEMBER), P(MEMBER), P(SHARD)), P(MEMBER, SHARD))
        return jax.tree.map(lambda x: x[:, :count], fly(learners, points, even))

    def _fly_all(self, learners: LearnerState, points: Point, keys: chex.PRNGKey) -> flights.Flights:
        return _over_members(lambda m: self._fly(m[0], m[1], keys), (learners, points))

    def _under(self, point: Point) -> tuple[Learner, Env]:
        under = getattr(self.env, "under", lambda _: self.env)
        return self.learner.under(point.hyper), under(point.world)

    def _init(self, seed: chex.Array, point: Point) -> TrainState:
        learner, env = self._under(point)
        learner_key, starts, key = jax.random.split(jax.random.PRNGKey(seed), 3)
        count = self.config.num_envs
        lanes = rollout.begin(env, starts, self._share(count), count, self.longest, self.config.unroll_length)
        first = learner.init(learner_key)
        _, transitions = jax.eval_shape(lambda *now: self._collect(learner, *now), first, lanes, key, starts)
        ring = replay_buffer.create(transitions, self.config.replay_unrolls)
        zero = jnp.float32(0.0)
        totals = Totals(zero, zero, zero, zero, zero, Terms(*[zero] * len(Terms._fields)))
        state = TrainState(first, ring, lanes, key, starts, jnp.int32(0), jnp.int32(-1), jnp.int32(-1), totals)
        # Types that are said, not weak: a restored state has no others, and would have a program of its own.
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)

    def _collect(
        self, learner: Learner, state: LearnerState, lanes: Lanes, key: chex.PRNGKey, starts: chex.PRNGKey
    ) -> tuple[Lanes, Transition]:
        return rollout.unroll(
            self.env,  # of any parameters: each lane carries its own
            lanes,
            lambda observation: learner.mean(state, observation),
            learner.sigma(state),
            key,
            starts,
            unroll_length=self.config.unroll_length,
            longest=self.longest,
        )

    def _advance(self, state: TrainState, point: Point, until: chex.Array) -> TrainState:
        """Go on until `until` unrolls have been made; where it pauses on the way changes nothing."""
        learner, env = self._under(point)
        step = functools.partial(self._unroll_and_learn, learner, env)
        return jax.lax.fori_loop(state.unrolls, until, lambda _, state: step(state), state)

    def _climb(self, state: TrainState, point: Point, until: chex.Array) -> TrainState:
        """Go on until `until` unrolls by the analytic gradient; an update stands for as many as its flights take."""
        config, (learner, env) = self.config, self._under(point)
        lanes = self._share(config.apg_num_envs)

        def climbed(unrolls: chex.Array) -> chex.Array:
            return (unrolls - config.learning_unrolls) // config.unrolls_per_apg_update

        def climb(i: chex.Array, state: TrainState) -> TrainState:
            key = jax.random.fold_in(state.key, config.learning_unrolls + i)
            keys = jax.vmap(lambda lane: jax.random.fold_in(key, lane))(lanes)

            def flown(now: LearnerState) -> tuple[chex.Array, chex.Array]:
                noise = learner.sigma(now) * learner.left(i)
                return analytic_gradient.returns(
                    env, lambda o: learner.mean(now, o), noise, keys, config.apg_episode_length
                )

            now, terms, (rewards, whole) = learner.climb(state.learner, flown, i)
            seen = Totals(
                rewards=rewards,
                steps=whole * config.apg_episode_length,
                episodes=jnp.float32(config.apg_num_envs),
                early=config.apg_num_envs - whole,
                updates=jnp.float32(1.0),
                terms=terms,
            )
            fault = ~jnp.isfinite(terms.policy_loss) & (state.fault_update < 0)
            return state._replace(
                learner=now,
                fault_update=jnp.where(fault, state.learner.updates, state.fault_update),
                fault_term=jnp.where(fault, FAULT_TERMS.index("reward"), state.fault_term),
                totals=jax.tree.map(jnp.add, state.totals, seen),
            )

        state = jax.lax.fori_loop(climbed(state.unrolls), climbed(until), climb, state)
        return state._replace(unrolls=until)

    def _turns(self, keys: chex.PRNGKey, index: chex.Array) -> chex.Array:
        """What draws a symmetry for each trajectory at `index` [minibatches, S·each]; [minibatches, S·each, 2]."""
        minibatches, width = index.shape
        shape = (minibatches, width // len(keys), 2)
        drawn = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, 1), shape))(keys)
        return jnp.swapaxes(drawn, 0, 1).reshape(minibatches, width, 2)

    def _turned(self, env: Env, batch: Transition, turns: chex.Array) -> Transition:
        """Trajectories [B, T, ...], each under the symmetry that `turns` [B, 2] draws."""
        symmetry = getattr(env, "symmetry", None)
        if not (self.config.symmetries and symmetry):
            return batch

        def turned(x: chex.Array, by: chex.Array) -> chex.Array:
            return jnp.matmul(x, by.swapaxes(1, 2), precision="highest")  # a GPU's own would round to ten bits

        under = jax.vmap(symmetry)(turns)
        return batch._replace(
            observation=turned(batch.observation, under.observation),
            next_observation=turned(batch.next_observation, under.observation),
            action=turned(batch.action, under.action),
        )

    def _unroll_and_learn(self, learner: Learner, env: Env, state: TrainState) -> TrainState:
        collect_key, learn_key = jax.random.split(jax.random.fold_in(state.key, state.unrolls))
        lanes, transitions = self._collect(learner, state.learner, state.lanes, collect_key, state.starts)
        observed = learner.observe(state.learner, transitions.observation)
        ring = replay_buffer.add(state.ring, transitions)

        def update(now: LearnerState, drawn: tuple[chex.Array, chex.Array]) -> tuple[LearnerState, chex.Array]:
            index, turn = drawn
            now, terms = learner.update(now, self._turned(env, replay_buffer.gather(ring, index), turn))
            return now, jnp.stack(terms)

        def learn(now: LearnerState) -> tuple[LearnerState, chex.Array]:
            shards = self.config.shard_count
            keys = jax.vmap(lambda shard: jax.random.fold_in(learn_key, shard))(self._share(shards))
            each = self.config.batch_size // shards
            index = replay_buffer.draw(ring, keys, self.config.updates_per_unroll, each)
            return jax.lax.scan(update, now, (index, self._turns(keys, index)))

        def wait(now: LearnerState) -> tuple[LearnerState, chex.Array]:
            return now, jnp.zeros((self.config.updates_per_unroll, len(Terms._fields)))

        warm = state.unrolls + 1 >= self.config.warmup_unrolls
        learned, terms = jax.lax.cond(warm, learn, wait, observed)
        sums = self._sum(
            jnp.stack(
                [
                    jnp.sum(transitions.reward),
                    jnp.sum(transitions.terminated + transitions.truncated),
                    jnp.sum(lanes.early - state.lanes.early).astype(jnp.float32),
                    *(jnp.sum(~jnp.isfinite(x)) for x in (transitions.reward, transitions.next_observation)),
                ]
            )
        )
        fault_update, fault_term = self._fault(sums[3:] == 0, terms, observed.updates)
        fresh = (state.fault_update < 0) & (fault_update >= 0)
        seen = Totals(
            rewards=sums[0],
            steps=jnp.float32(self.config.steps_per_unroll),
            episodes=sums[1],
            early=sums[2],
            updates=(learned.updates - observed.updates).astype(jnp.float32),
            terms=Terms(*jnp.sum(terms, axis=0)),
        )
        return TrainState(
            learner=learned,
            ring=ring,
            lanes=lanes,
            key=state.key,
            starts=state.starts,
            unrolls=state.unrolls + 1,
            fault_update=jnp.where(fresh, fault_update, state.fault_update),
            fault_term=jnp.where(fresh, fault_term, state.fault_term),
            totals=jax.tree.map(jnp.add, state.totals, seen),
        )

    def _fault(self, collected: chex.Array, terms: chex.Array, updates: chex.Array) -> tuple[chex.Array, chex.Array]:
        """(update, index into FAULT_TERMS) of the first number that is not finite; (−1, −1) if all are.

        `collected` [2]: whether rewards and observations of the unroll all are; `terms`: each update's."""
        finite = jnp.concatenate(
            [jnp.tile(collected, (self.config.updates_per_unroll, 1)), jnp.isfinite(terms)], axis=1
        )
        first = jnp.argmin(finite.reshape(-1))
        update, term = first // finite.shape[1], first % finite.shape[1]
        ok = jnp.all(finite)
        return jnp.where(ok, -1, updates + update), jnp.where(ok, -1, term)

    def _fly(self, state: LearnerState, point: Point, keys: chex.PRNGKey) -> flights.Flights:
        learner, env = self._under(point)
        shipped = learner.shipped(state)
        return flights.fly(env, lambda observation: learner.mean(shipped, observation), keys, self.longest)


def xla_effort(level: int) -> dict[str, Any]:
    """Compiler options that say how hard XLA tries.

    On a CPU level 1 compiles in two thirds of the time of XLA's own level, to the same speed.
    """
    least = jax.config.read("jax_disable_most_optimizations")
    return {"xla_backend_optimization_level": level} if jax.default_backend() == "cpu" and not least else {}


def _in_turn(members: int) -> bool:
    """Whether members run one after the other, as is fastest on a CPU; one alone does: its branches stay branches."""
    return members == 1 or jax.default_backend() == "cpu"


def _over_members(one: Callable[[Any], Any], members: Any) -> Any:
    in_turn = _in_turn(len(jax.tree.leaves(members)[0]))
    return jax.lax.map(one, members) if in_turn else jax.vmap(one)(members)

"""One minibatch update: V-trace or GAE, the perceptron objective, the value loss, Adam (Algorithm 1)."""

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from qrl.algorithm.networks import MLP, log_density
from qrl.algorithm.objective import perceptron
from qrl.algorithm.running_statistics import Statistics, deviation, merged, none_yet
from qrl.algorithm.types import Networks, Transition
from qrl.algorithm.vtrace import vtrace
from qrl.config import Config

MIN_DISCOUNTING = 1e-3  # of 1 − gamma, where a reward goes on for ever
MAX_NORMALISED = 10.0  # standard deviations at which a standardised observation is clipped


class LearnerState(NamedTuple):
    params: Networks
    optimiser: Networks  # each network's own Adam
    average: chex.ArrayTree  # policy parameters, averaged
    statistics: Statistics  # of observations, where they are normalised
    updates: chex.Array  # int32 []


class Terms(NamedTuple):
    """What an update reports, in the order in which it computes them; scalars."""

    log_rho: chex.Array
    value: chex.Array
    a_trace: chex.Array
    policy_loss: chex.Array
    value_loss: chex.Array
    policy_gradient: chex.Array  # global norm before clipping
    value_gradient: chex.Array


Hyper = dict[str, Any]  # the traced hyperparameters by name: float32 [], or [F] of observation_scale


def hyper(config: Config) -> Hyper:
    """The traced hyperparameters of `config` as arrays; those that are null are absent."""
    return {k: v for k, v in config.hyperparameters._asdict().items() if v is not None}


class Learner:
    """The learner's pure functions for one environment's sizes and one configuration; holds no state.

    Where a minibatch is spread over devices, `axis` names the mesh axis: `update` and `observe` then take a device's
    part, and give every device the same.
    """

    def __init__(self, config: Config, observation_size: int, action_size: int, axis: str | None = None) -> None:
        self.config = config
        self.axis = axis
        self.observation_size = observation_size
        self.policy = MLP(config.policy_hidden_layer_sizes, action_size, config.activation, final_gain=0.01)
        self.critic = MLP(config.critic_hidden_layer_sizes, 1, config.activation, final_gain=1.0)
        self.total_updates = max(1, (config.learning_unrolls - config.warmup_unrolls + 1) * config.updates_per_unroll)
        self._set(hyper(config))

    def under(self, hyper: Hyper) -> "Learner":
        """This learner with other values of the traced hyperparameters, which may be tracers."""
        other = copy.copy(self)
        other._set(hyper)
        return other

    def _set(self, hyper: Hyper) -> None:
        self.hyper = hyper
        # For one flat vector of each network: far fewer, larger operations than leaf by leaf.
        self._optimiser = optax.chain(optax.clip_by_global_norm(hyper["max_grad_norm"]), optax.scale_by_adam())  # pyright: ignore[reportArgumentType]

    def init(self, key: chex.PRNGKey) -> LearnerState:
        policy_key, critic_key = jax.random.split(key)
        observation = jnp.zeros(self.observation_size)
        params = Networks(self.policy.init(policy_key, observation), self.critic.init(critic_key, observation))
        return LearnerState(
            params=params,
            optimiser=Networks(*(self._optimiser.init(ravel_pytree(network)[0]) for network in params)),
            average=params.policy,
            statistics=none_yet(self.observation_size),
            updates=jnp.int32(0),
        )

    def progress(self, state: LearnerState) -> chex.Array:
        """Fraction of the run's updates on minibatches already made; those by the analytic gradient follow at 1."""
        return jnp.minimum(state.updates / self.total_updates, 1.0)

    def sigma(self, state: LearnerState) -> chex.Array:
        """The policy's standard deviation, log-linear in the run's progress; []."""
        start, end = jnp.log(self.hyper["sigma"]), jnp.log(self.hyper["sigma_end"])
        return jnp.exp(start + (end - start) * self.progress(state))

    def scale(self, state: LearnerState, observation: chex.Array) -> chex.Array:
        """Observations as the networks see them; [..., F] -> [..., F]."""
        if self.config.normalize_observations:
            standard = (observation - state.statistics.mean) / deviation(state.statistics)
            observation = jnp.clip(standard, -MAX_NORMALISED, MAX_NORMALISED)
        return observation * self.hyper["observation_scale"] if "observation_scale" in self.hyper else observation

    def mean(self, state: LearnerState, observation: chex.Array) -> chex.Array:
        """The policy's mean action; [..., F] -> [..., A]."""
        return _apply(self.policy, state.params.policy, self.scale(state, observation))

    def shipped(self, state: LearnerState) -> LearnerState:
        """The learner with the policy that ships: the average, where averaging is on and has begun."""
        if not self.config.average_fraction:
            return state
        begun = self._averaging(state) > 0
        policy = jax.tree.map(lambda a, p: jnp.where(begun, a, p), state.average, state.params.policy)
        return state._replace(params=state.params._replace(policy=policy))

    def observe(self, state: LearnerState, observation: chex.Array) -> LearnerState:
        """Take observations [..., F] into the running statistics, where they are used."""
        if not self.config.normalize_observations:
            return state
        batch = observation.reshape(-1, self.observation_size)
        return state._replace(statistics=merged(state.statistics, batch, self.axis))

    def update(self, state: LearnerState, batch: Transition) -> tuple[LearnerState, Terms]:
        """One step of both networks on a minibatch of trajectories (leaves [B, T, ...])."""
        gradient, terms = self._over_devices(jax.grad(self._loss, has_aux=True)(state.params, state, batch))
        if self.config.normalize_advantage and not self._scaled_before:
            divisor = _divisor(terms.a_trace)
            gradient = gradient._replace(policy=jax.tree.map(lambda x: x / divisor, gradient.policy))
            terms = terms._replace(policy_loss=terms.policy_loss / divisor)
        terms = terms._replace(a_trace=jnp.sqrt(terms.a_trace))
        start, end = self.hyper["learning_rate"], self.hyper["learning_rate_end"]
        rate = start + self.progress(state) * (end - start)

        policy, policy_opt, policy_norm = self._moved(
            state.params.policy, gradient.policy, state.optimiser.policy, rate
        )
        critic, critic_opt, critic_norm = self._moved(
            state.params.critic, gradient.critic, state.optimiser.critic, rate
        )
        state = state._replace(
            params=Networks(policy, critic), optimiser=Networks(policy_opt, critic_opt), updates=state.updates + 1
        )
        return self._averaged(state), terms._replace(policy_gradient=policy_norm, value_gradient=critic_norm)

    def left(self, made: chex.Array) -> chex.Array:
        """Falls from 1 to 0 over the updates by the analytic gradient, with how many were made: step size and noise.

        By the power 1.5: where it fell in proportion, policies still wandered by 2 mm near the end (docs/profile.md).
        """
        return (1.0 - made / max(1, self.config.num_apg_updates)) ** 1.5

    def climb(
        self,
        state: LearnerState,
        flown: Callable[[LearnerState], tuple[chex.Array, chex.Array]],
        made: chex.Array,
    ) -> tuple[LearnerState, Terms, chex.Array]:
        """One step up the mean return; also the sums of returns and of whole flights, over all devices [2].

        `flown` tells returns [n], differentiable in the learner's policy, and whether each flight is whole [n]. `made`:
        int32 [], how many such steps were made before. The first begins with the policy that ships and an optimiser
        that has seen nothing. Flights can be chaotic: where the gradient is not finite, policy and optimiser stay.
        """
        first, ships = made == 0, self.shipped(state).params.policy
        optimiser = jax.tree.map(lambda x: jnp.where(first, 0, x).astype(x.dtype), state.optimiser.policy)

        def loss(policy: chex.ArrayTree) -> tuple[chex.Array, chex.Array]:
            returns, whole = flown(state._replace(params=state.params._replace(policy=policy)))
            return -jnp.mean(returns), jnp.stack([jnp.mean(returns), jnp.mean(whole)])

        gradient, means = self._over_devices(jax.grad(loss, has_aux=True)(ships))
        rate = self.left(made) * self.hyper["apg_learning_rate"]
        moved, seen, norm = self._moved(ships, gradient, optimiser, rate)
        finite = jnp.isfinite(norm)
        policy, optimiser = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), (moved, seen), (ships, optimiser)
        )
        zero = jnp.zeros(())
        state = state._replace(
            params=state.params._replace(policy=policy),
            optimiser=state.optimiser._replace(policy=optimiser),
            average=policy,
            updates=state.updates + 1,
        )
        terms = Terms(*[zero] * len(Terms._fields))
        terms = terms._replace(policy_loss=-means[0], policy_gradient=jnp.where(finite, norm, 0.0))
        return state, terms, self.config.apg_num_envs * means

    def _moved(
        self, params: chex.ArrayTree, gradient: chex.ArrayTree, optimiser: chex.ArrayTree, rate: chex.Array
    ) -> tuple[Any, Any, chex.Array]:
        """A network's parameters and optimiser a step on, and the norm of the gradient."""
        flat, whole = ravel_pytree(gradient)
        direction, optimiser = self._optimiser.update(flat, optimiser)
        moved = jax.tree.map(lambda p, d: p - rate * d, params, whole(jnp.asarray(direction)))
        return moved, optimiser, optax.tree.norm(flat)

    def _loss(self, params: Networks, state: LearnerState, batch: Transition) -> tuple[chex.Array, Terms]:
        config, hyper = self.config, self.hyper
        samples = batch.reward.shape

        def flat(x: chex.Array) -> chex.Array:
            return x.reshape(-1, x.shape[-1])  # one large product instead of a batched small one

        def value_of(critic: chex.ArrayTree, observation: chex.Array) -> chex.Array:
            value = _apply(self.critic, critic, self.scale(state, flat(observation)))
            return value.reshape(observation.shape[:-1])

        observation = self.scale(state, flat(batch.observation))
        value = _apply(self.critic, params.critic, observation).reshape(samples)
        next_value = _next_values(functools.partial(value_of, jax.lax.stop_gradient(params.critic)), value, batch)
        reward = hyper["reward_scaling"] * batch.reward
        # Beyond an environment's own bounds no transition begins, and so V is never fitted there: bootstrapped from, it
        # drew policies out and grew without end. In its place the last reward, for ever.
        for_ever = reward / jnp.maximum(1.0 - hyper["gamma"], MIN_DISCOUNTING)
        next_value = jnp.where(batch.out_of_bounds > 0, for_ever, next_value)
        mean = _apply(self.policy, params.policy, observation)
        log_pi = log_density(flat(batch.action), mean, self.sigma(state)).reshape(samples)
        log_rho = jax.lax.stop_gradient(log_pi - batch.log_mu)

        # A^mu needs no correction for the difference between pi and mu; with rho = 1 the trace is GAE(lambda).
        off_policy = config.advantage == "pi"
        rho = jnp.exp(log_rho) if off_policy else jnp.ones_like(log_rho)
        rho_bar, c_bar = (hyper["rho_bar"], hyper["c_bar"]) if off_policy else (1.0, 1.0)
        trace = jax.vmap(
            lambda *trajectory: vtrace(
                *trajectory, gamma=hyper["gamma"], lam=hyper["lam"], rho_bar=rho_bar, c_bar=c_bar
            )
        )(
            reward,
            jax.lax.stop_gradient(value),
            next_value,
            batch.terminated,
            batch.truncated,
            rho,
        )
        a_trace = trace.a_trace
        square = jnp.mean(a_trace**2)
        if self._scaled_before:
            square = self._over_devices(square)
            a_trace = a_trace / _divisor(square)
        margins = {"epsilon": hyper["epsilon"], "xi": hyper.get("xi")}
        policy_loss = -jnp.mean(perceptron(log_pi, batch.log_mu, a_trace, form=config.form, **margins))
        value_loss = jnp.mean((value - trace.v_trace) ** 2)
        zero = jnp.zeros(())
        return policy_loss + value_loss, Terms(
            log_rho=jnp.mean(log_rho),
            value=jnp.mean(value),
            a_trace=square,
            policy_loss=policy_loss,
            value_loss=value_loss,
            policy_gradient=zero,
            value_gradient=zero,
        )

    @property
    def _scaled_before(self) -> bool:
        """Whether A is divided by its root mean square before the objective, which takes an exchange of its own.

        With xi = epsilon·|A| the objective is proportional to A, and its gradient may as well be divided afterwards.
        """
        return self.config.normalize_advantage and "xi" in self.hyper

    def _over_devices(self, part: chex.ArrayTree) -> Any:
        """Means over the devices, in one exchange."""
        if self.axis is None:
            return part
        flat, whole = ravel_pytree(part)
        return whole(jax.lax.pmean(flat, self.axis))

    def _averaging(self, state: LearnerState) -> chex.Array:
        """Updates since averaging began; ≤ 0 before."""
        return state.updates - round(self.total_updates * (1.0 - self.config.average_fraction))

    def _averaged(self, state: LearnerState) -> LearnerState:
        if not self.config.average_fraction:
            return state
        weight = 1.0 / jnp.maximum(self._averaging(state), 1)
        average = jax.tree.map(lambda a, p: a + weight * (p - a), state.average, state.params.policy)
        return state._replace(average=average)


def _next_values(critic: Callable[[chex.Array], chex.Array], value: chex.Array, batch: Transition) -> chex.Array:
    """V of what follows each step of trajectories, [B, T], where `value` is V of what precedes it.

    What follows is what precedes the next step, but at ends. So V is computed anew at the last step and at the first
    end before it, and everywhere only where a trajectory has more of these.
    """
    steps = jnp.arange(value.shape[1])
    within = (batch.terminated + batch.truncated > 0) & (steps < steps[-1])
    at = jnp.argmax(within, axis=1)  # 0 where there is none
    first = within & (steps == at[:, None])

    def shifted() -> chex.Array:
        after = jnp.take_along_axis(batch.next_observation, at[:, None, None], axis=1)
        anew = critic(jnp.concatenate([after, batch.next_observation[:, -1:]], axis=1))
        following = jnp.concatenate([jax.lax.stop_gradient(value)[:, 1:], anew[:, 1:]], axis=1)
        return jnp.where(first, anew[:, :1], following)

    return jax.lax.cond(jnp.any(within & ~first), lambda: critic(batch.next_observation), shifted)


def _divisor(square: chex.Array) -> chex.Array:
    """What normalises A, from its mean square."""
    return jnp.sqrt(square) + 1e-8


def _apply(network: MLP, params: chex.ArrayTree, x: chex.Array) -> chex.Array:
    return jnp.asarray(network.apply(params, x))  # flax types its result as a union

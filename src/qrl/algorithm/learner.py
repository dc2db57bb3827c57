"""One minibatch update: V-trace or GAE, the perceptron objective, the value loss, Adam (Algorithm 1).

Pure functions of (spec, hyper, state): `LearnerSpec` shapes the program, `Hyperparameters` are its arguments.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from qrl.algorithm import networks, running_statistics
from qrl.algorithm.networks import GRU, MLP, Network, log_density
from qrl.algorithm.objective import perceptron
from qrl.algorithm.running_statistics import RunningStatistics
from qrl.algorithm.types import Networks, Transition
from qrl.algorithm.vtrace import vtrace
from qrl.config import Config, Hyperparameters

MIN_ONE_MINUS_GAMMA = 1e-3  # least 1 − gamma of a reward that is paid forever
MAX_NORMALIZED = 10.0  # standard deviations at which a standardized observation is clipped


class LearnerSpec(NamedTuple):
    """What shapes the learner's program."""

    config: Config
    observation_size: int
    action_size: int
    axis: str | None = None  # mesh axis over which a minibatch is sharded; None: one device
    policy_observation_size: int | None = None  # the policy sees this many, the first; None: all
    policy_view: Callable[[chex.Array], chex.Array] = lambda observation: (
        observation
    )  # the policy network's input of it

    @property
    def policy(self) -> Network:
        config = self.config
        hidden = config.policy_hidden_layer_sizes
        outputs = self.action_size, config.activation, 0.01, self._in_blocks
        return GRU(hidden, config.policy_gru_size, *outputs) if config.policy_gru_size else MLP(hidden, *outputs)

    @property
    def critic(self) -> MLP:
        return MLP(self.config.critic_hidden_layer_sizes, 1, self.config.activation, 1.0, self._in_blocks)

    @property
    def _in_blocks(self) -> bool:
        """Whether several devices are threads of this process, where Eigen's parts of a product wait for each other."""
        return self.axis is not None and jax.default_backend() == "cpu"


class LearnerState(NamedTuple):
    params: Networks
    optimizer: Networks  # each network's own Adam
    average: chex.ArrayTree  # averaged policy parameters
    statistics: RunningStatistics  # of observations, where they are normalized
    reward_range: chex.Array  # [2] least and greatest reward seen; 0 is within
    updates: chex.Array  # int32 []
    planned_updates: chex.Array  # int32 []: minibatch updates over which the schedules run


class UpdateMetrics(NamedTuple):
    """What an update reports, in the order of its computation; scalars."""

    log_rho: chex.Array
    value: chex.Array
    a_trace: chex.Array  # root mean square
    policy_loss: chex.Array
    value_loss: chex.Array
    policy_gradient: chex.Array  # global norm before clipping
    value_gradient: chex.Array


def init(spec: LearnerSpec, hyper: Hyperparameters, key: chex.PRNGKey) -> LearnerState:
    policy_key, critic_key = jax.random.split(key)
    observation = jnp.zeros(spec.observation_size)
    seen = _seen(spec, observation)
    params = Networks(networks.init(spec.policy, policy_key, seen), spec.critic.init(critic_key, observation))
    return LearnerState(
        params=params,
        optimizer=Networks(*(_optimizer(hyper).init(ravel_pytree(network)[0]) for network in params)),
        average=params.policy,
        statistics=running_statistics.init(spec.observation_size),
        reward_range=jnp.zeros(2),
        updates=jnp.int32(0),
        planned_updates=jnp.int32(spec.config.planned_updates(spec.config.learning_unrolls)),
    )


def progress(state: LearnerState) -> chex.Array:
    """Fraction of the planned minibatch updates that are done; 1 during APG."""
    return jnp.minimum(state.updates / state.planned_updates, 1.0)


def sigma(hyper: Hyperparameters, state: LearnerState) -> chex.Array:
    """Standard deviation of the policy, log-linear in the run's progress; []."""
    start, end = jnp.log(hyper.sigma), jnp.log(hyper.sigma_end)
    return jnp.exp(start + (end - start) * progress(state))


def preprocess(spec: LearnerSpec, hyper: Hyperparameters, state: LearnerState, observation: chex.Array) -> chex.Array:
    """The networks' input of observations, or of the first of their numbers; [..., F] -> [..., F]."""
    size = observation.shape[-1]
    if spec.config.observation_limit:
        most = spec.config.observation_limits(size)
        observation = jnp.clip(observation, -most, most)
    if spec.config.normalize_observations:
        deviation = running_statistics.std(state.statistics)[:size]
        standard = (observation - state.statistics.mean[:size]) / deviation
        observation = jnp.clip(standard, -MAX_NORMALIZED, MAX_NORMALIZED)
    return observation if hyper.observation_scale is None else observation * hyper.observation_scale[:size]


def _seen(spec: LearnerSpec, observation: chex.Array) -> chex.Array:
    """The policy network's input of preprocessed observations [..., F], or of the part that it sees."""
    return spec.policy_view(observation[..., : spec.policy_observation_size])


def initial_memory(spec: LearnerSpec, *lanes: int) -> Any:
    """The policy's memory at the start of an episode; [*lanes, H], or () of a feed-forward policy."""
    return networks.initial_memory(spec.policy, lanes)


def act(
    spec: LearnerSpec, hyper: Hyperparameters, state: LearnerState, memory: Any, observation: chex.Array
) -> tuple[Any, chex.Array]:
    """Next memory and mean action of the policy, of observations or of what it sees of them; [..., F] -> [..., A]."""
    seen = _seen(spec, preprocess(spec, hyper, state, observation[..., : spec.policy_observation_size]))
    return networks.step(spec.policy, state.params.policy, memory, seen)


def with_scale_in_weights(
    spec: LearnerSpec, hyper: Hyperparameters, state: LearnerState
) -> tuple[Hyperparameters, LearnerState]:
    """Hyperparameters and a state with which `act` does the same, to rounding, without multiplying each observation by
    `observation_scale`: the policy's first layer has it in its weights. Unchanged where the policy network is given
    another view of observations; and elsewhere than on a CPU, where products may round more than to float32, and so
    differ from the learner's.
    """
    if hyper.observation_scale is None or jax.default_backend() != "cpu":
        return hyper, state
    scale = hyper.observation_scale[: spec.policy_observation_size]
    if spec.policy_view(scale) is not scale:
        return hyper, state
    policy = networks.scale_inputs(spec.policy, state.params.policy, scale)
    return hyper._replace(observation_scale=None), state._replace(params=state.params._replace(policy=policy))


def deployed(spec: LearnerSpec, state: LearnerState) -> LearnerState:
    """The state with the deployed policy's parameters: their average, once averaging has begun."""
    if not spec.config.average_fraction:
        return state
    begun = _averaged_updates(spec, state) > 0
    policy = jax.tree.map(lambda a, p: jnp.where(begun, a, p), state.average, state.params.policy)
    return state._replace(params=state.params._replace(policy=policy))


def update_statistics(
    spec: LearnerSpec, state: LearnerState, observation: chex.Array, reward: chex.Array
) -> LearnerState:
    """Merge rewards [...] into their range, and observations [..., F] into the running statistics, if in use."""
    extremes = jnp.stack([jnp.min(reward), -jnp.max(reward)])
    if spec.axis is not None:
        extremes = jax.lax.pmin(extremes, spec.axis)
    low, high = state.reward_range
    state = state._replace(reward_range=jnp.stack([jnp.minimum(low, extremes[0]), jnp.maximum(high, -extremes[1])]))
    if not spec.config.normalize_observations:
        return state
    batch = observation.reshape(-1, spec.observation_size)
    return state._replace(statistics=running_statistics.update(state.statistics, batch, spec.axis))


class Targets(NamedTuple):
    a_trace: chex.Array  # [..., T] advantages
    v_trace: chex.Array  # [..., T] targets of V


def update(
    spec: LearnerSpec, hyper: Hyperparameters, state: LearnerState, batch: Transition, targets: Targets | None = None
) -> tuple[LearnerState, UpdateMetrics]:
    """One step of both networks on a minibatch of trajectories (leaves [B, T, ...]).

    `targets` [B, T] are those of the trajectories, fixed, as PPO has them; without, they are computed from the present
    networks. Over several devices (`spec.axis`) each has an equal part of the minibatch, and all get the same result.
    """
    loss = functools.partial(_loss, spec, hyper)
    gradient, metrics = mean_over_devices(spec, jax.grad(loss, has_aux=True)(state.params, state, batch, targets))
    if spec.config.normalize_advantage and not _normalizes_in_loss(spec, hyper):
        divisor = _rms(metrics.a_trace)
        gradient = gradient._replace(policy=jax.tree.map(lambda x: x / divisor, gradient.policy))
        metrics = metrics._replace(policy_loss=metrics.policy_loss / divisor)
    metrics = metrics._replace(a_trace=jnp.sqrt(metrics.a_trace))
    rate = hyper.learning_rate + progress(state) * (hyper.learning_rate_end - hyper.learning_rate)

    policy, policy_opt, policy_norm = apply_gradient(
        hyper, state.params.policy, gradient.policy, state.optimizer.policy, rate
    )
    critic, critic_opt, critic_norm = apply_gradient(
        hyper, state.params.critic, gradient.critic, state.optimizer.critic, rate
    )
    state = state._replace(
        params=Networks(policy, critic), optimizer=Networks(policy_opt, critic_opt), updates=state.updates + 1
    )
    state = _update_average(spec, state)
    return state, metrics._replace(policy_gradient=policy_norm, value_gradient=critic_norm)


def apply_gradient(
    hyper: Hyperparameters, params: chex.ArrayTree, gradient: chex.ArrayTree, optimizer: Any, rate: chex.Array
) -> tuple[Any, Any, chex.Array]:
    """One step of Adam down `gradient`: parameters, optimizer state, and the gradient's global norm before clipping."""
    flat, unravel = ravel_pytree(gradient)
    direction, optimizer = _optimizer(hyper).update(flat, optimizer)
    params = jax.tree.map(lambda p, d: p - rate * d, params, unravel(jnp.asarray(direction)))
    return params, optimizer, optax.tree.norm(flat)


def mean_over_devices(spec: LearnerSpec, part: Any) -> Any:
    """Means over the devices of `spec.axis`, in one exchange."""
    if spec.axis is None:
        return part
    flat, unravel = ravel_pytree(part)
    return unravel(jax.lax.pmean(flat, spec.axis))


def _optimizer(hyper: Hyperparameters) -> optax.GradientTransformation:
    """For one flat vector of each network: far fewer, larger operations than leaf by leaf."""
    return optax.chain(optax.clip_by_global_norm(hyper.max_grad_norm), optax.scale_by_adam())


def targets_of(spec: LearnerSpec, hyper: Hyperparameters, state: LearnerState, batch: Transition) -> Targets:
    """A^trace and V^trace of trajectories (leaves [B, T, ...]) under the present networks; constants."""
    observation = preprocess(spec, hyper, state, _flat(batch.observation))
    samples = batch.reward.shape
    value = networks.apply(spec.critic, state.params.critic, observation).reshape(samples)
    log_rho = jnp.zeros(samples)
    if spec.config.advantage == "pi":
        mean = _means(spec, state.params.policy, observation, batch)
        log_rho = log_density(_flat(batch.action), mean, sigma(hyper, state)).reshape(samples) - batch.log_mu
    return jax.lax.stop_gradient(_targets(spec, hyper, state, state.params.critic, value, log_rho, batch))


def _loss(
    spec: LearnerSpec,
    hyper: Hyperparameters,
    params: Networks,
    state: LearnerState,
    batch: Transition,
    targets: Targets | None = None,
) -> tuple[chex.Array, UpdateMetrics]:
    """Sum of the policy's and the critic's loss; metrics hold A^trace's mean square."""
    samples = batch.reward.shape
    observation = preprocess(spec, hyper, state, _flat(batch.observation))
    value = networks.apply(spec.critic, params.critic, observation).reshape(samples)
    mean = _means(spec, params.policy, observation, batch)
    log_pi = log_density(_flat(batch.action), mean, sigma(hyper, state)).reshape(samples)
    log_rho = jax.lax.stop_gradient(log_pi - batch.log_mu)

    a_trace, v_trace = targets or _targets(spec, hyper, state, params.critic, value, log_rho, batch)
    square = jnp.mean(a_trace**2)
    if _normalizes_in_loss(spec, hyper):
        square = mean_over_devices(spec, square)
        a_trace = a_trace / _rms(square)
    margins = {"epsilon": hyper.epsilon, "xi": hyper.xi}
    policy_loss = -jnp.mean(perceptron(log_pi, batch.log_mu, a_trace, form=spec.config.form, **margins))
    value_loss = jnp.mean((value - v_trace) ** 2)
    zero = jnp.zeros(())
    return policy_loss + value_loss, UpdateMetrics(
        log_rho=jnp.mean(log_rho),
        value=jnp.mean(value),
        a_trace=square,
        policy_loss=policy_loss,
        value_loss=value_loss,
        policy_gradient=zero,
        value_gradient=zero,
    )


def _means(spec: LearnerSpec, policy: chex.ArrayTree, observation: chex.Array, batch: Transition) -> chex.Array:
    """Mean actions over a batch of trajectories, of their preprocessed observations [B·T, F]; [B·T, A].

    A recurrent policy begins with the memory that it had when the trajectory was collected.
    """
    seen = _seen(spec, observation).reshape(*batch.reward.shape, -1)
    return networks.unroll(spec.policy, policy, batch.memory, seen, batch.terminated + batch.truncated)


def _flat(x: chex.Array) -> chex.Array:
    """One large product instead of a batched small one; [..., F] -> [n, F]."""
    return x.reshape(-1, x.shape[-1])


def _bootstrap_values(
    spec: LearnerSpec,
    hyper: Hyperparameters,
    state: LearnerState,
    critic: chex.ArrayTree,
    value: chex.Array,
    reward: chex.Array,
    batch: Transition,
) -> chex.Array:
    """V of each step's next observation, constant, as far as it is bootstrapped from; [B, T].

    No transition begins out of bounds, so V is never fitted there and extrapolates; bootstrapped from, it diverges. In
    its place stands the last reward forever.
    """
    frozen = jax.lax.stop_gradient(critic)

    def value_of(observation: chex.Array) -> chex.Array:
        inputs = preprocess(spec, hyper, state, _flat(observation))
        return networks.apply(spec.critic, frozen, inputs).reshape(observation.shape[:-1])

    next_value = _next_values(value_of, value, batch)
    return jnp.where(batch.out_of_bounds > 0, reward * _horizon(hyper), next_value)


def _horizon(hyper: Hyperparameters) -> chex.Array:
    """Steps 1/(1 − gamma) that a reward paid forever counts for; at most 1 / MIN_ONE_MINUS_GAMMA; []."""
    return 1.0 / jnp.maximum(1.0 - hyper.gamma, MIN_ONE_MINUS_GAMMA)


def _targets(
    spec: LearnerSpec,
    hyper: Hyperparameters,
    state: LearnerState,
    critic: chex.ArrayTree,
    value: chex.Array,
    log_rho: chex.Array,
    batch: Transition,
) -> Targets:
    """A^trace and V^trace of trajectories [B, T]; `value` [B, T] is the critic's of their observations."""
    reward = hyper.reward_scaling * batch.reward
    next_value = _bootstrap_values(spec, hyper, state, critic, value, reward, batch)
    # No policy's value is beyond what the extreme rewards pay forever: with this bound V cannot run away.
    low, high = hyper.reward_scaling * state.reward_range * _horizon(hyper)
    value, next_value = (jnp.clip(x, low, high) for x in (value, next_value))
    # A^mu needs no correction for the difference between pi and mu; with rho = 1 the trace is GAE(lambda).
    off_policy = spec.config.advantage == "pi"
    rho = jnp.exp(log_rho) if off_policy else jnp.ones_like(log_rho)
    clips = {"rho_bar": hyper.rho_bar, "c_bar": hyper.c_bar} if off_policy else {"rho_bar": 1.0, "c_bar": 1.0}
    trace = functools.partial(vtrace, gamma=hyper.gamma, lam=hyper.lam, **clips)
    constant = jax.lax.stop_gradient(value)
    return Targets(*jax.vmap(trace)(reward, constant, next_value, batch.terminated, batch.truncated, rho))


def _next_values(critic: Callable[[chex.Array], chex.Array], value: chex.Array, batch: Transition) -> chex.Array:
    """V of the observation after each step of trajectories, [B, T]; `value` is V of the one before.

    It is V of the next step's own, but at the last step and at truncations before it: of these the first has its own,
    and further ones, whose final observations are not kept, V of the observation one step earlier. (What stands at
    terminations and out of bounds is not used.)
    """
    value = jax.lax.stop_gradient(value)
    within, last = jnp.split(critic(batch.final_observation), 2, axis=1)
    following = jnp.concatenate([value[:, 1:], last], axis=1)
    truncated = (batch.truncated > 0) & (batch.out_of_bounds == 0)
    at = truncated & (jnp.arange(value.shape[1]) < value.shape[1] - 1)
    first = at & (jnp.cumsum(at, axis=1) == 1)
    return jnp.where(first, within, jnp.where(at, value, following))


def _normalizes_in_loss(spec: LearnerSpec, hyper: Hyperparameters) -> bool:
    """Whether A is divided by its RMS before the objective, which takes an exchange between devices of its own.

    With xi = epsilon·|A| the objective is proportional to A, so its gradient can be divided afterwards.
    """
    return spec.config.normalize_advantage and hyper.xi is not None


def _rms(square: chex.Array) -> chex.Array:
    """Divisor that normalizes A, from its mean square."""
    return jnp.sqrt(square) + 1e-8


def _averaged_updates(spec: LearnerSpec, state: LearnerState) -> chex.Array:
    """Updates since averaging began; ≤ 0 before."""
    first = jnp.round(state.planned_updates * (1.0 - spec.config.average_fraction))
    return state.updates - first.astype(jnp.int32)


def _update_average(spec: LearnerSpec, state: LearnerState) -> LearnerState:
    if not spec.config.average_fraction:
        return state
    weight = 1.0 / jnp.maximum(_averaged_updates(spec, state), 1)
    average = jax.tree.map(lambda a, p: a + weight * (p - a), state.average, state.params.policy)
    return state._replace(average=average)

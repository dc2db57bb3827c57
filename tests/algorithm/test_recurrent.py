"""A recurrent policy: its cell, whole trajectories from their first memory, and its gradients."""

from functools import cache, partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from pydantic import ValidationError

import small_run
from fault_injection import assert_same_leaves, leaves
from qrl.algorithm import analytic_gradient, learner, networks, replay_buffer, rollout
from qrl.algorithm.adapter import adapt
from qrl.algorithm.learner import LearnerSpec
from qrl.algorithm.networks import GRU
from qrl.config import Config
from small_run import run_config, train

NETWORK = GRU((5,), 6, 2, "tanh", 0.5)
INPUTS, LANES, T = 3, 4, 25


@cache
def parameters(network: GRU = NETWORK) -> Any:
    @jax.jit
    def made() -> Any:
        of = networks.init(network, jax.random.PRNGKey(1), jnp.zeros(INPUTS))
        noise = jax.random.split(jax.random.PRNGKey(2), len(jax.tree.leaves(of)))
        each = (x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(jax.tree.leaves(of), noise, strict=True))
        return jax.tree.unflatten(jax.tree.structure(of), each)

    return made()


def test_the_cell_is_flaxs() -> None:
    params, h = parameters(), jax.random.normal(jax.random.PRNGKey(3), (7, 6))
    own, x = params["params"], jax.random.normal(jax.random.PRNGKey(4), (7, INPUTS))
    encoded = jnp.tanh(x @ own["layers_0"]["kernel"] + own["layers_0"]["bias"])
    of_x, bias = jnp.split(own["of_input"]["kernel"], 3, axis=1), jnp.split(own["of_input"]["bias"], 3)
    of_h = jnp.split(own["of_memory"]["kernel"], 3, axis=1)
    theirs = {f"i{name}": {"kernel": of_x[i], "bias": bias[i]} for i, name in enumerate("rzn")}
    theirs |= {f"h{name}": {"kernel": of_h[i]} for i, name in enumerate("rzn")}
    theirs["hn"]["bias"] = own["candidate_bias"]
    expected, _ = nn.GRUCell(6).apply({"params": theirs}, h, encoded)
    found, output = networks.step(NETWORK, params, h, x)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(output, expected @ own["of_output"]["kernel"] + own["of_output"]["bias"], atol=1e-5)


def test_weight_gradients_of_a_trajectory_in_blocks_of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the layers before the gates, as where several devices share a process."""
    monkeypatch.setattr(networks, "BLOCK_WORK", 50 * 3 * 5)
    monkeypatch.setattr(networks, "MIN_BLOCK_ROWS", 10)
    spec = LearnerSpec(config(policy_hidden_layer_sizes=(5,), policy_gru_size=6), INPUTS, 2)
    plain, in_blocks = spec.policy, spec._replace(axis="shard").policy
    assert (plain.in_blocks, in_blocks.in_blocks) == (False, True)
    keys = jax.random.split(jax.random.PRNGKey(5), 2)
    x, first = jax.random.normal(keys[0], (LANES, T, INPUTS)), jax.random.normal(keys[1], (LANES, 6))

    def gradient(network: GRU) -> Any:
        def loss(params: Any) -> jax.Array:
            return jnp.sum(jnp.sin(networks.unroll(network, params, first, x, jnp.zeros((LANES, T)))))

        return jax.jit(jax.grad(loss)).lower(parameters()).compile()

    compiled = gradient(in_blocks)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5),
        compiled(parameters()),
        gradient(plain)(parameters()),
    )
    assert "f32[2,3,5]" in compiled.as_text()  # 100 rows of 3 and 5


def test_a_trajectory_is_its_steps_one_by_one() -> None:
    """Memory starts anew after each end, the first step begins with the memory given, and so do the gradients."""
    params, keys = parameters(), jax.random.split(jax.random.PRNGKey(5), 3)
    x, first = jax.random.normal(keys[0], (LANES, T, INPUTS)), jax.random.normal(keys[1], (LANES, 6))
    ended = (jax.random.uniform(keys[2], (LANES, T)) < 0.1).astype(jnp.float32)
    assert ended[:, :-1].any()

    def by_step(params: Any) -> jax.Array:
        def of_lane(memory: jax.Array, x: jax.Array, ended: jax.Array) -> jax.Array:
            rows = []
            for t in range(T):
                memory, output = networks.step(NETWORK, params, memory, x[t])
                rows.append(output)
                memory = memory * (1.0 - ended[t])
            return jnp.stack(rows)

        return jax.vmap(of_lane)(first, x, ended).reshape(LANES * T, 2)

    def whole(params: Any) -> jax.Array:
        return networks.unroll(NETWORK, params, memory=first, x=x, ended=ended)

    weights = jax.random.normal(keys[0], (LANES * T, 2))
    both = (
        jax.jit(jax.value_and_grad(lambda p, f=f: (jnp.sum(weights * f(p)), f(p)), has_aux=True))
        for f in (whole, by_step)
    )
    ((_, output), ours), ((_, expected_output), theirs) = (f(params) for f in both)
    np.testing.assert_allclose(output, expected_output, atol=1e-5)
    for found, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


class Hidden(Env):
    """A point that is pushed, of which only the position is seen; its episodes end beyond 1.5. Reward −x²."""

    observation_size, action_size, backend = INPUTS, 1, "test"  # pyright: ignore[reportAssignmentType]
    episode_steps = 12

    def reset(self, rng: jax.Array) -> State:
        return self._at(jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: jax.Array) -> State:
        x, v = state.pipeline_state
        v = v + 0.3 * action[0]
        return self._at(jnp.stack([x + 0.3 * v, v]))

    def _at(self, state: jax.Array) -> State:
        done = (jnp.abs(state[0]) > 1.5).astype(jnp.float32)
        return State(state, jnp.stack([state[0], state[0] ** 2, jnp.ones(())]), -(state[0] ** 2), done)


def config(**changes: Any) -> Config:
    values = Config.preset("default").model_dump() | {"policy_gru_size": 6, "policy_hidden_layer_sizes": (5,)}
    return Config(**(values | {"symmetries": False, "normalize_observations": False} | changes))


def collected(spec: LearnerSpec, state: Any, unrolls: int) -> list[Any]:
    """Unrolls of the policy, one after the other."""
    env, hyper = adapt(Hidden()), spec.config.hyperparameters
    memory = learner.initial_memory(spec, LANES)
    lanes = rollout.init(env, jax.random.PRNGKey(6), jnp.arange(LANES), LANES, 12, T, memory)
    ring = replay_buffer.create(rollout.transitions_of(lanes, env.action_size, T), unrolls)
    policy, sigma, starts = partial(learner.act, spec, hyper, state), jnp.float32(0.3), jax.random.PRNGKey(6)
    unroll = jax.jit(
        lambda lanes, ring, key: rollout.unroll(env, lanes, ring, policy, sigma, key, starts, max_episode_steps=12)
    )
    for i in range(unrolls):
        lanes, ring = unroll(lanes, ring, jax.random.PRNGKey(i))
    return [jax.tree.map(lambda x, i=i: x[i], ring.data) for i in range(unrolls)]


def test_what_was_collected_is_replayed_with_its_memory() -> None:
    """Of the policy that collected it, pi/mu is 1 at each step of each unroll, over ends and between unrolls; from
    another memory it is not.
    """
    spec = LearnerSpec(config(sigma=0.3), INPUTS, 1)
    state = learner.init(spec, spec.config.hyperparameters, jax.random.PRNGKey(0))
    state = state._replace(params=state.params._replace(policy=parameters(spec.policy)))  # pyright: ignore
    for i, batch in enumerate(collected(spec, state, 3)):
        assert batch.memory.shape == (LANES, 6)
        assert bool(jnp.any(batch.memory != 0.0)) == (i > 0)
        assert jnp.any(batch.terminated + batch.truncated)
        means = learner._means(spec, state.params.policy, batch.observation.reshape(-1, INPUTS), batch)
        log_pi = networks.log_density(batch.action.reshape(-1, 1), means, 0.3).reshape(LANES, T)
        np.testing.assert_allclose(log_pi, batch.log_mu, atol=1e-4)
        if i:
            forgotten = batch._replace(memory=jnp.zeros_like(batch.memory))
            means = learner._means(spec, state.params.policy, batch.observation.reshape(-1, INPUTS), forgotten)
            other = networks.log_density(batch.action.reshape(-1, 1), means, 0.3).reshape(LANES, T)
            assert float(jnp.abs(other - batch.log_mu).max()) > 1e-2


def test_the_gradient_of_flights_goes_through_the_memory() -> None:
    """As that of a loop step by step."""
    network, env, steps = GRU((5,), 6, 1, "tanh", 0.5), Hidden(), 8
    params, keys = parameters(network), jax.random.split(jax.random.PRNGKey(7), 3)
    params = jax.tree.map(lambda x: 0.5 * x, params)  # so that no action is clipped

    def ours(params: Any) -> jax.Array:
        act = partial(networks.step, network, params)
        values, _ = analytic_gradient.returns(
            env, act, networks.initial_memory(network, (3,)), jnp.float32(0.0), keys, steps
        )
        return values.sum()

    def literal(params: Any) -> jax.Array:
        def of_flight(key: jax.Array) -> jax.Array:
            total, state, memory, alive = jnp.zeros(()), env.reset(jax.random.split(key)[0]), jnp.zeros(6), jnp.ones(())
            for _ in range(steps):
                memory, action = networks.step(network, params, memory, state.obs)
                after = env.step(state, jnp.clip(action, -1.0, 1.0))
                state = jax.tree.map(lambda new, old, alive=alive: jnp.where(alive > 0, new, old), after, state)
                total, alive = total + state.reward, alive * (1.0 - state.done)
            return total

        return jax.vmap(of_flight)(keys).sum()

    found, expected = (jax.jit(jax.value_and_grad(f))(params) for f in (ours, literal))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-5)
    for one, other in zip(jax.tree.leaves(found[1]), jax.tree.leaves(expected[1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
    assert float(jnp.abs(found[1]["params"]["of_memory"]["kernel"]).max()) > 1e-3


def test_a_memory_cannot_be_mirrored() -> None:
    with pytest.raises(ValidationError, match="expected symmetries false with policy_gru_size"):
        config(symmetries=True)


def test_a_recurrent_unit_follows_a_hidden_layer() -> None:
    with pytest.raises(ValidationError, match="at least one layer with policy_gru_size"):
        config(policy_hidden_layer_sizes=())


def test_stopped_it_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    """Through both learners."""
    run = run_config(
        policy_gru_size=3, policy_hidden_layer_sizes=(4,), symmetries=False, apg_fraction=0.4, apg_num_envs=4
    )
    env = small_run.pendulum()
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
    train(tmp_path / "whole", run, env)
    for stop_after in (7, 21):
        train(tmp_path / "stopped", run, env, stop_after=stop_after, resume=stop_after > 7)
    train(tmp_path / "stopped", run, env, resume=True)
    assert_same_leaves(leaves(tmp_path / "stopped"), leaves(tmp_path / "whole"))

"""The tasks as Gymnasium vector environments: its conventions, and the numbers of the Brax environments."""

import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from qrl_envs import env, task
from qrl_envs.gymnasium_env import BraxVectorEnv

Array = np.ndarray
N, EPISODE_STEPS = 5, 7


@functools.cache
def world() -> env.TaskEnv:
    """A hover with short episodes."""
    return env.from_task(task.from_data({"extend": "hover", "episode_steps": EPISODE_STEPS}, "here"))


@functools.cache
def vector_env() -> BraxVectorEnv:
    return BraxVectorEnv(world(), N, seed=0)


def rollout(envs: gymnasium.vector.VectorEnv, seed: int | None, steps: int) -> list[Any]:
    """The observation of a reset, then the results of `steps` steps under constant actions."""
    first, _ = envs.reset(seed=seed)
    return [first, *(envs.step(np.full((N, 4), 0.1, np.float32)) for _ in range(steps))]


@pytest.mark.parametrize("name", task.shipped())
def test_registered_ids_make_it(name: str) -> None:
    """With the spaces, the autoreset mode and the checks of gymnasium.make_vec; values lie in the spaces."""
    envs = gymnasium.make_vec(f"qrl_envs.gymnasium_env:qrl_envs/{name.capitalize()}-v0", num_envs=N)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for space, single in (
        (envs.observation_space, envs.single_observation_space),
        (envs.action_space, envs.single_action_space),
    ):
        assert space == gymnasium.vector.utils.batch_space(single, N)
        assert space.dtype == np.float32
    obs, infos = envs.reset(seed=3)
    assert (obs in envs.observation_space, infos) == (True, {})
    obs, rewards, terminations, truncations, _ = envs.step(envs.action_space.sample())
    assert obs in envs.observation_space
    assert [x.shape for x in (rewards, terminations, truncations)] == [(N,)] * 3
    assert terminations.dtype == truncations.dtype == np.bool_
    envs.close()
    assert envs.closed


def test_gymnasiums_checks_of_a_reset_pass() -> None:
    """Those of single environments that hold for vectors too; two seeds differ, and so do resets without one."""
    envs = gymnasium.make_vec("qrl_envs.gymnasium_env:qrl_envs/Hover-v0", num_envs=N)
    env_checker.check_reset_return_type(envs)
    env_checker.check_reset_options(envs)
    env_checker.check_reset_seed_determinism(envs)
    starts = [envs.reset(seed=seed)[0] for seed in (1, 2, None, None)]
    assert len(np.unique(np.concatenate(starts), axis=0)) == 4 * N


def test_a_seed_repeats_a_rollout_restarts_included() -> None:
    """Bit for bit; the constructor's seed is that of a first reset without one."""
    first, again = rollout(vector_env(), 5, 9), rollout(BraxVectorEnv(world(), N, seed=5), None, 9)
    jax.tree.map(np.testing.assert_array_equal, first, again)


def test_values_are_those_of_the_brax_environment() -> None:
    """Stepped by hand from the same states; the last observation of an episode included."""
    brax, envs = world(), vector_env()
    envs.reset(seed=4)
    state, infos = envs._episodes[0], {}
    step = jax.jit(jax.vmap(brax.step))
    for actions in np.random.default_rng(0).uniform(-1.5, 1.5, (EPISODE_STEPS, N, 4)).astype(np.float32):
        state = step(state, jnp.asarray(actions))
        obs, rewards, _, truncations, infos = envs.step(actions)
        np.testing.assert_allclose(infos.get("final_obs", obs), state.obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(rewards, state.reward, rtol=1e-5)
        assert truncations.all() == ("final_obs" in infos)
    assert "final_obs" in infos


def test_episodes_are_truncated_at_their_length_and_restarted() -> None:
    """Every EPISODE_STEPS steps, from starts that differ; the final observations are not lost."""
    results = rollout(vector_env(), 0, 3 * EPISODE_STEPS)
    truncations = np.stack([truncations for _, _, _, truncations, _ in results[1:]])
    expected = np.arange(1, len(results)) % EPISODE_STEPS == 0
    np.testing.assert_array_equal(truncations, np.broadcast_to(expected[:, None], truncations.shape))
    assert not any(terminations.any() for _, _, terminations, _, _ in results[1:])
    starts = np.concatenate([results[0], *(results[k * EPISODE_STEPS][0] for k in (1, 2, 3))])
    assert len(np.unique(starts, axis=0)) == 4 * N
    for k, (obs, _, _, _, infos) in enumerate(results[1:], 1):
        assert ("final_obs" in infos) == (k % EPISODE_STEPS == 0)
        if infos:
            assert infos["_final_obs"].all()
            assert not infos["final_info"]["out_of_bounds"].any()
            before = results[k - 1][0] if k > 1 else results[0]
            moved = np.abs(infos["final_obs"] - before)[:, 9:12].max()
            assert moved < 0.2 < np.abs(obs - before)[:, 9:12].max()


def test_leaving_the_bounds_truncates_that_environment_alone() -> None:
    envs = vector_env()
    envs.reset(seed=0)
    state, steps, keys = envs._episodes
    body = state.pipeline_state.x
    position = body.pose.position_m.at[2, 0].set(30.0)
    body = body._replace(pose=body.pose._replace(position_m=position))
    envs._episodes = state.replace(pipeline_state=state.pipeline_state._replace(x=body)), steps, keys
    obs, _, terminations, truncations, infos = envs.step(np.zeros((N, 4), np.float32))
    only = np.arange(N) == 2
    assert not terminations.any()
    for found in (truncations, infos["_final_obs"], infos["final_info"]["out_of_bounds"]):
        np.testing.assert_array_equal(found, only)
    assert infos["final_obs"][2, 9] > 29.0
    assert np.abs(obs[:, 9:12]).max() <= 2.0
    np.testing.assert_array_equal(envs._episodes[1], np.where(only, 0, 1))


def test_gymnasiums_wrapper_records_episodes() -> None:
    """Lengths and returns of ended episodes are the sums of the rewards."""
    recorded = RecordEpisodeStatistics(vector_env())
    results = rollout(recorded, 0, EPISODE_STEPS)
    episode = results[-1][4]["episode"]
    np.testing.assert_array_equal(episode["l"], EPISODE_STEPS)
    np.testing.assert_allclose(
        episode["r"], np.sum([rewards for _, rewards, _, _, _ in results[1:]], axis=0), rtol=1e-5
    )

"""The rollout against a literal loop over one lane's steps, on a toy whose observation is its whole state."""

import functools
import itertools
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from scipy import stats

import collecting
from qrl.algorithm import replay_buffer, rollout
from qrl.algorithm.adapter import adapt
from qrl.algorithm.carried import lanes_last
from qrl.algorithm.rollout import Lanes
from qrl.algorithm.types import Transition
from qrl.config import Config
from qrl.training.trainer import Setup
from qrl_envs import env as worlds
from qrl_envs import task

Array = np.ndarray

LANES, T, LONGEST, UNROLLS = 6, 6, 12, 5
SIGMA = 0.9
X, Y, CLOCK, GAIN, FENCE = range(5)
GAINS = np.array([2.0, 1.0, 0.5, 0.2, 0.1, 0.02], np.float32)


class Fenced(Env):
    """A point that each action moves by gain·action/2; beyond the fence, in x or in y, its episode is over."""

    @property
    def observation_size(self) -> int:
        return 5

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "toy"

    def reset(self, rng: jax.Array) -> State:
        start = jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0)
        return self.at(jnp.concatenate([start, jnp.array([0.0, 1.0, 1.2])]))

    def step(self, state: State, action: jax.Array) -> State:
        move = jnp.concatenate([state.pipeline_state[GAIN] * action / 2, jnp.array([1.0, 0.0, 0.0])])
        after = self.at(state.pipeline_state + move)
        over = jnp.max(after.obs[:CLOCK]) > after.obs[FENCE]
        return after.replace(reward=after.obs[X] - 2.0 * after.obs[Y] + jnp.sum(action**2), done=jnp.float32(over))

    def at(self, x: jax.Array) -> State:
        """The state that is observed as `x`."""
        return State(x, x, jnp.float32(0.0), jnp.float32(0.0), {}, {})


class Marked(Fenced):
    """The same; leaving in y is a truncation by the environment's own word, and a restart keeps gain and fence.

    Where x is positive too, it says that nothing begins there any more.
    """

    def __init__(self, mark: str) -> None:
        self.mark = mark

    def at(self, x: jax.Array) -> State:
        left = x[Y] > x[FENCE]
        return (
            super()
            .at(x)
            .replace(info={self.mark: jnp.float32(left), "out_of_bounds": jnp.float32(left & (x[X] > 0.0))})
        )

    def restart(self, state: State, rng: jax.Array) -> State:
        kept = state.pipeline_state[GAIN:]
        return self.at(jnp.concatenate([self.reset(rng).obs[:GAIN], kept]))


def mean(observation: jax.Array) -> jax.Array:
    """A policy that leans outward, and knows where it is."""
    return 0.4 + 0.3 * observation[..., :CLOCK]


class Flight(NamedTuple):
    """Consecutive unrolls of one environment."""

    env: Fenced
    begun: Lanes
    ended: Lanes
    steps: Transition  # [N, UNROLLS·T, ...] NumPy; of the final observations [N, UNROLLS·2, ...]

    @property
    def after(self) -> Array:
        """[N, UNROLLS·T, 5] the observation after each step, before any reset, by the environment itself."""
        each = jax.vmap(jax.vmap(lambda x, a: self.env.step(self.env.at(x), jnp.clip(a, -1.0, 1.0)).obs))
        return np.asarray(each(self.steps.observation, self.steps.action))


@functools.cache
def begin_of(env: Env) -> Callable[[jax.Array], Lanes]:
    return jax.jit(lambda key: rollout.init(adapt(env), key, jnp.arange(LANES), LANES, LONGEST, T))


@functools.cache
def unroll_of(env: Env) -> Callable[..., tuple[Lanes, Transition]]:
    sigma = jnp.float32(SIGMA)
    return jax.jit(
        lambda lanes, key, starts: collecting.unroll(
            adapt(env),
            lanes,
            lambda memory, o: (memory, mean(o)),
            sigma,
            key,
            starts,
            unroll_length=T,
            max_episode_steps=LONGEST,
        )
    )


def fly(env: Fenced, lanes: Lanes, seed: int) -> Flight:
    begun, unrolls = lanes, []
    for i in range(UNROLLS):
        lanes, transitions = unroll_of(env)(lanes, jax.random.key(1000 * seed + i), jax.random.key(seed))
        unrolls.append(transitions)
    steps = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *unrolls)
    return Flight(env, begun, lanes, steps)


PLAIN, MARKED, BRAXS = Fenced(), Marked("truncated"), Marked("truncation")


def begin(env: Fenced, seed: int, fence: float = 1.2) -> Lanes:
    """Lanes of one environment, each with a gain of its own where a restart keeps it."""
    lanes = begin_of(env)(jax.random.key(seed))
    if env is PLAIN:
        return lanes
    x = np.array(lanes.state.obs)
    x[:, GAIN], x[:, FENCE] = GAINS, fence
    state = lanes.state.replace(pipeline_state=jnp.asarray(x), obs=jnp.asarray(x))
    return lanes._replace(state=state, next_state=state)


@functools.cache
def flown(env: Fenced) -> Flight:
    return fly(env, begin(env, seed=0), seed=0)


@pytest.fixture(params=[PLAIN, MARKED, BRAXS], ids=["plain", "truncated", "truncation"])
def flight(request: pytest.FixtureRequest) -> Flight:
    return flown(request.param)


@pytest.fixture(scope="module")
def unfenced() -> Flight:
    """No episode ends before its time."""
    return fly(MARKED, begin(MARKED, seed=2, fence=np.inf), seed=2)


def ends(steps: Transition) -> Array:
    """[N, K] whether an episode's last step."""
    return (steps.terminated + steps.truncated).astype(bool)


def test_transitions_are_those_of_a_literal_loop(flight: Flight) -> None:
    """One lane after the other, one step after the other: the same actions from the same starts, all fields alike.

    Termination is the environment's done unless it says that it truncated; an episode of LONGEST steps is truncated.
    """
    steps, step = flight.steps, jax.jit(flight.env.step)
    seen = np.zeros(3, int)
    for i in range(LANES):
        state, age = flight.env.at(flight.begun.state.obs[i]), int(flight.begun.steps[i])
        for t in range(UNROLLS * T):
            np.testing.assert_allclose(steps.observation[i, t], state.obs, rtol=1e-5, atol=1e-6)
            state = step(state, np.clip(steps.action[i, t], -1.0, 1.0))
            age += 1
            terminated = bool(state.done) and not bool(state.info.get(getattr(flight.env, "mark", ""), 0.0))
            truncated = not terminated and (bool(state.done) or age == LONGEST)
            np.testing.assert_allclose(steps.reward[i, t], state.reward, rtol=1e-5, atol=1e-5)
            assert (steps.terminated[i, t], steps.truncated[i, t]) == (terminated, truncated)
            assert steps.out_of_bounds[i, t] == (bool(state.done) and bool(state.info.get("out_of_bounds", 0.0)))
            if (terminated or truncated) and t + 1 < UNROLLS * T:
                seen += [terminated, bool(state.done) and truncated, not bool(state.done)]
                state, age = flight.env.at(steps.observation[i, t + 1]), 0
    terminations, own_truncations, out_of_time = seen
    assert terminations > 3
    assert out_of_time > 3 or flight.env is PLAIN
    assert (own_truncations > 3) == (flight.env is not PLAIN)


def test_an_observation_after_an_end_is_that_of_a_start(flight: Flight) -> None:
    """Beyond the fence or at the last second where an episode ended, while the observation after it is a start."""
    steps, ended, after = flight.steps, ends(flight.steps), flight.after
    beyond = after[..., :CLOCK].max(axis=-1) > after[..., FENCE]
    out_of_time = steps.truncated.astype(bool) & ~beyond
    np.testing.assert_array_equal(ended, beyond | out_of_time)
    assert not (steps.observation[..., :CLOCK].max(axis=-1) > steps.observation[..., FENCE]).any()
    following = steps.observation[:, 1:]
    np.testing.assert_array_equal(following[..., CLOCK][ended[:, :-1]], 0.0)
    np.testing.assert_allclose(following[~ended[:, :-1]], after[:, :-1][~ended[:, :-1]], atol=1e-6)


def test_final_observations_are_those_that_v_is_bootstrapped_from(flight: Flight) -> None:
    """Of each unroll: after its first truncation within bounds and before its last step; and after its last step. Both
    before the reset, and zeros where V is not bootstrapped.
    """
    seen: Counter[int | str] = Counter()
    for each in (flight, *(fly(flight.env, begin(flight.env, seed), seed) for seed in range(20, 24))):
        after, final = each.after, each.steps.final_observation
        truncated, ended = (each.steps.truncated > 0) & (each.steps.out_of_bounds == 0), ends(each.steps)
        for i, unroll in itertools.product(range(LANES), range(UNROLLS)):
            *times, last = range(unroll * T, (unroll + 1) * T)
            within = [t for t in times if truncated[i, t]]
            expected = after[i, within[0]] if within else np.zeros(5)
            used = truncated[i, last] or not ended[i, last]
            expected = [expected, after[i, last] if used else np.zeros(5)]
            np.testing.assert_allclose(final[i, 2 * unroll : 2 * unroll + 2], expected, atol=1e-6)
            seen.update([min(len(within), 2), "used" if used else "not used"])
    assert min(seen[0], seen["used"], seen["not used"]) > 3
    assert flight.env is PLAIN or (seen[1] > 3 and seen[2] > 0)


def starts(flight: Flight) -> Array:
    """[n, 2] where episodes began: the very first, and the observation after every end."""
    later = flight.steps.observation[:, 1:][ends(flight.steps)[:, :-1]]
    return np.concatenate([flight.begun.state.obs, later])[:, :CLOCK]


def test_every_episode_of_every_lane_starts_afresh(flight: Flight) -> None:
    """No start twice: not the lane's first again, nor another lane's; also when a lane ends twice in an unroll."""
    ended = ends(flight.steps).reshape(LANES, UNROLLS, T)
    assert (ended.sum(axis=-1) >= 2).sum() >= 5
    begun = starts(flight)
    assert len(begun) > 4 * LANES
    assert len(np.unique(begun, axis=0)) == len(np.unique(begun[:, X])) == len(begun)


def test_starts_are_drawn_from_the_environments_reset() -> None:
    """Uniform over its square: Kolmogorov–Smirnov over several flights."""
    begun = np.concatenate([starts(fly(PLAIN, begin(PLAIN, seed), seed)) for seed in range(10, 20)])
    assert len(begun) > 300
    for coordinate in begun.T:
        assert stats.kstest(coordinate, stats.uniform(-1.0, 2.0).cdf).pvalue > 0.01


def test_a_restart_keeps_the_lanes_own_parameters() -> None:
    """What the environment's `restart` keeps, a lane has from its first episode to its last."""
    marked = flown(MARKED)
    assert ends(marked.steps)[0].sum() > 3
    np.testing.assert_array_equal(marked.steps.observation[..., GAIN], np.repeat(GAINS[:, None], UNROLLS * T, axis=1))


class Redrawing(Fenced):
    """A restart draws an integer that steps read; the second step ends an episode, by a mark that the first sets."""

    def at(self, x: jax.Array) -> State:
        info = {"truncated": jnp.float32(0.0), "late": jnp.float32(0.0), "drawn": jnp.int32(0)}
        return super().at(x).replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        late, drawn = state.info["late"], state.info["drawn"]
        info = {"truncated": late, "late": jnp.float32(1.0), "drawn": drawn}
        done = state.pipeline_state[CLOCK]
        return super().step(state, action).replace(reward=drawn.astype(float), done=done, info=info)

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(info=state.info | {"drawn": jax.random.randint(rng, (), 1, 1_000_000)})


def test_an_integer_drawn_anew_and_a_mark_alone_are_carried() -> None:
    """A reward is what was drawn; nothing but the mark depends on the leaf that sets it."""
    env = Redrawing()
    _, steps = unroll_of(env)(begin_of(env)(jax.random.key(0)), jax.random.key(1), jax.random.key(0))
    rewards = np.asarray(steps.reward)
    assert (rewards[:, 2:] >= 1.0).all()
    assert len(np.unique(rewards)) == rewards.size // 2
    np.testing.assert_array_equal(steps.truncated, np.tile([0.0, 1.0], (LANES, T // 2)))
    np.testing.assert_array_equal(steps.terminated, 0.0)


@pytest.mark.parametrize("change", ["type", "shape"])
def test_a_step_that_changes_a_leafs_type_or_shape_is_refused(change: str) -> None:
    class Changing(Fenced):
        def step(self, state: State, action: jax.Array) -> State:
            done = jnp.bool_(False) if change == "type" else jnp.zeros(2)
            return super().step(state, action).replace(done=done)

    lanes = begin_of(Fenced())(jax.random.key(0))
    with pytest.raises(ValueError, match=r"step gives another type or shape of \.done: expected float32 \[6\], found"):
        rollout.Steps(adapt(Changing()), lanes)


class Keeping(Fenced):
    """The same with leaves of its own: what a restart hands on and a step does not change, and what either changes."""

    def at(self, x: jax.Array) -> State:
        info = {"mass": x[GAIN], "swapped": x[GAIN], "age": x[CLOCK], "drawn": x[X], "empty": jnp.zeros(0)}
        return super().at(x).replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        after, info = super().step(state, action), state.info
        reward = after.reward + info["mass"] + info["swapped"] + info["drawn"] + info["age"]
        return after.replace(reward=reward, info=info | {"age": info["age"] + 1.0})

    def restart(self, state: State, rng: jax.Array) -> State:
        info = state.info | {"drawn": jax.random.uniform(rng), "swapped": state.info["mass"]}
        return self.at(self.reset(rng).obs).replace(info=info)


@pytest.mark.parametrize("jitted", [False, True])
def test_a_restart_leaves_alone_what_it_and_a_step_hand_on(jitted: bool) -> None:
    """Of each lane its own; an age, which steps change, is that of the state that was drawn. A jitted restart hides
    what it hands on: then nothing is kept, and the lanes are the same.
    """
    env = Keeping()
    lanes = begin_of(env)(jax.random.key(0))
    mass = jnp.arange(LANES, dtype=jnp.float32)
    info = lanes.state.info | {"mass": mass, "age": mass}
    lanes = lanes._replace(state=lanes.state.replace(info=info), done=jnp.arange(LANES) % 2 == 0)
    if jitted:
        env.restart = jax.jit(env.restart)
    steps = rollout.Steps(adapt(env), lanes)
    carry = steps.pack(lanes).state
    # A step changes the state [5] and the age; a restart "drawn" and "swapped" and, jitted, perhaps "mass". No later
    # step asks for the rest.
    assert carry.moving.shape == (6, LANES)
    assert carry.drawn.shape == (3 if jitted else 2, LANES)
    once = steps.restart(steps.pack(lanes), lanes_last(lanes.state), jax.random.key(1))
    once = steps.unpack(once, lanes)
    np.testing.assert_array_equal(once.state.info["mass"], mass)
    np.testing.assert_array_equal(once.state.info["swapped"], np.where(lanes.done, mass, lanes.state.info["swapped"]))
    np.testing.assert_array_equal(once.state.info["age"], mass)
    assert not np.intersect1d(once.state.info["drawn"][::2], lanes.state.info["drawn"]).size
    after, _ = unroll_of(env)(once, jax.random.key(2), jax.random.key(1))
    np.testing.assert_array_equal(after.state.info["mass"], mass)


def test_a_restart_of_another_structure_is_refused() -> None:
    class Another(Keeping):
        def restart(self, state: State, rng: jax.Array) -> State:
            return super().restart(state, rng).replace(info={})

    lanes = begin_of(Keeping())(jax.random.key(0))
    with pytest.raises(ValueError, match=r"restart gives a state of another structure: expected .*mass.*, found"):
        rollout.Steps(adapt(Another()), lanes)


def test_an_environment_without_the_mark_only_terminates(flight: Flight) -> None:
    """Its done is a termination; a mark makes a truncation of it; the two never come together."""
    steps = flight.steps
    beyond_x, beyond_y = (flight.after[..., i] > flight.after[..., FENCE] for i in (X, Y))
    expected = (beyond_x | beyond_y) if flight.env is PLAIN else beyond_x & ~beyond_y
    np.testing.assert_array_equal(steps.terminated.astype(bool), expected)
    assert not (steps.terminated * steps.truncated).any()
    assert set(np.unique([steps.terminated, steps.truncated])) == {0.0, 1.0}


def test_episodes_are_cut_at_the_longest(unfenced: Flight) -> None:
    """Staggered lanes have their first end early, and then one every LONGEST steps: a truncation, across unrolls."""
    np.testing.assert_array_equal(unfenced.begun.steps, [0, 0, 0, 6, 6, 6])
    time = np.arange(1, UNROLLS * T + 1)
    expected = (time + np.asarray(unfenced.begun.steps)[:, None]) % LONGEST == 0
    np.testing.assert_array_equal(unfenced.steps.truncated, expected)
    assert not unfenced.steps.terminated.any()
    assert not expected[:, np.arange(UNROLLS * T) % T != T - 1].any()  # whole unrolls: ends at unroll ends alone


@pytest.mark.parametrize(("lanes", "longest", "unroll_length"), [(8, 40, 10), (7, 200, 50), (3, 100, 50), (5, 30, 50)])
def test_lanes_begin_staggered_by_whole_unrolls(lanes: int, longest: int, unroll_length: int) -> None:
    """Ages are multiples of an unroll, below the longest episode, spread over it as evenly as whole lanes can be."""
    begun = jax.jit(lambda key: rollout.init(adapt(PLAIN), key, jnp.arange(lanes), lanes, longest, unroll_length))(
        jax.random.key(0)
    )
    ages = np.asarray(begun.steps)
    assert (ages % unroll_length == 0).all()
    assert ages.min() == 0
    assert ages.max() < longest
    _, counts = np.unique(ages, return_counts=True)
    assert len(counts) == min(lanes, -(-longest // unroll_length))
    assert counts.max() - counts.min() <= 1
    assert not begun.done.any()
    assert len(np.unique(begun.state.obs, axis=0)) == lanes


def test_early_counts_the_episodes_cut_short(flight: Flight, unfenced: Flight) -> None:
    """By the environment, before their last step; per lane, over all unrolls."""
    late = flight.after[..., CLOCK] == LONGEST
    first = np.cumsum(ends(flight.steps), axis=1) - ends(flight.steps) == 0
    age = flight.after[..., CLOCK] + first * np.asarray(flight.begun.steps)[:, None]
    cut_short = ends(flight.steps) & (age < LONGEST)
    assert late.sum() < cut_short.sum()
    np.testing.assert_array_equal(flight.ended.num_early, cut_short.sum(axis=1))
    assert not unfenced.ended.num_early.any()


def test_actions_are_recorded_as_drawn_and_flown_clipped(flight: Flight) -> None:
    """The point moves by gain/2 at most, though actions beyond ±1 stand in the record."""
    steps = flight.steps
    assert (np.abs(steps.action) > 1.0).mean() > 0.1
    on = ~ends(steps)[:, :-1]
    moved = (steps.observation[:, 1:] - steps.observation[:, :-1])[..., :CLOCK][on]
    expected = steps.observation[..., GAIN, None] * np.clip(steps.action, -1.0, 1.0) / 2
    np.testing.assert_allclose(moved, expected[:, :-1][on], atol=1e-6)


def test_log_mu_is_scipys_normal_density(flight: Flight) -> None:
    """Of the action as drawn, summed over its dimensions."""
    center = 0.4 + 0.3 * flight.steps.observation[..., :CLOCK].astype(np.float64)
    expected = stats.norm.logpdf(flight.steps.action.astype(np.float64), center, SIGMA).sum(axis=-1)
    np.testing.assert_allclose(flight.steps.log_mu, expected, rtol=1e-5, atol=1e-5)


def test_noise_is_standard_normal_and_never_repeats(flight: Flight) -> None:
    """Over steps, lanes, dimensions and unrolls: Kolmogorov–Smirnov, and no value twice."""
    center = 0.4 + 0.3 * flight.steps.observation[..., :CLOCK]
    noise = (flight.steps.action - center) / SIGMA
    assert stats.kstest(noise.ravel(), "norm").pvalue > 0.01
    assert len(np.unique(noise.round(5))) > 0.99 * noise.size


def test_noise_of_lanes_steps_and_dimensions_is_independent() -> None:
    """Standard normal, tails too; no correlation between lanes, dimensions or steps; odd sizes."""
    lanes, steps, size = jnp.array([0, 1, 2, 1_000_000]), 1501, 3
    noise = np.asarray(jax.jit(lambda key: rollout.normal(key, lanes, steps, size))(jax.random.key(5)), float)
    assert noise.shape == (steps, 4, size)
    assert stats.kstest(noise.ravel(), "norm").pvalue > 0.01
    assert abs((np.abs(noise) > 3.0).mean() - 0.0027) < 0.0012
    np.testing.assert_allclose([noise.mean(), noise.std()], [0.0, 1.0], atol=0.03)
    columns = noise.reshape(steps, -1)
    columns = np.concatenate([columns[1:], columns[:-1], columns[1:] ** 2], axis=1)
    correlation = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlation).max() < 4.5 / np.sqrt(steps)


def test_the_key_decides_everything() -> None:
    """The same key repeats an unroll to the last bit, another changes every action."""
    lanes = begin(MARKED, seed=3)
    first, again, other = (unroll_of(MARKED)(lanes, jax.random.key(i), jax.random.key(3)) for i in (0, 0, 1))
    for one, two in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, two)
    assert (np.asarray(first[1].action) != other[1].action).all()


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_members_side_by_side_fly_as_they_would_alone(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """vmapped, starts are drawn for all members where one needs them, which must not change any member's; and by the
    operations that are chosen for a GPU, where the condition on them must remain one.
    """
    begun, unrolls = [begin(MARKED, seed) for seed in (4, 5)], 3
    keys = jax.random.split(jax.random.key(6), 2)
    noise = [jax.random.split(key, unrolls) for key in keys]
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    program = jax.vmap(unroll_of.__wrapped__(MARKED))
    together = jax.tree.map(lambda *x: jnp.stack(x), *begun)
    text = str(jax.make_jaxpr(program)(together, keys, keys))
    assert (" cond[" in text) == (backend == "gpu")
    steps = []
    for i in range(unrolls):
        together, transitions = program(together, jnp.stack([each[i] for each in noise]), keys)
        steps.append(transitions)
    monkeypatch.undo()
    for member, lanes in enumerate(begun):
        for i in range(unrolls):
            lanes, alone = unroll_of(MARKED)(lanes, noise[member][i], keys[member])
            for ours, expected in zip(jax.tree.leaves(steps[i]), jax.tree.leaves(alone), strict=True):
                np.testing.assert_allclose(ours[member], expected, rtol=1e-5, atol=1e-5)
        # A start that is drawn early has the number that it would have had.
        mine = jax.tree.map(lambda x, member=member: x[member], together)
        np.testing.assert_array_equal(
            mine.reset_count + mine.next_state_used, lanes.reset_count + lanes.next_state_used
        )
        assert lanes.reset_count.max() > 1


def test_a_lane_flies_as_it_would_without_its_neighbors() -> None:
    """Starts, noise and stagger are a lane's own: half the lanes alone make the transitions that they make in a whole.

    Neighbors decide when starts are drawn, and must not decide which.
    """
    begun = begin(MARKED, seed=7)
    whole = fly(MARKED, begun, seed=7).steps
    assert ends(whole).sum() > 3 * LANES
    for half in (slice(0, 3), slice(3, 6)):
        alone = fly(MARKED, jax.tree.map(lambda x, half=half: x[half], begun), seed=7).steps
        for ours, expected in zip(alone, whole, strict=True):
            np.testing.assert_allclose(ours, expected[half], rtol=1e-5, atol=1e-5)
    first = jax.jit(lambda key: rollout.init(adapt(MARKED), key, jnp.arange(3, 6), LANES, LONGEST, T))(
        jax.random.key(7)
    )
    of_all = begin_of(MARKED)(jax.random.key(7))
    np.testing.assert_array_equal(first.state.obs, of_all.state.obs[3:])
    np.testing.assert_array_equal(first.steps, of_all.steps[3:])


def test_lanes_are_handed_on_before_the_reset(flight: Flight) -> None:
    """The state after an unroll is the one last observed, its end marked for the next unroll to see."""
    np.testing.assert_allclose(flight.ended.state.obs, flight.after[:, -1], atol=1e-6)
    np.testing.assert_array_equal(flight.ended.done, ends(flight.steps)[:, -1])


def test_the_longest_episode_is_the_configured_else_the_tasks_else_1000() -> None:
    """Ours say their own."""
    hover, default = worlds.make("hover"), Config.preset("hover")
    assert Setup(adapt(hover), default).max_episode_steps == 200
    assert Setup(adapt(hover), default.model_copy(update={"episode_length": 77})).max_episode_steps == 77
    assert Setup(adapt(PLAIN), default).max_episode_steps == 1000


@pytest.mark.parametrize("lanes", [8, 9], ids=["two blocks of 4", "three of 3"])
def test_lanes_are_stepped_alike_in_blocks(lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With more lanes than a block's most, each lane does, to rounding, what it does among all at once.

    But for when its next start is drawn, which is when some lane beside it needs one.
    """
    env = Marked("truncated")

    def run() -> tuple[Any, ...]:
        key = jax.random.PRNGKey(3)
        begun = rollout.init(adapt(env), key, jnp.arange(lanes), lanes, LONGEST, T)
        mean, sigma = (lambda observation: jnp.zeros((*observation.shape[:-1], env.action_size))), jnp.float32(0.5)
        after, steps = collecting.unroll(
            adapt(env),
            begun,
            lambda memory, o: (memory, mean(o)),
            sigma,
            key,
            key,
            unroll_length=3 * T,
            max_episode_steps=LONGEST,
        )
        return steps, after.state, after.steps, after.done, after.reset_count + after.next_state_used, after.num_early

    at_once = jax.jit(run)()
    monkeypatch.setattr(rollout, "BLOCK_LANES", 4)
    in_blocks = jax.jit(lambda: run())()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), in_blocks, at_once)


@pytest.mark.parametrize("block", [rollout.BLOCK_LANES, LANES // 2], ids=["one block", "two blocks"])
def test_an_unroll_is_written_into_the_next_slot_alone(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others keep what they hold, twice around the ring; what is written is what a ring of one slot would hold."""
    monkeypatch.setattr(rollout, "BLOCK_LANES", block)
    env, key, sigma = adapt(MARKED), jax.random.PRNGKey(4), jnp.float32(SIGMA)
    lanes = rollout.init(env, key, jnp.arange(LANES), LANES, LONGEST, T)
    shapes = rollout.transitions_of(lanes, env.action_size, T)
    ring, single = replay_buffer.create(shapes, 3), replay_buffer.create(shapes, 1)
    written = jax.jit(
        lambda lanes, ring, key: rollout.unroll(
            env,
            lanes,
            ring,
            lambda memory, o: (memory, mean(o)),
            sigma,
            key,
            jax.random.PRNGKey(4),
            max_episode_steps=LONGEST,
        )
    )
    for i in range(6):
        before = ring
        _, alone = written(lanes, single, jax.random.PRNGKey(i))
        lanes, ring = written(lanes, ring, jax.random.PRNGKey(i))
        assert int(ring.inserted) == i + 1
        newest = replay_buffer.newest(ring)
        for now, then, new in zip(ring.data, before.data, newest, strict=True):
            if isinstance(now, tuple):  # no memory
                continue
            np.testing.assert_array_equal(now[i % 3], new)
            np.testing.assert_array_equal(np.delete(now, i % 3, 0), np.delete(then, i % 3, 0))
        expected = replay_buffer.newest(alone)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), newest, expected)
        assert np.abs(newest.observation).max(axis=-1).min() > 0


class Whole(Env):
    """Observations in whole numbers."""

    observation_size, action_size, backend = 2, 1, "none"  # pyright: ignore[reportAssignmentType]

    def reset(self, rng: jax.Array) -> State:
        zero = jnp.float32(0.0)
        return State(pipeline_state=None, obs=jnp.zeros(2, jnp.int32), reward=zero, done=zero)

    def step(self, state: State, action: jax.Array) -> State:
        return state.replace(obs=state.obs + jnp.round(action[0]).astype(jnp.int32) + 1)


@pytest.mark.parametrize("env", [MARKED, Whole(), worlds.make("hover")], ids=["float", "integer", "hover"])
def test_what_is_recorded_has_the_types_of_a_step(env: Any) -> None:
    """`transitions_of` says them without tracing one."""
    env = adapt(env)
    lanes = jax.eval_shape(lambda: rollout.init(env, jax.random.PRNGKey(0), jnp.arange(4), 4, 10, 5))
    expected = rollout.transitions_of(lanes, env.action_size, 5)

    def step(lanes: Lanes) -> Transition:
        steps, none = rollout.Steps(env, lanes), jnp.zeros(4, bool)
        packed = steps.pack(lanes)
        now = rollout.UnrollCarry(packed, none, none, jnp.zeros_like(packed.state.observation))
        policy = lambda memory, o: (memory, jnp.zeros((4, env.action_size)))  # noqa: E731
        noise, key = jnp.ones((4, env.action_size)), jax.random.PRNGKey(0)
        return rollout._step(steps, policy, jnp.float32(0.1), key, 10, lanes_last(lanes.state), now, noise)[1]

    found = jax.eval_shape(step, lanes)
    for name in (*rollout._wide(found), *rollout._narrow(found)):
        ours, theirs = getattr(expected, name), getattr(found, name)
        assert (ours.dtype, ours.shape) == (theirs.dtype, (4, 5, *theirs.shape[1:])), name
    assert (expected.final_observation.dtype, expected.final_observation.shape) == (
        found.observation.dtype,
        (4, 2, env.observation_size),
    )


def test_rows_are_chosen_as_by_where() -> None:
    """Bit for bit, whatever the other number is."""
    odd = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 1e-45], np.float32)
    x, other = (np.asarray(a) for a in np.meshgrid(odd, odd))
    for chosen in (np.arange(8) % 2 == 0, np.zeros(8, bool), np.ones(8, bool)):
        found = jax.jit(rollout._chosen_rows)(chosen[:, None], x, other)
        np.testing.assert_array_equal(
            np.asarray(found).view(np.uint32), np.where(chosen[:, None], x, other).view(np.uint32)
        )


def test_a_quadrotor_that_flees_is_truncated_and_starts_afresh() -> None:
    """Our own environment, with bounds so near that most lanes leave them: the loop's steps, never a termination."""
    near = {"start": {"position_m": 1.5, "velocity_m_s": 9.0}, "evaluation": {"start": {"position_m": 1.5}}}
    spec = task.from_data({"extend": "hover", "bounds": {"distance_m": 3.0}} | near, "here")
    env, sigma = worlds.from_task(spec), jnp.float32(0.3)

    def still(observation: jax.Array) -> jax.Array:
        return jnp.zeros((*observation.shape[:-1], 4))

    @jax.jit
    def run(key: jax.Array) -> tuple[Lanes, Transition]:
        lanes = rollout.init(adapt(env), key, jnp.arange(4), 4, 100, 50)
        return lanes, collecting.unroll(
            adapt(env),
            lanes,
            lambda memory, o: (memory, still(o)),
            sigma,
            key,
            key,
            unroll_length=50,
            max_episode_steps=100,
        )[1]

    lanes, steps = run(jax.random.key(0))
    step, fled = jax.jit(env.step), 0
    for i in range(4):
        state = jax.tree.map(lambda x, i=i: x[i], lanes.state)
        for t in range(50):
            state = step(state, jnp.clip(steps.action[i, t], -1.0, 1.0))
            np.testing.assert_allclose(steps.reward[i, t], state.reward, rtol=1e-3, atol=1e-3)
            if state.done:
                fled += 1
                assert np.linalg.norm(state.obs[9:12]) > 3.0
                assert steps.truncated[i, t] == 1
                assert t == 49 or np.abs(steps.observation[i, t + 1, 9:12]).max() <= 2.0
                break
            after = steps.observation[i, t + 1] if t < 49 else steps.final_observation[i, 1]
            np.testing.assert_allclose(after, state.obs, rtol=1e-3, atol=1e-3)
    assert fled >= 2
    assert not np.asarray(steps.terminated).any()

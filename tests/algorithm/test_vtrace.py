"""V-trace and GAE(lambda) against rlax, and against the papers' formulas written out as loops and double sums."""

import warnings
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm.vtrace import Trace, linear_recurrence, vtrace

with warnings.catch_warnings():
    # rlax imports TensorFlow Probability, which reads a name that JAX has retired.
    warnings.simplefilter("ignore", DeprecationWarning)
    import rlax

Array = np.ndarray

T = 50
GAMMA = 0.97

our_vtrace = jax.jit(vtrace)
rlax_vtrace = jax.jit(rlax.vtrace_td_error_and_advantage)
rlax_gae = jax.jit(rlax.truncated_generalized_advantage_estimation)

each_seed = pytest.mark.parametrize("seed", range(5))
each_lam = pytest.mark.parametrize("lam", [0.0, 0.5, 0.95, 1.0])
each_rho_bar = pytest.mark.parametrize("rho_bar", [0.5, 1.0, 2.0, np.inf])


@pytest.fixture(autouse=True, scope="module")
def float64() -> Iterator[None]:
    """JAX in double precision for this file alone."""
    with jax.enable_x64(True):
        yield


class Trajectory(NamedTuple):
    reward: Array
    value: Array
    next_value: Array
    terminated: Array
    truncated: Array
    rho: Array


def trajectory(seed: int, end_rate: float = 0.15) -> Trajectory:
    """T random steps; each ends by termination, by truncation, or both, with probability `end_rate` of each."""
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.uniform(size=(2, T)) < end_rate
    value, final_value = rng.normal(size=(2, T))
    next_value = np.append(value[1:], final_value[-1])
    return Trajectory(
        reward=rng.normal(size=T),
        value=value,
        next_value=np.where(terminated | truncated, final_value, next_value),
        terminated=terminated,
        truncated=truncated,
        rho=np.exp(0.7 * rng.normal(size=T)),
    )


def on_policy(seed: int, end_rate: float = 0.15) -> Trajectory:
    """The same with pi = mu."""
    return trajectory(seed, end_rate)._replace(rho=np.ones(T))


def ours(steps: Trajectory, lam: float = 1.0, rho_bar: float = 1.0, c_bar: float = 1.0) -> Trace:
    """V-trace by qrl at this file's gamma."""
    return our_vtrace(*map(jnp.asarray, steps), gamma=GAMMA, lam=lam, rho_bar=rho_bar, c_bar=c_bar)


def as_rlax(steps: Trajectory) -> tuple[Array, Array]:
    """Reward and discount for rlax, whose bootstrap is its own next target: a truncation pays V(s') as reward."""
    reward = steps.reward + GAMMA * (steps.truncated & ~steps.terminated) * steps.next_value
    return reward, GAMMA * (1.0 - steps.terminated) * (1.0 - steps.truncated)


def episode_end(steps: Trajectory, start: int) -> int:
    """One past the last step of the episode that step `start` is in."""
    ends = np.flatnonzero((steps.terminated | steps.truncated)[start:])
    return start + ends[0] + 1 if len(ends) else T


def td_error(steps: Trajectory) -> Array:
    """TD error [T], r + gamma·V(s') − V(s), with V(s') zero after a termination."""
    return steps.reward + GAMMA * np.where(steps.terminated, 0.0, steps.next_value) - steps.value


def algorithm_1(steps: Trajectory) -> tuple[list[float], list[float]]:
    """The paper's Algorithm 1 as printed, on one trajectory without ends: A^trace and V^trace."""
    a_trace, v_trace, tmp_a = [0.0] * T, [0.0] * T, 0.0
    v = [*steps.value, steps.next_value[-1]]
    for i in range(T - 1, -1, -1):
        a_trace[i] = (steps.reward[i] + GAMMA * v[i + 1] - v[i]) + GAMMA * tmp_a
        tmp_a = min(1.0, steps.rho[i]) * a_trace[i]
        v_trace[i] = v[i] + tmp_a
    return a_trace, v_trace


@each_rho_bar
@each_lam
@each_seed
def test_a_trace_is_rlax_q_estimate_less_v(seed: int, lam: float, rho_bar: float) -> None:
    """Sec. 4, A^trace; rlax's `pg_advantage` carries one more min(1, rho), so it is not compared."""
    steps = trajectory(seed)
    reward, discount = as_rlax(steps)
    theirs = rlax_vtrace(steps.value, steps.next_value, reward, discount, steps.rho, lam, rho_bar)
    np.testing.assert_allclose(ours(steps, lam, rho_bar).a_trace, theirs.q_estimate - steps.value, atol=1e-12)


@each_rho_bar
@each_lam
@each_seed
def test_v_trace_is_rlax_errors_plus_v(seed: int, lam: float, rho_bar: float) -> None:
    """Sec. 4, V^trace; rlax fixes c_bar at 1."""
    steps = trajectory(seed)
    reward, discount = as_rlax(steps)
    theirs = rlax_vtrace(steps.value, steps.next_value, reward, discount, steps.rho, lam, rho_bar)
    np.testing.assert_allclose(ours(steps, lam, rho_bar).v_trace, theirs.errors + steps.value, atol=1e-12)


@each_seed
def test_vtrace_is_algorithm_1(seed: int) -> None:
    """Algorithm 1 of the paper, both outputs."""
    steps = trajectory(seed, end_rate=0.0)
    a_trace, v_trace = algorithm_1(steps)
    np.testing.assert_allclose(ours(steps).a_trace, a_trace, atol=1e-12)
    np.testing.assert_allclose(ours(steps).v_trace, v_trace, atol=1e-12)


@pytest.mark.parametrize("c_bar", [0.3, 1.0, 3.0])
@each_rho_bar
@each_lam
def test_v_trace_is_impalas_sum_within_the_episode(lam: float, rho_bar: float, c_bar: float) -> None:
    """IMPALA, eq. 1 with c_i = lambda·min(c_bar, rho_i), its sum stopped at the end of the episode."""
    steps = trajectory(seed=0)
    delta, clipped, c = td_error(steps), np.minimum(rho_bar, steps.rho), lam * np.minimum(c_bar, steps.rho)
    expected = [
        steps.value[s]
        + sum(GAMMA ** (t - s) * np.prod(c[s:t]) * clipped[t] * delta[t] for t in range(s, episode_end(steps, s)))
        for s in range(T)
    ]
    np.testing.assert_allclose(ours(steps, lam, rho_bar, c_bar).v_trace, expected, atol=1e-12)


@each_lam
@each_seed
def test_on_policy_both_outputs_are_gae(seed: int, lam: float) -> None:
    """Schulman et al. 2015, eq. 16: the sum of (gamma·lambda)^l delta_{t+l}, stopped at the end of the episode."""
    steps = on_policy(seed)
    delta = td_error(steps)
    gae = [sum((GAMMA * lam) ** (i - t) * delta[i] for i in range(t, episode_end(steps, t))) for t in range(T)]
    np.testing.assert_allclose(ours(steps, lam).a_trace, gae, atol=1e-12)
    np.testing.assert_allclose(ours(steps, lam).v_trace, steps.value + gae, atol=1e-12)


@each_lam
@each_seed
def test_on_policy_a_trace_is_rlax_gae(seed: int, lam: float) -> None:
    """The same eq. 16, as rlax writes it."""
    steps = on_policy(seed)
    reward, discount = as_rlax(steps)
    theirs = rlax_gae(reward, discount, lam, np.append(steps.value, steps.next_value[-1]))
    np.testing.assert_allclose(ours(steps, lam).a_trace, theirs, atol=1e-12)


@each_seed
def test_on_policy_v_trace_is_the_discounted_return(seed: int) -> None:
    """Monte Carlo return of the rest of the episode, with V(s') unless it terminates, at lambda = 1 and pi = mu."""
    steps = on_policy(seed)
    expected = []
    for t in range(T):
        last = episode_end(steps, t) - 1
        bootstrap = 0.0 if steps.terminated[last] else steps.next_value[last]
        rewards = [*steps.reward[t : last + 1], bootstrap]
        expected.append(sum(GAMMA**k * r for k, r in enumerate(rewards)))
    np.testing.assert_allclose(ours(steps).v_trace, expected, atol=1e-12)


@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_trace_does_not_leak_over_an_end(flag: str) -> None:
    """Nothing after an end changes any output up to it, to the last bit; without the end it would."""
    end, steps, other = 20, trajectory(0, end_rate=0.0), trajectory(1, end_rate=0.0)
    after = np.arange(T) > end

    def swapped(steps: Trajectory) -> Trajectory:
        return steps._replace(
            **{name: np.where(after, getattr(other, name), getattr(steps, name)) for name in ("reward", "value", "rho")}
        )

    ended = steps._replace(**{flag: np.arange(T) == end})
    for before, changed in zip(ours(ended), ours(swapped(ended)), strict=True):
        np.testing.assert_array_equal(before[: end + 1], changed[: end + 1])
        assert (before[end + 1 :] != changed[end + 1 :]).all()
    assert (ours(steps).v_trace[: end + 1] != ours(swapped(steps)).v_trace[: end + 1]).any()


@pytest.mark.parametrize("steps", [1, 2, 3, 31, 32, 33, 64])
def test_each_number_of_steps(steps: int) -> None:
    """x_i = b_i + a_i·x_{i+1} by a loop, whatever the number of steps."""
    a, b = np.random.default_rng(steps).uniform(0.0, 1.5, size=(2, steps))
    expected, x = np.zeros(steps), 0.0
    for i in reversed(range(steps)):
        expected[i] = x = b[i] + a[i] * x
    np.testing.assert_allclose(linear_recurrence(jnp.asarray(a), jnp.asarray(b)), expected, rtol=1e-12)


def test_a_product_of_ratios_may_overflow() -> None:
    """Importance ratios without clips, whose product is beyond float32, change nothing where every error is zero."""
    zeros, big = np.zeros(T, np.float32), np.float32(1e30)
    steps = Trajectory(zeros, zeros, zeros, zeros, zeros, np.full(T, big))
    for output in ours(steps, rho_bar=big, c_bar=big):
        np.testing.assert_array_equal(output, zeros)


@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_what_overflows_after_an_end_stays_there(flag: str) -> None:
    """Without clips; what precedes the end is what it is with ratios of 1 after it."""
    end, big = 20, np.float32(1e30)
    ended = trajectory(0, end_rate=0.0)._replace(**{flag: np.arange(T) == end})
    outputs = []
    for ratio in (1.0, big):
        rho = np.where(np.arange(T) > end, ratio, ended.rho)
        single = Trajectory(*(x.astype(np.float32) for x in ended._replace(rho=rho)))
        outputs.append(ours(single, rho_bar=big, c_bar=big))
    for expected, found in zip(*outputs, strict=True):
        assert not np.isfinite(found[end + 1 :]).all()
        np.testing.assert_array_equal(found[: end + 1], expected[: end + 1])


@pytest.mark.parametrize(("flag", "share"), [("terminated", 0.0), ("truncated", GAMMA)])
def test_bootstrap_follows_a_truncation_and_not_a_termination(flag: str, share: float) -> None:
    """Partial-episode bootstrapping (Pardo et al. 2018): one more V(s') at the end adds gamma there, or nothing."""
    end, steps = 20, trajectory(0, end_rate=0.0)
    at_end = np.arange(T) == end
    ended = steps._replace(**{flag: at_end})
    richer = ended._replace(next_value=ended.next_value + at_end)
    assert ours(richer).a_trace[end] - ours(ended).a_trace[end] == pytest.approx(share, abs=1e-14)


@pytest.mark.parametrize("flags", [np.bool_, np.float32])
@pytest.mark.parametrize(("dtype", "x64"), [(np.float64, True), (np.float32, True), (np.float32, False)])
def test_dtype_is_kept(dtype: type[np.floating], x64: bool, flags: type[np.generic]) -> None:
    """float32 in, float32 out, also where JAX allows float64; flags may be booleans or numbers; values agree."""
    exact, steps = ours(trajectory(0)), trajectory(0)
    cast = Trajectory(*(x.astype(flags if x.dtype == bool else dtype) for x in steps))
    with jax.enable_x64(x64):
        for output, expected in zip(ours(cast), exact, strict=True):
            assert output.dtype == dtype
            np.testing.assert_allclose(output, expected, atol=100 * float(np.finfo(dtype).eps))

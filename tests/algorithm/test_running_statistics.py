"""Running statistics against NumPy's over everything at once, and Brax's normalizer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics as brax_statistics
from hypothesis import given
from hypothesis import strategies as st

from qrl.algorithm.running_statistics import MIN_STD, init, std, update

F = 3

update_ours, update_theirs = jax.jit(update), jax.jit(brax_statistics.update)


def batches(sizes: list[int], offset: float = 3.0) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [offset * i + (1 + i) * random.normal(size=(n, F)).astype(np.float32) for i, n in enumerate(sizes)]


@given(st.lists(st.sampled_from([1, 2, 7, 40]), min_size=1, max_size=6))
def test_batch_by_batch_is_all_at_once(sizes: list[int]) -> None:
    """However the observations are parted; Brax's, by sums of squares, agrees."""
    parts = batches(sizes)
    ours, theirs = init(F), brax_statistics.init_state(jnp.zeros(F))
    for part in parts:
        ours, theirs = update_ours(ours, part), update_theirs(theirs, part)
    whole = np.concatenate(parts).astype(np.float64)
    assert ours.n == len(whole)
    np.testing.assert_allclose(ours.mean, whole.mean(axis=0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(ours.variance, whole.var(axis=0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(std(ours), np.maximum(theirs.std, MIN_STD), rtol=1e-3, atol=1e-3)


def test_far_from_zero_the_variance_keeps_its_digits() -> None:
    """1,000 ± 1, which squares of float32 would not tell from 0."""
    parts = [1000.0 + np.random.default_rng(i).normal(size=(50, F)).astype(np.float32) for i in range(20)]
    ours = init(F)
    for part in parts:
        ours = update_ours(ours, part)
    np.testing.assert_allclose(ours.variance, np.concatenate(parts).astype(np.float64).var(axis=0), rtol=1e-3)


def test_a_first_batch_that_hardly_varies_is_known_exactly() -> None:
    """The variance of 1 before it must not round it away."""
    batch = 1e-4 * np.random.default_rng(0).normal(size=(50, F)).astype(np.float32)
    np.testing.assert_allclose(
        std(update(init(F), jnp.asarray(batch))),
        batch.std(axis=0),
        rtol=1e-5,
    )


def test_before_the_first_nothing_is_scaled() -> None:
    assert init(F).n == 0
    np.testing.assert_array_equal(init(F).mean, np.zeros(F))
    np.testing.assert_array_equal(std(init(F)), np.ones(F))


def test_a_feature_that_does_not_vary_is_divided_by_no_zero() -> None:
    still = update(init(F), jnp.ones((10, F)))
    np.testing.assert_array_equal(std(still), np.full(F, MIN_STD, np.float32))


@pytest.mark.parametrize("parts", [1, 2, 5])
def test_parts_of_a_batch_on_each_device(parts: int) -> None:
    """As the whole batch on one; each device is told the same."""
    whole = jnp.asarray(batches([30])[0])
    before = update(init(F), whole + 1.0)
    each = jax.vmap(lambda part: update(before, part, "device"), axis_name="device")(whole.reshape(parts, -1, F))
    for ours, one in zip(each, update(before, whole), strict=True):
        for device in ours:
            np.testing.assert_allclose(device, one, rtol=1e-6)

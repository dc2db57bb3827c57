"""The integer policy stands close to the float one, and whatever policy there is gets one or a clear no."""

from dataclasses import replace

import numpy as np
import pytest

import policies
from policies import FLAT, HOVER, ODD, PENDULUM
from qrl.export.kernel import INT16, AccumulatorOverflow, Kernel
from qrl.export.policy import ACTIVATIONS, Policy
from qrl.export.quantize import UnsupportedNetwork, quantize, si_layers

ALL = [(sizes, activation) for sizes in (HOVER, PENDULUM, ODD, FLAT) for activation in ("relu", "tanh")]
EACH_POLICY = pytest.mark.parametrize(("sizes", "activation"), ALL, ids=str)


def full_scales(policy: Policy, action: np.ndarray, observations: np.ndarray) -> np.ndarray:
    """Error of actions, by the formula written in policies.py and not by Policy."""
    low, high = policy.limits
    a = policies.outputs(policy, observations) * [port.scale for port in policy.actions]
    wanted = np.clip(a + [port.offset for port in policy.actions], low, high)
    return (action - wanted) / (high - low)


def rmse(error: np.ndarray) -> float:
    return float((error**2).mean() ** 0.5)


def fresh(sizes: tuple[int, ...], n: int = 3000) -> np.ndarray:
    """Flights that nothing was calibrated on."""
    return policies.policy(sizes, seed=0, samples=n + 1).calibration


@EACH_POLICY
def test_policy_is_the_formula(sizes: tuple[int, ...], activation: str) -> None:
    policy = policies.policy(sizes, activation)
    observations = 3.0 * policy.calibration  # far enough for the clip of normalized observations
    np.testing.assert_allclose(full_scales(policy, policy(observations), observations), 0.0, atol=1e-12)


@EACH_POLICY
def test_everything_is_folded_into_si_units(sizes: tuple[int, ...], activation: str) -> None:
    """Offset, gain and scale of observations and of actions: what is left are layers from SI to SI."""
    policy = policies.policy(sizes, activation)
    low, high = policy.limits
    x, layers = policy.calibration.astype(float), si_layers(policy)
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if i < len(layers) - 1:
            x = ACTIVATIONS[activation](x)
    np.testing.assert_allclose(full_scales(policy, np.clip(x, low, high), policy.calibration), 0.0, atol=1e-9)


def rounded_to_nearest(policy: Policy, *, by_row: bool) -> np.ndarray:
    """Actions with int8 weights rounded to nearest, one scale a row or one a tensor, and all else in float."""
    x, layers, (low, high) = policy.calibration.astype(float), si_layers(policy), policy.limits
    for i, (weight, bias) in enumerate(layers):
        scale = np.abs(weight).max(axis=0 if by_row else None) / 127
        x = x @ (np.round(weight / scale) * scale) + bias
        if i < len(layers) - 1:
            x = ACTIVATIONS[policy.activation](x)
    return np.clip(x, low, high)


@EACH_POLICY
def test_integers_are_close_to_float(sizes: tuple[int, ...], activation: str) -> None:
    """Well within the bars, and clearly better than rounding to nearest."""
    policy, kernel = policies.policy(sizes, activation), policies.kernel(sizes, activation)
    error = full_scales(policy, policies.step(kernel, policy.calibration)[1], policy.calibration)
    assert rmse(error) <= 0.003
    assert np.abs(error).max() <= 0.025
    by_row, by_tensor = (
        rmse(full_scales(policy, rounded_to_nearest(policy, by_row=way), policy.calibration)) for way in (True, False)
    )
    assert rmse(error) < 0.67 * by_row
    assert rmse(error) < 0.5 * by_tensor


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_integers_are_close_on_flights_not_calibrated_on(activation: str) -> None:
    policy, kernel = policies.policy(HOVER, activation), policies.kernel(HOVER, activation)
    observations = fresh(HOVER)
    status, action = policies.step(kernel, observations)
    within = status == 0
    assert within.mean() > 0.99
    error = full_scales(policy, action[within], observations[within])
    assert rmse(error) <= 0.003
    assert np.abs(error).max() <= 0.025


@EACH_POLICY
def test_ranges_cover_the_flights(sizes: tuple[int, ...], activation: str) -> None:
    """No observation that was met is clipped, and each has at least 9 bits of its range."""
    policy, kernel = policies.policy(sizes, activation), policies.kernel(sizes, activation)
    assert (kernel.obs_max * kernel.lsb >= policy.calibration.max(axis=0)).all()
    assert (kernel.obs_min * kernel.lsb <= policy.calibration.min(axis=0)).all()
    reach = np.maximum(-kernel.obs_min, kernel.obs_max)
    assert ((reach >= 500) & (reach <= INT16)).all()
    assert not policies.step(kernel, policy.calibration)[0].any()


def test_integers_fit_their_types() -> None:
    for sizes, activation in ALL:
        kernel = policies.kernel(sizes, activation)
        assert kernel.scale.min() >= 2**15
        assert kernel.scale.max() < 2**16
        for layer in kernel.layers:
            assert np.abs(layer.weight).max() <= 127
            assert np.abs(layer.bias).max() < 2**31
            assert layer.multiplier.min() > 0
            assert layer.multiplier.max() < 2**15
            assert 0 <= layer.shift <= 15


def arrays(kernel: Kernel) -> list[np.ndarray]:
    layers = [x for layer in kernel.layers for x in (layer.weight, layer.bias, layer.multiplier, np.array(layer.shift))]
    rest = [kernel.scale, kernel.exponent, kernel.obs_min, kernel.obs_max, kernel.act_lsb]
    return [*layers, *rest, kernel.act_min, kernel.act_max, kernel.act_safe]


@pytest.mark.parametrize("sizes", [PENDULUM, ODD], ids=str)
def test_the_same_bits_twice(sizes: tuple[int, ...]) -> None:
    first, second = policies.kernel(sizes), quantize(policies.policy(sizes))
    for one, other in zip(arrays(first), arrays(second), strict=True):
        np.testing.assert_array_equal(one, other)


@EACH_POLICY
def test_actions_stay_within_their_limits(sizes: tuple[int, ...], activation: str) -> None:
    """Whatever is observed, and the limits are there in full."""
    policy, kernel = policies.policy(sizes, activation), policies.kernel(sizes, activation)
    rng = np.random.default_rng(0)
    corners = np.where(rng.random((4000, sizes[0])) < 0.5, kernel.obs_min, kernel.obs_max) * kernel.lsb
    wild = (corners * rng.uniform(0, 2, (4000, 1))).astype(np.float32)
    action = policies.step(kernel, wild)[1]
    low, high = policy.limits
    assert (action >= low - 0.5 * kernel.act_lsb).all()
    assert (action <= high + 0.5 * kernel.act_lsb).all()
    for steps, limit in ((kernel.act_min, low), (kernel.act_max, high)):
        np.testing.assert_allclose(steps * kernel.act_lsb, limit, rtol=0, atol=0.51 * kernel.act_lsb.max())


def test_the_safe_action_is_the_answer_to_no_number() -> None:
    kernel = policies.kernel(HOVER)
    observations = fresh(HOVER)[:36].copy()
    for i in range(36):
        observations[i, i % 18] = (np.nan, -np.inf)[i // 18]
    status, action = policies.step(kernel, observations)
    assert (status == 2).all()
    np.testing.assert_allclose(action, 0.667 * 9.81 / 4, rtol=1e-3)


# -- what is hard to express ---------------------------------------------------------------------------------


def altered(sizes: tuple[int, ...], layer: int, **changes: np.ndarray) -> Policy:
    """The policy with a layer's weight or bias replaced."""
    policy = policies.policy(sizes)
    layers = list(policy.layers)
    weight, bias = layers[layer]
    layers[layer] = changes.get("weight", weight), changes.get("bias", bias)
    return replace(policy, layers=tuple(layers))


def test_an_unknown_activation_is_refused() -> None:
    with pytest.raises(UnsupportedNetwork, match="activation 'gelu': expected one of relu, tanh"):
        quantize(replace(policies.policy(ODD), activation="gelu"))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("what", ["weight", "bias"])
def test_a_weight_that_is_not_finite_is_refused(what: str, value: float) -> None:
    for layer in range(3):
        changed = policies.policy(ODD).layers[layer][what == "bias"].copy()
        changed.flat[-1] = value
        with pytest.raises(UnsupportedNetwork, match=f"layer {layer}: a weight is not finite"):
            quantize(altered(ODD, layer, **{what: changed}))


@pytest.mark.parametrize("observations", [np.zeros((0, 5)), np.full((3, 5), np.nan)], ids=["none", "NaN"])
def test_no_flight_to_calibrate_on_is_refused(observations: np.ndarray) -> None:
    with pytest.raises(UnsupportedNetwork, match="no finite flight"):
        quantize(replace(policies.policy(ODD), calibration=observations.astype(np.float32)))


def assert_close(policy: Policy, worst: float = 0.05) -> None:
    kernel = quantize(policy)
    error = full_scales(policy, policies.step(kernel, policy.calibration)[1], policy.calibration)
    assert np.abs(error).max() <= worst


@pytest.mark.parametrize("layer", [0, 1, 2])
@pytest.mark.parametrize("bias", [0.0, 0.5, -0.5])
def test_a_dead_row(layer: int, bias: float) -> None:
    """An output whose weights are all zero is its bias."""
    weight, biases = (x.copy() for x in policies.policy(ODD).layers[layer])
    weight[:, 0], biases[0] = 0.0, bias
    assert_close(altered(ODD, layer, weight=weight, bias=biases))


@pytest.mark.parametrize("value", [0.0, 1.0, -1e-3])
@pytest.mark.parametrize("sizes", [ODD, FLAT], ids=str)
def test_an_observation_that_never_changes(sizes: tuple[int, ...], value: float) -> None:
    calibration = policies.policy(sizes).calibration.copy()
    calibration[:, 1] = value
    assert_close(replace(policies.policy(sizes), calibration=calibration))


def test_weights_of_zero_only() -> None:
    """An untrained last layer, say."""
    weight, bias = policies.policy(ODD).layers[2]
    assert_close(altered(ODD, 2, weight=0 * weight, bias=0 * bias))


def test_a_column_of_zeros() -> None:
    """An observation, or a neuron, that nobody looks at."""
    for layer in range(3):
        weight = policies.policy(ODD).layers[layer][0].copy()
        weight[0] = 0.0
        assert_close(altered(ODD, layer, weight=weight))


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("sizes", [ODD, FLAT], ids=str)
def test_hardly_any_flight(sizes: tuple[int, ...], samples: int) -> None:
    policy = policies.policy(sizes)
    assert_close(replace(policy, calibration=policy.calibration[:samples]))


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_weights_of_any_size(factor: float) -> None:
    """A first layer that a second one makes good again."""
    policy = policies.policy(ODD)
    (first, bias), (second, after), last = policy.layers
    assert_close(replace(policy, layers=((first * factor, bias * factor), (second / factor, after), last)))


def test_a_layer_too_wide_for_32_bits_is_refused() -> None:
    rng = np.random.default_rng(0)
    policy = policies.policy(ODD)
    layers = (
        (rng.choice([-1.0, 1.0], (5, 700)), rng.normal(size=700)),
        (rng.choice([-1.0, 1.0], (700, 2)) / 30, np.zeros(2)),
    )
    with pytest.raises(AccumulatorOverflow, match="layer 1"):
        quantize(replace(policy, layers=layers, calibration=policy.calibration[:100]))

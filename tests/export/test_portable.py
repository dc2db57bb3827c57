"""The float policy in ONNX, run by ONNX's own reference evaluator, and in NumPy arrays."""

import io

import numpy as np
import onnx
import pytest
from onnx.reference import ReferenceEvaluator

import policies
from policies import HOVER, ODD, PENDULUM, REMEMBERING
from qrl.export import portable
from qrl.export.policy import Policy

STEPS, FLIGHTS = 150, 3


def evaluator(policy: Policy) -> ReferenceEvaluator:
    return ReferenceEvaluator(onnx.load_from_string(portable.onnx_model(policy)))


@pytest.mark.parametrize("sizes", [HOVER, PENDULUM, ODD], ids=["hover", "pendulum", "odd"])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_a_policy_without_memory(sizes: tuple[int, ...], activation: str) -> None:
    policy = policies.policy(sizes, activation)
    (action,) = evaluator(policy).run(None, {"observation": policy.calibration})
    assert np.asarray(action).dtype == np.float32
    np.testing.assert_allclose(action, policy(policy.calibration), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("which", REMEMBERING)
def test_a_policy_with_memory_over_flights(which: str) -> None:
    policy = policies.remembering(which)
    graph, memory = evaluator(policy), policy.initial_memory(FLIGHTS)
    given, moved = memory.astype(np.float32), 0.0
    for t in range(STEPS):
        rows = np.arange(FLIGHTS) * STEPS + t
        observation = policy.calibration[rows, : len(policy.observations)]
        action, given = graph.run(["action", "next_memory"], {"observation": observation, "memory": given})
        after, wanted = policy.step(memory, observation)
        np.testing.assert_allclose(action, wanted, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(given, after, rtol=1e-3, atol=1e-3)
        moved, memory = moved + np.abs(after - memory).mean(), after
    assert moved > 0.01 * STEPS * np.abs(memory).mean()


def test_the_model_says_what_it_takes() -> None:
    policy = policies.remembering("both")
    model = onnx.load_from_string(portable.onnx_model(policy))
    assert [port.name for port in model.graph.input] == ["observation", "memory"]
    assert [port.name for port in model.graph.output] == ["action", "next_memory"]
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["observation"].split() == [port.name for port in policy.observations]
    assert about["control_period_s"] == f"{policy.control_period_s:g}"


def test_the_same_policy_gives_the_same_bytes() -> None:
    policy = policies.remembering("recurrent")
    assert portable.onnx_model(policy) == portable.onnx_model(policy)
    assert portable.arrays(policy) == portable.arrays(policy)


def test_arrays_are_the_policys() -> None:
    """The network by hand, from the file alone."""
    policy = policies.policy(HOVER, "relu")
    with np.load(io.BytesIO(portable.arrays(policy))) as found:
        x = (policy.calibration - found["observation_offset"]) * found["observation_gain"]
        x = np.clip(x, -found["observation_clip"], found["observation_clip"]) * found["observation_scale"]
        layers = sorted(name for name in found if name.endswith("_weight"))
        for name in layers:
            x = x @ found[name] + found[name.replace("weight", "bias")]
            x = x if name == layers[-1] else np.maximum(x, 0.0)
        action = np.clip(found["action_offset"] + found["action_scale"] * x, *found["action_limits"])
    np.testing.assert_allclose(action, policy(policy.calibration), rtol=1e-4, atol=1e-5)


def test_a_recurrent_policys_arrays_have_its_unit() -> None:
    policy = policies.remembering("recurrent")
    assert policy.unit
    with np.load(io.BytesIO(portable.arrays(policy))) as found:
        for name, layer in (("unit_of_input", policy.unit.of_input), ("unit_of_memory", policy.unit.of_memory)):
            np.testing.assert_array_equal(found[f"{name}_weight"], layer[0].astype(np.float32))
            np.testing.assert_array_equal(found[f"{name}_bias"], layer[1].astype(np.float32))

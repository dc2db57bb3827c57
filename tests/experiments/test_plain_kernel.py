"""What the kernel is compared with is the same network, in float32 and in naive int8, on the host and on a core."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cross_targets import EITHER
from experiments.kernel import plain
from qrl.export import targets
from qrl.export.targets import RELEASE, Core
from qrl.export.vectors import Observations


def network(rng: np.random.Generator, *widths: int) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(rng.normal(size=(i, o)) / i**0.5, 0.1 * rng.normal(size=o)) for i, o in pairwise(widths)]


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@EITHER
def test_the_plain_kernels_are_the_network(core: Core | None, activation: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    layers, obs = network(rng, 18, 24, 16, 4), rng.normal(size=(40, 18))
    kernel = plain.write(tmp_path / "kernel", layers, activation, obs)
    int8 = plain.naive(layers, activation, obs)
    obs_i16 = plain.to_int8(int8, obs)
    given = Observations(obs, obs_i16)
    if core is None:
        run = targets.run_host(kernel, tmp_path, RELEASE, given, plain.LIBRARIES)
    else:
        run, _ = targets.run_core(core, kernel, tmp_path, RELEASE, given, plain.LIBRARIES)
    act = obs
    for weight, bias in layers[:-1]:
        act = np.tanh(act @ weight + bias) if activation == "tanh" else np.maximum(act @ weight + bias, 0)
    act = act @ layers[-1][0] + layers[-1][1]
    np.testing.assert_allclose(run.act, act, atol=2e-6)
    np.testing.assert_array_equal(run.act_i16, plain.infer(int8, obs_i16))
    assert np.abs(run.act_i16 * int8.act_scale - act).mean() < 0.02 * np.abs(act).max()

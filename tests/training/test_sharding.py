"""Over several devices a run is what it is on one: the same lanes, the same minibatches, sums to rounding."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import once
from qrl.config import Config, load_preset
from qrl.training.sharding import make_mesh

TOLERANCE = 1e-5  # of everything after ten updates, absolute and relative
FLIGHT_TOLERANCE = 1e-2  # of flights, in which a difference grows
FLIGHTS = "[1].observations"  # [members, starts, steps, ...]
FLIGHT_STEPS = 100  # of 200: a pendulum that just turns over or just does not parts the two
Values = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Values]:
    """What `on_devices` leaves, by "SEEDS-DEVICES"."""
    out = once.made_once(tmp_path_factory, "on devices", train_on_devices)
    return {path.stem: dict(np.load(path)) for path in out.glob("*.npz")}


def train_on_devices(out: Path) -> None:
    program = Path(__file__).parents[1] / "helpers" / "on_devices.py"
    env = os.environ | {"JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, program, out], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def of_training(values: Values) -> Values:
    """Without what only says when starts were drawn, which a lane's neighbors decide, and the ends of flights."""
    idle = (".lanes.next_state_used", ".lanes.next_state", ".lanes.reset_count")
    values = {name: x for name, x in values.items() if not any(part in name for part in idle)}
    return {name: x[:, :, :FLIGHT_STEPS] if name == FLIGHTS else x for name, x in values.items()}


def assert_same(ours: Values, expected: Values) -> None:
    assert ours.keys() == expected.keys()
    for name, x in ours.items():
        if x.dtype.kind in "iub":
            np.testing.assert_array_equal(x, expected[name], err_msg=name)
        else:
            tolerance = FLIGHT_TOLERANCE if name.startswith("[1]") else TOLERANCE
            np.testing.assert_allclose(x, expected[name], rtol=tolerance, atol=tolerance, err_msg=name)


def test_ten_updates_over_several_devices_are_those_of_one(trained: dict[str, Values]) -> None:
    """State, ring, lanes, sums and flights; counts exactly."""
    one = trained["1-1"]
    assert one["[0].learner.updates"] == 10
    assert_same(of_training(trained["1-4"]), of_training(one))


def test_members_part_first(trained: dict[str, Values]) -> None:
    """Two seeds over four devices, two each: the first is the single run of its seed, the second another."""
    both, one = of_training(trained["2-4"]), of_training(trained["1-1"])
    assert_same({name: x[:1] for name, x in both.items()}, one)
    parameters = "[0].learner.params.policy['params']['Dense_0']['kernel']"
    assert np.abs(both[parameters][1] - both[parameters][0]).max() > 0.01


def test_what_one_device_saved_goes_on_over_several(trained: dict[str, Values]) -> None:
    """Five updates further, as on one."""
    assert_same(of_training(trained["further-4"]), of_training(trained["further-1"]))


def test_flights_of_the_analytic_gradient_are_shared(trained: dict[str, Values]) -> None:
    """Three of its updates, as on one device."""
    assert trained["polished-1"][".learner.updates"] == 13
    assert_same(of_training(trained["polished-4"]), of_training(trained["polished-1"]))


@pytest.mark.parametrize(
    ("devices", "members", "shards", "shape"),
    [
        (1, 1, 8, None),
        (8, 1, 8, (1, 8)),
        (3, 1, 8, (1, 2)),  # one is left over
        (8, 5, 8, (1, 8)),
        (8, 4, 8, (4, 2)),
        (6, 4, 8, (4, 1)),
        (5, 5, 1, (5, 1)),
        (7, 1, 1, None),
    ],
)
def test_devices_are_shared_evenly(devices: int, members: int, shards: int, shape: tuple[int, int] | None) -> None:
    """As many as members, and then shards, can be dealt out to in equal parts."""
    mesh = make_mesh(jax.devices() * devices, members, shards)
    assert (tuple(mesh.shape.values()) if mesh else None) == shape


@pytest.mark.parametrize(("lanes", "batch_size", "shards"), [(64, 8, 8), (16, 16, 8), (4, 2, 2), (12, 6, 2), (9, 5, 1)])
def test_shards_are_eight_or_what_divides(lanes: int, batch_size: int, shards: int) -> None:
    config = Config.model_validate(load_preset("default") | {"num_envs": lanes, "batch_size": batch_size}, strict=False)
    assert config.shard_count == shards

"""The checkpoint for PX4's mc_raptor: its layout, and that its numbers are the policy's, read as RLtools reads them.

`experiments.firmware.px4` has PX4's own source load and fly it.
"""

import io
import struct
import tarfile
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import policies
from qrl.export.firmware import px4
from qrl.export.policy import ActionSpec, BodyFrame, Integral, Memory, Policy
from qrl_envs import io_spec
from qrl_envs import task as tasks

# Of RAPTOR's own file (github.com/rl-tools/px4-blob, 4f31fc9): every entry with data, and its dimensions.
SHAPES = {
    "actor/layers/0/weights/parameters": (16, 22),
    "actor/layers/0/biases/parameters": (16,),
    "actor/layers/1/weights_input/parameters": (48, 16),
    "actor/layers/1/biases_input/parameters": (48,),
    "actor/layers/1/weights_hidden/parameters": (48, 16),
    "actor/layers/1/biases_hidden/parameters": (48,),
    "actor/layers/1/initial_hidden_state/parameters": (16,),
    "actor/layers/2/weights/parameters": (4, 16),
    "actor/layers/2/biases/parameters": (4,),
    "example/input": (500, 2, 22),
    "example/output": (500, 2, 4),
}
RAPTOR = ["FR", "BR", "BL", "FL"]  # its motors
KERNEL = {"x.c": "", "x.h": ""}
CORNERS = {(1, -1): "FR", (-1, -1): "BR", (-1, 1): "BL", (1, 1): "FL"}  # signs of x forward, y left


@cache
def shaped(seed: int = 0) -> Policy:
    """A lively policy of RAPTOR's shape."""
    base = policies.policy((18, 16, 4), seed=seed)
    rng = np.random.default_rng(seed)
    ports = tuple(ActionSpec(**port._asdict()) for port in io_spec.actions(tasks.load("raptor")))
    (weight, bias), (last, last_bias) = base.layers
    scale = np.concatenate([np.ones(9), [2.0] * 3, [1.0] * 3, [0.25] * 3, rng.uniform(0.5, 1.0, 4)])
    made = replace(
        base,
        actions=ports,
        memory=Memory(True, None, units=16),
        unit=policies.gated_unit(rng, 16, 16),
        observation_offset=np.concatenate([np.zeros(18), [0.4, 0.5, 0.5, 0.6]]),
        observation_gain=np.concatenate([np.ones(18), [2.0, 1.5, 2.0, 2.0]]),
        observation_scale=scale,
        observation_clip=np.repeat([np.inf, 0.5, 1.0, np.inf], [9, 3, 3, 7]),
        layers=((np.concatenate([weight, rng.normal(size=(4, 16))]), bias), (2.0 * last, last_bias)),
        calibration=np.concatenate([base.calibration, rng.uniform(size=(1500, 4))], axis=1).astype(np.float32),
    )
    return replace(made, calibration=np.concatenate([made.calibration, np.zeros((1500, 16), np.float32)], axis=1))


def read(data: bytes) -> dict[str, bytes]:
    """Entries as RLtools finds them: blocks of 512 bytes, names of up to 100, sizes in octal, to zeros or the end."""
    found, at = {}, 0
    while at < len(data) and data[at] != 0:
        name, size, magic = struct.unpack("100s24x12s121x5s", data[at : at + 262])
        assert magic == b"ustar"
        size = int(size.rstrip(b"\0 "), 8)
        found[name.rstrip(b"\0").decode()] = data[at + 512 : at + 512 + size]
        at += 512 + -(-size // 512) * 512
    return found


def tensor(entries: dict[str, bytes], path: str) -> np.ndarray:
    lines = dict(line.split(": ") for line in entries[f"{path}/meta"].decode().splitlines())
    assert (lines.pop("type"), lines.pop("dtype")) == ("tensor", "float32")
    shape = [int(lines[f"dim_{i}"]) for i in range(int(lines.pop("num_dims")))]
    assert len(lines) == len(shape)
    return np.frombuffer(entries[f"{path}/data"], "<f4").reshape(shape)


class Raptor:
    """The network as mc_raptor has it, in float32: dense, a unit in cuDNN's form with the gates r, z, n, dense."""

    def __init__(self, data: bytes) -> None:
        entries = read(data)
        self.w = {path: tensor(entries, path) for path in SHAPES}
        self.h = self.part(1, "initial_hidden_state")

    def part(self, layer: int, name: str) -> np.ndarray:
        return self.w[f"actor/layers/{layer}/{name}/parameters"]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        x = np.maximum(self.part(0, "weights") @ x + self.part(0, "biases"), 0.0)
        i = self.part(1, "weights_input") @ x + self.part(1, "biases_input")
        m = self.part(1, "weights_hidden") @ self.h + self.part(1, "biases_hidden")
        r, z = (1.0 / (1.0 + np.exp(-(i[at : at + 16] + m[at : at + 16]))) for at in (0, 16))
        self.h = z * self.h + (1.0 - z) * np.tanh(i[32:] + r * m[32:])
        return self.part(2, "weights") @ self.h + self.part(2, "biases")


def test_layout_is_that_of_raptors_own_file() -> None:
    data = px4.archive(shaped(), "a name\nof two lines" + "é" * 200)
    entries = read(data)
    assert {path: tensor(entries, path).shape for path in SHAPES} == SHAPES
    others = {name: text.decode() for name, text in entries.items() if name.rpartition("/")[0] not in SHAPES}
    first, kind = others.pop("actor/meta").splitlines()
    assert first.startswith("checkpoint_name: a name_of two lines_")
    assert len(first) < 120
    assert kind == "type: sequential"
    assert others == {
        "actor/layers/0/meta": "activation_function: RELU\ntype: dense\n",
        "actor/layers/1/meta": "type: gru\n",
        "actor/layers/2/meta": "activation_function: IDENTITY\ntype: dense\n",
    }
    # PX4 reads a tensor's meta data into 100 bytes with a terminator, those of the actor into 256.
    assert max(len(text) for name, text in entries.items() if name.endswith("meta")) < 100 + len(first)
    assert max(len(text) for name, text in entries.items() if name.endswith("/meta") and name != "actor/meta") < 100
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        assert {member.name: member.size for member in tar} == {name: len(text) for name, text in entries.items()}
    assert px4.archive(shaped(), "x") == px4.archive(shaped(), "x")


@pytest.mark.parametrize("places", [[0, 1, 2, 3], [2, 0, 3, 1]])
def test_outputs_are_the_policys_over_500_steps(places: list[int]) -> None:
    """With inputs and motors in RAPTOR's order, errors beyond what it clips, and the memory of both."""
    policy = replace(shaped(1), actions=tuple(shaped(1).actions[i] for i in places))
    corners = [CORNERS[tuple(np.sign(port.position_m).astype(int).tolist())] for port in policy.actions]
    order = [corners.index(name) for name in RAPTOR]
    network, previous, memory = Raptor(px4.archive(policy, "x")), np.zeros(4), policy.initial_memory(1)
    flights, moved = shaped(1).calibration[:500, :18], 0
    assert np.abs(flights[:, 9:12]).max() > 1.0
    for row in flights:
        memory, speed = policy.step(memory, row[None])
        p, v = np.clip(row[9:12], -0.5, 0.5), np.clip(row[12:15], -1.0, 1.0)
        x = np.concatenate([p, row[:9], v, row[15:18], previous]).astype(np.float32)
        previous = np.clip(network(x), -1.0, 1.0)
        np.testing.assert_allclose((previous + 1.0) / 2.0, speed[0, order], atol=1e-5)
        moved += np.ptp(previous) > 0.1
    assert moved > 400


def test_the_example_is_what_the_network_gives() -> None:
    data = px4.archive(shaped(), "x")
    x, y = (tensor(read(data), f"example/{name}") for name in ("input", "output"))
    assert np.isfinite(x).all()
    assert np.abs(x[..., :3]).max() == 0.5
    assert np.abs(x[..., 12:15]).max() == 1.0
    assert np.abs(x[..., 18:]).max() <= 1.0
    assert np.abs(y).max() > 1.0  # not clipped: PX4 compares before it clips
    for flight in range(2):
        network = Raptor(data)
        found = np.array([network(row) for row in x[:, flight]])
        assert np.abs(found - y[:, flight]).mean() < 1e-6


def test_refusals() -> None:
    good = shaped()
    assert px4.checkpoint_refusal(good) is None
    memory = good.memory
    assert memory
    first, last = good.layers
    thrusts = policies.policy().actions
    swapped = tuple(replace(port, spin=-(port.spin or 0)) for port in good.actions)
    clip = np.array(good.observation_clip)
    bad = [
        (replace(good, memory=replace(memory, integral=Integral((9, 10, 11), 0.5, 0.6))), "the inputs are not"),
        (replace(good, memory=replace(memory, previous_action=False)), "the inputs are not"),
        (replace(good, body_frame=BodyFrame(True, 0, 0)), "the inputs are not"),
        (replace(good, observations=good.observations[:15]), "the inputs are not"),
        (replace(good, layers=(first, (np.zeros((16, 16)), np.zeros(16)), last)), "the network is not"),
        (replace(good, memory=replace(memory, units=0), unit=None), "the network is not"),
        (replace(good, activation="tanh"), "the network is not"),
        (replace(good, actions=thrusts), "not rotor speeds"),
        (replace(good, control_period_s=0.02), "the control period is 20 ms"),
        (replace(good, observation_clip=np.inf), "inputs 10 to 12 are not clipped at 0.5"),
        (replace(good, observation_clip=np.where(clip == 1.0, 2.0, clip)), "inputs 13 to 15 are not clipped at 1"),
        (replace(good, observation_clip=np.where(np.arange(22) == 16, 9.0, clip)), "does not clip"),
        (replace(good, actions=swapped), "the motors are not"),
        (replace(good, actions=tuple(replace(port, axis=(0.0, 0.1, 0.995)) for port in good.actions)), "are tilted"),
    ]
    for policy, reason in bad:
        assert reason in (px4.checkpoint_refusal(policy) or "")
        assert f"px4/{px4.FILE}" not in px4.files(policy, KERNEL, "x")
        assert reason in px4.section(policy)


def test_the_readme_has_no_placeholder_left() -> None:
    readme = px4.files(shaped(), {"mine.c": "", "mine.h": ""}, "mine")["px4/README.md"]
    assert isinstance(readme, str)
    assert readme.startswith("# mine on PX4")
    assert "@" not in readme

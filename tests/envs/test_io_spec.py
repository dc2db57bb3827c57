"""What each number in and out is called: its frame, unit and place in the order."""

import pytest

from qrl_envs import io_spec
from qrl_envs import task as tasks


@pytest.mark.parametrize("name", ["hover", "circle"])
def test_observations_of_a_quadrotor(name: str) -> None:
    found = io_spec.observations(tasks.load(name))
    assert " ".join(port.name for port in found) == ("r11 r12 r13 r21 r22 r23 r31 r32 r33 px py pz vx vy vz wx wy wz")
    assert [port.unit for port in found] == ["1"] * 9 + ["m"] * 3 + ["m/s"] * 3 + ["rad/s"] * 3
    assert all(port.frame.startswith("body: ") for port in found[15:])
    assert found[1].frame.endswith("world x part of the body y axis")  # row-major, body -> world
    assert found[3].frame.endswith("world y part of the body x axis")
    assert all(port.frame.startswith("world: ") for port in found[9:15])
    assert all(("hover point" if name == "hover" else "circle's center") in port.frame for port in found[9:12])


def test_actions_of_the_quadrotor() -> None:
    found = io_spec.actions(tasks.load("hover"))
    assert [(port.name, port.unit) for port in found] == [(f"f{i}", "N") for i in range(1, 5)]
    hover = 0.667 * 9.81 / 4
    for port in found:
        assert port.safe == pytest.approx(hover, rel=1e-3)
        assert port.safe == port.offset
        assert (port.scale, port.low, port.high) == (6.0, 0.0, 8.0)
    a = 0.07425
    assert [port.position_m for port in found] == [(a, a), (-a, a), (-a, -a), (a, -a)]
    assert [port.spin for port in found] == [1, -1, 1, -1]


def test_actions_of_another_vehicle() -> None:
    """Its own motors, in its file's order, and its own hover thrust."""
    found = io_spec.actions(tasks.load("hover", "crazyflie"))
    assert [port.position_m for port in found] == [
        (0.0304056, 0.0304056),
        (0.0304056, -0.0304056),
        (-0.0304056, -0.0304056),
        (-0.0304056, 0.0304056),
    ]
    for port in found:
        assert (port.scale, port.low, port.high) == (pytest.approx(0.03 * 9.81 / 4), 0.0, 0.14375)
        assert port.safe == pytest.approx(0.03 * 9.81 / 4, rel=1e-3)


def test_rotor_speeds_reach_down_to_the_least_thrust() -> None:
    """As in the plant, which clips there: c·w + (1 − c)·w² = min/max."""
    spec = tasks.load("track", "cf21_brushless")
    assert isinstance(spec, tasks.QuadrotorTask)
    ports = io_spec.actions(spec.model_copy(update={"action": "rotor_speed"}))
    for port, motor in zip(ports, spec.vehicle.motors, strict=True):
        c = spec.vehicle.thrust_curve
        assert 0.0 < port.low < port.safe
        assert c * port.low + (1.0 - c) * port.low**2 == pytest.approx(motor.min_N / motor.max_N, abs=1e-4)
    assert [port.low for port in io_spec.actions(tasks.load("any"))] == [0.0] * 4


def test_a_tilted_motors_axis_is_told() -> None:
    """As a unit vector; the port of an upright one says body z."""
    spec = tasks.load("hover")
    assert isinstance(spec, tasks.QuadrotorTask)
    tilted = [
        motor.model_copy(update={"axis": (0.0, 0.6 * s, 0.8)})
        for s, motor in zip((1, 1, -1, -1), spec.vehicle.motors, strict=True)
    ]
    vehicle = spec.vehicle.model_copy(update={"motors": (*tilted[:1], *spec.vehicle.motors[1:3], *tilted[3:])})
    ports = io_spec.actions(spec.model_copy(update={"vehicle": vehicle}))
    assert [port.axis for port in ports] == [
        (0.0, pytest.approx(0.6), 0.8),
        *[(0.0, 0.0, 1.0)] * 2,
        (0.0, pytest.approx(-0.6), 0.8),
    ]
    assert [port.frame for port in ports] == [
        "thrust along its axis",
        *["thrust along body z"] * 2,
        "thrust along its axis",
    ]


def test_ports_of_the_pendulum() -> None:
    task = tasks.load("pendulum")
    found = io_spec.observations(task)
    assert [(port.name, port.unit) for port in found] == [
        ("cos_theta", "1"),
        ("sin_theta", "1"),
        ("theta_dot", "rad/s"),
    ]
    (torque,) = io_spec.actions(task)
    assert (torque.name, torque.unit, torque.offset, torque.scale) == ("torque", "N m", 0.0, 2.0)
    assert (torque.low, torque.high, torque.safe) == (-2.0, 2.0, 0.0)
    assert torque.position_m is None
    assert torque.spin is None

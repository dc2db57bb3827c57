"""rotorpy as a judge: `rotorpy_flights.py crazyflie|hummingbird [--kernel FOLDER]` flies qrl's kernel, RAPTOR and SE3.

Its plant as it comes: RK45 over each control period, rotors with lag, drag that grows with their speed and acts at
their hubs, parasitic drag, translational lift. `STAGES` takes it apart, to be compared with ours.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rotorpy.controllers.quadrotor_control import SE3Control
from rotorpy.vehicles import crazyflie_params, hummingbird_params
from rotorpy.vehicles.multirotor import Multirotor
from scipy.spatial.transform import Rotation

import kernel_flights
from kernel_flights import (
    PERIOD_S,
    Array,
    Condition,
    Controller,
    KernelController,
    RaptorController,
    Rotors,
    State,
    Target,
)

VEHICLES = {"crazyflie": crazyflie_params.quad_params, "hummingbird": hummingbird_params.quad_params}
EXACT = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12}
# rotorpy's own method and tolerance; it begins with the whole period rather than with a guess, in half the time.
USUAL = {"method": "RK45", "first_step": PERIOD_S}
# Each adds to the one before; the last is rotorpy as it is.
STAGES = (
    "no aerodynamics",
    "drag of hover at the center of mass",
    "drag with the rotors' speed",
    "drag at the hubs",
    "as it is",
)


def rotors(parameters: dict[str, Any]) -> Rotors:
    positions = np.array([position[:2] for position in parameters["rotor_pos"].values()])
    return Rotors(positions, np.asarray(parameters["rotor_directions"]))


class Staged(Multirotor):
    """rotorpy's plant with its aerodynamics up to a stage."""

    def __init__(self, parameters: dict[str, Any], stage: str) -> None:
        super().__init__(parameters, aero=False, integrator_kwargs=EXACT)
        self._stage = STAGES.index(stage)
        self._hover_rad_s = hover_speed_rad_s(parameters)

    def compute_body_wrench(self, body_rates: Array, rotor_speeds: Array, body_airspeed_vector: Array) -> Any:
        force, moment = super().compute_body_wrench(body_rates, rotor_speeds, body_airspeed_vector)
        if self._stage == 0:
            return force, moment
        speeds = np.full_like(rotor_speeds, self._hover_rad_s) if self._stage == 1 else rotor_speeds
        air = np.tile(body_airspeed_vector, (self.num_rotors, 1))
        if self._stage < 3:
            return force - (speeds[:, None] * air * np.diag(self.rotor_drag_matrix)).sum(axis=0), moment
        air = air + np.cross(body_rates, self.rotor_geometry)
        hub = -speeds[:, None] * air * np.diag(self.rotor_drag_matrix)
        return force + hub.sum(axis=0), moment + np.cross(self.rotor_geometry, hub).sum(axis=0)


def hover_speed_rad_s(parameters: dict[str, Any]) -> float:
    return float(np.sqrt(parameters["mass"] * 9.81 / parameters["num_rotors"] / parameters["k_eta"]))


class Flights:
    """n vehicles; set-points in rad/s. The point is 0, 0, 0: there is no ground."""

    def __init__(self, parameters: dict[str, Any], condition: Condition, stage: str | None = None) -> None:
        changed = parameters | {
            "mass": parameters["mass"] * condition.mass,
            "k_eta": parameters["k_eta"] * condition.thrust,
            "k_m": parameters["k_m"] * condition.thrust,
            "tau_m": parameters["tau_m"] * condition.lag,
        }
        self._vehicle = (
            Staged(changed, stage)
            if stage in STAGES[:-1]
            else Multirotor(changed, integrator_kwargs=EXACT if stage else USUAL)
        )
        self._hover_rad_s, self._wind_m_s = hover_speed_rad_s(parameters), np.array([condition.wind_m_s, 0.0, 0.0])
        self._states: list[dict[str, Array]] = []

    def start(self, states: State) -> None:
        self._states = [
            {
                "x": position,
                "v": velocity,
                "q": Rotation.from_matrix(rotation).as_quat(),
                "w": rate,
                "wind": self._wind_m_s,
                "rotor_speeds": np.full(self._vehicle.num_rotors, self._hover_rad_s),
            }
            for rotation, position, velocity, rate in zip(*states, strict=True)
        ]

    def states(self) -> State:
        position, velocity, quaternion, rate = (np.array([s[key] for s in self._states]) for key in "xvqw")
        return State(Rotation.from_quat(quaternion).as_matrix(), position, velocity, rate)

    def step(self, set_points: Array, flying: NDArray[np.bool_]) -> None:
        for i in np.flatnonzero(flying):
            self._states[i] = self._vehicle.step(self._states[i], {"cmd_motor_speeds": set_points[i]}, PERIOD_S)


class SE3:
    """rotorpy's geometric controller, with its gains, told the nominal vehicle; it is passed position, velocity and
    acceleration of what it is to follow.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        self._controller = SE3Control(parameters)

    def reset(self, flights: int) -> None:
        pass

    def act(self, states: State, target: Target) -> Array:
        wanted = {"x": target.position_m, "x_dot": target.velocity_m_s, "x_ddot": target.acceleration_m_s2}
        wanted |= {"x_dddot": np.zeros(3), "x_ddddot": np.zeros(3), "yaw": 0.0, "yaw_dot": 0.0}
        quaternions = Rotation.from_matrix(states.rotation).as_quat()
        each = zip(states.position_m, states.velocity_m_s, quaternions, states.body_rate_rad_s, strict=True)
        now = (dict(zip("xvqw", values, strict=True)) for values in each)
        return np.array([self._controller.update(0.0, state, wanted)["cmd_motor_speeds"] for state in now])


def main() -> None:
    job = kernel_flights.job(tuple(VEHICLES))
    parameters = VEHICLES[job.vehicle]
    theirs = rotors(parameters)

    def speed_of(thrust_N: Array) -> Array:
        return np.sqrt(thrust_N / parameters["k_eta"])

    if job.given and job.rollouts:
        given = kernel_flights.read_given(job.given)
        flights = {stage: Flights(parameters, Condition("nominal"), stage) for stage in STAGES}
        found = {s: kernel_flights.rollout(f, given, theirs, speed_of) for s, f in flights.items()}
        kernel_flights.write_rollouts(job.rollouts, found)
        return
    least, most = parameters["rotor_speed_min"], parameters["rotor_speed_max"]
    controllers: dict[str, Controller] = {}
    if job.kernel:
        controllers["qrl"] = KernelController(job.kernel, theirs, speed_of, least, most)
    controllers |= {"RAPTOR": RaptorController(theirs, least, most), "rotorpy's SE3": SE3(parameters)}
    kernel_flights.tournament(
        lambda condition, _: Flights(parameters, condition), controllers, job.starts, job.references
    )


if __name__ == "__main__":
    main()

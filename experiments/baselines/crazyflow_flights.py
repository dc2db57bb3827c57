"""crazyflow as a judge: `crazyflow_flights.py cf21B_500|cf2x_L250 [--kernel FOLDER]`: qrl's kernel, RAPTOR, Mellinger.

Its plant as it comes: first_principles at 500 Hz with Euler's method; rotors whose speed follows by a linear and a
quadratic term, reaction torques of the propellers' inertia, linear drag. It has no wind: here wind is the force that
its drag would exert. `STAGES` takes the plant apart, to be compared with ours.
"""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # before SciPy is imported: crazyflow rotates JAX arrays with it

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.control.transform import motor_force2rotor_vel
from crazyflow.drones import Drone
from crazyflow.dynamics import Dynamics, load_params
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator
from numpy.typing import NDArray
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

FREQUENCY_HZ = 500
HEIGHT_M = 1.5 * kernel_flights.LOST_M  # of the point: crazyflow has a floor at 0
VEHICLES = ("cf21B_500", "cf2x_L250")
# Each adds to the one before; the last is crazyflow as it is.
STAGES = (
    "rotors of one time constant, yaw torque by thrust, no propeller inertia, RK4",
    "yaw torque by its own curve",
    "rotors by its own law",
    "propeller inertia",
    "as it is: Euler",
)


class Vehicle:
    """crazyflow's identification of a Crazyflie; rotor speeds in RPM."""

    def __init__(self, drone: str) -> None:
        self.drone = Drone(drone)
        self.parameters = load_params(Dynamics.first_principles, self.drone, xp=np)
        mixing = np.asarray(self.parameters["mixing_matrix"])
        # Torques per thrust: row x is y of the motors, row y is −x, in lengths of L; row z is the spin.
        self.rotors = Rotors(float(self.parameters["L"]) * np.stack([-mixing[1], mixing[0]], axis=1), mixing[2])
        self.hover_N = float(self.parameters["mass"]) * 9.81 / 4.0
        self.hover_rpm = float(self.speed_of(np.array([self.hover_N]))[0])
        limits = np.array([float(self.parameters["thrust_min"]), float(self.parameters["thrust_max"])])
        self.least_rpm, self.most_rpm = self.speed_of(limits).tolist()

    def speed_of(self, thrust_N: Array) -> Array:
        return np.asarray(motor_force2rotor_vel(thrust_N, np.asarray(self.parameters["rpm2thrust"])))

    def yaw_moment_m(self) -> float:
        """Reaction torque per thrust of a rotor in hover."""
        constant, linear, square = self.parameters["rpm2torque"]
        return float((constant + linear * self.hover_rpm + square * self.hover_rpm**2) / self.hover_N)

    def rates_1_s(self) -> tuple[float, float]:
        """1 / time constant at which a rotor's speed rises and falls, for small changes about hover."""
        rise, rise_square, fall, fall_square = np.asarray(self.parameters["rotor_dyn_coef"]).tolist()
        return rise + 2.0 * rise_square * self.hover_rpm, fall + 2.0 * fall_square * self.hover_rpm


class Flights:
    """n vehicles; set-points in RPM, or 16 numbers of a state for the control `state`."""

    def __init__(self, vehicle: Vehicle, flights: int, control: Control, integrator: Integrator = Integrator.default):
        self._vehicle, self._control = vehicle, control
        self._sim = Sim(
            n_worlds=flights,
            drone=vehicle.drone,
            dynamics=Dynamics.first_principles,
            control=control,
            integrator=integrator,
            freq=FREQUENCY_HZ,
            state_freq=round(1.0 / PERIOD_S),
            attitude_freq=FREQUENCY_HZ,
            device="cpu",
        )
        self.nominal = self._sim.data.params
        self._wind_m_s = np.zeros(3)

    def under(self, condition: Condition) -> "Flights":
        """This judge, its vehicles changed by a condition."""
        nominal = self.nominal
        self.change(
            mass=nominal.mass * condition.mass,
            rpm2thrust=nominal.rpm2thrust * condition.thrust,
            rpm2torque=nominal.rpm2torque * condition.thrust,
            rotor_dyn_coef=nominal.rotor_dyn_coef / condition.lag,
        )
        self._wind_m_s = np.array([condition.wind_m_s, 0.0, 0.0])
        return self

    def change(self, **parameters: Any) -> "Flights":
        self._sim.default_data = self._sim.default_data.replace(params=self.nominal.replace(**parameters))
        return self

    def start(self, states: State) -> None:
        self._sim.reset()
        count = len(states.position_m)
        position = states.position_m + np.array([0.0, 0.0, HEIGHT_M])
        quaternion = Rotation.from_matrix(states.rotation).as_quat()
        self._sim.data = self._sim.data.replace(
            states=self._sim.data.states.replace(
                pos=_one_each(position),
                quat=_one_each(quaternion),
                vel=_one_each(states.velocity_m_s),
                ang_vel=_one_each(states.body_rate_rad_s),
                rotor_vel=jnp.full((count, 1, 4), self._vehicle.hover_rpm),
            )
        )

    def states(self) -> State:
        now = self._sim.data.states
        position, quaternion, velocity, rate = (
            np.asarray(a[:, 0], np.float64) for a in (now.pos, now.quat, now.vel, now.ang_vel)
        )
        # A flight that was lost may be NaN, of which SciPy makes an error.
        quaternion = np.where(np.isfinite(quaternion).all(axis=1, keepdims=True), quaternion, [0.0, 0.0, 0.0, 1.0])
        rotation = kernel_flights.matrices(np.roll(quaternion, 1, axis=1))
        return State(rotation, position - np.array([0.0, 0.0, HEIGHT_M]), velocity, rate)

    def step(self, set_points: Array, flying: NDArray[np.bool_]) -> None:
        if self._wind_m_s.any():
            rotation = self.states().rotation
            drag = np.asarray(self._vehicle.parameters["drag_matrix"])
            push_N = -(rotation @ drag @ np.swapaxes(rotation, 1, 2)) @ self._wind_m_s
            pushed = self._sim.data.states.replace(force=_one_each(push_N))
            self._sim.data = self._sim.data.replace(states=pushed)
        command = _one_each(set_points)
        if self._control == Control.state:
            self._sim.state_control(command)
        else:
            self._sim.rotor_vel_control(command)
        self._sim.step(round(FREQUENCY_HZ * PERIOD_S))


def _one_each(rows: Array) -> Any:
    """[n, k] -> float32 [n, 1, k]: one drone in each world."""
    return jnp.asarray(rows[:, None], jnp.float32)


class Mellinger:
    """crazyflow's own controller, with its gains and the mass that it assumes: it is passed position, velocity and
    acceleration of what it is to follow.
    """

    def reset(self, flights: int) -> None:
        pass

    def act(self, states: State, target: Target) -> Array:
        wanted = np.zeros(16)
        wanted[:3], wanted[3:6], wanted[6:9] = target.position_m, target.velocity_m_s, target.acceleration_m_s2
        wanted[2] += HEIGHT_M
        wanted[12] = 1.0  # the quaternion's w, which is last
        return np.tile(wanted, (len(states.position_m), 1))


def staged(vehicle: Vehicle, flights: int) -> Iterator[tuple[str, Flights]]:
    """The plant at each of STAGES, to be used before the next one is asked for."""
    rk4, euler = (Flights(vehicle, flights, Control.rotor_vel, i) for i in (Integrator.rk4, Integrator.euler))
    rise, fall = vehicle.rates_1_s()
    changes: dict[str, Any] = {
        "rpm2torque": euler.nominal.rpm2thrust * vehicle.yaw_moment_m(),
        "rotor_dyn_coef": jnp.array([[rise, 0.0, fall, 0.0]]),
        "prop_inertia": jnp.zeros_like(euler.nominal.prop_inertia),
    }
    for stage, theirs in zip(STAGES[:-1], ("", *list(changes)), strict=True):
        changes.pop(theirs, None)
        yield stage, rk4.change(**changes)
    yield STAGES[-1], euler


def main() -> None:
    job = kernel_flights.job(VEHICLES)
    vehicle = Vehicle(job.vehicle)
    if job.given and job.rollouts:
        given = kernel_flights.read_given(job.given)
        stages = staged(vehicle, len(given.thrusts_N))
        found = {s: kernel_flights.rollout(f, given, vehicle.rotors, vehicle.speed_of) for s, f in stages}
        kernel_flights.write_rollouts(job.rollouts, found)
        return
    controllers: dict[str, Controller] = {}
    if job.kernel:
        controllers["qrl"] = KernelController(
            job.kernel, vehicle.rotors, vehicle.speed_of, vehicle.least_rpm, vehicle.most_rpm
        )
    controllers["RAPTOR"] = RaptorController(vehicle.rotors, vehicle.least_rpm, vehicle.most_rpm)
    controllers["crazyflow's Mellinger"] = Mellinger()
    judges = {c: Flights(vehicle, job.starts, c) for c in (Control.rotor_vel, Control.state)}

    def judge(condition: Condition, name: str) -> Flights:
        return judges[Control.state if isinstance(controllers[name], Mellinger) else Control.rotor_vel].under(condition)

    kernel_flights.tournament(judge, controllers, job.starts, job.references)


if __name__ == "__main__":
    main()

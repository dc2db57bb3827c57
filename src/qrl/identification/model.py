"""A vehicle with free parameters, flown open loop through the plant of `qrl_envs` from the states of a log.

Thrust, mass, lag, inertia and yaw moment are free by the logarithm of a factor on the file's value, the others by what
is added to it. A log alone tells forces over mass and torques over inertia. So where it gives rotor speeds, thrust is
free and the mass is the file's; where it gives thrusts, they are believed, and mass and center of mass are free.
"""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from qrl.identification import flight_log
from qrl.identification.flight_log import Segments
from qrl_envs import plant, quadrotor, rotation, rotors
from qrl_envs.plant import World
from qrl_envs.quadrotor import Body, Pose, Twist
from qrl_envs.rotors import Rotors
from qrl_envs.uncertainty import Uncertainty
from qrl_envs.vehicle import Vehicle

FIRST_LAG_S = 0.03  # where the fit begins for a vehicle whose file has no lag
NO_LAG_S = 1e-5  # stands for none
MOST_LATENCY_S = 0.1


class Offsets(NamedTuple):
    """The parameters, as offsets from the file's: 0 is the file; M modes of thrust: common, roll, pitch, yaw."""

    thrust: Any  # [M] of the modes, each a pattern of logarithms of the motors' thrusts
    mass: Any  # [] logarithm
    center_m: Any  # [2] center of mass along body x, y
    curve: Any  # []
    lag: Any  # [] logarithm of both time constants
    rise: Any  # [] logarithm of the rise time's ratio to the geometric mean of both
    drag_1_s: Any  # [3] drag over the file's mass, body axes
    drag_height: Any  # [] where drag acts, over the length of the longest arm
    inertia: Any  # [] logarithm
    yaw_moment: Any  # [] logarithm
    latency_s: Any  # [] from a command's time in the log to its effect; no part of a vehicle


class Model(NamedTuple):
    """What is known before the fit; P parameters, N motors."""

    vehicle: Vehicle
    thrust: bool  # whether logs give thrusts
    period_s: float
    modes: np.ndarray  # [N, M]
    lag_s: tuple[float, float]  # to rise, to fall, where `lag` is 0

    @property
    def names(self) -> list[str]:
        """Of each parameter; [P]."""
        sizes = {"thrust": self.modes.shape[1], "center_m": 2, "drag_1_s": 3}
        return [name for name in Offsets._fields for _ in range(sizes.get(name, 1))]

    def unraveled(self, theta: Any) -> Offsets:
        """A vector of parameters [P] by name."""
        sizes = Offsets(self.modes.shape[1], 1, 2, 1, 1, 1, 3, 1, 1, 1, 1)
        parts = jnp.split(jnp.asarray(theta), np.cumsum(sizes)[:-1])
        return Offsets(
            *(
                p if n in ("thrust", "center_m", "drag_1_s") else p[0]
                for n, p in zip(Offsets._fields, parts, strict=True)
            )
        )

    @property
    def arm_m(self) -> float:
        return float(np.linalg.norm(self.vehicle.motor_positions_m, axis=0).max())

    @property
    def given(self) -> np.ndarray:
        """The parameters of the vehicle's file; [P]."""
        lag = np.log(NO_LAG_S / FIRST_LAG_S) if self.vehicle.rotor_rise_s == 0.0 else 0.0
        return np.where(np.array(self.names) == "lag", lag, 0.0)

    @property
    def free(self) -> np.ndarray:
        """Which parameters such logs can tell; [P] bool."""
        fixed = {"thrust"} if self.thrust else {"mass", "center_m"}
        return np.array([name not in fixed for name in self.names])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest parameters; [P] each."""
        v = self.vehicle
        arm = self.arm_m
        drag = -np.array(v.drag_N_s_m) / v.mass_kg
        low = Offsets(
            np.full(self.modes.shape[1], -1.5),
            -1.5,
            np.full(2, -0.5 * arm),
            -0.9 - v.thrust_curve,
            -3.0,
            -1.5,
            drag,
            -5.0,
            -2.0,
            -2.0,
            0.0,
        )
        high = Offsets(
            np.full(self.modes.shape[1], 1.5),
            1.5,
            np.full(2, 0.5 * arm),
            1.0 - v.thrust_curve,
            3.0,
            1.5,
            np.full(3, 20.0),
            5.0,
            2.0,
            2.0,
            MOST_LATENCY_S,
        )
        return np.array(ravel_pytree(low)[0], float), np.array(ravel_pytree(high)[0], float)


def model(vehicle: Vehicle, thrust: bool, period_s: float) -> Model:
    """The free vehicle of a file, for logs of thrusts or of rotor speeds at a period."""
    spin = np.array([motor.spin for motor in vehicle.motors], float)
    patterns = np.stack([np.ones_like(spin), *vehicle.torques_m[:2], spin])
    u, s, _ = np.linalg.svd((patterns / np.abs(patterns).max(axis=1, keepdims=True)).T, full_matrices=False)
    modes = u[:, s > 1e-6 * s[0]] * np.sqrt(len(spin))
    lag_s = (vehicle.rotor_rise_s, vehicle.rotor_fall_s) if vehicle.rotor_rise_s else (FIRST_LAG_S, FIRST_LAG_S)
    return Model(vehicle, thrust, period_s, modes, lag_s)


def world(model: Model, offsets: Offsets) -> World:
    """The plant with these parameters."""
    v = model.vehicle
    physics = quadrotor.physics(v)
    nominal = plant.draw(plant.ranges(Uncertainty(), v), physics, jnp.zeros(plant.DRAWS + len(v.motors)))
    axes = jnp.asarray(v.motor_axes, jnp.float32)
    spin = jnp.asarray([motor.spin for motor in v.motors], jnp.float32)
    center = jnp.append(offsets.center_m, 0.0)[:, None] * jnp.ones_like(axes)
    arms = rotation.cross(jnp.asarray(v.motor_positions_m, jnp.float32) - center, axes)
    changed = physics._replace(
        mass_kg=physics.mass_kg * jnp.exp(offsets.mass),
        inertia_kg_m2=physics.inertia_kg_m2 * jnp.exp(offsets.inertia),
        motor_torque_m=arms + v.yaw_moment_m * jnp.exp(offsets.yaw_moment) * spin * axes,
        motor_max_N=physics.motor_max_N * jnp.exp(jnp.asarray(model.modes, jnp.float32) @ offsets.thrust),
    )
    rise_s, fall_s = (
        jnp.float32(lag) * jnp.exp(offsets.lag + sign * offsets.rise)
        for lag, sign in zip(model.lag_s, (1, -1), strict=True)
    )
    drag = jnp.asarray(v.drag_N_s_m, jnp.float32) + v.mass_kg * offsets.drag_1_s
    return nominal._replace(
        physics=changed,
        rotors=Rotors(rise_s, fall_s, v.thrust_curve + offsets.curve),
        disturbance=nominal.disturbance._replace(
            drag_N_s_m=drag, drag_height_m=v.drag_height_m + model.arm_m * offsets.drag_height
        ),
    )


def predicted(
    model: Model, theta: chex.Array, segments: Segments, attitude_known: chex.Array | bool = False
) -> chex.Array:
    """Open-loop flights from the starts of `segments`: position, attitude, velocity, body rates at the lead times;
    [P] -> [S, L, 13]. With `attitude_known` attitude and body rates are the log's at each step.
    """
    offsets = model.unraveled(theta)
    there, dt_s = world(model, offsets), model.period_s
    first = jnp.floor(offsets.latency_s / dt_s + 1e-4).astype(jnp.int32)
    late_s = jnp.maximum(offsets.latency_s - first * dt_s, 0.0)
    warm, at = flight_log.warm_up_steps(dt_s), flight_log.leads(dt_s)

    def flight(measured: chex.Array, command: chex.Array) -> chex.Array:
        if model.thrust:
            command = rotors.speed_of(there.rotors.curve, jnp.minimum(command / there.physics.motor_max_N, 1.0))
        steps = jnp.arange(command.shape[0])
        old, new = (command[jnp.maximum(steps - first - i, 0)] for i in (1, 0))

        def spin_up(speed: chex.Array, points: tuple[chex.Array, chex.Array]) -> tuple[chex.Array, None]:
            before = rotors.after(there.rotors, speed, points[0], late_s)
            return rotors.after(there.rotors, before, points[1], dt_s - late_s), None

        def fly(carry: tuple[Body, chex.Array], row: tuple[chex.Array, ...]) -> tuple[Any, chex.Array]:
            body, speed = carry
            log = _body(row[2])
            body = Body(
                body.pose._replace(attitude=jnp.where(attitude_known, log.pose.attitude, body.pose.attitude)),
                body.twist._replace(
                    body_rate_rad_s=jnp.where(attitude_known, log.twist.body_rate_rad_s, body.twist.body_rate_rad_s)
                ),
            )
            body, speed = plant.advance(there, there.disturbance, body, speed, (row[0], row[1]), late_s, dt_s)
            return (body, speed), jnp.concatenate([*body.pose, *body.twist])

        speed, _ = jax.lax.scan(spin_up, command[0], (old[:warm], new[:warm]))
        rows = (old[warm:], new[warm:], measured[:-1])
        _, states = jax.lax.scan(fly, (_body(measured[0]), speed), rows)
        return states[at - 1]

    return jax.vmap(flight)(jnp.asarray(segments.measured), jnp.asarray(segments.command))


def _body(state: chex.Array) -> Body:
    p, q, v, w = jnp.split(state, [3, 7, 10])
    return Body(Pose(p, q), Twist(v, w))


def found_errors(model: Model, theta: chex.Array, segments: Segments) -> chex.Array:
    """What a fit makes small, [S, L, 12]: errors of position and velocity with the log's attitude, of attitude and body
    rates without. So what the log says of thrust is not drowned by errors in torque, which position integrates four
    times.
    """
    at = flight_log.leads(model.period_s)
    measured = jnp.asarray(segments.measured)[:, at]
    states = jax.vmap(lambda known: predicted(model, theta, segments, known))(jnp.array([False, True]))
    free, held = errors(states, measured)
    return jnp.concatenate([held[..., :3], free[..., 3:6], held[..., 6:9], free[..., 9:]], axis=-1)


def errors(states: chex.Array, measured: chex.Array) -> chex.Array:
    """Predicted minus measured position [m], attitude [rad, body axes], velocity [m/s], body rates [rad/s];
    [..., 13], [..., 13] -> [..., 12].
    """
    across = jnp.moveaxis(states[..., 3:7], -1, 0), jnp.moveaxis(measured[..., 3:7], -1, 0)
    inverse = jnp.concatenate([across[1][:1], -across[1][1:]])
    w, *vector = jnp.unstack(rotation.product(inverse, across[0]))
    attitude = 2.0 * jnp.where(w < 0.0, -1.0, 1.0) * jnp.stack(vector)
    difference = states - measured
    return jnp.concatenate([difference[..., :3], jnp.moveaxis(attitude, 0, -1), difference[..., 7:]], axis=-1)


def static_thrust_N(vehicle: Vehicle, command: np.ndarray, thrust: bool) -> np.ndarray:
    """The sum of thrusts at rest by the file, for commands [T, N]; [T]."""
    if thrust:
        return command.sum(axis=1)
    max_N = np.array([motor.max_N for motor in vehicle.motors])
    return (max_N * np.asarray(rotors.thrust_fraction(jnp.float32(vehicle.thrust_curve), jnp.asarray(command)))).sum(
        axis=1
    )

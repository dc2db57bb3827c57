"""The plant of real vehicles: rotors that lag, commands that act late, drag and disturbances, sensors that err.

A `World` is one flight's draw of an `Uncertainty`; it is constant during the flight. `Flight` is the state. For one
flight; the caller vmaps.
"""

import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import gusts, integrate, quadrotor, rotation, rotors, sensors
from qrl_envs.fusion import stored
from qrl_envs.gusts import Gust
from qrl_envs.own_vehicle import Drawn
from qrl_envs.quadrotor import Body, Disturbance, Physics, Pose, Twist
from qrl_envs.rotors import Rotors
from qrl_envs.sensors import Fixes, History, Noise, Sensors
from qrl_envs.target import Target
from qrl_envs.task import CircleReward, QuadrotorTask
from qrl_envs.uncertainty import Layout, Uncertainty
from qrl_envs.vehicle import Vehicle

LEAST_THRUST = 1.45  # of weight and force together, unless the vehicle has less: below, a draw is made lighter
MOST_BODY_RATE_RAD_S = 40.0  # where it saturates
INTEGRATION_STEP_S = 0.01  # at most; halving it changes nothing that is reported (docs/real_vehicles.md)


class Ranges(NamedTuple):
    """An `Uncertainty` as arrays [2], and the vehicle it is about; so that one program serves all of them."""

    mass_factor: chex.Array
    inertia_factor: chex.Array
    thrust_factor: chex.Array
    motor_factor: chex.Array
    rotor_rise_s: chex.Array
    rotor_fall_s: chex.Array
    drag_factor: chex.Array
    force_weights: chex.Array
    torque_share: chex.Array
    wind_m_s: chex.Array
    latency_s: chex.Array
    position_noise_m: chex.Array
    velocity_noise_m_s: chex.Array
    attitude_noise_rad: chex.Array
    body_rate_noise_rad_s: chex.Array
    position_bias_m: chex.Array
    gust_m_s: chex.Array
    gust_s: chex.Array
    position_period_s: chex.Array
    position_delay_s: chex.Array
    bias_wander_m: chex.Array
    bias_wander_s: chex.Array
    thrust_curve: chex.Array  # []
    drag_N_s_m: chex.Array  # [3]
    drag_height_m: chex.Array  # []


class World(NamedTuple):
    """One flight's draw."""

    physics: Physics  # the vehicle as it is
    motor_factor: chex.Array  # [N] thrust, of that of the vehicle file
    rotors: Rotors
    disturbance: Disturbance
    latency_s: chex.Array  # []
    sensors: Sensors
    gust: Gust | tuple[()] = ()
    reference: Any = ()  # this flight's, of a task that tracks one (`target`)


DRAWS = 23  # uniform numbers of a draw, besides one for each motor
MORE_DRAWS = 7  # of gusts and fixes


def ranges(uncertainty: Uncertainty, vehicle: Vehicle) -> Ranges:
    """The ranges of an uncertainty about a vehicle."""

    def lag(own_s: float) -> tuple[float, float]:
        if uncertainty.rotor_lag_s is not None:
            return uncertainty.rotor_lag_s
        low, high = uncertainty.rotor_lag_factor
        return low * own_s, high * own_s

    data: dict[str, Any] = {name: getattr(uncertainty, name) for name in Uncertainty.model_fields}
    data |= {"rotor_rise_s": lag(vehicle.rotor_rise_s), "rotor_fall_s": lag(vehicle.rotor_fall_s)}
    data |= {name: getattr(vehicle, name) for name in ("thrust_curve", "drag_N_s_m", "drag_height_m")}
    return Ranges(**{name: jnp.asarray(data[name], jnp.float32) for name in Ranges._fields})


def _direction(u: chex.Array) -> chex.Array:
    """A unit vector [3], uniform over the sphere, from u [2] uniform in [0, 1)."""
    z = 2.0 * u[0] - 1.0
    across, angle = jnp.sqrt(1.0 - z * z), 2.0 * jnp.pi * u[1]
    return jnp.stack([across * jnp.cos(angle), across * jnp.sin(angle), z])


def draw(
    ranges: Ranges,
    physics: Physics,
    u: chex.Array,
    layout: Layout | None = None,
    more: chex.Array | None = None,
    own: Drawn | None = None,
) -> World:
    """The world of a flight, from u [DRAWS + N] uniform in [0, 1); with gusts and fixes where `layout` has them, from
    `more` [MORE_DRAWS] likewise; of the flight's `own` vehicle, if it has one.

    A vehicle whose thrust is then under LEAST_THRUST of its weight and the force on it, and under what the vehicle of
    the file has, is made lighter, and the force weaker.
    """

    def within(pair: chex.Array, u: chex.Array) -> chex.Array:
        return pair[0] + (pair[1] - pair[0]) * u

    physics = physics if own is None else own.physics
    drag_N_s_m = ranges.drag_N_s_m if own is None else own.drag_N_s_m
    motors = within(ranges.thrust_factor, u[0]) * within(ranges.motor_factor, u[DRAWS:])
    own_thrust = jnp.sum(physics.motor_max_N)
    own_weight_N = physics.mass_kg * physics.gravity_m_s2
    mass, force = within(ranges.mass_factor, u[1]), within(ranges.force_weights, u[2])
    force = force if own is None else force + own.surplus_weights
    thrust = jnp.sum(motors * physics.motor_max_N) / own_weight_N
    share = jnp.minimum(1.0, thrust / (mass + force) / jnp.minimum(LEAST_THRUST, own_thrust / own_weight_N))
    mass, force = mass * share, force * share
    roll = jnp.min(jnp.sum(jnp.abs(physics.motor_torque_m[:2]), axis=1)) / 2.0 * jnp.mean(physics.hover_thrust_N)
    wind = 2.0 * jnp.pi * u[3]
    lags = Rotors(within(ranges.rotor_rise_s, u[5]), within(ranges.rotor_fall_s, u[5]), ranges.thrust_curve)
    gust, fixes = (), ()
    if layout and layout.gusts and more is not None:
        without_drag = jnp.all(drag_N_s_m == 0.0)
        gust = Gust(
            within(ranges.gust_m_s, more[0]),
            within(ranges.gust_s, more[1]),
            jnp.where(without_drag, gusts.WEIGHTS_S_M * own_weight_N, 0.0),
        )
    if layout and layout.positions and more is not None:
        period_s = within(ranges.position_period_s, more[2])
        others = (ranges.position_delay_s, ranges.bias_wander_m, ranges.bias_wander_s)
        fixes = Fixes(period_s, period_s * more[3], *(within(pair, more[4 + i]) for i, pair in enumerate(others)))
    return World(
        physics=physics._replace(
            mass_kg=physics.mass_kg * mass, inertia_kg_m2=physics.inertia_kg_m2 * within(ranges.inertia_factor, u[4])
        ),
        motor_factor=motors,
        rotors=lags if own is None else own.rotors,
        disturbance=Disturbance(
            drag_N_s_m=drag_N_s_m * within(ranges.drag_factor, u[6]),
            wind_m_s=within(ranges.wind_m_s, u[7]) * jnp.stack([jnp.cos(wind), jnp.sin(wind), jnp.zeros_like(wind)]),
            force_N=force * own_weight_N * _direction(u[8:10]),
            torque_N_m=within(ranges.torque_share, u[10]) * roll * _direction(u[11:13]),
            drag_height_m=ranges.drag_height_m,
        ),
        latency_s=within(ranges.latency_s, u[13]),
        sensors=Sensors(
            noise=Noise(*(within(getattr(ranges, name), u[14 + i]) for i, name in enumerate(NOISES))),
            bias_m=within(ranges.position_bias_m, u[18]) * _direction(u[19:21]),
            row=u[21],
            stride=u[22],
            fixes=fixes,
        ),
        gust=gust,
    )


NOISES = ("position_noise_m", "velocity_noise_m_s", "attitude_noise_rad", "body_rate_noise_rad_s")


class Flight(NamedTuple):
    """State of a flight; N motors."""

    body: Body
    speed: chex.Array  # [N] of the rotors, of their greatest
    set_points: chex.Array  # [D, N] speeds commanded, the latest first: those that may not have acted yet
    world: World
    sensed: Body  # the body as measured
    previous_action: chex.Array  # [N] applied
    integral_m_s: chex.Array | tuple[()]  # [k] of the position error along the integrator's axes; (): not integrated
    steps: chex.Array  # int32 []
    history: History | tuple[()] = ()  # of positions, with `sensors.Fixes`
    gust: chex.Array | tuple[()] = ()  # [2] along world x and y, of its standard deviation; with `Gust`


class Integrator(NamedTuple):
    """`task.Integral`, and the radius of the circle, if the task has one."""

    circle_m: float | None
    radius_m: float
    limit_m_s: float

    @property
    def size(self) -> int:
        """k, the number of components of the error."""
        return 4 if self.circle_m else 3


def integrator(task: QuadrotorTask) -> Integrator | None:
    """The integrator of a task whose policy observes the integral, else None."""
    if (integral := task.memory.integral) is None:
        return None
    circle_m = task.reward.radius_m if isinstance(task.reward, CircleReward) else None
    return Integrator(circle_m, integral.radius_m, integral.limit_m_s)


def begin(
    body: Body,
    world: World,
    layout: Layout,
    integrator: Integrator | None,
    dt_s: float,
    origin_m: chex.Array | float = 0.0,
) -> Flight:
    """A flight's state at its start: rotors at the speed of hover, a previous action of 0. The position's error is
    relative to `origin_m` [3].
    """
    physics = world.physics
    hover = rotors.speed_of(world.rotors.curve, physics.hover_thrust_N / physics.motor_max_N)
    motors = hover.shape[0]
    history = sensors.begin(world.sensors, body, layout.positions, dt_s)
    sensed = sensors.sense(world.sensors, history, body, jnp.int32(0), dt_s)
    return Flight(
        body=body,
        speed=hover,
        set_points=jnp.broadcast_to(hover, (layout.set_points, motors)),
        world=world,
        sensed=sensed,
        previous_action=jnp.zeros(motors),
        integral_m_s=integrated(
            jnp.zeros(integrator.size) if integrator else (), sensed.pose.position_m - origin_m, integrator, dt_s
        ),
        steps=jnp.int32(0),
        history=history,
        gust=gusts.begin(world.gust, world.sensors),
    )


def disturbance(flight: Flight) -> Disturbance:
    """What acts on the body in the period that begins now, gusts among it."""
    return gusts.disturbance(flight.world.disturbance, flight.world.gust, flight.gust)


def step(
    flight: Flight,
    action: chex.Array,
    integrator: Integrator | None,
    dt_s: float,
    origin_m: chex.Array | float = 0.0,
    rotor_speed: bool = False,
) -> Flight:
    """One control period under `action` [N], after which the position's error is relative to `origin_m` [3]. With
    `rotor_speed` −1 to 1 stands for a speed from 0 to the greatest.
    """
    world = flight.world
    set_point, applied = commanded(world, action, rotor_speed)
    set_points = jnp.concatenate([set_point[None], flight.set_points[:-1]])
    # Set-point i acts from latency_s − i·dt_s on; before that, set-point i + 1.
    first = jnp.floor(world.latency_s / dt_s + 1e-4)
    late_s = jnp.maximum(world.latency_s - first * dt_s, 0.0)
    ages = jnp.arange(set_points.shape[0]).reshape(-1, *[1] * (set_points.ndim - 1))
    new = jnp.sum(jnp.where(ages == first, set_points, 0.0), axis=0)
    old = jnp.sum(jnp.where(ages == jnp.minimum(first + 1, set_points.shape[0] - 1), set_points, 0.0), axis=0)

    body, speed = advance(world, disturbance(flight), flight.body, flight.speed, (old, new), late_s, dt_s)
    steps = flight.steps + 1
    history = sensors.follow(world.sensors, flight.history, body, steps, dt_s)
    sensed = sensors.sense(world.sensors, history, body, steps, dt_s)
    return Flight(
        body=body,
        speed=speed,
        set_points=set_points,
        world=world,
        sensed=sensed,
        previous_action=applied,
        integral_m_s=integrated(flight.integral_m_s, sensed.pose.position_m - origin_m, integrator, dt_s),
        steps=steps,
        history=history,
        gust=gusts.after(world.gust, world.sensors, flight.gust, steps, dt_s),
    )


def advance(
    world: World,
    acting: Disturbance,
    body: Body,
    speed: chex.Array,
    set_points: tuple[chex.Array, chex.Array],
    late_s: chex.Array,
    dt_s: float,
) -> tuple[Body, chex.Array]:
    """Body and rotor speeds [N] after a period in which a disturbance acts, and the first of two set-points [N] for
    `late_s` [], then the second.
    """
    physics, (old, new) = world.physics, set_points

    def speed_at(time_s: chex.Array) -> chex.Array:
        before = rotors.after(world.rotors, speed, old, jnp.minimum(time_s, late_s))
        return rotors.after(world.rotors, before, new, jnp.maximum(time_s - late_s, 0.0))

    def thrust_at(time_s: float) -> chex.Array:
        now = speed_at(jnp.float32(time_s)) if time_s else speed
        return stored(world.motor_factor * physics.motor_max_N * rotors.thrust_fraction(world.rotors.curve, now))

    substeps = math.ceil(dt_s / INTEGRATION_STEP_S - 1e-6)
    short_s = dt_s / substeps
    for i in range(substeps):
        begin_s, middle_s = i * short_s, (i + 0.5) * short_s
        body = integrate.midpoint(
            lambda b, t=begin_s: quadrotor.derivative(physics, b, thrust_at(t), acting),
            lambda b, t=middle_s: quadrotor.derivative(physics, b, thrust_at(t), acting),
            body,
            short_s,
        )
        body = _renormalized(body)
    return stored((body, speed_at(jnp.float32(dt_s))))


def commanded(world: World, action: chex.Array, rotor_speed: bool) -> tuple[chex.Array, chex.Array]:
    """The set-points of the rotors' speeds, and the action that stands for them; [N] each, for an action [N]."""
    physics, curve = world.physics, world.rotors.curve
    if not rotor_speed:
        thrust = quadrotor.thrust_N(physics, action)
        return rotors.speed_of(curve, thrust / physics.motor_max_N), quadrotor.applied_action(physics, thrust)
    least = rotors.speed_of(curve, physics.motor_min_N / physics.motor_max_N)
    set_point = jnp.clip(0.5 + 0.5 * action, least, 1.0)
    return set_point, 2.0 * set_point - 1.0


def _renormalized(body: Body) -> Body:
    """`body` with a unit quaternion, and body rates saturated at MOST_BODY_RATE_RAD_S."""
    rate = body.twist.body_rate_rad_s
    square = jnp.sum(rate * rate, axis=0)
    over = square > MOST_BODY_RATE_RAD_S**2
    rate = rate * jnp.where(over, MOST_BODY_RATE_RAD_S * jax.lax.rsqrt(jnp.where(over, square, 1.0)), 1.0)
    return Body(
        body.pose._replace(attitude=rotation.normalize(body.pose.attitude)), body.twist._replace(body_rate_rad_s=rate)
    )


def integrated(total: Any, position_m: chex.Array, integrator: Integrator | None, dt_s: float) -> Any:
    """The integral [k] after a period at `position_m` [3] (`task.Integral`); `total` as it is without an integrator."""
    if integrator is None:
        return total
    x, y, z = jnp.unstack(position_m)
    if radius_m := integrator.circle_m:
        outside = (x * x + y * y - radius_m**2) / (2.0 * radius_m)
        error = jnp.stack([outside, z, outside * x / radius_m, outside * y / radius_m])
        square = outside**2 + z**2
    else:
        error = jnp.stack([x, y, z])
        square = jnp.sum(error**2, axis=0)
    near = jnp.maximum(0.0, 1.0 - square / integrator.radius_m**2)
    return jnp.clip(total + dt_s * error * near**2, -integrator.limit_m_s, integrator.limit_m_s)


def observe(flight: Flight, previous_action: bool, target: Target | None = None) -> chex.Array:
    """What a policy observes: the measured body [18], relative to the target if there is one, then the target's preview
    [3k], then its memory: previous action [N], integral [k].
    """
    memory = [flight.previous_action] if previous_action else []
    memory += [] if isinstance(flight.integral_m_s, tuple) else [flight.integral_m_s]
    if target is None:
        return jnp.concatenate([quadrotor.observe(flight.sensed), *memory])
    return jnp.concatenate([quadrotor.observe(relative(flight.sensed, target)), target.preview_m_s, *memory])


def relative(body: Body, target: Target) -> Body:
    """`body` with position and velocity relative to a target."""
    (position, attitude), (velocity, rate) = body
    return Body(Pose(position - target.position_m, attitude), Twist(velocity - target.velocity_m_s, rate))


def _inertia(physics: Physics) -> chex.Array:
    """The mean of the numbers of the inertia []."""
    inertia = physics.inertia_kg_m2
    return jnp.mean(inertia, axis=tuple(range(inertia.ndim - physics.mass_kg.ndim)))


PRIVILEGED = 14  # numbers of `privileged`, besides one for each motor


def privileged(flight: Flight, nominal: Physics, dt_s: float, own: bool = False) -> chex.Array:
    """What only a critic may see, about 1 in size: three numbers of force and of torque, six of the vehicle, latency,
    drag; rotor speeds [N]. With `own`, of a vehicle that may be far from the nominal one.
    """
    world = flight.world

    def of(ratio: chex.Array) -> chex.Array:
        return jnp.log(ratio) if own else 4.0 * (ratio - 1.0)

    motors = world.motor_factor * world.physics.motor_max_N / nominal.motor_max_N if own else world.motor_factor
    weight_N = nominal.mass_kg * nominal.gravity_m_s2
    acting = disturbance(flight)
    drag = jnp.mean(acting.drag_N_s_m, axis=0)
    push = acting.force_N + drag * acting.wind_m_s
    roll = jnp.min(jnp.sum(jnp.abs(nominal.motor_torque_m[:2]), axis=1), axis=0) * jnp.mean(
        nominal.hover_thrust_N, axis=0
    )
    factors = jnp.stack(
        [
            of(world.physics.mass_kg / nominal.mass_kg),
            of(jnp.mean(motors, axis=0)),
            of(_inertia(world.physics) / _inertia(nominal)),
            10.0 * world.rotors.rise_s,
            10.0 * world.rotors.fall_s,
            world.latency_s / dt_s,
            drag / nominal.mass_kg,
            world.sensors.noise.position_m * 100.0,
        ]
    )
    return jnp.concatenate([5.0 * push / weight_N, 20.0 * world.disturbance.torque_N_m / roll, factors, flight.speed])

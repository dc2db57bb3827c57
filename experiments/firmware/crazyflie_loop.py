"""The emitted app for a Crazyflie in the loop: compiled for a PC, at 1 kHz in the plant, in the firmware's units."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from qrl.export import kernel as reference
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy
from qrl_envs import plant, quadrotor, rotation, rotors
from qrl_envs.quadrotor import Body, Pose, Twist
from qrl_envs.uncertainty import Uncertainty
from qrl_envs.vehicle import Vehicle

SHIM = Path(__file__).parent / "crazyflie_shim.c"
STEP_S = 0.001  # of the stabilizer
PARTS = (3, 6, 10, 13)  # of a flight: position, velocity, quaternion w x y z, body rates [rad/s], rotor speeds
STRICT = ("-Wall", "-Wextra", "-Werror")
IN, OUT = 32, 6
POLICY = 1  # `qrl.state`
# M1 to M4: body x and y are of these signs (documentation of the Crazyflie 2.1, beside its firmware).
CORNERS = ((1, -1), (-1, -1), (-1, 1), (1, 1))
Floats = NDArray[np.floating]


class Firmware(NamedTuple):
    """What an app is compiled against."""

    includes: tuple[Path, ...]
    flags: tuple[str, ...]  # the platform, and what the headers themselves need
    sources: tuple[Path, ...] = ()  # of the firmware, linked


class Mutant(NamedTuple):
    """A mistake in the app's source."""

    old: str
    new: str


def build(app: Path, firmware: Firmware, out: Path, *mutants: Mutant) -> Path:
    """The library `out` of the app in the folder `crazyflie/` of an export; ValueError if a mutant's text is not in it.

    Without mutants, a warning fails, and the kernel and the firmware's sources are compiled; with them, those of the
    same folder as `out` are linked.
    """
    source = next(app.glob("src/*_controller.c"))
    text = source.read_text(encoding="utf-8")
    for mutant in mutants:
        if mutant.old not in text:
            raise ValueError(f"not in {source}: {mutant.old}")
    # Together: one's new text may hold another's old.
    olds = {mutant.old: mutant.new for mutant in mutants}
    text = re.sub("|".join(map(re.escape, olds)) or "$^", lambda match: olds[match[0]], text)
    out.parent.mkdir(parents=True, exist_ok=True)
    mutated, kernel, stock = out.with_suffix(".c"), out.with_name("kernel.o"), out.with_name("stock.o")
    mutated.write_text(text, encoding="utf-8")
    includes = [f"-I{folder}" for folder in (source.parent, *firmware.includes)]
    common = ("gcc", "-std=gnu11", "-fPIC", *firmware.flags, *includes)
    if not mutants:
        run(*common, "-O2", *STRICT, "-c", str(source), "-o", str(out.with_name("app.o")))
        run(
            *common,
            "-O2",
            *STRICT,
            "-c",
            str(source.with_name(source.name.replace("_controller", ""))),
            "-o",
            str(kernel),
        )
        if firmware.sources:  # theirs, whose warnings are not ours
            run(*common, "-O1", "-w", "-r", "-nostdlib", *map(str, firmware.sources), "-o", str(stock))
    objects = [str(kernel), *([str(stock)] if firmware.sources else [])]
    run(*common, "-O0", "-w", "-shared", f'-DAPP="{mutated}"', str(SHIM), *objects, "-lm", "-o", str(out))
    return out


def run(*command: str) -> None:
    """Run a compiler; RuntimeError with what it says if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")


class App:
    """One vehicle's firmware: a library of its own, since the app's state is static."""

    def __init__(self, library: Path) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.thrust_max_N.restype = self._library.thrust_min_N.restype = ctypes.c_float
        self.thrust_max_N, self.thrust_min_N = self._library.thrust_max_N(), self._library.thrust_min_N()
        self._in, self._out = np.zeros(IN, np.float32), np.zeros(OUT, np.int32)
        self._pointers = self._in.ctypes.data_as(ctypes.c_void_p), self._out.ctypes.data_as(ctypes.c_void_p)
        self.now = 0
        self.simple_stock = bool(self._library.simple_stock())  # the shim's, whose order is known
        self.passed = bool(self._library.boot())

    def arm(self, on: bool = True) -> None:
        self._library.set_arm(int(on))

    def tick(self, numbers: Floats, steps: int = 1) -> NDArray[np.int32]:
        """The next step, of numbers [IN] as the shim's `tick` takes them; [OUT]. `steps`: how far its count goes on."""
        self._in[:] = numbers
        self.now += steps
        self._library.tick(ctypes.c_uint32(self.now), *self._pointers)
        return self._out.copy()

    def counts(self) -> list[int]:
        """Take-overs, clipped steps."""
        found = np.zeros(2, np.uint32)
        self._library.counts(found.ctypes.data_as(ctypes.c_void_p))
        return found.tolist()


def apps(library: Path, number: int, first: int = 0) -> list[App]:
    """As many, armed, each from a copy of the library, numbered from `first`."""
    found = []
    for i in range(first, first + number):
        own = library.with_name(f"{library.stem}_{i}.so")
        own.unlink(missing_ok=True)  # a library that is loaded keeps its file
        shutil.copyfile(library, own)
        found.append(App(own))
        found[-1].arm()
    return found


class Reference(NamedTuple):
    """A reference at one time, world [3] each."""

    position_m: Floats
    velocity_m_s: Floats
    acceleration_m_s2: Floats
    jerk_m_s3: Floats
    yaw_deg: float = 0.0


REST = Reference(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
Ordered = Callable[[int, Floats, Reference], Floats]  # step, states [n, 13], reference -> thrusts [n, motors]


def numbers(state: Floats, reference: Reference) -> NDArray[np.float32]:
    """Those of `App.tick` [n, IN], for states [n, 13]: position, velocity, quaternion w x y z, body rates [rad/s]."""
    found = np.zeros((len(state), IN), np.float32)
    found[:, :6] = state[:, :6]
    found[:, 6:10] = state[:, [7, 8, 9, 6]]
    found[:, 10:13] = np.rad2deg(state[:, 10:13])
    found[:, 13:25] = np.concatenate(reference[:4])
    found[:, 25] = reference.yaw_deg
    found[:, 29:31] = 1.0
    return found


def corner(position_m: Sequence[float] | None) -> tuple[int, int]:
    """Signs of x and y."""
    assert position_m
    return int(np.sign(position_m[0])), int(np.sign(position_m[1]))


class World:
    """A vehicle in the plant, nothing of it uncertain; n flights at once."""

    def __init__(self, vehicle: Vehicle, step_s: float = STEP_S) -> None:
        self.vehicle, self.step_s = vehicle, step_s
        physics = quadrotor.physics(vehicle)
        world = plant.draw(
            plant.ranges(Uncertainty(), vehicle), physics, jnp.full(plant.DRAWS + len(vehicle.motors), 0.5)
        )

        def step(flight: jax.Array, thrust_N: jax.Array) -> jax.Array:
            position, velocity, attitude, rate, speed = jnp.split(flight, PARTS)
            late_s = jnp.float32(0.0)
            set_point = rotors.speed_of(world.rotors.curve, thrust_N / physics.motor_max_N)
            body, speed = plant.advance(
                world,
                world.disturbance,
                Body(Pose(position, attitude), Twist(velocity, rate)),
                speed,
                (set_point, set_point),
                late_s,
                step_s,
            )
            return jnp.concatenate(
                [body.pose.position_m, body.twist.velocity_m_s, body.pose.attitude, body.twist.body_rate_rad_s, speed]
            )

        self._step = jax.jit(jax.vmap(step))
        self.min_N = np.array([motor.min_N for motor in vehicle.motors])
        self.max_N = np.array([motor.max_N for motor in vehicle.motors])
        # Of each motor, which of M1 to M4 it is.
        self.crazyflie = [CORNERS.index(corner(motor.position_m)) for motor in vehicle.motors]

    def begin(self, state: Floats) -> NDArray[np.float32]:
        """Flights [n, 17]: of states [n, 13], and the rotor speeds of hover."""
        return np.concatenate([state, np.tile(self.vehicle.hover_speeds, (len(state), 1))], axis=1).astype(np.float32)

    def step(self, flights: NDArray[np.float32], thrust_N: Floats) -> NDArray[np.float32]:
        """One step under thrusts [n, motors]."""
        return np.asarray(self._step(flights, np.minimum(thrust_N, self.max_N).astype(np.float32)))


def flown(
    world: World, start: Floats, seconds: float, thrust_N: Ordered, follow: Callable[[float], Reference] | None = None
) -> Floats:
    """States [steps, n, 13] from `start` [n, 13]; `follow(t)`: the reference, at rest without."""
    flights = world.begin(start)
    found = [start]
    for step in range(round(seconds / world.step_s)):
        ordered = thrust_N(step, found[-1], follow(step * world.step_s) if follow else REST)
        flights = world.step(flights, ordered)
        found.append(flights[:, :13].astype(np.float64))
    return np.stack(found)


def by_app(world: World, vehicles: Sequence[App]) -> Ordered:
    """Thrusts as the firmware of each vehicle orders them, cut and rounded as its motors' driver does."""
    most, least = vehicles[0].thrust_max_N, vehicles[0].thrust_min_N

    def thrust_N(_: int, state: Floats, reference: Reference) -> Floats:
        ratios = np.array([app.tick(row)[:4] for app, row in zip(vehicles, numbers(state, reference), strict=True)])
        ordered = np.clip(ratios, 0, 65535) / 65535 * most
        return np.where(ordered < least, 0.0, ordered)[:, world.crazyflie]

    return thrust_N


def by_kernel(
    world: World, policy: Policy, kernel: Kernel, n: int, preview: Callable[[float], Floats] | None = None
) -> Ordered:
    """Thrusts of the bare kernel, given what it was trained with, in the world turned by the reference's heading.

    `preview(t)` [3k]: of the reference, world; at rest without.
    """
    every, previews = round(policy.control_period_s / world.step_s), len(policy.observations) - 18
    speeds, c = policy.actions[0].quantity is not None, world.vehicle.thrust_curve
    of_port = [CORNERS.index(corner(port.position_m)) for port in policy.actions]
    order = [of_port.index(motor) for motor in world.crazyflie]  # the action of each motor of the vehicle
    thrust, memory = np.zeros((n, 4)), reference.initial_state(kernel, n)

    def thrust_N(step: int, state: Floats, now: Reference) -> Floats:
        nonlocal thrust, memory
        if step % every == 0:
            c_yaw, s_yaw = np.cos(np.deg2rad(now.yaw_deg)), np.sin(np.deg2rad(now.yaw_deg))
            turn = np.array([[c_yaw, s_yaw, 0.0], [-s_yaw, c_yaw, 0.0], [0.0, 0.0, 1.0]])
            attitude = turn @ np.asarray(_matrices(jnp.asarray(state[:, 6:10], jnp.float32)))
            relative = [(state[:, 0:3] - now.position_m) @ turn.T, (state[:, 3:6] - now.velocity_m_s) @ turn.T]
            ahead = (preview(step * world.step_s) if preview else np.zeros(previews)).reshape(-1, 3) @ turn.T
            parts = [attitude.reshape(n, 9), *relative, state[:, 10:13], np.broadcast_to(ahead.ravel(), (n, previews))]
            obs = np.concatenate(parts, axis=1).astype(np.float32)
            memory, _, action = reference.step(kernel, memory, obs)
            action = action[:, order]
            thrust = world.max_N * action * (c + (1 - c) * action) if speeds else action
            thrust = np.maximum(thrust, world.min_N)  # as the plant of training does
        return thrust

    return thrust_N


_matrices = jax.jit(jax.vmap(rotation.matrix))


def starts(n: int, seed: int = 0, distance_m: float = 1.0, speed_m_s: float = 1.0, tilt_rad: float = 1.0) -> Floats:
    """States [n, 13], tilted up to `tilt_rad` about any horizontal axis, of any heading up to as much."""
    rng = np.random.default_rng(seed)
    axis, tilt, yaw = rng.uniform(-np.pi, np.pi, n), tilt_rad * rng.uniform(-1, 1, n), tilt_rad * rng.uniform(-1, 1, n)
    level = np.stack([np.cos(tilt / 2), np.sin(tilt / 2) * np.cos(axis), np.sin(tilt / 2) * np.sin(axis), 0 * tilt], 1)
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, _ = level.T
    attitude = np.stack([c * w, c * x - s * y, c * y + s * x, s * w], axis=1)
    moving = rng.uniform(-1, 1, (n, 3)) * distance_m, rng.uniform(-1, 1, (n, 3)) * speed_m_s
    return np.concatenate([*moving, attitude, rng.uniform(-1, 1, (n, 3))], axis=1)

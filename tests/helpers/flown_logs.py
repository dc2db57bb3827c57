"""Flights of a quadrotor simulated with NumPy alone, as logs for `qrl identify`: its oracle shares no code with it."""

from pathlib import Path
from typing import Any

import numpy as np

G_M_S2, PERIOD_S, STEP_S = 9.81, 0.01, 0.005


class Truth:
    """The vehicle that flew; made of the file of another one, `data`, whose numbers `changes` replace."""

    def __init__(self, data: dict[str, Any], **changes: Any) -> None:
        data = {**data, **changes}
        self.mass, self.inertia = data["mass_kg"], np.array(data["inertia_kg_m2"])
        self.place = np.array([m["position_m"] for m in data["motors"]])  # [4, 2]
        self.spin = np.array([m["spin"] for m in data["motors"]])
        self.most = np.array([m["max_N"] for m in data["motors"]]) * np.array(data.get("thrust_factors", [1.0] * 4))
        self.yaw, self.curve = data["yaw_moment_m"], data["thrust_curve"]
        self.rise, self.fall = data["rotor_rise_s"], data["rotor_fall_s"]
        self.drag, self.height = np.array(data["drag_N_s_m"]), data.get("drag_height_m", 0.0)
        # Thrusts to total thrust and torques.
        self.mix = np.stack([np.ones(4), self.place[:, 1], -self.place[:, 0], self.yaw * self.spin])

    def thrust(self, speed: np.ndarray) -> np.ndarray:
        return self.most * (self.curve * speed + (1.0 - self.curve) * speed**2)

    def speed(self, thrust: np.ndarray) -> np.ndarray:
        a, b = 1.0 - self.curve, self.curve
        return np.clip((-b + np.sqrt(b * b + 4.0 * a * np.clip(thrust / self.most, 0.0, 1.0))) / (2.0 * a), 0.0, 1.0)

    def rates(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """d/dt of [F, 17]: position, quaternion, velocity, body rates, rotor speeds."""
        q, v, w, speed = x[:, 3:7], x[:, 7:10], x[:, 10:13], x[:, 13:]
        r = rotations(q)
        thrust = self.thrust(speed)
        air = np.einsum("fji,fj->fi", r, v)
        force = np.concatenate([np.zeros((len(x), 2)), thrust.sum(axis=1, keepdims=True)], axis=1) - self.drag * air
        torque = thrust @ self.mix[1:].T + np.cross([0.0, 0.0, self.height], -self.drag * air)
        turn = (torque - np.cross(w, self.inertia * w)) / self.inertia
        s, a = q[:, :1], q[:, 1:]
        q_dot = 0.5 * np.concatenate([-np.sum(a * w, axis=1, keepdims=True), s * w + np.cross(a, w)], axis=1)
        fall = np.einsum("fij,fj->fi", r, force) / self.mass - [0.0, 0.0, G_M_S2]
        return np.concatenate([v, q_dot, fall, turn, (u - speed) / np.where(u > speed, self.rise, self.fall)], axis=1)


def rotations(q: np.ndarray) -> np.ndarray:
    """[F, 4] -> [F, 3, 3] body to world."""
    w, (a, b, c) = q[:, 0], q[:, 1:].T
    rows = [
        [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
        [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
        [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def fly(truth: Truth, seconds: float, flights: int, seed: int, shake: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """States [F, K + 1, 13] and commanded speed fractions [F, K, 4] of flights about hover under an attitude controller
    that wanders and, by `shake`, jerks its thrusts; by Runge–Kutta's fourth-order method.
    """
    rng = np.random.default_rng(seed)
    x = np.zeros((flights, 17))
    x[:, 3], hover = 1.0, truth.mass * G_M_S2 / 4.0
    x[:, 13:] = truth.speed(np.full((flights, 4), hover))
    inverse = np.linalg.inv(truth.mix)
    states, commands = [x[:, :13]], []
    wanted, lift, jerk = np.zeros((flights, 2)), np.ones(flights), np.zeros((flights, 4))
    for k in range(round(seconds / PERIOD_S)):
        if k % 40 == 0:
            wanted, lift = (
                rng.uniform(-0.35, 0.35, (flights, 2)) * shake,
                1.0 + 0.2 * shake * rng.uniform(-1, 1, flights),
            )
            wanted -= 0.1 * np.einsum("fji,fj->fi", rotations(x[:, 3:7]), x[:, 7:10])[:, [1, 0]] * [-1, 1]
        if k % 7 == 0:
            jerk = 0.08 * shake * hover * rng.uniform(-1, 1, (flights, 4))
        tilt = 2.0 * x[:, 4:6] * np.sign(x[:, 3:4])
        turn = np.concatenate([60.0 * (wanted - tilt) - 12.0 * x[:, 10:12], -4.0 * x[:, 12:13]], axis=1) * truth.inertia
        lifted = (truth.mass * (G_M_S2 * lift - 2.0 * x[:, 9]))[:, None]
        u = truth.speed(np.concatenate([lifted, turn], axis=1) @ inverse.T + jerk)
        for _ in range(round(PERIOD_S / STEP_S)):
            a = truth.rates(x, u)
            b = truth.rates(x + STEP_S / 2 * a, u)
            c = truth.rates(x + STEP_S / 2 * b, u)
            x = x + STEP_S / 6 * (a + 2 * b + 2 * c + truth.rates(x + STEP_S * c, u))
            x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
        commands.append(u)
        states.append(x[:, :13])
    return np.stack(states, axis=1), np.stack(commands, axis=1)


COLUMNS = [
    "time_s",
    "x_m",
    "y_m",
    "z_m",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx_m_s",
    "vy_m_s",
    "vz_m_s",
    "wx_rad_s",
    "wy_rad_s",
    "wz_rad_s",
]


def write(path: Path, states: np.ndarray, commands: np.ndarray, names: str = "u{}", rates: bool = True) -> Path:
    """One flight's states [K + 1, 13] and commands [K, N] as a CSV file; without `rates` without velocity and rates."""
    kept = len(COLUMNS) if rates else 8
    times = PERIOD_S * np.arange(len(commands))[:, None]
    data = np.concatenate([times, states[:-1, : kept - 1], commands], axis=1)
    header = ",".join([*COLUMNS[:kept], *(names.format(i + 1) for i in range(commands.shape[1]))])
    np.savetxt(path, data, fmt="%.9g", delimiter=",", header=header, comments="")
    return path

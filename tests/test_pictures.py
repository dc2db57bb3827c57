"""Pictures of flights and learning curves: drawn on made-up data, read back from the axes and from the PNG."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from qrl import plots
from qrl_envs import picture, task
from qrl_envs.task import Task

Array = np.ndarray


def point_mass(name: str, n: int, steps: int, seed: int = 0) -> Array:
    """Flights [n, steps + 1, 18] of a point that accelerates towards the wanted motion and rights itself meanwhile."""
    rng = np.random.default_rng(seed)
    p, v = rng.uniform(-2, 2, (n, 3)), rng.uniform(-1, 1, (n, 3))
    tilt, flights = np.arccos(rng.uniform(-1, 1, n)), np.zeros((n, steps + 1, 18))
    axis = rng.uniform(0, 2 * np.pi, n)
    for k in range(steps + 1):
        c, s = np.cos(tilt), np.sin(tilt)
        flights[:, k, 8], flights[:, k, 2], flights[:, k, 5] = c, s * np.cos(axis), s * np.sin(axis)
        flights[:, k, 9:12], flights[:, k, 12:15] = p, v
        wanted = -1.5 * p
        if name == "circle":
            r = np.hypot(p[:, 0], p[:, 1]) + 1e-3
            along = np.stack([-p[:, 1], p[:, 0], 0 * r], -1) / r[:, None]
            wanted = 2 * along + 2.5 * p * np.stack([1 / r - 1, 1 / r - 1, -1 + 0 * r], -1)
            wanted -= 0.65 * p * [1, 1, 0] * np.minimum(1 / r, 1)[:, None]  # towards the centre, to turn
        push = 6 * (wanted - v)
        push *= np.minimum(1, 9 / np.linalg.norm(push, axis=1, keepdims=True)) * np.maximum(c, 0)[:, None]
        push[:, 2] -= 9.81 * (1 - np.maximum(c, 0.0)) * (c < 0.8)
        p, v = p + 0.01 * v, v + 0.01 * push
        tilt = tilt + 0.01 * (-4 * tilt + 0.1 * rng.normal(size=n))
    return flights


def pendulums(n: int, steps: int, seed: int = 0) -> Array:
    """Flights [n, steps + 1, 3]: pumped up by their energy, then held."""
    rng = np.random.default_rng(seed)
    theta, rate = rng.uniform(-np.pi, np.pi, n), rng.uniform(-1, 1, n)
    flights = np.zeros((n, steps + 1, 3))
    for k in range(steps + 1):
        flights[:, k] = np.stack([np.cos(theta), np.sin(theta), rate], -1)
        wrapped = np.arctan2(np.sin(theta), np.cos(theta))
        energy = 15 * (np.cos(theta) - 1) + rate**2 / 2
        u = np.where(np.abs(wrapped) < 0.4, -10 * wrapped - 3 * rate, -2 * np.sign(energy * rate))
        rate = np.clip(rate + 0.05 * (15 * np.sin(theta) + 3 * np.clip(u, -2, 2)), -8, 8)
        theta = theta + 0.05 * rate
    return flights

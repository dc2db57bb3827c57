"""Flights that failed: from which start, and how, so that each can be flown again."""

from typing import Any

import numpy as np

from qrl_envs.task import QuadrotorTask, Task


def starts(success: np.ndarray) -> list[int]:
    """The indices of the flights that failed, for `success` [n], 0 or 1 each."""
    return [int(i) for i in np.flatnonzero(~(np.asarray(success) > 0))]


def listed(task: Task, observations: np.ndarray, success: np.ndarray, most: int) -> list[dict[str, Any]]:
    """Of the first `most` flights that failed: the index of the start, what it was, and why it failed.

    `observations` [n, K + 1, F] are NaN from where an episode ended early, as those of an evaluation are. Reasons:
    "fled" or "tumbled" beyond the task's bounds, "did not settle" by the end, or "not finite".
    """
    return [
        {"start": i, **_start(task, observations[i, 0]), "reason": _reason(task, observations[i])}
        for i in starts(success)[:most]
    ]


def tilt_deg(observations: np.ndarray) -> np.ndarray:
    """Angle between body z and world z [°] of a quadrotor's observations [..., 18]; [...]."""
    return np.degrees(np.arccos(np.clip(observations[..., 8], -1.0, 1.0)))


def speed_m_s(observations: np.ndarray) -> np.ndarray:
    """‖v‖ of a quadrotor's observations [..., 18]; [...]."""
    return np.linalg.norm(observations[..., 12:15], axis=-1)


def _start(task: Task, seen: np.ndarray) -> dict[str, Any]:
    if not isinstance(task, QuadrotorTask):
        return {"angle_rad": float(np.arctan2(seen[1], seen[0])), "rate_rad_s": float(seen[2])}
    return {
        "tilt_deg": float(tilt_deg(seen)),
        "speed_m_s": float(speed_m_s(seen)),
        "position_m": [float(x) for x in seen[9:12]],
        "velocity_m_s": [float(x) for x in seen[12:15]],
        "body_rate_rad_s": [float(x) for x in seen[15:18]],
    }


def _reason(task: Task, seen: np.ndarray) -> str:
    over = np.flatnonzero(~np.isfinite(seen).all(axis=1))
    if not len(over):
        return "did not settle"
    if not isinstance(task, QuadrotorTask) or not over[0]:
        return "not finite"
    # The last that was seen is within the bounds; which of them it was about to leave, a step's motion tells.
    last = seen[over[0] - 1]
    ahead_m = np.linalg.norm(last[9:12] + task.control_period_s * last[12:15])
    near_distance = ahead_m / task.bounds.distance_m
    near_rate = np.linalg.norm(last[15:18]) / task.bounds.body_rate_rad_s
    return "fled" if near_distance >= near_rate else "tumbled"

"""Labels of the errors of `measures`."""

import numpy as np

from qrl_envs.measures import Measured

ERRORS = {  # name in measures.py -> label; unit; name of its tolerance in the task's `evaluation`
    "position_m": ("distance to target", "m", "distance_m"),
    "radius_m": ("radius error", "m", "distance_m"),
    "height_m": ("height error", "m", "distance_m"),
    "speed_m_s": ("speed error", "m/s", "speed_m_s"),
    "angle_rad": ("angle error", "rad", "angle_rad"),
}


def successes(found: Measured) -> str:
    """The number of flights that succeed, in words."""
    return f"{np.sum(found.success):,} of {len(found.success):,} flights succeed"

"""Success and steady-state error under off-nominal conditions, beside classical controllers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from qrl_envs.plots.frame import COLORS, empty, finish, legend, save
from qrl_envs.task import Task

LEAST_M = 1e-5  # of the logarithmic axis


def draw(path: Path, task: Task, results: Mapping[str, Any]) -> None:
    save(path, figure(task, results))


def figure(task: Task, results: Mapping[str, Any]) -> Figure:
    """For each controller by name what evaluation.json has of it, with its key "off_nominal". Axes: success [%], and
    the first steady-state error; a row a condition. An error is drawn where the median flight settles.
    """
    names = list(next(iter(results.values()))["off_nominal"])
    error = next(key for key in results["policy"] if key.startswith("rms_"))
    drawn = empty(task, height_in=1.8 + 0.32 * len(names))
    success, steady = drawn.subplots(1, 2, sharey=True)
    rows, height = np.arange(len(names)), 0.8 / len(results)
    for i, (label, result) in enumerate(results.items()):
        flown = [result["off_nominal"][name] for name in names]
        at = rows + (i - (len(results) - 1) / 2) * height
        success.barh(at, [100 * one["success"] for one in flown], height, color=COLORS[i], label=label)
        values = np.array([one[error] for one in flown], float)
        settled = np.isfinite(values) & np.array([one["success"] >= 0.5 for one in flown])
        steady.plot(np.maximum(values[settled], LEAST_M), at[settled], "o", color=COLORS[i], label=label)
    success.set(xlabel="success [%]", xlim=(0.0, 100.0), yticks=rows, yticklabels=names)
    success.invert_yaxis()
    most = max([LEAST_M, *(x for line in steady.lines for x in line.get_xdata())])
    steady.set(xlim=(LEAST_M / 2, 2 * most))  # before the scale, which needs a positive limit where nothing settled
    steady.set(xlabel=f"{error.removeprefix('rms_')}, RMS in the steady state", xscale="log")
    for axes, title in ((success, "flights that succeed"), (steady, "error where half of the flights or more succeed")):
        finish(axes, title)
    legend(drawn)
    return drawn

"""Whether a policy does its task, and if not, why."""

import math
from typing import NamedTuple

from qrl import tasks
from qrl.runs.record import TaskRecord
from qrl_envs.task import QuadrotorTask

FLIES = 0.99  # success from which a policy is said to do its task


class Verdict(NamedTuple):
    flies: bool | None  # None where success is not measured
    reason: str | None  # where it does not fly: one line

    @property
    def entry(self) -> dict[str, bool | str | None]:
        """Its keys in summary.json and evaluation.json."""
        return {"flies": self.flies} | ({"reason": self.reason} if self.reason else {})


def verdict(record: TaskRecord, success: float) -> Verdict:
    """That on a policy that succeeds from this share of starts, flown under the uncertainty of its training.

    Where that leaves out its vehicle's own lag, no success there says that it flies the vehicle.
    """
    reasons = []
    if not math.isnan(success) and success < FLIES:
        reasons.append(f"it succeeds from only {success:.1%} of the starts")
    task = tasks.spec(record) if record.spec else None
    if isinstance(task, QuadrotorTask) and task.lag_not_trained:
        reasons.append(f"{task.lag_not_trained}, with which it was not trained")
    if reasons:
        return Verdict(False, "; ".join(reasons))
    return Verdict(None if math.isnan(success) else True, None)

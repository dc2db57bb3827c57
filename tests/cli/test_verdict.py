"""Whether a policy flies is said of the vehicle that it is for."""

import math

import pytest

from qrl.cli.verdict import Verdict, verdict
from qrl.runs.record import TaskRecord
from qrl_envs import task


def record(name: str, vehicle: str | None = None, **uncertainty: tuple[float, float]) -> TaskRecord:
    spec = task.load(name, vehicle).model_dump(mode="json", exclude_none=True)
    return TaskRecord(name=name, spec=spec | ({"uncertainty": uncertainty} if uncertainty else {}))


@pytest.mark.parametrize(("success", "flies"), [(1.0, True), (0.99, True), (0.98, False), (math.nan, None)])
def test_success_decides_where_the_lag_was_trained_with(success: float, flies: bool | None) -> None:
    for one in (record("hover"), record("hover", "crazyflie"), record("pendulum"), TaskRecord(name="fast", spec=None)):
        said = verdict(one, success)
        assert said.flies is flies
        assert (said.reason is None) == (flies is not False)
        assert said.entry == ({"flies": flies, "reason": said.reason} if flies is False else {"flies": flies})


@pytest.mark.parametrize("success", [1.0, 0.5, math.nan])
def test_none_flies_a_vehicle_whose_lag_it_has_not_met(success: float) -> None:
    without = record("hover", "crazyflie", rotor_lag_s=(0.0, 0.0))
    said = verdict(without, success)
    assert said.flies is False
    assert said.reason
    assert "own lag of 72 ms" in said.reason
    assert ("50.0%" in said.reason) == (success == 0.5)
    assert verdict(record("hover", "crazyflie", rotor_lag_s=(0.0, 0.1)), 1.0) == Verdict(True, None)

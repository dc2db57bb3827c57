"""Statistics over seeds: those of Agarwal et al., *Deep RL at the Edge of the Statistical Precipice* (2021)."""

import math
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats


class Interval(NamedTuple):
    """An interquartile mean over seeds, and its bootstrap interval of 95 %; NaN where there is none."""

    iqm: float
    low: float
    high: float


def interquartile_mean(values: np.ndarray) -> Interval:
    """The mean of the middle half of `values` [seeds], and its percentile bootstrap; one value has no interval."""
    iqm = partial(stats.trim_mean, proportiontocut=0.25)
    if len(values) == 0:
        return Interval(math.nan, math.nan, math.nan)
    low = high = math.nan
    if len(values) > 1:
        with warnings.catch_warnings(action="ignore"), np.errstate(invalid="ignore"):  # about what is infinite
            interval = stats.bootstrap((values,), iqm, method="percentile", rng=np.random.default_rng(0))
        low, high = map(float, interval.confidence_interval)
    with np.errstate(invalid="ignore"):
        return Interval(float(iqm(values)), low, high)


def format_interval(values: np.ndarray, form: str = ".1f") -> str:
    """Interquartile mean [95 % interval] of `values` [seeds]; a dash where one was not measured."""
    if np.isnan(values).any():
        return "–"
    found = interquartile_mean(values)
    interval = "" if math.isnan(found.low) and len(values) == 1 else f" [{found.low:{form}}, {found.high:{form}}]"
    return f"{found.iqm:{form}}{interval}"

"""Statistics of small samples: spread, bootstrap intervals of means, intervals of shares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from planning.randomness import stream

Floats = NDArray[np.float64]

LEVEL = 0.95
"""Of every interval."""
DRAWS = 10_000
_FEWEST = 3


@dataclass(frozen=True)
class Interval:
    """An estimate with the ends of its interval; the ends are NaN where the sample is too small for one."""

    mean: float
    low: float
    high: float


def spread(values: Sequence[float]) -> tuple[float, float]:
    """(mean, standard deviation with n - 1); NaN where there are too few values."""
    array = np.asarray(values, np.float64)
    return (
        float(array.mean()) if array.size else math.nan,
        float(array.std(ddof=1)) if array.size > 1 else math.nan,
    )


def resampled_means(values: Floats, rng: np.random.Generator, draws: int = DRAWS) -> Floats:
    """Means of `draws` samples with replacement along the first axis. values: (n, ...); gives (draws, ...)."""
    n = len(values)
    counts = rng.multinomial(n, np.full(n, 1.0 / n), size=draws)
    return np.asarray(np.tensordot(counts / n, values, axes=1))


def bootstrap_mean(values: Sequence[float], *names: str | int) -> Interval:
    """Percentile bootstrap of the mean (Efron and Tibshirani 1993, section 13.3); of the names' random stream.

    With less than three values there is no interval; with few it is too narrow, as every percentile bootstrap is.
    """
    array = np.asarray(values, np.float64)
    if array.size < _FEWEST:
        return Interval(spread(values)[0], math.nan, math.nan)
    means = resampled_means(array, stream(0, "bootstrap", *names))
    low, high = np.quantile(means, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return Interval(float(array.mean()), float(low), float(high))


def share_interval(count: int, total: int) -> Interval:
    """A share with Wilson's interval (Wilson 1927), which also holds for none and for all."""
    if total == 0:
        return Interval(math.nan, math.nan, math.nan)
    found = binomtest(count, total).proportion_ci(LEVEL, method="wilson")
    return Interval(count / total, float(found.low), float(found.high))

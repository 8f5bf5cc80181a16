"""Intervals against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from planning.randomness import stream
from plgrim.evaluation.statistics import bootstrap_mean, resampled_means, share_interval, spread


@pytest.mark.parametrize(("total", "ones"), [(10, 5), (10, 2), (40, 10)])
def test_the_interval_of_zeros_and_ones_is_that_of_a_binomial(total: int, ones: int) -> None:
    """Means of resamples of zeros and ones are binomial: their quantiles are known."""
    found = bootstrap_mean([1.0] * ones + [0.0] * (total - ones), "test")
    share = ones / total
    low, high = (binom.ppf(q, total, share) / total for q in (0.025, 0.975))
    assert (found.mean, found.low, found.high) == pytest.approx((share, low, high))


def test_the_interval_of_many_values_is_normal() -> None:
    values = stream(1, "test").normal(5.0, 2.0, 400)
    found = bootstrap_mean(values.tolist(), "test")
    half = 1.96 * values.std() / math.sqrt(400)
    assert found.high - found.mean == pytest.approx(half, rel=0.05)
    assert found.mean - found.low == pytest.approx(half, rel=0.05)


@given(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=12))
def test_an_interval_lies_within_the_values_and_repeats(values: list[float]) -> None:
    found = bootstrap_mean(values, "test")
    assert min(values) - 1e-9 <= found.low <= found.high <= max(values) + 1e-9
    assert found == bootstrap_mean(values, "test")


def test_too_few_values_have_no_interval() -> None:
    assert math.isnan(bootstrap_mean([1.0, 3.0], "test").low)
    assert bootstrap_mean([1.0, 3.0], "test").mean == 2.0
    assert math.isnan(bootstrap_mean([], "test").mean)
    assert math.isnan(spread([1.0])[1])
    assert spread([1.0, 3.0]) == pytest.approx((2.0, math.sqrt(2.0)))


def test_curves_are_resampled_as_wholes() -> None:
    curves = np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]])
    means = resampled_means(curves, stream(1, "test"), 50)
    assert means.shape == (50, 2)
    assert np.allclose(means[:, 1], 2.0 * means[:, 0])


def test_a_share_of_none_has_an_upper_end() -> None:
    z = 1.959964
    found = share_interval(0, 10)
    assert (found.mean, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(z**2 / (10 + z**2), rel=1e-4)
    assert math.isnan(share_interval(0, 0).mean)

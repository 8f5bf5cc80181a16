"""The order of visits against all orders: exact, for every weight, with ways that are missing."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.latency_tour import MOST_PLACES, latency_tour

Floats = NDArray[np.float64]


def cost_of(order: tuple[int, ...], leg: Floats, gain: Floats, weight: float) -> float:
    """By the definition: length, and weight times gain times the way until there."""
    total, way, at = 0.0, 0.0, len(gain)
    for place in order:
        way += float(leg[at, place])
        total += weight * float(gain[place]) * way
        at = place
    return total + way


def places(seed: int, count: int) -> tuple[Floats, Floats]:
    """Legs between random places with a few detours, which make them asymmetric, and gains."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 50, (count + 1, 2))
    leg = np.hypot(*(xy[:, None] - xy[None, :count]).transpose(2, 0, 1)) * rng.uniform(
        1, 2, (count + 1, count)
    )
    return leg, rng.exponential(3.0, count)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6), st.sampled_from([0.0, 0.05, 0.4, 10.0]))
def test_it_is_the_best_of_all_orders_for_every_first_place(seed: int, count: int, weight: float) -> None:
    leg, gain = places(seed, count)
    found = latency_tour(leg, gain, weight)
    all_orders = list(itertools.permutations(range(count)))
    best = min(cost_of(o, leg, gain, weight) for o in all_orders)
    assert cost_of(tuple(found.order.tolist()), leg, gain, weight) == pytest.approx(best)
    for first in range(count):
        with_first = min(cost_of(o, leg, gain, weight) for o in all_orders if o[0] == first)
        assert found.first_cost[first] == pytest.approx(with_first)


def test_early_gain_decides_between_tours_of_like_length() -> None:
    # On a line: 1 m to the left a crumb, 2 m to the right much. The shorter tour begins with the crumb.
    xy = np.array([-1.0, 2.0, 0.0])
    leg = np.abs(xy[:, None] - xy[None, :2])
    assert latency_tour(leg, np.array([0.1, 5.0]), 0.0).order.tolist() == [0, 1]
    assert latency_tour(leg, np.array([0.1, 5.0]), 0.5).order.tolist() == [1, 0]


def test_a_place_without_way_from_the_start_is_not_the_first() -> None:
    leg = np.array([[0.0, 1.0], [1.0, 0.0], [np.inf, 5.0]])
    assert latency_tour(leg, np.ones(2), 0.1).order.tolist() == [1, 0]


def test_too_many_places_are_refused_by_number() -> None:
    with pytest.raises(ValueError, match=f"1 to {MOST_PLACES}"):
        latency_tour(np.zeros((16, 15)), np.zeros(15), 0.0)
    with pytest.raises(ValueError, match="got 0"):
        latency_tour(np.zeros((1, 0)), np.zeros(0), 0.0)

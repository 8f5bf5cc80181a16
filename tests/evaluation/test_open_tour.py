"""Open tours against brute force, and against their own definition of being finished."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.open_tour import improve_tour, nearest_neighbour_tour, tour_length
from planning.randomness import stream


def plane(count: int, seed: int) -> NDArray[np.float32]:
    """Distances between random points of the unit square."""
    points = stream(seed, "points").random((count, 2))
    found: NDArray[np.float64] = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    return found.astype(np.float32)


def graph(count: int, seed: int) -> NDArray[np.float32]:
    """Symmetric distances of no plane: the triangle inequality need not hold."""
    rows = stream(seed, "distances").random((count, count))
    found = (rows + rows.T).astype(np.float32)
    np.fill_diagonal(found, 0.0)
    return found


def improved(distance: NDArray[np.float32]) -> tuple[NDArray[np.int64], float, float]:
    """(order, length before, length after)."""
    order = nearest_neighbour_tour(distance)
    before = tour_length(distance, order)
    improve_tour(distance, order, 1000)
    return order, before, tour_length(distance, order)


def shortest(distance: NDArray[np.float32]) -> float:
    """By trying every order."""
    places = range(1, len(distance))
    return min(
        sum(float(distance[a, b]) for a, b in itertools.pairwise((0, *order)))
        for order in itertools.permutations(places)
    )


def moves(order: list[int]) -> list[list[int]]:
    """Every order that reversing one piece, or moving a short one, leads to; the first place stays."""
    found = []
    for i in range(1, len(order)):
        for j in range(i + 1, len(order) + 1):
            found.append(order[:i] + order[i:j][::-1] + order[j:])
            if j - i <= 3:
                piece, rest = order[i:j], order[:i] + order[j:]
                for k in range(1, len(rest) + 1):
                    found += [rest[:k] + piece + rest[k:], rest[:k] + piece[::-1] + rest[k:]]
    return found


def test_nearest_neighbour_goes_on_to_the_nearest() -> None:
    x = np.array([0.0, 10.0, 1.0, -2.0, 4.0])
    distance = np.abs(x[:, None] - x[None]).astype(np.float32)
    assert nearest_neighbour_tour(distance).tolist() == [0, 2, 3, 4, 1]
    assert tour_length(distance, nearest_neighbour_tour(distance)) == 1.0 + 3.0 + 6.0 + 6.0


@pytest.mark.parametrize("make", [plane, graph])
@given(count=st.integers(1, 14), seed=st.integers(0, 10_000))
def test_an_improved_tour_is_a_permutation_that_no_move_makes_shorter(
    make: object, count: int, seed: int
) -> None:
    distance = plane(count, seed) if make is plane else graph(count, seed)
    order, before, after = improved(distance)
    assert sorted(order.tolist()) == list(range(count))
    assert order[0] == 0
    assert after <= before + 1e-9
    for other in moves(order.tolist()):
        assert tour_length(distance, np.array(other)) > after - 1e-5


@given(count=st.integers(2, 7), seed=st.integers(0, 10_000))
def test_small_tours_are_near_the_shortest(count: int, seed: int) -> None:
    distance = plane(count, seed)
    after, best = improved(distance)[2], shortest(distance)
    assert after >= best - 1e-5
    assert after <= (best if count <= 4 else 1.25 * best) + 1e-5


def test_on_average_it_is_within_two_percent_of_the_shortest() -> None:
    gaps = [improved(d)[2] / shortest(d) for d in (plane(8, seed) for seed in range(20))]
    assert min(gaps) >= 1.0 - 1e-6
    assert np.mean(gaps) < 1.02


def test_many_places_gain_much_over_nearest_neighbour() -> None:
    order, before, after = improved(plane(600, 3))
    assert sorted(order.tolist()) == list(range(600))
    assert after < 0.92 * before


def test_passes_are_bounded() -> None:
    distance = plane(200, 1)
    order = nearest_neighbour_tour(distance)
    assert improve_tour(distance, order, 1) == 1
    assert improve_tour(distance, order, 1000) < 1000

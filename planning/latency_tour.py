"""The order of visits whose way is short and whose gain comes early, exactly, for a dozen places.

Cost of an order: the length of its way, and `weight` times the sum over the places of gain times the length of the way
until there (the minimum latency problem, Blum et al. 1994, on top of the open travelling salesman). What has been left
out of a tour is seldom as it seemed when the robot comes to it; early gain is worth having for that. A leg costs its
length times (1 + weight times the gain not yet visited), which depends on the set of places that are left and on
nothing else: so Held and Karp's recursion over sets (1962) is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

MOST_PLACES = 14
"""Time and memory double with each place: 14 take about 5 ms."""

Floats = NDArray[np.float64]


class LatencyTour(NamedTuple):
    """order: (n,) the places in the best order; first_cost: (n,) cost of the best order that begins with each."""

    order: NDArray[np.int64]
    first_cost: Floats


def latency_tour(leg: Floats, gain: Floats, weight: float) -> LatencyTour:
    """The cheapest order of all places.

    Args:
        leg: (n + 1, n), length of the way from place i to place j; row n: from the start. inf: no way.
        gain: (n,), at least 0.
        weight: of gain times way, against the way itself; 0: the shortest open tour.

    Raises:
        ValueError: no place, more than `MOST_PLACES`, or shapes that do not fit.
    """
    n = gain.shape[0]
    if not 1 <= n <= MOST_PLACES or leg.shape != (n + 1, n):
        raise ValueError(
            f"1 to {MOST_PLACES} places with legs (n + 1, n) are wanted, got {n} and {leg.shape}"
        )
    rest = np.zeros((1 << n, n))
    _solve(leg, gain, weight, rest)
    return LatencyTour(*_walk(leg, gain, weight, rest))


@njit
def _gain_of(places: int, gain: Floats) -> float:
    total = 0.0
    for k in range(gain.shape[0]):
        if places & (1 << k):
            total += gain[k]
    return total


@njit
def _solve(leg: Floats, gain: Floats, weight: float, rest: Floats) -> None:
    """rest: (2^n, n) out: least cost of visiting the set of places that are left from place i; zeros on entry."""
    n = gain.shape[0]
    for left in range(1, 1 << n):
        factor = 1.0 + weight * _gain_of(left, gain)
        for at in range(n):
            if left & (1 << at):
                continue
            best = np.inf
            for to in range(n):
                if left & (1 << to):
                    best = min(best, leg[at, to] * factor + rest[left ^ (1 << to), to])
            rest[left, at] = best


@njit
def _walk(leg: Floats, gain: Floats, weight: float, rest: Floats) -> tuple[NDArray[np.int64], Floats]:
    """The best order by the solved recursion, and what each first place costs; the lower index of equals."""
    n = gain.shape[0]
    left, at = (1 << n) - 1, n
    order, first_cost = np.empty(n, np.int64), np.empty(n)
    for step in range(n):
        factor = 1.0 + weight * _gain_of(left, gain)
        best, least = -1, np.inf
        for to in range(n):
            if left & (1 << to):
                cost = leg[at, to] * factor + rest[left ^ (1 << to), to]
                if step == 0:
                    first_cost[to] = cost
                if best < 0 or cost < least:
                    best, least = to, cost
        order[step] = best
        left ^= 1 << best
        at = best
    return order, first_cost

"""Open tours: an order in which to visit places from a fixed first one, without the way back.

Nearest neighbour, then 2-opt (Croes, 1958) and the moving of short pieces (Or, 1976) until neither makes the tour
shorter. The distances are symmetric: a piece costs the same the other way round.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

_LEAST_GAIN = 1e-6
"""Improvements below this are rounding."""
_LONGEST_PIECE = 3

Distances = NDArray[np.float32]


@njit
def tour_length(distance: Distances, order: NDArray[np.int64]) -> float:
    """Length of an open tour. distance: (n, n), order: (k,) indices into it."""
    total = 0.0
    for k in range(1, order.shape[0]):
        total += np.float64(distance[order[k - 1], order[k]])
    return total


@njit
def nearest_neighbour_tour(distance: Distances) -> NDArray[np.int64]:
    """From place 0 always on to the nearest place not yet visited; the lowest index of those as near.

    distance: (n, n), n >= 1. Returns the order, (n,), which begins with 0.
    """
    count = distance.shape[0]
    order = np.zeros(count, np.int64)
    visited = np.zeros(count, np.bool_)
    visited[0] = True
    for k in range(1, count):
        nearest, least = -1, np.inf
        for place in range(count):
            if not visited[place] and (nearest < 0 or distance[order[k - 1], place] < least):
                nearest, least = place, distance[order[k - 1], place]
        order[k] = nearest
        visited[nearest] = True
    return order


@njit
def improve_tour(distance: Distances, order: NDArray[np.int64], max_passes: int) -> int:
    """Make an open tour shorter, in place, until no move does or `max_passes` passes over it have been made.

    Args:
        distance: (n, n), symmetric, finite.
        order: in and out, (k,): its first place stays the first.
        max_passes: each takes O(k^2) and makes every move that it finds.

    Returns:
        How many passes were made.
    """
    for done in range(max_passes):
        if _two_opt_pass(distance, order) + _or_opt_pass(distance, order) == 0:
            return done + 1
    return max_passes


@njit
def _two_opt_pass(distance: Distances, order: NDArray[np.int64]) -> int:
    """Reverse every piece whose reversal makes the tour shorter; returns how many."""
    count, moves = order.shape[0], 0
    for i in range(1, count - 1):
        for j in range(i + 1, count):
            a, b, c = order[i - 1], order[i], order[j]
            gain = np.float64(distance[a, b]) - np.float64(distance[a, c])
            if j + 1 < count:
                d = order[j + 1]
                gain += np.float64(distance[c, d]) - np.float64(distance[b, d])
            if gain > _LEAST_GAIN:
                low, high = i, j
                while low < high:
                    order[low], order[high] = order[high], order[low]
                    low += 1
                    high -= 1
                moves += 1
    return moves


@njit
def _or_opt_pass(distance: Distances, order: NDArray[np.int64]) -> int:
    """Move every piece of up to `_LONGEST_PIECE` places to where the tour gains most by it; returns how many."""
    count, moves = order.shape[0], 0
    for length in range(1, _LONGEST_PIECE + 1):
        for i in range(1, count - length + 1):
            first, last = order[i], order[i + length - 1]
            before = order[i - 1]
            saved = np.float64(distance[before, first])
            if i + length < count:
                after = order[i + length]
                saved += np.float64(distance[last, after]) - np.float64(distance[before, after])
            best, best_at, turned = _LEAST_GAIN, -1, False
            for k in range(count):
                if i - 1 <= k < i + length:
                    continue
                left = order[k]
                one, other = np.float64(distance[left, first]), np.float64(distance[left, last])
                if k + 1 < count:
                    right = order[k + 1]
                    one += np.float64(distance[last, right]) - np.float64(distance[left, right])
                    other += np.float64(distance[first, right]) - np.float64(distance[left, right])
                if saved - min(one, other) > best:
                    best, best_at, turned = saved - min(one, other), k, bool(other < one)
            if best_at >= 0:
                _move_piece(order, i, length, best_at, turned)
                moves += 1
    return moves


@njit
def _move_piece(order: NDArray[np.int64], begin: int, length: int, behind: int, turned: bool) -> None:
    """Put the piece order[begin : begin + length] behind position `behind`, which lies outside it."""
    piece = order[begin : begin + length].copy()
    if turned:
        piece = piece[::-1].copy()
    if behind < begin:
        for k in range(begin - 1, behind, -1):
            order[k + length] = order[k]
        order[behind + 1 : behind + 1 + length] = piece
    else:
        for k in range(begin + length, behind + 1):
            order[k - length] = order[k]
        order[behind + 1 - length : behind + 1] = piece

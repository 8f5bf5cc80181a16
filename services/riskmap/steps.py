"""Steps of the ground: height differences over a short distance that slope does not explain.

Row by row, and within a row pair by pair, without branches, so that the compiler can take several columns at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


def find_steps(
    height_m: NDArray[np.float32],
    single: NDArray[np.float32],
    drift_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
    reach: int,
    max_slope: float,
    step: NDArray[np.float32],
    step_variance: NDArray[np.float32],
) -> None:
    """Height differences between cells up to `reach` cells apart in the eight directions, less what slope explains.

    A difference between neighbours belongs to both; over more cells to those in between alone, so that a ledge whose
    edge lies inside a cell is found and takes no more room than it has. Of equal ones a cell keeps the variance of the
    first: by the row, then the column of the pair's first cell, then the direction, then the distance. All arrays
    (h, w); step and step_variance, zeros at first, are written where the ground is known.
    """
    pairs, most, turns = _pairs(reach, resolution_m, max_slope)
    margin = 2 * reach
    shape = known.shape[0] + 2 * margin, known.shape[1] + 2 * margin
    inner = (slice(margin, -margin), slice(margin, -margin))
    height, is_known = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.bool_)
    height[inner], is_known[inner] = height_m, known
    _steps_by_rows(height, is_known, single, drift_m, margin, pairs, most, turns, step, step_variance)


def _pairs(
    reach: int, resolution_m: float, max_slope: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """(n, 2) rows and columns from a pair's first cell to its second; (n,) what slope explains at most, m; and (m, 3)
    the pairs that count at a cell: which, and rows and columns from the cell to its first cell, in their order."""
    pairs: list[tuple[int, int]] = []
    most: list[float] = []
    turns: list[tuple[int, int, int]] = []
    for dr, dc in _DIRECTIONS:
        length = resolution_m * (math.sqrt(2.0) if dr != 0 and dc != 0 else 1.0)
        for n in range(1, reach + 1):
            if n > 1 and n * length > reach * resolution_m + 1e-6:
                break
            low, high = (0, 1) if n == 1 else (1, n - 1)
            turns += [(len(pairs), -k * dr, -k * dc) for k in range(low, high + 1)]
            pairs.append((n * dr, n * dc))
            most.append(max_slope * n * length)
    turns.sort(key=lambda turn: (turn[1], turn[2], turn[0]))
    return np.array(pairs), np.array(most), np.array(turns)


@njit
def _steps_by_rows(
    height_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    single: NDArray[np.float32],
    drift_m: NDArray[np.float32],
    margin: int,
    pairs: NDArray[np.int64],
    most: NDArray[np.float64],
    turns: NDArray[np.int64],
    step: NDArray[np.float32],
    step_variance: NDArray[np.float32],
) -> None:
    """As `find_steps`; height_m and known have a margin of unknown cells around them."""
    rows, columns = step.shape
    span = 1 - turns[:, 1].min()
    # What the pairs of the last rows differ by (-1: no pair), at their first cells, with a margin left and right.
    rise = np.full((span, pairs.shape[0], columns + 2 * margin), -1.0)
    doubt = np.zeros((span, pairs.shape[0], columns + 2 * margin), dtype=np.float32)
    for r in range(rows):
        first, end = _extent(known[r + margin, margin : margin + columns])
        for p in range(pairs.shape[0]):
            rise[r % span, p, :] = -1.0
            if first < end and r + pairs[p, 0] < rows:
                _differences(height_m, known, r, first, end, margin, pairs[p], most[p], rise[r % span, p])
                _doubts(single, drift_m, r, first, end, margin, pairs[p], doubt[r % span, p])
        if first == end:
            continue
        width = end - first
        for t in range(turns.shape[0]):
            if r + turns[t, 1] < 0:
                continue
            at, row = first + margin + turns[t, 2], (r + turns[t, 1]) % span
            _take_greater(
                known[r + margin, first + margin : end + margin],
                rise[row, turns[t, 0], at : at + width],
                doubt[row, turns[t, 0], at : at + width],
                step[r, first:end],
                step_variance[r, first:end],
            )


@njit
def _extent(known: NDArray[np.bool_]) -> tuple[int, int]:
    """From the first known cell of a row to after the last."""
    first, end = 0, known.shape[0]
    while first < end and not known[first]:
        first += 1
    while end > first and not known[end - 1]:
        end -= 1
    return first, end


@njit
def _differences(
    height_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    r: int,
    first: int,
    end: int,
    margin: int,
    pair: NDArray[np.int64],
    most: float,
    out: NDArray[np.float64],
) -> None:
    """How much the pairs of a row differ beyond what the slope before and after them explains; -1: not both known."""
    dr, dc, width = pair[0], pair[1], end - first
    row, at = r + margin, first + margin
    here, there = height_m[row, at : at + width], height_m[row + dr, at + dc : at + dc + width]
    before = height_m[row - dr, at - dc : at - dc + width]
    after = height_m[row + 2 * dr, at + 2 * dc : at + 2 * dc + width]
    both, both_there = known[row, at : at + width], known[row + dr, at + dc : at + dc + width]
    outer = known[row - dr, at - dc : at - dc + width]
    outer_after = known[row + 2 * dr, at + 2 * dc : at + 2 * dc + width]
    found = out[at : at + width]
    for c in range(width):
        rise = float(there[c]) - float(here[c])
        sign = 1.0 if rise > 0.0 else -1.0
        rise_before, rise_after = sign * (here[c] - before[c]), sign * (after[c] - there[c])
        slope = sign * max(0.0, min(rise_before, rise_after, sign * rise, most))
        rise -= slope if outer[c] & outer_after[c] else 0.0
        found[c] = abs(rise) if both[c] & both_there[c] else -1.0


@njit
def _doubts(
    single: NDArray[np.float32],
    drift_m: NDArray[np.float32],
    r: int,
    first: int,
    end: int,
    margin: int,
    pair: NDArray[np.int64],
    out: NDArray[np.float32],
) -> None:
    """Variances of the differences of a row's pairs."""
    dr, dc = pair[0], pair[1]
    first, end = max(first, -dc), min(end, single.shape[1] - dc)
    if end <= first:
        return
    here, there = single[r, first:end], single[r + dr, first + dc : end + dc]
    drift, drift_there = drift_m[r, first:end], drift_m[r + dr, first + dc : end + dc]
    found = out[first + margin : end + margin]
    for c in range(end - first):
        found[c] = here[c] + there[c] + (drift[c] - drift_there[c]) ** 2


@njit
def _take_greater(
    known: NDArray[np.bool_],
    rise: NDArray[np.float64],
    doubt: NDArray[np.float32],
    step: NDArray[np.float32],
    step_variance: NDArray[np.float32],
) -> None:
    """At the known cells of a row: the difference where it is greater than the greatest so far."""
    for c in range(known.shape[0]):
        greater = known[c] & (rise[c] > step[c])
        step[c] = np.float32(rise[c]) if greater else step[c]
        step_variance[c] = doubt[c] if greater else step_variance[c]

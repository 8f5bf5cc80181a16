"""From the belief about obstacles to hazard, state and clearance (collision risk; flat ground)."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from planning.grid import FREE, LETHAL, UNKNOWN
from planning.kernels import njit, njit_borrowing

_FARTHER = 1.0 + 1e-6
"""Squared distances are told apart by rounding to float32 when one is so many times the other."""


class RiskLayers(NamedTuple):
    """The layers of a risk map, all (h, w); hazards in 1/m (see `schemas.world.RiskMap`)."""

    state: NDArray[np.uint8]
    hazard_mean: NDArray[np.float32]
    hazard_variance: NDArray[np.float32]
    hazard_cvar: NDArray[np.float32]
    clearance_m: NDArray[np.float32]


@cache
def cvar_factor(alpha: float) -> float:
    """CVaR_alpha of a normal variable is mean + factor * deviation: pdf(quantile(alpha)) / (1 - alpha), at alpha 0 no
    deviation."""
    if alpha <= 0.0:
        return 0.0
    return float(norm.pdf(norm.ppf(alpha)) / (1.0 - alpha))


def collision_layers(
    log_odds: NDArray[np.float32],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    resolution_m: float,
    free_log_odds: float,
    clamp_log_odds: float,
    hazard_per_m: float,
    alpha: float,
    max_clearance_m: float,
) -> RiskLayers:
    """State, hazard and clearance of each cell from its obstacle log-odds.

    log_odds, offset_x, offset_y: (h, w); the offsets are of the mean hit from the cell's centre, m. The hazard rate of
    a cell is hazard_per_m times the probability of an obstacle above that of the clearest possible cell.
    """
    state = np.full(log_odds.shape, UNKNOWN, dtype=np.uint8)
    state[log_odds < -free_log_odds] = FREE
    state[log_odds > 0.0] = LETHAL
    p = 1.0 / (1.0 + np.exp(-log_odds))
    p[state == UNKNOWN] = 0.5
    floor = 1.0 / (1.0 + math.exp(clamp_log_odds))
    p = np.clip((p - floor) / (1.0 - floor), 0.0, 1.0)
    mean = (hazard_per_m * p).astype(np.float32)
    variance = (hazard_per_m**2 * p * (1.0 - p)).astype(np.float32)
    cvar = np.minimum(mean + cvar_factor(alpha) * np.sqrt(variance), hazard_per_m).astype(np.float32)
    clearance = np.full(log_odds.shape, max_clearance_m, dtype=np.float32)
    stamp_clearance(state == LETHAL, offset_x, offset_y, resolution_m, max_clearance_m, clearance)
    return RiskLayers(state, mean, variance, cvar, clearance)


@njit
def stamp_clearance(
    lethal: NDArray[np.bool_],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    resolution_m: float,
    max_clearance_m: float,
    out_m: NDArray[np.float32],
) -> None:
    """Distance from each cell's centre to the nearest lethal point, up to a maximum; 0 in lethal cells.

    Exact for the points (mean hits inside lethal cells), unlike a distance transform of whole cells: a door of 0.8 m
    must not lose a cell on either side. Cells that lethal cells surround on all eight sides are left out: they are the
    nearest by a tenth of a cell at most.
    """
    height, width = lethal.shape
    reach = math.ceil(max_clearance_m / resolution_m) + 1
    counts = lethal.copy()
    # The least and, to know where rounding might decide, the second least squared distance.
    first, second = np.full((height, width), np.inf), np.full((height, width), np.inf)
    beside = np.empty(2 * reach + 1)
    for row in range(height):
        for column in range(width):
            if not lethal[row, column]:
                continue
            if _surrounded(lethal, row, column):
                counts[row, column] = False
                continue
            ox, oy = offset_x[row, column], offset_y[row, column]
            low, high = max(0, column - reach), min(width, column + reach + 1)
            for c in range(low, high):
                dx = (c - column) * resolution_m - ox
                beside[c - low] = dx * dx
            for r in range(max(0, row - reach), min(height, row + reach + 1)):
                dy = (r - row) * resolution_m - oy
                if dy * dy <= _FARTHER * max_clearance_m * max_clearance_m:
                    _take_nearer(beside, high - low, dy * dy, r, low, first, second)
    for row in range(height):
        for column in range(width):
            nearest = first[row, column]
            if lethal[row, column]:
                out_m[row, column] = 0.0
            elif nearest > _FARTHER * max_clearance_m * max_clearance_m:
                continue
            elif (
                second[row, column] > _FARTHER * nearest
                and _FARTHER * nearest < max_clearance_m * max_clearance_m
            ):
                out_m[row, column] = math.sqrt(nearest)
            else:
                out_m[row, column] = _clearance_at(
                    counts, offset_x, offset_y, resolution_m, reach, row, column, out_m[row, column]
                )


@njit_borrowing
def _surrounded(lethal: NDArray[np.bool_], row: int, column: int) -> bool:
    return (
        0 < row < lethal.shape[0] - 1
        and 0 < column < lethal.shape[1] - 1
        and lethal[row - 1, column]
        and lethal[row + 1, column]
        and lethal[row, column - 1]
        and lethal[row, column + 1]
        and lethal[row - 1, column - 1]
        and lethal[row - 1, column + 1]
        and lethal[row + 1, column - 1]
        and lethal[row + 1, column + 1]
    )


@njit_borrowing
def _take_nearer(
    beside: NDArray[np.float64],
    count: int,
    across: float,
    row: int,
    low: int,
    first: NDArray[np.float64],
    second: NDArray[np.float64],
) -> None:
    """In a row, from column `low` on: the two least different squared distances, those of one more point among them."""
    r, left = (
        np.uint64(row),
        np.uint64(low),
    )  # unsigned: no index counts from the end, several columns at a time
    for c in range(np.uint64(count)):
        squared, least = beside[c] + across, first[r, left + c]
        greater = squared if squared > least else least
        other = second[r, left + c]
        second[r, left + c] = greater if (greater < other) & (squared != least) else other
        first[r, left + c] = squared if squared < least else least


@njit_borrowing
def _clearance_at(
    counts: NDArray[np.bool_],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    resolution_m: float,
    reach: int,
    r: int,
    c: int,
    nearest_m: float,
) -> float:
    """The clearance of one cell, point by point in their order, where rounding decides between two that are as near."""
    nearest = np.float32(nearest_m)
    for row in range(max(0, r - reach), min(counts.shape[0], r + reach + 1)):
        for column in range(max(0, c - reach), min(counts.shape[1], c + reach + 1)):
            if counts[row, column]:
                dx = (c - column) * resolution_m - offset_x[row, column]
                dy = (r - row) * resolution_m - offset_y[row, column]
                squared = dx * dx + dy * dy
                if squared < nearest * nearest:
                    nearest = np.float32(math.sqrt(squared))
    return float(nearest)

"""The cells' records as layers in the order of the grid, as the metrics and the hazard need them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.riskmap.cells import (
    BELOW,
    CEILING,
    CEILING_SEEN,
    HIT_WEIGHT,
    HIT_X,
    HIT_Y,
    LOG_ODDS,
    MEAN,
    SEEN,
    TRAVELLED,
    VARIANCE,
)

_SHARED = np.float32(0.1)
"""Share of a supposed height's variance that its neighbours, which were supposed together with it, do not share."""


class GridLayers(NamedTuple):
    """(h, w) each, row 0 the lowest y. Lengths in m, variances in m2.

    height_m and variance of the ground, single and drift_m as in `terrain.Ground`; ground: its height is known;
    blocked: an obstacle stands there; bounded: the ground is only known to be no higher than height_m. log_odds, hit_x,
    hit_y, room_m and room_variance as in `hazard.Obstacles`.
    """

    height_m: NDArray[np.float32]
    variance: NDArray[np.float32]
    single: NDArray[np.float32]
    drift_m: NDArray[np.float32]
    ground: NDArray[np.bool_]
    blocked: NDArray[np.bool_]
    bounded: NDArray[np.bool_]
    log_odds: NDArray[np.float32]
    hit_x: NDArray[np.float32]
    hit_y: NDArray[np.float32]
    room_m: NDArray[np.float32]
    room_variance: NDArray[np.float32]


def grid_layers(
    cells: NDArray[np.float32],
    origin: tuple[int, int],
    travelled_m: float,
    drift_per_m: float,
    range_sigma_m: float,
) -> GridLayers:
    """The layers of a ring buffer (h, w, CHANNELS) whose lower left cell is at `origin` in memory."""
    shape = cells.shape[:2]
    f = [np.empty(shape, dtype=np.float32) for _ in range(9)]
    is_so = [np.empty(shape, dtype=np.bool_) for _ in range(3)]
    layers = GridLayers(f[0], f[1], f[2], f[3], is_so[0], is_so[1], is_so[2], f[4], f[5], f[6], f[7], f[8])
    numbers = np.array([travelled_m, drift_per_m, range_sigma_m**2], dtype=np.float32)
    for row0, first, count in _runs(origin[0], shape[0]):
        _fill_rows(cells, row0, first, count, origin[1], numbers, layers)
    return layers


def _runs(first: int, size: int) -> list[tuple[int, int, int]]:
    """Rows in memory, rows in the grid, and how many: the two pieces of a ring."""
    return [(first, 0, size - first)] + ([(0, size - first, first)] if first > 0 else [])


@njit
def _fill_rows(
    cells: NDArray[np.float32],
    row0: int,
    first: int,
    count: int,
    column0: int,
    numbers: NDArray[np.float32],
    out: GridLayers,
) -> None:
    """Rows of memory from row0 on to rows of the grid from `first` on; numbers: (3,) the arguments of `grid_layers`."""
    width = cells.shape[1]
    travelled_m, drift_per_m, range_variance = numbers[0], numbers[1], numbers[2]
    height_m, variance, single, drift_m = out.height_m, out.variance, out.single, out.drift_m
    ground, blocked, bounded = out.ground, out.blocked, out.bounded
    log_odds, hit_x, hit_y = out.log_odds, out.hit_x, out.hit_y
    room_m, room_variance = out.room_m, out.room_variance
    nothing, open_m = np.float32(0.0), np.float32(np.inf)
    for k in range(count):
        r, row = first + k, row0 + k
        for c in range(width):
            column = c + column0
            if column >= width:
                column -= width
            mean, doubt = cells[row, column, MEAN], cells[row, column, VARIANCE]
            is_ground, stands = doubt > nothing, cells[row, column, LOG_ODDS] > nothing
            drift = drift_per_m * (travelled_m - cells[row, column, TRAVELLED]) if is_ground else nothing
            doubt = doubt if is_ground else nothing
            height_m[r, c], variance[r, c], drift_m[r, c] = mean, doubt, drift
            single[r, c] = doubt if cells[row, column, SEEN] > nothing else _SHARED * doubt
            ground[r, c], blocked[r, c] = is_ground, stands
            bounded[r, c] = cells[row, column, SEEN] == BELOW and not is_ground
            log_odds[r, c] = cells[row, column, LOG_ODDS]
            hit = stands and cells[row, column, HIT_WEIGHT] > nothing
            hit_x[r, c] = cells[row, column, HIT_X] if hit else nothing
            hit_y[r, c] = cells[row, column, HIT_Y] if hit else nothing
            covered = is_ground and cells[row, column, CEILING_SEEN] > nothing
            room_m[r, c] = cells[row, column, CEILING] - mean if covered else open_m
            room_variance[r, c] = doubt + drift * drift + range_variance if covered else nothing

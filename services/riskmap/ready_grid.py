"""Ready occupancy grids as evidence: they replace what the window holds where they know something."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from planning.kernels import njit
from schemas.sensing import ReadyGrid
from services.riskmap.occupancy import OccupancyWindow


def apply_ready_grid(
    grid: ReadyGrid, window: OccupancyWindow, clamp_log_odds: float, only_new: bool = False
) -> None:
    """Write an occupancy grid into the window. only_new: only where the window holds nothing yet (it has rolled)."""
    known, evidence = grid_evidence(grid, window.spec, clamp_log_odds)
    if only_new:
        known &= (window.log_odds == 0.0) & (window.hit_weight == 0.0)
    window.log_odds[known] = evidence[known]
    for hits in (window.hit_weight, window.hit_x, window.hit_y):
        hits[known] = 0.0  # a grid says nothing about where in the cell


def grid_evidence(
    grid: ReadyGrid, spec: GridSpec, clamp_log_odds: float
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """(known, log-odds) over a window, both (h, w): grids of any resolution and origin are taken.

    A window cell is occupied if any grid cell that it overlaps is (more than 50 %), and known to be free only if every
    one is known to be; what lies outside the grid is unknown, and so is -1.
    """
    rows = _index_ranges(spec.iy0, spec.height, spec.resolution_m, grid.origin_y_m, grid.resolution_m)
    columns = _index_ranges(spec.ix0, spec.width, spec.resolution_m, grid.origin_x_m, grid.resolution_m)
    percent = np.empty(spec.shape, dtype=np.int8)
    _worst(np.ascontiguousarray(grid.occupancy), *rows, *columns, percent)
    p = np.clip(percent / 100.0, 1e-6, 1.0 - 1e-6)
    evidence = np.clip(np.log(p / (1.0 - p)), -clamp_log_odds, clamp_log_odds)
    return percent >= 0, evidence.astype(np.float32)


def _index_ranges(
    first: int, count: int, resolution_m: float, origin_m: float, grid_resolution_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each window cell of one axis, the half-open range (low, high) of grid cells that it overlaps."""
    borders = ((first + np.arange(count + 1)) * resolution_m - origin_m) / grid_resolution_m
    low = np.floor(borders[:-1] + 1e-6).astype(np.int64)
    high = np.ceil(borders[1:] - 1e-6).astype(np.int64)
    return low, np.maximum(high, low + 1)


@njit
def _worst(
    occupancy: NDArray[np.int8],
    row_low: NDArray[np.int64],
    row_high: NDArray[np.int64],
    column_low: NDArray[np.int64],
    column_high: NDArray[np.int64],
    out: NDArray[np.int8],
) -> None:
    """The highest percentage of the grid cells under each window cell; -1 if one is unknown and none occupied."""
    rows, columns = occupancy.shape
    for r in range(out.shape[0]):
        inside_r = row_low[r] >= 0 and row_high[r] <= rows
        for c in range(out.shape[1]):
            unknown = not (inside_r and column_low[c] >= 0 and column_high[c] <= columns)
            worst = -1
            for i in range(max(row_low[r], 0), min(row_high[r], rows)):
                for j in range(max(column_low[c], 0), min(column_high[c], columns)):
                    worst = max(worst, occupancy[i, j])
                    unknown = unknown or occupancy[i, j] < 0
            out[r, c] = worst if worst > 50 or not unknown else -1

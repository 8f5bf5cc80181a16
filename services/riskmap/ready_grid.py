"""Ready occupancy grids as evidence: they replace what the window holds where they know something."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.sensing import ReadyGrid
from services.riskmap.occupancy import OccupancyWindow


def apply_ready_grid(grid: ReadyGrid, window: OccupancyWindow, clamp_log_odds: float) -> None:
    """Write an occupancy grid into the window: percent to log-odds, each window cell from the grid's worst cell.

    Grids of any resolution and origin are taken; -1 leaves what the window knows.
    """
    s = window.spec
    rows = _index_ranges(s.iy0, s.height, s.resolution_m, grid.origin_y_m, grid.resolution_m)
    columns = _index_ranges(s.ix0, s.width, s.resolution_m, grid.origin_x_m, grid.resolution_m)
    percent = _worst(_worst(grid.occupancy, *rows).T, *columns).T
    known = percent >= 0
    p = np.clip(percent / 100.0, 1e-6, 1.0 - 1e-6)
    evidence = np.clip(np.log(p / (1.0 - p)), -clamp_log_odds, clamp_log_odds)
    window.log_odds[known] = evidence[known]
    for hits in (
        window.hit_weight,
        window.hit_x,
        window.hit_y,
    ):  # a grid says nothing about where in the cell
        hits[known] = 0.0


def _index_ranges(
    first: int, count: int, resolution_m: float, origin_m: float, grid_resolution_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each window cell of one axis, the half-open range (low, high) of grid cells that it overlaps."""
    borders = ((first + np.arange(count + 1)) * resolution_m - origin_m) / grid_resolution_m
    low = np.floor(borders[:-1] + 1e-6).astype(np.int64)
    high = np.ceil(borders[1:] - 1e-6).astype(np.int64)
    return low, np.maximum(high, low + 1)


def _worst(values: NDArray[Any], low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int8]:
    """Row i is the highest of the rows low[i] to high[i] of `values`; -1 where there are none."""
    out = np.full((len(low), values.shape[1]), -1, dtype=np.int8)
    low, high = np.clip(low, 0, len(values)), np.clip(high, 0, len(values))
    for i in np.flatnonzero(low < high):
        out[i] = values[low[i] : high[i]].max(axis=0)
    return out

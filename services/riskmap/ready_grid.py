"""Ready occupancy grids as evidence: they replace what the window holds where they know something."""

from __future__ import annotations

import math

import numpy as np

from services.riskmap.occupancy import OccupancyWindow
from schemas.sensing import ReadyGrid


def apply_ready_grid(grid: ReadyGrid, window: OccupancyWindow, clamp_log_odds: float) -> None:
    """Write an occupancy grid into the window: percent to log-odds, each window cell from the grid's worst cell.

    Grids of any resolution and origin are taken; -1 leaves what the window knows.
    """
    spec = window.spec
    rows_of = _index_range(spec.iy0, spec.height, spec.resolution_m, grid.origin_y_m, grid.resolution_m)
    columns_of = _index_range(spec.ix0, spec.width, spec.resolution_m, grid.origin_x_m, grid.resolution_m)
    for row, (r0, r1) in enumerate(rows_of):
        r0, r1 = max(r0, 0), min(r1, grid.height)
        if r0 >= r1:
            continue
        band = grid.occupancy[r0:r1].max(axis=0)
        for column, (c0, c1) in enumerate(columns_of):
            c0, c1 = max(c0, 0), min(c1, grid.width)
            if c0 >= c1:
                continue
            percent = int(band[c0:c1].max())
            if percent >= 0:
                p = min(max(percent / 100.0, 1e-6), 1.0 - 1e-6)
                window.log_odds[row, column] = np.clip(math.log(p / (1.0 - p)), -clamp_log_odds, clamp_log_odds)
                window.hit_weight[row, column] = 0.0


def _index_range(
    first: int, count: int, resolution_m: float, origin_m: float, grid_resolution_m: float
) -> list[tuple[int, int]]:
    """For each window cell of one axis, the half-open range of grid cells that it overlaps."""
    ranges = []
    for i in range(count):
        low = ((first + i) * resolution_m - origin_m) / grid_resolution_m
        high = ((first + i + 1) * resolution_m - origin_m) / grid_resolution_m
        ranges.append((math.floor(low + 1e-6), max(math.ceil(high - 1e-6), math.floor(low + 1e-6) + 1)))
    return ranges

"""How high everything stands: what the coverage sensor has to look over."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.riskmap.cells import HIT_HIGH, HIT_WEIGHT, LOG_ODDS

_TALL_SHARE = 0.75
"""Hits are counted up to the robot's height: what reaches this share of it may well be a wall."""
WALL_M = 100.0
"""What is tall, or of unknown height, is taken to be so high."""


@njit
def tops(
    cells: NDArray[np.float32], origin: tuple[int, int], ground_m: NDArray[np.float32], height_m: float
) -> NDArray[np.float32]:
    """(h, w) height in odom of the ground, or of the obstacle that stands there, m.

    cells: the ring buffer whose lower left cell is at `origin` in memory. ground_m: (h, w). height_m: of the robot.
    """
    rows, columns = ground_m.shape
    top_m = np.empty(ground_m.shape, dtype=np.float32)
    for r in range(rows):
        row = r + origin[0] if r + origin[0] < rows else r + origin[0] - rows
        for c in range(columns):
            column = c + origin[1] if c + origin[1] < columns else c + origin[1] - columns
            top = ground_m[r, c]
            if cells[row, column, LOG_ODDS] > 0.0:
                high = cells[row, column, HIT_HIGH]
                seen = cells[row, column, HIT_WEIGHT] > 0.0
                short = seen and high - top < _TALL_SHARE * height_m
                top = max(top, high) if short else top + np.float32(WALL_M)
            top_m[r, c] = top
    return top_m

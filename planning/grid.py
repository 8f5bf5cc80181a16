"""Grids aligned to integer multiples of their resolution, so that rolling a window never resamples it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

UNKNOWN: int = 0
FREE: int = 1
LETHAL: int = 2

DIRECTION_DX = np.array([1, 1, 0, -1, -1, -1, 0, 1], dtype=np.int64)
"""Column step of the eight directions, E first and counter-clockwise (REP-103)."""
DIRECTION_DY = np.array([0, 1, 1, 1, 0, -1, -1, -1], dtype=np.int64)
"""Row step of the eight directions, E first and counter-clockwise (REP-103)."""


class GridSpec(NamedTuple):
    """Where a grid lies: global cell index of its lower left cell, its size, and metres per cell.

    Arrays over the grid have shape (height, width) = (rows, columns) = (y, x).
    """

    resolution_m: float
    ix0: int
    iy0: int
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an array over this grid."""
        return (self.height, self.width)

    def cell_of(self, x_m: float, y_m: float) -> tuple[int, int]:
        """(row, column) of a point; may lie outside the grid."""
        return (
            math.floor(y_m / self.resolution_m) - self.iy0,
            math.floor(x_m / self.resolution_m) - self.ix0,
        )

    def centre_of(self, row: int, column: int) -> tuple[float, float]:
        """(x, y) in metres of a cell's centre."""
        return (
            (self.ix0 + column + 0.5) * self.resolution_m,
            (self.iy0 + row + 0.5) * self.resolution_m,
        )

    def contains(self, row: int, column: int) -> bool:
        """Whether the cell lies inside the grid."""
        return 0 <= row < self.height and 0 <= column < self.width

    def centres_x(self) -> NDArray[np.float64]:
        """x of the column centres in metres, shape (width,)."""
        return (self.ix0 + np.arange(self.width, dtype=np.float64) + 0.5) * self.resolution_m

    def centres_y(self) -> NDArray[np.float64]:
        """y of the row centres in metres, shape (height,)."""
        return (self.iy0 + np.arange(self.height, dtype=np.float64) + 0.5) * self.resolution_m


def window_around(x_m: float, y_m: float, size_m: float, resolution_m: float) -> GridSpec:
    """The square grid of about `size_m` centred on the cell that holds the point."""
    cells = max(1, round(size_m / resolution_m))
    ix0 = math.floor(x_m / resolution_m) - cells // 2
    iy0 = math.floor(y_m / resolution_m) - cells // 2
    return GridSpec(resolution_m, ix0, iy0, cells, cells)


def overlap(a: GridSpec, b: GridSpec) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """Slices of `a` and of `b` that cover their common cells, or None. Both need the same resolution."""
    if not math.isclose(a.resolution_m, b.resolution_m, rel_tol=1e-9):
        raise ValueError(f"grids of different resolution: {a.resolution_m} and {b.resolution_m} m")
    x_low, x_high = max(a.ix0, b.ix0), min(a.ix0 + a.width, b.ix0 + b.width)
    y_low, y_high = max(a.iy0, b.iy0), min(a.iy0 + a.height, b.iy0 + b.height)
    if x_low >= x_high or y_low >= y_high:
        return None
    of_a = (slice(y_low - a.iy0, y_high - a.iy0), slice(x_low - a.ix0, x_high - a.ix0))
    of_b = (slice(y_low - b.iy0, y_high - b.iy0), slice(x_low - b.ix0, x_high - b.ix0))
    return of_a, of_b

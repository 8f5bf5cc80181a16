"""A rolling window as a true ring buffer: a cell stays where it is in memory for as long as it is in the window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec, window_around
from planning.kernels import njit


class RingWindow:
    """Records of `channels` float32 for each cell of a square window around a point.

    cells: (h, w, channels); the cell of global index (ix, iy) is at row iy mod h, column ix mod w. A record of zeros
    is a cell of which nothing is known. Rolling clears what enters and touches nothing else.
    """

    def __init__(self, size_m: float, resolution_m: float, channels: int) -> None:
        self._size_m = size_m
        self.spec = window_around(0.0, 0.0, size_m, resolution_m)
        self.cells = np.zeros((*self.spec.shape, channels), dtype=np.float32)

    @property
    def origin(self) -> tuple[int, int]:
        """(row, column) in memory of the window's lower left cell."""
        return self.spec.iy0 % self.spec.height, self.spec.ix0 % self.spec.width

    def roll_to(self, x_m: float, y_m: float) -> bool:
        """Centre the window on a point; what leaves it is forgotten. Returns whether it moved."""
        old = self.spec
        wanted = window_around(x_m, y_m, self._size_m, old.resolution_m)
        if wanted == old:
            return False
        self.spec = wanted
        rows, columns = wanted.iy0 - old.iy0, wanted.ix0 - old.ix0
        if abs(rows) >= old.height or abs(columns) >= old.width:
            self.cells[:] = 0.0
            return True
        for first, count in _entering(old.iy0, rows, old.height):
            self.cells[first : first + count] = 0.0
        for first, count in _entering(old.ix0, columns, old.width):
            self.cells[:, first : first + count] = 0.0
        return True

    def ordered(self) -> NDArray[np.float32]:
        """The layers in the order of the grid, (channels, h, w), row 0 the lowest y: a copy, for output."""
        out = np.empty((self.cells.shape[2], *self.spec.shape), dtype=np.float32)
        unroll(self.cells, *self.origin, out)
        return out

    def place(self, spec: GridSpec, cells: NDArray[np.float32]) -> None:
        """Take over a window as a snapshot held it."""
        self.spec, self.cells = spec, cells


def _entering(first: int, shift: int, size: int) -> list[tuple[int, int]]:
    """The slices (start, count) of memory that enter one axis when the window moves by `shift` cells."""
    if shift == 0:
        return []
    start = (first if shift > 0 else first + shift) % size
    count = abs(shift)
    head = min(count, size - start)
    return [(start, head)] + ([(0, count - head)] if count > head else [])


@njit
def unroll(cells: NDArray[np.float32], row0: int, column0: int, out: NDArray[np.float32]) -> None:
    """Write the layers in the order of the grid: cells (h, w, channels) to out (channels, h, w)."""
    height, width, channels = cells.shape
    for row in range(height):
        r = row + row0
        if r >= height:
            r -= height
        for column in range(width):
            c = column + column0
            if c >= width:
                c -= width
            for channel in range(channels):
                out[channel, row, column] = cells[r, c, channel]

"""Line of sight on a grid.

A cell is visible when the segment from the viewer to the cell's centre crosses no opaque cell. A ray that only
grazes corners is free as long as one side of it is free, so nothing is seen between two opaque cells that touch
at a corner, and one cell's corner hides nothing.

The sweep is exact, not sampled: the plane is cut into four sectors around the viewer (|slope| <= 1 in each);
within a sector the columns are visited outwards and the set of slopes that are still free is kept as a list of
intervals. Every opaque cell takes its own slopes away from the columns behind it; a ray with |slope| <= 1 that
ends at a cell's centre enters that column inside the same cell, so cells of one column never hide each other.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

_SECTOR_SLOPE = 1.01
"""Slopes swept per sector: a little beyond the diagonals, so that both sides of a diagonal ray are known."""


@njit
def buffer_size(range_cells: float) -> int:
    """Number of cells that a buffer for `visible_list` must hold."""
    side = 2 * int(math.ceil(range_cells)) + 3
    return side * side


@njit
def _blocks(opaque: NDArray[np.bool_], row: int, column: int) -> bool:
    """Whether a cell is opaque; cells outside the grid are."""
    height, width = opaque.shape
    return row < 0 or column < 0 or row >= height or column >= width or bool(opaque[row, column])


@njit
def _blocked_slopes(y_low: float, y_high: float, x_near: float, x_far: float) -> tuple[float, float]:
    """Open interval of slopes of the rays from the origin that cross the box [x_near, x_far] x [y_low, y_high].

    x_near >= 0. Every bound is one division, so that equal slopes of different cells compare equal.
    """
    low = y_low / (x_far if y_low > 0.0 else x_near) if y_low != 0.0 else 0.0
    high = y_high / (x_near if y_high > 0.0 else x_far) if y_high != 0.0 else 0.0
    return low, high


@njit
def _sweep_sector(
    opaque: NDArray[np.bool_],
    row0: int,
    column0: int,
    forward_offset: float,
    left_offset: float,
    sector: int,
    range_cells: float,
    intervals: NDArray[np.float64],
    found: NDArray[np.int32],
    count: int,
) -> int:
    """Append the visible cells of one sector (flat indices) to `found`; returns the new count.

    Sector 0 looks along +x, 1 along +y, 2 along -x, 3 along -y; a cell exactly on slope +1 belongs to the next.
    `intervals` is scratch (2, n, 2): the free slopes of this column and of the next.
    """
    width = opaque.shape[1]
    forward_c = (1, 0, -1, 0)[sector]
    forward_r = (0, 1, 0, -1)[sector]
    range_squared = range_cells * range_cells
    intervals[0, 0, 0] = -_SECTOR_SLOPE
    intervals[0, 0, 1] = _SECTOR_SLOPE
    free = 1
    side = 0
    for ahead in range(int(math.ceil(range_cells)) + 2):
        x_near = max(ahead - 0.5 - forward_offset, 0.0)
        x_far = ahead + 0.5 - forward_offset
        x_centre = ahead - forward_offset
        if x_near > range_cells or free == 0:
            break
        if x_far <= 0.0:  # the viewer stands on the far border of its own column
            continue
        kept = 0
        for k in range(free):
            start = intervals[side, k, 0]
            end = intervals[side, k, 1]
            low = start * (x_near if start > 0.0 else x_far) + left_offset
            high = end * (x_far if end > 0.0 else x_near) + left_offset
            rest = start
            for across in range(int(math.floor(low + 0.5)), int(math.ceil(high - 0.5)) + 1):
                if ahead == 0 and across == 0:
                    continue
                column = column0 + forward_c * ahead - forward_r * across
                row = row0 + forward_r * ahead + forward_c * across
                y_centre = across - left_offset
                if not _blocks(opaque, row, column):
                    if x_centre > 0.0 and x_centre * x_centre + y_centre * y_centre <= range_squared:
                        slope = y_centre / x_centre
                        if (
                            slope == -1.0
                            and start == -1.0
                            and _blocks(opaque, row + forward_c, column - forward_r)
                        ):
                            continue  # between a cell of an earlier column and one of this, both touching the ray
                        if start <= slope <= end and -1.0 <= slope < 1.0:
                            found[count] = row * width + column
                            count += 1
                    continue
                block_low, block_high = _blocked_slopes(y_centre - 0.5, y_centre + 0.5, x_near, x_far)
                if rest < end and block_low > rest:
                    intervals[1 - side, kept, 0] = rest
                    intervals[1 - side, kept, 1] = min(block_low, end)
                    kept += 1
                rest = max(rest, block_high)
            if rest < end:
                intervals[1 - side, kept, 0] = rest
                intervals[1 - side, kept, 1] = end
                kept += 1
        side = 1 - side
        free = kept
    return count


@njit
def visible_list(
    opaque: NDArray[np.bool_],
    x_cells: float,
    y_cells: float,
    range_cells: float,
    found: NDArray[np.int32],
    intervals: NDArray[np.float64],
) -> int:
    """Flat indices (row * W + column) of all cells visible from a point, full circle, each once.

    Args:
        opaque: (H, W).
        x_cells, y_cells: the viewer in cells: cell (row, column) spans [column, column + 1) x [row, row + 1).
        range_cells: a cell further away than this (centre to viewer) is not seen.
        found: out, at least `buffer_size(range_cells)` long.
        intervals: scratch, (2, buffer_size(range_cells), 2).

    Returns:
        How many cells were written. The viewer's own cell comes first and never hides anything; it is left out
        if opaque. A viewer outside the grid sees nothing. Opaque cells and cells outside are never in the list.
    """
    height, width = opaque.shape
    column, row = int(math.floor(x_cells)), int(math.floor(y_cells))
    if row < 0 or column < 0 or row >= height or column >= width:
        return 0
    count = 0
    if not opaque[row, column]:
        found[0] = row * width + column
        count = 1
    x = x_cells - column - 0.5
    y = y_cells - row - 0.5
    count = _sweep_sector(opaque, row, column, x, y, 0, range_cells, intervals, found, count)
    count = _sweep_sector(opaque, row, column, y, -x, 1, range_cells, intervals, found, count)
    count = _sweep_sector(opaque, row, column, -x, -y, 2, range_cells, intervals, found, count)
    return _sweep_sector(opaque, row, column, -y, x, 3, range_cells, intervals, found, count)


@njit
def visible_cells(
    opaque: NDArray[np.bool_],
    x_cells: float,
    y_cells: float,
    range_cells: float,
    heading_rad: float,
    fov_rad: float,
    out: NDArray[np.uint8],
) -> int:
    """Set `out` to 1 in the cells within range, field of view and line of sight of a viewer.

    Args:
        opaque: (H, W), cells that block the sight; they are never marked themselves.
        x_cells, y_cells: the viewer in cells (column + fraction, row + fraction); (x_m / res - ix0) of a grid.
        range_cells: range to a cell's centre, in cells.
        heading_rad: middle of the field of view, counter-clockwise from +x.
        fov_rad: full width of the field of view; 2 pi or more is the full circle.
        out: (H, W) uint8; cells that are not seen keep their value.

    Returns:
        Number of cells seen. The viewer's own cell is seen whatever the heading.
    """
    size = buffer_size(range_cells)
    found = np.empty(size, np.int32)
    intervals = np.empty((2, size, 2), np.float64)
    total = visible_list(opaque, x_cells, y_cells, range_cells, found, intervals)
    width = opaque.shape[1]
    own = int(math.floor(y_cells)) * width + int(math.floor(x_cells))
    heading_x, heading_y = math.cos(heading_rad), math.sin(heading_rad)
    cos_half = math.cos(0.5 * fov_rad) if fov_rad < 2.0 * math.pi else -2.0
    seen = 0
    for k in range(total):
        row, column = found[k] // width, found[k] % width
        dx, dy = column + 0.5 - x_cells, row + 0.5 - y_cells
        if found[k] != own and dx * heading_x + dy * heading_y < cos_half * math.hypot(dx, dy) - 1e-9:
            continue
        out[row, column] = 1
        seen += 1
    return seen


@njit
def visible_mass(
    opaque: NDArray[np.bool_],
    mass: NDArray[np.float32],
    x_cells: float,
    y_cells: float,
    range_cells: float,
    patch_of: NDArray[np.int32],
    out: NDArray[np.float32],
) -> float:
    """Add the mass of the visible cells (full circle) to their patches: what is seen of each patch from here.

    Args:
        opaque, x_cells, y_cells, range_cells: as in `visible_cells`.
        mass: (H, W), for example each cell's share of its patch.
        patch_of: (H, W), patch of each cell, -1 for none; ids in [0, len(out)).
        out: (n,), added to.

    Returns:
        The mass added in all.
    """
    size = buffer_size(range_cells)
    found = np.empty(size, np.int32)
    intervals = np.empty((2, size, 2), np.float64)
    total = visible_list(opaque, x_cells, y_cells, range_cells, found, intervals)
    width = opaque.shape[1]
    added = 0.0
    for k in range(total):
        row, column = found[k] // width, found[k] % width
        patch = patch_of[row, column]
        if patch >= 0:
            out[patch] += mass[row, column]
            added += mass[row, column]
    return added

"""Kernels over occupied cells taken as areas. Positions are in cells: x / resolution - ix0, likewise y.

Whatever lies outside the array counts as occupied.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

BoolGrid = NDArray[np.bool_]


@njit
def is_occupied(occupied: BoolGrid, row: int, column: int) -> bool:
    """Whether the cell is a wall or lies outside the array."""
    height, width = occupied.shape
    if row < 0 or column < 0 or row >= height or column >= width:
        return True
    return bool(occupied[row, column])


@njit
def clearance(occupied: BoolGrid, x: float, y: float, reach: float) -> tuple[float, float, float]:
    """Distance from a point to the nearest occupied cell's area, and that nearest point.

    Exact up to `reach` (cells). Returns (reach, nan, nan) if nothing is nearer; 0 inside an occupied cell.
    """
    best, best_x, best_y = reach * reach, math.nan, math.nan
    for row in range(math.floor(y - reach), math.floor(y + reach) + 1):
        for column in range(math.floor(x - reach), math.floor(x + reach) + 1):
            if is_occupied(occupied, row, column):
                near_x = min(max(x, float(column)), column + 1.0)
                near_y = min(max(y, float(row)), row + 1.0)
                squared = (near_x - x) ** 2 + (near_y - y) ** 2
                if squared < best:
                    best, best_x, best_y = squared, near_x, near_y
    return math.sqrt(best), best_x, best_y


@njit
def ray_length(occupied: BoolGrid, x: float, y: float, dx: float, dy: float, longest: float) -> float:
    """Length of the free ray from (x, y) along the unit vector (dx, dy), in cells, at most `longest`.

    Exact grid traversal (Amanatides and Woo 1987); 0 if the ray begins inside an occupied cell.
    """
    column, row = math.floor(x), math.floor(y)
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    next_x = ((column + 1 - x) if dx > 0.0 else (x - column)) * delta_x if dx != 0.0 else math.inf
    next_y = ((row + 1 - y) if dy > 0.0 else (y - row)) * delta_y if dy != 0.0 else math.inf
    travelled = 0.0
    while travelled < longest:
        if is_occupied(occupied, row, column):
            return travelled
        if next_x < next_y:
            travelled = next_x
            next_x += delta_x
            column += step_x
        else:
            travelled = next_y
            next_y += delta_y
            row += step_y
    return longest


@njit
def sees_cell(occupied: BoolGrid, x: float, y: float, row: int, column: int) -> bool:
    """Whether the straight line from (x, y) to the centre of a cell crosses no occupied cell before it."""
    at_row, at_column = math.floor(y), math.floor(x)
    dx, dy = column + 0.5 - x, row + 0.5 - y
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    next_x = ((at_column + 1 - x) if dx > 0.0 else (x - at_column)) * delta_x if dx != 0.0 else math.inf
    next_y = ((at_row + 1 - y) if dy > 0.0 else (y - at_row)) * delta_y if dy != 0.0 else math.inf
    # The count of steps is an integer known beforehand, so rounding cannot walk past the target.
    for _ in range(abs(row - at_row) + abs(column - at_column)):
        if is_occupied(occupied, at_row, at_column):
            return False
        if at_row == row or (at_column != column and next_x < next_y):
            next_x += delta_x
            at_column += step_x
        else:
            next_y += delta_y
            at_row += step_y
    return True


@njit
def dilate(mask: BoolGrid, half_widths: NDArray[np.int64], outside: bool) -> BoolGrid:
    """Dilation by a symmetrical shape: row offset k - K reaches `half_widths[k]` columns either way.

    `half_widths` has shape (2 K + 1,); a negative entry is an empty row. `outside` is the mask's value beyond
    the array. Rows are prefix sums, so the cost per cell is the shape's height, not its area.
    """
    height, width = mask.shape
    prefix = np.zeros((height, width + 1), dtype=np.int32)
    for row in range(height):
        for column in range(width):
            prefix[row, column + 1] = prefix[row, column] + (1 if mask[row, column] else 0)
    result = np.zeros((height, width), dtype=np.bool_)
    reach = half_widths.shape[0] // 2
    for row in range(height):
        for k in range(half_widths.shape[0]):
            half, other = half_widths[k], row + k - reach
            if half < 0 or (not outside and (other < 0 or other >= height)):
                continue
            if other < 0 or other >= height:
                result[row, :] = True
                break
            for column in range(width):
                low, high = column - half, column + half + 1
                beyond = outside and (low < 0 or high > width)
                if beyond or prefix[other, min(high, width)] > prefix[other, max(low, 0)]:
                    result[row, column] = True
    return result


@njit
def flood(free: BoolGrid, row: int, column: int) -> BoolGrid:
    """The 4-connected part of `free` that holds the given cell (all False if that cell is not free)."""
    height, width = free.shape
    seen = np.zeros((height, width), dtype=np.bool_)
    if not free[row, column]:
        return seen
    stack = np.empty(height * width, dtype=np.int32)
    stack[0] = row * width + column
    seen[row, column] = True
    size = 1
    while size > 0:
        size -= 1
        r, c = stack[size] // width, stack[size] % width
        for k in range(4):
            nr, nc = r + (1 if k == 0 else -1 if k == 1 else 0), c + (1 if k == 2 else -1 if k == 3 else 0)
            if 0 <= nr < height and 0 <= nc < width and free[nr, nc] and not seen[nr, nc]:
                seen[nr, nc] = True
                stack[size] = nr * width + nc
                size += 1
    return seen


def disc_touches_area(radius_cells: float) -> NDArray[np.int64]:
    """Shape for `dilate`: offsets of cells whose area lies nearer than `radius_cells` to a cell's centre."""
    reach = max(0, math.ceil(radius_cells + 0.5) - 1)
    rows = np.arange(-reach, reach + 1)
    rise = np.maximum(np.abs(rows) - 0.5, 0.0)
    run = np.sqrt(np.maximum(radius_cells**2 - rise**2, 0.0))
    # Strictly nearer: a disc that only touches a wall fits. The tolerance absorbs rounding of radius / cell.
    return np.asarray(np.ceil(run - 0.5 - 1e-9), dtype=np.int64)


def disc_holds_centre(radius_cells: float) -> NDArray[np.int64]:
    """Shape for `dilate`: offsets of cells whose centre lies within `radius_cells` of a cell's centre."""
    reach = math.floor(radius_cells + 1e-9)
    rows = np.arange(-reach, reach + 1)
    run = np.sqrt(np.maximum(radius_cells**2 - rows**2, 0.0))
    return np.floor(run + 1e-9).astype(np.int64)


def configuration_space(occupied: BoolGrid, radius_cells: float) -> BoolGrid:
    """Cells on whose centre the open disc of `radius_cells` overlaps no occupied cell's area; exact."""
    return ~dilate(occupied, disc_touches_area(radius_cells), True)

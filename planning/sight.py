"""Line of sight over uneven ground: a low block hides what lies close behind it, not all that lies beyond.

`rays` is for flat ground, where whatever stands blocks the sight. Here every cell has a top, the height of its ground
or of what stands on it, and a cell is visible when the line from the viewer to a point a little above its ground passes
over the tops of all cells before it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

SEEN_ABOVE_M = 0.1
"""A cell is seen when the point so high over its ground is."""


@njit
def sees_over(
    top_m: NDArray[np.float32], x: float, y: float, z_m: float, row: int, column: int, target_m: float
) -> bool:
    """Whether the line from (x, y) in cells and z to height `target_m` over a cell's centre passes over all tops.

    Every cell that the line crosses before the last one is taken at the height of its top, at the middle of the
    crossing; the viewer's own cell hides nothing. Cells outside the grid block.
    """
    at_row, at_column = math.floor(y), math.floor(x)
    dx, dy = column + 0.5 - x, row + 0.5 - y
    dz = target_m - z_m
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    next_x = ((at_column + 1 - x) if dx > 0.0 else (x - at_column)) * delta_x if dx != 0.0 else math.inf
    next_y = ((at_row + 1 - y) if dy > 0.0 else (y - at_row)) * delta_y if dy != 0.0 else math.inf
    begin = 0.0
    for crossed in range(abs(row - at_row) + abs(column - at_column)):
        if at_row < 0 or at_column < 0 or at_row >= top_m.shape[0] or at_column >= top_m.shape[1]:
            return False
        by_column = at_row == row or (at_column != column and next_x < next_y)
        end = min(next_x if by_column else next_y, 1.0)
        if crossed > 0 and z_m + dz * 0.5 * (begin + end) < top_m[at_row, at_column]:
            return False
        begin = end
        if by_column:
            next_x += delta_x
            at_column += step_x
        else:
            next_y += delta_y
            at_row += step_y
    return True


@njit
def visible_over(
    top_m: NDArray[np.float32],
    ground_m: NDArray[np.float32],
    wanted: NDArray[np.bool_],
    view: tuple[float, float, float],
    range_cells: float,
    heading_rad: float,
    fov_rad: float,
    out: NDArray[np.bool_],
) -> int:
    """Set `out` in the wanted cells within range, field of view and line of sight. Returns how many are seen.

    Args:
        top_m, ground_m: (H, W), height of what blocks the sight and of the ground, m.
        wanted: (H, W), the cells that are asked for.
        view: x, y in cells (column + fraction, row + fraction), z in m.
        range_cells: range to a cell's centre, in cells.
        heading_rad: middle of the field of view; fov_rad: its full width, 2 pi or more is the full circle.
        out: (H, W); cells that are not seen keep their value.
    """
    x, y, z_m = view
    height, width = top_m.shape
    heading_x, heading_y = math.cos(heading_rad), math.sin(heading_rad)
    cos_half = math.cos(0.5 * fov_rad) if fov_rad < 2.0 * math.pi else -2.0
    own_row, own_column = math.floor(y), math.floor(x)
    seen = 0
    for row in range(max(0, math.floor(y - range_cells)), min(height, math.floor(y + range_cells) + 1)):
        for column in range(max(0, math.floor(x - range_cells)), min(width, math.floor(x + range_cells) + 1)):
            if not wanted[row, column]:
                continue
            dx, dy = column + 0.5 - x, row + 0.5 - y
            distance = math.hypot(dx, dy)
            own = row == own_row and column == own_column
            if distance > range_cells:
                continue
            if not own and dx * heading_x + dy * heading_y < cos_half * distance - 1e-9:
                continue
            if sees_over(top_m, x, y, z_m, row, column, ground_m[row, column] + SEEN_ABOVE_M):
                out[row, column] = True
                seen += 1
    return seen


@njit
def visible_mass_over(
    top_m: NDArray[np.float32],
    ground_m: NDArray[np.float32],
    mass: NDArray[np.float32],
    view: tuple[float, float, float],
    range_cells: float,
    patch_of: NDArray[np.int32],
    out: NDArray[np.float32],
) -> float:
    """Add the mass of the visible cells (full circle) to their patches; as `rays.visible_mass`, over tops.

    Only cells with mass are looked at.
    """
    x, y, z_m = view
    height, width = top_m.shape
    added = 0.0
    for row in range(max(0, math.floor(y - range_cells)), min(height, math.floor(y + range_cells) + 1)):
        for column in range(max(0, math.floor(x - range_cells)), min(width, math.floor(x + range_cells) + 1)):
            if mass[row, column] <= 0.0 or patch_of[row, column] < 0:
                continue
            dx, dy = column + 0.5 - x, row + 0.5 - y
            if dx * dx + dy * dy > range_cells * range_cells:
                continue
            if sees_over(top_m, x, y, z_m, row, column, ground_m[row, column] + SEEN_ABOVE_M):
                out[patch_of[row, column]] += mass[row, column]
                added += mass[row, column]
    return added

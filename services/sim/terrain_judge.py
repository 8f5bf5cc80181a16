"""The judge on uneven ground: where the robot can stand at acceptable risk, and what it sees over bumps.

A robot can stand on a cell when, over its disc there, the least-squares plane is no steeper than its slope limit,
no two heights within `STEP_M` of each other differ by more than its step limit (beyond what the slope on both sides
explains), no ground stands higher over the plane than its belly, and neither wall nor low ceiling is touched.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import GridSpec
from planning.kernels import njit
from services.sim.config import RobotConfig
from services.sim.geometry import configuration_space, disc_holds_centre
from services.sim.terrain import BoolGrid, Heights

STEP_M = 0.25
SEEN_ABOVE_M = 0.1
"""A cell is seen when the point so high over its ground is."""


def acceptable_ground(spec: GridSpec, solid: BoolGrid, floor_m: Heights, robot: RobotConfig) -> BoolGrid:
    """Cells on whose centre the robot's disc stands at acceptable risk; `solid` includes low ceilings."""
    cell = spec.resolution_m
    free = configuration_space(solid, robot.footprint_radius_m / cell)
    offsets = _offsets(robot.footprint_radius_m / cell)
    step = steps(floor_m, cell, max(1, math.floor(STEP_M / cell + 1e-6)), math.tan(robot.max_slope_rad))
    step = ndimage.maximum_filter(step, footprint=offsets, mode="nearest")
    limits = np.array([math.tan(robot.max_slope_rad), robot.belly_m])
    rows, columns = np.nonzero(offsets)
    reach = offsets.shape[0] // 2
    disc = np.stack([rows - reach, columns - reach], axis=1)
    return stands(free & (step <= robot.max_step_m), floor_m, disc, cell, limits)


def _offsets(radius_cells: float) -> BoolGrid:
    """The disc of cells whose centre lies within the radius, as a mask."""
    half_widths = disc_holds_centre(radius_cells)
    reach = half_widths.size // 2
    columns = np.abs(np.arange(-reach, reach + 1))
    return np.asarray(columns[None, :] <= half_widths[:, None])


@njit
def steps(floor_m: Heights, cell_m: float, reach: int, max_slope: float) -> Heights:
    """Greatest height difference between each cell and those up to `reach` cells from it in the eight directions.

    Less what slope explains: the rise just before or just after the two cells, whichever is less, up to `max_slope`.
    """
    rows, columns = floor_m.shape
    found = np.zeros((rows, columns), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            for k in range(4):
                dr, dc = (0, 1, 1, 1)[k], (1, 0, 1, -1)[k]
                length = math.sqrt(2.0) if k > 1 else 1.0
                for n in range(1, reach + 1):
                    r1, c1 = row + n * dr, column + n * dc
                    if n * length > reach + 1e-6 or r1 >= rows or c1 < 0 or c1 >= columns:
                        break
                    rise = floor_m[r1, c1] - floor_m[row, column]
                    if abs(rise) <= found[row, column] and abs(rise) <= found[r1, c1]:
                        continue
                    slope = _rise_beside(
                        floor_m, row, column, n * dr, n * dc, rise, max_slope * n * length * cell_m
                    )
                    found[row, column] = max(found[row, column], abs(rise - slope))
                    found[r1, c1] = max(found[r1, c1], abs(rise - slope))
    return found


@njit
def _rise_beside(
    floor_m: Heights, row: int, column: int, dr: int, dc: int, rise: float, most: float
) -> float:
    """What slope explains of the rise from a cell to the one (dr, dc) further: of its sign, at most `most`."""
    rows, columns = floor_m.shape
    sign = 1.0 if rise > 0.0 else -1.0
    r0, c0, r1, c1 = row - dr, column - dc, row + dr, column + dc
    r2, c2 = r1 + dr, c1 + dc
    if r0 < 0 or r2 >= rows or min(c0, c2) < 0 or max(c0, c2) >= columns:
        return 0.0
    before = sign * (floor_m[row, column] - floor_m[r0, c0])
    after = sign * (floor_m[r2, c2] - floor_m[r1, c1])
    return sign * max(0.0, min(before, after, sign * rise, most))


@njit
def stands(
    free: BoolGrid, floor_m: Heights, disc: NDArray[np.int64], cell_m: float, limits: NDArray[np.float64]
) -> BoolGrid:
    """The free cells whose disc (offsets[n, 2] of rows and columns) is neither too steep nor too bumpy.

    `limits` is (tangent of the greatest slope, greatest height over the plane in metres).
    """
    rows, columns = free.shape
    result = np.zeros((rows, columns), dtype=np.bool_)
    spread, count = 0.0, disc.shape[0]
    for k in range(count):
        spread += disc[k, 1] * disc[k, 1]
    spread = max(spread, 1.0) * cell_m
    for row in range(rows):
        for column in range(columns):
            if not free[row, column]:
                continue
            total, east, north = 0.0, 0.0, 0.0
            for k in range(count):
                height = floor_m[row + disc[k, 0], column + disc[k, 1]]
                total += height
                east += disc[k, 1] * height
                north += disc[k, 0] * height
            mean, east, north = total / count, east / spread, north / spread
            if east * east + north * north > limits[0] * limits[0]:
                continue
            over = 0.0
            for k in range(count):
                plane = mean + cell_m * (east * disc[k, 1] + north * disc[k, 0])
                over = max(over, floor_m[row + disc[k, 0], column + disc[k, 1]] - plane)
            result[row, column] = over <= limits[1]
    return result


@njit
def look_over(
    occupied: BoolGrid,
    floor_m: Heights,
    ceiling_m: Heights,
    pending: BoolGrid,
    covered: BoolGrid,
    view: NDArray[np.float64],
    range_cells: float,
    cos_half_fov: float,
) -> int:
    """As `coverage.look`, in three dimensions: the line from the sensor may meet neither ground nor ceiling.

    `view` is (x, y, cos yaw, sin yaw, z) in cells and, for z, metres.
    """
    x, y = view[0], view[1]
    height, width = pending.shape
    row_low, row_high = max(0, math.floor(y - range_cells)), min(height - 1, math.floor(y + range_cells))
    column_low, column_high = max(0, math.floor(x - range_cells)), min(width - 1, math.floor(x + range_cells))
    new = 0
    for row in range(row_low, row_high + 1):
        for column in range(column_low, column_high + 1):
            if not pending[row, column]:
                continue
            dx, dy = column + 0.5 - x, row + 0.5 - y
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > range_cells or dx * view[2] + dy * view[3] < cos_half_fov * distance:
                continue
            if sees_over(occupied, floor_m, ceiling_m, x, y, view[4], row, column):
                pending[row, column] = False
                covered[row, column] = True
                new += 1
    return new


@njit
def sees_over(
    occupied: BoolGrid,
    floor_m: Heights,
    ceiling_m: Heights,
    x: float,
    y: float,
    z: float,
    row: int,
    column: int,
) -> bool:
    """Whether the line from (x, y) in cells and z in metres to `SEEN_ABOVE_M` over a cell's centre is free.

    Every cell that the line crosses before the last is taken at the height of its own centre, at the middle of the
    crossing.
    """
    at_row, at_column = math.floor(y), math.floor(x)
    dx, dy = column + 0.5 - x, row + 0.5 - y
    dz = floor_m[row, column] + SEEN_ABOVE_M - z
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    next_x = ((at_column + 1 - x) if dx > 0.0 else (x - at_column)) * delta_x if dx != 0.0 else math.inf
    next_y = ((at_row + 1 - y) if dy > 0.0 else (y - at_row)) * delta_y if dy != 0.0 else math.inf
    begin = 0.0
    for _ in range(abs(row - at_row) + abs(column - at_column)):
        if (
            at_row < 0
            or at_column < 0
            or at_row >= occupied.shape[0]
            or at_column >= occupied.shape[1]
            or occupied[at_row, at_column]
        ):
            return False
        by_column = at_row == row or (at_column != column and next_x < next_y)
        end = min(next_x if by_column else next_y, 1.0)
        middle = z + dz * 0.5 * (begin + end)
        if middle < floor_m[at_row, at_column] or middle > ceiling_m[at_row, at_column]:
            return False
        begin = end
        if by_column:
            next_x += delta_x
            at_column += step_x
        else:
            next_y += delta_y
            at_row += step_y
    return True

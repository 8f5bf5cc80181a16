"""Small worlds and brute-force references for the tests of the simulator."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from services.sim.world import World


def box(
    width_m: float,
    height_m: float,
    resolution_m: float = 0.1,
    start: tuple[float, float, float] | None = None,
) -> World:
    """An empty room whose lower left corner is the origin; the walls are the outside."""
    columns, rows = round(width_m / resolution_m), round(height_m / resolution_m)
    spec = GridSpec(resolution_m, 0, 0, columns, rows)
    start = start or (width_m / 2.0, height_m / 2.0, 0.0)
    return World("box", spec, np.zeros(spec.shape, dtype=np.bool_), start)


def with_walls(world: World, *rectangles: tuple[float, float, float, float]) -> World:
    """The world with solid rectangles (x_low, y_low, x_high, y_high) in metres added."""
    occupied = world.occupied.copy()
    for x_low, y_low, x_high, y_high in rectangles:
        cells = [round(v / world.spec.resolution_m) for v in (x_low, y_low, x_high, y_high)]
        occupied[
            cells[1] - world.spec.iy0 : cells[3] - world.spec.iy0,
            cells[0] - world.spec.ix0 : cells[2] - world.spec.ix0,
        ] = True
    return World(world.name, world.spec, occupied, world.start)


def brute_clearance_m(world: World, x_m: float, y_m: float) -> float:
    """Distance from a point to the nearest wall area or to the outside, over every cell."""
    spec, res = world.spec, world.spec.resolution_m
    low_x, low_y = spec.ix0 * res, spec.iy0 * res
    best = min(x_m - low_x, y_m - low_y, low_x + spec.width * res - x_m, low_y + spec.height * res - y_m)
    for row, column in zip(*np.nonzero(world.occupied), strict=True):
        left, bottom = low_x + column * res, low_y + row * res
        dx = max(left - x_m, 0.0, x_m - left - res)
        dy = max(bottom - y_m, 0.0, y_m - bottom - res)
        best = min(best, math.hypot(dx, dy))
    return best


def brute_sees(occupied: NDArray[np.bool_], x: float, y: float, row: int, column: int, samples: int) -> bool:
    """Line of sight in cells by fine sampling of the segment to the cell's centre."""
    t = np.linspace(0.0, 1.0, samples)
    rows = np.floor(y + t * (row + 0.5 - y)).astype(int)
    columns = np.floor(x + t * (column + 0.5 - x)).astype(int)
    return not occupied[rows, columns].any()

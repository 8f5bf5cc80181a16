"""Small uneven worlds and brute-force references for the tests of the simulator."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from services.sim.world import World

Surface = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def ground(
    width_m: float,
    height_m: float,
    surface: Surface,
    start: tuple[float, float, float],
    ceiling: Surface | None = None,
    resolution_m: float = 0.1,
    walls: tuple[tuple[float, float, float, float], ...] = (),
) -> World:
    """A world with the lower left corner at the origin whose floor is a function of x and y in metres."""
    spec = GridSpec(resolution_m, 0, 0, round(width_m / resolution_m), round(height_m / resolution_m))
    x, y = np.meshgrid(spec.centres_x(), spec.centres_y())
    occupied = np.zeros(spec.shape, dtype=np.bool_)
    for x_low, y_low, x_high, y_high in walls:
        occupied |= (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
    roof = None if ceiling is None else ceiling(x, y).astype(np.float32)
    floor = np.broadcast_to(surface(x, y), spec.shape).astype(np.float32)
    return World("ground", spec, occupied, start, floor, roof)


def ramp(slope_rad: float, from_m: float) -> Surface:
    """Level up to x = `from_m`, then rising (or falling) with the slope."""
    return lambda x, y: math.tan(slope_rad) * np.maximum(x - from_m, 0.0)


def ledge(height_m: float, at_m: float) -> Surface:
    """Level, then higher (or lower) by `height_m` from x = `at_m`."""
    return lambda x, y: np.where(x > at_m, height_m, 0.0)


def bilinear(
    world: World, heights: NDArray[np.float32], x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Heights at points, by the definition."""
    spec = world.spec
    u = np.clip(x_m / spec.resolution_m - spec.ix0 - 0.5, 0.0, spec.width - 1.0)
    v = np.clip(y_m / spec.resolution_m - spec.iy0 - 0.5, 0.0, spec.height - 1.0)
    c, r = np.minimum(u.astype(int), spec.width - 2), np.minimum(v.astype(int), spec.height - 2)
    a, b, h = u - c, v - r, np.minimum(heights, 1e6).astype(np.float64)
    low = h[r, c] * (1.0 - a) + h[r, c + 1] * a
    high = h[r + 1, c] * (1.0 - a) + h[r + 1, c + 1] * a
    is_open = np.maximum(np.maximum(h[r, c], h[r, c + 1]), np.maximum(h[r + 1, c], h[r + 1, c + 1])) > 1e5
    return np.where(is_open, np.inf, low * (1.0 - b) + high * b)


def march(
    world: World, origin_m: NDArray[np.float64], way: NDArray[np.float64], longest_m: float, step_m: float
) -> float:
    """Range of a ray by small steps; inf if it meets nothing."""
    assert world.floor_m is not None and world.ceiling_m is not None
    t = step_m * np.arange(1, int(longest_m / step_m) + 1)
    x, y, z = (origin_m[k] + way[k] * t for k in range(3))
    columns = np.floor(x / world.spec.resolution_m).astype(int) - world.spec.ix0
    rows = np.floor(y / world.spec.resolution_m).astype(int) - world.spec.iy0
    outside = (rows < 0) | (columns < 0) | (rows >= world.spec.height) | (columns >= world.spec.width)
    solid = outside.copy()
    solid[~outside] = world.occupied[rows[~outside], columns[~outside]]
    hit = solid | (z <= bilinear(world, world.floor_m, x, y)) | (z >= bilinear(world, world.ceiling_m, x, y))
    return float(t[np.argmax(hit)]) if hit.any() else math.inf

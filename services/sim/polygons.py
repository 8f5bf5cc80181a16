"""Worlds drawn as free polygons on solid ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec

Polygon = NDArray[np.float64]
"""Vertices (x, y) in metres, shape (n, 2), of a simple polygon."""


def band(a: Polygon, b: Polygon, width_m: float) -> Polygon:
    """Rectangle of `width_m` along the segment between two points of shape (2,)."""
    along = (b - a) / math.hypot(*(b - a))
    side = np.array([-along[1], along[0]]) * (width_m / 2.0)
    return np.array([a + side, b + side, b - side, a - side])


def draw(
    polygons: Sequence[Polygon], resolution_m: float, margin_m: float
) -> tuple[GridSpec, NDArray[np.bool_]]:
    """Occupied bool[height, width] with the cells whose centre lies in a polygon free, walls all round."""
    points = np.concatenate(polygons)
    low = np.floor((points.min(axis=0) - margin_m) / resolution_m).astype(int)
    high = np.ceil((points.max(axis=0) + margin_m) / resolution_m).astype(int)
    spec = GridSpec(resolution_m, int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    occupied = np.ones(spec.shape, dtype=np.bool_)
    for polygon in polygons:
        _carve(spec, occupied, polygon)
    return spec, occupied


def _carve(spec: GridSpec, occupied: NDArray[np.bool_], polygon: Polygon) -> None:
    """Free the cells whose centre lies inside, by the even-odd rule."""
    row_low, column_low = spec.cell_of(*polygon.min(axis=0))
    row_high, column_high = spec.cell_of(*polygon.max(axis=0))
    rows, columns = slice(row_low, row_high + 1), slice(column_low, column_high + 1)
    x, y = spec.centres_x()[columns], spec.centres_y()[rows, None]
    inside = np.zeros((y.shape[0], x.shape[0]), dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            crosses = (ay > y) != (by > y)
            inside ^= crosses & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    occupied[rows, columns] &= ~inside


def regular(centre: Polygon, radius_m: float, corners: int) -> Polygon:
    """Regular polygon about a point of shape (2,)."""
    angles = 2.0 * math.pi * np.arange(corners) / corners
    return centre + radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def spanning_links(
    rows: int, columns: int, extra_fraction: float, rng: np.random.Generator
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Links of a random depth-first spanning tree of a lattice, then a fraction of the others as loops.

    Depth first (a "recursive backtracker") gives long winding passages with dead ends.
    """
    start = (int(rng.integers(rows)), int(rng.integers(columns)))
    seen, stack, links = {start}, [start], []
    while stack:
        here = stack[-1]
        ways = [n for n in _neighbours(here, rows, columns) if n not in seen]
        if not ways:
            stack.pop()
            continue
        there = ways[int(rng.integers(len(ways)))]
        links.append((here, there))
        seen.add(there)
        stack.append(there)
    used = {frozenset(link) for link in links}
    cells = [(r, c) for r in range(rows) for c in range(columns)]
    unused = [(a, b) for a in cells for b in _neighbours(a, rows, columns) if a < b and {a, b} not in used]
    picked = rng.permutation(len(unused))[: round(extra_fraction * len(unused))]
    return links + [unused[int(k)] for k in sorted(picked)]


def _neighbours(cell: tuple[int, int], rows: int, columns: int) -> list[tuple[int, int]]:
    r, c = cell
    around = ((r, c + 1), (r + 1, c), (r, c - 1), (r - 1, c))
    return [(a, b) for a, b in around if 0 <= a < rows and 0 <= b < columns]

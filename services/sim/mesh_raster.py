"""A triangle mesh as columns: what stands over each cell's centre, and which cells a steep face crosses.

Every vertical line through a cell's centre is cut with all triangles at once (no ray casting): the triangles are
drawn into the grid like polygons, and the cuts sorted by height. Steep faces, which a vertical line may miss, are
sampled by points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from planning.kernels import njit

FLAT_COSINE = 0.42
"""A face whose normal leans no farther than this from the vertical (65 degrees) may be a floor."""
_SAME_M = 0.02
"""Cuts of one facing nearer to each other are one surface."""

Triangles = NDArray[np.float64]


def columns_of(triangles: Triangles, spec: GridSpec) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(first int64[cells + 1], cuts float32[n, 2]): cuts first[k] : first[k + 1] belong to cell k = row width + column.

    A cut is (height in metres, z of the face's unit normal), sorted by height.
    """
    local = _to_cells(triangles, spec)
    normals = _normal_z(triangles)
    count = np.zeros(spec.width * spec.height + 1, dtype=np.int64)
    _cut(local, normals, spec.width, spec.height, count, np.empty((0, 2), np.float32), False)
    first = np.concatenate([[0], np.cumsum(count[:-1])])
    cuts = np.empty((int(first[-1]), 2), dtype=np.float32)
    _cut(local, normals, spec.width, spec.height, first[:-1].copy(), cuts, True)
    return _sort_and_join(first, cuts)


def steep_points(triangles: Triangles, spec: GridSpec) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(cell int64[n], height float32[n]) of points on steep faces, at most half a cell apart."""
    steep = np.abs(_normal_z(triangles)) < FLAT_COSINE
    local, pitch = _to_cells(triangles[steep], spec), 0.5
    local[..., 2] /= spec.resolution_m
    total = _sample(local, pitch, spec.width, spec.height, np.empty(0, np.int64), np.empty(0, np.float32))
    cells, heights = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.float32)
    _sample(local, pitch, spec.width, spec.height, cells, heights)
    return cells, heights * np.float32(spec.resolution_m)


def _to_cells(triangles: Triangles, spec: GridSpec) -> Triangles:
    """x and y in cells of the grid, z in metres."""
    local = triangles.copy()
    local[..., 0] = triangles[..., 0] / spec.resolution_m - spec.ix0
    local[..., 1] = triangles[..., 1] / spec.resolution_m - spec.iy0
    return local


def _normal_z(triangles: Triangles) -> NDArray[np.float64]:
    """z of the unit normals; 0 for faces without area."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.sqrt((normals**2).sum(axis=1))
    return np.asarray(normals[:, 2] / np.maximum(length, 1e-300))


@njit
def _cut(
    triangles: Triangles,
    normals: NDArray[np.float64],
    width: int,
    height: int,
    place: NDArray[np.int64],
    cuts: NDArray[np.float32],
    write: bool,
) -> None:
    """Count the cuts per cell into `place`, or write them to where `place` says (and move it on)."""
    for t in range(triangles.shape[0]):
        ax, ay, az = triangles[t, 0, 0], triangles[t, 0, 1], triangles[t, 0, 2]
        bx, by, bz = triangles[t, 1, 0], triangles[t, 1, 1], triangles[t, 1, 2]
        cx, cy, cz = triangles[t, 2, 0], triangles[t, 2, 1], triangles[t, 2, 2]
        twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(twice) < 1e-12:
            continue
        column_low, column_high = math.ceil(min(ax, bx, cx) - 0.5), math.floor(max(ax, bx, cx) - 0.5)
        row_low, row_high = math.ceil(min(ay, by, cy) - 0.5), math.floor(max(ay, by, cy) - 0.5)
        for row in range(max(row_low, 0), min(row_high, height - 1) + 1):
            for column in range(max(column_low, 0), min(column_high, width - 1) + 1):
                x, y = column + 0.5, row + 0.5
                p = ((by - cy) * (x - cx) + (cx - bx) * (y - cy)) / twice
                q = ((cy - ay) * (x - cx) + (ax - cx) * (y - cy)) / twice
                if p < -1e-9 or q < -1e-9 or p + q > 1.0 + 1e-9:
                    continue
                cell = row * width + column
                if write:
                    cuts[place[cell], 0] = p * az + q * bz + (1.0 - p - q) * cz
                    cuts[place[cell], 1] = normals[t]
                place[cell] += 1


@njit
def _sort_and_join(
    first: NDArray[np.int64], cuts: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Cuts of each cell by height, with those of an edge that two triangles share joined."""
    joined_first = np.zeros(first.shape[0], dtype=np.int64)
    joined = np.empty_like(cuts)
    count = 0
    for cell in range(first.shape[0] - 1):
        begin = count
        part = cuts[first[cell] : first[cell + 1]]
        for k in np.argsort(part[:, 0]):
            same = count > begin and part[k, 0] - joined[count - 1, 0] < _SAME_M
            if same and part[k, 1] * joined[count - 1, 1] > 0.0:
                if abs(part[k, 1]) > abs(joined[count - 1, 1]):
                    joined[count - 1, 1] = part[k, 1]
                continue
            joined[count, 0], joined[count, 1] = part[k, 0], part[k, 1]
            count += 1
        joined_first[cell + 1] = count
    return joined_first, joined[:count].copy()


@njit
def _sample(
    triangles: Triangles,
    pitch: float,
    width: int,
    height: int,
    cells: NDArray[np.int64],
    heights: NDArray[np.float32],
) -> int:
    """Points on the triangles (all axes in cells), no two neighbours farther apart than `pitch`; returns how many.

    Writes them when the arrays are not empty.
    """
    count = 0
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        longest = 0.0
        for k in range(3):
            longest = max(longest, abs(b[k] - a[k]), abs(c[k] - a[k]), abs(c[k] - b[k]))
        parts = max(1, math.ceil(longest / pitch))
        for i in range(parts + 1):
            for k in range(parts + 1 - i):
                p, q = i / parts, k / parts
                x = a[0] + p * (b[0] - a[0]) + q * (c[0] - a[0])
                y = a[1] + p * (b[1] - a[1]) + q * (c[1] - a[1])
                row, column = math.floor(y), math.floor(x)
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                if cells.shape[0] > 0:
                    cells[count] = row * width + column
                    heights[count] = a[2] + p * (b[2] - a[2]) + q * (c[2] - a[2])
                count += 1
    return count

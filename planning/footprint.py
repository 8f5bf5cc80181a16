"""The swept footprint of a disc-shaped robot: clearance, mean hazard under the disc, risk of a segment.

Risk is a hazard *rate per metre travelled*, so that the risk of a path, rho = 1 - exp(-integral of h ds), does
not depend on the cell size. h(x, y) is the mean rate under the robot's disc; it is computed once per map
(`footprint_hazard`) and then integrated along centre lines (`segment_risk`).

All segment functions take the grid as plain numbers (resolution_m, ix0, iy0: see `planning.grid.GridSpec`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from planning.kernels import njit, njit_borrowing

_FREE = FREE
_LETHAL = LETHAL
_UNKNOWN = UNKNOWN
_MAX_SUBSTEP_M = 0.1
"""Longest sub-step of a line integral in metres; half a cell where cells are smaller than 0.2 m."""
_SUBSAMPLES = 32


@njit
def _propagate_nearest(
    nearest: NDArray[np.int64],
    offset_x: NDArray[np.float64],
    offset_y: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> None:
    """Let each cell take over its neighbours' nearest lethal cell where that one's point is nearer.

    The lethal cell with the nearest centre need not hold the nearest point. One sweep forward and one backward,
    in place (vector propagation after Danielsson), mend what a search by centres misses; a missed point costs
    hundredths of a cell. Flat indices, offsets and distances in cells, all (H, W).
    """
    height, width = nearest.shape
    for k in range(2 * height * width):
        cell = k if k < height * width else 2 * height * width - 1 - k
        row, column = cell // width, cell % width
        for other_row in range(max(0, row - 1), min(height, row + 2)):
            for other_column in range(max(0, column - 1), min(width, column + 2)):
                r, c = nearest[other_row, other_column] // width, nearest[other_row, other_column] % width
                d = math.hypot(c - column + offset_x[r, c], r - row + offset_y[r, c])
                if d < distance[row, column]:
                    distance[row, column] = d
                    nearest[row, column] = r * width + c


def clearance_m(
    lethal: NDArray[np.bool_],
    hit_x: NDArray[np.float32] | None,
    hit_y: NDArray[np.float32] | None,
    spec: GridSpec,
    max_clearance_m: float = 10.0,
) -> NDArray[np.float32]:
    """Distance in metres from each cell's centre to the nearest lethal cell's representative point.

    Args:
        lethal: (H, W), the cells that end the mission when touched.
        hit_x, hit_y: (H, W), mean of the hits in a lethal cell as an *offset from the cell's centre* in metres
            (NaN: none, the centre stands in), or None for the centres of all cells.
        spec: where the grid lies; only its resolution is used.
        max_clearance_m: cap, also the value where nothing is lethal; the result is always finite.

    Returns:
        (H, W) float32; 0 in lethal cells.
    """
    if not lethal.any():
        return np.full(lethal.shape, max_clearance_m, dtype=np.float32)
    distance, indices = ndimage.distance_transform_edt(~lethal, return_indices=True)
    if hit_x is not None and hit_y is not None:
        offset_x = np.nan_to_num(hit_x.astype(np.float64)) / spec.resolution_m
        offset_y = np.nan_to_num(hit_y.astype(np.float64)) / spec.resolution_m
        nearest = indices[0].astype(np.int64) * lethal.shape[1] + indices[1]
        distance = np.full(lethal.shape, np.inf)
        _propagate_nearest(nearest, offset_x, offset_y, distance)
        distance[lethal] = 0.0
    result: NDArray[np.float32] = np.minimum(distance * spec.resolution_m, max_clearance_m).astype(np.float32)
    return result


def disc_weights(radius_m: float, resolution_m: float) -> NDArray[np.float32]:
    """Fraction of each cell's area under a disc centred on the middle cell, normalised to the sum 1.

    Args:
        radius_m: radius of the disc; at 0 all the weight is on the middle cell.
        resolution_m: metres per cell.

    Returns:
        (k, k) float32, k odd.
    """
    reach = max(0, math.ceil(radius_m / resolution_m - 0.5))
    if radius_m <= 0.0 or reach == 0:
        return np.ones((1, 1), dtype=np.float32)
    size = 2 * reach + 1
    offsets = ((np.arange(size * _SUBSAMPLES) + 0.5) / _SUBSAMPLES - size / 2) * resolution_m
    inside = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= radius_m**2
    area = inside.reshape(size, _SUBSAMPLES, size, _SUBSAMPLES).mean(axis=(1, 3))
    weights: NDArray[np.float32] = (area / area.sum()).astype(np.float32)
    return weights


def kernel_radius_m(radius_m: float, resolution_m: float) -> float:
    """Radius of the disc whose weights, read through cells, spread like the true disc.

    A cell holds a mean over its area (variance res^2 / 12 per axis), area-fraction weights add the same again and
    bilinear reading res^2 / 6. The kernel's radius is shrunk by as much, r^2 = R^2 - 4/3 res^2, so that the second
    moment of the whole chain is that of the true disc, R^2 / 4, at every resolution.
    """
    return math.sqrt(max(0.0, radius_m**2 - 4.0 / 3.0 * resolution_m**2))


def footprint_hazard(
    hazard_per_m: NDArray[np.float32], radius_m: float, resolution_m: float
) -> NDArray[np.float32]:
    """Mean hazard rate under the robot's disc when its centre is at each cell's centre.

    Args:
        hazard_per_m: (H, W), hazard rate per metre travelled, the mean over each cell; finite, >= 0.
        radius_m: radius of the footprint.
        resolution_m: metres per cell.

    Returns:
        (H, W) float32; to be read bilinearly (see `kernel_radius_m`). Edges are replicated.
    """
    weights = disc_weights(kernel_radius_m(radius_m, resolution_m), resolution_m)
    if weights.size == 1:
        return hazard_per_m.astype(np.float32)
    padded = np.pad(hazard_per_m.astype(np.float32), weights.shape[0] // 2, mode="edge")
    result = np.empty(hazard_per_m.shape, np.float32)
    _correlate(padded, weights, result)
    return result


@njit
def _correlate(padded: NDArray[np.float32], weights: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Correlation with the (symmetric) weights, row by row: a sum of shifted rows takes several columns at a time."""
    size, width = weights.shape[0], out.shape[1]
    total = np.empty(width, np.float32)
    for row in range(out.shape[0]):
        total[:] = np.float32(0.0)
        for i in range(size):
            for j in range(size):
                weight = weights[i, j]
                if weight == np.float32(0.0):
                    continue
                for column in range(width):
                    total[column] += weight * padded[row + i, column + j]
        for column in range(width):
            out[row, column] = total[column]


@njit_borrowing
def bilinear(field: NDArray[np.float32], column: float, row: float) -> float:
    """Value of the field at fractional cell-centre coordinates; clamped to the border cells outside."""
    height, width = field.shape
    x = min(max(column, 0.0), width - 1.0)
    y = min(max(row, 0.0), height - 1.0)
    c = min(int(x), max(width - 2, 0))
    r = min(int(y), max(height - 2, 0))
    c_next = min(c + 1, width - 1)
    r_next = min(r + 1, height - 1)
    u = x - c
    v = y - r
    low = field[r, c] * (1.0 - u) + field[r, c_next] * u
    high = field[r_next, c] * (1.0 - u) + field[r_next, c_next] * u
    return low * (1.0 - v) + high * v


@njit_borrowing
def _substeps(length_m: float, resolution_m: float) -> int:
    return max(1, int(math.ceil(length_m / min(0.5 * resolution_m, _MAX_SUBSTEP_M) - 1e-9)))


@njit_borrowing
def segment_risk(
    footprint_hazard_per_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    x0_m: float,
    y0_m: float,
    x1_m: float,
    y1_m: float,
) -> tuple[float, float]:
    """Length and hazard integral of a straight segment of the robot's centre.

    Midpoint rule over sub-steps of at most half a cell and 0.1 m on the bilinearly interpolated field. The
    segment's traversal risk is rho = 1 - exp(-integral); integrals add along a path. Outside the grid the border
    cells' values hold.

    Returns:
        (distance_m, hazard_integral), both >= 0.
    """
    length = math.hypot(x1_m - x0_m, y1_m - y0_m)
    steps = _substeps(length, resolution_m)
    column = x0_m / resolution_m - ix0 - 0.5
    row = y0_m / resolution_m - iy0 - 0.5
    d_column = (x1_m - x0_m) / resolution_m / steps
    d_row = (y1_m - y0_m) / resolution_m / steps
    total = 0.0
    for step in range(steps):
        total += bilinear(
            footprint_hazard_per_m, column + (step + 0.5) * d_column, row + (step + 0.5) * d_row
        )
    return length, total * length / steps


@njit_borrowing
def segment_min_clearance(
    clearance: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    x0_m: float,
    y0_m: float,
    x1_m: float,
    y1_m: float,
) -> float:
    """Smallest clearance in metres on the centre line of a segment; a disc of that radius is swept freely.

    Samples at both ends and at least every half cell, bilinear. Distance is 1-Lipschitz and convex near a point,
    so the result is at most about res^2 / (4 d) + res / 4 above the exact minimum d, and never more than res / 2
    below it.
    """
    return _min_clearance_above(clearance, resolution_m, ix0, iy0, x0_m, y0_m, x1_m, y1_m, -np.inf)


@njit_borrowing
def _min_clearance_above(
    clearance: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    x0_m: float,
    y0_m: float,
    x1_m: float,
    y1_m: float,
    stop_below_m: float,
) -> float:
    """`segment_min_clearance` that gives up at the first sample below `stop_below_m`."""
    steps = _substeps(math.hypot(x1_m - x0_m, y1_m - y0_m), resolution_m)
    column = x0_m / resolution_m - ix0 - 0.5
    row = y0_m / resolution_m - iy0 - 0.5
    d_column = (x1_m - x0_m) / resolution_m / steps
    d_row = (y1_m - y0_m) / resolution_m / steps
    best = np.inf
    for step in range(steps + 1):
        best = min(best, bilinear(clearance, column + step * d_column, row + step * d_row))
        if best < stop_below_m:
            break
    return best


@njit_borrowing
def segment_state(
    state: NDArray[np.uint8],
    resolution_m: float,
    ix0: int,
    iy0: int,
    x0_m: float,
    y0_m: float,
    x1_m: float,
    y1_m: float,
) -> int:
    """Worst state of the cells that the centre line crosses: LETHAL, else UNKNOWN, else FREE.

    Exact cell traversal (Amanatides and Woo); outside the grid is UNKNOWN; a line through a cell's corner
    crosses into the diagonal cell.
    """
    height, width = state.shape
    x = x0_m / resolution_m - ix0
    y = y0_m / resolution_m - iy0
    dx = x1_m / resolution_m - ix0 - x
    dy = y1_m / resolution_m - iy0 - y
    column, row = int(math.floor(x)), int(math.floor(y))
    last_column, last_row = int(math.floor(x + dx)), int(math.floor(y + dy))
    step_column = 1 if dx > 0.0 else -1
    step_row = 1 if dy > 0.0 else -1
    t_column = ((column + (dx > 0.0)) - x) / dx if dx != 0.0 else np.inf
    t_row = ((row + (dy > 0.0)) - y) / dy if dy != 0.0 else np.inf
    worst = _FREE
    for _ in range(abs(last_column - column) + abs(last_row - row) + 1):
        if row < 0 or column < 0 or row >= height or column >= width:
            worst = _UNKNOWN
        elif state[row, column] == _LETHAL:
            return _LETHAL
        elif state[row, column] != _FREE:
            worst = _UNKNOWN
        if (column == last_column and row == last_row) or min(t_column, t_row) > 1.0:
            break
        move_column = t_column <= t_row
        move_row = t_row <= t_column
        if move_column:
            column += step_column
            t_column += abs(1.0 / dx)
        if move_row:
            row += step_row
            t_row += abs(1.0 / dy)
    return worst

"""Between the rings of a sweep: ground that may be supposed there, and ground that a ray shows to be wrong."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from services.riskmap.cells import BELOW, MEAN, SEEN, VARIANCE
from services.riskmap.ground import ABOVE, BOUND_TOLERANCE_M, GROUND, NOTHING, GroundRules, suppose
from services.riskmap.sweep import BEARINGS, Sweep

_ALIKE = 0.06
"""Two stretches of a bearing slope alike when they differ by no more per metre."""
_BESIDE_M = 0.2
"""The slope before and after a gap is taken over so much or more, m."""
_CONTRADICTED_SIGMA_M = 0.05
"""What a ray that passes below a cell's ground adds to the ground's deviation, m."""
_FORGOTTEN_VARIANCE = 0.3**2
"""Contradicted ground is forgotten when its variance is more, m2."""
_STEEP_LOOK = 0.1
"""Rays that fall by less per metre bound no ground: they are far away, and pass over everything."""


@njit
def join_rings(
    sweep: Sweep,
    kind: NDArray[np.uint8],
    ground: NDArray[np.float32],
    cells: NDArray[np.float32],
    rules: GroundRules,
) -> None:
    """Between two consecutive ground hits of a bearing: fill the ground in, or forget what the ray shows to be wrong.

    The gap is filled when it is short and slopes as the robot could drive, and is either nearly level or slopes as the
    ground before or after it does: a ledge or the rim of a pit does neither.
    """
    bins = kind.shape[1]
    distance, height = np.empty(bins + 1, dtype=np.float64), np.empty(bins + 1, dtype=np.float64)
    clear, anything = np.empty(bins + 1, dtype=np.bool_), np.empty(bins, dtype=np.uint8)
    sensor = (sweep.sensor[0], sweep.sensor[1], sweep.sensor[2])
    for b in range(BEARINGS):
        if sweep.start[b] == sweep.start[b + 1]:
            continue
        angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
        dx, dy = math.cos(angle), math.sin(angle)
        distance[0], height[0], clear[0] = 0.0, rules.feet_m, False
        count, obstructed = 1, False
        _join(kind, b, (b - 1) % BEARINGS, (b + 1) % BEARINGS, anything)
        for k in range(bins):
            if anything[k] == NOTHING:
                continue
            seen = _seen_from(kind, b, k)
            if seen < 0:
                continue
            r = float(sweep.low_distance[seen, k])
            if kind[seen, k] == GROUND:
                distance[count], height[count], clear[count] = r, ground[seen, k], not obstructed
                count += 1
            elif not obstructed:  # the lowest ray to something upright passes over ground, too
                near, near_z = distance[count - 1], height[count - 1]
                _along_gap(sensor, dx, dy, near, near_z, r, sweep.low[seen, k], False, cells, rules)
            obstructed = kind[seen, k] == ABOVE
        for j in range(1, count):
            fill = j > 1 and clear[j] and _joinable(distance, height, clear, count, j, rules)
            _along_gap(
                sensor, dx, dy, distance[j - 1], height[j - 1], distance[j], height[j], fill, cells, rules
            )


@njit_borrowing
def _join(kind: NDArray[np.uint8], b: int, left: int, right: int, out: NDArray[np.uint8]) -> None:
    """Where a bearing or its neighbours have anything: not `NOTHING`."""
    here, before, after = np.uint64(b), np.uint64(left), np.uint64(right)  # unsigned: many bins at a time
    for k in range(np.uint64(out.shape[0])):
        out[k] = kind[here, k] | kind[before, k] | kind[after, k]


@njit_borrowing
def _seen_from(kind: NDArray[np.uint8], b: int, k: int) -> int:
    """Which of a bearing and its two neighbours has something at or below the robot's height in a bin; -1: none.

    On a robot that leans, the rings of one azimuth spread over neighbouring bearings. The bearing itself comes first.
    """
    for step in (0, -1, 1):
        other = (b + step) % BEARINGS
        if kind[other, k] == GROUND or kind[other, k] == ABOVE:
            return other
    return -1


@njit
def _joinable(
    distance: NDArray[np.float64],
    height: NDArray[np.float64],
    clear: NDArray[np.bool_],
    count: int,
    j: int,
    rules: GroundRules,
) -> bool:
    """Whether ground may be supposed between the hits j - 1 and j of a bearing."""
    gap, rise = distance[j] - distance[j - 1], height[j] - height[j - 1]
    if gap > rules.max_gap_m or abs(rise) > rules.slope * gap + 0.01:
        return False
    if abs(rise) <= 0.5 * rules.step_m:
        return True
    for forwards in (False, True):
        k = j if forwards else j - 1
        end = k
        while 1 <= end < count and abs(distance[end] - distance[k]) < _BESIDE_M:
            if not clear[end + 1 if forwards and end + 1 < count else end]:
                break
            end += 1 if forwards else -1
        if 1 <= end < count and abs(distance[end] - distance[k]) >= _BESIDE_M:
            other = (height[end] - height[k]) / (distance[end] - distance[k])
            if abs(other - rise / gap) <= _ALIKE:
                return True
    return False


@njit
def _along_gap(
    sensor: tuple[float, float, float],
    dx: float,
    dy: float,
    near: float,
    near_z: float,
    far: float,
    far_z: float,
    fill: bool,
    cells: NDArray[np.float32],
    rules: GroundRules,
) -> None:
    """The cells strictly between two hits: suppose ground, and doubt ground that stands in the ray's way."""
    # Not through `slot` and views of cells: this walk is most of what a sweep costs.
    res, height, width = rules.resolution_m, cells.shape[0], cells.shape[1]
    pace = 0.7 * res
    x0, y0, z0 = sensor
    fall = (far_z - z0) / far
    bounds = fall < -_STEEP_LOOK and not fill
    for s in range(1, math.ceil((far - near) / pace)):
        r = near + s * pace
        row = int(math.floor((y0 + r * dy) / res)) - rules.iy0
        column = int(math.floor((x0 + r * dx) / res)) - rules.ix0
        if row < 0 or row >= height or column < 0 or column >= width:
            return
        row, column = row + rules.row0, column + rules.column0
        row, column = (
            (row - height if row >= height else row),
            (column - width if column >= width else column),
        )
        if far - r > res:
            known = cells[row, column, VARIANCE] > 0.0
            if known or bounds:
                below = z0 + fall * r + BOUND_TOLERANCE_M + 3.0 * rules.angle_sigma_rad * r
                if known:
                    if cells[row, column, MEAN] > below:
                        _doubt(cells, row, column)
                elif cells[row, column, SEEN] != BELOW or below < cells[row, column, MEAN]:
                    cells[row, column, MEAN], cells[row, column, SEEN] = below, BELOW
        if fill:
            share = (r - near) / (far - near)
            sigma = rules.fill_sigma_per_m * min(r - near, far - r) + rules.range_sigma_m
            suppose(cells[row, column], near_z + share * (far_z - near_z), sigma * sigma, rules)


@njit
def _doubt(cells: NDArray[np.float32], row: int, column: int) -> None:
    """A ray passed below this cell's ground: it is forgotten at once if it was supposed, else after a few rays."""
    cells[row, column, VARIANCE] += _CONTRADICTED_SIGMA_M * _CONTRADICTED_SIGMA_M
    if cells[row, column, SEEN] == 0.0 or cells[row, column, VARIANCE] > _FORGOTTEN_VARIANCE:
        cells[row, column, VARIANCE] = 0.0
        cells[row, column, SEEN] = 0.0

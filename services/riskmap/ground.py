"""Which points are ground: along each bearing, outwards from the robot's feet; and the ground's height, fused."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from services.riskmap.cells import (
    BELOW,
    CEILING,
    CEILING_SEEN,
    HIT_WEIGHT,
    LOG_ODDS,
    MEAN,
    SEEN,
    TRAVELLED,
    VARIANCE,
)
from services.riskmap.sweep import BEARINGS, Sweep

NOTHING, GROUND, ABOVE, OVERHEAD = 0, 1, 2, 3
"""Kinds of a polar bin: without points; its lowest point is ground, above the ground, or above the robot."""

_STEEP = 1.2
"""Ground may rise by so much per metre (50 degrees) ..."""
_STEEP_M = 0.7
"""... over the first so many metres since what was last seen of the bearing, ..."""
_GENTLE = 0.15
"""... and by so much beyond them, or as steeply as it has risen so far."""
_FAR_M = 4.0
"""... for at most so many metres: what shows up high and far away, with nothing before it, is no ground."""
_TREND_M = 0.15
"""How steeply ground has risen so far is read from gaps longer than this, m."""
_ALIKE = 0.06
"""Two stretches of a bearing slope alike when they differ by no more per metre."""
_BESIDE_M = 0.2
"""The slope before and after a gap is taken over so much or more, m."""
_FOOT_M = 0.05
"""The lowest point of something upright is its foot on the ground when it is so near to the ground before it, m."""
_TRUSTED_POINTS = 4.0
"""From so many points a cell's ground is the authority on what stands above it."""
_CONTRADICTED_SIGMA_M = 0.05
"""What a ray that passes below a cell's ground adds to the ground's deviation, m."""
_FORGOTTEN_VARIANCE = 0.3**2
"""Contradicted ground is forgotten when its variance is more, m2."""

_BOUND_TOLERANCE_M = 0.05
"""Rays pass so much below supposed ground before it is taken for wrong, m."""
_STEEP_LOOK = 0.1
"""Rays that fall by less per metre bound no ground: they are far away, and pass over everything."""


class GroundRules(NamedTuple):
    """Numbers of the ground model; see the config. resolution_m, then the window's origin: global and in memory.

    travelled_m: distance driven so far. feet_m: height, under the sensor, of the plane that the robot stands on;
    lean_x, lean_y: rise per metre of that plane.
    """

    resolution_m: float
    ix0: int
    iy0: int
    row0: int
    column0: int
    travelled_m: float
    feet_m: float
    lean_x: float
    lean_y: float
    height_m: float
    step_m: float
    slope: float
    range_sigma_m: float
    angle_sigma_rad: float
    drift_per_m: float
    max_gap_m: float
    fill_sigma_per_m: float
    pass_log_odds: float
    hit_log_odds: float


@njit
def slot(rules: GroundRules, height: int, width: int, x: float, y: float) -> tuple[int, int]:
    """(row, column) in memory of the cell at a point, or (-1, -1) outside the window."""
    ix, iy = math.floor(x / rules.resolution_m), math.floor(y / rules.resolution_m)
    return slot_of(rules, height, width, ix, iy)


@njit
def slot_of(rules: GroundRules, height: int, width: int, ix: int, iy: int) -> tuple[int, int]:
    """(row, column) in memory of the cell of a global index, or (-1, -1) outside the window."""
    row, column = iy - rules.iy0, ix - rules.ix0
    if row < 0 or row >= height or column < 0 or column >= width:
        return -1, -1
    row += rules.row0
    column += rules.column0
    return (row - height if row >= height else row), (column - width if column >= width else column)


@njit
def variance_now(cell: NDArray[np.float32], rules: GroundRules) -> float:
    """Variance of a known cell's height by now: odometry's height may have drifted since it was looked at, m2."""
    drift = rules.drift_per_m * (rules.travelled_m - cell[TRAVELLED])
    return cell[VARIANCE] + drift * drift


@njit
def upright(sweep: Sweep, step_m: float, height_m: float) -> NDArray[np.bool_]:
    """(BEARINGS, bins): whether there are points between step and robot height over a polar bin's lowest point.

    In it or in the four next to it: the rays that meet a wall one above the other may fall into two bins.
    """
    low = sweep.low
    found = np.zeros(low.shape, dtype=np.bool_)
    last = low.shape[1] - 1
    for b in range(BEARINGS):
        for i in range(sweep.start[b], sweep.start[b + 1]):
            k = min(int(sweep.distance[i] / sweep.bin_m), last)
            z = sweep.sensor[2] + sweep.points[i, 2]
            for db, dk in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                bn, kn = (b + db) % BEARINGS, min(max(k + dk, 0), last)
                if step_m < z - low[bn, kn] <= height_m:
                    found[bn, kn] = True
    return found


@njit
def walk(
    sweep: Sweep, body: NDArray[np.bool_], cells: NDArray[np.float32], rules: GroundRules
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Kind of each polar bin, and the height of the ground in it (or below it), both (BEARINGS, bins).

    The lowest point of a bin is ground unless it rises too steeply from the last ground of its bearing, stands well
    above the ground that the cell is known to have, or is the middle of something upright. Ground may fall as it
    likes. So crowns, overhangs and decks above the robot are not ground, as long as ground below them leads there.
    """
    kind = np.zeros(sweep.low.shape, dtype=np.uint8)
    ground = np.zeros(sweep.low.shape, dtype=np.float32)
    for b in range(BEARINGS):
        if sweep.start[b] == sweep.start[b + 1]:
            continue
        angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
        dx, dy = math.cos(angle), math.sin(angle)
        last_z, last_r = rules.feet_m, 0.0
        trend = rules.lean_x * dx + rules.lean_y * dy
        for k in range(sweep.low.shape[1]):
            z = sweep.low[b, k]
            if z == np.inf:
                continue
            r = sweep.low_distance[b, k]
            row, column = slot(rules, cells.shape[0], cells.shape[1], sweep.sensor[0] + r * dx, sweep.sensor[1] + r * dy)  # fmt: skip  # noqa: E501
            known, mean = False, np.float32(0.0)
            if row >= 0:
                mean = cells[row, column, MEAN]
                known = cells[row, column, SEEN] >= _TRUSTED_POINTS and mean > last_z - rules.height_m
            gap = r - last_r
            if known:
                drift = rules.drift_per_m * (rules.travelled_m - cells[row, column, TRAVELLED])
                gate = max(rules.step_m, 3.0 * math.sqrt(cells[row, column, VARIANCE] + drift * drift))
                is_ground = z <= mean + gate
            elif body[b, k]:
                is_ground = z <= last_z + _FOOT_M + 0.1 * min(gap, 0.5)
            else:
                goes_on = max(_GENTLE, min(trend, rules.slope)) * min(max(gap - _STEEP_M, 0.0), _FAR_M)
                is_ground = z <= last_z + rules.step_m + _STEEP * min(gap, _STEEP_M) + goes_on
            if is_ground:
                if gap > _TREND_M:
                    trend = 0.5 * (trend + (z - last_z) / gap)
                kind[b, k], ground[b, k] = GROUND, z
                last_z, last_r = z, r
                continue
            ground[b, k] = min(mean, z) if known else min(last_z, z)
            kind[b, k] = ABOVE if z - ground[b, k] <= rules.height_m else OVERHEAD
            if kind[b, k] == ABOVE:
                last_r = r
    return kind, ground


@njit
def fuse_ground(
    sweep: Sweep,
    kind: NDArray[np.uint8],
    ground: NDArray[np.float32],
    cells: NDArray[np.float32],
    rules: GroundRules,
) -> None:
    """Fuse the sweep's ground points into the cells: one Kalman update a cell and sweep.

    A cell's measurement is the mean of its low points, those within a step of the lowest; its variance is that of the
    sensor's attitude at this range, which all points of a sweep share, and of the points' scatter by their number.
    """
    height, width = cells.shape[0], cells.shape[1]
    lowest = np.full((height, width), np.inf, dtype=np.float32)
    place = np.zeros((height, width), dtype=np.int32)  # of the cell among those touched, from 1 on
    count = sweep.points.shape[0]
    sums = np.zeros((count + 1, 4), dtype=np.float32)
    rows, columns = np.full(count, -1, dtype=np.int32), np.zeros(count, dtype=np.int32)
    touched = np.empty((count, 2), dtype=np.int32)
    last = kind.shape[1] - 1
    for b in range(BEARINGS):
        for i in range(sweep.start[b], sweep.start[b + 1]):
            k = min(int(sweep.distance[i] / sweep.bin_m), last)
            z = np.float32(sweep.sensor[2] + sweep.points[i, 2])
            if kind[b, k] != GROUND or z - ground[b, k] > rules.step_m:
                continue
            r, c = slot(rules, height, width, sweep.sensor[0] + sweep.points[i, 0], sweep.sensor[1] + sweep.points[i, 1])  # fmt: skip  # noqa: E501
            rows[i], columns[i] = r, c
            if r >= 0 and z < lowest[r, c]:
                lowest[r, c] = z
    found = 0
    for i in range(count):
        r, c = rows[i], columns[i]
        if r < 0:
            continue
        over = np.float32(sweep.sensor[2] + sweep.points[i, 2]) - lowest[r, c]
        if over <= rules.step_m:
            t = place[r, c]
            if t == 0:
                touched[found, 0], touched[found, 1] = r, c
                found += 1
                t = place[r, c] = found
            sums[t, 0] += 1.0
            sums[t, 1] += over
            sums[t, 2] += over * over
            sums[t, 3] = max(sums[t, 3], sweep.distance[i])
    for t in range(found):
        r, c = touched[t, 0], touched[t, 1]
        n = sums[t + 1, 0]
        mean = sums[t + 1, 1] / n
        scatter = max(sums[t + 1, 2] / n - mean * mean, 0.0)
        attitude = rules.angle_sigma_rad * sums[t + 1, 3]
        noise = attitude * attitude + (rules.range_sigma_m * rules.range_sigma_m + scatter) / n
        _fuse(cells[r, c], lowest[r, c] + mean, noise, n, rules)


@njit
def _fuse(cell: NDArray[np.float32], z: float, noise: float, points: float, rules: GroundRules) -> None:
    """One measurement of a cell's ground: Kalman, unless it does not fit what was known; then the new one stands."""
    if cell[SEEN] > 0.0:
        prior = variance_now(cell, rules)
        gate = max(rules.step_m, 3.0 * math.sqrt(prior + noise))
        if abs(z - cell[MEAN]) <= gate:
            gain = prior / (prior + noise)
            z = cell[MEAN] + gain * (z - cell[MEAN])
            noise = (1.0 - gain) * prior
            points = min(points + cell[SEEN], 1e6)
        elif abs(z - cell[MEAN]) > rules.height_m:
            cell[CEILING_SEEN] = 0.0  # another storey
    cell[MEAN], cell[VARIANCE] = z, noise
    cell[SEEN], cell[TRAVELLED] = points, rules.travelled_m
    # Ground that rises before the robot is taken for something overhead, while what leads there is unknown. What is
    # truly as low will be hit again, as an obstacle over this ground.
    if cell[CEILING_SEEN] > 0.0 and cell[CEILING] - z <= rules.height_m:
        cell[CEILING_SEEN] = 0.0
    if cell[HIT_WEIGHT] == 0.0:
        cell[LOG_ODDS] = max(cell[LOG_ODDS] - rules.pass_log_odds, -rules.hit_log_odds)


@njit
def suppose(cell: NDArray[np.float32], z: float, variance: float, rules: GroundRules) -> None:
    """A height that was not measured: taken where nothing is known, or only something less certain.

    Not where rays have shown the ground to be lower.
    """
    if cell[SEEN] == BELOW and z > cell[MEAN] + _BOUND_TOLERANCE_M:
        return
    if cell[VARIANCE] == 0.0 or (cell[SEEN] == 0.0 and variance < variance_now(cell, rules)):
        cell[MEAN], cell[VARIANCE] = z, variance
        cell[SEEN], cell[TRAVELLED] = 0.0, rules.travelled_m


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
                below = z0 + fall * r + _BOUND_TOLERANCE_M + 3.0 * rules.angle_sigma_rad * r
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

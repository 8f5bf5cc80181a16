"""Which points are ground: along each bearing, outwards from the robot's feet; and the ground's height, fused."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.riskmap.cells import (
    BELOW,
    CEILING,
    CEILING_SEEN,
    HIT_LOW,
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
_FOOT_M = 0.05
"""The lowest point of something upright is its foot on the ground when it is so near to the ground before it, m."""
_TRUSTED_POINTS = 4.0
"""From so many points a cell's ground is the authority on what stands above it."""

ITSELF_M = 0.15
"""A point that is no farther from supposed ground is that ground: what stands there has points higher up, too."""
BOUND_TOLERANCE_M = 0.05
"""Rays pass so much below supposed ground before it is taken for wrong, m."""


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
def _lowest_beyond(sweep: Sweep, b: int, lowest_rise: NDArray[np.float32]) -> None:
    """Into (bins,): rise per metre of the lowest ray of a bearing that ends beyond each bin; inf: none does."""
    lowest = np.float32(np.inf)
    for k in range(lowest_rise.size - 1, -1, -1):
        lowest_rise[k] = lowest
        if sweep.low[b, k] < np.inf:
            lowest = min(lowest, (sweep.low[b, k] - np.float32(sweep.sensor[2])) / sweep.low_distance[b, k])


@njit
def walk(
    sweep: Sweep, body: NDArray[np.bool_], cells: NDArray[np.float32], rules: GroundRules
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Kind of each polar bin, and the height of the ground in it (or below it), both (BEARINGS, bins).

    The lowest point of a bin is ground unless it rises too steeply from the last ground of its bearing, stands well
    above the ground that the cell is known to have, or is the middle of something upright. Ground may fall as it
    likes. So crowns, overhangs and decks above the robot are not ground, as long as ground below them leads there, nor
    is anything below which a ray has passed, in this sweep or before: a roof that comes down is no ground that rises.
    """
    lowest_rise = np.empty(sweep.low.shape[1], dtype=np.float32)
    kind = np.zeros(sweep.low.shape, dtype=np.uint8)
    ground = np.zeros(sweep.low.shape, dtype=np.float32)
    for b in range(BEARINGS):
        if sweep.start[b] == sweep.start[b + 1]:
            continue
        angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
        dx, dy = math.cos(angle), math.sin(angle)
        _lowest_beyond(sweep, b, lowest_rise)
        last_z, last_r = rules.feet_m, 0.0
        trend = rules.lean_x * dx + rules.lean_y * dy
        for k in range(sweep.low.shape[1]):
            z = sweep.low[b, k]
            if z == np.inf:
                continue
            r = sweep.low_distance[b, k]
            row, column = slot(rules, cells.shape[0], cells.shape[1], sweep.sensor[0] + r * dx, sweep.sensor[1] + r * dy)  # fmt: skip  # noqa: E501
            known, mean, gap = False, np.float32(0.0), r - last_r
            bound = sweep.sensor[2] + lowest_rise[k] * r + BOUND_TOLERANCE_M + 3.0 * rules.angle_sigma_rad * r
            if row >= 0:
                # Much lower than what leads there it is the ground of another storey, unless a slope may lie between.
                mean = cells[row, column, MEAN]
                lower = rules.height_m + _STEEP * gap
                known = cells[row, column, SEEN] >= _TRUSTED_POINTS and mean > last_z - lower
                if cells[row, column, SEEN] == BELOW:
                    bound = min(bound, mean + rules.step_m)
            if z > bound:
                is_ground = False
            elif known:
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
    # And a roof over ground that falls away is taken for an obstacle on it, until the ground is seen.
    if cell[HIT_WEIGHT] > 0.0 and cell[HIT_LOW] - z > rules.height_m + 3.0 * math.sqrt(noise):
        cell[CEILING] = cell[HIT_LOW] if cell[CEILING_SEEN] == 0.0 else min(cell[HIT_LOW], cell[CEILING])
        cell[CEILING_SEEN] += cell[HIT_WEIGHT]
        cell[HIT_WEIGHT], cell[LOG_ODDS] = 0.0, 0.0
    if cell[HIT_WEIGHT] == 0.0:
        cell[LOG_ODDS] = max(cell[LOG_ODDS] - rules.pass_log_odds, -rules.hit_log_odds)


@njit
def suppose(cell: NDArray[np.float32], z: float, variance: float, rules: GroundRules) -> None:
    """A height that was not measured: taken where nothing is known, or only something less certain.

    Not where rays have shown the ground to be lower.
    """
    if cell[SEEN] == BELOW and z > cell[MEAN] + BOUND_TOLERANCE_M:
        return
    if cell[VARIANCE] == 0.0 or (cell[SEEN] == 0.0 and variance < variance_now(cell, rules)):
        cell[MEAN], cell[VARIANCE] = z, variance
        cell[SEEN], cell[TRAVELLED] = 0.0, rules.travelled_m
    # What was seen at this height while nothing led there was this ground, not something over it.
    if cell[SEEN] == 0.0 and cell[CEILING_SEEN] > 0.0 and abs(cell[CEILING] - cell[MEAN]) <= ITSELF_M:
        cell[CEILING_SEEN] = 0.0

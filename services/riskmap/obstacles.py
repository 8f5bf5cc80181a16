"""What stands on the ground: hits between step and robot height, the ceiling above, and rays that pierce old hits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from services.riskmap.cells import (
    CEILING,
    CEILING_SEEN,
    HIT_HIGH,
    HIT_LOW,
    HIT_WEIGHT,
    HIT_X,
    HIT_Y,
    LOG_ODDS,
    MEAN,
    SEEN,
    VARIANCE,
)
from services.riskmap.ground import ITSELF_M, GroundRules, slot
from services.riskmap.sweep import BEARINGS, Sweep

_PIERCED_M = 0.02
"""A ray speaks against a surface that it passes at this distance or nearer, m."""
_ABOVE_M = 0.03
"""It must pass no more than this above the highest or below the lowest hit, m."""
_LONG_MEMORY = 64.0
"""The mean hit is over so many of the last hits."""


@njit
def add_hits(
    sweep: Sweep,
    ground: NDArray[np.float32],
    lowest_m: float,
    clamp_log_odds: float,
    cells: NDArray[np.float32],
    rules: GroundRules,
) -> NDArray[np.bool_]:
    """Points over the ground: obstacles from `lowest_m` to the robot's height, ceiling above it.

    ground: (BEARINGS, bins), the local ground. Returns the cells (in memory's order) that the sweep hit.
    """
    height, width = cells.shape[0], cells.shape[1]
    hit_now = np.zeros((height, width), dtype=np.bool_)
    last = ground.shape[1] - 1
    for b in range(BEARINGS):
        for i in range(sweep.start[b], sweep.start[b + 1]):
            k = min(int(sweep.distance[i] / sweep.bin_m), last)
            z = sweep.sensor[2] + sweep.points[i, 2]
            over = z - ground[b, k]
            if over <= lowest_m:
                continue
            x, y = sweep.sensor[0] + sweep.points[i, 0], sweep.sensor[1] + sweep.points[i, 1]
            row, column = slot(rules, height, width, x, y)
            if row < 0:
                continue
            cell = cells[row, column]
            if over > rules.height_m:
                # Far up a slope, where a sweep misses what leads there: ground that was seen is no ceiling of itself.
                if cell[SEEN] > 0.0 and z - cell[MEAN] <= rules.height_m:
                    continue
                if cell[SEEN] == 0.0 and cell[VARIANCE] > 0.0 and abs(z - cell[MEAN]) <= ITSELF_M:
                    continue
                cell[CEILING] = z if cell[CEILING_SEEN] == 0.0 else min(z, cell[CEILING])
                cell[CEILING_SEEN] = min(cell[CEILING_SEEN] + 1.0, 1e6)
                continue
            if not hit_now[row, column]:
                hit_now[row, column] = True
                cell[LOG_ODDS] = min(cell[LOG_ODDS] + rules.hit_log_odds, clamp_log_odds)
            off_x = x - (math.floor(x / rules.resolution_m) + 0.5) * rules.resolution_m
            off_y = y - (math.floor(y / rules.resolution_m) + 0.5) * rules.resolution_m
            _mean_hit(cell, off_x, off_y, z)
    return hit_now


@njit
def _mean_hit(cell: NDArray[np.float32], off_x: float, off_y: float, z: float) -> None:
    if cell[HIT_WEIGHT] == 0.0:
        cell[HIT_X], cell[HIT_Y], cell[HIT_LOW], cell[HIT_HIGH] = 0.0, 0.0, z, z
    weight = min(cell[HIT_WEIGHT] + 1.0, _LONG_MEMORY)
    cell[HIT_WEIGHT] = weight
    cell[HIT_X] += (off_x - cell[HIT_X]) / weight
    cell[HIT_Y] += (off_y - cell[HIT_Y]) / weight
    cell[HIT_LOW], cell[HIT_HIGH] = min(cell[HIT_LOW], z), max(cell[HIT_HIGH], z)


@njit
def clear_pierced(
    sweep: Sweep, hit_now: NDArray[np.bool_], cells: NDArray[np.float32], rules: GroundRules
) -> None:
    """Evidence against old hits, once a sweep: a ray went on through their mean, at a height where they were hit.

    A ray that grazes a wall, or passes over a boulder, says nothing about it.
    """
    height, width = cells.shape[0], cells.shape[1]
    done = hit_now
    res = rules.resolution_m
    x0, y0 = sweep.sensor[0] / res - rules.ix0, sweep.sensor[1] / res - rules.iy0
    for b in range(BEARINGS):
        first, end = sweep.start[b], sweep.start[b + 1]
        if first == end:
            continue
        longest = first
        for i in range(first, end):
            if sweep.distance[i] > sweep.distance[longest]:
                longest = i
        length = sweep.distance[longest] / res - 0.5
        dx = sweep.points[longest, 0] / sweep.distance[longest]
        dy = sweep.points[longest, 1] / sweep.distance[longest]
        column, row = math.floor(x0), math.floor(y0)
        next_x = ((column + (1 if dx > 0 else 0)) - x0) / dx if dx != 0.0 else math.inf
        next_y = ((row + (1 if dy > 0 else 0)) - y0) / dy if dy != 0.0 else math.inf
        travelled = 0.0
        while travelled < length and 0 <= row < height and 0 <= column < width:
            r, c = row + rules.row0, column + rules.column0
            r, c = (r - height if r >= height else r), (c - width if c >= width else c)
            if cells[r, c, HIT_WEIGHT] > 0.0 and not done[r, c]:
                off_x = (column + 0.5 - x0) * res + cells[r, c, HIT_X]
                off_y = (row + 0.5 - y0) * res + cells[r, c, HIT_Y]
                if _pierced(
                    sweep, first, end, off_x, off_y, cells[r, c, HIT_LOW], cells[r, c, HIT_HIGH], res
                ):
                    done[r, c] = True
                    speak_against(cells[r, c], rules)
            if next_x < next_y:
                travelled = next_x
                next_x += abs(1.0 / dx)
                column += 1 if dx > 0 else -1
            else:
                travelled = next_y
                next_y += abs(1.0 / dy)
                row += 1 if dy > 0 else -1


@njit_borrowing
def _pierced(
    sweep: Sweep,
    first: int,
    end: int,
    off_x: float,
    off_y: float,
    hit_low: float,
    hit_high: float,
    resolution_m: float,
) -> bool:
    """Whether one of the rays went through the mean hit, which is at (off_x, off_y) from the sensor."""
    for i in range(first, end):
        reach = sweep.distance[i]
        dx, dy = sweep.points[i, 0] / reach, sweep.points[i, 1] / reach
        along = off_x * dx + off_y * dy
        if along >= reach - 0.5 * resolution_m or abs(off_x * dy - off_y * dx) > _PIERCED_M:
            continue
        z = sweep.sensor[2] + sweep.points[i, 2] / reach * along
        if hit_low - _ABOVE_M <= z <= hit_high + _ABOVE_M:
            return True
    return False


@njit
def speak_against(cell: NDArray[np.float32], rules: GroundRules) -> None:
    cell[LOG_ODDS] -= rules.pass_log_odds
    if cell[LOG_ODDS] < 0.0:
        cell[HIT_WEIGHT] = 0.0

"""Ground that the robot knows without seeing it: where it stands, and around where it was put down."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.riskmap.cells import BELOW, CEILING_SEEN, HIT_WEIGHT, LOG_ODDS, MEAN, SEEN, VARIANCE
from services.riskmap.ground import ABOVE, GROUND, GroundRules, slot_of, suppose
from services.riskmap.obstacles import speak_against
from services.riskmap.sweep import BEARINGS, Sweep

_NEIGHBOURS = 5
"""Rays of one azimuth may lie in several bins, and some are lost: a bearing is read with so many bins beside it."""
_LIKE_OWN_SLOPE = 0.2
"""The first ground seen may rise or fall, from the robot's own plane, by so much per metre."""
_UNSEEN_START_M = 1.0
"""Where no bearing is near, or the first ground on it does not fit, so much is supposed around the start, m."""


@njit
def stand_here(
    x: float, y: float, z: float, radius_m: float, sigma_m: float,
    cells: NDArray[np.float32], rules: GroundRules,
) -> None:  # fmt: skip
    """The robot stands on its disc of ground: supposed in its own plane, and nothing stands in its middle."""
    res = rules.resolution_m
    for iy in range(math.floor((y - radius_m) / res), math.floor((y + radius_m) / res) + 1):
        for ix in range(math.floor((x - radius_m) / res), math.floor((x + radius_m) / res) + 1):
            dx, dy = (ix + 0.5) * res - x, (iy + 0.5) * res - y
            away = math.sqrt(dx * dx + dy * dy)
            row, column = slot_of(rules, cells.shape[0], cells.shape[1], ix, iy)
            if away > radius_m or row < 0:
                continue
            cell = cells[row, column]
            plane = z + rules.lean_x * dx + rules.lean_y * dy
            if cell[VARIANCE] > 0.0 and abs(cell[MEAN] - plane) > rules.height_m:  # another storey
                cell[VARIANCE], cell[SEEN], cell[CEILING_SEEN] = 0.0, 0.0, 0.0
            if cell[SEEN] == BELOW:
                cell[SEEN] = 0.0
            suppose(cell, plane, sigma_m * sigma_m, rules)
            if away <= radius_m - 1.5 * res and cell[HIT_WEIGHT] > 0.0:
                speak_against(cell, rules)


@njit
def start_ground(
    sweep: Sweep,
    kind: NDArray[np.uint8],
    ground: NDArray[np.float32],
    radius_m: float,
    rules: GroundRules,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(BEARINGS,) each: how far ground around the start may be supposed, m, and its rise per metre.

    Straight from the robot's feet to the first ground seen: up to `radius_m`, or to that ground if it is not much
    farther away, or to the first obstacle. Where the first ground does not lie about in the robot's own plane, or none
    is seen, less; there and up to obstacles the slope is that of the bearings to the left and the right, or the
    robot's own where there are none.
    """
    stop, first, rise = _first_seen(sweep, kind, ground, rules)
    reach, slope = np.full(BEARINGS, min(radius_m, _UNSEEN_START_M)), np.full(BEARINGS, np.nan)
    for b in range(BEARINGS):
        angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
        own = rules.lean_x * math.cos(angle) + rules.lean_y * math.sin(angle)
        nearest_stop, nearest = np.inf, b
        for away in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            other = (b + away) % BEARINGS
            nearest_stop = min(nearest_stop, stop[other])
            if first[other] < np.inf and (
                first[nearest] == np.inf or abs(rise[other] - own) < abs(rise[nearest] - own)
            ):
                nearest = other
        if nearest_stop < min(first[nearest], radius_m):
            reach[b] = nearest_stop
        elif first[nearest] < np.inf and abs(rise[nearest] - own) <= _LIKE_OWN_SLOPE:
            seen_m = first[nearest] if first[nearest] <= radius_m + rules.max_gap_m else 0.0
            reach[b], slope[b] = min(max(radius_m, seen_m), nearest_stop), rise[nearest]
    _between(slope, rules)
    return reach, slope


@njit
def _first_seen(
    sweep: Sweep, kind: NDArray[np.uint8], ground: NDArray[np.float32], rules: GroundRules
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Of each bearing: range of the first obstacle, of the first ground (inf: none), and its rise from the feet."""
    stop, first, rise = np.full(BEARINGS, np.inf), np.full(BEARINGS, np.inf), np.zeros(BEARINGS)
    for b in range(BEARINGS):
        for k in range(kind.shape[1]):
            if kind[b, k] == ABOVE:
                stop[b] = sweep.low_distance[b, k]
                break
            if kind[b, k] == GROUND and first[b] == np.inf:
                first[b] = sweep.low_distance[b, k]
                rise[b] = (ground[b, k] - rules.feet_m) / first[b]
    return stop, first, rise


@njit
def _between(slope: NDArray[np.float64], rules: GroundRules) -> None:
    """Fill what is NaN, in place: linear in the angle between the nearest bearings on both sides."""
    known = np.flatnonzero(np.isfinite(slope))
    for b in range(BEARINGS):
        if math.isfinite(slope[b]):
            continue
        if known.size == 0:
            angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
            slope[b] = rules.lean_x * math.cos(angle) + rules.lean_y * math.sin(angle)
            continue
        i = np.searchsorted(known, b)
        left, right = known[(i - 1) % known.size], known[i % known.size]
        to_left, to_right = (b - left) % BEARINGS, (right - b) % BEARINGS
        slope[b] = (slope[left] * to_right + slope[right] * to_left) / max(to_left + to_right, 1)


@njit
def suppose_start(
    x: float,
    y: float,
    reach_m: NDArray[np.float64],
    slope: NDArray[np.float64],
    sigma_m: float,
    cells: NDArray[np.float32],
    rules: GroundRules,
) -> None:
    """Around the first pose the ground is where it seems to be until it is seen, where nothing stands on it."""
    res, most = rules.resolution_m, reach_m.max()
    for iy in range(math.floor((y - most) / res), math.floor((y + most) / res) + 1):
        for ix in range(math.floor((x - most) / res), math.floor((x + most) / res) + 1):
            dx, dy = (ix + 0.5) * res - x, (iy + 0.5) * res - y
            away = math.sqrt(dx * dx + dy * dy)
            bearing = int((math.atan2(dy, dx) / (2.0 * math.pi) + 1.0) * BEARINGS) % BEARINGS
            row, column = slot_of(rules, cells.shape[0], cells.shape[1], ix, iy)
            if away <= reach_m[bearing] - 0.5 * res and row >= 0 and cells[row, column, LOG_ODDS] <= 0.0:
                suppose(cells[row, column], rules.feet_m + slope[bearing] * away, sigma_m * sigma_m, rules)

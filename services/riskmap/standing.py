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
"""Rays of one azimuth may lie in several bins, and some are lost: a bearing is read with so many bins on either side."""
_UNSEEN_START_M = 1.0
"""Where no bearing is near, or the first ground on it does not fit, so much is supposed around the start, m."""


@njit
def stand_here(
    x: float, y: float, radius_m: float, slope_x: float, slope_y: float, sigma_m: float,
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
            z = rules.feet_m + slope_x * dx + slope_y * dy
            if cell[VARIANCE] > 0.0 and abs(cell[MEAN] - z) > rules.height_m:  # another storey
                cell[VARIANCE], cell[SEEN], cell[CEILING_SEEN] = 0.0, 0.0, 0.0
            if cell[SEEN] == BELOW:
                cell[SEEN] = 0.0
            suppose(cell, z, sigma_m * sigma_m, rules)
            if away <= radius_m - 1.5 * res and cell[HIT_WEIGHT] > 0.0:
                speak_against(cell, rules)


@njit
def start_ground(
    sweep: Sweep,
    kind: NDArray[np.uint8],
    ground: NDArray[np.float32],
    radius_m: float,
    slope_x: float,
    slope_y: float,
    rules: GroundRules,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(BEARINGS,) each: how far ground around the start may be supposed, m, and its rise per metre.

    Up to the first obstacle of the bearing, in the robot's own plane; else up to `radius_m`, straight from its feet to
    the first ground seen. Where that is not to be reached by a slope that the robot can drive, less.
    """
    stop, first, rise = np.full(BEARINGS, np.inf), np.full(BEARINGS, np.inf), np.zeros(BEARINGS)
    for b in range(BEARINGS):
        for k in range(kind.shape[1]):
            if kind[b, k] == ABOVE:
                stop[b] = sweep.low_distance[b, k]
                break
            if kind[b, k] == GROUND and first[b] == np.inf:
                first[b] = sweep.low_distance[b, k]
                rise[b] = (ground[b, k] - rules.feet_m) / first[b]
    reach, slope = np.full(BEARINGS, min(radius_m, _UNSEEN_START_M)), np.zeros(BEARINGS)
    for b in range(BEARINGS):
        angle = 2.0 * math.pi * (b + 0.5) / BEARINGS
        slope[b] = slope_x * math.cos(angle) + slope_y * math.sin(angle)
        nearest_stop, nearest = np.inf, b
        for away in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            other = (b + away) % BEARINGS
            nearest_stop = min(nearest_stop, stop[other])
            if first[other] < first[nearest]:
                nearest = other
        if nearest_stop < min(first[nearest], radius_m):
            reach[b] = nearest_stop
        elif first[nearest] < np.inf and abs(rise[nearest]) <= rules.slope:
            reach[b], slope[b] = min(radius_m, nearest_stop), rise[nearest]
    return reach, slope


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

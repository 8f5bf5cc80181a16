"""Ground that the robot knows without seeing it: where it stands, and around where it was put down."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.riskmap.cells import CEILING_SEEN, HIT_WEIGHT, LOG_ODDS, MEAN, SEEN, VARIANCE
from services.riskmap.ground import ABOVE, GROUND, GroundRules, slot, suppose
from services.riskmap.obstacles import speak_against
from services.riskmap.sweep import BEARINGS, Sweep

_NEIGHBOURS = 9
"""A bearing without points counts on the nearest within so many bins (1.8 degrees)."""
_UNSEEN_START_M = 1.0
"""Where no bearing is near, or the first ground on it does not fit, so much is supposed around the start, m."""


@njit
def stand_here(
    x: float, y: float, radius_m: float, slope_x: float, slope_y: float, sigma_m: float,
    cells: NDArray[np.float32], rules: GroundRules,
) -> None:  # fmt: skip
    """The robot stands on its disc of ground: supposed at its feet's plane, and nothing stands in its middle."""
    reach = math.ceil(radius_m / rules.resolution_m)
    for row_step in range(-reach, reach + 1):
        for column_step in range(-reach, reach + 1):
            dx, dy = column_step * rules.resolution_m, row_step * rules.resolution_m
            away = math.sqrt(dx * dx + dy * dy)
            if away > radius_m:
                continue
            row, column = slot(rules, cells.shape[0], cells.shape[1], x + dx, y + dy)
            if row < 0:
                continue
            cell = cells[row, column]
            _stand_on(cell, rules.feet_m + slope_x * dx + slope_y * dy, sigma_m * sigma_m, rules)
            if away <= radius_m - 1.5 * rules.resolution_m and cell[HIT_WEIGHT] > 0.0:
                speak_against(cell, rules)


@njit
def _stand_on(cell: NDArray[np.float32], z: float, variance: float, rules: GroundRules) -> None:
    from_storey = cell[VARIANCE] > 0.0 and abs(cell[MEAN] - z) > rules.height_m
    if from_storey:
        cell[VARIANCE], cell[SEEN], cell[CEILING_SEEN] = 0.0, 0.0, 0.0
    suppose(cell, z, variance, rules)


@njit
def start_reach(
    sweep: Sweep, kind: NDArray[np.uint8], ground: NDArray[np.float32], radius_m: float, rules: GroundRules
) -> NDArray[np.float64]:
    """(BEARINGS,): how far the ground around the start may be supposed level, m: up to the first obstacle.

    Where the first ground that a bearing sees is lower or higher than the robot could have driven to, less.
    """
    own = np.full(BEARINGS, -1.0)
    for b in range(BEARINGS):
        for k in range(kind.shape[1]):
            if kind[b, k] == ABOVE:
                own[b] = min(radius_m, sweep.low_distance[b, k])
                break
            if kind[b, k] == GROUND:
                away = sweep.low_distance[b, k]
                fits = abs(ground[b, k] - rules.feet_m) <= rules.step_m + rules.slope * away
                own[b] = radius_m if fits else min(radius_m, _UNSEEN_START_M)
                break
    reach = np.empty(BEARINGS)
    for b in range(BEARINGS):
        nearest = math.inf
        for step in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            seen = own[(b + step) % BEARINGS]
            if seen >= 0.0 and abs(step) <= 2:
                nearest = min(nearest, seen)
        for step in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            seen = own[(b + step) % BEARINGS]
            if nearest == math.inf and seen >= 0.0:
                nearest = seen
        reach[b] = nearest if nearest < math.inf else min(radius_m, _UNSEEN_START_M)
    return reach


@njit
def suppose_start(
    x: float, y: float, reach_m: NDArray[np.float64], sigma_m: float, cells: NDArray[np.float32], rules: GroundRules
) -> None:
    """Around the first pose the ground is at the robot's feet until it is seen, where nothing stands on it."""
    cells_out = math.ceil(reach_m.max() / rules.resolution_m)
    for row_step in range(-cells_out, cells_out + 1):
        for column_step in range(-cells_out, cells_out + 1):
            dx, dy = column_step * rules.resolution_m, row_step * rules.resolution_m
            away = math.sqrt(dx * dx + dy * dy)
            bearing = int((math.atan2(dy, dx) / (2.0 * math.pi) + 1.0) * BEARINGS) % BEARINGS
            if away > reach_m[bearing] - 0.5 * rules.resolution_m:
                continue
            row, column = slot(rules, cells.shape[0], cells.shape[1], x + dx, y + dy)
            if row >= 0 and cells[row, column, LOG_ODDS] <= 0.0:
                suppose(cells[row, column], rules.feet_m, sigma_m * sigma_m, rules)

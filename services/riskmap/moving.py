"""What moves: points in ground that was known to be free (Schmid et al., Dynablox, RA-L 2023; flat ground).

A cell earns trust once it has been seen free for certain, and loses it only when something has stood in it for a while.
A point in a trusted cell, with nothing but trusted cells around it, belongs to something that has come there: a person,
a closing door. Walls that come into view lie in cells that were never free, and a wall's noise lies beside the wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit


class MovingRules(NamedTuple):
    """Which points are asked. range_m: farther ones are not, as the pose's error of yaw moves them.

    low_m, high_m: heights in `odom` between which the robot can meet a point, m. self_m: nearer ones are its own, m.
    """

    range_m: float
    low_m: float
    high_m: float
    self_m: float


@njit
def update_trust(
    log_odds: NDArray[np.float32],
    elapsed_s: float,
    certain: float,
    settle_s: float,
    trust_s: NDArray[np.float32],
) -> None:
    """Refresh the trust (h, w) of each cell from its evidence, `elapsed_s` after the last sweep; trust_s is changed.

    Log-odds below minus `certain` earn the full trust of `settle_s`: the time for which something must stand in the
    cell until it is no longer taken for something that moves.
    """
    for row in range(log_odds.shape[0]):
        for column in range(log_odds.shape[1]):
            if log_odds[row, column] <= -certain:
                trust_s[row, column] = settle_s
            elif log_odds[row, column] > 0.0 and trust_s[row, column] > 0.0:
                trust_s[row, column] = max(trust_s[row, column] - elapsed_s, 0.0)


@njit
def moving_points(
    points_m: NDArray[np.float32],
    sensor: NDArray[np.float64],
    rules: MovingRules,
    resolution_m: float,
    ix0: int,
    iy0: int,
    trust_s: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Where the sweep met something that moves, (m, 2) m in `odom`: the mean of the points in each such cell.

    points_m: (n, 3) in the sensor's frame. sensor: x, y, z, yaw in odom. A cell counts with two points or more and
    another such cell beside it: a single one is noise.
    """
    height, width = trust_s.shape
    count = np.zeros((height, width), dtype=np.int32)
    total = np.zeros((height, width, 2), dtype=np.float64)
    cosine, sine = math.cos(sensor[3]), math.sin(sensor[3])
    met = np.empty((points_m.shape[0], 2), dtype=np.int32)
    size = 0
    for i in range(points_m.shape[0]):
        px, py, pz = float(points_m[i, 0]), float(points_m[i, 1]), float(points_m[i, 2])
        distance = math.sqrt(px * px + py * py)
        # Written so that a coordinate that is not a number is passed over too.
        if not (rules.self_m <= distance <= rules.range_m and rules.low_m < sensor[2] + pz <= rules.high_m):
            continue
        x, y = sensor[0] + cosine * px - sine * py, sensor[1] + sine * px + cosine * py
        row, column = math.floor(y / resolution_m) - iy0, math.floor(x / resolution_m) - ix0
        if not _trusted_around(trust_s, row, column):
            continue
        if count[row, column] == 0:
            met[size, 0], met[size, 1] = row, column
            size += 1
        count[row, column] += 1
        total[row, column, 0] += x
        total[row, column, 1] += y
    found = np.empty((size, 2), dtype=np.float32)
    kept = 0
    for k in range(size):
        row, column = met[k, 0], met[k, 1]
        if count[row, column] >= 2 and _has_neighbour(count, row, column):
            found[kept, 0] = total[row, column, 0] / count[row, column]
            found[kept, 1] = total[row, column, 1] / count[row, column]
            kept += 1
    return found[:kept].copy()


@njit
def _trusted_around(trust_s: NDArray[np.float32], row: int, column: int) -> bool:
    """Whether the cell and all eight around it are trusted; never at the border."""
    if not (0 < row < trust_s.shape[0] - 1 and 0 < column < trust_s.shape[1] - 1):
        return False
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if trust_s[r, c] <= 0.0:
                return False
    return True


@njit
def _has_neighbour(count: NDArray[np.int32], row: int, column: int) -> bool:
    """Whether one of the eight cells around has two points or more; the cell is not at the border."""
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if (r != row or c != column) and count[r, c] >= 2:
                return True
    return False

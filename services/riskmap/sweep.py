"""One sweep in polar form: points by bearing, and what each bearing sees at each distance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

BEARINGS = 1801
"""Bearing bins of a sweep: about twice as many as common sensors have azimuths, and prime, so that these do not all lie
on the borders of bins, where rounding would scatter the rings of one azimuth."""


class Sweep(NamedTuple):
    """A sweep around the sensor, in the axes of odom.

    sensor: (3,) its place in odom, m. bin_m: length of a range bin. points: (n, 3) from the sensor, ordered by
    bearing; distance: (n,) their horizontal range, m. start: (BEARINGS + 1,) of each bearing in them. Polar layers,
    (BEARINGS, bins): low, z in odom of the lowest point (inf: none), and low_distance, its horizontal range.
    """

    sensor: NDArray[np.float64]
    bin_m: float
    points: NDArray[np.float32]
    distance: NDArray[np.float32]
    start: NDArray[np.int64]
    low: NDArray[np.float32]
    low_distance: NDArray[np.float32]


def read_sweep(
    points_m: NDArray[np.float32], sensor_in_odom: NDArray[np.float64], bin_m: float, reach_m: float
) -> tuple[Sweep, int]:
    """The sweep of (n, 3) points in the sensor's frame, and how many of them were not finite (those are left out).

    sensor_in_odom: (4, 4). reach_m: points beyond it are left out.
    """
    bins = math.ceil(reach_m / bin_m)
    points, distance, start, bad = _by_bearing(points_m, sensor_in_odom, bins * bin_m)
    low = np.full((BEARINGS, bins), np.inf, dtype=np.float32)
    low_distance = np.zeros((BEARINGS, bins), dtype=np.float32)
    _lowest(points, distance, start, sensor_in_odom[2, 3], bin_m, low, low_distance)
    return Sweep(sensor_in_odom[:3, 3].copy(), bin_m, points, distance, start, low, low_distance), bad


@njit
def _by_bearing(
    points_m: NDArray[np.float32], sensor_in_odom: NDArray[np.float64], reach_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], int]:
    """Rotate the points into odom's axes and sort them by bearing (a counting sort: stable)."""
    n = points_m.shape[0]
    turned = np.empty((n, 3), dtype=np.float32)
    away = np.empty(n, dtype=np.float32)
    bearing = np.full(n, -1, dtype=np.int32)
    start = np.zeros(BEARINGS + 1, dtype=np.int64)
    m = sensor_in_odom
    bad = 0
    for i in range(n):
        px, py, pz = float(points_m[i, 0]), float(points_m[i, 1]), float(points_m[i, 2])
        if not (math.isfinite(px) and math.isfinite(py) and math.isfinite(pz)):
            bad += 1
            continue
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz
        distance = math.sqrt(x * x + y * y)
        if distance >= reach_m or distance < 1e-3:
            continue
        turned[i, 0], turned[i, 1] = x, y
        turned[i, 2] = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz
        away[i] = distance
        b = int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * BEARINGS) % BEARINGS
        bearing[i] = b
        start[b + 1] += 1
    for b in range(BEARINGS):
        start[b + 1] += start[b]
    place = start[:-1].copy()
    points = np.empty((start[BEARINGS], 3), dtype=np.float32)
    distances = np.empty(start[BEARINGS], dtype=np.float32)
    for i in range(n):
        if bearing[i] >= 0:
            k = place[bearing[i]]
            place[bearing[i]] += 1
            points[k, 0], points[k, 1], points[k, 2] = turned[i, 0], turned[i, 1], turned[i, 2]
            distances[k] = away[i]
    return points, distances, start, bad


@njit
def _lowest(
    points: NDArray[np.float32],
    distance: NDArray[np.float32],
    start: NDArray[np.int64],
    sensor_z_m: float,
    bin_m: float,
    low: NDArray[np.float32],
    low_distance: NDArray[np.float32],
) -> None:
    """The lowest point of each polar bin."""
    last = low.shape[1] - 1
    for b in range(BEARINGS):
        for i in range(start[b], start[b + 1]):
            k = min(int(distance[i] / bin_m), last)
            z = np.float32(sensor_z_m + points[i, 2])
            if z < low[b, k]:
                low[b, k] = z
                low_distance[b, k] = distance[i]

"""Planar laser scans as clouds: what a beam hits, and the level floor that it is taken to pass over."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

FLOOR_M = 10.0
"""Floor is put under a beam up to so far: the cloud's density falls with the distance."""
_FLOOR_STEP_M = 0.1
_BEFORE_HIT_M = 0.15
"""Floor ends so far before what the beam hits."""
_NEAREST_M = 0.3


def scan_cloud(
    ranges_m: NDArray[np.float64],
    angles: tuple[float, float],
    limits_m: tuple[float, float],
    height_m: float,
    dropped: Counter[str],
) -> NDArray[np.float32]:
    """Points (n, 3) in the laser's frame from one scan of a planar laser `height_m` above a level floor.

    ranges_m: (m,). angles: of the first beam, and from beam to beam, rad. limits_m: range_min, range_max of the
    scan. A reading that is no range is left out and counted in `dropped`. A planar laser sees no floor: it is
    assumed, level, under each beam and between neighbouring ones up to the shorter.
    """
    bearing = angles[0] + angles[1] * np.arange(len(ranges_m), dtype=np.float64)
    good = _good_ranges(ranges_m, limits_m, dropped)
    length: NDArray[np.float64] = np.where(good, ranges_m, 0.0).astype(np.float64)
    hits = np.column_stack([length * np.cos(bearing), length * np.sin(bearing), np.zeros(len(length))])[good]
    floor = _floor(bearing, length, angles[1])
    return np.vstack([hits, np.column_stack([floor, np.full(len(floor), -height_m)])]).astype(np.float32)


def _good_ranges(
    ranges_m: NDArray[np.float64], limits_m: tuple[float, float], dropped: Counter[str]
) -> NDArray[np.bool_]:
    not_a_number = np.isnan(ranges_m)
    too_near = ~not_a_number & (ranges_m < max(limits_m[0], 1e-3))
    too_far = ~not_a_number & (ranges_m >= limits_m[1])
    for reason, which in (
        ("ranges that are NaN", not_a_number),
        ("ranges below range_min", too_near),
        ("ranges from range_max", too_far),
    ):
        if which.any():
            dropped[reason] += int(which.sum())
    return ~(not_a_number | too_near | too_far)


def _floor(
    bearing: NDArray[np.float64], length_m: NDArray[np.float64], increment: float
) -> NDArray[np.float64]:
    """(k, 2) places of the floor under the beams and between them, where neighbours have ranges."""
    between = max(1, math.ceil(abs(increment) * FLOOR_M / _FLOOR_STEP_M))
    reach, at = [length_m], [bearing]
    for part in range(1, between):
        reach.append(np.minimum(length_m[:-1], length_m[1:]))
        at.append(bearing[:-1] + increment * part / between)
    far = np.minimum(np.concatenate(reach) - _BEFORE_HIT_M, FLOOR_M)
    steps = np.arange(_NEAREST_M, FLOOR_M, _FLOOR_STEP_M)
    beam, step = np.nonzero(steps[None, :] <= far[:, None])
    angle = np.concatenate(at)[beam]
    return np.column_stack([steps[step] * np.cos(angle), steps[step] * np.sin(angle)])

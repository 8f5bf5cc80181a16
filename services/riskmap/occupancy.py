"""Evidence of obstacles in a rolling window: what sweeps hit and what they pass (flat ground)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import overlap, window_around
from planning.kernels import njit

_BEARINGS = 900
"""Bearing bins of a sweep; the rays of all rings of one bearing are swept together."""

_PIERCED_M = 0.02
"""A ray speaks against a surface that it passes at this distance or nearer, m."""

_MOST_SKIMMED_M = 1.5
"""Longest stretch before its end over which a ray clears no surface, m: more would leave ghosts before walls."""


class OccupancyWindow:
    """Log-odds of each cell being an obstacle, and where in the cell it was hit.

    log_odds: (h, w). hit_weight, hit_x, hit_y: (h, w) sums for the mean hit as an offset from the cell's centre, m.
    trust_s: (h, w), see `moving.update_trust`. seen_at_m: (h, w), the distance driven when a cell was last seen, m.
    """

    def __init__(self, size_m: float, resolution_m: float) -> None:
        self._size_m = size_m
        self.spec = window_around(0.0, 0.0, size_m, resolution_m)
        self._allocate()

    def _allocate(self) -> None:
        self.log_odds = np.zeros(self.spec.shape, dtype=np.float32)
        self.hit_weight = np.zeros(self.spec.shape, dtype=np.float32)
        self.hit_x = np.zeros(self.spec.shape, dtype=np.float32)
        self.hit_y = np.zeros(self.spec.shape, dtype=np.float32)
        self.trust_s = np.zeros(self.spec.shape, dtype=np.float32)
        self.seen_at_m = np.zeros(self.spec.shape, dtype=np.float32)

    @property
    def layers(self) -> tuple[NDArray[np.float32], ...]:
        """All layers, for whoever keeps or moves them."""
        return self.log_odds, self.hit_weight, self.hit_x, self.hit_y, self.trust_s, self.seen_at_m

    def roll_to(self, x_m: float, y_m: float) -> None:
        """Centre the window on a point; what leaves it is forgotten, what stays is not resampled."""
        wanted = window_around(x_m, y_m, self._size_m, self.spec.resolution_m)
        if wanted == self.spec:
            return
        old_spec, old = self.spec, self.layers
        self.spec = wanted
        self._allocate()
        common = overlap(old_spec, wanted)
        if common is not None:
            for before, now in zip(old, self.layers, strict=True):
                now[common[1]] = before[common[0]]

    def forget(self, seen_before_m: float) -> None:
        """Forget what was last seen before so much was driven."""
        old = (self.seen_at_m < seen_before_m) & (self.log_odds != 0.0)
        if old.any():
            for layer in (self.log_odds, self.hit_weight, self.trust_s):
                layer[old] = 0.0


@njit
def integrate_sweep(
    points_m: NDArray[np.float32],
    sensor: NDArray[np.float64],
    heights_m: NDArray[np.float64],
    evidence: NDArray[np.float64],
    resolution_m: float,
    ix0: int,
    iy0: int,
    log_odds: NDArray[np.float32],
    hit_weight: NDArray[np.float32],
    hit_x: NDArray[np.float32],
    hit_y: NDArray[np.float32],
    hit_now: NDArray[np.uint8],
) -> int:
    """Add one sweep to the evidence. Returns the number of points that were not finite (they are skipped).

    points_m: (n, 3) in the sensor's frame. sensor: x, y, z, yaw in odom. heights_m: ground z, ground tolerance,
    robot height, self radius. evidence: hit, pass, clamp (log-odds, all positive). hit_now: (h, w) zeros; 1 and 2
    afterwards in the cells that the sweep hit or passed.
    """
    free_range, free_angle = np.zeros(_BEARINGS, dtype=np.float64), np.zeros(_BEARINGS, dtype=np.float64)
    cosine, sine = math.cos(sensor[3]), math.sin(sensor[3])
    bad = 0
    for i in range(points_m.shape[0]):
        px, py, pz = float(points_m[i, 0]), float(points_m[i, 1]), float(points_m[i, 2])
        if not (math.isfinite(px) and math.isfinite(py) and math.isfinite(pz)):
            bad += 1
            continue
        distance = math.sqrt(px * px + py * py)
        if distance < heights_m[3]:
            continue
        dx, dy = cosine * px - sine * py, sine * px + cosine * py
        above = sensor[2] + pz - heights_m[0]
        reach = distance
        if above > heights_m[2]:
            # A sensor above the robot sees such points over its head: nothing is known of the ground below.
            room = heights_m[2] + heights_m[0] - sensor[2]
            reach = distance * room / pz if room > 0.0 else 0.0
        elif above > heights_m[1]:
            _add_hit(sensor[0] + dx, sensor[1] + dy, evidence, resolution_m, ix0, iy0, log_odds, hit_weight, hit_x, hit_y, hit_now)  # fmt: skip  # noqa: E501
        angle = math.atan2(dy, dx)
        bearing = int((angle / (2.0 * math.pi) + 1.0) * _BEARINGS) % _BEARINGS
        if reach > free_range[bearing]:
            free_range[bearing], free_angle[bearing] = reach, angle
    _clear_passed(sensor, free_range, free_angle, evidence, resolution_m, ix0, iy0, log_odds, hit_weight, hit_x, hit_y, hit_now)  # fmt: skip  # noqa: E501
    return bad


@njit
def _add_hit(
    x: float,
    y: float,
    evidence: NDArray[np.float64],
    resolution_m: float,
    ix0: int,
    iy0: int,
    log_odds: NDArray[np.float32],
    hit_weight: NDArray[np.float32],
    hit_x: NDArray[np.float32],
    hit_y: NDArray[np.float32],
    hit_now: NDArray[np.uint8],
) -> None:
    """One point on an obstacle: evidence once a sweep, the mean of the hits over the last few dozens."""
    column = math.floor(x / resolution_m) - ix0
    row = math.floor(y / resolution_m) - iy0
    if not (0 <= row < log_odds.shape[0] and 0 <= column < log_odds.shape[1]):
        return
    if hit_now[row, column] == 0:
        hit_now[row, column] = 1
        log_odds[row, column] = min(log_odds[row, column] + evidence[0], evidence[2])
    weight = min(hit_weight[row, column] + 1.0, 64.0)
    hit_weight[row, column] = weight
    hit_x[row, column] += (x - (ix0 + column + 0.5) * resolution_m - hit_x[row, column]) / weight
    hit_y[row, column] += (y - (iy0 + row + 0.5) * resolution_m - hit_y[row, column]) / weight


@njit
def _clear_passed(
    sensor: NDArray[np.float64],
    free_range: NDArray[np.float64],
    free_angle: NDArray[np.float64],
    evidence: NDArray[np.float64],
    resolution_m: float,
    ix0: int,
    iy0: int,
    log_odds: NDArray[np.float32],
    hit_weight: NDArray[np.float32],
    hit_x: NDArray[np.float32],
    hit_y: NDArray[np.float32],
    hit_now: NDArray[np.uint8],
) -> None:
    """Cells that rays went through are evidence of nothing there, once a sweep, unless the sweep hit them too.

    Between two bearings the shorter of both counts too, so that far away no cell is missed between the rays. A cell
    that was hit before is cleared only by a ray through its mean hit: a ray that grazes a wall runs through many of
    the wall's cells in front of its surface, and would wipe the wall out behind the robot. Nor does it clear the
    stretch right before its end, where it comes as near as that to the surface on which it ends.
    """
    height, width = log_odds.shape
    passed = hit_now
    x0, y0 = sensor[0] / resolution_m - ix0, sensor[1] / resolution_m - iy0
    count = free_range.shape[0]
    for half in range(2 * count):
        reach, angle = free_range[half // 2], free_angle[half // 2]
        if half % 2 == 1:
            after = (half // 2 + 1) % count
            reach = min(reach, free_range[after])
            angle += 0.5 * ((free_angle[after] - angle + math.pi) % (2.0 * math.pi) - math.pi)
        length = reach / resolution_m - 0.5
        if length <= 0.0:
            continue
        skims = length - _skimmed(free_range, half // 2) / resolution_m
        dx, dy = math.cos(angle), math.sin(angle)
        column, row = math.floor(x0), math.floor(y0)
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        next_x = ((column + (1 if dx > 0 else 0)) - x0) / dx if dx != 0.0 else math.inf
        next_y = ((row + (1 if dy > 0 else 0)) - y0) / dy if dy != 0.0 else math.inf
        travelled = 0.0
        while travelled < length and 0 <= row < height and 0 <= column < width:
            off_x = column + 0.5 + hit_x[row, column] / resolution_m - x0
            off_y = row + 0.5 + hit_y[row, column] / resolution_m - y0
            pierced = hit_weight[row, column] == 0.0 or (
                abs(off_x * dy - off_y * dx) * resolution_m <= _PIERCED_M and off_x * dx + off_y * dy < skims
            )
            if passed[row, column] == 0 and pierced:
                passed[row, column] = 2
                log_odds[row, column] = max(log_odds[row, column] - evidence[1], -evidence[2])
                if log_odds[row, column] < 0.0:
                    hit_weight[row, column] = 0.0
            if next_x < next_y:
                travelled = next_x
                next_x += abs(1.0 / dx)
                column += step_x
            else:
                travelled = next_y
                next_y += abs(1.0 / dy)
                row += step_y


@njit
def _skimmed(free_range: NDArray[np.float64], bearing: int) -> float:
    """How far before its end a ray may be within `_PIERCED_M` of the surface it ends on, by its neighbours' ends, m.

    Their ranges tell the angle at which it meets the surface: steep (two alike) or grazing (far apart).
    """
    count, reach = free_range.shape[0], free_range[bearing]
    change = 0.0
    for beside in (bearing - 1, (bearing + 1) % count):
        if free_range[beside] > 0.0:
            change = max(change, abs(free_range[beside] - reach))
    slope = change / max(reach * 2.0 * math.pi / count, 1e-6)
    return min(2.0 * _PIERCED_M * slope, _MOST_SKIMMED_M)

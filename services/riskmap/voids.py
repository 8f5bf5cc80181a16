"""Ground that should be there and is not: where nothing comes back from a direction in which there is ground (flat
ground).

A drop or the edge of a platform returns no beam. Where a sector of the sweep that is known to show ground is empty, the
first unknown cell on the known ground in that direction is evidence of an obstacle: the robot keeps off.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

SECTORS = 180
"""Of a sweep: each holds several azimuths, so that rays which are lost by chance empty none."""
_LEAST_RETURNS = 4
"""Points on the ground in one sweep that show that the sensor sees the ground in a sector."""


@njit
def read_sectors(
    points_m: NDArray[np.float32], low_z_m: float, high_z_m: float, shows_ground: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which sectors (SECTORS,) of the sensor should have shown ground and are empty in this sweep.

    points_m: (n, 3) in the sensor's frame, the robot's own body included. low_z_m, high_z_m: heights in that frame
    between which a point lies on the ground. shows_ground: (SECTORS,) what the sensor has shown so far; changed.
    """
    returns = np.zeros(SECTORS, dtype=np.int64)
    on_ground = np.zeros(SECTORS, dtype=np.int64)
    for i in range(points_m.shape[0]):
        x, y, z = float(points_m[i, 0]), float(points_m[i, 1]), float(points_m[i, 2])
        if not math.isfinite(x + y + z):
            continue
        sector = int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * SECTORS) % SECTORS
        returns[sector] += 1
        if low_z_m <= z <= high_z_m:
            on_ground[sector] += 1
    shows_ground |= on_ground >= _LEAST_RETURNS
    return shows_ground & (returns == 0)


@njit
def mark_voids(
    empty: NDArray[np.bool_],
    sensor: NDArray[np.float64],
    near_m: float,
    far_m: float,
    hit_log_odds: float,
    clamp_log_odds: float,
    free_log_odds: float,
    resolution_m: float,
    ix0: int,
    iy0: int,
    log_odds: NDArray[np.float32],
    hit_weight: NDArray[np.float32],
    hit_x: NDArray[np.float32],
    hit_y: NDArray[np.float32],
) -> None:
    """Evidence of an obstacle in the first unknown cell of each empty sector, where free cells lead up to it.

    sensor: x, y, z, yaw in odom. near_m, far_m: nearer and farther cells are left alone; near the robot nothing may
    have been seen yet.
    """
    for sector in range(SECTORS):
        if not empty[sector]:
            continue
        angle = sensor[3] + 2.0 * math.pi * (sector + 0.5) / SECTORS
        dx, dy = math.cos(angle), math.sin(angle)
        for k in range(1, math.floor(2.0 * far_m / resolution_m) + 1):
            away = 0.5 * k * resolution_m
            column = math.floor((sensor[0] + away * dx) / resolution_m) - ix0
            row = math.floor((sensor[1] + away * dy) / resolution_m) - iy0
            if not (0 <= row < log_odds.shape[0] and 0 <= column < log_odds.shape[1]):
                break
            if log_odds[row, column] < -free_log_odds:
                continue
            if away >= near_m and log_odds[row, column] <= 0.0:
                log_odds[row, column] = min(log_odds[row, column] + hit_log_odds, clamp_log_odds)
                hit_weight[row, column], hit_x[row, column], hit_y[row, column] = 1.0, 0.0, 0.0
            break

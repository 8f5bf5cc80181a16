"""Sweeps over height fields by marching rays, for the tests of the terrain model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.sensing import PointCloud
from services.riskmap.extrinsics import transform

Heights = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Height of the ground at points (x, y), m: any shapes that are alike."""

MOUNT = Pose(z_m=0.8)
RINGS_DEG = tuple(float(v) for v in np.linspace(-15.0, 15.0, 16))
RANGE_M = 20.0


def flat(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level ground."""
    return np.zeros(np.broadcast(x, y).shape)


def plane(slope_x: float, slope_y: float = 0.0) -> Heights:
    """A plane through the origin."""
    return lambda x, y: slope_x * x + slope_y * y


def ledge(at_x_m: float, rise_m: float) -> Heights:
    """Level ground that rises (or falls) by a ledge at x."""
    return lambda x, y: np.where(x > at_x_m, rise_m, 0.0) + 0.0 * y


def stand_on(heights: Heights, x_m: float, y_m: float, yaw_rad: float = 0.0) -> Pose:
    """The robot's pose on the ground: its body follows the slope between points 0.3 m before, behind and beside it."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)

    def at(forward: float, left: float) -> float:
        return float(heights(np.array(x_m + c * forward - s * left), np.array(y_m + s * forward + c * left)))

    pitch = -math.atan2(at(0.3, 0.0) - at(-0.3, 0.0), 0.6)
    roll = math.atan2(at(0.0, 0.3) - at(0.0, -0.3), 0.6)
    return Pose(x_m=x_m, y_m=y_m, z_m=at(0.0, 0.0), yaw_rad=yaw_rad, pitch_rad=pitch, roll_rad=roll)


def scan(
    heights: Heights,
    base: Pose,
    bearings: int = 600,
    rings_deg: Sequence[float] = RINGS_DEG,
    noise_m: float = 0.0,
    rng: np.random.Generator | None = None,
    ceiling_m: float = math.inf,
) -> NDArray[np.float32]:
    """Points (n, 3) in the sensor's frame: where each ray first goes below the ground or above the ceiling."""
    pose = sensor_pose(base)
    matrix = transform(pose)
    azimuth, elevation = np.meshgrid(
        2.0 * math.pi * (np.arange(bearings) + 0.5) / bearings,
        np.radians(np.asarray(rings_deg)),
        indexing="ij",
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    turned = rays @ matrix[:3, :3].T
    alive, slant = np.arange(len(rays)), np.full(len(rays), np.inf)

    def over(index: NDArray[np.int64], s: NDArray[np.float64]) -> NDArray[np.float64]:
        p = matrix[:3, 3] + turned[index] * s[:, None]
        return np.minimum(p[:, 2] - heights(p[:, 0], p[:, 1]), ceiling_m - p[:, 2])

    pace = 0.1
    for s in np.arange(pace, RANGE_M + pace, pace):
        below = over(alive, np.full(len(alive), s)) < 0.0
        hit = alive[below]
        low, high = np.full(len(hit), s - pace), np.full(len(hit), s)
        for _ in range(8):
            middle = 0.5 * (low + high)
            inside = over(hit, middle) < 0.0
            low, high = np.where(inside, low, middle), np.where(inside, middle, high)
        slant[hit] = high
        alive = alive[~below]
    seen = slant <= RANGE_M
    reach = slant[seen]
    if rng is not None:
        reach = reach + rng.normal(0.0, noise_m, len(reach))
    points: NDArray[np.float32] = (rays[seen] * reach[:, None]).astype(np.float32)
    return points


def sensor_pose(base: Pose) -> Pose:
    """The sensor's pose in odom on a robot at `base`: MOUNT, turned with the body."""
    up = transform(base)[:3, :3] @ np.array([MOUNT.x_m, MOUNT.y_m, MOUNT.z_m])
    return base.model_copy(update={"x_m": base.x_m + up[0], "y_m": base.y_m + up[1], "z_m": base.z_m + up[2]})


def cloud_at(
    heights: Heights,
    base: Pose,
    stamp_ns: int = 1,
    points_m: NDArray[np.float32] | None = None,
    **how: object,
) -> PointCloud:
    """One sweep as a message."""
    points = scan(heights, base, **how) if points_m is None else points_m  # type: ignore[arg-type]
    return PointCloud(
        stamp_ns=stamp_ns,
        sensor_in_odom=sensor_pose(base),
        sensor_in_base=MOUNT,
        range_m=RANGE_M,
        points_m=points,
    )


def cell(spec: GridSpec, x_m: float, y_m: float) -> tuple[int, int]:
    """(row, column) of a point."""
    return spec.cell_of(x_m, y_m)

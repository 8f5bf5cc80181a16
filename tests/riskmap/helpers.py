"""Synthetic sweeps in worlds of straight walls, and the inputs of a stage, for the tests of riskmap and irm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Inputs, Received, Topic
from schemas.sensing import Odometry, PointCloud

Wall = tuple[float, float, float, float]
"""A wall from (x0, y0) to (x1, y1), m, seen from both sides."""

SENSOR_Z_M = 0.8
WALL_TOP_M = 2.5


def rectangle(x_low: float, y_low: float, x_high: float, y_high: float) -> list[Wall]:
    """The four sides of a rectangle."""
    return [
        (x_low, y_low, x_high, y_low),
        (x_high, y_low, x_high, y_high),
        (x_high, y_high, x_low, y_high),
        (x_low, y_high, x_low, y_low),
    ]


def horizontal_ranges(
    walls: Sequence[Wall], x_m: float, y_m: float, angles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance to the first wall along each bearing, (n,), inf where there is none."""
    dx, dy = np.cos(angles), np.sin(angles)
    nearest = np.full(angles.shape, np.inf)
    for x0, y0, x1, y1 in walls:
        ex, ey = x1 - x0, y1 - y0
        cross = dx * ey - dy * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((x0 - x_m) * ey - (y0 - y_m) * ex) / cross
            share = ((x0 - x_m) * dy - (y0 - y_m) * dx) / cross
        hit = (np.abs(cross) > 1e-12) & (along > 1e-9) & (share >= 0.0) & (share <= 1.0)
        nearest = np.where(hit, np.minimum(nearest, along), nearest)
    return nearest


def sweep(
    walls: Sequence[Wall],
    pose: Pose,
    bearings: int = 900,
    elevations_deg: Sequence[float] = (-15.0, -5.0, 0.0, 5.0, 15.0),
    range_m: float = 20.0,
) -> NDArray[np.float32]:
    """What a LiDAR at `pose` (z over flat ground) returns, (n, 3) in its own frame; nothing where nothing is hit."""
    azimuths = 2.0 * math.pi * np.arange(bearings) / bearings
    flat = horizontal_ranges(walls, pose.x_m, pose.y_m, azimuths + pose.yaw_rad)
    rings = []
    for elevation in np.radians(np.asarray(elevations_deg)):
        slope = math.tan(elevation)
        wall = np.where(pose.z_m + flat * slope <= WALL_TOP_M, flat, np.inf)
        ground = -pose.z_m / slope if slope < 0.0 else math.inf
        reach = np.minimum(wall, ground)
        seen = reach / math.cos(elevation) <= range_m
        r = reach[seen]
        rings.append(np.stack([r * np.cos(azimuths[seen]), r * np.sin(azimuths[seen]), r * slope], axis=1))
    return np.concatenate(rings).astype(np.float32)


def cloud(walls: Sequence[Wall], x_m: float, y_m: float, stamp_ns: int, yaw_rad: float = 0.0) -> PointCloud:
    """One sweep as a message."""
    pose = Pose(x_m=x_m, y_m=y_m, z_m=SENSOR_Z_M, yaw_rad=yaw_rad)
    return PointCloud(stamp_ns=stamp_ns, sensor_in_odom=pose, range_m=20.0, points_m=sweep(walls, pose))


def odometry(x_m: float, y_m: float, yaw_rad: float = 0.0, stamp_ns: int = 0) -> Odometry:
    """The robot at rest; odom and map are the same."""
    return Odometry(
        stamp_ns=stamp_ns,
        pose=Pose(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad),
        map_to_odom=Pose(),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=np.zeros((3, 3)),
    )


Feed = tuple[Topic[Message], Message]


def received(
    message: Message, age_s: float = 0.0, fresh: bool = True, stale: bool = False
) -> Received[Message]:
    """A message as a driver hands it to a stage."""
    return Received(message, "sim", 1, 1, message.stamp_ns, round(age_s * SECOND_NS), fresh, stale)


def inputs(*feeds: Feed, age_s: float = 0.0, fresh: bool = True, stale: bool = False) -> Inputs:
    """Inputs of one step from (topic, message) pairs, all of the same age and freshness."""
    messages: dict[str, list[Received[Message]]] = {}
    for topic, message in feeds:
        messages.setdefault(topic.name, []).append(received(message, age_s, fresh, stale))
    return Inputs(messages)


def merged(*parts: Inputs) -> Inputs:
    """Inputs of several kinds in one step."""
    messages: dict[str, list[Received[Message]]] = {}
    for part in parts:
        for name, found in part.messages.items():
            messages.setdefault(name, []).extend(found)
    return Inputs(messages)

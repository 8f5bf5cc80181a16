"""Planar rigid transforms between frames (REP-105)."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol


class Planar(NamedTuple):
    """Pose of a frame in another: x, y in metres, yaw in radians."""

    x_m: float
    y_m: float
    yaw_rad: float

    def apply(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A point of this frame, expressed in the other one."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return self.x_m + c * x_m - s * y_m, self.y_m + s * x_m + c * y_m

    def compose(self, inner: Planar) -> Planar:
        """The pose, in the other frame, of a pose given in this one."""
        x, y = self.apply(inner.x_m, inner.y_m)
        return Planar(x, y, wrap_angle(self.yaw_rad + inner.yaw_rad))

    def inverse(self) -> Planar:
        """The other frame's pose in this one."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Planar(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, -self.yaw_rad)

    @property
    def is_identity(self) -> bool:
        """Whether applying it changes nothing."""
        return self == Planar(0.0, 0.0, 0.0)


class Posed(Protocol):
    """What lies in the plane of a frame: a pose of a message, for one. m, rad."""

    @property
    def x_m(self) -> float: ...
    @property
    def y_m(self) -> float: ...
    @property
    def yaw_rad(self) -> float: ...


def planar(pose: Posed) -> Planar:
    """A pose, or the pose of a frame, without height, roll and pitch."""
    return Planar(pose.x_m, pose.y_m, pose.yaw_rad)


def in_map(map_to_odom: Posed, pose: Posed) -> Planar:
    """A pose of `odom` in `map`: map_to_odom after the pose."""
    return planar(map_to_odom).compose(planar(pose))


def wrap_angle(angle_rad: float) -> float:
    """The angle in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped

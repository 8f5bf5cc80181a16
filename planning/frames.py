"""Planar rigid transforms between frames (REP-105)."""

from __future__ import annotations

import math
from typing import NamedTuple


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


def wrap_angle(angle_rad: float) -> float:
    """The angle in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped

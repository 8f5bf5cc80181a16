"""What the operator's polygons mean for planners: ground that is shut, and ground that counts more.

Polygons are given in `map` or in `odom` and are asked about in either; `frame` is always the pose of `odom` in `map`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.frames import Planar
from planning.grid import GridSpec
from planning.polygons import Points, Rings, cells_inside, cells_on_border, crosses, distance_m, inside

PRIORITY_REACH_M = 10.0
"""So far from a priority polygon what leads towards it counts more by a third of what it does inside."""
_STEP_M, _STEP_RAD = 0.01, 0.0005


class Polygon(NamedTuple):
    """kind: geofence, no_go or priority. in_odom: of `odom`, else of `map`. weight: of a priority."""

    kind: str
    in_odom: bool
    weight: float
    rings: tuple[Points, ...]


class Shut(NamedTuple):
    """Over a window: cells where the robot may not be, (h, w), and the distance to them, m (inf: there are none)."""

    mask: NDArray[np.bool_]
    distance_m: NDArray[np.float32]


def polygon(kind: str, frame: str, weight: float, rings: Sequence[Sequence[tuple[float, float]]]) -> Polygon:
    """From plain values."""
    arrays = tuple(np.asarray(ring, dtype=np.float64).reshape(-1, 2) for ring in rings)
    return Polygon(kind, frame == "odom", weight, arrays)


def stepped(frame: Planar) -> Planar:
    """The frame rounded to 1 cm: what hangs on it is not computed anew for the noise of SLAM."""
    return Planar(
        round(frame.x_m / _STEP_M) * _STEP_M,
        round(frame.y_m / _STEP_M) * _STEP_M,
        round(frame.yaw_rad / _STEP_RAD) * _STEP_RAD,
    )


@dataclass(slots=True)
class Placed:
    """The polygons in one frame."""

    geofence: list[Rings] = field(default_factory=list)
    no_go: list[Rings] = field(default_factory=list)
    priority: list[tuple[float, Rings]] = field(default_factory=list)

    @property
    def shuts(self) -> bool:
        """Whether there is ground where the robot may not be."""
        return bool(self.geofence or self.no_go)

    def forbids(self, x_m: float, y_m: float) -> bool:
        """Whether the robot may not be at a point."""
        return bool(self.forbidden(np.array([[x_m, y_m]]))[0])

    def forbidden(self, points: Points) -> NDArray[np.bool_]:
        """Of points (n, 2), (n,)."""
        out = np.zeros(len(points), np.bool_)
        if self.geofence:
            out |= ~np.any([inside(rings, points) for rings in self.geofence], axis=0)
        for rings in self.no_go:
            out |= inside(rings, points)
        return out

    def forbids_lines(self, begin: Points, end: Points) -> NDArray[np.bool_]:
        """Which straight lines (n, 2) to (n, 2) lead through ground that is shut, (n,)."""
        out = self.forbidden(begin) | self.forbidden(end)
        for rings in self.no_go:
            out |= crosses(rings, begin, end)
        if len(self.geofence) == 1:
            out |= crosses(self.geofence[0], begin, end)
        elif self.geofence:  # of several the inner borders are none: look along the line
            for share in np.linspace(0.0, 1.0, 41)[1:-1].tolist():
                out |= self.forbidden(begin + share * (end - begin))
        return out

    def border_m(self, x_m: float, y_m: float) -> float:
        """Distance to the nearest border of what is shut, m; inf without any."""
        return min((distance_m(rings, x_m, y_m) for rings in (*self.no_go, *self.geofence)), default=math.inf)

    def over(self, spec: GridSpec) -> Shut | None:
        """What is shut in a window; None when nothing is."""
        if not self.shuts:
            return None
        mask = np.zeros(spec.shape, np.bool_)
        if self.geofence:
            allowed = [cells_inside(spec, rings) for rings in self.geofence]
            mask |= ~np.any(allowed, axis=0)
            if len(self.geofence) == 1:
                mask |= cells_on_border(spec, self.geofence[0])
        for rings in self.no_go:
            mask |= cells_inside(spec, rings) | cells_on_border(spec, rings)
        if not mask.any():
            return None
        away = (ndimage.distance_transform_edt(~mask) - 0.5) * spec.resolution_m
        return Shut(mask, np.maximum(away, 0.0).astype(np.float32))

    def weights(self, spec: GridSpec) -> NDArray[np.float32] | None:
        """How many times each cell of a window counts, (h, w); None when all count once."""
        out: NDArray[np.float32] | None = None
        for weight, rings in self.priority:
            mask = cells_inside(spec, rings)
            if mask.any():
                out = np.ones(spec.shape, np.float32) if out is None else out
                out[mask] = np.maximum(out[mask], np.float32(weight))
        return out

    def boost(self, x_m: float, y_m: float) -> float:
        """How many times a frontier at a point counts: what is near to a priority polygon leads towards it."""
        best = 1.0
        for weight, rings in self.priority:
            away_m = 0.0
            if not inside(rings, np.array([[x_m, y_m]]))[0]:
                away_m = distance_m(rings, x_m, y_m)
            best = max(best, 1.0 + (weight - 1.0) * math.exp(-away_m / PRIORITY_REACH_M))
        return best


def place(polygons: Sequence[Polygon], frame: Planar, in_odom: bool) -> Placed:
    """The polygons as they lie in `odom` (in_odom) or in `map`."""
    to_odom, placed = frame.inverse(), Placed()
    for one in polygons:
        motion = None if one.in_odom == in_odom else to_odom if in_odom else frame
        rings = one.rings if motion is None else tuple(_moved(ring, motion) for ring in one.rings)
        if one.kind == "geofence":
            placed.geofence.append(rings)
        elif one.kind == "no_go":
            placed.no_go.append(rings)
        else:
            placed.priority.append((one.weight, rings))
    return placed


def _moved(ring: Points, motion: Planar) -> Points:
    c, s = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
    turn = np.array([[c, s], [-s, c]])
    out: Points = ring @ turn + np.array([motion.x_m, motion.y_m])
    return out

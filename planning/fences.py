"""What the operator's polygons mean for planners: ground that is shut, and ground that counts more.

Polygons are given in `map` or in `odom` and are asked about in either; `frame` is always the pose of `odom` in `map`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.frames import Planar
from planning.grid import GridSpec
from planning.polygons import Points, Rings, cells_inside, cells_on_border, crosses, distance_m, inside

PRIORITY_REACH_M = 10.0
"""So far from a priority polygon what leads towards it counts more by a third of what it does inside."""
_STEP_M, _STEP_RAD = 0.01, 0.0005
_SAME = Planar(0.0, 0.0, 0.0)


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


class DrawnRing(Protocol):
    """A ring as a message holds it."""

    @property
    def points(self) -> list[tuple[float, float]]: ...


class Drawn(Protocol):
    """A polygon as a message holds it (`schemas.fences.Fence`)."""

    @property
    def kind(self) -> str: ...
    @property
    def frame(self) -> str: ...
    @property
    def weight(self) -> float: ...
    @property
    def rings(self) -> Sequence[DrawnRing]: ...


class FenceView:
    """The fences as a planner has heard of them, asked about window by window.

    version: of the fences held, -1 before any was heard of.
    """

    def __init__(self) -> None:
        self.version = -1
        self._polygons: tuple[Polygon, ...] = ()
        self._shut: tuple[GridSpec, Planar, Shut | None] | None = None
        self._placed: dict[tuple[Planar, bool], Placed] = {}

    def update(self, version: int, fences: Sequence[Drawn]) -> bool:
        """Take in what was told. Returns whether it is another version."""
        if version == self.version:
            return False
        self.version = version
        drawn = [(f.kind, f.frame, f.weight, [ring.points for ring in f.rings]) for f in fences]
        self._polygons = tuple(polygon(*one) for one in drawn)
        self._forget()
        return True

    def _forget(self) -> None:
        self._shut = None
        self._placed = {}

    @property
    def is_empty(self) -> bool:
        """Whether there is no polygon at all."""
        return not self._polygons

    def placed(self, frame: Planar, in_odom: bool) -> Placed:
        """The polygons in `odom` or `map`; frame: the pose of `odom` in `map`, taken to the nearest centimetre."""
        native = all(p.in_odom == in_odom for p in self._polygons)
        near = _SAME if native else stepped(frame)
        if (near, in_odom) not in self._placed:
            self._placed = {k: v for k, v in self._placed.items() if k[1] != in_odom}
            self._placed[near, in_odom] = place(self._polygons, near, in_odom)
        return self._placed[near, in_odom]

    def shut(self, spec: GridSpec, frame: Planar) -> Shut | None:
        """What is shut in a window in `odom`; None: nothing."""
        if self.is_empty:
            return None
        near = stepped(frame)
        if self._shut is None or self._shut[:2] != (spec, near):
            self._shut = (spec, near, self.placed(frame, True).over(spec))
        return self._shut[2]

    def weights(self, spec: GridSpec, frame: Planar) -> NDArray[np.float32] | None:
        """How many times each cell of a window in `odom` counts; None: once each."""
        return None if self.is_empty else self.placed(frame, True).weights(spec)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        polygons = [
            [p.kind, p.in_odom, p.weight, [ring.tolist() for ring in p.rings]] for p in self._polygons
        ]
        return {"version": self.version, "polygons": polygons}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.version = state["version"]
        self._polygons = tuple(
            polygon(kind, "odom" if in_odom else "map", weight, rings)
            for kind, in_odom, weight, rings in state["polygons"]
        )
        self._forget()

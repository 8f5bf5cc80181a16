"""The operator's polygons: the mission keeps them, numbers them, and is the only one that changes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planning.frames import Planar
from planning.polygons import PolygonError, check_rings, inside
from schemas.base import Pose
from schemas.contract import Stamp
from schemas.fences import MAX_FENCES, MAX_VERTICES, Fence, FenceFrame, FenceKind, Fences
from services.mission.machine import Outcome

_MOST_VERTICES = 20_000
"""Of all polygons together, so that every reader can take them."""


_SAME = Planar(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """Where the robot and its home are, (x, y) in `map`, and the pose of `odom` in `map`; None: not known yet."""

    robot: tuple[float, float] | None = None
    home: Pose | None = None
    frame: Planar = _SAME


@dataclass(slots=True)
class FenceBook:
    """The polygons by id, in the order in which they were drawn. version: grows with every change."""

    version: int = 0
    given: int = 0
    fences: dict[str, Fence] = field(default_factory=dict)

    def add(self, new: list[Fence], where: Whereabouts) -> tuple[Outcome, list[str]]:
        """Add polygons, all or none of them. Returns what became of it and their ids."""
        if not new:
            return Outcome(False, "fences: there is no polygon in the command"), []
        for index, fence in enumerate(new):
            try:
                check_rings([ring.points for ring in fence.rings], MAX_VERTICES)
            except PolygonError as error:
                return Outcome(False, f"fences[{index}].rings[{error.ring}]: {error.wrong}; {error.mend}"), []
        kept = dict(self.fences)
        if any(fence.kind == FenceKind.GEOFENCE for fence in new):
            kept = {k: f for k, f in kept.items() if f.kind != FenceKind.GEOFENCE}
        given, ids = self.given, []
        for fence in new:
            name = fence.fence_id
            while not name or (not fence.fence_id and name in kept):
                given += 1
                name = f"{fence.kind.value}-{given}"
            kept[name] = fence.model_copy(update={"fence_id": name})
            ids.append(name)
        wrong = _too_much(kept) or _shuts_in(kept, where)
        if wrong:
            return Outcome(False, wrong), []
        self.fences, self.given, self.version = kept, given, self.version + 1
        return Outcome(True, _told(new, ids) + _shuts_home(kept, where)), ids

    def remove(self, ids: list[str]) -> tuple[Outcome, list[str]]:
        """Take polygons away; none given: all."""
        unknown = [name for name in ids if name not in self.fences]
        if unknown:
            there = ", ".join(self.fences) or "none"
            return Outcome(False, f"fence_ids: no fence {unknown[0]!r}; there are: {there}"), []
        gone = list(ids) or list(self.fences)
        if not gone:
            return Outcome(True, "there was no fence"), []
        self.fences = {k: f for k, f in self.fences.items() if k not in gone}
        self.version += 1
        return Outcome(True, f"removed {', '.join(dict.fromkeys(gone))}"), list(dict.fromkeys(gone))

    def message(self, now: Stamp) -> Fences:
        """What everybody is told."""
        return Fences(stamp_ns=now, version=self.version, fences=list(self.fences.values()))

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        fences = [fence.model_dump(mode="json") for fence in self.fences.values()]
        return {"version": self.version, "given": self.given, "fences": fences}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.version, self.given = state["version"], state["given"]
        fences = [Fence.model_validate(values) for values in state["fences"]]
        self.fences = {fence.fence_id: fence for fence in fences}


def _too_much(fences: dict[str, Fence]) -> str:
    if len(fences) > MAX_FENCES:
        return f"fences: there would be {len(fences)}, over {MAX_FENCES}; remove some first"
    count = sum(len(ring.x_m) for fence in fences.values() for ring in fence.rings)
    return (
        f"fences: {count} points in all, over {_MOST_VERTICES}; simplify them"
        if count > _MOST_VERTICES
        else ""
    )


def _shuts_in(fences: dict[str, Fence], where: Whereabouts) -> str:
    """A fence that shuts the robot in where it stands would leave it no way to obey."""
    if where.robot is None:
        return ""
    shut = _shut_by(fences, where.robot, where.frame)
    if not shut:
        return ""
    if fences[shut].kind == FenceKind.GEOFENCE:
        return "fences: the robot stands outside the geofence; draw it around the robot"
    return f"fences: the robot stands in the no-go polygon {shut!r}; move the robot or the polygon"


def _shuts_home(fences: dict[str, Fence], where: Whereabouts) -> str:
    if where.home is None:
        return ""
    shut = _shut_by(fences, (where.home.x_m, where.home.y_m), where.frame)
    return f"; mind: home is shut by {shut!r}" if shut else ""


def _shut_by(fences: dict[str, Fence], at: tuple[float, float], frame: Planar) -> str:
    """Id of a fence that keeps the robot from a point in `map`, or nothing."""
    geofences = [name for name, fence in fences.items() if fence.kind == FenceKind.GEOFENCE]
    for name, fence in fences.items():
        if fence.kind == FenceKind.NO_GO and _holds(fence, at, frame):
            return name
    if geofences and not any(_holds(fences[name], at, frame) for name in geofences):
        return geofences[0]
    return ""


def _holds(fence: Fence, at: tuple[float, float], frame: Planar) -> bool:
    x_m, y_m = at if fence.frame == FenceFrame.MAP else frame.inverse().apply(*at)
    rings = [np.array(ring.points) for ring in fence.rings]
    return bool(inside(rings, np.array([[x_m, y_m]]))[0])


def _told(new: list[Fence], ids: list[str]) -> str:
    kinds = {
        FenceKind.GEOFENCE: "geofence",
        FenceKind.NO_GO: "no-go polygon",
        FenceKind.PRIORITY: "priority polygon",
    }
    parts = [
        f"{kinds[fence.kind]} {name} in {fence.frame.value}" for fence, name in zip(new, ids, strict=True)
    ]
    return f"holds from now on: {', '.join(parts)}"

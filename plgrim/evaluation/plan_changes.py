"""What a new plan does to the one that is driven: heading jumps where they part, and how soon it heeds a new hazard.

Everything is measured on the lines that are published, so that it means the same for every planner and profile.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from planning.frames import Planar, planar
from schemas.contract import SECOND_NS, Stamp
from schemas.policy import Plan
from schemas.sensing import Odometry

Line = NDArray[np.float64]
Area = tuple[float, float, float, float]
"""x_low, y_low, x_high, y_high in `map`, m."""

SAME_M = 0.05
"""Two lines go together while they are no farther apart."""
BASE_M = 0.5
"""Directions are those of chords of this length."""
AHEAD_M = 40.0
"""No farther ahead is compared."""
SHARP_RAD = math.radians(45.0)
WATCHED_S = 20.0
"""A hazard without a reaction until then counts as this long."""


@dataclass(frozen=True)
class Junction:
    """Where a new plan leaves the old one: so far ahead of the robot, with such a change of direction."""

    ahead_m: float
    jump_rad: float


def arc_m(line: Line) -> NDArray[np.float64]:
    """Way along a line to each of its points, m, (k,)."""
    return (
        np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))]) if len(line) else np.zeros(0)
    )


def junction(old: Line, new: Line, yaw_rad: float) -> Junction | None:
    """Where the new line leaves the old one; None when it does not (it was cut, or is the same).

    old, new: (k, 2), from the robot's place on. yaw_rad: where the robot looks, which counts as the direction before
    when they part at once. A line that goes on where the old one ended parts from it there.
    """
    along = arc_m(new)
    near = along <= AHEAD_M
    new, along = new[near], along[near]
    if len(old) < 2 or len(new) < 2:
        return None
    apart = cdist(new, old).min(axis=1) > SAME_M + _half_step(old)
    if not apart.any():
        return None
    first = max(int(np.argmax(apart)) - 1, 0)
    after = direction(new, along, float(along[first]), BASE_M)
    before = yaw_rad
    if along[first] >= BASE_M:
        before = direction(new, along, float(along[first]), -BASE_M)
    return Junction(float(along[first]), abs(math.remainder(after - before, 2.0 * math.pi)))


def _half_step(line: Line) -> float:
    """Half the distance of a line's points: so far off its points a point may be that lies on it."""
    return 0.5 * float(np.hypot(*np.diff(line, axis=0).T).max())


def direction(line: Line, along: NDArray[np.float64], at_m: float, chord_m: float) -> float:
    """Direction of travel of the chord from `at_m` on (or, negative, up to it)."""
    ends = sorted((at_m, at_m + chord_m))
    x, y = (np.interp(ends, along, line[:, axis]) for axis in (0, 1))
    return math.atan2(y[1] - y[0], x[1] - x[0])


def first_touch_m(line: Line, area: Area, radius_m: float) -> float | None:
    """Way along a line to where a disc touches an area; None when it passes by."""
    if not len(line):
        return None
    low, high = np.array(area[:2]), np.array(area[2:])
    off = np.maximum(np.maximum(low - line, line - high), 0.0)
    touches = np.flatnonzero(np.hypot(*off.T) < radius_m)
    return float(arc_m(line)[touches[0]]) if touches.size else None


@dataclass(slots=True)
class Hazard:
    """An area that became solid on the driven line. way_m: to it, then. Times from then on; None: not yet."""

    area: Area
    since_ns: Stamp
    way_m: float
    cut_s: float | None = None
    reacted_s: float | None = None


@dataclass
class PlanChanges:
    """Collects junctions and reactions from plans and poses. closed: areas of the world that have become solid so far.

    footprint_radius_m: of the disc that must not touch an area.
    """

    footprint_radius_m: float = 0.25
    closed: Callable[[], Sequence[Area]] = tuple
    junctions: list[Junction] = field(default_factory=list)
    hazards: list[Hazard] = field(default_factory=list)
    _plan_id: int = -1
    _line: Line = field(default_factory=lambda: np.zeros((0, 2)))
    _known: int = 0
    _frame: Planar = field(default_factory=lambda: Planar(0.0, 0.0, 0.0))
    _yaw_rad: float = 0.0

    def see_pose(self, odometry: Odometry) -> None:
        """Take in where the robot is."""
        frame = odometry.map_to_odom
        self._frame, self._yaw_rad = planar(frame), odometry.pose.yaw_rad

    def see_plan(self, plan: Plan, now: Stamp) -> None:
        """Take in a plan as it is published."""
        line = np.column_stack((plan.x_m, plan.y_m)) if plan.valid else np.zeros((0, 2))
        self._watch_hazards(line, now)
        if plan.plan_id != self._plan_id:
            found = junction(self._line, line, self._yaw_rad)
            if found is not None:
                self.junctions.append(found)
        self._plan_id, self._line = plan.plan_id, line

    def _watch_hazards(self, line: Line, now: Stamp) -> None:
        """An area closes on the line driven so far: it is a hazard. Then wait for what the plans do about it."""
        closed = self.closed()
        for area in closed[self._known :]:
            way_m = first_touch_m(self._in_map(self._line), area, self.footprint_radius_m)
            if way_m is not None:
                self.hazards.append(Hazard(area, now, way_m))
        self._known = len(closed)
        for hazard in self.hazards:
            if hazard.reacted_s is None:
                self._react(hazard, line, (now - hazard.since_ns) / SECOND_NS)

    def _react(self, hazard: Hazard, line: Line, after_s: float) -> None:
        """Cut: the line does not touch it any more. Reacted: and leads on, longer than the way to it was."""
        clear = first_touch_m(self._in_map(line), hazard.area, self.footprint_radius_m) is None
        if after_s >= WATCHED_S:
            hazard.cut_s, hazard.reacted_s = hazard.cut_s or WATCHED_S, WATCHED_S
        elif clear:
            hazard.cut_s = after_s if hazard.cut_s is None else hazard.cut_s
            if len(line) and arc_m(line)[-1] > hazard.way_m:
                hazard.reacted_s = after_s

    def _in_map(self, line: Line) -> Line:
        return np.array([self._frame.apply(float(x), float(y)) for x, y in line]).reshape(-1, 2)

    def result(self) -> dict[str, Any]:
        """Plain figures, degrees and seconds; None where nothing was seen."""
        jumps = np.degrees([j.jump_rad for j in self.junctions])
        reacted = [h.reacted_s for h in self.hazards if h.reacted_s is not None]
        cut = [h.cut_s for h in self.hazards if h.cut_s is not None]
        return {
            "junctions": len(jumps),
            "junction_ahead_m": _mean([j.ahead_m for j in self.junctions]),
            "heading_jump_deg": _mean(jumps.tolist()),
            "heading_jump_p95_deg": float(np.quantile(jumps, 0.95)) if jumps.size else None,
            "sharp_jumps": int((np.radians(jumps) > SHARP_RAD).sum()),
            "hazards": len(self.hazards),
            "hazard_cut_s": _mean(cut),
            "hazard_reaction_s": _mean(reacted),
        }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None

"""A tour by a planner that knows the map: viewpoints, their order, and the way past them, by the judge's sight.

A round picks viewpoints for all that is not yet covered (greedy set cover), orders them (nearest neighbour, 2-opt) and
walks the order in rehearsal. As the map is known, so is what a place would still add: a viewpoint whose ground has been
seen on the way is left out, and the way to one ends where the last of its ground comes in sight. What a round leaves,
because it is less than is worth a visit, is for the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.open_tour import improve_tour, nearest_neighbour_tour, tour_length
from plgrim.evaluation.known_ground import KnownGround, Points, distances_between
from plgrim.evaluation.viewpoints import SAMPLE, Cells, Tell, Viewpoint, cover, sampled, views
from services.sim.config import SimConfig
from services.sim.coverage import Judge
from services.sim.world import World

SPACING_M = 1.5
"""Between candidates for viewpoints."""
_PASSES = 200
"""Most passes of 2-opt; far fewer are needed."""
_STEP_M, _STEP_RAD = 0.1, 0.15
"""Between two looks of a rehearsal: about what the robot moves between two looks of the judge at full speed."""
_ASK_EVERY = 3
"""Steps between two checks of whether a viewpoint's ground has been seen."""
_MOST_TURNS = 3
"""On the spot, at one viewpoint."""
SHARP_RAD = math.radians(50.0)
"""The follower turns on the spot where the way turns by more; each costs about `_SPOT_S` besides the turning."""
_SPOT_S = 1.2
SLOW_MPS, SLOW_MARGIN_M, FREE_MARGIN_M = 0.4, 0.1, 0.3
"""Up to the first margin from the rim so slow that a touch breaks nothing, from the second on at full speed."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A way without a stop, and the heading to turn to at its end; None: as the way ends."""

    points_m: Points
    yaw_rad: float | None


class Rehearsed(NamedTuple):
    """A tour as planned. The time is an estimate; the drive measures it."""

    stretches: list[Stretch]
    stops_m: Points
    """(n, 2): where the viewpoints that were visited have been seen from."""
    viewpoints: int
    """That the first round chose."""
    nearest_neighbour_m: float
    """Length of the first round's order over all its viewpoints, before 2-opt."""
    two_opt_m: float
    covered_m2: float
    time_s: float


@dataclass
class _Walk:
    """Where a rehearsal stands."""

    at: tuple[float, float]
    yaw_rad: float
    time_s: float = 0.0
    points: list[tuple[float, float]] = field(default_factory=list)
    stretches: list[Stretch] = field(default_factory=list)
    stops: list[tuple[float, float]] = field(default_factory=list)

    def end_stretch(self, yaw_rad: float | None) -> None:
        points = self.points if self.points else [self.at]
        self.stretches.append(Stretch(np.array(points, np.float64), yaw_rad))
        self.points = [self.at]


def speed_limit_mps(margin_m: NDArray[np.float64], max_speed_mps: float) -> NDArray[np.float64]:
    """Allowed speed by distance from the rim of the ground."""
    slow = min(SLOW_MPS, max_speed_mps)
    return np.interp(margin_m, [SLOW_MARGIN_M, FREE_MARGIN_M], [slow, max_speed_mps])


class TourPlanner:
    """Plans tours in one world. Holds a judge, whose coverage a rehearsal uses up and a drive may use after it."""

    def __init__(
        self, world: World, config: SimConfig, judge: Judge, ground: KnownGround, tell: Tell
    ) -> None:
        self._judge, self.ground, self._tell = judge, ground, tell
        self._start = world.start
        self._robot = config.robot
        self._cells = ground.places(SPACING_M)
        self._places_m = ground.centres(self._cells)
        self._seen_from = views(judge, self._places_m, tell)
        self._graph = ground.roadmap(self._cells, SPACING_M)
        tell(f"{len(self._cells)} places for viewpoints, {self._graph.nnz // 2} ways between them")

    def rehearse(self, rounds_m2: Sequence[float], time_s: float) -> Rehearsed:
        """A tour of at least about `time_s`, if there is so much to see.

        rounds_m2: in each round, the least area (m2) that a viewpoint is visited for.
        """
        self._judge.set_covered(np.zeros(self._judge.spec.shape, np.bool_))
        walk = _Walk(self._start[:2], self._start[2])
        walk.points.append(walk.at)
        self._judge.update(*self._start)
        cell_m2 = (SAMPLE * self._judge.spec.resolution_m) ** 2
        first: tuple[int, float, float] | None = None
        for least_m2 in rounds_m2:
            least = max(1, round(least_m2 / cell_m2))
            wanted = sampled(self._judge.reachable & ~self._judge.covered)
            viewpoints = cover(self._seen_from, wanted, least)
            order, before_m, after_m = self._order(walk.at, viewpoints)
            first = first or (len(viewpoints), before_m, after_m)
            for viewpoint in order:
                if walk.time_s > time_s:
                    break
                self._visit(walk, viewpoint, least)
        walk.end_stretch(None)
        assert first is not None
        covered_m2 = self._judge.covered_area_m2
        return Rehearsed(walk.stretches, np.array(walk.stops).reshape(-1, 2), *first, covered_m2, walk.time_s)

    def _order(
        self, at: tuple[float, float], viewpoints: list[Viewpoint]
    ) -> tuple[list[Viewpoint], float, float]:
        """The viewpoints in the order of the tour, and its length before and after 2-opt."""
        if not viewpoints:
            return [], 0.0, 0.0
        places = np.array([v.place for v in viewpoints])
        distance = np.zeros((len(places) + 1, len(places) + 1), np.float32)
        distance[1:, 1:] = distances_between(self._graph, places)
        distance[0, 1:] = distance[1:, 0] = self.ground.from_point(*at, self._cells[places])
        order = nearest_neighbour_tour(distance)
        before_m = tour_length(distance, order)
        passes = improve_tour(distance, order, _PASSES)
        after_m = tour_length(distance, order)
        self._tell(
            f"{len(places)} viewpoints: nearest neighbour {before_m:.0f} m, "
            f"after {passes} passes of 2-opt {after_m:.0f} m"
        )
        return [viewpoints[k - 1] for k in order[1:].tolist()], before_m, after_m

    def _visit(self, walk: _Walk, viewpoint: Viewpoint, least: int) -> None:
        """Go to a viewpoint until less than `least` of its cells are unseen; turn there to what is not ahead."""
        left = self._left(viewpoint.owned)
        if left.size < least:
            return
        row, column = self._cells[viewpoint.place].tolist()
        points, cost = self.ground.way(walk.at, (row, column))
        if math.isfinite(cost) and not self._walk_along(walk, points, viewpoint.owned, least):
            for _ in range(_MOST_TURNS):
                left = self._left(left)
                if left.size < least:
                    break
                self._turn(walk, self._bearing(walk.at, left))
        walk.stops.append(walk.at)

    def _left(self, cells: Cells) -> Cells:
        return cells[~self._judge.covered.reshape(-1)[cells]]

    def _bearing(self, at: tuple[float, float], cells: Cells) -> float:
        """Mean direction of cells seen from a point."""
        spec = self._judge.spec
        x = (spec.ix0 + cells % spec.width + 0.5) * spec.resolution_m - at[0]
        y = (spec.iy0 + cells // spec.width + 0.5) * spec.resolution_m - at[1]
        far = np.maximum(np.hypot(x, y), 1e-9)
        return math.atan2(float((y / far).sum()), float((x / far).sum()))

    def _walk_along(self, walk: _Walk, points: Points, owned: Cells, least: int) -> bool:
        """Look along a way; returns whether the viewpoint's ground was seen, there or before its end."""
        steps = 0
        for (x0, y0), (x1, y1) in zip(points[:-1].tolist(), points[1:].tolist(), strict=True):
            length = math.hypot(x1 - x0, y1 - y0)
            if length < 1e-6:
                continue
            self._head(walk, math.atan2(y1 - y0, x1 - x0))
            count = max(1, math.ceil(length / _STEP_M))
            share = np.arange(1, count + 1) / count
            along = np.stack([x0 + share * (x1 - x0), y0 + share * (y1 - y0)], axis=1)
            speed = speed_limit_mps(self.ground.margin_at(along), self._robot.max_speed_mps)
            for (x, y), mps in zip(along.tolist(), speed.tolist(), strict=True):
                self._judge.update(x, y, walk.yaw_rad)
                walk.at = (x, y)
                walk.time_s += length / count / mps
                steps += 1
                if steps % _ASK_EVERY == 0 and self._left(owned).size < least:
                    walk.points.append(walk.at)
                    return True
            walk.points.append(walk.at)
        return False

    def _head(self, walk: _Walk, yaw_rad: float) -> None:
        """Take up the direction of the next piece of way: on the spot when it is sharp, and then looking round."""
        turn = abs(math.remainder(yaw_rad - walk.yaw_rad, math.tau))
        if turn > SHARP_RAD:
            self._sweep(walk, yaw_rad)
        walk.yaw_rad = yaw_rad

    def _turn(self, walk: _Walk, yaw_rad: float) -> None:
        """Stop, and turn on the spot."""
        self._sweep(walk, yaw_rad)
        walk.end_stretch(yaw_rad)

    def _sweep(self, walk: _Walk, yaw_rad: float) -> None:
        turn = math.remainder(yaw_rad - walk.yaw_rad, math.tau)
        count = max(1, math.ceil(abs(turn) / _STEP_RAD))
        for k in range(1, count + 1):
            self._judge.update(*walk.at, walk.yaw_rad + turn * k / count)
        walk.yaw_rad = math.remainder(walk.yaw_rad + turn, math.tau)
        walk.time_s += abs(turn) / self._robot.max_turn_rate_radps + _SPOT_S

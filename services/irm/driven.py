"""Where the robot itself went between two breadcrumbs: what alone is evidence against that edge."""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = tuple[float, float]

_STEP_M = 0.25
"""Points of a way are so far apart."""
_MOST_POINTS = 200
_LEAST_M = 0.5
"""A way between ends that are nearer to one another has no direction to be told in."""

REFUTED_WITHIN_M = 5.0
"""What stands there counts when it is seen from so near: from farther away, a slope that falls off behind a stone looks
closed, where the robot went itself."""
REFUTED = 3
"""A way that was found blocked so often in a row is closed: once may be a person, or noise on a slope."""


class Trail:
    """The way of the robot in `map` since its last breadcrumb."""

    def __init__(self) -> None:
        self.points: list[Point] = []

    def note(self, x_m: float, y_m: float) -> None:
        """The robot is here."""
        if not self.points or math.dist(self.points[-1], (x_m, y_m)) >= _STEP_M:
            self.points.append((x_m, y_m))
            del self.points[:-_MOST_POINTS]

    def hand_over(self, start: Point, end: Point) -> list[float]:
        """The way, seen from two nodes (see `seen_from`); what follows begins here."""
        way = seen_from(start, end, self.points)
        self.points = self.points[-1:]
        return way


def seen_from(start: Point, end: Point, points: Sequence[Point]) -> list[float]:
    """Points as shares along and across the line between two nodes, one after the other: they move with the nodes.

    Empty when the nodes are too near to one another.
    """
    ux, uy = end[0] - start[0], end[1] - start[1]
    square = ux * ux + uy * uy
    if square < _LEAST_M**2:
        return []
    shares: list[float] = []
    for x, y in points:
        dx, dy = x - start[0], y - start[1]
        shares += [(dx * ux + dy * uy) / square, (dy * ux - dx * uy) / square]
    return shares


def placed(start: Point, end: Point, shares: Sequence[float]) -> list[Point]:
    """The inverse of `seen_from`, for where the nodes are now."""
    ux, uy = end[0] - start[0], end[1] - start[1]
    return [
        (start[0] + t * ux - s * uy, start[1] + t * uy + s * ux)
        for t, s in zip(shares[::2], shares[1::2], strict=True)
    ]

"""How long what was seen still lies where it seems to in `odom`, which drifts: by the distance driven since.

A map around the robot that keeps more shows corridors beside themselves when the robot comes round a loop.
"""

from __future__ import annotations

import math
from typing import Any

from planning.frames import Planar, planar
from schemas.base import Pose

_STANDS_M = 0.2
"""Less is the noise of the pose of a robot that stands."""
_SHOWN_M = 0.2
"""Closures that have moved the robot by so much in `map` show that odometry has drifted; smaller ones add up."""
_RECENT_M = 10.0
"""What was seen so lately is kept then: over such a way odometry holds together."""


class Drift:
    """Counts the way in `odom` and the jumps of `odom` in `map`. memory_m: 0 keeps what no closure refutes."""

    def __init__(self, memory_m: float) -> None:
        self._memory_m = memory_m if memory_m > 0.0 else math.inf
        self._driven_m, self._shown_m, self._refuted_m = 0.0, 0.0, -math.inf
        self._at: tuple[float, float] | None = None
        self._frame: Planar | None = None

    def drive(self, x_m: float, y_m: float) -> float:
        """The robot is here in `odom`. Returns how far it has driven, m."""
        step_m = math.inf if self._at is None else math.dist(self._at, (x_m, y_m))
        if step_m > _STANDS_M:
            self._driven_m += step_m if self._at is not None else 0.0
            self._at = (x_m, y_m)
        return self._driven_m

    def count(self, driven_m: float) -> None:
        """The robot has driven so far by somebody else's count, m: instead of `drive`."""
        self._driven_m = driven_m

    def close(self, map_to_odom: Pose, robot: Pose) -> None:
        """Where `odom` lies in `map`: when that jumps, a loop was closed. robot: in `odom`."""
        frame = planar(map_to_odom)
        if self._frame is not None and frame != self._frame:
            before, after = (f.apply(robot.x_m, robot.y_m) for f in (self._frame, frame))
            self._shown_m += math.dist(before, after)
        self._frame = frame
        if self._shown_m >= _SHOWN_M:
            self._shown_m, self._refuted_m = 0.0, self._driven_m - _RECENT_M

    def keeps_from_m(self) -> float:
        """What was last seen before so much was driven is to be forgotten, m."""
        return max(self._refuted_m, self._driven_m - self._memory_m)

    def state(self) -> list[Any]:
        """For a snapshot."""
        frame = None if self._frame is None else list(self._frame)
        return [self._driven_m, self._shown_m, self._refuted_m, self._at, frame]

    def load(self, state: list[Any]) -> None:
        """Go on from `state`."""
        self._driven_m, self._shown_m, self._refuted_m = (float(value) for value in state[:3])
        self._at = None if state[3] is None else (float(state[3][0]), float(state[3][1]))
        self._frame = None if state[4] is None else Planar(*state[4])

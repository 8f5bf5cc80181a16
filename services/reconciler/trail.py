"""Where the robot has driven lately: the one way that is known to be free when it cannot go on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_APART_M = 0.05
_GAP_M = 0.25


class Trail:
    """The last `length_m` of the driven line in `odom`, points `_APART_M` or more apart; oldest first."""

    def __init__(self, length_m: float) -> None:
        self._most = max(2, math.ceil(length_m / _APART_M))
        self._points: list[tuple[float, float]] = []

    def add(self, x_m: float, y_m: float) -> None:
        """The robot is here now. Going back over the trail takes it up again."""
        for k in range(max(len(self._points) - self._most, 0), len(self._points)):
            if math.hypot(x_m - self._points[k][0], y_m - self._points[k][1]) < _APART_M:
                del self._points[k + 1 :]
                return
        self._points.append((x_m, y_m))
        del self._points[: -self._most]

    def back(self, x_m: float, y_m: float, distance_m: float) -> NDArray[np.float64]:
        """The way back from a point along the trail, (k, 2) m, k >= 1; shorter where the trail ends."""
        line, left_m = [(x_m, y_m)], distance_m
        for point in reversed(self._points):
            step_m = math.dist(line[-1], point)
            if step_m > _GAP_M:  # nobody drove there
                break
            if step_m >= left_m:
                share = left_m / step_m
                line.append(
                    (
                        line[-1][0] + share * (point[0] - line[-1][0]),
                        line[-1][1] + share * (point[1] - line[-1][1]),
                    )
                )
                break
            if step_m > 1e-6:
                line.append(point)
                left_m -= step_m
        return np.array(line)

    def state(self) -> list[tuple[float, float]]:
        """For a snapshot."""
        return list(self._points)

    def load(self, state: list[tuple[float, float]]) -> None:
        """Go on from `state`."""
        self._points = [(float(x), float(y)) for x, y in state]

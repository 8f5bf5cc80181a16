"""What stopped the robot although no ray had shown it: after a second contact at one place, the place is lethal."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import LETHAL, GridSpec
from schemas.base import Pose
from services.riskmap.collision import RiskLayers

_SAME_PLACE_M = 0.4
"""Contacts whose places are nearer to each other than this are met at one place."""
_MOST = 64


class Bumps:
    """Contacts of the robot, each (stamp ns, x m, y m) in `odom` of the rim of its disc in the way it was going.

    The first at a place is passed over: a scrape at a door's frame, after which the robot comes again from a little
    way back. From the second on the place is lethal for `memory_ns`.
    """

    def __init__(self, radius_m: float, memory_ns: int) -> None:
        self._radius_m = radius_m
        self._memory_ns = memory_ns
        self._met: list[tuple[int, float, float, float, float]] = []
        self._touching: tuple[float, float] | None = None
        self._backwards = False

    def observe(self, now_ns: int, pose: Pose, speed_mps: float, blocked: bool) -> None:
        """Where the robot is, how it moves, and whether something stops it."""
        if abs(speed_mps) > 0.02:
            self._backwards = speed_mps < 0.0
        here = (pose.x_m, pose.y_m)
        if self._touching is not None and math.dist(here, self._touching) > 0.5 * _SAME_PLACE_M:
            self._touching = None
        if not blocked or self._touching is not None:
            return
        self._touching = here
        way = pose.yaw_rad + (math.pi if self._backwards else 0.0)
        rim = (here[0] + self._radius_m * math.cos(way), here[1] + self._radius_m * math.sin(way))
        self._met = [m for m in self._met if now_ns - m[0] < self._memory_ns][-_MOST + 1 :]
        self._met.append((now_ns, *here, *rim))

    def places(self, now_ns: int) -> NDArray[np.float64]:
        """(n, 2) m in `odom`: where the robot was stopped more than once."""
        met = [m for m in self._met if now_ns - m[0] < self._memory_ns]
        again = [
            m[3:]
            for k, m in enumerate(met)
            if any(math.dist(m[3:], other[3:]) < _SAME_PLACE_M for other in met[:k])
        ]
        return np.array(again, dtype=np.float64).reshape(-1, 2)

    def state(self) -> dict[str, object]:
        """For a snapshot."""
        return {"met": self._met, "touching": self._touching, "backwards": self._backwards}

    def load(self, state: dict[str, object]) -> None:
        """Go on from `state`."""
        met, touching = state["met"], state["touching"]
        assert isinstance(met, list)
        self._met = [(int(m[0]), *(float(v) for v in m[1:])) for m in met]  # type: ignore[misc]
        self._touching = None if touching is None else (float(touching[0]), float(touching[1]))  # type: ignore[index]
        self._backwards = bool(state["backwards"])


def stamp_bumps(
    layers: RiskLayers, spec: GridSpec, places: NDArray[np.float64], full_hazard_per_m: float
) -> None:
    """Make the cells of `places` (n, 2) lethal, and the clearance around them small, in place."""
    x, y = spec.centres_x(), spec.centres_y()[:, None]
    for px, py in places:
        row, column = spec.cell_of(float(px), float(py))
        if not spec.contains(row, column):
            continue
        layers.state[row, column] = LETHAL
        layers.hazard_mean[row, column] = layers.hazard_cvar[row, column] = full_hazard_per_m
        layers.hazard_variance[row, column] = 0.0
        away = np.hypot(x - px, y - py).astype(np.float32)
        away[row, column] = 0.0
        np.minimum(layers.clearance_m, away, out=layers.clearance_m)

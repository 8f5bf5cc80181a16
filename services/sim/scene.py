"""What of a world moves: people who walk and doors that close, as they stand at one mission time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.sim.geometry import clearance
from services.sim.world import Door, World


class Scene:
    """The walls and the movers of a world now. Without doors and movers it is the world itself.

    `occupied` is bool[height, width], read-only; `movers` float64[n, 5]: x, y, radius, foot, top in metres.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.occupied: NDArray[np.bool_] = world.occupied
        self.closed: list[bool] = [False] * len(world.doors)
        """Which doors have closed."""
        self.movers: NDArray[np.float64] = np.zeros((len(world.movers), 5))
        self.advance(0.0, None, 0.0)

    def advance(self, now_s: float, robot_m: tuple[float, float] | None, radius_m: float) -> bool:
        """Go on to a mission time; the robot's disc keeps doors open. Returns whether a door has closed."""
        for k, mover in enumerate(self.world.movers):
            x_m, y_m = mover.at(now_s)
            foot_m = self._ground_m(x_m, y_m)
            self.movers[k] = (x_m, y_m, mover.radius_m, foot_m, foot_m + mover.height_m)
        closing = [
            not shut
            and now_s >= door.closes_at_s
            and _is_near(door, robot_m)
            and (robot_m is None or not self._holds(door, robot_m, radius_m))
            for shut, door in zip(self.closed, self.world.doors, strict=True)
        ]
        if not any(closing):
            return False
        self.set_closed([shut or now for shut, now in zip(self.closed, closing, strict=True)])
        return True

    def closed_areas_m(self) -> tuple[tuple[float, float, float, float], ...]:
        """The rectangles of the doors that have closed."""
        return tuple(door.area_m for shut, door in zip(self.closed, self.world.doors, strict=True) if shut)

    def set_closed(self, closed: list[bool]) -> None:
        """Close these doors and open the others."""
        self.closed = list(closed)
        occupied = self.world.occupied
        for shut, door in zip(closed, self.world.doors, strict=True):
            if shut:
                occupied = occupied | self._cells(door)
        occupied.setflags(write=False)
        self.occupied = occupied

    def _cells(self, door: Door) -> NDArray[np.bool_]:
        """Cells whose centre lies in the door."""
        x_low, y_low, x_high, y_high = door.area_m
        spec = self.world.spec
        x, y = spec.centres_x(), spec.centres_y()[:, None]
        return np.asarray((x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high))

    def _holds(self, door: Door, robot_m: tuple[float, float], radius_m: float) -> bool:
        """Whether the robot's disc overlaps the door."""
        reach = radius_m / self.world.spec.resolution_m + 1.0
        room, _, _ = clearance(self._cells(door), *self.world.to_cells(*robot_m), reach)
        return room * self.world.spec.resolution_m < radius_m + 0.05

    def _ground_m(self, x_m: float, y_m: float) -> float:
        if self.world.floor_m is None:
            return 0.0
        row, column = self.world.spec.cell_of(x_m, y_m)
        return float(self.world.floor_m[row, column])


def _is_near(door: Door, robot_m: tuple[float, float] | None) -> bool:
    """Whether the robot is where the door closes."""
    if robot_m is None:
        return math.isinf(door.closes_within_m)
    return door.gap_m(*robot_m) <= door.closes_within_m

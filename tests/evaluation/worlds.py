"""Small worlds for tours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from services.sim.config import SimConfig
from services.sim.world import World

Box = tuple[float, float, float, float]
CONFIG = SimConfig()


def silent(text: str) -> None:
    """Tell nobody."""


def rooms(
    width_m: float,
    height_m: float,
    walls: tuple[Box, ...] = (),
    start: tuple[float, float, float] = (1.0, 1.0, 0.0),
    floor_m: NDArray[np.float32] | None = None,
) -> World:
    """A walled box with its lower left corner at the origin, and further walls in it; cells of 0.1 m."""
    spec = GridSpec(0.1, 0, 0, round(width_m * 10), round(height_m * 10))
    x, y = np.meshgrid(spec.centres_x(), spec.centres_y())
    occupied = (x < 0.1) | (y < 0.1) | (x > width_m - 0.1) | (y > height_m - 0.1)
    for x_low, y_low, x_high, y_high in walls:
        occupied |= (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
    ceiling = None if floor_m is None else floor_m + np.float32(3.0)
    return World("rooms", spec, occupied, start, floor_m, ceiling)

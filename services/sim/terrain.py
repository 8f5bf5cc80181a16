"""The ground and the ceiling as surfaces: heights at cell centres, bilinear between them.

Positions are in cells as in `geometry`: x / resolution - ix0. Beyond the outermost centres the surface goes on level.
Between four centres of which one has no ceiling there is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from planning.kernels import njit
from services.sim.world import World

OPEN_M = 1e6
"""Height of a ceiling where there is none: finite, as 0 * inf would spoil an interpolation."""

Heights = NDArray[np.float32]
BoolGrid = NDArray[np.bool_]


class Terrain(NamedTuple):
    """Surfaces of one world, as the kernels take them: arrays of the world's shape, in metres."""

    floor_m: Heights
    ceiling_m: Heights
    """`OPEN_M` where there is no ceiling."""


def terrain_of(world: World) -> Terrain:
    """The surfaces of a world that has them."""
    assert world.floor_m is not None and world.ceiling_m is not None
    return Terrain(world.floor_m, finite_ceiling(world.ceiling_m))


def finite_ceiling(ceiling_m: Heights) -> Heights:
    """The ceiling with `OPEN_M` for inf; read-only."""
    finite = np.minimum(ceiling_m, np.float32(OPEN_M))
    finite.setflags(write=False)
    return finite


@njit
def height_at(heights_m: Heights, x: float, y: float) -> float:
    """Height in metres of the surface at a point in cells."""
    rows, columns = heights_m.shape
    u = min(max(x - 0.5, 0.0), columns - 1.0)
    v = min(max(y - 0.5, 0.0), rows - 1.0)
    column, row = min(int(u), max(columns - 2, 0)), min(int(v), max(rows - 2, 0))
    right, up = min(column + 1, columns - 1), min(row + 1, rows - 1)
    a, b = u - column, v - row
    low = heights_m[row, column] * (1.0 - a) + heights_m[row, right] * a
    high = heights_m[up, column] * (1.0 - a) + heights_m[up, right] * a
    return low * (1.0 - b) + high * b


def resample(heights_m: Heights, cuts: int) -> Heights:
    """Heights at the centres of cells cut `cuts` times finer; exact, as the surface is bilinear. Read-only."""
    finer = heights_m if cuts == 1 else _resample(heights_m, cuts)
    finer.setflags(write=False)  # as the world's own: another kind of array would be another compilation
    return finer


@njit
def _resample(heights_m: Heights, cuts: int) -> Heights:
    rows, columns = heights_m.shape
    finer = np.empty((rows * cuts, columns * cuts), dtype=np.float32)
    for row in range(rows * cuts):
        for column in range(columns * cuts):
            finer[row, column] = height_at(heights_m, (column + 0.5) / cuts, (row + 0.5) / cuts)
    return finer


def body_solid(world: World, height_m: float) -> BoolGrid:
    """What is wall to a body of that height: solid cells, and those whose ceiling hangs lower over the floor."""
    if world.floor_m is None or world.ceiling_m is None:
        return world.occupied
    solid = world.occupied | (world.ceiling_m - world.floor_m < height_m)
    solid.setflags(write=False)
    return solid


def rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Rotation (3, 3) from the body to the world: yaw about z, then pitch about y, then roll about x (REP-103).

    A positive pitch turns the nose down.
    """
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def local_xy(spec: GridSpec, x_m: float, y_m: float) -> tuple[float, float]:
    """A point in cells of the grid."""
    return x_m / spec.resolution_m - spec.ix0, y_m / spec.resolution_m - spec.iy0

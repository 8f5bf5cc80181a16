"""Where a robot can start on uneven ground."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from services.sim.config import RobotConfig
from services.sim.terrain import BoolGrid, body_solid
from services.sim.terrain_judge import acceptable_ground
from services.sim.world import StartError, World, with_start

_GENTLE = 0.15
"""Tangent of the slope up to which ground is flat enough for a default start."""


def standing_ground(world: World, robot: RobotConfig) -> BoolGrid:
    """Cells on which the robot stands at acceptable risk."""
    assert world.floor_m is not None
    return acceptable_ground(world.spec, body_solid(world, robot.height_m), world.floor_m, robot)


def deepest_standing_point(world: World, robot: RobotConfig) -> tuple[float, float]:
    """Centre (x_m, y_m) of the flat cell farthest from where the robot cannot stand, in the largest connected part.

    Raises StartError if it can stand nowhere.
    """
    assert world.floor_m is not None
    ground = standing_ground(world, robot)
    parts, count = ndimage.label(ground)
    if count == 0:
        raise StartError("the robot can stand nowhere in this world")
    largest = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    slope = np.hypot(*np.gradient(world.floor_m, world.spec.resolution_m))
    flat = largest & (ndimage.uniform_filter(slope, 7) < _GENTLE)
    depth = ndimage.distance_transform_edt(np.pad(largest, 1))[1:-1, 1:-1]
    depth[~flat if flat.any() else ~largest] = 0.0
    row, column = divmod(int(np.argmax(depth)), world.spec.width)
    return world.spec.centre_of(row, column)


def with_terrain_start(
    world: World, x_m: float, y_m: float, yaw_rad: float | None, robot: RobotConfig
) -> World:
    """As `world.with_start`; also refuses ground on which the robot does not stand, and suggests the nearest."""
    try:
        placed = with_start(world, x_m, y_m, yaw_rad, robot.footprint_radius_m)
    except StartError:
        if not (
            math.isfinite(x_m) and math.isfinite(y_m) and world.spec.contains(*world.spec.cell_of(x_m, y_m))
        ):
            raise
        placed = None
    ground = standing_ground(world, robot)
    row, column = world.spec.cell_of(x_m, y_m)
    if placed is not None and ground[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].any():
        return placed
    if not ground.any():
        raise StartError(f"the robot can stand nowhere in world {world.name}")
    nearest = ndimage.distance_transform_edt(~ground, return_distances=False, return_indices=True)
    x_good_m, y_good_m = world.spec.centre_of(int(nearest[0, row, column]), int(nearest[1, row, column]))
    away_m = math.hypot(x_good_m - x_m, y_good_m - y_m)
    raise StartError(
        f"start ({x_m:g}, {y_m:g}) in world {world.name}: a wall is too near or the ground too steep or rough for the "
        f"robot; the nearest that is not lies {away_m:.1f} m away at ({x_good_m:.2f}, {y_good_m:.2f})"
    )

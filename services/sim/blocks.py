"""A subway station in which blocks come down before the robot, to see how soon its plans heed what was not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from services.sim.subway import subway
from services.sim.world import Door, World

_BLOCKS = 60
_SIDE_M = 0.8
_WITHIN_M = 3.0
"""A block comes down when the robot has come so near: three times its way to stop from 1 m/s."""
_CLEAR_M = 1.6
"""From a block's middle to the next wall, at least: there is always a way round."""
_APART_M = 3.5
_CALM_M = 5.0
"""None so near to the start."""


def subway_blocks(seed: int) -> World:
    """`subway_1x` with blocks of 0.8 m at random places, each of which appears when the robot comes within 3 m."""
    world = subway(seed, 1)
    spec, rng = world.spec, np.random.default_rng([seed, 0xB10C])
    room_m = ndimage.distance_transform_edt(~world.occupied) * spec.resolution_m
    rows, columns = np.nonzero(room_m >= _CLEAR_M)
    middles: list[tuple[float, float]] = []
    for k in rng.permutation(len(rows)).tolist():
        x_m, y_m = spec.centre_of(int(rows[k]), int(columns[k]))
        near = [np.hypot(x_m - x, y_m - y) < _APART_M for x, y in middles]
        if not any(near) and np.hypot(x_m - world.start[0], y_m - world.start[1]) > _CALM_M:
            middles.append((x_m, y_m))
        if len(middles) == _BLOCKS:
            break
    half = _SIDE_M / 2.0
    doors = tuple(Door((x - half, y - half, x + half, y + half), 0.0, _WITHIN_M) for x, y in middles)
    return replace(world, name="subway_blocks", doors=doors)

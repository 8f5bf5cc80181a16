"""What a loop closure does to the terrain model: old ground and old obstacles go, the robot keeps what it stands on."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL, UNKNOWN
from schemas.base import Pose
from services.riskmap.cells import HIT_AT, HIT_WEIGHT, LOG_ODDS, MEAN, SEEN, TRAVELLED, VARIANCE
from services.riskmap.config import Config
from services.riskmap.terrain_model import TerrainModel
from tests.riskmap.rough import Heights, cloud_at, flat, stand_on

FRAME = Pose(x_m=3.0, y_m=-1.0, yaw_rad=0.3)
NEAR_M = 5.2


def model() -> TerrainModel:
    return TerrainModel(Config.model_validate({"model": "terrain", "profile": "husky", "resolution_m": 0.2}))


def see(
    of: TerrainModel, heights: Heights, way: Iterable[tuple[float, float]], frame: Pose | None = FRAME
) -> Pose:
    """Sweeps along a way, by a sensor that sees no farther than NEAR_M. Returns the last pose."""
    base, rng = Pose(), np.random.default_rng(0)
    for k, (x, y) in enumerate(way):
        base = stand_on(heights, x, y)
        if frame is not None:
            of.located(frame, base)
        of.roll_to(x, y)
        cloud = cloud_at(heights, base, k + 1, noise_m=0.01, rng=rng)
        points_m = cloud.points_m[np.hypot(cloud.points_m[:, 0], cloud.points_m[:, 1]) < NEAR_M]
        of.integrate(cloud.model_copy(update={"points_m": points_m}))
    return base


def moved(x_m: float) -> Pose:
    """FRAME after a closure that has moved the robot by so much."""
    return FRAME.model_copy(update={"x_m": FRAME.x_m + x_m})


def two_walls(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """One before the start, at x = 4; one beside the end of the way, at y = 2."""
    return np.where((x > 4.0) | ((y > 2.0) & (x < -9.0) & (x > -13.0)), 2.0, 0.0)


AWAY = [(-0.5 * k, 0.0) for k in range(29)]


def state_of(of: TerrainModel, base: Pose, x_m: float, y_m: float) -> int:
    return int(of.layers(base)[0].state[of.spec.cell_of(x_m, y_m)])


@pytest.mark.parametrize(("jump_m", "forgets"), [(0.1, False), (0.5, True)])
def test_a_closure_forgets_old_walls_and_old_ground(jump_m: float, forgets: bool) -> None:
    terrain = model()
    base = see(terrain, two_walls, AWAY)
    assert state_of(terrain, base, 4.1, 0.1) == LETHAL, "fourteen metres on it still stands"
    assert state_of(terrain, base, 2.1, 0.1) == FREE
    base = see(terrain, two_walls, [AWAY[-1]], moved(jump_m))
    assert state_of(terrain, base, 4.1, 0.1) == (UNKNOWN if forgets else LETHAL)
    assert state_of(terrain, base, 2.1, 0.1) == (UNKNOWN if forgets else FREE)
    assert state_of(terrain, base, -11.1, 2.1) == LETHAL, "seen lately"
    assert state_of(terrain, base, -10.1, 0.1) == FREE
    assert state_of(terrain, base, *AWAY[-1]) == FREE


def test_ground_around_the_robot_stays_known() -> None:
    """It goes round in a small circle: no ray falls on the ground within, which was seen or supposed long ago."""
    way = [(math.cos(0.4 * k), math.sin(0.4 * k)) for k in range(60)]
    terrain = model()
    base = see(terrain, flat, way)
    base = see(terrain, flat, [way[-1]], moved(1.0))
    x, y = np.meshgrid(terrain.spec.centres_x(), terrain.spec.centres_y())
    around = np.hypot(x - base.x_m, y - base.y_m) < 3.0
    assert (terrain.layers(base)[0].state[around] == FREE).all()


def test_without_closures_nothing_changes_bit_for_bit() -> None:
    told, untold = model(), model()
    see(told, two_walls, AWAY)
    base = see(untold, two_walls, AWAY, None)
    for a, b in zip(told.layers(base)[0], untold.layers(base)[0], strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert told.state()["cells"].tobytes() == untold.state()["cells"].tobytes()


def record(of: TerrainModel, x_m: float, y_m: float) -> NDArray[np.float32]:
    """The record of the cell at a point."""
    (row, column), (row0, column0) = of.spec.cell_of(x_m, y_m), of._window.origin
    found: NDArray[np.float32] = of._window.cells[
        (row + row0) % of.spec.height, (column + column0) % of.spec.width
    ]
    return found


GROUND = {VARIANCE: 0.01, SEEN: 5.0, MEAN: 0.3}
HIT = {LOG_ODDS: 2.0, HIT_WEIGHT: 3.0}


@pytest.mark.parametrize(
    ("fields", "x_m", "kept"),
    [
        ({**GROUND, TRAVELLED: 29.0}, 8.0, False),
        ({**GROUND, TRAVELLED: 31.0}, 8.0, True),
        ({**GROUND, TRAVELLED: 29.0}, 20.0, True),
        ({**HIT, HIT_AT: 29.0}, 8.0, False),
        ({**HIT, HIT_AT: 29.0}, 20.0, False),
        ({**HIT, HIT_AT: 31.0}, 8.0, True),
        ({**GROUND, TRAVELLED: 1.0, **HIT, HIT_AT: 31.0}, 8.0, True),
        ({**GROUND, TRAVELLED: 31.0, **HIT, HIT_AT: 1.0}, 8.0, False),
    ],
    ids=[
        "old ground", "new ground", "old ground here", "old hit", "old hit here", "new hit", "new hit on old ground",
        "old hit on new ground",
    ],
)  # fmt: skip
def test_what_a_closure_forgets(fields: dict[int, float], x_m: float, kept: bool) -> None:
    """Forty metres driven; the robot is at x = 20, what counts is ten metres back. Across the seam of the ring, too."""
    terrain = model()
    for x in np.arange(0.0, 20.1, 0.5):
        terrain._move_to(np.array([[1.0, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    terrain.roll_to(20.0, 0.0)
    terrain._travelled_m = 40.0
    terrain._drift.count(40.0)
    for y_m in (-0.9, 0.9):
        for channel, value in fields.items():
            record(terrain, x_m, y_m)[channel] = value
    before = [record(terrain, x_m, y_m).copy() for y_m in (-0.9, 0.9)]
    terrain.located(FRAME, Pose(x_m=20.0))
    terrain._forget()
    assert np.array_equal([record(terrain, x_m, y_m) for y_m in (-0.9, 0.9)], before), "no closure yet"
    terrain.located(moved(0.3), Pose(x_m=20.0))
    restored, state = model(), terrain.state()
    restored.load({**state, "cells": state["cells"].copy()})
    for other in (terrain, restored):
        other._forget()
        found = [record(other, x_m, y_m) for y_m in (-0.9, 0.9)]
        assert np.array_equal(found, before if kept else np.zeros_like(before))

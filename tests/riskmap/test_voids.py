"""Ground that ends without a wall: no beam comes back from there, and the robot keeps off."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL, UNKNOWN
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.sensing import PointCloud
from services.riskmap.config import Config
from services.riskmap.flat_model import FlatModel
from tests.riskmap.helpers import SENSOR_Z_M, sweep

ELEVATIONS_DEG = tuple(float(e) for e in range(-15, 0, 2))


def on_platform(x_m: float, edge_m: float, yaw_rad: float = 0.0, behind: bool = True) -> NDArray[np.float32]:
    """A sweep on open ground that ends at x = edge_m; behind: whether the sensor looks backwards too."""
    points = sweep([], Pose(x_m=x_m, z_m=SENSOR_Z_M, yaw_rad=yaw_rad), elevations_deg=ELEVATIONS_DEG)
    away = np.cos(yaw_rad) * points[:, 0] - np.sin(yaw_rad) * points[:, 1]
    kept = (x_m + away < edge_m) & (behind | (points[:, 0] > 0.0))
    return np.ascontiguousarray(points[kept])


def driven(model: FlatModel, places_m: NDArray[np.float64], edge_m: float = 3.0, **options: bool) -> None:
    for k, x in enumerate(places_m):
        model.roll_to(float(x), 0.0)
        model.integrate(
            PointCloud(
                stamp_ns=(k + 1) * SECOND_NS // 10,
                sensor_in_odom=Pose(x_m=float(x), z_m=SENSOR_Z_M),
                range_m=20.0,
                points_m=on_platform(float(x), edge_m, **options),
            )
        )


def states(model: FlatModel) -> NDArray[np.uint8]:
    return model.layers(Pose())[0].state


def column(model: FlatModel, x_m: float) -> int:
    return model.spec.cell_of(x_m, 0.0)[1]


def test_the_edge_of_a_platform_becomes_an_obstacle_before_the_robot_is_there() -> None:
    model = FlatModel(Config(window_m=16.0))
    driven(model, np.arange(-3.0, 1.6, 0.1))
    state = states(model)
    row = model.spec.cell_of(0.0, 0.0)[0]
    for r in range(row - 8, row + 9):
        edge = np.flatnonzero(state[r] == LETHAL)
        assert len(edge) >= 1, r
        assert abs(edge[0] - column(model, 3.0)) <= 2, r
        assert (state[r, column(model, -2.0) : edge[0]] == FREE).all()


def test_from_afar_the_edge_is_only_unknown() -> None:
    model = FlatModel(Config(window_m=16.0))
    driven(model, np.arange(-3.0, -1.5, 0.1))
    assert not (states(model) == LETHAL).any()
    assert (states(model)[:, column(model, 3.3)] == UNKNOWN).all()


def test_a_sensor_that_never_looked_there_says_nothing_of_it() -> None:
    model = FlatModel(Config(window_m=16.0))
    driven(model, np.arange(-3.0, 1.0, 0.1), edge_m=100.0, behind=False)
    assert not (states(model) == LETHAL).any()


def test_where_nothing_was_seen_yet_the_robot_is_not_walled_in() -> None:
    model = FlatModel(Config(window_m=16.0))
    driven(model, np.full(5, 2.9))
    state = states(model)
    row, here = model.spec.cell_of(2.9, 0.0)
    assert not (state[row - 3 : row + 4, here - 3 : here + 4] == LETHAL).any()


def test_ground_that_shows_after_all_is_free_again() -> None:
    model = FlatModel(Config(window_m=16.0))
    driven(model, np.arange(-3.0, 1.6, 0.1))
    assert (states(model) == LETHAL).any()
    for k in range(15):
        model.integrate(
            PointCloud(
                stamp_ns=(100 + k) * SECOND_NS // 10,
                sensor_in_odom=Pose(x_m=1.5, z_m=SENSOR_Z_M, yaw_rad=0.003 * k),
                range_m=20.0,
                points_m=on_platform(1.5, math.inf),
            )
        )
    assert not (states(model) == LETHAL).any()


def test_it_can_be_turned_off() -> None:
    model = FlatModel(Config(window_m=16.0, void_range_m=0.0))
    driven(model, np.arange(-3.0, 1.6, 0.1))
    assert not (states(model) == LETHAL).any()

"""What drifting odometry holds together: by the way driven, and by what closures show."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.grid import FREE, LETHAL, UNKNOWN
from schemas.base import Pose
from services.riskmap.config import Config
from services.riskmap.drift import Drift
from services.riskmap.flat_model import FlatModel
from tests.riskmap.helpers import cloud, rectangle

HERE = Pose()


def driven(drift: Drift, way_m: float, from_m: float = 0.0) -> float:
    for x in np.arange(from_m, from_m + way_m + 1e-9, 0.5):
        found = drift.drive(float(x), 0.0)
    return found


def test_the_way_is_counted_and_the_noise_of_a_standing_robot_is_not() -> None:
    drift, rng = Drift(30.0), np.random.default_rng(0)
    assert driven(drift, 12.0) == pytest.approx(12.0)
    for dx, dy in rng.normal(0.0, 0.02, (500, 2)):
        assert drift.drive(12.0 + dx, dy) == pytest.approx(12.0)
    assert drift.keeps_from_m() == pytest.approx(12.0 - 30.0)
    assert Drift(0.0).keeps_from_m() == -math.inf


def test_closures_that_move_the_robot_refute_what_is_older_than_ten_metres() -> None:
    drift = Drift(100.0)
    driven(drift, 50.0)
    drift.close(Pose(), HERE)
    drift.close(Pose(x_m=0.1), HERE)
    assert drift.keeps_from_m() == pytest.approx(-50.0)
    drift.close(Pose(x_m=0.1), HERE)
    drift.close(Pose(x_m=0.2), HERE)
    assert drift.keeps_from_m() == pytest.approx(40.0), "small ones add up"
    other = Drift(100.0)
    other.load(drift.state())
    assert other.state() == drift.state()
    driven(drift, 20.0, 50.0)
    assert drift.keeps_from_m() == pytest.approx(40.0), "what was seen since is kept"


def test_a_turn_of_the_frame_counts_by_where_the_robot_is() -> None:
    near, far = Drift(100.0), Drift(100.0)
    for drift, x_m in ((near, 1.0), (far, 40.0)):
        driven(drift, 50.0)
        drift.close(Pose(), Pose(x_m=x_m))
        drift.close(Pose(yaw_rad=0.02), Pose(x_m=x_m))
    assert near.keeps_from_m() < 0.0 < far.keeps_from_m()


@pytest.mark.parametrize("memory_m", [0.0, 8.0])
def test_the_map_forgets_what_was_not_seen_for_long_and_a_closure_the_rest(memory_m: float) -> None:
    """Along a corridor round a corner: the leg behind the corner is out of sight."""
    walls = [
        *rectangle(-2.0, -1.0, 14.0, 1.0)[1:],
        (-2.0, -1.0, 10.0, -1.0),
        (10.0, -1.0, 10.0, -14.0),
        (14.0, -14.0, 14.0, 1.0),
    ]
    walls.append((10.0, -14.0, 14.0, -14.0))
    model = FlatModel(Config(window_m=40.0, odometry_memory_m=memory_m))
    model.located(Pose(), HERE)
    way = [(float(x), 0.0) for x in np.arange(0.0, 12.0, 0.4)] + [
        (12.0, float(y)) for y in np.arange(0.0, -12.4, -0.4)
    ]
    for k, (x, y) in enumerate(way):
        model.roll_to(x, y)
        model.integrate(cloud(walls, x, y, (k + 1) * 100_000_000))

    def state(x_m: float, y_m: float) -> int:
        return int(model.layers(Pose())[0].state[model.spec.cell_of(x_m, y_m)])

    assert state(12.0, -8.0) == FREE
    assert state(5.0, 0.0) == (UNKNOWN if memory_m else FREE)
    assert state(5.0, 1.0) == (UNKNOWN if memory_m else LETHAL)
    model.located(Pose(x_m=0.5), Pose(x_m=12.0, y_m=-12.0))
    model.integrate(cloud(walls, 12.0, -12.0, 10_000_000_000))
    assert state(12.0, -8.0) == FREE
    assert state(5.0, 0.0) == UNKNOWN

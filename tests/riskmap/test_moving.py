"""What moves: people and doors that come into free ground are told at once, walls never, and nobody leaves a ghost."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.sensing import PointCloud
from services.riskmap.config import Config
from services.riskmap.flat_model import FlatModel
from tests.riskmap.helpers import SENSOR_Z_M, Wall, rectangle, sweep

HALL = rectangle(-6.0, -4.0, 6.0, 4.0)
TENTH = SECOND_NS // 10
NOISE_M = 0.01


def person(x_m: float, y_m: float, radius_m: float = 0.3) -> list[Wall]:
    """A round person as twelve flat sides."""
    angles = 2.0 * math.pi * np.arange(13) / 12
    x, y = x_m + radius_m * np.cos(angles), y_m + radius_m * np.sin(angles)
    return [(x[k], y[k], x[k + 1], y[k + 1]) for k in range(12)]


@dataclass
class Watched:
    """A flat risk map that is shown sweeps with noise, ten a second."""

    config: Config = field(default_factory=lambda: Config(window_m=16.0))

    def __post_init__(self) -> None:
        self.model = FlatModel(self.config)
        self.rng = np.random.default_rng(5)
        self.ticks = 0

    def look(
        self, walls: list[Wall], x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0
    ) -> NDArray[np.float32]:
        """What moves in the next sweep."""
        self.ticks += 1
        true = Pose(x_m=x_m, y_m=y_m, z_m=SENSOR_Z_M, yaw_rad=yaw_rad)
        points = sweep(walls, true)
        points += self.rng.normal(0.0, NOISE_M, points.shape).astype(np.float32)
        dx, dy, turned = self.rng.normal(0.0, [0.01, 0.01, 0.002])
        told = Pose(x_m=x_m + dx, y_m=y_m + dy, z_m=SENSOR_Z_M, yaw_rad=yaw_rad + turned)
        self.model.roll_to(x_m, y_m)
        self.model.integrate(
            PointCloud(stamp_ns=self.ticks * TENTH, sensor_in_odom=told, range_m=20.0, points_m=points)
        )
        return self.model.moving_m

    def state(self, x_m: float, y_m: float) -> int:
        layers, _ = self.model.layers(Pose())
        return int(layers.state[self.model.spec.cell_of(x_m, y_m)])


def looked(seconds: float = 2.0) -> Watched:
    """Long enough at the empty hall."""
    watched = Watched()
    for _ in range(round(10 * seconds)):
        assert len(watched.look(HALL)) == 0
    return watched


def test_somebody_who_walks_is_told_in_every_sweep_and_lies_on_their_surface() -> None:
    watched = looked()
    for k in range(60):
        x, y = 3.0 - 0.06 * k, 1.5
        found = watched.look(HALL + person(x, y))
        assert len(found) >= 3, k
        off = np.hypot(found[:, 0] - x, found[:, 1] - y)
        assert np.abs(off - 0.3).max() < 0.12, k
        assert np.hypot(*found.T).min() < math.hypot(x, y) - 0.2, "the near side"


def test_somebody_who_comes_straight_on_is_told_too() -> None:
    watched = looked()
    for k in range(40):
        x = 4.0 - 0.08 * k
        found = watched.look(HALL + person(x, 0.0))
        assert len(found) >= 3 and abs(float(found[:, 0].min()) - (x - 0.3)) < 0.1, k


def test_who_stays_becomes_an_obstacle_and_no_longer_moves_and_who_leaves_is_forgotten() -> None:
    watched = looked()
    for k in range(30):
        found = watched.look(HALL + person(2.0, 0.5))
        assert (len(found) > 0) == (k < round(10 * watched.config.settle_s) + 3) or 15 < k < 22, k
    assert watched.state(1.73, 0.43) == LETHAL
    gone = [watched.look(HALL) for _ in range(15)]
    assert all(len(found) == 0 for found in gone)
    layers, _ = watched.model.layers(Pose())
    s = watched.model.spec
    near = np.hypot(s.centres_x() - 2.0, s.centres_y()[:, None] - 0.5) < 0.6
    assert (layers.state[near] == FREE).all(), "no ghost"
    assert len(watched.look(HALL + person(2.0, 0.5))) >= 3, "whoever comes back there moves again"


def test_a_door_that_closes_is_told() -> None:
    watched = looked()
    found = watched.look([*HALL, (2.0, -1.0, 2.0, 1.0)])
    assert len(found) >= 10
    assert np.abs(found[:, 0] - 2.0).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_walls_that_come_into_view_do_not_move(seed: int) -> None:
    """A drive with noise through a door into a room full of corners, and back."""
    rooms = [
        *HALL,
        (1.0, -4.0, 1.0, -0.5),
        (1.0, 0.5, 1.0, 4.0),
        *rectangle(3.0, 1.0, 4.0, 2.5),
        *person(4.0, -2.0),
    ]
    watched = Watched()
    watched.rng = np.random.default_rng(seed)
    for k in range(160):
        along = 8.0 * (1.0 - abs(1.0 - k / 80.0))
        yaw = 0.3 * math.sin(0.2 * k) + (math.pi if k > 80 else 0.0)
        found = watched.look(rooms, -4.0 + along, 0.2 * math.sin(0.1 * k), yaw)
        assert len(found) == 0, (k, found)


def test_beyond_the_range_and_before_the_ground_is_known_nothing_moves() -> None:
    watched = looked()
    assert len(watched.look(HALL + person(-5.0, 3.0))) > 0
    short = Watched(Config(window_m=16.0, moving_range_m=3.0))
    for _ in range(20):
        short.look(HALL)
    assert len(short.look(HALL + person(-5.0, 3.0))) == 0
    assert len(Watched().look(HALL + person(2.0, 0.0))) == 0

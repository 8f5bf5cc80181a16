"""LiDAR ranges against analytic geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.sim.config import LidarConfig
from services.sim.lidar import Lidar
from services.sim.world import WALL_HEIGHT_M
from tests.sim.helpers import box, with_walls

CLEAN = LidarConfig(range_noise_m=0.0, dropout_probability=0.0)
LEVEL = LidarConfig(
    rings=1, elevation_min_deg=0.0, elevation_max_deg=0.0, range_noise_m=0.0, dropout_probability=0.0
)


def _wall_distance(x: float, y: float, angle: float, width: float, height: float) -> float:
    dx, dy = math.cos(angle), math.sin(angle)
    ways = [(width - x) / dx if dx > 0 else -x / dx] if abs(dx) > 1e-12 else []
    ways += [(height - y) / dy if dy > 0 else -y / dy] if abs(dy) > 1e-12 else []
    return min(ways)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_level_ring_in_an_empty_room(yaw: float) -> None:
    ranges = Lidar(box(12.0, 7.0), LEVEL).ranges(3.13, 4.21, yaw)[:, 0]
    for k in range(0, 900, 7):
        expected = _wall_distance(3.13, 4.21, yaw + 2 * math.pi * k / 900, 12.0, 7.0)
        assert ranges[k] == pytest.approx(expected, abs=1e-9)


def test_rings_hit_ground_wall_or_nothing() -> None:
    lidar, x, y = Lidar(box(30.0, 30.0), CLEAN), 21.0, 15.0
    ranges = lidar.ranges(x, y, 0.0)
    elevations = np.radians(np.linspace(-15, 15, 16))
    for a in range(0, 900, 11):
        wall = _wall_distance(x, y, 2 * math.pi * a / 900, 30.0, 30.0)
        for k, elevation in enumerate(elevations):
            along = wall if 0.8 + wall * math.tan(elevation) <= WALL_HEIGHT_M else math.inf
            if elevation < 0:
                along = min(along, 0.8 / math.tan(-elevation))
            expected = along / math.cos(elevation)
            assert ranges[a, k] == pytest.approx(expected if expected <= 20.0 else math.inf, abs=1e-9)


def test_a_wall_hides_what_is_behind() -> None:
    world = with_walls(box(12.0, 8.0), (6.0, 3.0, 6.2, 5.0))
    ranges = Lidar(world, LEVEL).ranges(3.0, 4.0, 0.0)[:, 0]
    assert ranges[0] == pytest.approx(3.0)
    assert ranges[450] == pytest.approx(3.0)  # behind the robot: the room's own wall
    past_edge = math.ceil(math.atan2(1.0, 3.0) / (2 * math.pi / 900)) + 1
    assert ranges[past_edge] > 5.0


def test_points_lie_in_the_sensor_frame() -> None:
    rng = np.random.default_rng(0)
    points = Lidar(box(12.0, 7.0), LEVEL).scan(3.0, 3.5, math.pi / 2, rng)
    assert points.dtype == np.float32
    assert points.shape == (900, 3)
    # Facing +y, the wall 3 m to the west is on the left, the one 3.5 m to the north ahead.
    assert points[:, 0].max() == pytest.approx(3.5, abs=1e-5)
    assert points[:, 1].max() == pytest.approx(3.0, abs=1e-5)
    assert points[:, 1].min() == pytest.approx(-9.0, abs=1e-5)
    assert not points[:, 2].any()


def test_ground_points_lie_on_the_ground_and_beyond_range_there_is_nothing() -> None:
    points = Lidar(box(100.0, 100.0), CLEAN).scan(50.0, 50.0, 0.0, np.random.default_rng(0))
    assert points[:, 2] == pytest.approx(-0.8, abs=1e-5)
    assert np.linalg.norm(points, axis=1).max() <= 20.0 + 1e-5


def test_noise_and_dropouts_have_their_statistics_and_their_seed() -> None:
    config = LidarConfig(range_noise_m=0.05, dropout_probability=0.2)
    lidar = Lidar(box(8.0, 8.0), config)
    clean = Lidar(box(8.0, 8.0), CLEAN).ranges(4.0, 4.0, 0.0)
    points = lidar.scan(4.0, 4.0, 0.0, np.random.default_rng(1))
    assert len(points) == pytest.approx(0.8 * np.isfinite(clean).sum(), rel=0.03)
    assert (points == lidar.scan(4.0, 4.0, 0.0, np.random.default_rng(1))).all()
    other = lidar.scan(4.0, 4.0, 0.0, np.random.default_rng(2))
    assert other.shape != points.shape or (other != points).any()
    noisy = LidarConfig(range_noise_m=0.05, dropout_probability=0.0)
    with_noise = Lidar(box(8.0, 8.0), noisy).scan(4.0, 4.0, 0.0, np.random.default_rng(1))
    error = np.linalg.norm(with_noise, axis=1) - clean[np.isfinite(clean)]
    assert error.std() == pytest.approx(0.05, rel=0.05)
    assert abs(error.mean()) < 0.002

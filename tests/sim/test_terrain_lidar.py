"""LiDAR over uneven ground against a brute-force ray marcher and against plane geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.grid import GridSpec
from services.sim.config import LidarConfig
from services.sim.lidar import Lidar
from services.sim.terrain import rotation, terrain_of
from services.sim.terrain_lidar import bounds_of, cast_rays
from services.sim.world import World
from tests.sim.helpers import box, with_walls
from tests.sim.terrains import bilinear, ground, march, ramp

FEW = LidarConfig(
    rings=7, azimuths=12, range_m=6.0, elevation_min_deg=-40.0, elevation_max_deg=40.0, range_noise_m=0.0,
    dropout_probability=0.0,
)  # fmt: skip
STEP_M = 0.002


def _rough_world(seed: int) -> World:
    rng = np.random.default_rng(seed)
    spec = GridSpec(float(rng.choice([0.1, 0.2])), -7, 5, 40, 36)
    floor = rng.normal(0.0, 0.15, spec.shape).astype(np.float32)
    ceiling = (1.6 + rng.normal(0.0, 0.2, spec.shape)).astype(np.float32)
    ceiling[rng.random(spec.shape) < 0.1] = np.inf
    occupied = rng.random(spec.shape) < 0.04
    row, column = 18, 20
    occupied[row - 2 : row + 3, column - 2 : column + 3] = False
    floor[row - 2 : row + 3, column - 2 : column + 3] = 0.0
    return World("rough", spec, occupied, (*spec.centre_of(row, column), 0.0), floor, ceiling)


@given(st.integers(0, 10_000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0))
@settings(max_examples=6, deadline=None)
def test_every_range_is_that_of_the_marcher(seed: int, roll: float, pitch: float, yaw: float) -> None:
    world = _rough_world(seed)
    x_m, y_m, _ = world.start
    lidar = Lidar(world, FEW)
    ranges = lidar.ranges(x_m, y_m, yaw, 0.0, roll, pitch)
    turn = rotation(roll, pitch, yaw)
    origin = np.array([x_m, y_m, 0.0]) + turn[:, 2] * FEW.height_m
    elevations = np.radians(np.linspace(-40.0, 40.0, 7))
    for a in range(12):
        azimuth = 2 * math.pi * a / 12
        for k, e in enumerate(elevations):
            level = math.cos(e)
            way = turn @ np.array([math.cos(azimuth) * level, math.sin(azimuth) * level, math.sin(e)])
            marched = march(world, origin, way, FEW.range_m, STEP_M)
            # No farther than the marcher's; nearer only where it stepped over a corner that is really there.
            assert ranges[a, k] < marched + 1e-4 or math.isinf(marched)
            if ranges[a, k] < marched - STEP_M - 1e-4:
                assert march(world, origin + way * (ranges[a, k] - 1e-5), way, 2e-5, 1e-7) < math.inf


@given(st.integers(0, 10_000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_striding_over_clear_regions_changes_no_bit(seed: int, roll: float, pitch: float, yaw: float) -> None:
    """Against the walk patch by patch, which regions that are never clear leave."""
    world = _rough_world(seed)
    terrain = terrain_of(world)
    bounds = bounds_of(world.occupied, terrain)
    never = np.full((0, 0, 2), 1e30, dtype=np.float32)
    elevations, azimuths = np.radians(np.linspace(-40.0, 40.0, 9)), np.linspace(0.0, 6.2, 60)
    directions = np.empty((60, 9, 3), dtype=np.float32)
    directions[..., 0] = np.cos(azimuths)[:, None] * np.cos(elevations)
    directions[..., 1] = np.sin(azimuths)[:, None] * np.cos(elevations)
    directions[..., 2] = np.sin(elevations)
    x, y = world.to_cells(*world.start[:2])
    rest = (
        np.array([x + 0.3, y - 0.2, 0.7]), rotation(roll, pitch, yaw), directions,
        np.array([world.spec.resolution_m, 4.0]),
    )  # fmt: skip
    fast = cast_rays(world.occupied, terrain, bounds, *rest)
    plain = cast_rays(world.occupied, terrain, bounds._replace(coarse=never, fine=never), *rest)
    assert np.array_equal(fast, plain)
    assert (bounds.fine[..., 0] < 1e29).any()


def test_points_of_a_slope_lie_on_it_whatever_the_lean() -> None:
    world = ground(20.0, 20.0, lambda x, y: 0.2 * x - 0.1 * y, (10.0, 10.0, 0.0))
    config = LidarConfig(range_m=8.0, range_noise_m=0.0, dropout_probability=0.0)
    z, roll, pitch, yaw = 1.0, 0.2, -0.25, 0.7
    points = Lidar(world, config).scan(10.0, 10.0, yaw, np.random.default_rng(0), z, roll, pitch)
    turn = rotation(roll, pitch, yaw)
    placed = points @ turn.T + np.array([10.0, 10.0, z]) + turn[:, 2] * config.height_m
    assert len(placed) > 2000
    assert placed[:, 2] == pytest.approx(0.2 * placed[:, 0] - 0.1 * placed[:, 1], abs=1e-4)


def test_a_level_floor_gives_the_ranges_of_a_flat_world() -> None:
    walls = (6.0, 3.0, 6.2, 5.0)
    level = ground(12.0, 8.0, lambda x, y: 0.0 * x, (3.0, 4.0, 0.0), walls=(walls,))
    config = LidarConfig(elevation_max_deg=5.0, range_noise_m=0.0, dropout_probability=0.0)
    one = Lidar(level, config).ranges(3.03, 4.01, 0.4)
    other = Lidar(with_walls(box(12.0, 8.0), walls), config).ranges(3.03, 4.01, 0.4)
    assert one == pytest.approx(other, abs=1e-5)


def test_the_ceiling_returns_and_its_hole_does_not() -> None:
    world = ground(
        20.0, 6.0, lambda x, y: 0.0 * x, (5.0, 3.0, 0.0),
        ceiling=lambda x, y: np.where((x > 8.0) & (x < 10.0), np.inf, 2.0),
    )  # fmt: skip
    up = LidarConfig(
        rings=2, elevation_min_deg=20.0, elevation_max_deg=30.0, range_noise_m=0.0, dropout_probability=0.0
    )
    ranges = Lidar(world, up).ranges(5.0, 3.0, 0.0)[0]
    assert ranges[1] == pytest.approx(1.2 / math.sin(math.radians(30.0)), abs=1e-6)
    # The lower ring reaches the hole after 3.3 m, above its edge at 2 m, and the rim of the hole behind.
    assert ranges[0] > 3.2 / math.cos(math.radians(20.0))


def test_the_far_side_of_a_hill_is_hidden() -> None:
    world = ground(20.0, 4.0, lambda x, y: 1.5 * np.exp(-(((x - 6.0) / 1.0) ** 2)) + 0 * y, (2.0, 2.0, 0.0))
    config = LidarConfig(range_noise_m=0.0, dropout_probability=0.0)
    points = Lidar(world, config).scan(2.0, 2.0, 0.0, np.random.default_rng(0))
    ahead = points[(np.abs(points[:, 1]) < 0.5) & (points[:, 0] > 0.0) & (points[:, 2] < 0.2)]
    hidden = (ahead[:, 0] > 4.2) & (ahead[:, 0] < 6.0)
    assert not hidden.any()
    assert ((ahead[:, 0] > 2.0) & (ahead[:, 0] < 4.1)).any()


def test_the_surface_is_continuous_across_cells() -> None:
    world = ground(10.0, 4.0, ramp(0.4, 3.0), (1.0, 2.0, 0.0))
    assert world.floor_m is not None
    heights = bilinear(
        world, world.floor_m, np.linspace(2.5, 3.997, 500), np.full(500, 2.0, dtype=np.float64)
    )
    assert np.abs(np.diff(heights)).max() < 0.003 * math.tan(0.4) + 1e-6

"""Cave and lava tube: as large, as rough and as passable as promised, and the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from services.sim.cave import cave_plan
from services.sim.config import CoverageSensorConfig, RobotConfig, SimConfig
from services.sim.coverage import Judge
from services.sim.lava_tube import tube_plan
from services.sim.terrain_start import standing_ground
from services.sim.world import StartError, World, WorldError
from services.sim.worlds import build_world, make_world
from tests.sim.helpers import box

SEEDS = [0, 1, 5]
NAMES = ("cave", "lava_tube")


def _area_m2(world: World) -> float:
    return float(np.count_nonzero(~world.occupied)) * world.spec.resolution_m**2


@pytest.mark.parametrize("name", NAMES)
def test_worlds_are_their_seed(name: str) -> None:
    world, again, other = make_world(name, 3), make_world(name, 3), make_world(name, 4)
    for field in ("occupied", "floor_m", "ceiling_m"):
        assert getattr(world, field).tobytes() == getattr(again, field).tobytes()
    assert world.start == again.start
    assert world.spec != other.spec or (world.occupied != other.occupied).any()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("profile", ["husky", "spot"])
def test_most_of_the_floor_is_reachable_and_real_hazards_are_beside_it(
    name: str, seed: int, profile: str
) -> None:
    world = make_world(name, seed)
    robot = RobotConfig.model_validate({"profile": profile})
    judge = Judge(world, robot.footprint_radius_m, CoverageSensorConfig(), robot)
    assert 0.8 * _area_m2(world) < judge.reachable_area_m2 < 0.92 * _area_m2(world)
    assert world.floor_m is not None
    floor, cell = world.floor_m, world.spec.resolution_m
    slope = np.hypot(*np.gradient(floor, cell))
    inside = ndimage.binary_erosion(~world.occupied, iterations=2)
    way = ndimage.binary_dilation(judge.reachable, iterations=8)
    steep = np.count_nonzero(inside & way & (slope > np.tan(robot.tip_pitch_rad))) * cell**2
    assert steep > 10.0  # square metres of ground within reach of the way that would break it


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", SEEDS)
def test_the_start_is_level_and_has_room(name: str, seed: int) -> None:
    world = make_world(name, seed)
    assert world.floor_m is not None
    x_m, y_m, _ = world.start
    spec = world.spec
    away = np.hypot(spec.centres_x() - x_m, spec.centres_y()[:, None] - y_m)
    near = away < 3.5
    assert not world.occupied[near].any()
    assert np.abs(world.floor_m[near]).max() < 0.02
    assert standing_ground(world, RobotConfig(profile="husky"))[away < 3.0].all()


@pytest.mark.parametrize("seed", range(10))
def test_sizes(seed: int) -> None:
    _, passages = cave_plan(np.random.default_rng([seed, 103]))
    galleries = [p for p in passages if p.length_m > 5.0]
    assert sum(p.length_m for p in galleries) > 400.0
    narrowest = [float(p.half_width_m.min()) * 2.0 for p in galleries]
    assert min(narrowest) < 0.67  # too narrow for the Husky
    assert any(1.0 <= width < 1.6 for width in narrowest)
    tube, *pockets = tube_plan(np.random.default_rng([seed, 104]))
    assert 200.0 < tube.length_m < 300.0
    assert 2.0 * tube.half_width_m.min() >= 6.0 and 2.0 * tube.half_width_m.max() <= 15.0
    assert len(pockets) >= 5


@pytest.mark.parametrize("seed", SEEDS)
def test_the_tube_is_broad(seed: int) -> None:
    assert _area_m2(make_world("lava_tube", seed)) > 2000.0


def test_a_start_in_a_hazard_is_refused_with_the_nearest_good_one() -> None:
    world = make_world("cave", 2)
    assert world.floor_m is not None
    bad = ~world.occupied & ~ndimage.binary_dilation(standing_ground(world, RobotConfig()), iterations=4)
    row, column = np.argwhere(bad)[0].tolist()
    x_m, y_m = world.spec.centre_of(row, column)
    config = SimConfig.model_validate({"world": "cave", "seed": 2, "start": {"x_m": x_m, "y_m": y_m}})
    with pytest.raises(StartError, match=r"the nearest that is not lies [\d.]+ m away"):
        build_world(config)


def test_heights_must_fit_and_be_finite() -> None:
    flat = box(4.0, 4.0)
    heights = np.zeros(flat.spec.shape, np.float32)
    with pytest.raises(WorldError, match="ceiling but no floor"):
        World("w", flat.spec, flat.occupied, flat.start, None, heights)
    with pytest.raises(WorldError, match="floor_m is float64"):
        World("w", flat.spec, flat.occupied, flat.start, heights.astype(np.float64))
    hole = heights.copy()
    hole[3, 3] = np.nan
    with pytest.raises(WorldError, match="free cell has no height"):
        World("w", flat.spec, flat.occupied, flat.start, hole)
    solid = flat.occupied.copy()
    solid[3, 3] = True
    filled = World("w", flat.spec, solid, flat.start, hole).floor_m
    assert filled is not None and filled[3, 3] == 0.0

"""The built-in worlds: sizes as promised, connected, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from services.sim.config import CoverageSensorConfig, SimConfig, Start
from services.sim.coverage import Judge
from services.sim.world import StartError, UnknownWorldError, World, WorldError
from services.sim.worlds import build_world, make_world, subway, with_start
from tests.sim.helpers import box

SEEDS = [0, 1, 2, 3, 7, 1234, 2**40]
STATIONS_AND_MAZE = ("subway_1x", "subway_2x", "subway_3x", "maze")


def _reachable_area_m2(world: World) -> float:
    return Judge(world, 0.335, CoverageSensorConfig()).reachable_area_m2


@pytest.mark.parametrize("name", STATIONS_AND_MAZE)
@pytest.mark.parametrize("seed", SEEDS[:4])
def test_worlds_are_their_seed(name: str, seed: int) -> None:
    world, again, other = make_world(name, seed), make_world(name, seed), make_world(name, seed + 1)
    assert world.spec == again.spec
    assert world.start == again.start
    assert (world.occupied == again.occupied).all()
    assert world.spec != other.spec or (world.occupied != other.occupied).any()


@pytest.mark.parametrize("name", STATIONS_AND_MAZE)
@pytest.mark.parametrize("seed", SEEDS)
def test_worlds_are_connected_and_walled(name: str, seed: int) -> None:
    world = make_world(name, seed)
    _, parts = ndimage.label(~world.occupied)
    assert parts == 1
    rim = [world.occupied[0], world.occupied[-1], world.occupied[:, 0], world.occupied[:, -1]]
    assert all(edge.all() for edge in rim)
    free_m2 = np.count_nonzero(~world.occupied) * world.spec.resolution_m**2
    assert _reachable_area_m2(world) > 0.97 * free_m2


@pytest.mark.parametrize("seed", SEEDS)
def test_subway_sizes(seed: int) -> None:
    areas = [_reachable_area_m2(subway(seed, scale)) for scale in (1, 2, 3)]
    assert areas[0] >= 2100.0
    assert areas[1] == pytest.approx(2.0 * areas[0], rel=0.05)
    assert areas[2] == pytest.approx(3.0 * areas[0], rel=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_maze_is_about_sixty_metres_with_loops_and_dead_ends(seed: int) -> None:
    world = make_world("maze", seed)
    assert 55.0 < world.spec.width * world.spec.resolution_m < 65.0
    assert 55.0 < world.spec.height * world.spec.resolution_m < 65.0
    depth = ndimage.distance_transform_edt(~world.occupied) * world.spec.resolution_m
    assert depth.max() < 3.0  # corridors, no halls
    # Loops enclose islands of wall: count the parts of wall that do not touch the rim.
    _, walls = ndimage.label(world.occupied, structure=np.ones((3, 3)))
    assert walls >= 3


def test_unknown_names_and_scales_are_refused() -> None:
    with pytest.raises(UnknownWorldError, match=r"'subwy' is not one of subway_1x, .*maze"):
        make_world("subwy", 0)
    with pytest.raises(WorldError, match="scale 4"):
        subway(0, 4)


def test_a_start_must_have_room() -> None:
    world = make_world("maze", 0)
    x_m, y_m, _ = world.start
    moved = with_start(world, x_m + 0.2, y_m, 7.0)
    assert moved.start == pytest.approx((x_m + 0.2, y_m, 7.0 - 2 * np.pi))
    with pytest.raises(StartError, match="inside a wall"):
        with_start(world, -3.0, -3.0)
    with pytest.raises(StartError, match="outside the map"):
        with_start(world, 500.0, 0.0)
    with pytest.raises(StartError, match="not finite"):
        with_start(world, float("nan"), 0.0)
    with pytest.raises(StartError, match=r"does not fit, the nearest wall is 0\.30 m"):
        with_start(box(4.0, 4.0), 0.3, 2.0)
    assert with_start(box(4.0, 4.0), 0.335, 2.0).start[:2] == (0.335, 2.0)


def test_the_default_yaw_looks_along_the_room() -> None:
    assert with_start(box(2.0, 9.0), 1.0, 2.0).start[2] == pytest.approx(np.pi / 2, abs=0.25)
    assert with_start(box(9.0, 2.0), 7.0, 1.0).start[2] == pytest.approx(np.pi, abs=0.25) or (
        with_start(box(9.0, 2.0), 7.0, 1.0).start[2] == pytest.approx(-np.pi, abs=0.25)
    )


def test_a_configuration_builds_its_world() -> None:
    assert build_world(SimConfig(world="maze", seed=3)).start == make_world("maze", 3).start
    with pytest.raises(StartError, match="inside a wall"):
        build_world(SimConfig(world="maze", seed=3, start=Start(x_m=-3.0, y_m=-3.0)))

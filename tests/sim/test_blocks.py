"""Blocks that come down before the robot: where they are, when they come, and that there is a way round."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import ndimage

from services.sim.blocks import subway_blocks
from services.sim.scene import Scene
from services.sim.subway import subway
from services.sim.world import Door
from tests.sim.helpers import box

SEEDS = [1, 2, 3, 101]


@pytest.mark.parametrize("seed", SEEDS)
def test_blocks_keep_apart_and_never_shut_anything_in(seed: int) -> None:
    world = subway_blocks(seed)
    assert world.name == "subway_blocks"
    assert (world.occupied == subway(seed, 1).occupied).all()
    middles = [((d.area_m[0] + d.area_m[2]) / 2.0, (d.area_m[1] + d.area_m[3]) / 2.0) for d in world.doors]
    assert 35 <= len(middles) <= 60
    assert min(math.dist(a, b) for a, b in itertools.combinations(middles, 2)) >= 3.5
    assert min(math.dist(m, world.start[:2]) for m in middles) > 5.0
    scene = Scene(world)
    scene.set_closed([True] * len(world.doors))
    assert scene.closed_areas_m() == tuple(door.area_m for door in world.doors)
    room_m = ndimage.distance_transform_edt(~scene.occupied) * world.spec.resolution_m
    _, parts = ndimage.label(room_m > 0.35)  # a Husky's disc
    assert parts == 1, "a block shuts something in"


def test_a_block_comes_down_when_the_robot_is_near_and_is_not_under_it() -> None:
    world = subway_blocks(1)
    scene, door = Scene(world), world.doors[0]
    x, y = door.area_m[2], (door.area_m[1] + door.area_m[3]) / 2.0
    others = [d for d in world.doors[1:] if d.gap_m(x + 3.2, y) > 3.0 and d.gap_m(x + 2.9, y) > 3.0]
    assert door.area_m not in scene.closed_areas_m()
    scene.advance(5.0, (x + 3.2, y), 0.25)
    assert door.area_m not in scene.closed_areas_m()
    assert scene.advance(6.0, (x + 2.9, y), 0.25)
    assert door.area_m in scene.closed_areas_m()
    assert not {d.area_m for d in others} & set(scene.closed_areas_m())


@pytest.mark.parametrize(
    ("x", "y", "gap"), [(1.5, 1.5, 0.0), (3.0, 1.5, 1.0), (1.5, 0.0, 1.0), (5.0, 6.0, 5.0), (0.0, 1.0, 1.0)]
)
def test_the_gap_to_a_rectangle(x: float, y: float, gap: float) -> None:
    assert Door((1.0, 1.0, 2.0, 2.0), 0.0).gap_m(x, y) == pytest.approx(gap)


def test_a_door_without_a_distance_closes_wherever_the_robot_is() -> None:
    room = box(12.0, 4.0)
    assert np.isinf(Door((6.0, 0.0, 6.2, 4.0), 1.0).closes_within_m)
    world = type(room)(
        "d", room.spec, room.occupied, (2.0, 2.0, 0.0), doors=(Door((6.0, 0.0, 6.2, 4.0), 1.0),)
    )
    assert Scene(world).advance(1.0, None, 0.25)
    near = type(room)(
        "d", room.spec, room.occupied, (2.0, 2.0, 0.0), doors=(Door((6.0, 0.0, 6.2, 4.0), 0.0, 2.0),)
    )
    assert not Scene(near).advance(9.0, None, 0.25)
    assert not Scene(near).advance(9.0, (3.9, 2.0), 0.25)
    assert Scene(near).advance(9.0, (4.1, 2.0), 0.25)

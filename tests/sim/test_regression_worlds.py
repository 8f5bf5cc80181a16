"""The named regression worlds keep the trait they are named for; people walk and doors close with mission time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.robot_profile import PROFILES
from services.sim.config import CoverageSensorConfig, LidarConfig, SimConfig
from services.sim.coverage import Judge
from services.sim.geometry import ray_length
from services.sim.lidar import Lidar
from services.sim.regression_worlds import (
    closing_door,
    dead_end,
    loop,
    map_edge,
    maze_bend,
    moving_person,
    narrow_sensor,
    unknown_start,
    unreachable_slit,
)
from services.sim.robot import Robot
from services.sim.scene import Scene
from services.sim.world import Door, Mover, World
from services.sim.worlds import WORLD_NAMES, make_world
from tests.sim.helpers import box, brute_clearance_m
from tests.sim.terrains import ground

MAKERS = (
    unreachable_slit, unknown_start, maze_bend, dead_end, narrow_sensor, moving_person, closing_door, map_edge, loop,
)  # fmt: skip
CLEAN = LidarConfig(range_noise_m=0.0, dropout_probability=0.0)


def _judge(world: World, radius_m: float = 0.335) -> Judge:
    return Judge(world, radius_m, CoverageSensorConfig())


@pytest.mark.parametrize("maker", MAKERS)
def test_each_has_its_name_and_room_for_both_robots(maker: object) -> None:
    assert callable(maker)
    world = maker()
    assert world.name in WORLD_NAMES
    assert make_world(world.name, 7).start == world.start
    for profile in PROFILES.values():
        assert _judge(world, profile.footprint_radius_m).reachable_area_m2 > 80.0


def test_a_beam_passes_the_slit_and_no_robot() -> None:
    world = unreachable_slit()
    x, y = world.to_cells(3.0, 5.0)
    assert ray_length(world.occupied, x, y, 1.0, 0.0, 400.0) * 0.1 > 15.0
    for profile in PROFILES.values():
        judge = _judge(world, profile.footprint_radius_m)
        assert not judge.reachable[:, world.spec.cell_of(13.5, 0.0)[1] :].any()


def test_no_ground_near_the_unknown_start_is_seen() -> None:
    world = unknown_start()
    points = Lidar(world, CLEAN).scan(*world.start, np.random.default_rng(0))
    on_ground = points[points[:, 2] < -0.75]
    assert len(on_ground) > 0
    assert np.hypot(on_ground[:, 0], on_ground[:, 1]).min() > 2.5
    assert brute_clearance_m(world, *world.start[:2]) < 0.5


def test_the_dead_end_is_long_and_the_loop_closes() -> None:
    world = dead_end()
    assert world.spec.width * 0.1 > 50.0
    ring = loop()
    judge = _judge(ring)
    assert judge.reachable[ring.spec.cell_of(-12.0, 0.0)]
    assert ring.occupied[ring.spec.cell_of(0.0, 0.0)]


def test_the_map_edge_returns_nothing_and_stops_the_robot() -> None:
    world = map_edge()
    ranges = Lidar(world, CLEAN).ranges(-5.0, 0.0, 0.0)
    assert math.isinf(ranges[450, 8:].min())  # backwards, level and upwards: 3 m to the border
    assert ranges[0, 8] == pytest.approx(6.0 / math.cos(math.radians(1.0)))  # the wall inside
    points = Lidar(world, CLEAN).scan(-5.0, 0.0, 0.0, np.random.default_rng(0))
    assert (points[:, 0] - 5.0).min() > -8.0
    robot = Robot(world, SimConfig(slip_fraction=0.0), np.random.default_rng(0))
    for _ in range(150):
        robot.step(-0.3, 0.0, 0.1)
    assert robot.state.blocked
    assert robot.state.x_m >= -8.0 + 0.25 - 1e-9


def test_a_mover_walks_to_and_fro() -> None:
    mover = Mover((1.0, 2.0), (4.0, 6.0), 0.5)
    assert mover.at(0.0) == (1.0, 2.0)
    assert mover.at(5.0) == pytest.approx((2.5, 4.0))
    assert mover.at(10.0) == pytest.approx((4.0, 6.0))
    assert mover.at(15.0) == pytest.approx((2.5, 4.0))
    assert mover.at(1020.0) == pytest.approx(mover.at(0.0))


@pytest.mark.parametrize("rough", [False, True])
def test_the_lidar_sees_a_person_where_it_is_then(rough: bool) -> None:
    base = ground(12.0, 6.0, lambda x, y: 0.0 * x, (2.0, 3.0, 0.0)) if rough else box(12.0, 6.0)
    world = World(
        "person", base.spec, base.occupied, (2.0, 3.0, 0.0), base.floor_m,
        movers=(Mover((6.0, 3.0), (10.0, 3.0), 1.0),),
    )  # fmt: skip
    scene = Scene(world)
    lidar = Lidar(world, CLEAN, scene)
    for now_s, away in ((0.0, 4.0), (2.0, 6.0)):
        scene.advance(now_s, (2.0, 3.0), 0.25)
        ranges = lidar.ranges(2.0, 3.0, 0.0)
        for ring, slope in ((7, -1.0), (8, 1.0)):
            expected = (away - 0.3) / math.cos(math.radians(slope))
            assert ranges[0, ring] == pytest.approx(expected, abs=1e-5)
        assert ranges[0, 15] > expected  # over its head: 0.8 m + 3.7 m x tan 15 degrees
        assert ranges[450, 8] == pytest.approx(2.0 / math.cos(math.radians(1.0)), abs=1e-4)
        half = math.asin(0.3 / away) / (2 * math.pi / 900)
        hits = np.flatnonzero(ranges[:, 8] < away)
        assert set(range(math.floor(half))) <= set(hits.tolist())
        assert math.ceil(half) + 1 not in hits


def _met(speed_mps: float, mover: Mover) -> Robot:
    world = World("p", box(12.0, 6.0).spec, box(12.0, 6.0).occupied, (2.0, 3.0, 0.0), movers=(mover,))
    scene = Scene(world)
    robot = Robot(world, SimConfig(slip_fraction=0.0), np.random.default_rng(0), scene)
    for k in range(240):
        scene.advance(k * 0.05, (robot.state.x_m, robot.state.y_m), 0.25)
        robot.step(speed_mps, 0.0, 0.05)
    return robot


def test_contact_with_a_person_counts_and_fast_it_breaks() -> None:
    standing = Mover((6.0, 3.0), (6.0, 5.9), 1e-9)
    slow = _met(0.4, standing)
    assert (slow.state.contacts, slow.lost_reason) == (1, "")
    assert slow.state.x_m <= 6.0 - 0.55 + 1e-6
    fast = _met(1.0, standing)
    assert fast.lost_reason == "ran into somebody at more than 0.5 m/s"
    walked_into = _met(0.0, Mover((6.0, 3.0), (0.5, 3.0), 1.0))
    assert walked_into.state.contacts >= 1
    assert walked_into.lost_reason == ""
    assert walked_into.state.x_m == 2.0


def test_a_door_closes_at_its_time_unless_the_robot_stands_in_it() -> None:
    world = closing_door()
    scene = Scene(world)
    door = world.spec.cell_of(12.0, 4.0)
    assert not scene.advance(59.9, (4.0, 4.0), 0.25)
    assert not scene.occupied[door]
    assert not scene.advance(60.0, (12.3, 4.0), 0.25)
    assert scene.advance(61.0, (13.0, 4.0), 0.25)
    assert scene.occupied[door]
    assert not world.occupied[door]
    assert not scene.advance(62.0, (13.0, 4.0), 0.25)
    lidar = Lidar(world, CLEAN, scene)
    assert lidar.ranges(13.0, 4.0, math.pi)[0, 7] == pytest.approx(0.8, abs=0.01)


def test_ground_shut_in_before_it_was_covered_does_not_count() -> None:
    spec = box(12.0, 4.0).spec
    occupied = np.zeros(spec.shape, dtype=np.bool_)
    world = World("d", spec, occupied, (2.0, 2.0, 0.0), doors=(Door((6.0, 0.0, 6.2, 4.0), 10.0),))
    judge, scene = _judge(world), Scene(world)
    judge.update(2.5, 2.0, 0.0)  # sees to x = 8.5
    before = judge.covered_area_m2
    seen_behind = np.count_nonzero(judge.covered[:, 62:])
    assert scene.advance(10.0, (2.5, 2.0), 0.335)
    judge.close(scene.occupied, (2.5, 2.0))
    assert judge.covered_area_m2 == pytest.approx(before)
    assert np.count_nonzero(judge.reachable[:, 62:]) == seen_behind > 0
    assert judge.update(2.5, 2.0, math.pi) > 0
    judge.update(5.0, 2.0, 0.0)
    assert np.count_nonzero(judge.covered[:, 62:]) == seen_behind

"""The brake for people, closed loop: the simulator's LiDAR and robot, the risk map, the reconciler's guard."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.sensing import PointCloud
from services.reconciler.config import Config as ReconcilerConfig
from services.reconciler.path import first_hazard
from services.reconciler.separation import Guard
from services.riskmap.config import Config as RiskMapConfig
from services.riskmap.flat_model import FlatModel
from services.sim.config import LidarConfig, SimConfig
from services.sim.lidar import Lidar
from services.sim.robot import Robot
from services.sim.scene import Scene
from services.sim.world import Mover, World
from tests.sim.helpers import box

TICK_NS = SECOND_NS // 20
LATE_TICKS = 5
"""From a sweep to the brake: 0.25 s, as in lock-step (p50 0.22 s, p95 0.28 s)."""
PERSON_MPS = 0.6
MEET_S, MEET_M = 5.0, (7.0, 6.0)
"""When and where a robot that does not brake meets them; it waits a second first, so that it knows the ground."""


def meeting(bearing_rad: float, aside_m: float) -> World:
    """A hall in which somebody walks along a bearing to where the robot drives by then, or a little to the side."""
    way = np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    at = np.array(MEET_M) + aside_m * np.array([-way[1], way[0]])
    begin, end = at - PERSON_MPS * MEET_S * way, at + 10.0 * way
    hall = box(14.0, 12.0)
    mover = Mover(tuple(begin.tolist()), tuple(end.tolist()), PERSON_MPS)
    return World("hall", hall.spec, hall.occupied, (MEET_M[0] - 3.9, MEET_M[1], 0.0), movers=(mover,))


def free_to_m(model: FlatModel) -> float:
    """Where the path along MEET_M's y ends: at the end of the hall, or before what the risk map shows, m."""
    line = np.stack([np.arange(3.0, 13.0, 0.1), np.full(100, MEET_M[1])], axis=1)
    layers, s = model.layers(Pose())[0], model.spec
    here = round((s.centre_of(s.height // 2, s.width // 2)[0] - 3.0) / 0.1) + 2
    hazard = first_hazard(line, here, layers.state, layers.clearance_m, s.resolution_m, s.ix0, s.iy0, 0.2)
    return 12.0 if hazard < 0 else float(line[max(hazard - 3, 0), 0])


@pytest.mark.parametrize("aside_m", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("bearing_deg", range(0, 360, 30))
def test_it_has_stopped_before_they_touch(bearing_deg: int, aside_m: float) -> None:
    world = meeting(math.radians(bearing_deg), aside_m)
    config, scene = SimConfig(), Scene(world)
    robot = Robot(world, config, np.random.default_rng(1), scene)
    lidar = Lidar(world, LidarConfig(), scene)
    model, guard = FlatModel(RiskMapConfig(window_m=20.0)), Guard(ReconcilerConfig())
    rng, told = np.random.default_rng(2), dict[int, tuple[NDArray[np.float32], float]]()
    nearest_m, slowest, end_m = math.inf, 1.0, 0.0
    for tick in range(20 * 9):
        now = tick * TICK_NS
        before = robot.state
        scene.advance(now / SECOND_NS, (before.x_m, before.y_m), config.robot.footprint_radius_m)
        if tick % 2 == 0:
            sensor = Pose(x_m=before.x_m, y_m=before.y_m, z_m=0.8, yaw_rad=before.yaw_rad)
            points = lidar.scan(*before[:3], rng)
            model.roll_to(before.x_m, before.y_m)
            model.integrate(
                PointCloud(stamp_ns=now + 1, sensor_in_odom=sensor, range_m=20.0, points_m=points)
            )
            told[tick + LATE_TICKS] = model.moving_m, free_to_m(model)
        if tick in told:
            moving, end_m = told[tick]
            guard.watch(
                now, moving, np.array([[before.x_m, before.y_m], [max(end_m, before.x_m), MEET_M[1]]])
            )
        slowest = min(slowest, guard.share)
        wanted = min(guard.share, math.sqrt(2.0 * 0.8 * max(end_m - before.x_m, 0.0))) if tick >= 20 else 0.0
        state = robot.step(wanted, 0.0, 0.05)
        person = scene.movers[0, :2]
        gap_m = math.dist((state.x_m, state.y_m), person) - 0.25 - 0.3
        nearest_m = min(nearest_m, gap_m)
        assert not state.lost, state
        if gap_m <= 0.02:
            towards = (person[0] - state.x_m) / (gap_m + 0.55)
            assert state.speed_mps * towards <= 0.05, "it drove into them"
            break
    assert nearest_m < 1.5, "they do meet"
    if 90 < bearing_deg < 270:
        assert slowest < 1.0, "it did brake"


def test_without_the_guard_the_robot_would_be_lost() -> None:
    world = meeting(math.pi, 0.0)
    scene = Scene(world)
    robot = Robot(world, SimConfig(), np.random.default_rng(1), scene)
    for tick in range(20 * 9):
        scene.advance(tick / 20.0, (robot.state.x_m, robot.state.y_m), 0.25)
        robot.step(0.0 if tick < 20 else 1.0, 0.0, 0.05)
    assert robot.state.lost

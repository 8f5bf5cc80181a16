"""The robot: limits, slip, and walls that it never passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.grid import GridSpec
from services.sim.config import RobotConfig, SimConfig
from services.sim.robot import Robot
from services.sim.world import World, deepest_free_point
from tests.sim.helpers import box, with_walls

NO_SLIP = SimConfig(slip_fraction=0.0)
RADIUS_M = RobotConfig().footprint_radius_m


def _robot(world: World, config: SimConfig = NO_SLIP, seed: int = 0) -> Robot:
    return Robot(world, config, np.random.default_rng(seed))


def test_acceleration_and_speed_limits() -> None:
    robot = _robot(box(20.0, 20.0))
    speeds = [robot.step(5.0, 0.0, 0.1).speed_mps for _ in range(15)]
    assert np.diff(speeds).max() <= 0.1 + 1e-9
    assert speeds[-1] == pytest.approx(1.0)
    rates = [robot.step(0.0, 9.0, 0.1).turn_rate_radps for _ in range(10)]
    assert np.diff(rates).max() <= 0.3 + 1e-9
    assert rates[-1] == pytest.approx(1.5)


def test_a_circle_closes() -> None:
    robot = _robot(box(20.0, 20.0))
    for _ in range(40):
        start = robot.step(0.5, 0.5, 0.1)
    duration = 2 * math.pi / 0.5
    end = robot.step(0.5, 0.5, duration)
    assert math.hypot(end.x_m - start.x_m, end.y_m - start.y_m) < 1e-3
    assert math.remainder(end.yaw_rad - start.yaw_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_sub_steps_make_long_and_short_steps_alike() -> None:
    one, many = _robot(box(20.0, 20.0)), _robot(box(20.0, 20.0))
    one.step(1.0, 0.7, 2.0)
    for _ in range(20):
        many.step(1.0, 0.7, 0.1)
    assert one.state[:5] == pytest.approx(many.state[:5], abs=1e-9)


def test_slip_is_its_seed_and_has_its_size() -> None:
    config, world = SimConfig(slip_fraction=0.05), box(2000.0, 4.0, 0.5, start=(2.0, 2.0, 0.0))
    same = [_robot(world, config, 4), _robot(world, config, 4), _robot(world, config, 5)]
    a, b, c = (robot.step(1.0, 0.0, 5.0) for robot in same)
    assert a == b
    assert a.x_m != c.x_m
    ideal = _robot(world).step(1.0, 0.0, 5.0).x_m
    ratios = []
    for seed in range(200):
        robot = _robot(world, config, seed)
        before = robot.step(1.0, 0.0, 3.0).x_m
        ratios.append((robot.step(1.0, 0.0, 0.1).x_m - before) / 0.1)
    assert np.std(ratios) == pytest.approx(0.05, rel=0.2)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.015)
    assert abs(a.x_m - ideal) > 1e-6


def test_a_slow_touch_stops_and_counts_once() -> None:
    robot = _robot(box(4.0, 4.0))
    for _ in range(200):
        state = robot.step(0.3, 0.0, 0.1)
    assert state.blocked
    assert state.contacts == 1
    assert not state.lost
    assert 4.0 - RADIUS_M - 0.01 < state.x_m <= 4.0 - RADIUS_M + 1e-9
    # It can turn at the wall and drive away from it.
    while abs(math.remainder(robot.state.yaw_rad - math.pi, 2 * math.pi)) > 0.1:
        robot.step(0.0, 1.0, 0.1)
    for _ in range(30):
        state = robot.step(0.5, 0.0, 0.1)
    assert state.x_m < 3.0
    assert not (state.blocked or state.touching)


def test_a_fast_hit_loses_the_robot() -> None:
    robot = _robot(box(6.0, 4.0, start=(1.0, 2.0, 0.0)))
    for _ in range(80):
        state = robot.step(1.0, 0.0, 0.1)
    assert state.lost
    assert state.contacts == 1
    assert state.speed_mps == 0.0
    assert robot.step(-1.0, 1.0, 1.0) == state


def test_a_glancing_touch_at_speed_is_survived() -> None:
    robot = _robot(box(30.0, 4.0, start=(1.0, 3.3, 0.1)))
    for _ in range(60):
        state = robot.step(1.0, 0.0, 0.1)
    assert state.contacts >= 1
    assert not state.lost


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_robot_never_passes_walls(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec = GridSpec(0.2, -10, -20, 60, 60)
    occupied = rng.random(spec.shape) < 0.01
    x_m, y_m = deepest_free_point(spec, occupied)
    world = World("random", spec, occupied, (x_m, y_m, float(rng.uniform(-3, 3))))
    config = SimConfig(slip_fraction=0.2, contact_lost_speed_mps=100.0)
    robot = Robot(world, config, rng)
    for _ in range(150):
        state = robot.step(
            float(rng.uniform(-1, 2)), float(rng.uniform(-2, 2)), float(rng.uniform(0.02, 0.5))
        )
        assert world.clearance_m(state.x_m, state.y_m, 1.0) >= RADIUS_M - 1e-6
    assert not state.lost


def test_a_thin_wall_is_not_jumped() -> None:
    world = with_walls(box(8.0, 3.0, 0.1, start=(2.0, 1.5, 0.0)), (4.0, 0.0, 4.1, 3.0))
    fast = SimConfig(robot=RobotConfig(max_speed_mps=8.0, max_acceleration_mps2=50.0), slip_fraction=0.0)
    state = _robot(world, fast).step(8.0, 0.0, 2.0)
    assert state.x_m < 4.0 - RADIUS_M
    assert state.lost


@pytest.mark.parametrize("command", [(float("nan"), 0.0, 0.1), (0.0, float("inf"), 0.1), (0.0, 0.0, 0.0)])
def test_bad_commands_are_refused(command: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="robot command"):
        _robot(box(4.0, 4.0)).step(*command)

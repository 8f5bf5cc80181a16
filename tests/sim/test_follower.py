"""The follower with the robot in the loop."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.sim.config import RobotConfig, SimConfig
from services.sim.follower import Command, Follower, TimedPath
from services.sim.robot import Robot
from services.sim.world import World
from tests.sim.helpers import box, with_walls

TICK_S = 0.05


def _path(points: list[tuple[float, float]], speed: float = 1.0, ttl_s: float = 1e3) -> TimedPath:
    """A path through the points, at one speed, at rest at the end."""
    (ax, ay), (bx, by) = points[-2:]
    brake = min(0.9, speed**2 / 1.4 / math.hypot(bx - ax, by - ay))  # where to begin to brake at 0.7 m/s2
    x, y = np.array([*points[:-1], (bx + brake * (ax - bx), by + brake * (ay - by)), points[-1]]).T
    yaw = np.arctan2(np.diff(y), np.diff(x))
    speeds = np.full(x.shape, speed)
    speeds[-1] = 0.0
    t = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))]) / speed
    return TimedPath(x, y, np.append(yaw, yaw[-1]), speeds, t, 0.0, ttl_s)


def _drive(
    world: World, path: TimedPath, seconds: float, slip_fraction: float = 0.03, seed: int = 0
) -> tuple[list[Command], NDArray[np.float64], Robot]:
    """Commands, true poses (n, 3) and the robot after driving."""
    config = SimConfig(slip_fraction=slip_fraction)
    robot, follower = Robot(world, config, np.random.default_rng(seed)), Follower(config.robot)
    follower.set_path(path)
    commands, poses = [], []
    for k in range(round(seconds / TICK_S)):
        state = robot.state
        command = follower.step(state.x_m, state.y_m, state.yaw_rad, k * TICK_S, state.blocked)
        robot.step(command.speed_mps, command.turn_rate_radps, TICK_S)
        commands.append(command)
        poses.append(robot.state[:3])
        if command.arrived:
            break
    return commands, np.array(poses), robot


def _distance_to(path: TimedPath, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    best = np.full(len(poses), np.inf)
    for ax, ay, bx, by in zip(path.x_m[:-1], path.y_m[:-1], path.x_m[1:], path.y_m[1:], strict=True):
        d = np.array([bx - ax, by - ay])
        t = np.clip(((poses[:, :2] - [ax, ay]) @ d) / (d @ d), 0.0, 1.0)
        best = np.minimum(best, np.hypot(*(poses[:, :2] - [ax, ay] - t[:, None] * d).T))
    return best


SHAPES = {
    "straight": [(2.0, 2.0), (12.0, 2.0)],
    "eighths": [(2.0, 2.0), (5.0, 2.0), (7.0, 4.0), (7.0, 8.0), (5.0, 10.0), (2.0, 10.0)],
    "right angles": [(2.0, 2.0), (6.0, 2.0), (6.0, 6.0), (2.0, 6.0), (2.0, 10.0)],
    "back": [(2.0, 2.0), (8.0, 2.0), (3.0, 2.3)],
    "zigzag": [(2.0 + k, 2.0 + (k % 2)) for k in range(9)],
    "circle": [(2.0 + 3.0 * math.sin(a), 5.0 - 3.0 * math.cos(a)) for a in np.linspace(0.0, 3.1, 40)],
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", [0, 1])
def test_paths_are_tracked_within_five_centimetres(shape: str, seed: int) -> None:
    path = _path(SHAPES[shape])
    commands, poses, robot = _drive(box(14.0, 14.0, start=(2.0, 2.0, 0.0)), path, 90.0, seed=seed)
    assert commands[-1].arrived
    assert _distance_to(path, poses).max() < 0.05
    assert math.hypot(robot.state.x_m - path.x_m[-1], robot.state.y_m - path.y_m[-1]) < 0.08
    assert abs(math.remainder(robot.state.yaw_rad - path.yaw_rad[-1], 2 * math.pi)) < 0.1
    progress = [c.progress_m for c in commands]
    assert np.diff(progress).min() > -0.05
    assert progress[-1] == pytest.approx(commands[-1].progress_m + commands[-1].remaining_m, abs=0.06)
    assert not any(c.stuck for c in commands)


def test_it_is_not_slow_where_it_need_not_be() -> None:
    commands, _, _ = _drive(box(14.0, 14.0, start=(2.0, 2.0, 0.0)), _path(SHAPES["straight"]), 30.0)
    assert len(commands) * TICK_S < 14.0  # 10 m at 1 m/s, with one second to speed up and two to stop


def test_a_doorway_barely_wider_than_the_robot() -> None:
    world = with_walls(
        box(12.0, 8.0, 0.05, start=(2.0, 2.0, 0.0)), (6.0, 0.0, 6.2, 3.6), (6.0, 4.4, 6.2, 8.0)
    )
    path = _path([(2.0, 2.0), (4.0, 4.0), (8.0, 4.0), (10.0, 2.0)])
    for seed in range(5):
        commands, _, robot = _drive(world, path, 60.0, seed=seed)
        assert commands[-1].arrived
        assert robot.state.contacts == 0


def test_the_speed_of_the_path_is_kept() -> None:
    columns = [[2.0, 5.0, 8.0, 12.0], [2.0] * 4, [0.0] * 4, [0.0, 0.8, 0.2, 0.0], [0.0, 7.5, 13.5, 40.0]]
    x, y, yaw, speed, t = (np.array(c) for c in columns)
    path = TimedPath(x, y, yaw, speed, t, 0.0, 1e3)
    commands, _, _ = _drive(box(14.0, 14.0, start=(2.0, 2.0, 0.0)), path, 120.0)
    for command in commands:
        s = command.progress_m
        allowed = math.sqrt(np.interp(s, [0.0, 3.0, 6.0, 10.0], np.array([0.0, 0.8, 0.2, 0.0]) ** 2))
        assert command.speed_mps <= max(allowed, 0.08) + 1e-9
    assert commands[-1].arrived


def test_it_turns_on_the_spot_towards_a_path_behind() -> None:
    path = _path([(6.0, 6.0), (2.0, 6.0)])
    commands, poses, _ = _drive(box(14.0, 14.0, start=(6.0, 6.0, 0.0)), path, 40.0)
    assert commands[0].speed_mps == 0.0
    assert abs(commands[0].turn_rate_radps) > 1.0
    assert poses[:, 0].max() < 6.05
    assert commands[-1].arrived


def test_the_last_yaw_is_reached() -> None:
    path = _path([(2.0, 2.0), (4.0, 2.0)])
    path = replace(path, yaw_rad=np.array([0.0, 0.0, 2.5]))
    commands, poses, _ = _drive(box(8.0, 8.0, start=(2.0, 2.0, 0.0)), path, 40.0)
    assert commands[-1].arrived
    assert poses[-1, 2] == pytest.approx(2.5, abs=0.1)


def test_a_single_point_is_a_turn() -> None:
    two, one, zero = np.array([2.0]), np.array([1.0]), np.array([0.0])
    path = TimedPath(two, two, one, zero, zero, issued_s=0.0, ttl_s=100.0)
    commands, poses, _ = _drive(box(8.0, 8.0, start=(2.0, 2.0, 0.0)), path, 20.0)
    assert commands[-1].arrived
    assert poses[-1, 2] == pytest.approx(1.0, abs=0.1)


def test_an_expired_path_stops_the_robot() -> None:
    path = _path(SHAPES["straight"], ttl_s=3.0)
    commands, poses, robot = _drive(box(14.0, 14.0, start=(2.0, 2.0, 0.0)), path, 8.0)
    assert commands[-1].expired
    assert not commands[-1].active
    assert commands[-1].speed_mps == 0.0
    assert robot.state.speed_mps == 0.0
    assert 3.0 < poses[-1, 0] < 6.0
    assert all(c.speed_mps == 0.0 for c in commands[60:])
    assert commands[59].speed_mps > 0.0


def test_no_path_no_motion() -> None:
    follower = Follower(RobotConfig())
    command = follower.step(1.0, 2.0, 0.0, 5.0)
    assert (command.speed_mps, command.turn_rate_radps, command.active) == (0.0, 0.0, False)
    follower.set_path(_path(SHAPES["straight"]))
    assert follower.step(2.0, 2.0, 0.0, 5.0).active
    follower.set_path(None)
    assert not follower.step(2.0, 2.0, 0.0, 5.1).active


def test_held_against_a_wall_it_says_stuck_and_blocked() -> None:
    world = with_walls(box(10.0, 4.0, start=(2.0, 2.0, 0.0)), (4.0, 0.0, 4.5, 4.0))
    path = _path([(2.0, 2.0), (8.0, 2.0)], speed=0.4)
    commands, _, robot = _drive(world, path, 20.0)
    assert robot.state.contacts >= 1
    assert commands[-1].stuck
    assert commands[-1].blocked
    assert not any(c.stuck for c in commands[:100])
    first = next(k for k, c in enumerate(commands) if c.stuck)
    blocked = next(k for k, c in enumerate(commands) if c.blocked)
    assert (first - blocked) * TICK_S == pytest.approx(3.0, abs=0.5)


def test_standing_still_on_purpose_is_not_stuck() -> None:
    follower = Follower(RobotConfig())
    follower.set_path(_path(SHAPES["straight"], ttl_s=1.0))
    assert not any(follower.step(2.0, 2.0, 0.0, 2.0 + 0.5 * k).stuck for k in range(20))


def test_being_stuck_outlives_a_new_path() -> None:
    follower, stuck = Follower(RobotConfig()), []
    for k in range(10):
        follower.set_path(_path(SHAPES["straight"]))
        stuck.append(follower.step(2.0, 2.0, 0.0, 0.5 * k).stuck)
    assert stuck == [False] * 6 + [True] * 4


def test_a_path_that_passes_itself_is_not_cut_short() -> None:
    path = _path([(2.0, 6.0), (8.0, 6.0), (8.0, 8.0), (5.0, 8.0), (5.0, 3.0)])
    commands, _, _ = _drive(box(14.0, 14.0, start=(2.0, 6.0, 0.0)), path, 80.0)
    assert commands[-1].arrived
    assert np.diff([c.progress_m for c in commands]).max() < 0.15


def test_a_dead_end_is_driven_to_its_end_and_back() -> None:
    path = _path([(2.0, 2.0), (4.0, 2.0), (4.0, 3.0), (4.0, 2.0), (7.0, 2.0)])
    commands, poses, _ = _drive(box(10.0, 10.0, start=(2.0, 2.0, 0.0)), path, 60.0)
    assert commands[-1].arrived
    assert poses[:, 1].max() > 2.9
    assert _distance_to(path, poses).max() < 0.05


def test_noise_of_the_pose_does_not_break_the_way_through_a_doorway() -> None:
    world = with_walls(box(9.0, 4.0, 0.05, start=(2.0, 2.0, 0.0)), (5.0, 0.0, 5.2, 1.6), (5.0, 2.4, 5.2, 4.0))
    rng, config, path = np.random.default_rng(3), SimConfig(), _path([(2.0, 2.0), (7.0, 2.0)])
    robot, follower = Robot(world, config, rng), Follower(config.robot)
    follower.set_path(path)
    for k in range(400):
        x_m, y_m, yaw_rad = np.array(robot.state[:3]) + rng.normal(0.0, [0.01, 0.01, 0.002])
        command = follower.step(float(x_m), float(y_m), float(yaw_rad), k * TICK_S, robot.state.blocked)
        robot.step(command.speed_mps, command.turn_rate_radps, TICK_S)
    assert command.arrived
    assert robot.state.contacts == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x_m": np.array([])}, "shapes"),
        ({"x_m": np.array([1.0])}, "shapes"),
        ({"y_m": np.array([0.0, np.nan])}, "not finite"),
        ({"speed_mps": np.array([-0.1, 0.0])}, "negative speed"),
        ({"t_s": np.array([1.0, 0.0])}, "run backwards"),
        ({"ttl_s": 0.0}, "ttl"),
        ({"issued_s": math.inf}, "not finite"),
    ],
)
def test_bad_paths_are_refused(change: dict[str, Any], message: str) -> None:
    ends = np.array([0.0, 1.0])
    two_points = TimedPath(ends, ends, ends, ends, ends, 0.0, 1.0)
    with pytest.raises(ValueError, match=message):
        replace(two_points, **change)


def test_a_path_whose_yaw_points_against_its_way_is_driven_backwards() -> None:
    path = _path([(6.0, 5.0), (5.0, 5.0), (4.0, 5.4)], speed=0.4)
    back = replace(path, yaw_rad=np.remainder(path.yaw_rad + 2.0 * math.pi, 2.0 * math.pi) - math.pi)
    commands, poses, robot = _drive(box(10.0, 10.0, start=(6.0, 5.0, 0.0)), back, 15.0)
    assert commands[-1].arrived
    assert math.hypot(robot.state.x_m - 4.0, robot.state.y_m - 5.4) < 0.1
    assert np.abs(poses[:, 2]).max() < 0.6, "it never turned round"
    assert min(c.speed_mps for c in commands) < -0.3
    assert _distance_to(path, poses).max() < 0.08

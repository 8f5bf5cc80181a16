"""What uneven ground does to the robot: it stands, leans, is stopped, and is lost by name; Husky and Spot differ."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.robot_profile import PROFILES
from services.sim.config import RobotConfig, SimConfig
from services.sim.robot import Robot, RobotState
from services.sim.terrain import rotation
from services.sim.terrain_start import standing_ground
from services.sim.world import World
from services.sim.worlds import make_world
from tests.sim.terrains import Surface, ground, ledge, ramp

BOTH = ("husky", "spot")


def _robot(world: World, profile: str, **more: object) -> Robot:
    robot = RobotConfig.model_validate({"profile": profile})
    config = SimConfig.model_validate({"robot": robot.model_dump(), "slip_fraction": 0.0, **more})
    return Robot(world, config, np.random.default_rng(0))


def _drive(
    surface: Surface, profile: str, speed_mps: float, seconds: float = 8.0, cell_m: float = 0.1
) -> tuple[RobotState, str]:
    world = ground(12.0, 4.0, surface, (2.0, 2.0, 0.0), resolution_m=cell_m)
    robot = _robot(world, profile)
    for _ in range(round(seconds / 0.1)):
        robot.step(speed_mps, 0.0, 0.1)
    return robot.state, robot.lost_reason


@pytest.mark.parametrize("profile", BOTH)
def test_it_stands_on_the_plane_under_its_feet(profile: str) -> None:
    world = ground(10.0, 10.0, lambda x, y: 0.2 * x - 0.1 * y, (5.0, 5.0, 0.0))
    state = _robot(world, profile).state
    assert state.z_m == pytest.approx(0.5, abs=1e-5)
    assert state.pitch_rad == pytest.approx(-math.atan(0.2), abs=1e-5)  # nose up
    assert state.roll_rad < 0.0  # the left side is lower
    up = np.array([-0.2, 0.1, 1.0]) / math.sqrt(1.05)
    assert rotation(state.roll_rad, state.pitch_rad, 0.0)[:, 2] == pytest.approx(up, abs=1e-5)
    turned = ground(10.0, 10.0, lambda x, y: 0.2 * x + 0 * y, (5.0, 5.0, math.pi / 2))
    assert _robot(turned, profile).state.roll_rad == pytest.approx(-math.atan(0.2), abs=1e-5)


@pytest.mark.parametrize("profile", BOTH)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slopes_that_the_profile_allows_are_driven(profile: str, sign: float) -> None:
    state, reason = _drive(ramp(sign * PROFILES[profile].max_slope_rad, 4.0), profile, 1.0)
    assert reason == ""
    assert state.x_m > 7.0
    assert state.contacts == 0
    assert state.pitch_rad == pytest.approx(-sign * PROFILES[profile].max_slope_rad, abs=0.01)


def test_uphill_is_slower_and_across_it_drifts_down() -> None:
    up, _ = _drive(ramp(0.4, 0.0), "spot", 1.0, 4.0)
    down, _ = _drive(ramp(-0.4, 0.0), "spot", 1.0, 4.0)
    level, _ = _drive(ramp(0.0, 0.0), "spot", 1.0, 4.0)
    assert up.x_m < down.x_m < level.x_m
    world = ground(12.0, 8.0, lambda x, y: 0.3 * y + 0 * x, (2.0, 4.0, 0.0))
    robot = _robot(world, "spot")
    for _ in range(40):
        robot.step(1.0, 0.0, 0.1)
    assert robot.state.y_m < 3.98


@pytest.mark.parametrize("profile", BOTH)
def test_too_steep_a_side_slope_tips_it(profile: str) -> None:
    tilt = PROFILES[profile].tip_roll_rad
    for slope, lost in ((tilt - 0.05, False), (tilt + 0.05, True)):
        # A sideways slope that grows along the way: it has no ledge.
        def twisted(x: np.ndarray, y: np.ndarray, slope: float = slope) -> np.ndarray:
            return np.asarray(math.tan(slope) * np.clip((x - 3.0) / 5.0, 0.0, 1.0) * (y - 2.0))

        world = ground(14.0, 8.0, twisted, (2.0, 2.0, 0.0))
        robot = _robot(world, profile, slope_slip_fraction=0.0)
        for _ in range(90):
            robot.step(1.0, 0.0, 0.1)
        assert (robot.lost_reason == "tipped over") is lost


@pytest.mark.parametrize("profile", BOTH)
def test_ledges_up_are_climbed_or_are_walls(profile: str) -> None:
    most = PROFILES[profile].max_climb_m
    state, reason = _drive(ledge(most - 0.03, 5.0), profile, 1.0)
    assert (reason, state.contacts) == ("", 0)
    assert state.z_m == pytest.approx(most - 0.03, abs=1e-4)
    state, reason = _drive(ledge(most + 0.03, 5.0), profile, 1.0)
    assert "ledge it cannot climb" in reason
    assert state.x_m < 5.05
    state, reason = _drive(ledge(most + 0.03, 5.0), profile, 0.3, 14.0)
    assert (reason, state.blocked, state.contacts) == ("", True, 1)
    assert state.x_m < 5.05


@pytest.mark.parametrize("profile", BOTH)
def test_a_drop_loses_it_at_any_speed(profile: str) -> None:
    most = PROFILES[profile].max_drop_m
    state, reason = _drive(ledge(-(most - 0.05), 5.0), profile, 0.8, 12.0)
    assert reason == ""
    assert state.z_m == pytest.approx(-(most - 0.05), abs=1e-4)
    for speed in (0.3, 1.0):
        state, reason = _drive(ledge(-(most + 0.05), 5.0), profile, speed, 12.0)
        assert reason == "dropped off a ledge"
        assert state.speed_mps == 0.0


def _pit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(np.where(np.hypot(x - 6.0, y - 2.0) < 0.7, -1.0, 0.0))


def _crack(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(np.where(np.abs(x - 6.05) < 0.04, -1.0, 0.0) + 0 * y)


@pytest.mark.parametrize("profile", BOTH)
def test_a_pit_swallows_it_and_a_crack_does_not(profile: str) -> None:
    assert _drive(_pit, profile, 0.8)[1] == "dropped off a ledge"
    assert _drive(_crack, profile, 0.8)[1] == ""


def _ridge(height_m: float) -> Surface:
    """A smooth ridge along the way, between the feet."""
    return lambda x, y: (
        height_m * np.clip((x - 4.0) / 2.5, 0.0, 1.0) * np.maximum(1.0 - np.abs(y - 2.0) / 0.06, 0.0)
    )


def test_a_ridge_between_the_feet_high_centres_the_husky_only() -> None:
    assert _drive(_ridge(0.5), "husky", 0.8, cell_m=0.05)[1] == "high-centred: the ground holds up its belly"
    assert _drive(_ridge(0.5), "spot", 0.8, cell_m=0.05)[1] == ""
    assert _drive(_ridge(0.15), "husky", 0.8, cell_m=0.05)[1] == ""


def test_what_loses_the_husky_spot_may_stand() -> None:
    assert _drive(ledge(0.25, 5.0), "husky", 1.0)[1] != ""
    assert _drive(ledge(0.25, 5.0), "spot", 1.0)[1] == ""
    assert _drive(ledge(-0.32, 5.0), "husky", 1.0)[1] != ""
    assert _drive(ledge(-0.32, 5.0), "spot", 1.0)[1] == ""


def test_a_ceiling_too_low_is_a_wall() -> None:
    world = ground(
        12.0, 4.0, lambda x, y: 0.0 * x, (2.0, 2.0, 0.0), ceiling=lambda x, y: np.where(x > 6.0, 0.7, 3.0)
    )
    robot = _robot(world, "spot")
    for _ in range(200):
        robot.step(0.3, 0.0, 0.1)
    assert robot.state.blocked
    assert robot.state.x_m == pytest.approx(6.0 - 0.25, abs=0.01)


@pytest.mark.parametrize("profile", BOTH)
def test_on_ground_that_the_judge_accepts_nothing_is_lost(profile: str) -> None:
    """Straight drives at full speed whose every cell the robot may stand on."""
    world = make_world("cave", 4)
    config = RobotConfig.model_validate({"profile": profile})
    good = standing_ground(world, config)
    rng = np.random.default_rng(1)
    cells = np.argwhere(good)
    driven = 0.0
    for _ in range(60):
        x_m, y_m = world.spec.centre_of(*cells[rng.integers(len(cells))].tolist())
        yaw = float(rng.uniform(-math.pi, math.pi))
        length = 0.0
        while length < 6.0:
            ahead = length + 0.35
            row, column = world.spec.cell_of(x_m + ahead * math.cos(yaw), y_m + ahead * math.sin(yaw))
            if not good[row - 1 : row + 2, column - 1 : column + 2].all():
                break
            length += 0.05
        if length < 0.5:
            continue
        placed = World("cave", world.spec, world.occupied, (x_m, y_m, yaw), world.floor_m, world.ceiling_m)
        robot = _robot(placed, profile, slope_slip_fraction=0.0)
        while math.hypot(robot.state.x_m - x_m, robot.state.y_m - y_m) < length - 0.1:
            before = robot.state
            robot.step(1.0, 0.0, 0.1)
            assert robot.lost_reason == ""
            if robot.state.x_m == before.x_m and robot.state.speed_mps == 0.0:
                break
        driven += length
    assert driven > 50.0

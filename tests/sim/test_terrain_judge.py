"""The judge on uneven ground: which ground counts, and what is seen of it."""

from __future__ import annotations

import numpy as np
import pytest

from planning.robot_profile import PROFILES
from services.sim.config import CoverageSensorConfig, RobotConfig
from services.sim.coverage import Judge
from services.sim.terrain_judge import acceptable_ground, sees_over, steps
from services.sim.world import StartError, World
from tests.sim.helpers import box, with_walls
from tests.sim.terrains import Surface, bilinear, ground, ledge, ramp

BOTH = ("husky", "spot")


def _judge(world: World, profile: str = "spot", **sensor: float) -> Judge:
    robot = RobotConfig.model_validate({"profile": profile})
    return Judge(world, robot.footprint_radius_m, CoverageSensorConfig.model_validate(sensor), robot)


def _reaches(surface: Surface, profile: str, x_m: float) -> bool:
    judge = _judge(ground(12.0, 4.0, surface, (2.0, 2.0, 0.0)), profile)
    return bool(judge.reachable[judge.spec.cell_of(x_m, 2.0)])


@pytest.mark.parametrize("profile", BOTH)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slopes_up_to_the_limit_count(profile: str, sign: float) -> None:
    most = PROFILES[profile].max_slope_rad
    assert _reaches(ramp(sign * (most - 0.02), 5.0), profile, 9.0)
    assert not _reaches(ramp(sign * (most + 0.02), 5.0), profile, 9.0)


@pytest.mark.parametrize(("profile", "good_m", "bad_m"), [("husky", 0.08, 0.12), ("spot", 0.16, 0.22)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_steps_up_to_the_limit_count(profile: str, good_m: float, bad_m: float, sign: float) -> None:
    assert _reaches(ledge(sign * good_m, 5.0), profile, 9.0)
    assert not _reaches(ledge(sign * bad_m, 5.0), profile, 9.0)


def test_a_steady_slope_is_no_step_but_a_ledge_on_it_is() -> None:
    x = 0.1 * np.arange(60)
    slope = np.broadcast_to(0.4 * x, (60, 60)).astype(np.float32)
    found = steps(slope, 0.1, 2, 0.5)[4:-4, 4:-4]
    assert found == pytest.approx(0.0, abs=1e-5)
    stepped = slope + np.where(x > 3.0, 0.2, 0.0).astype(np.float32)
    found = steps(stepped, 0.1, 2, 0.5)
    assert found[4:-4].max() == pytest.approx(0.2, abs=1e-5)
    assert found[30, 10] == pytest.approx(0.0, abs=1e-5)
    # Steeper than may pass for slope: the rest is a step.
    assert steps(2.0 * slope, 0.1, 2, 0.5)[30, 30] == pytest.approx(0.8 * 0.2 - 0.5 * 0.2, abs=1e-5)


def test_ground_that_would_touch_the_belly_does_not_count() -> None:
    def dome(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(0.35 * np.exp(-(((x - 6.05) ** 2 + (y - 2.05) ** 2) / 0.25**2)))

    world = ground(12.0, 4.0, dome, (2.0, 2.0, 0.0))
    assert world.floor_m is not None
    for belly_m, stands in ((0.1, False), (0.3, True)):
        robot = RobotConfig(profile="husky", max_step_m=1.0, belly_m=belly_m)
        good = acceptable_ground(world.spec, world.occupied, world.floor_m, robot)
        assert good[world.spec.cell_of(6.05, 2.05)] == stands  # level there, with the top under it
        assert good[world.spec.cell_of(9.0, 2.0)]


def test_low_ceilings_do_not_count() -> None:
    world = ground(
        12.0, 4.0, lambda x, y: 0.0 * x, (2.0, 2.0, 0.0), ceiling=lambda x, y: np.where(x > 6.0, 0.8, 3.0)
    )
    judge = _judge(world)
    assert judge.reachable[judge.spec.cell_of(5.5, 2.0)]
    assert not judge.reachable[judge.spec.cell_of(6.5, 2.0)]


def test_coarse_worlds_are_cut_along_their_surface() -> None:
    world = ground(12.0, 4.0, ramp(0.3, 5.0), (2.0, 2.0, 0.0), resolution_m=0.2)
    judge = _judge(world)
    assert judge.spec.resolution_m == pytest.approx(0.1)
    assert judge.reachable[judge.spec.cell_of(10.0, 2.0)]
    assert world.floor_m is not None and judge._floor_m is not None
    x, y = judge.spec.centres_x()[7:90], np.full(83, 2.05)
    assert judge._floor_m[20, 7:90] == pytest.approx(bilinear(world, world.floor_m, x, y), abs=1e-5)


def test_a_start_on_a_slope_too_steep_is_refused() -> None:
    with pytest.raises(StartError, match="too rough"):
        _judge(ground(12.0, 4.0, lambda x, y: 1.2 * x, (6.0, 2.0, 0.0)))


def test_hills_and_pits_hide_ground() -> None:
    hill = ground(14.0, 4.0, lambda x, y: 0.9 * np.exp(-(((x - 7.0) / 2.0) ** 2)) + 0 * y, (3.0, 2.0, 0.0))
    judge = _judge(hill, range_m=8.0)
    judge.update(3.0, 2.0, 0.0)
    assert judge.covered[judge.spec.cell_of(5.0, 2.0)]
    assert not judge.covered[judge.spec.cell_of(9.0, 2.0)]
    judge.update(7.0, 2.0, 0.0)  # from the top
    assert judge.covered[judge.spec.cell_of(9.0, 2.0)]


def test_a_low_ceiling_hides_what_is_behind() -> None:
    def lintel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((x > 5.0) & (x < 5.4), 0.6, 4.0)

    world = ground(12.0, 4.0, lambda x, y: 0.25 * np.maximum(x - 6.0, 0.0), (3.0, 2.0, 0.0), ceiling=lintel)
    judge = _judge(world)
    judge.reachable[:] = judge._pending[:] = True  # no robot passes under it: only the line of sight is asked
    judge.update(3.0, 2.0, 0.0)
    assert judge.covered[judge.spec.cell_of(4.5, 2.0)]
    assert not judge.covered[judge.spec.cell_of(8.5, 2.0)]


def test_line_of_sight_on_level_ground_is_that_of_the_plane() -> None:
    world = with_walls(box(8.0, 6.0), (3.0, 2.0, 3.4, 4.0), (5.0, 0.5, 5.5, 3.0))
    level = World("level", world.spec, world.occupied, world.start, np.zeros(world.spec.shape, np.float32))
    flat, rough = Judge(world, 0.25, CoverageSensorConfig()), _judge(level)
    for x_m, y_m, yaw in ((1.5, 3.1, 0.0), (4.2, 1.0, 2.0), (6.5, 4.0, -2.0)):
        assert flat.update(x_m, y_m, yaw) == rough.update(x_m, y_m, yaw)
    assert (flat.covered == rough.covered).all()


def test_line_of_sight_against_sampling() -> None:
    rng = np.random.default_rng(3)
    floor = (0.5 * rng.random((30, 30))).astype(np.float32)
    ceiling = (1.2 + rng.random((30, 30))).astype(np.float32)
    occupied = rng.random((30, 30)) < 0.02
    differ = 0
    for _ in range(400):
        x, y = rng.uniform(5, 25, 2)
        row, column = rng.integers(0, 30, 2).tolist()
        t = np.linspace(0.0, 1.0, 4000)
        rows = np.floor(y + t * (row + 0.5 - y)).astype(int)
        columns = np.floor(x + t * (column + 0.5 - x)).astype(int)
        z = 0.9 + t * (floor[row, column] + 0.1 - 0.9)
        before = (rows != row) | (columns != column)
        r, c, h = rows[before], columns[before], z[before]
        # At the middle of each cell's crossing, as declared: take the mean height within every cell.
        cells = r * 30 + c
        free = True
        for cell in np.unique(cells):
            inside = cells == cell
            height = 0.5 * (h[inside].min() + h[inside].max())
            a, b = divmod(int(cell), 30)
            free &= not occupied[a, b] and floor[a, b] <= height <= ceiling[a, b]
        differ += free != sees_over(occupied, floor, ceiling, float(x), float(y), 0.9, row, column)
    assert differ <= 8  # corners that the sampling steps over

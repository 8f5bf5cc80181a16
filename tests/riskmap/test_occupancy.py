"""Evidence of sweeps against brute force: what was hit, what was passed, what fades, and the rolling window."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.grid import GridSpec, window_around
from schemas.base import Pose
from services.riskmap.collision import RiskLayers, collision_layers
from services.riskmap.config import Config
from services.riskmap.occupancy import OccupancyWindow, integrate_sweep
from tests.riskmap.helpers import SENSOR_Z_M, rectangle, sweep

HIT, PASS, CLAMP = 1.2, 0.5, 4.0
GROUND_M, BODY_M, SELF_M = 0.15, 0.9, 0.2
BEARINGS = 900


def integrate(
    window: OccupancyWindow,
    points_m: NDArray[np.float32],
    x_m: float = 0.0,
    y_m: float = 0.0,
    yaw_rad: float = 0.0,
    z_m: float = SENSOR_Z_M,
    ground_z_m: float = 0.0,
) -> int:
    s = window.spec
    return integrate_sweep(
        points_m,
        np.array([x_m, y_m, z_m, yaw_rad]),
        np.array([ground_z_m, GROUND_M, BODY_M, SELF_M]),
        np.array([HIT, PASS, CLAMP]),
        s.resolution_m,
        s.ix0,
        s.iy0,
        window.log_odds,
        window.hit_weight,
        window.hit_x,
        window.hit_y,
        np.zeros(s.shape, np.uint8),
    )


def layers_of(window: OccupancyWindow) -> RiskLayers:
    c = Config()
    return collision_layers(
        window.log_odds,
        window.hit_x,
        window.hit_y,
        window.spec.resolution_m,
        c.free_log_odds,
        c.clamp_log_odds,
        c.collision_hazard_per_m,
        c.cvar_alpha,
        c.max_clearance_m,
    )


def points(*rows: tuple[float, float, float]) -> NDArray[np.float32]:
    return np.array(rows, dtype=np.float32).reshape(-1, 3)


class _Point(NamedTuple):
    """A finite point outside the body: where, how far the ray is at body height, and whether it is an obstacle."""

    x: float
    y: float
    angle: float
    bearing: int
    reach: float
    hit: bool


def _read_points(cloud: NDArray[np.float32], x: float, y: float, z: float, yaw: float) -> list[_Point]:
    found = []
    for px, py, pz in cloud.astype(np.float64):
        distance = math.hypot(px, py)
        if not all(math.isfinite(v) for v in (px, py, pz)) or distance < SELF_M:
            continue
        dx = math.cos(yaw) * px - math.sin(yaw) * py
        dy = math.sin(yaw) * px + math.cos(yaw) * py
        bearing = math.floor((math.atan2(dy, dx) % (2 * math.pi)) / (2 * math.pi) * BEARINGS) % BEARINGS
        over = z + pz > BODY_M
        reach = distance * (BODY_M - z) / pz if over and z <= BODY_M else (0.0 if over else distance)
        angle = math.atan2(dy, dx)
        found.append(_Point(x + dx, y + dy, angle, bearing, reach, GROUND_M < z + pz <= BODY_M))
    return found


def _brute_force(
    spec: GridSpec, cloud: NDArray[np.float32], x: float, y: float, z: float, yaw: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """(hit, surely passed, perhaps passed): a ray within 1e-6 cells of a corner is a matter of rounding."""
    hit = np.zeros(spec.shape, np.bool_)
    reach, angle = np.zeros(BEARINGS), np.zeros(BEARINGS)
    for point in _read_points(cloud, x, y, z, yaw):
        row, column = spec.cell_of(point.x, point.y)
        if point.hit and spec.contains(row, column):
            hit[row, column] = True
        if point.reach > reach[point.bearing]:
            reach[point.bearing], angle[point.bearing] = point.reach, point.angle
    low_x = (spec.ix0 + np.arange(spec.width)[None, :]) - x / spec.resolution_m
    low_y = (spec.iy0 + np.arange(spec.height)[:, None]) - y / spec.resolution_m
    sure, maybe = np.zeros(spec.shape, np.bool_), np.zeros(spec.shape, np.bool_)
    # Each bearing's own ray, and between two of them the shorter one.
    reaches = np.stack((reach, np.minimum(reach, np.roll(reach, -1))), axis=1).ravel()
    between = angle + 0.5 * np.vectorize(math.remainder)(np.roll(angle, -1) - angle, 2 * math.pi)
    angles = np.stack((angle, between), axis=1).ravel()
    for half in np.flatnonzero(reaches / spec.resolution_m > 0.5):
        enter = np.zeros(spec.shape)
        leave = np.full(spec.shape, np.inf)
        for low, slope in ((low_x, math.cos(angles[half])), (low_y, math.sin(angles[half]))):
            a, b = low / slope, (low + 1.0) / slope
            enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
        length = reaches[half] / spec.resolution_m - 0.5
        sure |= (leave - enter > 1e-6) & (enter < length - 1e-6)
        maybe |= (leave - enter > -1e-6) & (enter < length + 1e-6)
    return hit, sure, maybe


@given(
    seed=st.integers(0, 10_000),
    pose=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)),
    z=st.sampled_from([0.3, 0.8, 1.4]),
)
def test_one_sweep_equals_brute_force(seed: int, pose: tuple[float, float, float], z: float) -> None:
    rng = np.random.default_rng(seed)
    x, y, yaw = pose
    cloud = rng.uniform((-3.5, -3.5, -z - 0.05), (3.5, 3.5, 2.5 - z), (60, 3)).astype(np.float32)
    cloud[::17, rng.integers(3)] = np.nan
    window = OccupancyWindow(6.0, 0.1)
    assert integrate(window, cloud, x, y, yaw, z) == len(cloud[::17])
    hit, sure, maybe = _brute_force(window.spec, cloud, x, y, z, yaw)
    assert (window.log_odds > 0).tolist() == hit.tolist()
    assert window.log_odds[hit] == pytest.approx(HIT)
    passed = window.log_odds < 0
    assert not (passed & ~maybe).any()
    assert not (sure & ~hit & ~passed).any()
    assert window.log_odds[passed] == pytest.approx(-PASS)


@given(seed=st.integers(0, 10_000), sweeps=st.integers(1, 12))
def test_mean_hit_is_the_mean_of_the_points_in_the_cell(seed: int, sweeps: int) -> None:
    rng = np.random.default_rng(seed)
    window = OccupancyWindow(6.0, 0.2)
    cell = rng.uniform((1.4, -0.2), (1.6, 0.0), (sweeps, 3, 2))
    for part in cell:
        integrate(window, points(*((px, py, -0.3) for px, py in part)))
    row, column = window.spec.cell_of(1.5, -0.1)
    centre = window.spec.centre_of(row, column)
    mean = cell.reshape(-1, 2).mean(axis=0)
    assert window.hit_weight[row, column] == 3 * sweeps
    assert centre[0] + window.hit_x[row, column] == pytest.approx(mean[0], abs=1e-4)
    assert centre[1] + window.hit_y[row, column] == pytest.approx(mean[1], abs=1e-4)


def test_a_room_is_free_inside_and_lethal_along_its_walls_and_unknown_outside() -> None:
    walls = rectangle(-3.03, -2.04, 2.97, 2.06)
    window = OccupancyWindow(12.0, 0.1)
    for _ in range(5):
        integrate(window, sweep(walls, Pose(x_m=0.3, y_m=-0.2, z_m=SENSOR_Z_M)), 0.3, -0.2)
    state = layers_of(window).state
    x, y = np.meshgrid(window.spec.centres_x(), window.spec.centres_y())
    inside = np.minimum(np.minimum(x + 3.03, 2.97 - x), np.minimum(y + 2.04, 2.06 - y))
    assert (state[inside > 0.1] == 1).all()
    assert (state[inside < -0.1] == 0).all()
    assert (state[np.abs(inside) <= 0.02] == 2).mean() > 0.9
    assert not (state[inside < -0.051] == 2).any()


def test_only_points_at_body_height_are_obstacles() -> None:
    window = OccupancyWindow(12.0, 0.1)
    heights = {1.05: GROUND_M - 0.01, 2.05: GROUND_M + 0.01, 3.05: BODY_M - 0.01, 4.05: BODY_M + 0.01}
    integrate(window, points(*((0.0, y, z - SENSOR_Z_M) for y, z in heights.items())))
    hits = {y: window.log_odds[window.spec.cell_of(0.0, y)] > 0 for y in heights}
    assert hits == {1.05: False, 2.05: True, 3.05: True, 4.05: False}


def test_heights_are_measured_from_the_ground() -> None:
    window = OccupancyWindow(6.0, 0.1)
    integrate(window, points((1.0, 0.0, -0.7)), z_m=5.8, ground_z_m=5.0)
    assert window.log_odds[window.spec.cell_of(1.0, 0.0)] <= 0
    integrate(window, points((1.0, 0.0, -0.6)), z_m=5.8, ground_z_m=5.0)
    assert window.log_odds[window.spec.cell_of(1.0, 0.0)] > 0


def test_a_ray_to_a_point_above_the_robot_clears_only_where_it_is_at_body_height() -> None:
    """From 0.8 m to 2.0 m high at 4.8 m: it leaves the body's height of 0.9 m after 0.4 m."""
    window = OccupancyWindow(12.0, 0.1)
    integrate(window, points((4.8, 0.01, 1.2)))
    row, column = window.spec.cell_of(0.01, 0.01)
    cleared = np.flatnonzero(window.log_odds[row] < 0) - column
    assert cleared.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("rise", [-0.1, 0.0, 0.3])
def test_a_sensor_above_the_robot_learns_nothing_from_points_above_the_robot(rise: float) -> None:
    window = OccupancyWindow(12.0, 0.1)
    integrate(window, points((3.0, 0.0, rise)), z_m=1.4)
    assert not window.log_odds.any()


def test_the_robots_own_body_is_neither_obstacle_nor_free() -> None:
    window = OccupancyWindow(6.0, 0.1)
    integrate(window, points((SELF_M - 0.01, 0.0, -0.3), (0.0, -SELF_M + 0.01, -0.8)))
    assert not window.log_odds.any()
    integrate(window, points((SELF_M + 0.01, 0.0, -0.3)))
    assert window.log_odds[window.spec.cell_of(SELF_M + 0.01, 0.0)] > 0


def test_points_and_rays_outside_the_window_are_harmless() -> None:
    window = OccupancyWindow(2.0, 0.1)
    integrate(window, points((50.0, 0.0, -0.3), (0.0, -50.0, -0.3)))
    assert not (window.log_odds > 0).any()
    assert (window.log_odds < 0).sum() == 20
    integrate(window, points((1.0, 0.0, -0.3)), x_m=40.0)
    assert (window.log_odds < 0).sum() == 20


def test_a_moved_obstacle_fades_and_the_clearance_comes_back() -> None:
    walls = rectangle(-4, -4, 4, 4)
    crate = rectangle(1.0, -0.2, 1.4, 0.2)
    window = OccupancyWindow(9.0, 0.1)
    pose = Pose(z_m=SENSOR_Z_M)
    for _ in range(40):
        integrate(window, sweep([*walls, *crate], pose))
    cell = window.spec.cell_of(0.75, 0.05)
    near = layers_of(window)
    assert near.clearance_m[cell] == pytest.approx(0.25, abs=0.03)
    needed = 0
    while (layers_of(window).state[window.spec.cell_of(1.05, 0.05)]) != 1:
        integrate(window, sweep(walls, pose))
        needed += 1
    assert needed == math.ceil((CLAMP + Config().free_log_odds) / PASS)
    after = layers_of(window)
    assert (after.state[(slice(40, 50), slice(50, 60))] == 1).all()
    assert after.clearance_m[cell] == pytest.approx(Config().max_clearance_m)


def test_rays_that_graze_a_wall_do_not_wipe_it_out() -> None:
    """A robot drives 10 m along a corridor; the walls that it passed are still there, far behind."""
    walls = rectangle(-18.0, -1.03, 18.0, 1.07)
    rng = np.random.default_rng(0)
    window = OccupancyWindow(40.0, 0.1)
    for k in range(101):
        x, yaw = -10.0 + 0.1 * k, 0.002 * k
        cloud = sweep(walls, Pose(x_m=x, z_m=SENSOR_Z_M, yaw_rad=yaw))
        noise = rng.normal(0.0, 0.01, len(cloud)) / np.linalg.norm(cloud, axis=1)
        integrate(window, (cloud * (1.0 + noise[:, None])).astype(np.float32), x, 0.0, yaw)
    state = layers_of(window).state
    row, column = window.spec.cell_of(-9.95, 1.07)
    wall = state[row, column : column + 100]
    assert (wall == 2).mean() > 0.9
    assert (wall[-70:] == 2).all()
    row, column = window.spec.cell_of(-9.95, 0.05)
    assert (state[row, column : column + 100] == 1).all()


def test_a_robot_that_stands_beside_a_wall_and_looks_along_it_does_not_wipe_it_out() -> None:
    """Far along a wall the rays lie farther apart than its cells, and skim more of them than they hit."""
    walls = rectangle(-12.0, -0.63, 12.0, 8.0)
    rng = np.random.default_rng(0)
    window = OccupancyWindow(30.0, 0.1)
    row, column = window.spec.cell_of(-9.95, -0.63)
    for k in range(260):
        x = -10.0 + 0.25 * k if k < 40 else 0.0
        yaw, (dx, dy, turned) = 0.1 * math.sin(0.05 * k), rng.normal(0.0, [0.01, 0.01, 0.002])
        cloud = sweep(walls, Pose(x_m=x, z_m=SENSOR_Z_M, yaw_rad=yaw))
        integrate(window, cloud, x + dx, dy, yaw + turned)
        if k == 40:
            before = (layers_of(window).state[row - 1 : row + 2, column : column + 200] == 2).any(axis=0)
    after = (layers_of(window).state[row - 1 : row + 2, column : column + 200] == 2).any(axis=0)
    assert before.mean() > 0.9
    assert after[before].mean() > 0.97
    gaps = "".join("x" if cell else " " for cell in after[:-20]).split("x")
    assert max(len(gap) for gap in gaps) < 3


def test_evidence_is_bounded() -> None:
    window = OccupancyWindow(6.0, 0.1)
    for _ in range(30):
        integrate(window, points((2.0, 0.01, -0.3)))
    assert window.log_odds.max() == pytest.approx(CLAMP)
    assert window.log_odds.min() == pytest.approx(-CLAMP)


@settings(max_examples=12)
@given(low=st.floats(-0.4, 0.0), x=st.floats(1.8, 2.2))
def test_a_thin_door_keeps_its_clearance(low: float, x: float) -> None:
    """A door of 0.8 m anywhere between the cells: clearance is right within 2 cm in it and 5 cm around it.

    Around it the nearest point is a corner, whose mean hit lies a few centimetres along its two faces.
    """
    high = low + 0.8
    walls = [
        *rectangle(-3.0, -3.0, x + 3.0, 3.0),
        *rectangle(x, -3.0, x + 0.2, low),
        *rectangle(x, high, x + 0.2, 3.0),
    ]
    window = OccupancyWindow(12.0, 0.1)
    for k in range(7):
        robot = (x - 1.5 + 0.4 * k, 0.5 * (low + high))
        integrate(window, sweep(walls, Pose(x_m=robot[0], y_m=robot[1], z_m=SENSOR_Z_M)), *robot)
    clearance = layers_of(window).clearance_m
    middle = 0.5 * (low + high)
    for column_x in np.arange(x - 0.3, x + 0.55, 0.1):
        cell = window.spec.cell_of(column_x, middle)
        cx, cy = window.spec.centre_of(*cell)
        away = max(x - cx, 0.0, cx - x - 0.2)
        exact = min(math.hypot(away, cy - low), math.hypot(away, high - cy))
        assert clearance[cell] == pytest.approx(exact, abs=0.02 if away == 0.0 else 0.05), (cx, cy)


@given(
    steps=st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)), min_size=1, max_size=8),
    resolution_m=st.sampled_from([0.1, 0.2, 0.25]),
)
def test_rolling_keeps_what_stays_to_the_bit_and_forgets_what_left(
    steps: list[tuple[float, float]], resolution_m: float
) -> None:
    window = OccupancyWindow(3.0, resolution_m)
    rng = np.random.default_rng(0)
    names = ("log_odds", "hit_weight", "hit_x", "hit_y")
    world: dict[tuple[int, int], tuple[float, ...]] = {}
    x, y = 0.0, 0.0
    for dx, dy in steps:
        for name in names:
            getattr(window, name)[:] = rng.normal(size=window.spec.shape)
        s = window.spec
        world = {
            (s.ix0 + c, s.iy0 + r): tuple(float(getattr(window, n)[r, c]) for n in names)
            for r in range(s.height)
            for c in range(s.width)
        }
        x, y = x + dx, y + dy
        window.roll_to(x, y)
        s = window.spec
        assert s == window_around(x, y, 3.0, resolution_m)
        for r in range(s.height):
            for c in range(s.width):
                expected = world.get((s.ix0 + c, s.iy0 + r), (0.0,) * 4)
                assert tuple(float(getattr(window, n)[r, c]) for n in names) == expected


def test_rolling_within_a_cell_changes_nothing() -> None:
    window = OccupancyWindow(3.0, 0.1)
    before = window.log_odds
    window.roll_to(0.09, 0.01)
    assert window.log_odds is before

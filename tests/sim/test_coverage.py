"""The judge against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from planning.grid import GridSpec
from services.sim.config import CoverageSensorConfig
from services.sim.coverage import Judge
from services.sim.world import StartError, World, deepest_free_point
from tests.sim.helpers import box, brute_clearance_m, brute_sees, with_walls

SENSOR = CoverageSensorConfig()


def _random_world(seed: int) -> tuple[World, np.random.Generator]:
    rng = np.random.default_rng(seed)
    spec = GridSpec(0.1, -12, 5, 36, 30)
    occupied = rng.random(spec.shape) < 0.02
    x_m, y_m = deepest_free_point(spec, occupied)
    return World("random", spec, occupied, (x_m, y_m, 0.0)), rng


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.12, 0.2, 0.335]))
@settings(max_examples=15, deadline=None)
def test_reachable_ground_is_what_the_disc_sweeps(seed: int, radius_m: float) -> None:
    world, _ = _random_world(seed)
    centres = [[world.spec.centre_of(r, c) for c in range(36)] for r in range(30)]
    fits = np.array([[brute_clearance_m(world, *p) > radius_m - 1e-9 for p in row] for row in centres])
    start = world.spec.cell_of(*world.start[:2])
    if not fits[start]:
        with pytest.raises(StartError):
            Judge(world, radius_m, SENSOR)
        return
    parts, _ = ndimage.label(fits)
    swept = np.zeros_like(fits)
    for row, column in np.argwhere(parts == parts[start]):
        distance = np.hypot(np.arange(30)[:, None] - row, np.arange(36) - column)
        swept |= distance <= radius_m / 0.1 + 1e-9
    reachable = Judge(world, radius_m, SENSOR).reachable
    assert (reachable == swept).all()
    assert not (reachable & world.occupied).any()


@given(st.integers(0, 2**32 - 1), st.sampled_from([60.0, 120.0, 270.0, 360.0]))
@settings(max_examples=15, deadline=None)
def test_a_look_covers_what_brute_force_sees(seed: int, fov_deg: float) -> None:
    world, rng = _random_world(seed)
    judge = Judge(world, 0.12, CoverageSensorConfig(range_m=1.5, fov_deg=fov_deg))
    free = np.argwhere(judge.reachable)
    expected = np.zeros_like(judge.reachable)
    for _ in range(3):
        row, column = free[rng.integers(len(free))]
        x, y, yaw = column + rng.uniform(), row + rng.uniform(), rng.uniform(-math.pi, math.pi)
        before = np.count_nonzero(judge.covered)
        new = judge.update((x - 12) * 0.1, (y + 5) * 0.1, yaw)
        assert np.count_nonzero(judge.covered) - before == new
        for r, c in free:
            bearing = math.remainder(math.atan2(r + 0.5 - y, c + 0.5 - x) - yaw, 2 * math.pi)
            near = math.hypot(r + 0.5 - y, c + 0.5 - x) <= 15.0
            inside = near and abs(bearing) <= math.radians(fov_deg) / 2
            expected[r, c] |= inside and brute_sees(world.occupied, x, y, int(r), int(c), 20_001)
    assert (judge.covered == expected).all()
    assert judge.coverage_fraction == pytest.approx(expected.sum() / len(free))
    assert judge.covered_area_m2 == pytest.approx(expected.sum() * 0.01)


def test_a_sector_in_the_open_has_its_area() -> None:
    judge = Judge(box(20.0, 20.0), 0.335, CoverageSensorConfig(range_m=5.0, fov_deg=90.0))
    judge.update(10.0, 10.0, 0.3)
    assert judge.covered_area_m2 == pytest.approx(math.pi * 25.0 / 4.0, rel=0.01)
    assert judge.update(10.0, 10.0, 0.3) == 0


def test_a_room_loses_only_its_corners_to_a_disc() -> None:
    judge = Judge(box(4.0, 4.0, 0.02), 0.5, SENSOR)
    lost = 4.0 * (0.25 - math.pi * 0.25 / 4.0)
    assert judge.reachable_area_m2 == pytest.approx(16.0 - lost, rel=0.005)


@pytest.mark.parametrize(("gap_m", "reached"), [(0.65, False), (0.75, True)])
def test_a_doorway_opens_the_next_room_when_the_footprint_fits(gap_m: float, reached: bool) -> None:
    world = box(10.0, 4.0, 0.05, start=(2.0, 2.0, 0.0))
    world = with_walls(world, (5.0, 0.0, 5.2, 1.5), (5.0, 1.5 + gap_m, 5.2, 4.0))
    judge = Judge(world, 0.335, SENSOR)
    assert bool(judge.reachable[40, 160]) is reached
    # What lies behind a gap too narrow is not asked for, and seeing it gains nothing.
    judge.update(4.6, 1.8, 0.0)
    assert not judge.covered[~judge.reachable].any()


def test_coarse_worlds_are_judged_on_fine_cells() -> None:
    world = with_walls(box(10.0, 4.0, 0.5, start=(2.0, 2.0, 0.0)), (5.0, 0.0, 5.5, 1.5), (5.0, 2.5, 5.5, 4.0))
    judge = Judge(world, 0.335, SENSOR)
    assert judge.spec.resolution_m == pytest.approx(0.1)
    assert judge.reachable.shape == (40, 100)
    assert judge.reachable[20, 80]  # through a gap of two coarse cells


def test_no_holes_on_a_fine_grid() -> None:
    judge = Judge(box(14.0, 14.0, 0.03), 0.335, CoverageSensorConfig(fov_deg=360.0))
    judge.update(7.0, 7.0, 0.0)
    filled = ndimage.binary_fill_holes(judge.covered)
    assert (filled == judge.covered).all()


def test_coverage_can_be_restored() -> None:
    world = box(8.0, 8.0)
    judge, other = Judge(world, 0.335, SENSOR), Judge(world, 0.335, SENSOR)
    judge.update(4.0, 4.0, 1.0)
    other.set_covered(judge.covered)
    assert other.coverage_fraction == judge.coverage_fraction > 0.0
    assert other.update(4.0, 4.0, 1.0) == 0
    assert other.update(4.0, 4.0, -2.0) == judge.update(4.0, 4.0, -2.0) > 0
    with pytest.raises(ValueError, match="shape"):
        other.set_covered(np.zeros((3, 3), dtype=np.bool_))


def test_a_start_without_room_is_refused() -> None:
    world = with_walls(box(4.0, 4.0), (2.2, 0.0, 2.4, 4.0), (1.6, 0.0, 1.8, 4.0))
    with pytest.raises(StartError, match="does not fit"):
        Judge(world, 0.335, SENSOR)


def test_what_was_covered_before_a_door_closed_is_news_for_the_journal_all_the_same() -> None:
    world = box(4.0, 4.0)
    judge = Judge(world, 0.2, SENSOR)
    judge.update(2.0, 2.0, 0.0)
    covered = judge.covered.copy()
    judge.take_over(world.occupied, judge.reachable)
    assert covered.any()
    assert set(judge.take_news().tolist()) == set(np.flatnonzero(covered).tolist())
    assert judge.take_news().size == 0

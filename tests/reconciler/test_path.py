"""The driven line: smoothing, projection, hazards, speeds; each against plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.grid import FREE, UNKNOWN
from planning.search import dijkstra_box, trace_path
from services.reconciler.config import Config
from services.reconciler.path import (
    STEP_M,
    Ground,
    arc_lengths,
    first_hazard,
    headings,
    project,
    resample,
    round_corners,
    smooth,
    speeds,
)
from tests.reconciler.grounds import ground_of, random_ground

CONFIG = Config()
SEEDS = st.integers(0, 2**32 - 1)
Line = NDArray[np.float64]


def clearance_at(ground: Ground, x: float, y: float) -> float:
    """Bilinear between cell centres."""
    s = ground.spec
    column, row = x / s.resolution_m - s.ix0 - 0.5, y / s.resolution_m - s.iy0 - 0.5
    column, row = min(max(column, 0.0), s.width - 1.0), min(max(row, 0.0), s.height - 1.0)
    c, r = min(int(column), s.width - 2), min(int(row), s.height - 2)
    u, v = column - c, row - r
    f = ground.clearance_m.astype(float)
    low = (1 - u) * f[r, c] + u * f[r, c + 1]
    high = (1 - u) * f[r + 1, c] + u * f[r + 1, c + 1]
    return float((1 - v) * low + v * high)


def least_clearance(ground: Ground, line: Line) -> float:
    """The smallest clearance on a line, looked at every centimetre."""
    s = arc_lengths(line)
    at = np.arange(0.0, s[-1], 0.01)
    return min(
        clearance_at(ground, float(x), float(y))
        for x, y in zip(np.interp(at, s, line[:, 0]), np.interp(at, s, line[:, 1]), strict=True)
    )


def grid_path(ground: Ground, seed: int) -> Line | None:
    """A shortest path of grid cells between two random places where the robot fits: zigzag and close to boulders."""
    rng, s = np.random.default_rng(seed), ground.spec
    passable = ground.clearance_m >= rng.uniform(CONFIG.footprint_radius_m + 0.01, CONFIG.comfort_clearance_m)
    cells = np.argwhere(passable)
    start, end = cells[rng.integers(len(cells))], cells[rng.integers(len(cells))]
    cost, parent = np.full(s.shape, np.inf), np.full(s.shape, -1, np.int32)
    dijkstra_box(
        np.ones(s.shape, np.float32), passable, s.resolution_m, int(start[0]), int(start[1]),
        (0, s.height, 0, s.width), np.empty((0, 2), np.int32), 100.0, cost, parent,
    )  # fmt: skip
    if not np.isfinite(cost[end[0], end[1]]) or cost[end[0], end[1]] < 2.0:
        return None
    found = trace_path(parent, int(end[0]), int(end[1]))
    return np.array(
        [s.centre_of(int(r), int(c)) for r, c in found[::4]] + [s.centre_of(int(end[0]), int(end[1]))]
    )


# --- smoothing ----------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(SEEDS)
def test_smoothing_never_goes_nearer_to_obstacles_than_the_line_did(seed: int) -> None:
    """Below the comfort clearance nothing gets worse, by more than a centimetre."""
    ground = random_ground(seed)
    line = grid_path(ground, seed)
    assume(line is not None)
    assert line is not None
    smoothed = smooth(line, 0, ground, CONFIG)
    before, after = least_clearance(ground, line), least_clearance(ground, smoothed)
    assert after >= min(before, CONFIG.comfort_clearance_m) - 0.01
    np.testing.assert_array_equal(smoothed[0], line[0])
    np.testing.assert_allclose(smoothed[-1], line[-1], atol=1e-12)
    assert arc_lengths(smoothed)[-1] < 1.25 * arc_lengths(line)[-1] + 0.2


@given(SEEDS, st.integers(1, 12))
def test_smoothing_keeps_the_fixed_points_to_the_bit(seed: int, fixed: int) -> None:
    ground = random_ground(seed, boulders=4)
    line = grid_path(ground, seed)
    assume(line is not None and len(line) > fixed)
    assert line is not None
    smoothed = smooth(line, fixed, ground, CONFIG)
    assert smoothed[:fixed].tobytes() == line[:fixed].tobytes()


def test_smoothing_shortens_a_zigzag_and_bends_a_corner() -> None:
    ground = ground_of(np.zeros((100, 100), np.bool_))
    zigzag = np.array([(0.1 * i, 0.1 * (i % 2)) for i in range(30)])
    smoothed = smooth(zigzag, 0, ground, CONFIG)
    assert arc_lengths(smoothed)[-1] < 1.05 * math.dist(zigzag[0], zigzag[-1])
    corner = np.array([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (2.0, 2.0)])
    bent = smooth(corner, 0, ground, CONFIG)
    turns = np.abs(np.diff(np.unwrap(headings(bent))))
    assert turns.max() < math.radians(40.0)


def test_smoothing_goes_through_pinned_points_and_keeps_their_corners() -> None:
    """A look back from a place a little aside: a smooth line would pass it by under another heading."""
    ground = ground_of(np.zeros((100, 100), np.bool_))
    line = np.array([(1.0, 1.0), (2.0, 1.0), (2.0, 0.7), (3.0, 1.0), (4.0, 1.0)])
    free, pinned = smooth(line, 0, ground, CONFIG), smooth(line, 0, ground, CONFIG, np.array([1, 2]))
    for point in line[1:3]:
        assert np.hypot(*(pinned - point).T).min() < 1e-9
    assert np.hypot(*(free - line[2]).T).min() > 0.1
    assert np.abs(np.sin(headings(pinned)) + 1.0).min() < 1e-9, "it heads south on the way between the two"
    fixed = smooth(line, 3, ground, CONFIG, np.array([0, 2, 4]))
    assert fixed[:3].tobytes() == line[:3].tobytes()


def test_smoothing_pushes_a_line_off_a_wall() -> None:
    lethal = np.zeros((60, 100), np.bool_)
    lethal[:30] = True
    ground = ground_of(lethal)
    line = np.array([(x, 0.3) for x in np.arange(0.0, 4.0, 0.5)])
    smoothed = smooth(line, 0, ground, CONFIG)
    middle = smoothed[len(smoothed) // 2]
    assert clearance_at(ground, *middle) > clearance_at(ground, 2.0, 0.3) + 0.05


def rounded(ground: Ground, line: Line, begin: int = 0) -> Line:
    """A copy of the line with its corners rounded."""
    found, s = line.copy(), ground.spec
    round_corners(found, begin, ground.clearance_m, s.resolution_m, s.ix0, s.iy0, CONFIG.comfort_clearance_m)
    return found


def sharpest(line: Line) -> float:
    """The greatest turn at a point, rad."""
    return float(np.abs(np.diff(np.unwrap(headings(line)))).max())


@pytest.mark.parametrize("degrees", [40, 60, 90, 120, 150, 180])
def test_corners_up_to_130_degrees_become_arcs_that_are_driven_without_a_stop(degrees: int) -> None:
    ground, turn = ground_of(np.zeros((100, 100), np.bool_)), math.radians(degrees)
    way = np.array([(2.0 + math.cos(turn) * s, 3.0 + math.sin(turn) * s) for s in np.arange(0.1, 2.05, 0.1)])
    line = np.concatenate([np.array([(x, 3.0) for x in np.arange(0.5, 2.05, 0.1)]), way])
    arc = rounded(ground, line)
    assert len(arc) == len(line)
    if degrees > 130:
        assert arc.tobytes() == line.tobytes(), "the robot turns on the spot"
        return
    assert sharpest(arc) < math.radians(25.0)
    assert np.hypot(*(arc - line).T).max() < 0.3
    np.testing.assert_array_equal(arc[[0, 1, -2, -1]], line[[0, 1, -2, -1]])
    assert rounded(ground, arc).tobytes() == arc.tobytes(), "an arc is no corner"
    assert speeds(arc, 1.0, ground, CONFIG, 1.0)[0][2:-6].min() >= CONFIG.min_speed_mps - 1e-9


@settings(max_examples=40)
@given(SEEDS, st.integers(0, 30))
def test_arcs_come_no_nearer_to_obstacles_and_begin_where_they_may(seed: int, begin: int) -> None:
    ground = random_ground(seed)
    line = grid_path(ground, seed)
    assume(line is not None)
    assert line is not None
    line = resample(line)
    arcs = rounded(ground, line, begin)
    assert arcs[: begin + 1].tobytes() == line[: begin + 1].tobytes()
    moved = np.flatnonzero((arcs != line).any(axis=1))
    for i in moved.tolist():
        near = line[max(i - 5, 0) : i + 6]
        before = min(clearance_at(ground, float(x), float(y)) for x, y in near)
        after = clearance_at(ground, *arcs[i].tolist())
        assert after >= min(before, CONFIG.comfort_clearance_m) - 0.005


def test_points_are_a_step_apart() -> None:
    line = np.array([(0.0, 0.0), (1.05, 0.0), (1.05, 2.0)])
    s = arc_lengths(resample(line))
    assert np.all(np.diff(s) <= STEP_M + 1e-12)
    assert np.median(np.diff(s)) > 0.95 * STEP_M
    np.testing.assert_array_equal(resample(line)[[0, -1]], line[[0, -1]])
    assert len(resample(np.array([(1.0, 2.0), (1.0, 2.0)]))) == 1


# --- where on it, and what is on it -------------------------------------------------------------------------------


@given(SEEDS)
def test_projection_is_the_nearest_point_of_the_window(seed: int) -> None:
    rng = np.random.default_rng(seed)
    line = rng.uniform(-3, 3, (20, 2))
    x, y = rng.uniform(-3, 3, 2)
    low = int(rng.integers(0, 20))
    high = int(rng.integers(low, 20))
    index, distance = project(line, x, y, low, high)
    expected = min((math.dist(line[i], (x, y)), i) for i in range(low, high + 1))
    assert index == expected[1]
    assert distance == pytest.approx(expected[0])


@settings(max_examples=40)
@given(SEEDS)
def test_the_first_hazard(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = random_ground(seed, size=60, boulders=3)
    ground.state[rng.integers(0, 60, 30), rng.integers(0, 60, 30)] = UNKNOWN
    s = ground.spec
    angle = rng.uniform(0, 2 * math.pi)
    x0, y0 = (s.ix0 + 30) * 0.1, (s.iy0 + 30) * 0.1
    line = np.array([(x0 + 0.1 * i * math.cos(angle), y0 + 0.1 * i * math.sin(angle)) for i in range(50)])
    begin, needed = int(rng.integers(0, 10)), float(rng.uniform(0.05, 0.4))
    expected = -1
    for i in range(begin, 50):
        row, column = s.cell_of(*line[i])
        fits = s.contains(row, column) and ground.state[row, column] == FREE
        if not fits or clearance_at(ground, *line[i]) < needed:
            expected = i
            break
    assert expected >= 0, "the line leaves the map"
    found = first_hazard(line, begin, ground.state, ground.clearance_m, s.resolution_m, s.ix0, s.iy0, needed)
    assert found == expected


def test_no_hazard() -> None:
    ground = ground_of(np.zeros((60, 60), np.bool_))
    s, line = ground.spec, np.array([(-1.0 + 0.1 * i, 0.0) for i in range(20)])
    assert first_hazard(line, 0, ground.state, ground.clearance_m, s.resolution_m, s.ix0, s.iy0, 0.25) == -1


# --- speeds -------------------------------------------------------------------------------------------------------


def wavy(seed: int) -> Line:
    """A line of bends, none of them sharper than the slowest speed allows to turn."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.uniform(-0.25, 0.25, 60))
    line: Line = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * STEP_M, axis=0)
    line[:, 0] -= 2.0
    return line


@given(SEEDS, st.floats(0.0, 1.0), st.sampled_from([1.0, 0.5]))
def test_speeds_keep_every_limit(seed: int, now_mps: float, share: float) -> None:
    ground = random_ground(seed, boulders=6)
    line = wavy(seed)
    speed, time_s = speeds(line, now_mps, ground, CONFIG, share)
    s = arc_lengths(line)
    assert speed[-1] == 0.0
    assert np.all(speed >= 0.0) and np.all(speed <= CONFIG.max_speed_mps * share + 1e-9)
    assert speed[0] <= max(now_mps, CONFIG.min_speed_mps) + 1e-9
    change = np.diff(speed**2) / (2.0 * np.diff(s))
    assert np.all(np.abs(change) <= CONFIG.max_acceleration_mps2 + 1e-9)
    for i in range(2, len(line) - 3):
        turned = abs(math.remainder(float(headings(line)[i + 2] - headings(line)[i - 2]), 2.0 * math.pi))
        assert speed[i] * turned / (4 * STEP_M) <= CONFIG.max_turn_rate_radps + 1e-6
    for i, (x, y) in enumerate(line):
        if clearance_at(ground, float(x), float(y)) <= CONFIG.tight_clearance_m:
            assert speed[i] <= CONFIG.min_speed_mps + 1e-9
    assert time_s[0] == 0.0
    assert np.all(np.diff(time_s) > 0.0)
    driven = np.diff(s) / np.diff(time_s)
    assert np.all(driven <= np.maximum(speed[1:], speed[:-1]) + 0.05 + 1e-9)


def test_a_long_straight_line_is_driven_at_full_speed_and_braked_in_time() -> None:
    ground = ground_of(np.zeros((100, 100), np.bool_))
    line = np.array([(-3.0 + 0.1 * i, 0.0) for i in range(61)])
    speed, time_s = speeds(line, 0.0, ground, CONFIG, 1.0)
    assert speed.max() == pytest.approx(CONFIG.max_speed_mps)
    braking_m = CONFIG.max_speed_mps**2 / (2.0 * CONFIG.max_acceleration_mps2)
    assert speed[round((6.0 - braking_m) / 0.1) - 1] == pytest.approx(CONFIG.max_speed_mps)
    assert 6.0 < time_s[-1] < 9.0


def test_degenerate_lines() -> None:
    ground = ground_of(np.zeros((20, 20), np.bool_))
    for line in (np.zeros((0, 2)), np.zeros((1, 2))):
        speed, time_s = speeds(line, 0.5, ground, CONFIG, 1.0)
        assert speed.tolist() == time_s.tolist() == [0.0] * len(line)
        assert headings(line).tolist() == [0.0] * len(line)

"""Slope, roughness, steps and drops of height fields against brute force and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.riskmap.terrain import Ground, TerrainMetrics, close_holes, spread_heights, terrain_metrics

RADIUS_M, MAX_SLOPE, STEP_REACH_M, DROP_REACH_M = 0.335, 0.45, 0.25, 1.5


def metrics(
    height_m: NDArray[np.float64],
    resolution_m: float = 0.1,
    sigma_m: float = 0.01,
    known: NDArray[np.bool_] | None = None,
    bounded: NDArray[np.bool_] | None = None,
    drift_m: NDArray[np.float64] | None = None,
) -> TerrainMetrics:
    variance = np.full(height_m.shape, sigma_m**2, np.float32)
    none = np.zeros(height_m.shape, np.bool_)
    ground = Ground(
        height_m.astype(np.float32), variance, variance,
        np.zeros(height_m.shape, np.float32) if drift_m is None else drift_m.astype(np.float32),
        ~none if known is None else known, none if bounded is None else bounded,
    )  # fmt: skip
    return terrain_metrics(ground, resolution_m, RADIUS_M, MAX_SLOPE, STEP_REACH_M, DROP_REACH_M)


def centres(n: int, resolution_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = (np.arange(n) + 0.5) * resolution_m
    grid = np.meshgrid(x, x)
    return grid[0], grid[1]


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), share=st.sampled_from([0.5, 0.8, 1.0]))
def test_the_plane_is_that_of_weighted_least_squares(seed: int, share: float) -> None:
    """Against numpy, cell by cell, with holes and unequal variances."""
    rng = np.random.default_rng(seed)
    n, res = 14, 0.1
    height = rng.normal(0.0, 0.1, (n, n)) + 100.0
    variance = rng.uniform(1e-5, 4e-3, (n, n)).astype(np.float32)
    known = rng.random((n, n)) < share
    none = np.zeros((n, n), np.bool_)
    zero = np.zeros((n, n), np.float32)
    found = terrain_metrics(
        Ground(height.astype(np.float32), variance, variance, zero, known, none), res, RADIUS_M, 1.0, 0.2, 0.5
    )
    x, y = centres(n, res)
    z = height.astype(np.float32).astype(np.float64)
    disc = sum(1 for r in range(-3, 4) for c in range(-3, 4) if math.hypot(r, c) * res <= RADIUS_M + 1e-9)
    for r in range(n):
        for c in range(n):
            near = known & (np.hypot(x - x[r, c], y - y[r, c]) <= RADIUS_M + 1e-9)
            if not known[r, c] or near.sum() < 0.35 * disc:
                assert not found.fitted[r, c]
                continue
            w = 0.02**2 / (variance[near].astype(np.float64) + 0.02**2)
            a = np.column_stack([x[near] - x[r, c], y[near] - y[r, c], np.ones(near.sum())])
            root = np.sqrt(w)
            plane = np.linalg.lstsq(a * root[:, None], z[near] * root, rcond=None)[0]
            if not found.fitted[r, c]:
                continue
            residual = math.sqrt(np.average((z[near] - a @ plane) ** 2, weights=w))
            assert found.slope_rad[r, c] == pytest.approx(math.atan(math.hypot(*plane[:2])), abs=1e-4)
            assert found.roughness_m[r, c] == pytest.approx(residual, abs=1e-4)
    if share == 1.0:
        assert found.fitted.all()


@given(slope=st.floats(0.0, 0.8), heading=st.floats(0.0, 6.28), resolution_m=st.sampled_from([0.1, 0.2, 0.4]))
def test_a_plane_has_its_slope_and_nothing_else(slope: float, heading: float, resolution_m: float) -> None:
    x, y = centres(24, resolution_m)
    rise = math.tan(slope)
    found = metrics(rise * (math.cos(heading) * x + math.sin(heading) * y), resolution_m)
    inner = (slice(4, -4), slice(4, -4))
    assert found.slope_rad[inner] == pytest.approx(slope, abs=2e-3)
    assert found.roughness_m.max() < 2e-3
    allowed = max(rise - MAX_SLOPE, 0.0) * 3 * resolution_m
    assert found.step_m[inner].max() <= allowed + 1e-3
    assert found.drop_m.max() == 0.0


@pytest.mark.parametrize("rise", [0.04, 0.12, 0.3, -0.2])
@pytest.mark.parametrize("between", [0.0, 0.5])
def test_a_ledge_is_a_step_of_its_height_at_its_edge_alone(rise: float, between: float) -> None:
    """Also where the edge lies inside a column of cells, whose heights are in between."""
    height = np.zeros((20, 20))
    height[:, 10:] = rise
    if between:
        height[:, 10] = between * rise
    found = metrics(height)
    edge = [10] if between else [9, 10]
    assert found.step_m[5, edge] == pytest.approx(abs(rise), abs=1e-6)
    away = [c for c in range(20) if c not in (9, 10, 11)]
    assert found.step_m[5, away].max() == 0.0


def test_a_ledge_on_a_slope_is_not_explained_by_the_slope() -> None:
    x, _ = centres(24, 0.1)
    found = metrics(0.3 * x + np.where(x > 1.2, 0.15, 0.0))
    assert found.step_m[10, 11] == pytest.approx(0.15, abs=0.01)
    assert found.step_m[10, 4:9].max() < 1e-3


def test_a_seam_between_old_and_new_ground_is_an_uncertain_step() -> None:
    """The heights of both sides have drifted apart since the old one was looked at."""
    height = np.zeros((12, 12))
    height[:, 6:] = 0.1
    drift = np.zeros((12, 12))
    drift[:, :6] = 0.2
    seam = metrics(height, drift_m=drift)
    assert seam.step_m[5, 6] == pytest.approx(0.1, abs=1e-6)
    assert seam.step_variance[5, 6] == pytest.approx(0.2**2 + 2e-4, rel=1e-3)
    assert seam.step_variance[5, 2] < 1e-3


def test_an_edge_over_lower_ground_is_a_drop_and_its_surroundings_are_not() -> None:
    height = np.zeros((20, 40))
    height[:, 20:] = -0.6
    known = np.ones(height.shape, np.bool_)
    known[:, 12:20] = False
    found = metrics(height, known=known)
    assert found.drop_m[5, 11] == pytest.approx(0.6, abs=1e-6)
    assert found.drop_m[5, :11].max() == 0.0 and found.drop_m[5, 20:].max() == 0.0


def test_a_hidden_piece_of_an_even_slope_is_no_drop() -> None:
    height = np.tile(-0.03 * np.arange(40.0), (20, 1))
    known = np.ones(height.shape, np.bool_)
    known[:, 12:20] = False
    assert metrics(height, known=known).drop_m.max() < 1e-5


def test_a_pit_whose_ground_is_only_known_to_be_low_is_a_drop() -> None:
    height = np.zeros((20, 40))
    known, bounded = np.ones(height.shape, np.bool_), np.zeros(height.shape, np.bool_)
    known[:, 12:] = False
    bounded[:, 18] = True
    height[:, 18] = -0.4
    found = metrics(height, known=known, bounded=bounded)
    assert found.drop_m[5, 11] == pytest.approx(0.4, abs=1e-6)
    assert metrics(height, known=known).drop_m.max() == 0.0


def test_roughness_is_the_deviation_from_the_plane() -> None:
    rng = np.random.default_rng(3)
    x, y = centres(60, 0.1)
    found = metrics(0.2 * x - 0.1 * y + rng.normal(0.0, 0.05, x.shape))
    inner = found.roughness_m[5:-5, 5:-5]
    assert float(np.sqrt((inner.astype(np.float64) ** 2).mean())) == pytest.approx(
        0.05 * math.sqrt(34 / 37), rel=0.03
    )


def test_less_certain_heights_make_a_less_certain_slope() -> None:
    flat = np.zeros((12, 12))
    assert (
        metrics(flat, sigma_m=0.05).slope_variance[6, 6]
        > 5 * metrics(flat, sigma_m=0.01).slope_variance[6, 6]
    )


def test_holes_close_only_among_like_neighbours() -> None:
    height = np.zeros((5, 9), np.float32)
    height[:, 7:] = 0.5
    known = np.ones((5, 9), np.bool_)
    known[2, 2] = known[2, 7] = False
    variance = np.full((5, 9), 1e-4, np.float32)
    height[2, 2] = 99.0
    close_holes(height, variance, known, np.zeros((5, 9), np.bool_), 0.1, 0.05)
    assert known[2, 2] and height[2, 2] == 0.0
    assert variance[2, 2] == pytest.approx(1e-4 + 0.05**2)
    assert not known[2, 7]


def test_unknown_cells_take_a_near_height_or_the_robots() -> None:
    height = np.full((6, 6), 77.0, np.float32)
    known = np.zeros((6, 6), np.bool_)
    known[1, 1], height[1, 1] = True, 2.0
    known[5, 5], height[5, 5] = True, 3.0
    spread_heights(height, known, -1.0)
    assert height[0, 0] == 2.0 and height[4, 5] == 3.0 and height[1, 2] == 2.0
    bare = np.full((4, 4), 5.0, np.float32)
    spread_heights(bare, np.zeros((4, 4), np.bool_), -1.0)
    assert (bare == -1.0).all()

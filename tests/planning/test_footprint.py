"""Swept footprints against brute force: clearance, disc means, risk of a segment at several cell sizes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning import footprint
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec

Field = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
RADIUS_M = 0.335


def _rasterise(field: Field, spec: GridSpec, samples: int = 8) -> NDArray[np.float32]:
    """Mean of the field over each cell (area fraction for indicator fields)."""
    fine = spec.resolution_m / samples
    x: NDArray[Any] = spec.ix0 * spec.resolution_m + (np.arange(spec.width * samples) + 0.5) * fine
    y: NDArray[Any] = spec.iy0 * spec.resolution_m + (np.arange(spec.height * samples) + 0.5) * fine
    values = field(x[None, :], y[:, None])
    cells = values.reshape(spec.height, samples, spec.width, samples)
    result: NDArray[np.float32] = cells.mean(axis=(1, 3)).astype(np.float32)
    return result


def _true_integral(field: Field, x0: float, y0: float, x1: float, y1: float) -> float:
    """Integral over the segment of the field's mean under the disc, by dense sampling."""
    offsets = (np.arange(41) + 0.5) / 41 * 2 - 1
    grid_x, grid_y = np.meshgrid(offsets * RADIUS_M, offsets * RADIUS_M)
    inside = np.hypot(grid_x, grid_y) <= RADIUS_M
    t = (np.arange(400) + 0.5) / 400
    centre_x, centre_y = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
    values = field(centre_x[:, None] + grid_x[inside][None, :], centre_y[:, None] + grid_y[inside][None, :])
    return float(values.mean()) * math.hypot(x1 - x0, y1 - y0)


def _smooth(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.05 + 0.04 * np.sin(x) * np.cos(0.8 * y) + 0.2 * np.exp(-((x - 4) ** 2 + (y - 3) ** 2) / 2)


def _edges(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    blob = np.hypot(x - 3.03, y - 3.11) < 0.9
    other = np.hypot(x - 5.9, y - 4.27) < 0.7
    band = (x + 0.3 * y > 6.83) & (x + 0.3 * y < 7.6)
    result: NDArray[np.float64] = 0.02 + 0.3 * blob + 0.5 * other + 0.2 * band
    return result


@pytest.mark.parametrize("field", [_smooth, _edges])
@pytest.mark.parametrize(
    "segment", [(1.0, 2.9, 8.5, 3.4), (1.1, 1.3, 7.7, 6.9), (2.0, 3.5, 7.9, 4.0), (3.2, 1.0, 3.2, 6.3)]
)
def test_rho_is_the_same_at_every_cell_size(field: Field, segment: tuple[float, float, float, float]) -> None:
    truth = 1 - math.exp(-_true_integral(field, *segment))
    for resolution_m in (0.1, 0.2, 0.4):
        spec = GridSpec(resolution_m, -5, -7, round(11 / resolution_m), round(11 / resolution_m))
        hazard = footprint.footprint_hazard(_rasterise(field, spec), RADIUS_M, resolution_m)
        distance, integral = footprint.segment_risk(hazard, resolution_m, spec.ix0, spec.iy0, *segment)
        assert distance == pytest.approx(math.hypot(segment[2] - segment[0], segment[3] - segment[1]))
        assert 1 - math.exp(-integral) == pytest.approx(truth, rel=0.05), resolution_m


def test_risk_adds_along_a_path_and_is_the_same_backwards() -> None:
    spec = GridSpec(0.2, 0, 0, 60, 60)
    hazard = footprint.footprint_hazard(_rasterise(_smooth, spec), RADIUS_M, 0.2)
    points = [(1.0, 1.0), (3.0, 2.0), (4.5, 6.0)]
    whole = footprint.segment_risk(hazard, 0.2, 0, 0, 1.0, 1.0, 4.5, 6.0)[1]
    back = footprint.segment_risk(hazard, 0.2, 0, 0, 4.5, 6.0, 1.0, 1.0)[1]
    assert back == pytest.approx(whole, rel=1e-9)
    middle = (1.0 + 0.4 * 3.5, 1.0 + 0.4 * 5.0)
    first = footprint.segment_risk(hazard, 0.2, 0, 0, 1.0, 1.0, *middle)[1]
    second = footprint.segment_risk(hazard, 0.2, 0, 0, *middle, 4.5, 6.0)[1]
    assert first + second == pytest.approx(whole, rel=1e-3)
    assert footprint.segment_risk(hazard, 0.2, 0, 0, *points[0], *points[0]) == (0.0, 0.0)


@pytest.mark.parametrize(("radius_m", "resolution_m"), [(0.335, 0.1), (0.335, 0.2), (0.25, 0.4), (0.6, 0.17)])
def test_disc_weights_are_area_fractions(radius_m: float, resolution_m: float) -> None:
    weights = footprint.disc_weights(radius_m, resolution_m)
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert np.array_equal(weights, weights.T) and np.array_equal(weights, weights[::-1])
    half = weights.shape[0] // 2
    inner = math.pi * radius_m**2
    centre_is_inside = math.hypot(0.5, 0.5) * resolution_m <= radius_m
    if centre_is_inside:
        assert weights[half, half] == pytest.approx(resolution_m**2 / inner, rel=0.01)
    assert weights[half, 0] > 0 and (half + 0.5) * resolution_m >= radius_m


def test_disc_without_radius_is_one_cell() -> None:
    assert footprint.disc_weights(0.0, 0.2).tolist() == [[1.0]]
    assert footprint.disc_weights(0.05, 0.2).tolist() == [[1.0]]


def test_footprint_hazard_of_a_constant_field_is_that_constant_up_to_the_edges() -> None:
    field = np.full((9, 12), 0.3, np.float32)
    assert footprint.footprint_hazard(field, RADIUS_M, 0.1) == pytest.approx(field, rel=1e-5)


@given(seed=st.integers(0, 10_000), with_hits=st.booleans())
def test_clearance_equals_the_nearest_representative_point(seed: int, with_hits: bool) -> None:
    rng = np.random.default_rng(seed)
    height, width, resolution_m = 14, 19, 0.2
    lethal = rng.random((height, width)) < 0.05
    lethal[3, 4] = True
    hit_x = rng.uniform(-0.1, 0.1, lethal.shape).astype(np.float32) if with_hits else None
    hit_y = rng.uniform(-0.1, 0.1, lethal.shape).astype(np.float32) if with_hits else None
    if hit_x is not None and hit_y is not None:
        hit_x[3, 4] = hit_y[3, 4] = np.nan
    spec = GridSpec(resolution_m, 7, -3, width, height)
    result = footprint.clearance_m(lethal, hit_x, hit_y, spec, max_clearance_m=1.5)
    rows, columns = np.nonzero(lethal)
    points_x = columns * resolution_m + (0 if hit_x is None else np.nan_to_num(hit_x)[lethal])
    points_y = rows * resolution_m + (0 if hit_y is None else np.nan_to_num(hit_y)[lethal])
    for row in range(height):
        for column in range(width):
            gap = np.hypot(points_x - column * resolution_m, points_y - row * resolution_m).min()
            expected = 0.0 if lethal[row, column] else min(1.5, float(gap))
            # With sub-cell hits vector propagation rarely misses a point, and then by little.
            assert result[row, column] == pytest.approx(expected, abs=0.02 if with_hits else 1e-5)


def test_clearance_without_lethal_cells_is_the_cap() -> None:
    result = footprint.clearance_m(np.zeros((3, 4), np.bool_), None, None, GridSpec(0.2, 0, 0, 4, 3), 2.5)
    assert result.tolist() == [[2.5] * 4] * 3


def _scene(seed: int) -> tuple[NDArray[np.bool_], GridSpec]:
    rng = np.random.default_rng(seed)
    return rng.random((40, 40)) < 0.01, GridSpec(0.2, -20, 5, 40, 40)


@given(seed=st.integers(0, 10_000), ends=st.tuples(*[st.floats(0.3, 7.7)] * 4))
def test_min_clearance_is_that_of_the_swept_capsule(
    seed: int, ends: tuple[float, float, float, float]
) -> None:
    lethal, spec = _scene(seed)
    lethal[20, 20] = True
    clearance = footprint.clearance_m(lethal, None, None, spec)
    x0, y0, x1, y1 = ends[0] - 4.0, ends[1] + 1.0, ends[2] - 4.0, ends[3] + 1.0
    result = footprint.segment_min_clearance(clearance, 0.2, spec.ix0, spec.iy0, x0, y0, x1, y1)
    rows, columns = np.nonzero(lethal)
    lethal_x, lethal_y = spec.centres_x()[columns], spec.centres_y()[rows]
    t = np.linspace(0, 1, 2001)[:, None]
    gaps = np.hypot(x0 + t * (x1 - x0) - lethal_x, y0 + t * (y1 - y0) - lethal_y).min(axis=0)
    exact = float(gaps.min())
    assert result <= exact + 0.2**2 / (4 * max(exact, 0.1)) + 0.05 + 1e-6
    assert result >= exact - 0.1


def _sampled_state(state: NDArray[np.uint8], spec: GridSpec, ends: tuple[float, float, float, float]) -> int:
    t = np.linspace(0, 1, 20_001)
    columns = np.floor((ends[0] + t * (ends[2] - ends[0])) / spec.resolution_m).astype(int) - spec.ix0
    rows = np.floor((ends[1] + t * (ends[3] - ends[1])) / spec.resolution_m).astype(int) - spec.iy0
    inside = (rows >= 0) & (columns >= 0) & (rows < spec.height) & (columns < spec.width)
    values = np.where(inside, state[rows.clip(0, spec.height - 1), columns.clip(0, spec.width - 1)], UNKNOWN)
    if (values == LETHAL).any():
        return LETHAL
    return UNKNOWN if (values == UNKNOWN).any() else FREE


@given(seed=st.integers(0, 10_000))
def test_segment_state_equals_dense_sampling(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = np.full((12, 15), FREE, np.uint8)
    state[rng.random(state.shape) < 0.06] = UNKNOWN
    state[rng.random(state.shape) < 0.04] = LETHAL
    spec = GridSpec(0.25, -4, 3, 15, 12)
    x = rng.uniform(-1.2, 3.0, 2)
    y = rng.uniform(0.6, 3.9, 2)
    ends = (float(x[0]), float(y[0]), float(x[1]), float(y[1]))
    assert footprint.segment_state(state, 0.25, -4, 3, *ends) == _sampled_state(state, spec, ends)


def test_segment_state_on_axes_and_diagonals() -> None:
    state = np.full((5, 5), FREE, np.uint8)
    state[2, 3] = LETHAL
    assert footprint.segment_state(state, 1.0, 0, 0, 0.5, 2.5, 2.9, 2.5) == FREE
    assert footprint.segment_state(state, 1.0, 0, 0, 0.5, 2.5, 4.5, 2.5) == LETHAL
    assert footprint.segment_state(state, 1.0, 0, 0, 3.5, 4.5, 3.5, 0.5) == LETHAL
    assert footprint.segment_state(state, 1.0, 0, 0, 2.5, 3.5, 4.5, 1.5) == LETHAL
    assert footprint.segment_state(state, 1.0, 0, 0, 1.5, 2.5, 3.5, 0.5) == FREE
    assert footprint.segment_state(state, 1.0, 0, 0, 0.5, 0.5, -0.5, 0.5) == UNKNOWN
    assert footprint.segment_state(state, 1.0, 0, 0, 3.5, 2.5, 3.5, 2.5) == LETHAL

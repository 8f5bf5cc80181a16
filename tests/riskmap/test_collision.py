"""Hazard, state and clearance from evidence: monotone, bounded, and equal to brute force and to integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, stats

from planning.footprint import footprint_hazard, segment_risk
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from services.riskmap.collision import RiskLayers, collision_layers, cvar_factor, stamp_clearance

HAZARD_PER_M, CLAMP, FREE_BELOW, REACH_M = 2.0, 4.0, 0.4, 1.5


def layers(log_odds: NDArray[np.float32], alpha: float = 0.9, resolution_m: float = 0.1) -> RiskLayers:
    none = np.zeros_like(log_odds)
    return collision_layers(
        log_odds, none, none, resolution_m, FREE_BELOW, CLAMP, HAZARD_PER_M, alpha, REACH_M
    )


@pytest.mark.parametrize("alpha", [0.05, 0.5, 0.9, 0.99])
def test_cvar_factor_is_the_mean_of_the_normal_tail(alpha: float) -> None:
    quantile = stats.norm.ppf(alpha)
    tail, _ = integrate.quad(lambda z: z * stats.norm.pdf(z), quantile, np.inf)
    assert cvar_factor(alpha) == pytest.approx(tail / (1 - alpha), rel=1e-7)


@given(
    evidence=st.lists(st.floats(-CLAMP, CLAMP, width=32), min_size=2, max_size=40),
    alpha=st.sampled_from([0.1, 0.5, 0.9, 0.98]),
)
def test_more_evidence_is_never_less_hazard(evidence: list[float], alpha: float) -> None:
    """Mean and CVaR grow with the evidence, over the borders of the states too; CVaR is at least the mean."""
    result = layers(np.sort(np.array([evidence], dtype=np.float32)), alpha)
    assert (np.diff(result.hazard_mean[0]) >= -1e-6).all()
    assert (np.diff(result.hazard_cvar[0]) >= -1e-6).all()
    assert (result.hazard_cvar >= result.hazard_mean - 1e-6).all()
    assert (result.hazard_variance >= 0).all() and (result.hazard_cvar <= HAZARD_PER_M + 1e-6).all()


def test_states_follow_the_evidence_and_unknown_is_never_free() -> None:
    result = layers(np.array([[-CLAMP, -0.41, -0.39, 0.0, 0.01, CLAMP]], dtype=np.float32))
    assert result.state[0].tolist() == [FREE, FREE, UNKNOWN, UNKNOWN, LETHAL, LETHAL]
    unseen = layers(np.zeros((5, 5), np.float32))
    assert (unseen.state == UNKNOWN).all()
    assert (unseen.hazard_mean > 0.4 * HAZARD_PER_M).all()


def test_the_clearest_cell_has_no_hazard_and_the_surest_obstacle_all_of_it() -> None:
    result = layers(np.array([[-CLAMP, CLAMP, 20.0]], dtype=np.float32))
    assert result.hazard_mean[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert result.hazard_cvar[0, 0] == pytest.approx(0.0, abs=1e-3)
    assert result.hazard_mean[0, 1] == pytest.approx(HAZARD_PER_M, rel=0.02)
    assert result.hazard_mean[0, 2] == pytest.approx(HAZARD_PER_M, rel=1e-5)


@given(
    seed=st.integers(0, 10_000),
    density=st.sampled_from([0.01, 0.1, 0.5, 0.9]),
    resolution_m=st.sampled_from([0.1, 0.2, 0.35]),
)
def test_clearance_equals_brute_force_over_all_points(seed: int, density: float, resolution_m: float) -> None:
    """A tenth of a cell is lost at most: what stands behind all eight neighbours is left out."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(3, 22)), int(rng.integers(3, 22)))
    lethal = rng.random(shape) < density
    offset = rng.uniform(-0.5, 0.5, (2, *shape)).astype(np.float32) * np.float32(resolution_m)
    out = np.full(shape, REACH_M, np.float32)
    stamp_clearance(lethal, offset[0], offset[1], resolution_m, REACH_M, out)
    rows, columns = np.nonzero(lethal)
    px, py = columns * resolution_m + offset[0][lethal], rows * resolution_m + offset[1][lethal]
    for r in range(shape[0]):
        for c in range(shape[1]):
            away = np.hypot(px - c * resolution_m, py - r * resolution_m)
            exact = 0.0 if lethal[r, c] else min(float(away.min(initial=math.inf)), REACH_M)
            assert exact - 1e-4 <= out[r, c] <= exact + 0.1 * resolution_m


def test_rho_from_evidence_through_the_footprint_is_that_of_the_closed_form() -> None:
    """Along the middle of a wide field of equal evidence: rho = 1 - exp(-h L), whatever the cell size."""
    for resolution_m in (0.1, 0.2, 0.4):
        spec = GridSpec(resolution_m, -3, 4, round(8 / resolution_m), round(8 / resolution_m))
        result = layers(np.full(spec.shape, -1.5, np.float32), resolution_m=resolution_m)
        hazard = footprint_hazard(result.hazard_mean, 0.335, resolution_m)
        x, y = spec.ix0 * resolution_m, spec.iy0 * resolution_m
        length, total = segment_risk(hazard, resolution_m, spec.ix0, spec.iy0, x + 2, y + 2, x + 5, y + 6)
        p, floor = 1 / (1 + math.exp(1.5)), 1 / (1 + math.exp(CLAMP))
        assert length == pytest.approx(5.0)
        assert total == pytest.approx(5.0 * HAZARD_PER_M * (p - floor) / (1 - floor), rel=1e-4)


def _share_beyond(distance_m: float, radius_m: float) -> float:
    """Share of a disc's area that lies beyond a straight border at this distance from its centre."""
    d = min(distance_m / radius_m, 1.0)
    return (math.acos(d) - d * math.sqrt(1 - d * d)) / math.pi


@pytest.mark.parametrize(("resolution_m", "tolerance"), [(0.1, 0.05), (0.2, 0.15)])
def test_rho_along_a_wall_is_that_of_the_disc_that_overlaps_it(resolution_m: float, tolerance: float) -> None:
    """A wall in x > 4: the disc is half in it, overlaps it by more than half of its radius, and is clear of it."""
    n = round(8 / resolution_m)
    evidence = np.full((n, n), -CLAMP, np.float32)
    evidence[:, round(4 / resolution_m) :] = CLAMP
    hazard = footprint_hazard(layers(evidence, resolution_m=resolution_m).hazard_mean, 0.335, resolution_m)
    inside = float(layers(evidence).hazard_mean[0, -1])
    for x in (4.0, 3.85, 3.0):
        total = segment_risk(hazard, resolution_m, 0, 0, x, 1.0, x, 3.0)[1]
        exact = 2.0 * inside * _share_beyond(4.0 - x, 0.335)
        assert 1 - math.exp(-total) == pytest.approx(1 - math.exp(-exact), rel=tolerance, abs=1e-6)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 10_000),
    share=st.sampled_from([0.01, 0.1, 0.6]),
    spread_m=st.sampled_from([0.0, 0.05]),
)
def test_clearance_is_that_of_the_points_one_by_one_in_their_order(
    seed: int, share: float, spread_m: float
) -> None:
    """Bit for bit, also where many points are equally near."""
    rng = np.random.default_rng(seed)
    lethal = rng.random((15, 18)) < share
    x, y = (rng.uniform(-spread_m, spread_m, lethal.shape).astype(np.float32) for _ in range(2))
    found, wanted = (np.full(lethal.shape, 0.7, dtype=np.float32) for _ in range(2))
    stamp_clearance(lethal, x, y, 0.1, 0.7, found)
    around = np.pad(lethal, 1)
    inner = np.ones_like(lethal)
    for r, c in np.ndindex(3, 3):
        inner &= around[r : r + 15, c : c + 18]
    for row, column in np.argwhere(lethal):
        wanted[row, column] = 0.0
        if inner[row, column]:
            continue
        for r, c in np.ndindex(*lethal.shape):
            dx, dy = (c - column) * 0.1 - float(x[row, column]), (r - row) * 0.1 - float(y[row, column])
            if dx * dx + dy * dy < float(wanted[r, c] * wanted[r, c]):
                wanted[r, c] = math.sqrt(dx * dx + dy * dy)
    assert np.array_equal(found, wanted)

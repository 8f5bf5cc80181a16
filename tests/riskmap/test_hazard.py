"""Hazard of terrain: propagation and CVaR against integrals, limits, and independence of the cells' size."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, stats

from planning.footprint import footprint_hazard, segment_risk
from planning.grid import FREE, LETHAL, UNKNOWN
from services.riskmap.collision import RiskLayers
from services.riskmap.hazard import Limits, Obstacles, hazard_layers, propagate, shape_of
from services.riskmap.terrain import Ground, TerrainMetrics, terrain_metrics

LIMITS = Limits(
    slope_rad=0.42, step_m=0.1, roughness_m=0.05, drop_m=0.25, height_m=0.9, limit_hazard_per_m=0.2,
    full_hazard_per_m=2.0, lethal_sigmas=1.0, clamp_log_odds=4.0, terrain=True,
)  # fmt: skip
RADIUS_M = 0.335


def ground_of(height_m: NDArray[np.float64], sigma_m: float = 0.01) -> Ground:
    shape = height_m.shape
    variance, none = np.full(shape, sigma_m**2, np.float32), np.zeros(shape, np.bool_)
    return Ground(height_m.astype(np.float32), variance, variance, np.zeros(shape, np.float32), ~none, none)


def nothing_on(shape: tuple[int, int]) -> Obstacles:
    zero = np.zeros(shape, np.float32)
    return Obstacles(zero, zero, zero, np.full(shape, np.inf, np.float32), zero)


def layers(
    metrics: TerrainMetrics,
    obstacles: Obstacles | None = None,
    limits: Limits = LIMITS,
    resolution_m: float = 0.1,
    alpha: float = 0.9,
) -> RiskLayers:
    found = nothing_on(metrics.fitted.shape) if obstacles is None else obstacles
    return hazard_layers(metrics, found, limits, resolution_m, alpha, 1.5)


def metrics_of(
    height_m: NDArray[np.float64], resolution_m: float = 0.1, sigma_m: float = 0.01
) -> TerrainMetrics:
    return terrain_metrics(ground_of(height_m, sigma_m), resolution_m, RADIUS_M, math.tan(0.42), 0.25, 1.5)


@given(value=st.floats(0.0, 0.25), deviation=st.floats(0.001, 0.06))
def test_mean_and_variance_of_the_hazard_are_about_those_of_the_integral(
    value: float, deviation: float
) -> None:
    """Three points are exact for the fourth power; the kink at the limit and the tail cost a few percent of full."""
    found = propagate(value, deviation**2, 0.42, LIMITS)
    normal = stats.norm(value, deviation)

    def moment(k: int) -> float:
        bounds = (value - 6 * deviation, value + 6 * deviation)
        total, _ = integrate.quad(
            lambda v: shape_of(v, 0.42, LIMITS) ** k * normal.pdf(v), *bounds, limit=200, points=[0.42]
        )
        return float(total)

    mean = moment(1)
    assert found[0] == pytest.approx(mean, abs=2e-3)
    assert math.sqrt(found[1]) == pytest.approx(math.sqrt(max(moment(2) - mean**2, 0.0)), abs=0.02)


@given(values=st.lists(st.floats(0, 1.2), min_size=2, max_size=20))
def test_hazard_rises_smoothly_to_the_full_one(values: list[float]) -> None:
    found = [shape_of(v, 0.42, LIMITS) for v in sorted(values)]
    assert all(b >= a for a, b in itertools.pairwise(found))
    assert found[0] >= 0.0 and found[-1] <= 2.0
    assert shape_of(0.42, 0.42, LIMITS) == pytest.approx(0.2)
    assert shape_of(0.42 + 1e-9, 0.42, LIMITS) == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize("alpha", [0.5, 0.9, 0.99])
def test_cvar_is_the_mean_of_the_worst_share(alpha: float) -> None:
    """Of a normal with the layers' mean and variance, by numerical integration of its tail."""
    x = (np.arange(20) + 0.5) * 0.1
    found = layers(metrics_of(np.tile(0.2 * x, (20, 1)), sigma_m=0.03), alpha=alpha)
    mean, deviation = float(found.hazard_mean[10, 10]), math.sqrt(float(found.hazard_variance[10, 10]))
    assert deviation > 0.0
    normal = stats.norm(mean, deviation)
    low = normal.ppf(alpha)
    tail, _ = integrate.quad(lambda h: h * normal.pdf(h), low, low + 12 * deviation)
    assert found.hazard_cvar[10, 10] == pytest.approx(tail / (1 - alpha), rel=1e-4)


def test_at_alpha_zero_cvar_is_the_mean() -> None:
    x = (np.arange(20) + 0.5) * 0.1
    found = layers(metrics_of(np.tile(0.3 * x, (20, 1)), sigma_m=0.03), alpha=0.0)
    assert np.array_equal(found.hazard_cvar, found.hazard_mean)


@pytest.mark.parametrize(("slope", "state"), [(0.2, FREE), (0.38, FREE), (0.48, LETHAL), (0.8, LETHAL)])
def test_slopes_above_the_limit_are_lethal(slope: float, state: int) -> None:
    x = (np.arange(20) + 0.5) * 0.1
    found = layers(metrics_of(np.tile(math.tan(slope) * x, (20, 1))))
    assert (found.state[5:-5, 5:-5] == state).all()


@pytest.mark.parametrize(("rise", "lethal"), [(0.05, False), (0.09, False), (0.13, True), (-0.13, True)])
def test_ledges_above_the_limit_are_lethal_at_their_edge_alone(rise: float, lethal: bool) -> None:
    height = np.zeros((20, 20))
    height[:, 10:] = rise
    found = layers(metrics_of(height, sigma_m=0.005))
    assert (found.state[5, [9, 10]] == LETHAL).all() == lethal
    assert (found.state[5, :8] == FREE).all() and (found.state[5, 12:] == FREE).all()


def test_a_limit_that_may_not_be_passed_is_costly_but_not_lethal() -> None:
    height = np.zeros((20, 20))
    height[:, 10:] = 0.13
    found = layers(metrics_of(height, sigma_m=0.05))
    assert found.state[5, 10] == FREE
    assert found.hazard_cvar[5, 10] == pytest.approx(2.0)


def test_a_low_ceiling_is_lethal_and_a_doubtful_one_is_hazardous() -> None:
    metrics = metrics_of(np.zeros((10, 10)))
    room = np.full((10, 10), np.inf, np.float32)
    room[5, 5], room[5, 6], room[5, 7] = 0.85, 0.93, 2.0
    obstacles = nothing_on((10, 10))._replace(room_m=room, room_variance=np.full((10, 10), 4e-4, np.float32))
    found = layers(metrics, obstacles)
    assert found.state[5, 5:8].tolist() == [LETHAL, FREE, FREE]
    p = stats.norm.cdf((0.9 - 0.93) / 0.02)
    assert found.hazard_mean[5, 6] == pytest.approx(2.0 * p, rel=0.02)
    assert found.hazard_mean[5, 7] < 1e-3


def test_unfitted_ground_is_unknown_and_never_free() -> None:
    metrics = metrics_of(np.zeros((10, 10)))
    metrics.fitted[:, 5:] = False
    found = layers(metrics)
    assert (found.state[:, 5:] == UNKNOWN).all() and (found.state[:, :5] == FREE).all()
    assert (found.hazard_mean[:, 5:] == 1.0).all()


def test_risk_blind_sees_no_terrain() -> None:
    height = np.zeros((20, 20))
    height[:, 10:] = 1.0
    found = layers(metrics_of(height), limits=LIMITS._replace(terrain=False), alpha=0.0)
    assert (found.state == FREE).all()
    assert found.hazard_cvar.max() == 0.0


def _rho(height: object, resolution_m: float) -> float:
    n = round(12.0 / resolution_m)
    x = (np.arange(n) + 0.5) * resolution_m
    grid = np.meshgrid(x, x)
    z = 0.28 * grid[0] + 0.4 * np.sin(0.5 * grid[1]) if height == "waves" else math.tan(0.36) * grid[0]
    found = layers(metrics_of(z, resolution_m, 0.005), resolution_m=resolution_m)
    assert (found.state[4:-4, 4:-4] == FREE).all()
    hazard = footprint_hazard(found.hazard_cvar, RADIUS_M, resolution_m)
    return 1.0 - math.exp(-segment_risk(hazard, resolution_m, 0, 0, 3.0, 2.5, 8.0, 9.5)[1])


@pytest.mark.parametrize("height", ["plane", "waves"])
def test_rho_of_a_path_does_not_depend_on_the_cells(height: str) -> None:
    reference = _rho(height, 0.1)
    assert 0.1 < reference < 0.9
    for resolution_m in (0.2, 0.4):
        assert _rho(height, resolution_m) == pytest.approx(reference, rel=0.05)

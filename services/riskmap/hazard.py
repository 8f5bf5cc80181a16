"""From terrain metrics and obstacles to one hazard rate: mean, variance, CVaR_alpha, and the cells' states."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL, UNKNOWN
from planning.kernels import njit
from services.riskmap.collision import RiskLayers, cvar_factor, stamp_clearance
from services.riskmap.terrain import TerrainMetrics

_SATURATES = 1.25
"""At so many times its limit a metric has the full hazard."""
_SIGMAS = math.sqrt(3.0)
"""Three-point Gauss-Hermite quadrature of a normal: the mean, weight 2/3, and so many deviations to either side."""


class Limits(NamedTuple):
    """What the robot may be asked to do, and what it costs; see the config.

    At a limit the hazard is limit_hazard_per_m, below it falls with the fourth power; full_hazard_per_m is that of an
    obstacle. Over the limit by lethal_sigmas deviations is lethal. terrain: whether slope, step, roughness and drop
    count at all.
    """

    slope_rad: float
    step_m: float
    roughness_m: float
    drop_m: float
    height_m: float
    limit_hazard_per_m: float
    full_hazard_per_m: float
    lethal_sigmas: float
    clamp_log_odds: float
    terrain: bool


class Obstacles(NamedTuple):
    """(h, w) each: obstacle log-odds, mean hit (offset from the centre, m), room under the ceiling (inf: open), its
    variance."""

    log_odds: NDArray[np.float32]
    hit_x: NDArray[np.float32]
    hit_y: NDArray[np.float32]
    room_m: NDArray[np.float32]
    room_variance: NDArray[np.float32]


def hazard_layers(
    metrics: TerrainMetrics,
    obstacles: Obstacles,
    limits: Limits,
    resolution_m: float,
    alpha: float,
    max_clearance_m: float,
) -> RiskLayers:
    """State, hazard and clearance of each cell, (h, w) each.

    The sources of hazard add, as rates of independent failures do: means and variances are summed, each after
    propagation of its metric's variance; CVaR_alpha is that of a normal of this mean and variance (STEP, fan2021step),
    at alpha 0 the mean. Where no plane could be fitted and nothing stands, the cell is unknown and has half of the
    full hazard.
    """
    shape = metrics.fitted.shape
    state = np.full(shape, UNKNOWN, dtype=np.uint8)
    mean, variance = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    _combine(metrics, obstacles, limits, state, mean, variance)
    factor = cvar_factor(alpha) if alpha > 0.0 else 0.0
    cvar = np.minimum(mean + np.float32(factor) * np.sqrt(variance), np.float32(limits.full_hazard_per_m))
    clearance = np.full(shape, max_clearance_m, dtype=np.float32)
    stamp_clearance(
        state == LETHAL, obstacles.hit_x, obstacles.hit_y, resolution_m, max_clearance_m, clearance
    )
    return RiskLayers(state, mean, variance, cvar, clearance)


@njit
def shape_of(value: float, limit: float, limits: Limits) -> float:
    """Hazard rate of a metric, 1/m: (value / limit)^4 up to the limit, then in a straight line to the full one."""
    ratio = max(value, 0.0) / limit
    if ratio <= 1.0:
        return limits.limit_hazard_per_m * ratio**4
    over = min((ratio - 1.0) / (_SATURATES - 1.0), 1.0)
    return limits.limit_hazard_per_m + over * (limits.full_hazard_per_m - limits.limit_hazard_per_m)


@njit
def propagate(value: float, variance: float, limit: float, limits: Limits) -> tuple[float, float]:
    """Mean and variance of the hazard of a normal metric."""
    away = _SIGMAS * math.sqrt(variance)
    low = shape_of(value - away, limit, limits)
    middle = shape_of(value, limit, limits)
    high = shape_of(value + away, limit, limits)
    mean = (low + 4.0 * middle + high) / 6.0
    square = (low * low + 4.0 * middle * middle + high * high) / 6.0
    return mean, max(square - mean * mean, 0.0)


@njit
def _collision(log_odds: float, room_m: float, room_variance: float, floor: float, limits: Limits) -> float:
    """Probability of touching something in the cell, above that of the clearest possible cell (`floor`)."""
    p = (1.0 / (1.0 + math.exp(-log_odds)) - floor) / (1.0 - floor) if log_odds > 0.0 else 0.0
    if room_m < np.inf:
        deviation = math.sqrt(2.0 * max(room_variance, 1e-6))
        p = max(p, 0.5 * math.erfc((room_m - limits.height_m) / deviation))
    return min(max(p, 0.0), 1.0)


@njit
def _over(value: float, variance: float, limit: float, limits: Limits) -> bool:
    return value - limits.lethal_sigmas * math.sqrt(variance) > limit


@njit
def _combine(
    metrics: TerrainMetrics,
    obstacles: Obstacles,
    limits: Limits,
    state: NDArray[np.uint8],
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
) -> None:
    full = limits.full_hazard_per_m
    floor = 1.0 / (1.0 + math.exp(limits.clamp_log_odds))
    # Taken out of their tuples once: handed on in them, numba counts their references for every cell.
    log_odds, rooms, room_variances = obstacles.log_odds, obstacles.room_m, obstacles.room_variance
    fitted, slope, slope_variance = metrics.fitted, metrics.slope_rad, metrics.slope_variance
    roughness, roughness_variance = metrics.roughness_m, metrics.roughness_variance
    step, step_variance = metrics.step_m, metrics.step_variance
    drop, drop_variance = metrics.drop_m, metrics.drop_variance
    rows, columns = state.shape
    for r in range(rows):
        for c in range(columns):
            room = rooms[r, c]
            p = _collision(log_odds[r, c], room, room_variances[r, c], floor, limits)
            h, v = full * p, full * full * p * (1.0 - p)
            lethal = log_odds[r, c] > 0.0 or room < limits.height_m
            if limits.terrain and not lethal:
                for k in range(4):
                    if k == 0:
                        value, doubt, limit = slope[r, c], slope_variance[r, c], limits.slope_rad
                    elif k == 1:
                        value, doubt, limit = roughness[r, c], roughness_variance[r, c], limits.roughness_m
                    elif k == 2:
                        value, doubt, limit = step[r, c], step_variance[r, c], limits.step_m
                    else:
                        value, doubt, limit = drop[r, c], drop_variance[r, c], limits.drop_m
                    if value == 0.0 and doubt == 0.0:
                        continue  # most cells have no step, no drop: these add nothing
                    one, one_variance = propagate(value, doubt, limit, limits)
                    h += one
                    v += one_variance
                    lethal = lethal or _over(value, doubt, limit, limits)
                if lethal:
                    h, v = full, 0.0
            if lethal:
                state[r, c] = LETHAL
            elif fitted[r, c]:
                state[r, c] = FREE
            else:
                h, v = 0.5 * full, 0.25 * full * full
            mean[r, c], variance[r, c] = min(h, full), v

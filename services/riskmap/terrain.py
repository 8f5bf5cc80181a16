"""What the ground around each cell is like: slope, roughness, steps and drops, each with mean and variance (STEP)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from services.riskmap.steps import find_steps

_WEIGHT_VARIANCE = 0.02**2
"""Heights as certain as this weigh half in the fit of a plane, m2."""
_LEAST_SHARE = 0.35
"""A plane is fitted where at least so much of the robot's disc is known ..."""
_LEAST_SPREAD = 0.2
"""... and it spreads, in every direction, by so much of the disc's radius (standard deviation)."""
_INDEPENDENT = 6.0
"""The errors of neighbouring heights are not independent: a plane counts as made of no more than so many."""


class TerrainMetrics(NamedTuple):
    """Per cell, (h, w) each; where `fitted` is false there is no plane and slope and roughness are 0.

    slope_rad of the plane under the robot's disc, roughness_m its residual (rms), step_m the largest height difference
    across or beside the cell that slope does not explain, drop_m how far the ground falls behind an unseen edge.
    """

    fitted: NDArray[np.bool_]
    slope_rad: NDArray[np.float32]
    slope_variance: NDArray[np.float32]
    roughness_m: NDArray[np.float32]
    roughness_variance: NDArray[np.float32]
    step_m: NDArray[np.float32]
    step_variance: NDArray[np.float32]
    drop_m: NDArray[np.float32]
    drop_variance: NDArray[np.float32]


class Ground(NamedTuple):
    """The ground as the metrics see it, (h, w) each.

    variance of the height without odometry's drift; single, the part of it that a cell does not share with its
    neighbours; drift_m, the deviation of odometry's height since the cell was looked at (what neighbours of one age
    have in common). bounded: not known, but not higher than height_m.
    """

    height_m: NDArray[np.float32]
    variance: NDArray[np.float32]
    single: NDArray[np.float32]
    drift_m: NDArray[np.float32]
    known: NDArray[np.bool_]
    bounded: NDArray[np.bool_]


def terrain_metrics(
    ground: Ground,
    resolution_m: float,
    radius_m: float,
    max_slope: float,
    step_reach_m: float,
    drop_reach_m: float,
) -> TerrainMetrics:
    """The metrics of a height field.

    radius_m: the robot's disc. max_slope: rise per metre that counts as slope, not as a step. step_reach_m: a step is a
    difference over this distance or less. drop_reach_m: how far behind an edge lower ground is looked for.
    """
    shape = ground.known.shape
    fitted = np.zeros(shape, dtype=np.bool_)
    layers = np.zeros((8, *shape), dtype=np.float32)
    disc_m = max(radius_m, 1.5 * resolution_m)
    spans = _disc_spans(disc_m / resolution_m)
    shrink = (radius_m / disc_m) ** 2
    _fit_planes(
        ground.height_m,
        ground.variance,
        ground.known,
        resolution_m,
        disc_m,
        shrink,
        spans,
        fitted,
        layers[:4],
    )
    reach = max(1, int(step_reach_m / resolution_m + 1e-6))
    find_steps(
        ground.height_m,
        ground.single,
        ground.drift_m,
        ground.known,
        resolution_m,
        reach,
        max_slope,
        layers[4],
        layers[5],
    )
    reach = max(2, math.ceil(drop_reach_m / resolution_m))
    _find_drops(
        ground.height_m, ground.single, ground.drift_m, ground.known, ground.bounded, resolution_m, reach, max_slope,
        layers[6], layers[7],
    )  # fmt: skip
    return TerrainMetrics(fitted, *layers)


def _disc_spans(radius_cells: float) -> NDArray[np.int64]:
    """Half widths of a disc's rows, from the lowest row to the highest."""
    reach = int(radius_cells + 1e-6)
    rows = np.arange(-reach, reach + 1)
    return np.floor(np.sqrt(np.maximum(radius_cells**2 - rows**2, 0.0)) + 1e-6).astype(np.int64)


@njit
def _fit_planes(
    height_m: NDArray[np.float32],
    variance: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
    radius_m: float,
    shrink: float,
    spans: NDArray[np.int64],
    fitted: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    """Weighted least squares of a plane over the disc around each known cell, by running sums along the rows.

    radius_m: of the disc that is fitted, larger than the robot's when cells are; shrink: by what to scale its spread
    down again, so that a slope is as uncertain on large cells as on small ones. out: (4, h, w): slope, its variance,
    roughness, its variance.
    """
    rows, columns = height_m.shape
    reach = spans.shape[0] // 2
    full = float((2 * spans + 1).sum())
    # Of the rows in reach, sums over the columns to the left of: number, w, w x, w xx, w z, w xz, w zz, w variance.
    band = 2 * reach + 1
    sums = np.zeros((band, columns + 1, 8))
    part, slots = np.zeros(8), np.zeros(band, dtype=np.int64)
    for r in range(-reach, rows):
        if r + reach < rows:
            _sum_row(
                height_m[r + reach],
                variance[r + reach],
                known[r + reach],
                resolution_m,
                sums[(r + reach) % band],
            )
        if r < 0:
            continue
        for k in range(band):
            slots[k] = (r - reach + k) % band
        low, high = max(-reach, -r), min(reach, rows - 1 - r)
        for c in range(columns):
            if not known[r, c]:
                continue
            n = s = sx = sy = sz = sxx = sxy = syy = sxz = syz = szz = sv = 0.0
            x0 = c * resolution_m
            for k in range(low, high + 1):
                row = slots[k + reach]
                left = max(0, c - spans[k + reach])
                right = min(columns, c + spans[k + reach] + 1)
                for q in range(8):
                    part[q] = sums[row, right, q] - sums[row, left, q]
                if part[0] == 0.0:
                    continue
                y = k * resolution_m
                n += part[0]
                s += part[1]
                px = part[2] - x0 * part[1]
                sx += px
                sy += y * part[1]
                sxx += part[3] - 2.0 * x0 * part[2] + x0 * x0 * part[1]
                sxy += y * px
                syy += y * y * part[1]
                sz += part[4]
                sxz += part[5] - x0 * part[4]
                syz += y * part[4]
                szz += part[6]
                sv += part[7]
            if n < _LEAST_SHARE * full:
                continue
            _plane(
                (n, s, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz, sv), (_LEAST_SPREAD * radius_m) ** 2, shrink,
                r, c, fitted, out,
            )  # fmt: skip


@njit
def _plane(
    sums: tuple[float, ...],
    least_spread: float,
    shrink: float,
    r: int,
    c: int,
    fitted: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    """The plane of a cell from its sums: number, w, w x, w y, w z, w xx, w xy, w yy, w xz, w yz, w zz, w variance."""
    n, s, sx, sy, sz, sxx, sxy, syy, sxz, syz, szz, sv = sums
    mx, my, mz = sx / s, sy / s, sz / s
    cxx, cxy, cyy = sxx / s - mx * mx, sxy / s - mx * my, syy / s - my * my
    half = 0.5 * (cxx + cyy)
    least = half - math.sqrt(max(0.25 * (cxx - cyy) ** 2 + cxy * cxy, 0.0))
    if least < least_spread:
        return
    cxz, cyz = sxz / s - mx * mz, syz / s - my * mz
    determinant = cxx * cyy - cxy * cxy
    gx = (cxz * cyy - cyz * cxy) / determinant
    gy = (cyz * cxx - cxz * cxy) / determinant
    residual = max(szz / s - mz * mz - gx * cxz - gy * cyz, 0.0)
    steepness = math.sqrt(gx * gx + gy * gy)
    own = sv / s / min(n, _INDEPENDENT)
    fitted[r, c] = True
    out[0, r, c] = math.atan(steepness)
    out[1, r, c] = (own + residual / n) / (least * shrink) / (1.0 + steepness * steepness) ** 2
    out[2, r, c] = math.sqrt(residual)
    out[3, r, c] = own


@njit
def _sum_row(
    height_m: NDArray[np.float32],
    variance: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
    sums: NDArray[np.float64],
) -> None:
    """The running sums of one row for `_fit_planes`: (columns + 1, 8), the first of them zeros."""
    n = s = sx = sxx = sz = sxz = szz = sv = 0.0
    for c in range(known.shape[0]):
        if known[c]:
            w = _WEIGHT_VARIANCE / (variance[c] + _WEIGHT_VARIANCE)
            x, z = c * resolution_m, float(height_m[c])
            n += 1.0
            s += w
            sx += w * x
            sxx += w * x * x
            sz += w * z
            sxz += w * x * z
            szz += w * z * z
            sv += w * variance[c]
        row = sums[c + 1]
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7] = n, s, sx, sxx, sz, sxz, szz, sv


@njit_borrowing
def _known_at(known: NDArray[np.bool_], r: int, c: int) -> bool:
    return 0 <= r < known.shape[0] and 0 <= c < known.shape[1] and known[r, c]


@njit
def _find_drops(
    height_m: NDArray[np.float32],
    single: NDArray[np.float32],
    drift_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    bounded: NDArray[np.bool_],
    resolution_m: float,
    reach: int,
    max_slope: float,
    drop: NDArray[np.float32],
    drop_variance: NDArray[np.float32],
) -> None:
    """At cells next to unknown ones: how much lower than their slope would lead to the ground behind is.

    Behind: the first known cell, or before it a cell whose ground rays have shown to lie below some height. What slope
    explains is the fall before the edge and, where it is known, after the gap, whichever is less: the ray that sees
    over an edge always falls gently, so that the mean slope over the gap says nothing.
    """
    rows, columns = known.shape
    for r in range(rows):
        for c in range(columns):
            if not known[r, c] or _inside(known, r, c):
                continue
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    r1, c1 = r + dr, c + dc
                    if (dr == 0 and dc == 0) or not (0 <= r1 < rows and 0 <= c1 < columns) or known[r1, c1]:
                        continue
                    length = resolution_m * math.sqrt(float(dr * dr + dc * dc))
                    before = _rise_per_m(height_m, known, r, c, -dr, -dc, length)
                    if math.isnan(before):
                        continue
                    for n in range(1, reach + 1):
                        r1, c1 = r + n * dr, c + n * dc
                        if not (0 <= r1 < rows and 0 <= c1 < columns):
                            break
                        slope, here = min(max(before, 0.0), max_slope), known[r1, c1]
                        if here:
                            after = -_rise_per_m(height_m, known, r1, c1, dr, dc, length)
                            slope = slope if math.isnan(after) else min(slope, max(after, 0.0))
                        elif not bounded[r1, c1]:
                            continue
                        fall = float(height_m[r, c]) - float(height_m[r1, c1]) - slope * n * length
                        if fall > drop[r, c]:
                            drop[r, c] = fall
                            drop_variance[r, c] = (
                                single[r, c] + single[r1, c1] + (drift_m[r, c] - drift_m[r1, c1]) ** 2
                            )
                        if here:
                            break


@njit_borrowing
def _inside(known: NDArray[np.bool_], r: int, c: int) -> bool:
    """Whether all eight neighbours are in the grid and known."""
    if r == 0 or c == 0 or r == known.shape[0] - 1 or c == known.shape[1] - 1:
        return False
    return (
        known[r - 1, c - 1] & known[r - 1, c] & known[r - 1, c + 1] & known[r, c - 1]
        & known[r, c + 1] & known[r + 1, c - 1] & known[r + 1, c] & known[r + 1, c + 1]
    )  # fmt: skip


@njit_borrowing
def _rise_per_m(
    height_m: NDArray[np.float32], known: NDArray[np.bool_], r: int, c: int, dr: int, dc: int, length: float
) -> float:
    """Rise per metre from a known cell over up to three more in a direction; NaN where the next is unknown."""
    n = 0
    while n < 3 and _known_at(known, r + (n + 1) * dr, c + (n + 1) * dc):
        n += 1
    return (
        (float(height_m[r + n * dr, c + n * dc]) - float(height_m[r, c])) / (n * length)
        if n > 0
        else math.nan
    )


@njit
def close_holes(
    height_m: NDArray[np.float32],
    variance: NDArray[np.float32],
    known: NDArray[np.bool_],
    blocked: NDArray[np.bool_],
    most_m: float,
    sigma_m: float,
) -> None:
    """Unknown single cells among at least five known neighbours of like height are taken for ground, in place.

    most_m: the neighbours differ by no more. sigma_m: deviation that is added. Such holes lie between the bearings.
    """
    before = known.copy()
    for r in range(1, known.shape[0] - 1):
        for c in range(1, known.shape[1] - 1):
            if before[r, c] or blocked[r, c]:
                continue
            n, total, doubt, low, high = 0, 0.0, 0.0, np.inf, -np.inf
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    if before[r + dr, c + dc]:
                        z = float(height_m[r + dr, c + dc])
                        n += 1
                        total += z
                        doubt += variance[r + dr, c + dc]
                        low, high = min(low, z), max(high, z)
            if n >= 5 and high - low <= most_m:
                known[r, c] = True
                height_m[r, c] = total / n
                variance[r, c] = doubt / n + sigma_m * sigma_m


@njit_borrowing
def _spread(
    away: NDArray[np.float32], height_m: NDArray[np.float32], r: int, c: int, rn: int, cn: int, cost: float
) -> None:
    if away[rn, cn] + cost < away[r, c]:
        away[r, c] = away[rn, cn] + cost
        height_m[r, c] = height_m[rn, cn]


@njit
def spread_heights(height_m: NDArray[np.float32], known: NDArray[np.bool_], otherwise_m: float) -> None:
    """Give unknown cells the height of a near known one, in place: two passes over the grid, as a chamfer distance."""
    rows, columns = known.shape
    away = np.where(known, np.float32(0.0), np.float32(np.inf))
    for turn in range(2):
        back = -1 if turn == 0 else 1
        for i in range(rows):
            r = i if turn == 0 else rows - 1 - i
            for j in range(columns):
                c = j if turn == 0 else columns - 1 - j
                if away[r, c] == 0.0:
                    continue
                if j > 0:
                    _spread(away, height_m, r, c, r, c + back, 1.0)
                if i > 0:
                    _spread(away, height_m, r, c, r + back, c, 1.0)
                    if j > 0:
                        _spread(away, height_m, r, c, r + back, c + back, 1.414)
                    if j < columns - 1:
                        _spread(away, height_m, r, c, r + back, c - back, 1.414)
    for r in range(rows):
        for c in range(columns):
            if away[r, c] == np.inf:
                height_m[r, c] = otherwise_m

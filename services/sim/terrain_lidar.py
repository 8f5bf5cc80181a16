"""LiDAR over uneven ground: every ray walks the grid for itself, as a leaning sensor's rings share no plane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.sim.terrain import OPEN_M, BoolGrid, Heights, Terrain

_WALL = 1e30
"""Height of the floor that stands for a wall among the bounds."""


@njit
def patch_bounds(occupied: BoolGrid, floor_m: Heights, ceiling_m: Heights) -> NDArray[np.float32]:
    """Highest floor and lowest ceiling of every patch between four cell centres, float32[rows+1, columns+1, 2].

    Patch (r, c) lies between the centres of the cells r - 1, r and c - 1, c, so that the patches reach half a cell
    beyond the outermost centres on every side. Where one of its cells is solid or outside, the floor is `_WALL`; a
    patch with an open corner is open.
    """
    rows, columns = occupied.shape
    bounds = np.empty((rows + 1, columns + 1, 2), dtype=np.float32)
    for row in range(rows + 1):
        for column in range(columns + 1):
            high, low, is_open = -_WALL, _WALL, False
            for k in range(4):
                r, c = row - 1 + (k >> 1), column - 1 + (k & 1)
                if r < 0 or c < 0 or r >= rows or c >= columns or occupied[r, c]:
                    high = _WALL
                else:
                    high, low = max(high, floor_m[r, c]), min(low, ceiling_m[r, c])
                    is_open = is_open or ceiling_m[r, c] >= OPEN_M
            bounds[row, column, 0], bounds[row, column, 1] = high, _WALL if is_open else low
    return bounds


@njit
def cast_rays(
    occupied: BoolGrid,
    terrain: Terrain,
    bounds: NDArray[np.float32],
    origin: NDArray[np.float64],
    turn: NDArray[np.float64],
    directions: NDArray[np.float32],
    limits: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Noiseless ranges in metres, shape (azimuths, rings), inf where nothing returns.

    `origin` is (x, y) in cells and z in metres; `turn` the rotation (3, 3) from the sensor to the world;
    `directions` unit vectors (azimuths, rings, 3) in the sensor's frame; `limits` (cell size, longest range) in m.
    """
    ranges = np.empty(directions.shape[:2])
    for a in range(directions.shape[0]):
        for k in range(directions.shape[1]):
            x, y, z = float(directions[a, k, 0]), float(directions[a, k, 1]), float(directions[a, k, 2])
            dx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            dy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            dz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            ranges[a, k] = cast_ray(
                occupied, terrain, bounds, origin, dx / limits[0], dy / limits[0], dz, limits[1]
            )
    return ranges


@njit
def cast_ray(
    occupied: BoolGrid,
    terrain: Terrain,
    bounds: NDArray[np.float32],
    origin: NDArray[np.float64],
    du: float,
    dv: float,
    dz: float,
    longest_m: float,
) -> float:
    """Range in metres to the first wall, floor or ceiling; `du`, `dv` in cells a metre of way. inf: beyond."""
    u, v, z = origin[0] + 0.5, origin[1] + 0.5, origin[2]  # patches begin half a cell before the cells
    column, row = math.floor(u), math.floor(v)
    step_u, step_v = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    delta_u = abs(1.0 / du) if du != 0.0 else math.inf
    delta_v = abs(1.0 / dv) if dv != 0.0 else math.inf
    next_u = ((column + 1 - u) if du > 0.0 else (u - column)) * delta_u if du != 0.0 else math.inf
    next_v = ((row + 1 - v) if dv > 0.0 else (v - row)) * delta_v if dv != 0.0 else math.inf
    rows, columns = bounds.shape[0], bounds.shape[1]
    begin = 0.0
    while begin < longest_m:
        if row < 0 or column < 0 or row >= rows or column >= columns:
            return begin
        end = min(next_u, next_v, longest_m)
        z_begin, z_end = z + dz * begin, z + dz * end
        if min(z_begin, z_end) <= bounds[row, column, 0] or max(z_begin, z_end) >= bounds[row, column, 1]:
            hit = _hit_in_patch(occupied, terrain, row, column, u, v, z, du, dv, dz, begin, end)
            if hit < math.inf:
                return hit
        begin = end
        if next_u < next_v:
            next_u += delta_u
            column += step_u
        else:
            next_v += delta_v
            row += step_v
    return math.inf


@njit
def _hit_in_patch(
    occupied: BoolGrid,
    terrain: Terrain,
    row: int,
    column: int,
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    begin: float,
    end: float,
) -> float:
    """First hit with the way along the ray between `begin` and `end`, all within one patch; inf: none.

    The borders of cells cross the patch in its middle: they cut the way into up to three parts, each in one cell.
    """
    cut_u = (column + 0.5 - u) / du if du != 0.0 else math.inf
    cut_v = (row + 0.5 - v) / dv if dv != 0.0 else math.inf
    first, second = min(cut_u, cut_v), max(cut_u, cut_v)
    at = begin
    for part in range(3):
        to = min(max(first if part == 0 else second if part == 1 else end, at), end)
        if to <= at and part < 2:
            continue
        middle = 0.5 * (at + to)
        r, c = math.floor(v + dv * middle - 0.5), math.floor(u + du * middle - 0.5)
        if r < 0 or c < 0 or r >= occupied.shape[0] or c >= occupied.shape[1] or occupied[r, c]:
            return at
        hit = min(
            _meet(terrain.floor_m, 1.0, row, column, u, v, z, du, dv, dz, at, to),
            _meet(terrain.ceiling_m, -1.0, row, column, u, v, z, du, dv, dz, at, to),
        )
        if hit < math.inf:
            return hit
        at = to
    return math.inf


@njit
def _meet(
    heights_m: Heights,
    side: float,
    row: int,
    column: int,
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    at: float,
    to: float,
) -> float:
    """Where between `at` and `to` the ray, first on the side `side` (1 above, -1 below), meets the patch.

    Along a line a bilinear patch is a parabola, so the meeting is the first root of a quadratic; inf: none.
    """
    rows, columns = heights_m.shape
    r0, r1 = min(max(row - 1, 0), rows - 1), min(max(row, 0), rows - 1)
    c0, c1 = min(max(column - 1, 0), columns - 1), min(max(column, 0), columns - 1)
    h00, h01 = float(heights_m[r0, c0]), float(heights_m[r0, c1])
    h10, h11 = float(heights_m[r1, c0]), float(heights_m[r1, c1])
    if side < 0.0 and max(h00, h01, h10, h11) >= OPEN_M:
        return math.inf
    along_u, along_v, twist = h01 - h00, h10 - h00, h00 - h01 - h10 + h11
    p, q = u + du * at - column, v + dv * at - row
    gap = side * (z + dz * at - (h00 + along_u * p + along_v * q + twist * p * q))
    if gap <= 0.0:
        return at
    rate = side * (dz - (along_u * du + along_v * dv + twist * (p * dv + q * du)))
    bend = -side * twist * du * dv
    length = to - at
    if abs(bend) < 1e-12:
        root = -gap / rate if rate < 0.0 else math.inf
    else:
        under = rate * rate - 4.0 * bend * gap
        if under < 0.0:
            return math.inf
        # The stable form: no difference of like numbers.
        s = -0.5 * (rate + math.copysign(math.sqrt(under), rate))
        one, other = s / bend, (gap / s if s != 0.0 else math.inf)
        low, high = min(one, other), max(one, other)
        root = low if low > 0.0 else high if high > 0.0 else math.inf
    return at + root if root <= length else math.inf


@njit
def hide_behind_movers(
    ranges: NDArray[np.float64],
    origin_m: NDArray[np.float64],
    turn: NDArray[np.float64],
    directions: NDArray[np.float32],
    movers: NDArray[np.float64],
    longest_m: float,
) -> None:
    """Shorten `ranges` (in place) to where rays meet the sides of upright cylinders.

    `movers`[n, 5] is (x, y, radius, foot, top) in metres, in the world's frame as `origin_m`.
    """
    for a in range(ranges.shape[0]):
        for k in range(ranges.shape[1]):
            x, y, z = float(directions[a, k, 0]), float(directions[a, k, 1]), float(directions[a, k, 2])
            dx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
            dy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
            dz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
            level = dx * dx + dy * dy
            for m in range(movers.shape[0]):
                ox, oy = movers[m, 0] - origin_m[0], movers[m, 1] - origin_m[1]
                along = dx * ox + dy * oy
                under = along * along - level * (ox * ox + oy * oy - movers[m, 2] ** 2)
                if under <= 0.0 or along <= 0.0:
                    continue
                hit = max((along - math.sqrt(under)) / level, 0.0)
                height = origin_m[2] + dz * hit
                if hit <= longest_m and hit < ranges[a, k] and movers[m, 3] <= height <= movers[m, 4]:
                    ranges[a, k] = hit

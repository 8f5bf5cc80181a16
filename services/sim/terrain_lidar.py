"""LiDAR over uneven ground: every ray walks the grid for itself, as a leaning sensor's rings share no plane."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from services.sim.terrain import OPEN_M, BoolGrid, Heights, Terrain

COARSE, FINE = 8, 2
"""Patches along a side of the blocks that a ray strides over."""
_MARGIN_M = 1e-5
"""A ray so far from the bounds of a patch does not meet its surface, whatever the rounding."""
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


class Bounds(NamedTuple):
    """Highest floor and lowest ceiling, float32[..., 2], of patches and of regions.

    Block (R, C) of a level of size s is of the s x s patches from (R s, C s) on; its bounds are those of its region,
    which reaches s patches beyond it on every side. A region that is not all inside is never clear.
    """

    patches: NDArray[np.float32]
    coarse: NDArray[np.float32]
    fine: NDArray[np.float32]


def bounds_of(occupied: BoolGrid, terrain: Terrain) -> Bounds:
    """The bounds of a world's surfaces."""
    patches = patch_bounds(occupied, terrain.floor_m, terrain.ceiling_m)
    return Bounds(patches, _regions(patches, COARSE), _regions(patches, FINE))


def _regions(patches: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    rows, columns = (n // size for n in patches.shape[:2])
    whole = patches[: rows * size, : columns * size].reshape(rows, size, columns, size, 2)
    high = np.pad(whole[..., 0].max(axis=(1, 3)), 1, constant_values=_WALL)
    low = np.pad(whole[..., 1].min(axis=(1, 3)), 1, constant_values=-_WALL)
    regions = np.full((rows + 1, columns + 1, 2), (_WALL, -_WALL), dtype=np.float32)
    regions[:rows, :columns, 0] = sliding_window_view(high, (3, 3)).max(axis=(2, 3))
    regions[:rows, :columns, 1] = sliding_window_view(low, (3, 3)).min(axis=(2, 3))
    return regions


@njit
def cast_rays(
    occupied: BoolGrid,
    terrain: Terrain,
    bounds: Bounds,
    origin: NDArray[np.float64],
    turn: NDArray[np.float64],
    directions: NDArray[np.float32],
    limits: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Noiseless ranges in metres, shape (azimuths, rings), inf where nothing returns.

    `origin` is (x, y) in cells and z in metres; `turn` the rotation (3, 3) from the sensor to the world;
    `directions` unit vectors (azimuths, rings, 3) in the sensor's frame; `limits` (cell size, longest range) in m.
    """
    azimuths, rings = directions.shape[0], directions.shape[1]
    ranges = np.empty((azimuths, rings))
    rays, pace = np.empty((rings, 3)), np.empty((2, rings))
    most = math.ceil(limits[1] / limits[0]) + 4
    times = np.empty((2, most, rings))
    u, v, z = origin[0] + 0.5, origin[1] + 0.5, origin[2]  # patches begin half a cell before the cells
    for a in range(azimuths):
        for k in range(rings):
            x, y, up = float(directions[a, k, 0]), float(directions[a, k, 1]), float(directions[a, k, 2])
            rays[k, 0] = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * up) / limits[0]
            rays[k, 1] = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * up) / limits[0]
            rays[k, 2] = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * up
            pace[0, k], pace[1, k] = abs(1.0 / rays[k, 0]), abs(1.0 / rays[k, 1])
            times[0, 0, k] = _first_crossing(u, rays[k, 0])
            times[1, 0, k] = _first_crossing(v, rays[k, 1])
        known = 1
        for k in range(rings):
            du, dv, dz = rays[k, 0], rays[k, 1], rays[k, 2]
            clear_m = _clear_way(bounds.coarse, COARSE, limits[0], u, v, z, du, dv, dz, 0.0, limits[1])
            clear_m = _clear_way(bounds.fine, FINE, limits[0], u, v, z, du, dv, dz, clear_m, limits[1])
            if clear_m >= limits[1]:
                ranges[a, k] = math.inf
                continue
            need = min(int(clear_m * max(abs(du), abs(dv))) + 3, most - 1)
            while known <= need:
                for q in range(rings):
                    times[0, known, q] = times[0, known - 1, q] + pace[0, q]
                    times[1, known, q] = times[1, known - 1, q] + pace[1, q]
                known += 1
            i = _crossed(times, 0, k, known, clear_m, abs(du))
            j = _crossed(times, 1, k, known, clear_m, abs(dv))
            begin = max(times[0, i - 1, k] if i > 0 else 0.0, times[1, j - 1, k] if j > 0 else 0.0)
            next_u = times[0, i, k] if i < known else times[0, i - 1, k] + pace[0, k]
            next_v = times[1, j, k] if j < known else times[1, j - 1, k] + pace[1, k]
            ranges[a, k] = _cast_ray(
                occupied, terrain, bounds.patches, u, v, z, du, dv, dz, i, j, begin, next_u, next_v, limits[1]
            )
    return ranges


@njit_borrowing
def _first_crossing(at: float, rate: float) -> float:
    """When a ray first meets a border of patches; `rate` in cells a metre of way."""
    if rate == 0.0:
        return math.inf
    patch = math.floor(at)
    return ((patch + 1 - at) if rate > 0.0 else (at - patch)) * abs(1.0 / rate)


@njit_borrowing
def _clear_way(
    regions: NDArray[np.float32],
    size: int,
    cell_m: float,
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    begin: float,
    longest_m: float,
) -> float:
    """How far from `begin` on the ray meets nothing for sure, m: in strides that stay in the region of a block."""
    stride = 0.999 * size * cell_m
    rows, columns = regions.shape[0], regions.shape[1]
    while begin < longest_m:
        end = begin + stride
        row, column = math.floor(v + dv * begin) // size, math.floor(u + du * begin) // size
        if row < 0 or column < 0 or row >= rows or column >= columns:
            break
        z_begin, z_end = z + dz * begin, z + dz * end
        high, low = regions[row, column, 0], regions[row, column, 1]
        if min(z_begin, z_end) <= high or max(z_begin, z_end) >= low:
            break
        begin = end
    return begin


@njit_borrowing
def _crossed(times: NDArray[np.float64], axis: int, k: int, known: int, until: float, rate: float) -> int:
    """How many borders across an axis the ray has crossed at a time."""
    count = int((until - times[axis, 0, k]) * rate) + 1 if times[axis, 0, k] <= until else 0
    count = min(count, known)
    while count > 0 and times[axis, count - 1, k] > until:
        count -= 1
    while count < known and times[axis, count, k] <= until:
        count += 1
    return count


@njit_borrowing
def _cast_ray(
    occupied: BoolGrid,
    terrain: Terrain,
    patches: NDArray[np.float32],
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    i: int,
    j: int,
    begin: float,
    next_u: float,
    next_v: float,
    longest_m: float,
) -> float:
    """Range in metres to the first wall, floor or ceiling; inf: beyond.

    The way up to `begin` is clear; it has crossed i columns and j rows, and crosses the next at `next_u`, `next_v`.
    """
    step_u, step_v = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    column, row = math.floor(u) + step_u * i, math.floor(v) + step_v * j
    delta_u, delta_v = abs(1.0 / du), abs(1.0 / dv)
    rows, columns = patches.shape[0], patches.shape[1]
    while begin < longest_m:
        if row < 0 or column < 0 or row >= rows or column >= columns:
            return begin
        end = min(next_u, next_v, longest_m)
        z_begin, z_end = z + dz * begin, z + dz * end
        high, low = patches[row, column, 0], patches[row, column, 1]
        if min(z_begin, z_end) <= high or max(z_begin, z_end) >= low:
            floor = min(z_begin, z_end) <= high + _MARGIN_M
            ceiling = max(z_begin, z_end) >= low - _MARGIN_M or high > OPEN_M
            hit = _hit_in_patch(
                occupied, terrain, row, column, u, v, z, du, dv, dz, begin, end, floor, ceiling
            )
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


@njit_borrowing
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
    may_meet_floor: bool,
    may_meet_ceiling: bool,
) -> float:
    """First hit with the way along the ray between `begin` and `end`, all within one patch; inf: none.

    The borders of cells cross the patch in its middle: they cut the way into up to three parts, each in one cell.
    """
    floor = _corners(terrain.floor_m, row, column)
    ceiling = _corners(terrain.ceiling_m, row, column) if may_meet_ceiling else floor
    may_meet_ceiling = may_meet_ceiling and max(ceiling) < OPEN_M
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
        p, q = u + du * at - column, v + dv * at - row
        hit = _meet(floor, 1.0, p, q, z, du, dv, dz, at, to) if may_meet_floor else math.inf
        if may_meet_ceiling:
            hit = min(hit, _meet(ceiling, -1.0, p, q, z, du, dv, dz, at, to))
        if hit < math.inf:
            return hit
        at = to
    return math.inf


@njit_borrowing
def _corners(heights_m: Heights, row: int, column: int) -> tuple[float, float, float, float]:
    """Heights at the corners of a patch, by the row and then the column; beyond the outermost centres as there."""
    rows, columns = heights_m.shape
    r0, r1 = min(max(row - 1, 0), rows - 1), min(max(row, 0), rows - 1)
    c0, c1 = min(max(column - 1, 0), columns - 1), min(max(column, 0), columns - 1)
    return (
        float(heights_m[r0, c0]), float(heights_m[r0, c1]), float(heights_m[r1, c0]), float(heights_m[r1, c1])
    )  # fmt: skip


@njit_borrowing
def _meet(
    corners: tuple[float, float, float, float],
    side: float,
    p: float,
    q: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    at: float,
    to: float,
) -> float:
    """Where between `at` and `to` the ray, first on the side `side` (1 above, -1 below), meets the patch.

    (p, q) is the place in the patch at `at`. Along a line a bilinear patch is a parabola, so the meeting is the first
    root of a quadratic; inf: none.
    """
    h00, h01, h10, h11 = corners
    along_u, along_v, twist = h01 - h00, h10 - h00, h00 - h01 - h10 + h11
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

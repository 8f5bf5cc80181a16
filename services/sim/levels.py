"""Levels of a mesh: over each cell the floors with room above, and the ones that hang together with the start.

A world here is 2.5D: one floor a cell. Where passages cross above one another, the lowest level that connects with
the start is kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import GridSpec
from planning.kernels import njit
from services.sim.mesh_raster import FLAT_COSINE, Triangles, columns_of, steep_points
from services.sim.world import World

ROOM_M = 1.0
"""A floor has a ceiling at least so far above, or none."""
_WALL_FROM_M, _WALL_TO_M = 0.4, 1.5
"""A steep face that comes so high over the floor makes the cell a wall."""
_STEP_M = 0.75
"""Neighbouring floors no farther apart in height hang together (a robot need not climb it)."""
_BORDER_M = 8.0
"""Ground that is not connected but lies this near is kept, for the sensors to see: the bottom of a pit."""


class Levels(NamedTuple):
    """Floors by cell: those of cell k = row width + column are first[k] : first[k + 1], from below.

    `first` int64[cells + 1], `floor_m`, `ceiling_m` float32[n] (inf: open), `walled` bool[n]: a steep face stands
    there.
    """

    first: NDArray[np.int64]
    floor_m: NDArray[np.float32]
    ceiling_m: NDArray[np.float32]
    walled: NDArray[np.bool_]


def grid_of(triangles: Triangles, resolution_m: float) -> GridSpec:
    """The grid over a mesh, two cells wider on every side."""
    low = np.floor(triangles[..., :2].min(axis=(0, 1)) / resolution_m).astype(int) - 2
    high = np.ceil(triangles[..., :2].max(axis=(0, 1)) / resolution_m).astype(int) + 2
    return GridSpec(resolution_m, *low.tolist(), *(high - low).tolist())


def levels_of(triangles: Triangles, spec: GridSpec) -> Levels:
    """All levels of a mesh. Faces are trusted to look into the open if nearly all columns alternate up and down."""
    first, cuts = columns_of(triangles, spec)
    oriented = _alternating(first, cuts) > 0.8
    level_first, floors, ceilings = _pair(first, cuts, oriented)
    walled = np.zeros(floors.size, dtype=np.bool_)
    _mark_walls(level_first, floors, ceilings, *steep_points(triangles, spec), walled)
    return Levels(level_first, floors, ceilings, walled)


@njit
def _alternating(first: NDArray[np.int64], cuts: NDArray[np.float32]) -> float:
    """Share of neighbouring cuts of a column that face opposite ways."""
    pairs, opposite = 0, 0
    for cell in range(first.shape[0] - 1):
        for k in range(first[cell], first[cell + 1] - 1):
            pairs += 1
            if cuts[k, 1] * cuts[k + 1, 1] < 0.0:
                opposite += 1
    return opposite / pairs if pairs > 0 else 0.0


@njit
def _pair(
    first: NDArray[np.int64], cuts: NDArray[np.float32], oriented: bool
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Floors with the surface above them, where there is room between.

    With oriented faces a floor looks up and what hangs over it down; else a floor may be any flat face, but open to
    the sky is only the lowest of a column (else every roof would be a level).
    """
    level_first = np.zeros(first.shape[0], dtype=np.int64)
    floors, ceilings = np.empty(cuts.shape[0], np.float32), np.empty(cuts.shape[0], np.float32)
    count = 0
    for cell in range(first.shape[0] - 1):
        for k in range(first[cell], first[cell + 1]):
            facing = cuts[k, 1] if oriented else abs(cuts[k, 1])
            if facing < FLAT_COSINE:
                continue
            last = k + 1 == first[cell + 1]
            if last:
                ceiling = math.inf
                usable = oriented or k == first[cell]
            else:
                ceiling = cuts[k + 1, 0]
                usable = ceiling - cuts[k, 0] > ROOM_M and (not oriented or cuts[k + 1, 1] <= 0.0)
            if usable:
                floors[count], ceilings[count] = cuts[k, 0], ceiling
                count += 1
        level_first[cell + 1] = count
    return level_first, floors[:count].copy(), ceilings[:count].copy()


@njit
def _mark_walls(
    first: NDArray[np.int64],
    floor_m: NDArray[np.float32],
    ceiling_m: NDArray[np.float32],
    cells: NDArray[np.int64],
    heights_m: NDArray[np.float32],
    walled: NDArray[np.bool_],
) -> None:
    """Mark (in place) the levels whose cell a steep face crosses at the height of a body."""
    for n in range(cells.shape[0]):
        for k in range(first[cells[n]], first[cells[n] + 1]):
            over = heights_m[n] - floor_m[k]
            if _WALL_FROM_M < over < _WALL_TO_M and heights_m[n] < ceiling_m[k] - 0.1:
                walled[k] = True


def lowest(levels: Levels, spec: GridSpec) -> NDArray[np.int64]:
    """Index of the lowest level of each cell, int64[height, width]; -1: none."""
    count = np.diff(levels.first)
    return np.where(count > 0, levels.first[:-1], -1).reshape(spec.shape)


def level_world(name: str, spec: GridSpec, levels: Levels, chosen: NDArray[np.int64]) -> World:
    """The world of one level a cell (-1: solid), without a start yet."""
    if levels.floor_m.size == 0:
        nothing = np.zeros(spec.shape, np.float32)
        return World(name, spec, np.ones(spec.shape, np.bool_), (0.0, 0.0, 0.0), nothing, nothing)
    safe = np.maximum(chosen, 0)
    walled = (chosen >= 0) & levels.walled[safe]
    free = (chosen >= 0) & ~walled
    free, floor_m, ceiling_m = _close_seams(free, walled, levels.floor_m[safe], levels.ceiling_m[safe])
    floor_m, ceiling_m = np.where(free, floor_m, 0.0), np.where(free, ceiling_m, 0.0)
    return World(name, spec, ~free, (0.0, 0.0, 0.0), floor_m.astype(np.float32), ceiling_m.astype(np.float32))


def _close_seams(
    free: NDArray[np.bool_],
    walled: NDArray[np.bool_],
    floor_m: NDArray[np.float32],
    ceiling_m: NDArray[np.float32],
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Fill slits of one cell without a face between floors of like height: tiles of a mesh do not always meet."""
    free, floor_m, ceiling_m = free.copy(), floor_m.copy(), ceiling_m.copy()
    for axis in (0, 1):
        before, after = np.roll(free, 1, axis), np.roll(free, -1, axis)
        low, high = np.roll(floor_m, 1, axis), np.roll(floor_m, -1, axis)
        seam = ~free & ~walled & before & after & (np.abs(high - low) < 0.3)
        floor_m[seam] = 0.5 * (low + high)[seam]
        ceiling_m[seam] = np.minimum(np.roll(ceiling_m, 1, axis), np.roll(ceiling_m, -1, axis))[seam]
        free |= seam
    return free, floor_m, ceiling_m


def connected_levels(levels: Levels, spec: GridSpec, row: int, column: int) -> NDArray[np.int64]:
    """The lowest level of each cell that hangs together with the lowest at the given cell, int64[height, width].

    Ground that does not hang together but lies lower beside it is kept as well; -1: solid.
    """
    here = int(lowest(levels, spec)[row, column])
    chosen = np.full(spec.shape, -1, dtype=np.int64)
    if here < 0:
        return chosen
    seen = _spread(levels, spec.width, spec.height, row * spec.width + column, here)
    _lowest_of(levels.first, seen, chosen.reshape(-1))
    return _with_pits(levels, spec, chosen)


@njit
def _spread(levels: Levels, width: int, height: int, cell: int, level: int) -> NDArray[np.bool_]:
    """Levels (bool[n]) that a walk over neighbouring floors reaches."""
    seen = np.zeros(levels.floor_m.shape[0], dtype=np.bool_)
    stack = np.empty((levels.floor_m.shape[0] + 1, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = cell, level
    seen[level] = True
    size = 1
    while size > 0:
        size -= 1
        at, k = stack[size, 0], stack[size, 1]
        row, column = at // width, at % width
        for side in range(4):
            r = row + (1 if side == 0 else -1 if side == 1 else 0)
            c = column + (1 if side == 2 else -1 if side == 3 else 0)
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            other = r * width + c
            for n in range(levels.first[other], levels.first[other + 1]):
                if seen[n] or levels.walled[n] or abs(levels.floor_m[n] - levels.floor_m[k]) > _STEP_M:
                    continue
                gap = min(levels.ceiling_m[n], levels.ceiling_m[k]) - max(
                    levels.floor_m[n], levels.floor_m[k]
                )
                if gap > 0.5:
                    seen[n] = True
                    stack[size, 0], stack[size, 1] = other, n
                    size += 1
    return seen


@njit
def _lowest_of(first: NDArray[np.int64], seen: NDArray[np.bool_], chosen: NDArray[np.int64]) -> None:
    for cell in range(chosen.shape[0]):
        for k in range(first[cell], first[cell + 1]):
            if seen[k]:
                chosen[cell] = k
                break


def _with_pits(levels: Levels, spec: GridSpec, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """`chosen` with the lowest level of the cells that lie lower than the nearest connected floor, and near it."""
    away, nearest = ndimage.distance_transform_edt(chosen < 0, return_indices=True)
    beside_m = levels.floor_m[chosen[tuple(nearest)]]
    low = lowest(levels, spec)
    lower = levels.floor_m[np.maximum(low, 0)] < beside_m + 0.3
    kept = (chosen < 0) & (low >= 0) & lower & (away * spec.resolution_m < _BORDER_M)
    return np.where(kept, low, chosen)

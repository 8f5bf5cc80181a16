"""Polygons in the plane: whether they are fit for use, what lies in them, which cells and lines they touch.

A polygon is a sequence of closed rings, (k, 2) in m with the last point equal to the first: the outer one and its
holes. Inside is what an odd number of rings surround (even-odd rule); the border belongs to it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec

Points = NDArray[np.float64]
Rings = Sequence[Points]

FARTHEST_M = 100_000.0
"""No coordinate is larger: whoever draws in degrees or in a national grid has taken another frame."""
LONGEST_SIDE_M = 20_000.0
LEAST_AREA_M2 = 0.01


class PolygonError(ValueError):
    """A polygon that cannot be used. ring: index of the ring; wrong: what is; mend: what to do."""

    def __init__(self, ring: int, wrong: str, mend: str) -> None:
        self.ring, self.wrong, self.mend = ring, wrong, mend
        super().__init__(f"ring {ring}: {wrong}; {mend}")


def check_rings(rings: Sequence[Sequence[tuple[float, float]]], most_vertices: int) -> None:
    """Raises PolygonError, which names the ring, what is wrong and the mend."""
    if not rings:
        raise PolygonError(0, "is missing", "give at least the outer ring")
    if sum(len(ring) for ring in rings) > most_vertices:
        count = sum(len(ring) for ring in rings)
        raise PolygonError(0, f"the polygon has {count} points, over {most_vertices}", "simplify it")
    arrays = [_checked_ring(index, ring) for index, ring in enumerate(rings)]
    for index, hole in enumerate(arrays[1:], start=1):
        if not inside([arrays[0]], hole).all():
            raise PolygonError(
                index, "the hole leaves the outer ring", "keep holes inside, or draw two polygons"
            )
        for other in range(index):
            crossed = _first_crossing(arrays[other], hole)
            if crossed is not None:
                x, y = crossed[2]
                raise PolygonError(
                    index, f"crosses ring {other} at ({x:g}, {y:g})", "keep holes apart and inside"
                )


def _checked_ring(index: int, ring: Sequence[tuple[float, float]]) -> Points:
    points = np.asarray(ring, dtype=np.float64).reshape(-1, 2)
    if len(points) < 4:
        raise PolygonError(
            index, f"has {len(points)} points", "a closed ring has at least 4, the last like the first"
        )
    if not np.isfinite(points).all():
        raise PolygonError(index, "holds numbers that are not finite", "give every coordinate in metres")
    if not np.array_equal(points[0], points[-1]):
        raise PolygonError(index, "is not closed", "repeat the first point at its end")
    if np.abs(points).max() > FARTHEST_M:
        raise PolygonError(
            index, f"lies beyond {FARTHEST_M:g} m", "give metres of the frame, not degrees or a grid"
        )
    sides = points.max(axis=0) - points.min(axis=0)
    if sides.max() > LONGEST_SIDE_M:
        raise PolygonError(index, f"is {sides.max():g} m wide", f"no side may be over {LONGEST_SIDE_M:g} m")
    if (np.abs(np.diff(points, axis=0)).sum(axis=1) == 0.0).any():
        raise PolygonError(index, "holds a point twice in a row", "leave one of them out")
    crossed = self_crossing(points)
    if crossed is not None:
        a, b, (x, y) = crossed
        raise PolygonError(
            index, f"crosses itself: sides {a} and {b} at ({x:g}, {y:g})", "draw it without a knot"
        )
    if abs(area_m2(points)) < LEAST_AREA_M2:
        raise PolygonError(
            index, f"encloses {abs(area_m2(points)):g} m2", f"at least {LEAST_AREA_M2:g} m2 is wanted"
        )
    return points


def area_m2(ring: Points) -> float:
    """Area that a closed ring encloses, positive when it runs counter-clockwise."""
    x, y = ring[:, 0] - ring[0, 0], ring[:, 1] - ring[0, 1]
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def self_crossing(ring: Points) -> tuple[int, int, tuple[float, float]] | None:
    """The first two sides of a closed ring that meet elsewhere than at the corner they share, and where."""
    return _first_crossing(ring, ring, same=True)


def _first_crossing(p: Points, q: Points, same: bool = False) -> tuple[int, int, tuple[float, float]] | None:
    count = len(q) - 1
    for i in range(len(p) - 1):
        begin = i + 1 if same else 0
        where = _meeting(p[i], p[i + 1], q[begin:count], q[begin + 1 : count + 1])
        for k in np.flatnonzero(~np.isnan(where[:, 0])).tolist():
            j = begin + k
            if same and (j == i + 1 or (i == 0 and j == count - 1)) and not _folds_back(p, i, j, count):
                continue
            return i, j, (float(where[k, 0]), float(where[k, 1]))
    return None


def _folds_back(ring: Points, i: int, j: int, count: int) -> bool:
    """Whether two sides that share a corner lie on one another."""
    first, second = (i, j) if j == i + 1 else (j, i)
    a = ring[first] - ring[first + 1]
    b = ring[second + 1] - ring[second]
    return bool(a[0] * b[1] == a[1] * b[0] and float(a @ b) > 0.0) and count > 2


def _meeting(a: Points, b: Points, c: Points, d: Points) -> Points:
    """Where the segment a-b meets each segment c-d, (n, 2); nan where it does not. Touching counts."""
    out = np.full((len(c), 2), np.nan)
    r, s, offset = b - a, d - c, c - a
    cross = r[0] * s[:, 1] - r[1] * s[:, 0]
    away = offset[:, 0] * r[1] - offset[:, 1] * r[0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = (offset[:, 0] * s[:, 1] - offset[:, 1] * s[:, 0]) / cross
        u = away / cross
        meets = (cross != 0.0) & (t >= 0.0) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)
        out[meets] = a + t[meets, None] * r
    length2 = float(r @ r)
    for k in np.flatnonzero((cross == 0.0) & (away == 0.0)).tolist() if length2 > 0.0 else []:
        low, high = sorted((float(offset[k] @ r), float((d[k] - a) @ r)))
        if high >= 0.0 and low <= length2:
            out[k] = a + max(low, 0.0) / length2 * r
    return out


def inside(rings: Rings, points: Points) -> NDArray[np.bool_]:
    """Which points (n, 2) lie in a polygon, (n,)."""
    odd = np.zeros(len(points), np.bool_)
    x, y = points[:, 0], points[:, 1]
    for ring in rings:
        for (x0, y0), (x1, y1) in zip(ring[:-1].tolist(), ring[1:].tolist(), strict=True):
            if y0 == y1:
                continue
            spans = (y0 <= y) != (y1 <= y)
            odd ^= spans & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return odd


def distance_m(rings: Rings, x_m: float, y_m: float) -> float:
    """Distance from a point to the border of a polygon, m."""
    best = math.inf
    for ring in rings:
        a, r = ring[:-1], np.diff(ring, axis=0)
        length2 = np.maximum((r * r).sum(axis=1), 1e-18)
        t = np.clip(((np.array([x_m, y_m]) - a) * r).sum(axis=1) / length2, 0.0, 1.0)
        nearest = a + t[:, None] * r
        best = min(best, float(np.hypot(nearest[:, 0] - x_m, nearest[:, 1] - y_m).min()))
    return best


def crosses(rings: Rings, begin: Points, end: Points) -> NDArray[np.bool_]:
    """Which segments from begin (n, 2) to end (n, 2) meet the border of a polygon, (n,)."""
    found = np.zeros(len(begin), np.bool_)
    for ring in rings:
        for c, d in itertools.pairwise(ring):
            found |= ~np.isnan(_meeting(c, d, begin, end)[:, 0])
    return found


def cells_inside(spec: GridSpec, rings: Rings) -> NDArray[np.bool_]:
    """Cells of a grid whose centre lies in a polygon, (h, w). A row at a time, so that many corners cost little."""
    mask = np.zeros(spec.shape, np.bool_)
    sides = np.concatenate([np.concatenate([ring[:-1], ring[1:]], axis=1) for ring in rings])
    sides = sides[sides[:, 1] != sides[:, 3]]
    slope = (sides[:, 2] - sides[:, 0]) / (sides[:, 3] - sides[:, 1])
    y_low, y_high = sides[:, [1, 3]].min(), sides[:, [1, 3]].max()
    x = spec.centres_x()
    for row, y in enumerate(spec.centres_y().tolist()):
        if not y_low <= y <= y_high:
            continue
        spans = (sides[:, 1] <= y) != (sides[:, 3] <= y)
        at = np.sort(sides[spans, 0] + (y - sides[spans, 1]) * slope[spans])
        mask[row] = np.searchsorted(at, x, side="right") % 2 == 1
    return mask


def cells_on_border(spec: GridSpec, rings: Rings) -> NDArray[np.bool_]:
    """Cells of a grid that the border of a polygon runs through, (h, w): what is thinner than a cell shuts as well."""
    mask = np.zeros(spec.shape, np.bool_)
    h = spec.resolution_m
    low = np.array([spec.ix0 * h, spec.iy0 * h]) - h
    high = np.array([(spec.ix0 + spec.width) * h, (spec.iy0 + spec.height) * h]) + h
    for ring in rings:
        for a, b in itertools.pairwise(ring):
            piece = _clip(a, b, low, high)
            if piece is None:
                continue
            steps = max(1, math.ceil(2.0 * math.dist(*piece) / h))
            at = piece[0] + np.linspace(0.0, 1.0, steps + 1)[:, None] * (piece[1] - piece[0])
            column = np.floor(at[:, 0] / h).astype(np.int64) - spec.ix0
            row = np.floor(at[:, 1] / h).astype(np.int64) - spec.iy0
            fits = (row >= 0) & (row < spec.height) & (column >= 0) & (column < spec.width)
            mask[row[fits], column[fits]] = True
    return mask


def _clip(a: Points, b: Points, low: Points, high: Points) -> tuple[Points, Points] | None:
    """The part of a segment in a box (Liang and Barsky), or None."""
    begin, end, r = 0.0, 1.0, b - a
    for axis in (0, 1):
        if r[axis] == 0.0:
            if not low[axis] <= a[axis] <= high[axis]:
                return None
            continue
        t0, t1 = sorted(((low[axis] - a[axis]) / r[axis], (high[axis] - a[axis]) / r[axis]))
        begin, end = max(begin, float(t0)), min(end, float(t1))
    return (a + begin * r, a + end * r) if begin <= end else None

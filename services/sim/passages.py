"""Underground passages: curved centre lines with a width, and a lane along each that hazards leave free.

What the generators of caves share: where rock is, how deep inside the open a cell lies, how far from the lanes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import GridSpec
from services.sim.noise import Field, line_noise

SAMPLE_M = 0.25
_LANE_HALF_M = 1.2
"""A lane keeps so far from the rock where the passage is wide enough."""


@dataclass(frozen=True)
class Passage:
    """A centre line (n, 2) in metres, samples `SAMPLE_M` apart, with half widths (n,) and the lane's line (n, 2)."""

    line_m: Field
    half_width_m: Field
    lane_m: Field

    @property
    def length_m(self) -> float:
        """Along the centre line."""
        return float(np.hypot(*np.diff(self.line_m, axis=0).T).sum())


class Hollow(NamedTuple):
    """Fields over the grid: how deep inside the open a cell lies (negative: rock), the half width there, the
    distance to the nearest lane, all in metres."""

    depth_m: Field
    half_width_m: Field
    lane_distance_m: Field


def curve(points_m: Field) -> Field:
    """A smooth line through the points (n, 2), sampled about every `SAMPLE_M` (Catmull-Rom)."""
    padded = np.vstack([2.0 * points_m[0] - points_m[1], points_m, 2.0 * points_m[-1] - points_m[-2]])
    parts = []
    for k in range(len(points_m) - 1):
        a, b, c, d = padded[k : k + 4]
        t = np.linspace(0.0, 1.0, max(2, math.ceil(math.hypot(*(c - b)) / (SAMPLE_M / 2.0))), endpoint=False)[
            :, None
        ]
        parts.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    fine = np.vstack([*parts, points_m[-1:]])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fine, axis=0).T))])
    even = np.linspace(0.0, way[-1], max(2, math.ceil(way[-1] / SAMPLE_M)))
    return np.stack([np.interp(even, way, fine[:, 0]), np.interp(even, way, fine[:, 1])], axis=1)


def passage(line_m: Field, half_width_m: Field, rng: np.random.Generator) -> Passage:
    """A passage whose lane winds from side to side where there is room, and runs in the middle at both ends."""
    tangent = np.gradient(line_m, axis=0)
    tangent /= np.hypot(tangent[:, 0], tangent[:, 1])[:, None]
    side = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    count = len(line_m)
    room = np.maximum(half_width_m - _LANE_HALF_M, 0.0)
    ends = np.minimum(1.0, np.minimum(np.arange(count), np.arange(count)[::-1]) * SAMPLE_M / 3.0)
    winding = np.clip(1.6 * line_noise(count, math.ceil(count * SAMPLE_M / 8.0), rng), -1.0, 1.0)
    return Passage(line_m, half_width_m, line_m + side * (winding * room * ends)[:, None])


def grid_around(passages: Sequence[Passage], resolution_m: float, margin_m: float) -> GridSpec:
    """The grid that holds all passages with a margin."""
    low = np.min([(p.line_m - p.half_width_m[:, None]).min(axis=0) for p in passages], axis=0) - margin_m
    high = np.max([(p.line_m + p.half_width_m[:, None]).max(axis=0) for p in passages], axis=0) + margin_m
    first, last = np.floor(low / resolution_m).astype(int), np.ceil(high / resolution_m).astype(int)
    return GridSpec(resolution_m, *first.tolist(), *(last - first).tolist())


def hollow(spec: GridSpec, passages: Sequence[Passage]) -> Hollow:
    """The union of the passages, before any noise of the walls."""
    depth = np.full(spec.shape, -1e3)
    width = np.ones(spec.shape)
    on_lane = np.zeros(spec.shape, dtype=np.bool_)
    for p in passages:
        for (x_m, y_m), half_m in zip(p.line_m, p.half_width_m, strict=True):
            _open(spec, depth, width, float(x_m), float(y_m), float(half_m))
        _mark(spec, on_lane, p.lane_m)
    return Hollow(depth, width, ndimage.distance_transform_edt(~on_lane) * spec.resolution_m)


def _open(spec: GridSpec, depth: Field, width: Field, x_m: float, y_m: float, half_m: float) -> None:
    """Join a disc to the open, in place."""
    reach = half_m + 1.5
    rows, columns = window(spec, x_m, y_m, reach)
    distance = np.hypot(spec.centres_x()[columns] - x_m, spec.centres_y()[rows, None] - y_m)
    deeper = half_m - distance > depth[rows, columns]
    depth[rows, columns][deeper] = (half_m - distance)[deeper]
    width[rows, columns][deeper] = half_m


def _mark(spec: GridSpec, mask: NDArray[np.bool_], line_m: Field) -> None:
    way = np.arange(len(line_m))
    fine = np.linspace(0, len(line_m) - 1, 4 * len(line_m))
    columns = np.floor(np.interp(fine, way, line_m[:, 0]) / spec.resolution_m).astype(int) - spec.ix0
    rows = np.floor(np.interp(fine, way, line_m[:, 1]) / spec.resolution_m).astype(int) - spec.iy0
    mask[np.clip(rows, 0, spec.height - 1), np.clip(columns, 0, spec.width - 1)] = True


def window(spec: GridSpec, x_m: float, y_m: float, reach_m: float) -> tuple[slice, slice]:
    """Rows and columns of the cells within `reach_m` of a point, cut to the grid."""
    row_low, column_low = spec.cell_of(x_m - reach_m, y_m - reach_m)
    row_high, column_high = spec.cell_of(x_m + reach_m, y_m + reach_m)
    return (
        slice(max(row_low, 0), max(row_high + 1, 0)),
        slice(max(column_low, 0), max(column_high + 1, 0)),
    )

"""The line to drive: smoothing with clearance, projection, hazards on the way, speeds and times."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.fences import Shut
from planning.footprint import bilinear, segment_min_clearance
from planning.grid import FREE, LETHAL, GridSpec
from planning.kernels import njit
from schemas.world import RiskMap
from services.reconciler.config import Config

STEP_M = 0.1
"""Spacing of the points of a path."""
_FREE = FREE
_WAY_OUT_M = 1.0
_SHARP_LEAST, _SHARP_MOST = math.radians(35.0), math.radians(130.0)
_STRAIGHT = 0.3
"""An arc's legs turn by less than this at each point, rad."""
ARC_POINTS = 5
"""On either side of a corner: half a metre."""


@dataclass(frozen=True, slots=True)
class Ground:
    """The risk map as the path functions need it. state (h, w), clearance_m (h, w): the operator's fences are obstacles
    in both. shut (h, w): where only a fence is in the way; None: nowhere."""

    spec: GridSpec
    state: NDArray[np.uint8]
    clearance_m: NDArray[np.float32]
    shut: NDArray[np.bool_] | None = None

    def is_shut(self, x_m: float, y_m: float, within_m: float) -> bool:
        """Whether a fence lies so near to a point."""
        if self.shut is None:
            return False
        row, column = self.spec.cell_of(x_m, y_m)
        reach = math.ceil(within_m / self.spec.resolution_m)
        rows = slice(max(0, row - reach), max(0, row + reach + 1))
        return bool(self.shut[rows, max(0, column - reach) : max(0, column + reach + 1)].any())


def fenced_ground(risk: RiskMap, shut: Shut | None, robot: tuple[float, float]) -> Ground:
    """A risk map with what the fences shut as obstacles.

    A robot that stands in a fence all the same (a closure has moved one of the two) may leave: the fence does not count
    near to it.
    """
    g = risk.grid
    spec = GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height)
    if shut is None:
        return Ground(spec, risk.state, risk.clearance_m)
    mask, distance_m = shut.mask, shut.distance_m
    row, column = spec.cell_of(*robot)
    if spec.contains(row, column) and mask[row, column]:
        rows, columns = np.ogrid[: spec.height, : spec.width]
        near = np.hypot(rows - row, columns - column) * spec.resolution_m <= _WAY_OUT_M
        mask, distance_m = mask & ~near, np.where(near, np.float32(np.inf), distance_m)
    state = np.where(mask, np.uint8(LETHAL), risk.state)
    return Ground(spec, state, np.minimum(risk.clearance_m, distance_m), mask)


def arc_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Arc length at each point, (k,), of a line (k, 2)."""
    steps = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    return np.concatenate([[0.0], np.cumsum(steps)])


def project(points: NDArray[np.float64], x_m: float, y_m: float, low: int, high: int) -> tuple[int, float]:
    """(index, distance) of the nearest point of the line between two indices."""
    piece = points[low : high + 1]
    distance = np.hypot(piece[:, 0] - x_m, piece[:, 1] - y_m)
    best = int(np.argmin(distance))
    return low + best, float(distance[best])


def smooth(
    points: NDArray[np.float64],
    fixed: int,
    ground: Ground,
    config: Config,
    pinned: NDArray[np.int64] | None = None,
) -> NDArray[np.float64]:
    """The line resampled to STEP_M, corners rounded and pushed off walls; the first `fixed` points stay as they are.

    points: (k, 2) m. pinned: (m,) indices of points through which the line must go, with its corner there as sharp as
    it is. No step makes the clearance worse below the comfort clearance.
    """
    first = max(fixed - 1, 0)
    kept, rest = points[:fixed], points[first:]
    s = ground.spec
    stops = [] if pinned is None else [int(p) - first for p in pinned if 0 < p - first < len(rest) - 1]
    bounds = [0, *dict.fromkeys(stops), len(rest) - 1]
    pieces: list[NDArray[np.float64]] = []
    for low, high in itertools.pairwise(bounds):
        piece = resample(
            string_pull(
                rest[low : high + 1], ground.clearance_m, s.resolution_m, s.ix0, s.iy0,
                config.comfort_clearance_m, 0.4, 6,
            )
        )  # fmt: skip
        relax(
            piece, ground.clearance_m, s.resolution_m, s.ix0, s.iy0, config.comfort_clearance_m, 40,
            config.footprint_radius_m + config.clearance_margin_m,
        )  # fmt: skip
        pieces.append(piece if not pieces else piece[1:])
    line = np.concatenate(pieces) if pieces else rest[:1]
    return np.concatenate([kept[:-1], line]) if fixed > 1 else line


def resample(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The line with a point every STEP_M (and at its ends)."""
    s = arc_lengths(points)
    if s[-1] < 1e-6:
        return points[:1].copy()
    count = max(2, math.ceil(s[-1] / STEP_M) + 1)
    at = np.linspace(0.0, s[-1], count)
    return np.stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])], axis=1)


@njit
def string_pull(
    points: NDArray[np.float64],
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    comfort_m: float,
    max_offset_m: float,
    max_skip: int,
) -> NDArray[np.float64]:
    """Skip points of a lattice path where the straight line keeps as clear and stays near to what it skips."""
    count = points.shape[0]
    out = np.empty_like(points)
    out[0] = points[0]
    size, i = 1, 0
    while i < count - 1:
        chosen = i + 1
        for j in range(min(i + max_skip, count - 1), i + 1, -1):
            if _may_skip(points, i, j, clearance_m, resolution_m, ix0, iy0, comfort_m, max_offset_m):
                chosen = j
                break
        out[size] = points[chosen]
        size += 1
        i = chosen
    return out[:size].copy()


@njit
def _may_skip(
    points: NDArray[np.float64],
    i: int,
    j: int,
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    comfort_m: float,
    max_offset_m: float,
) -> bool:
    x0, y0, x1, y1 = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
    length = math.hypot(x1 - x0, y1 - y0)
    if length < 1e-6:
        return False
    needed = comfort_m
    for m in range(i, j):
        offset = abs((points[m, 0] - x0) * (y1 - y0) - (points[m, 1] - y0) * (x1 - x0)) / length
        along = (points[m, 0] - x0) * (x1 - x0) + (points[m, 1] - y0) * (y1 - y0)
        if offset > max_offset_m or along < -1e-9 or along > length * length + 1e-9:
            return False
        leg = segment_min_clearance(
            clearance_m,
            resolution_m,
            ix0,
            iy0,
            points[m, 0],
            points[m, 1],
            points[m + 1, 0],
            points[m + 1, 1],
        )
        needed = min(needed, leg - 0.004)
    return segment_min_clearance(clearance_m, resolution_m, ix0, iy0, x0, y0, x1, y1) >= needed


@njit
def clearance_at(
    clearance_m: NDArray[np.float32], resolution_m: float, ix0: int, iy0: int, x: float, y: float
) -> float:
    """Bilinear clearance at a point, m."""
    return bilinear(clearance_m, x / resolution_m - ix0 - 0.5, y / resolution_m - iy0 - 0.5)


@njit
def relax(
    line: NDArray[np.float64],
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    comfort_m: float,
    rounds: int,
    radius_m: float,
) -> None:
    """Round the corners of a line and push it off walls, in place; its ends stay.

    No point comes to have less clearance than it began with (or than is comfortable), but for a few millimetres; nor
    less than the radius where it had more, nor any less where it had not even that.
    """
    h = resolution_m
    floor_m = np.empty(line.shape[0])
    for i in range(line.shape[0]):
        floor_m[i] = min(clearance_at(clearance_m, h, ix0, iy0, line[i, 0], line[i, 1]), comfort_m) - 0.004
    for _ in range(rounds):
        for i in range(1, line.shape[0] - 1):
            x, y = line[i, 0], line[i, 1]
            before = clearance_at(clearance_m, h, ix0, iy0, x, y)
            nx = x + 0.35 * (line[i - 1, 0] + line[i + 1, 0] - 2.0 * x)
            ny = y + 0.35 * (line[i - 1, 1] + line[i + 1, 1] - 2.0 * y)
            if before < comfort_m:
                gx = clearance_at(clearance_m, h, ix0, iy0, x + h, y) - clearance_at(
                    clearance_m, h, ix0, iy0, x - h, y
                )
                gy = clearance_at(clearance_m, h, ix0, iy0, x, y + h) - clearance_at(
                    clearance_m, h, ix0, iy0, x, y - h
                )
                norm = math.hypot(gx, gy)
                if norm > 0.2 * h:
                    push = 0.1 * (comfort_m - before)
                    nx += push * gx / norm
                    ny += push * gy / norm
            after = clearance_at(clearance_m, h, ix0, iy0, nx, ny)
            if after >= floor_m[i] and after >= min(before, radius_m):
                line[i, 0], line[i, 1] = nx, ny


@njit
def round_corners(
    line: NDArray[np.float64],
    begin: int,
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    comfort_m: float,
) -> None:
    """Turn corners from index `begin` on into arcs, in place: at a sharp one the follower stops and turns on the spot.

    A corner is a turn of 35 to 130 degrees at one point, with `ARC_POINTS` points or fewer to the next corner on both
    sides for the arc. It stays where an arc would come nearer to obstacles than is comfortable and than it did.
    """
    i = begin + 2
    while i < line.shape[0] - 2:
        if not _SHARP_LEAST < _turn_at(line, i) < _SHARP_MOST:
            i += 1
            continue
        span = 2
        while (
            span < ARC_POINTS
            and i - span - 1 >= begin
            and i + span + 1 < line.shape[0]
            and _turn_at(line, i - span) < _STRAIGHT
            and _turn_at(line, i + span) < _STRAIGHT
        ):
            span += 1
        _put_arc(line, i, span, clearance_m, resolution_m, ix0, iy0, comfort_m)
        i += span


@njit
def _turn_at(line: NDArray[np.float64], i: int) -> float:
    """Angle between the steps to and from a point, 0 to pi."""
    ax, ay = line[i, 0] - line[i - 1, 0], line[i, 1] - line[i - 1, 1]
    bx, by = line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1]
    return abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))


@njit
def _put_arc(
    line: NDArray[np.float64],
    i: int,
    span: int,
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    comfort_m: float,
) -> None:
    """Replace the points within `span` of a corner by as many on a curve, unless that comes too near to something."""
    ax, ay, bx, by = line[i - span, 0], line[i - span, 1], line[i + span, 0], line[i + span, 1]
    cx, cy = line[i, 0], line[i, 1]
    # The circle that touches both legs, as a rational quadratic curve with the weight cos(turn / 2).
    weight = math.cos(0.5 * _turn_at(line, i))
    needed = min(clearance_at(clearance_m, resolution_m, ix0, iy0, cx, cy), comfort_m) - 0.004
    arc = np.empty((2 * span - 1, 2))
    for j in range(1, 2 * span):
        t = j / (2.0 * span)
        u, v, w = (1.0 - t) * (1.0 - t), 2.0 * t * (1.0 - t) * weight, t * t
        x, y = (u * ax + v * cx + w * bx) / (u + v + w), (u * ay + v * cy + w * by) / (u + v + w)
        if clearance_at(clearance_m, resolution_m, ix0, iy0, x, y) < needed:
            return
        arc[j - 1, 0], arc[j - 1, 1] = x, y
    line[i - span + 1 : i + span] = arc


@njit
def first_hazard(
    line: NDArray[np.float64],
    begin: int,
    state: NDArray[np.uint8],
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    needed_m: float,
) -> int:
    """Index of the first point from `begin` on where the robot does not fit or the ground is not known; -1: none."""
    for i in range(begin, line.shape[0]):
        column = math.floor(line[i, 0] / resolution_m) - ix0
        row = math.floor(line[i, 1] / resolution_m) - iy0
        if row < 0 or column < 0 or row >= state.shape[0] or column >= state.shape[1]:
            return i
        if state[row, column] != _FREE:
            return i
        if clearance_at(clearance_m, resolution_m, ix0, iy0, line[i, 0], line[i, 1]) < needed_m:
            return i
    return -1


def headings(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Yaw along the line at each point, (k,)."""
    if len(line) < 2:
        return np.zeros(len(line))
    steps = np.diff(line, axis=0)
    yaw = np.arctan2(steps[:, 1], steps[:, 0])
    return np.concatenate([yaw, yaw[-1:]])


def speeds(
    line: NDArray[np.float64], speed_now_mps: float, ground: Ground, config: Config, share: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speed and time at each point within speed, turn-rate, clearance and acceleration limits; 0 at the end.

    share: of the speed limits (degraded operation). Returns (speed_mps, time_s), both (k,).
    """
    k, s = len(line), arc_lengths(line)
    if k < 2:
        return np.zeros(k), np.zeros(k)
    limit = np.full(k, config.max_speed_mps * share)
    limit = np.minimum(limit, _curve_limit(line, config))
    g = ground.spec
    clear = np.array([clearance_at(ground.clearance_m, g.resolution_m, g.ix0, g.iy0, x, y) for x, y in line])
    span = max(config.free_clearance_m - config.tight_clearance_m, 1e-3)
    roomy = np.clip((clear - config.tight_clearance_m) / span, 0.0, 1.0)
    tight = config.min_speed_mps + (config.max_speed_mps * share - config.min_speed_mps) * roomy
    limit = np.maximum(np.minimum(limit, tight), min(config.min_speed_mps, config.max_speed_mps * share))
    limit[-1] = 0.0
    step = np.diff(s)
    for i in range(k - 2, -1, -1):
        limit[i] = min(limit[i], math.sqrt(limit[i + 1] ** 2 + 2.0 * config.max_acceleration_mps2 * step[i]))
    limit[0] = min(limit[0], max(speed_now_mps, config.min_speed_mps))
    for i in range(1, k):
        limit[i] = min(
            limit[i], math.sqrt(limit[i - 1] ** 2 + 2.0 * config.max_acceleration_mps2 * step[i - 1])
        )
    mean = np.maximum(0.5 * (limit[1:] + limit[:-1]), 0.05)
    return limit, np.concatenate([[0.0], np.cumsum(step / mean)])


def _curve_limit(line: NDArray[np.float64], config: Config) -> NDArray[np.float64]:
    """Speed limit from the turn rate: omega_max over the curvature, seen over a window of 0.5 m."""
    yaw = np.unwrap(headings(line))
    half = 2
    padded = np.pad(yaw, half, mode="edge")
    change = np.abs(padded[2 * half :] - padded[: -2 * half])
    curvature = change / (2 * half * STEP_M)
    return np.asarray(config.max_turn_rate_radps / np.maximum(curvature, 1e-3))

"""Kernels of the Local IRM: anchors, edges, visibility, all on the fine layers around the robot."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.footprint import segment_min_clearance, segment_risk
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit, njit_borrowing
from planning.search import dijkstra_box, trace_path

_DX = DIRECTION_DX
_DY = DIRECTION_DY
_COMFORT_CAP_M = 0.6


@njit
def choose_anchors(
    free_space: NDArray[np.bool_],
    known: NDArray[np.bool_],
    clearance_m: NDArray[np.float32],
    resolution_m: float,
    spacing_m: float,
    ix0: int,
    iy0: int,
    lattice_ix0: int,
    lattice_iy0: int,
    size: int,
    previous_m: NDArray[np.float64],
    anchor_m: NDArray[np.float64],
    state: NDArray[np.uint8],
) -> None:
    """Pick the point that stands for each patch: roomy, and near to the patch's middle.

    previous_m: (n, 2) the anchors of the last Local IRM for these nodes (nan: none); one that is still in free space
    keeps its place unless another is clearly better, so that paths do not wander. anchor_m: (n, 2) out, m.
    state: (n,) out, 0 unknown, 1 traversable, 2 not.
    """
    height, width = free_space.shape
    for node in range(size * size):
        low_x = (lattice_ix0 + node % size) * spacing_m
        low_y = (lattice_iy0 + node // size) * spacing_m
        c0, r0 = round(low_x / resolution_m) - ix0, round(low_y / resolution_m) - iy0
        cells = round(spacing_m / resolution_m)
        best, seen = -math.inf, 0
        for row in range(max(0, r0), min(height, r0 + cells)):
            for column in range(max(0, c0), min(width, c0 + cells)):
                seen += 1 if known[row, column] else 0
                if not free_space[row, column]:
                    continue
                x = (ix0 + column + 0.5) * resolution_m
                y = (iy0 + row + 0.5) * resolution_m
                off = math.hypot(x - low_x - 0.5 * spacing_m, y - low_y - 0.5 * spacing_m)
                score = min(clearance_m[row, column], _COMFORT_CAP_M) - 0.3 * off
                if math.hypot(x - previous_m[node, 0], y - previous_m[node, 1]) < 1e-6:
                    score += 0.1
                if score > best:
                    best = score
                    anchor_m[node, 0], anchor_m[node, 1] = x, y
        if best > -math.inf:
            state[node] = 1
        else:
            state[node] = 2 if 2 * seen >= cells * cells else 0
            anchor_m[node, 0], anchor_m[node, 1] = low_x + 0.5 * spacing_m, low_y + 0.5 * spacing_m


@njit
def path_hazard(
    points_m: NDArray[np.float64],
    hazard: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
) -> tuple[float, float]:
    """Length and hazard integral of a polyline, (k, 2) m."""
    length, total = 0.0, 0.0
    for i in range(points_m.shape[0] - 1):
        d, h = segment_risk(
            hazard,
            resolution_m,
            ix0,
            iy0,
            points_m[i, 0],
            points_m[i, 1],
            points_m[i + 1, 0],
            points_m[i + 1, 1],
        )
        length += d
        total += h
    return length, total


@njit
def connect_neighbours(
    free_space: NDArray[np.bool_],
    clearance_m: NDArray[np.float32],
    hazard: NDArray[np.float32],
    step_cost: NDArray[np.float32],
    needed_m: float,
    resolution_m: float,
    spacing_m: float,
    ix0: int,
    iy0: int,
    size: int,
    detour: float,
    state: NDArray[np.uint8],
    anchor_m: NDArray[np.float64],
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    bent_edge: NDArray[np.int32],
    bent_start: NDArray[np.int32],
    bent_xy: NDArray[np.float32],
) -> int:
    """Edges between 8-connected anchors: straight where the robot fits, else the best short path around the corner.

    A path may be longer than the straight line by `detour`; where the lattice would fall apart without it, by any
    length (the ground is connected: a lattice that is not would hold the robot in a pocket). Writes distance_m and
    risk, (n, 8), both directions; bent edges into the bent arrays. Returns their number.
    """
    bent_start[0] = 0
    label = np.arange(size * size)
    bent = _connect(
        free_space, clearance_m, hazard, step_cost, needed_m, resolution_m, spacing_m, ix0, iy0, size, detour,
        state, anchor_m, label, 0, distance_m, risk, bent_edge, bent_start, bent_xy,
    )  # fmt: skip
    if _label_lattice(size, state, distance_m, label) > 1:
        bent = _connect(
            free_space, clearance_m, hazard, step_cost, needed_m, resolution_m, spacing_m, ix0, iy0, size,
            math.inf, state, anchor_m, label, bent, distance_m, risk, bent_edge, bent_start, bent_xy,
        )  # fmt: skip
    return bent


@njit
def _label_lattice(
    size: int, state: NDArray[np.uint8], distance_m: NDArray[np.float32], label: NDArray[np.int64]
) -> int:
    """Number of connected components of the traversable nodes; label: (n,) out, -1 for the others."""
    stack = np.empty(size * size, np.int64)
    label[:] = -1
    count = 0
    for first in range(size * size):
        if state[first] != 1 or label[first] >= 0:
            continue
        label[first], stack[0], top = count, first, 1
        while top > 0:
            top -= 1
            node = stack[top]
            for k in range(8):
                if distance_m[node, k] > 0.0:
                    other = node + _DY[k] * size + _DX[k]
                    if label[other] < 0:
                        label[other] = count
                        stack[top] = other
                        top += 1
        count += 1
    return count


@njit
def _straight_edges(
    free_space: NDArray[np.bool_],
    clearance_m: NDArray[np.float32],
    hazard: NDArray[np.float32],
    needed_m: float,
    resolution_m: float,
    ix0: int,
    iy0: int,
    size: int,
    state: NDArray[np.uint8],
    anchor_m: NDArray[np.float64],
    label: NDArray[np.int64],
    node: int,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    pending: NDArray[np.int64],
) -> bool:
    """The straight edges of a node in the directions 0 .. 3. pending: (4,) out, 1 where none fits. Whether any is."""
    some = False
    for k in range(4):
        pending[k] = 0
        r, c = node // size + _DY[k], node % size + _DX[k]
        if r < 0 or c < 0 or r >= size or c >= size or state[r * size + c] != 1:
            continue
        other = r * size + c
        if label[other] == label[node]:
            continue
        x0, y0, x1, y1 = anchor_m[node, 0], anchor_m[node, 1], anchor_m[other, 0], anchor_m[other, 1]
        if segment_min_clearance(clearance_m, resolution_m, ix0, iy0, x0, y0, x1, y1) >= needed_m and line_in(
            free_space, resolution_m, ix0, iy0, x0, y0, x1, y1
        ):
            d, h = segment_risk(hazard, resolution_m, ix0, iy0, x0, y0, x1, y1)
            set_edge(node, other, k, d, h, distance_m, risk)
        else:
            pending[k], some = 1, True
    return some


@njit
def _line_of(
    parent: NDArray[np.int32], row: int, column: int, resolution_m: float, ix0: int, iy0: int
) -> NDArray[np.float64]:
    """The centres of the cells on the way to a cell, (n, 2) m."""
    cells = trace_path(parent, row, column)
    line = np.empty((cells.shape[0], 2), np.float64)
    for i in range(cells.shape[0]):
        line[i, 0] = (ix0 + cells[i, 1] + 0.5) * resolution_m
        line[i, 1] = (iy0 + cells[i, 0] + 0.5) * resolution_m
    return line


@njit
def _connect(
    free_space: NDArray[np.bool_],
    clearance_m: NDArray[np.float32],
    hazard: NDArray[np.float32],
    step_cost: NDArray[np.float32],
    needed_m: float,
    resolution_m: float,
    spacing_m: float,
    ix0: int,
    iy0: int,
    size: int,
    detour: float,
    state: NDArray[np.uint8],
    anchor_m: NDArray[np.float64],
    label: NDArray[np.int64],
    bent: int,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    bent_edge: NDArray[np.int32],
    bent_start: NDArray[np.int32],
    bent_xy: NDArray[np.float32],
) -> int:
    """One pass over the pairs of anchors whose labels differ. bent: bent edges so far. Returns how many there are."""
    cost = np.empty(free_space.shape, np.float64)
    parent = np.empty(free_space.shape, np.int32)
    points = bent_start[bent]
    pending = np.zeros(4, np.int64)
    for node in range(size * size):
        if state[node] != 1:
            continue
        row, column = node // size, node % size
        if not _straight_edges(
            free_space, clearance_m, hazard, needed_m, resolution_m, ix0, iy0, size, state, anchor_m, label, node,
            distance_m, risk, pending,
        ):  # fmt: skip
            continue
        start_c = math.floor(anchor_m[node, 0] / resolution_m) - ix0
        start_r = math.floor(anchor_m[node, 1] / resolution_m) - iy0
        reach = math.ceil(2.2 * spacing_m / resolution_m)
        box = (start_r - reach, start_r + reach + 1, start_c - reach, start_c + reach + 1)
        ends = np.empty((4, 2), np.int32)
        awaited = 0
        for k in range(4):
            if pending[k] == 1:
                other = (row + _DY[k]) * size + column + _DX[k]
                ends[awaited, 0] = math.floor(anchor_m[other, 1] / resolution_m) - iy0
                ends[awaited, 1] = math.floor(anchor_m[other, 0] / resolution_m) - ix0
                awaited += 1
        dijkstra_box(
            step_cost, free_space, resolution_m, start_r, start_c, box, ends[:awaited], 6.0 * spacing_m, cost,
            parent,
        )  # fmt: skip
        for k in range(4):
            if pending[k] == 0:
                continue
            other = (row + _DY[k]) * size + column + _DX[k]
            end_c = math.floor(anchor_m[other, 0] / resolution_m) - ix0
            end_r = math.floor(anchor_m[other, 1] / resolution_m) - iy0
            inside = box[0] <= end_r < box[1] and box[2] <= end_c < box[3]
            if not inside or not math.isfinite(cost[end_r, end_c]):
                continue
            line = _line_of(parent, end_r, end_c, resolution_m, ix0, iy0)
            d, h = path_hazard(line, hazard, resolution_m, ix0, iy0)
            straight = math.hypot(
                anchor_m[other, 0] - anchor_m[node, 0], anchor_m[other, 1] - anchor_m[node, 1]
            )
            inner = line.shape[0] - 2
            room = bent < bent_edge.shape[0] and points + inner <= bent_xy.shape[0]
            if d > detour * straight + 0.5 * spacing_m or inner < 0 or not room:
                continue
            set_edge(node, other, k, d, h, distance_m, risk)
            for i in range(inner):
                bent_xy[points, 0], bent_xy[points, 1] = line[i + 1, 0], line[i + 1, 1]
                points += 1
            bent_edge[bent] = node * 8 + k
            bent += 1
            bent_start[bent] = points
    return bent


@njit_borrowing
def line_in(
    mask: NDArray[np.bool_],
    resolution_m: float,
    ix0: int,
    iy0: int,
    x0: float,
    y0: float,
    x1: float,
    y1: float,
) -> bool:
    """Whether points every half cell of the segment lie in the mask."""
    steps = max(1, math.ceil(2.0 * math.hypot(x1 - x0, y1 - y0) / resolution_m))
    for i in range(steps + 1):
        column = math.floor((x0 + (x1 - x0) * i / steps) / resolution_m) - ix0
        row = math.floor((y0 + (y1 - y0) * i / steps) / resolution_m) - iy0
        if row < 0 or column < 0 or row >= mask.shape[0] or column >= mask.shape[1] or not mask[row, column]:
            return False
    return True


@njit_borrowing
def set_edge(
    a: int,
    b: int,
    k: int,
    distance: float,
    hazard_integral: float,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
) -> None:
    """Write an edge in both directions; rho = 1 - exp(-integral of h ds)."""
    rho = 1.0 - math.exp(-hazard_integral)
    distance_m[a, k] = distance_m[b, (k + 4) % 8] = max(distance, 1e-3)
    risk[a, k] = risk[b, (k + 4) % 8] = rho


@njit
def sum_patches(
    values: NDArray[np.float32],
    counted: NDArray[np.bool_],
    resolution_m: float,
    spacing_m: float,
    ix0: int,
    iy0: int,
    lattice_ix0: int,
    lattice_iy0: int,
    size: int,
    total: NDArray[np.float64],
    count: NDArray[np.int64],
) -> None:
    """Sum a fine layer over the counted cells of each patch; total and count: (n,), zeroed by the caller."""
    for row in range(values.shape[0]):
        r = math.floor((iy0 + row + 0.5) * resolution_m / spacing_m) - lattice_iy0
        if r < 0 or r >= size:
            continue
        for column in range(values.shape[1]):
            if not counted[row, column]:
                continue
            c = math.floor((ix0 + column + 0.5) * resolution_m / spacing_m) - lattice_ix0
            if 0 <= c < size:
                total[r * size + c] += values[row, column]
                count[r * size + c] += 1


@njit
def halve(
    opaque: NDArray[np.bool_],
    mass: NDArray[np.float32],
    out_opaque: NDArray[np.bool_],
    out_mass: NDArray[np.float32],
) -> None:
    """Layers at half the resolution for visibility: opaque where two or more of four cells are; mass summed."""
    for row in range(out_opaque.shape[0]):
        for column in range(out_opaque.shape[1]):
            blocked = 0
            total = np.float32(0.0)
            for r in range(2 * row, 2 * row + 2):
                for c in range(2 * column, 2 * column + 2):
                    blocked += 1 if opaque[r, c] else 0
                    total += mass[r, c]
            out_opaque[row, column] = blocked >= 2
            out_mass[row, column] = total


@njit
def halve_heights(
    ground_m: NDArray[np.float32],
    top_m: NDArray[np.float32],
    out_ground_m: NDArray[np.float32],
    out_top_m: NDArray[np.float32],
) -> None:
    """Heights at half the resolution: the mean of the ground, and of the tops the second highest of four."""
    for row in range(out_ground_m.shape[0]):
        for column in range(out_ground_m.shape[1]):
            total = np.float32(0.0)
            first, second = np.float32(-np.inf), np.float32(-np.inf)
            for r in range(2 * row, 2 * row + 2):
                for c in range(2 * column, 2 * column + 2):
                    total += ground_m[r, c]
                    if top_m[r, c] > first:
                        first, second = top_m[r, c], first
                    elif top_m[r, c] > second:
                        second = top_m[r, c]
            out_ground_m[row, column] = np.float32(0.25) * total
            out_top_m[row, column] = second

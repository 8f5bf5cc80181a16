"""Shortest paths on grids and on graphs in CSR form, and straightening of grid paths.

Dijkstra with an indexed binary heap in preallocated arrays: deterministic, no Python objects. Equal costs are
settled in an order that depends on the input only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.footprint import _min_clearance_above, segment_risk
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit, njit_borrowing

_DX = DIRECTION_DX
_DY = DIRECTION_DY


@njit_borrowing
def heap_lift(heap: NDArray[np.int32], place: NDArray[np.int32], key: NDArray[np.float64], slot: int) -> None:
    """Move the item at `slot` of a min-heap up to where its key belongs; `place` is the inverse of `heap`."""
    item = heap[slot]
    while slot > 0:
        above = (slot - 1) // 2
        if key[heap[above]] <= key[item]:
            break
        heap[slot] = heap[above]
        place[heap[slot]] = slot
        slot = above
    heap[slot] = item
    place[item] = slot


@njit_borrowing
def heap_pop(heap: NDArray[np.int32], place: NDArray[np.int32], key: NDArray[np.float64], size: int) -> int:
    """Remove and return the item of the smallest key from a min-heap of `size` items."""
    first = heap[0]
    place[first] = -1
    item = heap[size - 1]
    size -= 1
    if size == 0:
        return first
    slot = 0
    while True:
        below = 2 * slot + 1
        if below >= size:
            break
        if below + 1 < size and key[heap[below + 1]] < key[heap[below]]:
            below += 1
        if key[item] <= key[heap[below]]:
            break
        heap[slot] = heap[below]
        place[heap[slot]] = slot
        slot = below
    heap[slot] = item
    place[item] = slot
    return first


@njit_borrowing
def heap_push_or_lower(
    heap: NDArray[np.int32],
    place: NDArray[np.int32],
    key: NDArray[np.float64],
    size: int,
    item: int,
    value: float,
) -> int:
    """Set an item's key to a lower value, inserting it if it is not in the heap; returns the new size."""
    key[item] = value
    if place[item] < 0:
        place[item] = size
        heap[size] = item
        size += 1
    heap_lift(heap, place, key, place[item])
    return size


@njit
def _mark_targets(
    targets: NDArray[np.int32], row_low: int, row_high: int, column_low: int, column_high: int
) -> NDArray[np.int32]:
    """How often each cell of the box is a target, flat; empty when there are no targets."""
    box_width = column_high - column_low
    if targets.shape[0] == 0:
        return np.empty(0, np.int32)
    awaited = np.zeros((row_high - row_low) * box_width, np.int32)
    for k in range(targets.shape[0]):
        r, c = targets[k, 0] - row_low, targets[k, 1] - column_low
        if r >= 0 and c >= 0 and r < row_high - row_low and c < box_width:
            awaited[r * box_width + c] += 1
    return awaited


@njit
def dijkstra_box(
    cost_per_m: NDArray[np.float32],
    passable: NDArray[np.bool_],
    resolution_m: float,
    row: int,
    column: int,
    box: tuple[int, int, int, int],
    targets: NDArray[np.int32],
    max_cost: float,
    out_cost: NDArray[np.float64],
    out_parent: NDArray[np.int32],
) -> int:
    """Cheapest paths from one cell within a box of the grid, until all targets are settled.

    A step to one of the 8 neighbours costs its length times the mean of both cells' cost per metre; a diagonal
    step needs both cells beside it to be passable (no corner cutting).

    Args:
        cost_per_m: (H, W), finite and >= 0.
        passable: (H, W). The start is expanded even if it is not passable itself.
        resolution_m: metres per cell.
        row, column: the start, inside the box.
        box: (row_low, row_high, column_low, column_high), half open; clipped to the grid.
        targets: (k, 2) (row, column); the search stops when all of them are settled. An empty array, or a target
            outside the box, searches all that `max_cost` allows.
        max_cost: cells above it are not settled.
        out_cost: out, (H, W): cost of settled cells, inf else. Only the box is written.
        out_parent: out, (H, W): flat index (row * W + column) of the cell before on the path, -1 at the start and
            where the cost is inf. Only the box is written.

    Returns:
        Number of settled cells.
    """
    height, width = passable.shape
    row_low, row_high = max(box[0], 0), min(box[1], height)
    column_low, column_high = max(box[2], 0), min(box[3], width)
    if row < row_low or row >= row_high or column < column_low or column >= column_high:
        return 0
    box_width = column_high - column_low
    cells = (row_high - row_low) * box_width
    out_cost[row_low:row_high, column_low:column_high] = np.inf
    out_parent[row_low:row_high, column_low:column_high] = -1
    key = np.full(cells, np.inf)
    place = np.full(cells, -1, np.int32)
    heap = np.empty(cells, np.int32)
    size = heap_push_or_lower(heap, place, key, 0, (row - row_low) * box_width + column - column_low, 0.0)
    awaited = _mark_targets(targets, row_low, row_high, column_low, column_high)
    left = targets.shape[0]
    settled = 0
    while size > 0:
        item = heap_pop(heap, place, key, size)
        size -= 1
        r, c = row_low + item // box_width, column_low + item % box_width
        out_cost[r, c] = key[item]
        settled += 1
        if awaited.size > 0 and awaited[item] > 0:
            left -= awaited[item]
            if left == 0:
                break
        for k in range(8):
            r_next, c_next = r + _DY[k], c + _DX[k]
            if r_next < row_low or r_next >= row_high or c_next < column_low or c_next >= column_high:
                continue
            if not passable[r_next, c_next]:
                continue
            if k % 2 == 1 and not (passable[r, c_next] and passable[r_next, c]):
                continue
            length = resolution_m * (math.sqrt(2.0) if k % 2 == 1 else 1.0)
            mean = 0.5 * (np.float64(cost_per_m[r, c]) + np.float64(cost_per_m[r_next, c_next]))
            cost = key[item] + length * mean
            next_item = (r_next - row_low) * box_width + c_next - column_low
            if cost < key[next_item] and cost <= max_cost:
                size = heap_push_or_lower(heap, place, key, size, next_item, cost)
                out_parent[r_next, c_next] = r * width + c
    for k in range(size):
        out_parent[row_low + heap[k] // box_width, column_low + heap[k] % box_width] = -1
    return settled


@njit
def dijkstra_grid(
    cost_per_m: NDArray[np.float32],
    passable: NDArray[np.bool_],
    resolution_m: float,
    row: int,
    column: int,
    max_cost: float,
    out_cost: NDArray[np.float64],
    out_parent: NDArray[np.int32],
) -> int:
    """`dijkstra_box` over the whole grid: cost and parent of every cell within `max_cost` of the start."""
    box = (0, passable.shape[0], 0, passable.shape[1])
    targets = np.empty((0, 2), np.int32)
    return dijkstra_box(
        cost_per_m, passable, resolution_m, row, column, box, targets, max_cost, out_cost, out_parent
    )


@njit
def trace_path(parent: NDArray[np.int32], row: int, column: int) -> NDArray[np.int32]:
    """Cells from the search's start to (row, column), both included.

    Args:
        parent: (H, W) as written by the grid searches; ask only for cells whose cost is finite (any other cell
            gives itself alone).

    Returns:
        (n, 2) (row, column).
    """
    width = parent.shape[1]
    count = 1
    cell = parent[row, column]
    while cell >= 0:
        count += 1
        cell = parent[cell // width, cell % width]
    path = np.empty((count, 2), np.int32)
    cell = np.int32(row * width + column)
    for k in range(count - 1, -1, -1):
        path[k, 0], path[k, 1] = cell // width, cell % width
        cell = parent[path[k, 0], path[k, 1]]
    return path


@njit
def dijkstra_csr(
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    weights: NDArray[np.float64],
    sources: NDArray[np.int32],
    source_costs: NDArray[np.float64],
    max_cost: float,
    out_cost: NDArray[np.float64],
    out_parent: NDArray[np.int32],
) -> int:
    """Cheapest paths from any of several sources in a graph in CSR form.

    Args:
        indptr, indices, weights: (N + 1,), (E,), (E,): edges of node i are indptr[i] to indptr[i + 1]; weights
            >= 0; an infinite weight is no edge.
        sources, source_costs: (S,): where paths may start, and what each start costs already.
        max_cost: nodes above it are not settled.
        out_cost: out, (N,): cost of settled nodes, inf else.
        out_parent: out, (N,): the node before on the path, -1 at a source and where the cost is inf.

    Returns:
        Number of settled nodes.
    """
    nodes = indptr.shape[0] - 1
    out_cost[:] = np.inf
    out_parent[:] = -1
    place = np.full(nodes, -1, np.int32)
    heap = np.empty(nodes, np.int32)
    size = 0
    for k in range(sources.shape[0]):
        if source_costs[k] < out_cost[sources[k]] and source_costs[k] <= max_cost:
            size = heap_push_or_lower(heap, place, out_cost, size, sources[k], source_costs[k])
    settled = 0
    while size > 0:
        node = heap_pop(heap, place, out_cost, size)
        size -= 1
        settled += 1
        for edge in range(indptr[node], indptr[node + 1]):
            other = indices[edge]
            cost = out_cost[node] + weights[edge]
            if cost < out_cost[other] and cost <= max_cost:
                size = heap_push_or_lower(heap, place, out_cost, size, other, cost)
                out_parent[other] = node
    return settled


@njit
def shortcut_path(
    points_m: NDArray[np.float64],
    clearance: NDArray[np.float32],
    footprint_hazard_per_m: NDArray[np.float32],
    resolution_m: float,
    ix0: int,
    iy0: int,
    min_clearance_m: float,
    hazard_weight_m: float,
    relative_tolerance: float,
    max_span: int,
) -> NDArray[np.float64]:
    """Straighten a path: replace stretches by straight segments that are as safe and not worse.

    Greedy string pulling from the start: from each kept point to the furthest later point whose straight segment
    has enough clearance (`min_clearance_m`, or what the stretch itself has if that is less) and costs no more
    than (1 + relative_tolerance) times the stretch, cost = length + hazard_weight_m * hazard integral.

    Args:
        points_m: (n, 2) x, y in metres.
        clearance, footprint_hazard_per_m: (H, W), see `planning.footprint`.
        resolution_m, ix0, iy0: where both grids lie.
        min_clearance_m: clearance that a new segment must have.
        hazard_weight_m: metres of detour that one unit of hazard integral is worth.
        relative_tolerance: how much worse than the stretch a segment may be, for example 0.001.
        max_span: most points that one segment may skip; bounds the time to n * max_span segments.

    Returns:
        (k, 2), a subset of the points with both ends.
    """
    count = points_m.shape[0]
    if count < 3:
        return points_m.copy()
    cost = np.zeros(count)
    tight = np.empty(count)
    for k in range(1, count):
        x0, y0, x1, y1 = points_m[k - 1, 0], points_m[k - 1, 1], points_m[k, 0], points_m[k, 1]
        length, hazard = segment_risk(footprint_hazard_per_m, resolution_m, ix0, iy0, x0, y0, x1, y1)
        cost[k] = cost[k - 1] + length + hazard_weight_m * hazard
        tight[k] = _min_clearance_above(clearance, resolution_m, ix0, iy0, x0, y0, x1, y1, -np.inf)
    kept = np.empty(count, np.int64)
    kept[0] = 0
    total = 1
    start = 0
    while start < count - 1:
        x0, y0 = points_m[start, 0], points_m[start, 1]
        end = min(count - 1, start + max_span)
        required = min_clearance_m
        for k in range(start + 1, end + 1):
            required = min(required, tight[k])
        while end > start + 1:
            x1, y1 = points_m[end, 0], points_m[end, 1]
            # `required` of the longest stretch is a quick first test; the exact one belongs to this stretch.
            if _min_clearance_above(clearance, resolution_m, ix0, iy0, x0, y0, x1, y1, required) >= required:
                own = min_clearance_m
                for k in range(start + 1, end + 1):
                    own = min(own, tight[k])
                length, hazard = segment_risk(footprint_hazard_per_m, resolution_m, ix0, iy0, x0, y0, x1, y1)
                straight = length + hazard_weight_m * hazard
                worst = (cost[end] - cost[start]) * (1.0 + relative_tolerance) + 1e-9
                clear = _min_clearance_above(clearance, resolution_m, ix0, iy0, x0, y0, x1, y1, own) >= own
                if clear and straight <= worst:
                    break
            end -= 1
        start = end
        kept[total] = start
        total += 1
    return points_m[kept[:total]]

"""On the lattice of the Local IRM: travel between nodes, first moves, how values spread, and what any node sees."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import lowest_bit
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit, njit_borrowing

_DX = DIRECTION_DX
_DY = DIRECTION_DY


@njit
def neighbour(node: int, k: int, size: int) -> int:
    """The node in direction k, or -1 outside the lattice."""
    row, column = node // size + _DY[k], node % size + _DX[k]
    if row < 0 or column < 0 or row >= size or column >= size:
        return -1
    return row * size + column


class PassableEdges(NamedTuple):
    """The edges that may be taken, those of node i from start[i] to start[i + 1], ascending in direction.

    start: (n + 1,). other: (e,), the node at the other end. back: (e,), the direction from there. distance_m,
    risk_cost: (e,), m; an edge costs their sum.
    """

    start: NDArray[np.int32]
    other: NDArray[np.int32]
    back: NDArray[np.int8]
    distance_m: NDArray[np.float64]
    risk_cost: NDArray[np.float64]


@njit
def passable_edges(
    size: int,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    risk_weight_m: float,
    max_risk: float,
) -> PassableEdges:
    """The edges of a lattice, (n, 8), no riskier than max_risk, for `travel_costs_over`."""
    n = size * size
    edges = PassableEdges(
        np.zeros(n + 1, np.int32), np.empty(8 * n, np.int32), np.empty(8 * n, np.int8), np.empty(8 * n), np.empty(8 * n)
    )  # fmt: skip
    count = 0
    for row in range(size):
        for column in range(size):
            node = row * size + column
            for k in range(8):
                there = 0 <= row + _DY[k] < size and 0 <= column + _DX[k] < size
                d = distance_m[node, k]
                if not there or d <= 0.0 or risk[node, k] > max_risk:
                    continue
                edges.other[count] = node + _DY[k] * size + _DX[k]
                edges.back[count] = (k + 4) % 8
                edges.distance_m[count], edges.risk_cost[count] = d, risk_weight_m * risk[node, k]
                count += 1
            edges.start[node + 1] = count
    return edges


class Heap(NamedTuple):
    """A binary min-heap of nodes, room for all. key, item: (n + 1,), by slot. place: (n,), a node's slot or -1.

    The last slot in use is followed by a key of inf, so that every slot has two below.
    """

    key: NDArray[np.float64]
    item: NDArray[np.int32]
    place: NDArray[np.int32]


@njit
def empty_heap(n: int) -> Heap:
    """An empty heap for n nodes."""
    return Heap(np.empty(n + 2), np.empty(n + 2, np.int32), np.full(n, -1, np.int32))


@njit_borrowing
def _settle(heap: Heap, slot: int, item: int, key: float, strictly: bool) -> None:
    """Move an item from a free slot up to where its key belongs; strictly: past equal keys too."""
    while slot > 0:
        above = (slot - 1) >> 1
        if heap.key[above] < key or (not strictly and heap.key[above] == key):
            break
        heap.key[slot], heap.item[slot] = heap.key[above], heap.item[above]
        heap.place[heap.item[slot]] = slot
        slot = above
    heap.key[slot], heap.item[slot] = key, item
    heap.place[item] = slot


@njit_borrowing
def _pop(heap: Heap, count: int) -> int:
    """Remove and return the item of the smallest key of `count`.

    The hole goes down to the end along the smaller keys and the last item up from there: it nearly always belongs near
    the end. It ends where going down with it would have put it (before keys that are equal), so that ties are broken
    the same way.
    """
    first, item, key = heap.item[0], heap.item[count - 1], heap.key[count - 1]
    heap.place[first] = -1
    heap.key[count - 1] = np.inf
    slot, below = 0, 1
    while below < count - 1:
        below += np.int64(heap.key[below + 1] < heap.key[below])  # type: ignore[assignment]  # the compiler's int
        heap.key[slot], heap.item[slot] = heap.key[below], heap.item[below]
        heap.place[heap.item[slot]] = slot
        slot, below = below, 2 * below + 1
    if count > 1:
        _settle(heap, slot, item, key, True)
    return first


@njit_borrowing
def travel_costs_over(
    edges: PassableEdges, source: int, heap: Heap, cost: NDArray[np.float64], move: NDArray[np.int8]
) -> None:
    """As `travel_costs`, for many sources over the same edges. heap: empty, before and after."""
    for i in range(cost.shape[0]):
        cost[i], move[i] = np.inf, -1
    cost[source] = 0.0
    heap.key[0], heap.item[0], heap.key[1] = 0.0, source, np.inf
    count = 1
    while count > 0:
        node = _pop(heap, count)
        count -= 1
        here = cost[node]
        for e in range(edges.start[node], edges.start[node + 1]):
            other = edges.other[e]
            value = here + edges.distance_m[e] + edges.risk_cost[e]
            if value >= cost[other] - 1e-12:
                continue
            cost[other], move[other] = value, edges.back[e]
            slot = heap.place[other]
            if slot < 0:
                slot = count
                count += 1
                heap.key[count] = np.inf
            _settle(heap, slot, other, value, False)


@njit
def travel_costs(
    source: int,
    size: int,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    risk_weight_m: float,
    max_risk: float,
    cost: NDArray[np.float64],
    move: NDArray[np.int8],
) -> None:
    """Cheapest travel from every node *to* the source (edges go both ways), and the first move towards it.

    distance_m, risk: (n, 8). An edge costs distance + risk_weight_m * risk; riskier ones than max_risk are not used.
    cost: (n,) out, inf where there is no way. move: (n,) out, the direction to take, -1 at the source or without way.
    """
    edges = passable_edges(size, distance_m, risk, risk_weight_m, max_risk)
    travel_costs_over(edges, source, empty_heap(size * size), cost, move)


@njit
def spread_values(
    seed_value: NDArray[np.float64],
    size: int,
    distance_m: NDArray[np.float32],
    risk: NDArray[np.float32],
    gamma_per_m: float,
    cost_per_m: float,
    risk_cost: float,
    value: NDArray[np.float64],
) -> None:
    """V(i) = max(seed(i), max_j gamma^d_ij V(j) - costs): what a value at some nodes is worth elsewhere; at least 0.

    seed_value: (n,), -inf where nothing is given. value: (n,) out. Sweeps until nothing changes.
    """
    n = size * size
    for i in range(n):
        value[i] = max(seed_value[i], 0.0)
    changed = True
    sweep = 0
    while changed and sweep < 4 * size:
        changed = False
        for step in range(n):
            node = step if sweep % 2 == 0 else n - 1 - step
            for k in range(8):
                d = distance_m[node, k]
                if d <= 0.0:
                    continue
                other = neighbour(node, k, size)
                candidate = (
                    math.pow(gamma_per_m, d) * value[other] - cost_per_m * d - risk_cost * risk[node, k]
                )
                if candidate > value[node] + 1e-9:
                    value[node] = candidate
                    changed = True
        sweep += 1


@njit
def seen_by_any(
    visible: NDArray[np.uint32], connected: NDArray[np.bool_], size: int, reach: int, seen: NDArray[np.bool_]
) -> None:
    """Mark the nodes that some connected node sees; seen: (n,) out. Others cannot be covered from here."""
    for node in range(size * size):
        if not connected[node]:
            continue
        for r in range(2 * reach + 1):
            word = np.uint64(visible[node, r])
            while word != np.uint64(0):
                row, column = node // size + r - reach, node % size + lowest_bit(word) - reach
                word &= word - np.uint64(1)
                if 0 <= row < size and 0 <= column < size:
                    seen[row * size + column] = True

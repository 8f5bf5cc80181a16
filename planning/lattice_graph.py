"""On the lattice of the Local IRM: travel between nodes, first moves, how values spread, and what any node sees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.bits import lowest_bit
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower

_DX = DIRECTION_DX
_DY = DIRECTION_DY


@njit
def neighbour(node: int, k: int, size: int) -> int:
    """The node in direction k, or -1 outside the lattice."""
    row, column = node // size + _DY[k], node % size + _DX[k]
    if row < 0 or column < 0 or row >= size or column >= size:
        return -1
    return row * size + column


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
    n = size * size
    heap, place = np.empty(n, np.int32), np.full(n, -1, np.int32)
    cost[:] = np.inf
    move[:] = -1
    cost[source] = 0.0
    count = heap_push_or_lower(heap, place, cost, 0, source, 0.0)
    while count > 0:
        node = heap_pop(heap, place, cost, count)
        count -= 1
        for k in range(8):
            d = distance_m[node, k]
            if d <= 0.0 or risk[node, k] > max_risk:
                continue
            other = neighbour(node, k, size)
            value = cost[node] + d + risk_weight_m * risk[node, k]
            if value < cost[other] - 1e-12:
                move[other] = (k + 4) % 8
                count = heap_push_or_lower(heap, place, cost, count, other, value)


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

"""Label-setting over the whole Global IRM with a check of the Bellman equation in the same pass.

The fast way of `services.gcp.qmdp`: a heap of four children a node that holds the keys themselves, entries that are
out of date are skipped when they come up, and edges are read in the order of their end nodes. Every edge is looked at
once, when its end node is settled: a start node that was settled before and would be worth more through this edge shows
that label-setting is not exact here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing

_ARITY = 4


@njit_borrowing
def _push(keys: NDArray[np.float64], nodes: NDArray[np.int32], size: int, key: float, node: int) -> None:
    """Add an entry to a min-heap of `size` entries."""
    slot = size
    while slot > 0:
        above = (slot - 1) // _ARITY
        if keys[above] <= key:
            break
        keys[slot], nodes[slot] = keys[above], nodes[above]
        slot = above
    keys[slot], nodes[slot] = key, node


@njit_borrowing
def _drop_first(keys: NDArray[np.float64], nodes: NDArray[np.int32], size: int) -> None:
    """Take the first entry out of a min-heap of `size` entries."""
    key, node = keys[size - 1], nodes[size - 1]
    size -= 1
    slot = 0
    while True:
        below = _ARITY * slot + 1
        if below >= size:
            break
        smallest = below
        for other in range(below + 1, min(below + _ARITY, size)):
            if keys[other] < keys[smallest]:
                smallest = other
        if key <= keys[smallest]:
            break
        keys[slot], nodes[slot] = keys[smallest], nodes[smallest]
        slot = smallest
    keys[slot], nodes[slot] = key, node


@njit_borrowing
def _settle_all(
    start: NDArray[np.int32],
    source: NDArray[np.int32],
    edge: NDArray[np.int32],
    discount: NDArray[np.float64],
    cost: NDArray[np.float64],
    floor: float,
    size: int,
    keys: NDArray[np.float64],
    nodes: NDArray[np.int32],
    state: NDArray[np.uint8],
    value: NDArray[np.float64],
    action: NDArray[np.int32],
) -> float:
    """Settle from the heap of `size` entries. state: 0 open, 1 settled, 2 or 3 a terminal. Returns the residual."""
    residual = 0.0
    while size > 0:
        node, label = nodes[0], -keys[0]
        _drop_first(keys, nodes, size)
        size -= 1
        if state[node] & 1:
            continue
        state[node] |= 1
        for slot in range(start[node], start[node + 1]):
            other = source[slot]
            through = discount[slot] * label - cost[slot]
            if through <= value[other] or through <= floor or state[other] > 1:
                continue
            if state[other] == 1:
                residual = max(residual, (through - value[other]) / (1.0 + abs(value[other])))
                continue
            value[other] = through
            action[other] = edge[slot]
            _push(keys, nodes, size, -through, other)
            size += 1
    return residual


@njit
def best_labels(
    start: NDArray[np.int32],
    source: NDArray[np.int32],
    edge: NDArray[np.int32],
    discount: NDArray[np.float64],
    cost: NDArray[np.float64],
    terminal: NDArray[np.bool_],
    gain: NDArray[np.float64],
    floor: float,
    action: NDArray[np.int32],
) -> tuple[NDArray[np.float64], float]:
    """Best labels from the terminals backwards. The first five: edges by end node, from start[i] to start[i + 1].

    Returns (value (n,), residual): -inf without a label (those at or below `floor` are not made); the residual is the
    largest gain left in any edge, relative to 1 + |value|: 0 where label-setting was exact. action: (n,) out, -1 where
    there is none.
    """
    n, size = terminal.shape[0], 0
    keys, nodes = np.empty(n + source.shape[0]), np.empty(n + source.shape[0], np.int32)
    value, state = np.full(n, -np.inf), np.zeros(n, np.uint8)
    action[:] = -1
    for node in range(n):
        if terminal[node]:
            value[node], state[node] = gain[node], 2
            _push(keys, nodes, size, -gain[node], node)
            size += 1
    residual = _settle_all(
        start, source, edge, discount, cost, floor, size, keys, nodes, state, value, action
    )
    return value, residual


@njit
def reaching(
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    cost: NDArray[np.float64],
    start: NDArray[np.int32],
    source: NDArray[np.int32],
    reverse_cost: NDArray[np.float64],
    value: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Nodes from which passable edges lead to one that has a label (value > -inf), and those themselves. (n,)

    The edges by start node (the first three) and by end node; an impassable one has an infinite cost. Only what has no
    label is searched.
    """
    n = value.shape[0]
    reached = value > -np.inf
    stack, top = np.empty(n, np.int32), 0
    for node in range(n):
        if value[node] > -np.inf:
            continue
        for e in range(indptr[node], indptr[node + 1]):
            if value[indices[e]] > -np.inf and cost[e] < np.inf:
                reached[node] = True
                stack[top] = node
                top += 1
                break
    while top > 0:
        top -= 1
        node = stack[top]
        for slot in range(start[node], start[node + 1]):
            other = source[slot]
            if not reached[other] and reverse_cost[slot] < np.inf:
                reached[other] = True
                stack[top] = other
                top += 1
    return reached

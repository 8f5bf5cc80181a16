"""What each frontier is worth from where the robot stands, from the whole graph: a reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower
from services.gcp.qmdp import STAY, GlobalGraph, label_setting


class FrontierValues(NamedTuple):
    """Going to one frontier and no other, best first; (F,) each.

    node: the frontier.
    value: expected discounted gain less cost of going there; -inf where there is no way.
    gain: what it pays on arrival.
    distance_m: length of that way, failed attempts not counted; inf where there is none.
    risk: probability that at least one edge of the way fails at first, 1 - product of (1 - rho); 1 where none.
    exact: whether the value is known to be the best; otherwise it is that of a good way, a lower bound.
    """

    node: NDArray[np.int32]
    value: NDArray[np.float64]
    gain: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    risk: NDArray[np.float64]
    exact: NDArray[np.bool_]


@njit
def _forward_tree(graph: GlobalGraph, start: int, reference: float) -> NDArray[np.int32]:
    """Edge by which the best way from `start` enters each node, STAY at the start and where there is none.

    Edges are weighed c' + (1 - gamma') * reference: the value lost on them if what waits behind is worth
    `reference`. Exact for frontiers worth just that or without discount; a good way for the others.
    """
    nodes = graph.terminal.shape[0]
    key = np.full(nodes, np.inf)
    place = np.full(nodes, -1, np.int32)
    heap = np.empty(nodes, np.int32)
    entry = np.full(nodes, STAY, np.int32)
    size = heap_push_or_lower(heap, place, key, 0, start, 0.0)
    while size > 0:
        node = heap_pop(heap, place, key, size)
        size -= 1
        if graph.terminal[node] and node != start:
            continue
        for edge in range(graph.indptr[node], graph.indptr[node + 1]):
            other = graph.indices[edge]
            lost = key[node] + graph.cost[edge] + (1.0 - graph.discount[edge]) * reference
            if lost < key[other]:
                size = heap_push_or_lower(heap, place, key, size, other, lost)
                entry[other] = edge
    return entry


@njit
def _edge_sources(graph: GlobalGraph) -> NDArray[np.int32]:
    """Start node of every edge."""
    source = np.empty(graph.indices.shape[0], np.int32)
    for node in range(graph.terminal.shape[0]):
        source[graph.indptr[node] : graph.indptr[node + 1]] = node
    return source


@njit
def _price_tree_path(
    graph: GlobalGraph,
    source: NDArray[np.int32],
    entry: NDArray[np.int32],
    distance_m: NDArray[np.float64],
    risk: NDArray[np.float64],
    start: int,
    frontier: int,
) -> tuple[float, float, float]:
    """Value, length and risk of the tree's way from `start` to a frontier."""
    node = frontier
    value = graph.gain[frontier]
    length, safe = 0.0, 1.0
    while node != start:
        edge = entry[node]
        if edge == STAY:
            return -np.inf, np.inf, 1.0
        value = graph.discount[edge] * value - graph.cost[edge]
        length += distance_m[edge]
        safe *= 1.0 - risk[edge]
        node = source[edge]
    return value, length, 1.0 - safe


@njit
def _price_policy_path(
    graph: GlobalGraph,
    action: NDArray[np.int32],
    distance_m: NDArray[np.float64],
    risk: NDArray[np.float64],
    start: int,
) -> tuple[float, float]:
    """Length and risk of the way that a policy without cycles takes from `start`."""
    node, length, safe = start, 0.0, 1.0
    while action[node] != STAY:
        edge = action[node]
        length += distance_m[edge]
        safe *= 1.0 - risk[edge]
        node = graph.indices[edge]
    return length, 1.0 - safe


@njit
def _first_pass(
    graph: GlobalGraph,
    distance_m: NDArray[np.float64],
    risk: NDArray[np.float64],
    start: int,
    frontiers: NDArray[np.int32],
    reference: float,
    out: NDArray[np.float64],
) -> None:
    """Fill `out` (F, 3) with value, length and risk of the forward tree's ways."""
    entry = _forward_tree(graph, start, reference)
    source = _edge_sources(graph)
    for k in range(frontiers.shape[0]):
        value, length, hazard = _price_tree_path(graph, source, entry, distance_m, risk, start, frontiers[k])
        out[k, 0], out[k, 1], out[k, 2] = value, length, hazard


def frontier_values(
    graph: GlobalGraph,
    distance_m: NDArray[np.float64],
    risk: NDArray[np.float64],
    start: int,
    top: int = 5,
) -> FrontierValues:
    """Value of going from `start` to each frontier, were it the only one.

    The best way depends on what waits at its end, so there is no single tree of best ways. One forward search
    gives every frontier a good way, whose exact worth is a lower bound; then the `top` best (by that bound) are
    solved one by one, by label-setting backwards from the frontier that stops at `start` and drops labels that
    fall below the bound. That is exact for positive values. Ways do not pass through other frontiers, which
    would end them.

    Args:
        graph: see `services.gcp.qmdp.global_graph`.
        distance_m, risk: (E,) of the edges, as given to `edge_terms`.
        start: the robot's node.
        top: how many frontiers are solved exactly, each at most one label-setting over the graph.
    """
    frontiers = np.flatnonzero(graph.terminal).astype(np.int32)
    priced = np.empty((len(frontiers), 3))
    gains = graph.gain[frontiers]
    reference = max(0.0, float(gains.max(initial=0.0)))
    _first_pass(graph, distance_m, risk, start, frontiers, reference, priced)
    exact = frontiers == start
    action = np.empty(len(graph.terminal), np.int32)
    for k in np.argsort(-priced[:, 0], kind="stable")[:top]:
        if priced[k, 0] <= 0.0 or frontiers[k] == start:
            continue
        bound = float(np.nextafter(priced[k, 0] * (1.0 - 1e-12), -np.inf))
        value = label_setting(graph, frontiers[k : k + 1], bound, start, action)[start]
        exact[k] = bool(np.isfinite(value))
        if value > priced[k, 0]:
            priced[k] = (value, *_price_policy_path(graph, action, distance_m, risk, start))
    order = np.argsort(-priced[:, 0], kind="stable")
    columns = priced[order].T
    return FrontierValues(frontiers[order], columns[0], gains[order], columns[1], columns[2], exact[order])

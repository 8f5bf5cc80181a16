"""Searches against scipy's and networkx' Dijkstra, and what a shortened path must keep."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from planning import search
from planning.footprint import clearance_m, footprint_hazard, segment_min_clearance, segment_risk
from planning.grid import GridSpec

NO_TARGETS = np.empty((0, 2), np.int32)


def _scene(seed: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 14)), int(rng.integers(1, 17)))
    passable = rng.random(shape) > rng.choice([0.0, 0.2, 0.4])
    return rng.uniform(0, 3, shape).astype(np.float32), passable


def _grid_graph(
    cost: NDArray[np.float32], passable: NDArray[np.bool_], start: tuple[int, int], resolution_m: float
) -> nx.DiGraph[Any]:
    """Every allowed move of the grid as an edge, written down from the rule and not from the code."""
    graph: nx.DiGraph[Any] = nx.DiGraph()
    graph.add_node(start)
    height, width = passable.shape
    for row, column in np.ndindex(height, width):
        if not passable[row, column] and (row, column) != start:
            continue
        for d_row, d_column in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]:
            r, c = row + d_row, column + d_column
            if not (0 <= r < height and 0 <= c < width and passable[r, c]):
                continue
            if d_row and d_column and not (passable[row, c] and passable[r, column]):
                continue
            mean = 0.5 * (float(cost[row, column]) + float(cost[r, c]))
            graph.add_edge((row, column), (r, c), weight=math.hypot(d_row, d_column) * resolution_m * mean)
    return graph


@given(seed=st.integers(0, 100_000))
def test_dijkstra_grid_equals_networkx(seed: int) -> None:
    cost, passable = _scene(seed)
    rng = np.random.default_rng(seed + 1)
    start = (int(rng.integers(passable.shape[0])), int(rng.integers(passable.shape[1])))
    max_cost = float(rng.choice([0.7, 2.0, np.inf]))
    out_cost = np.full(passable.shape, -1.0)
    parent = np.full(passable.shape, -7, np.int32)
    settled = search.dijkstra_grid(cost, passable, 0.2, *start, max_cost, out_cost, parent)
    expected = nx.single_source_dijkstra_path_length(_grid_graph(cost, passable, start, 0.2), start)
    expected = {cell: value for cell, value in expected.items() if value <= max_cost}
    assert settled == len(expected) == int(np.isfinite(out_cost).sum())
    for (row, column), value in expected.items():
        assert out_cost[row, column] == pytest.approx(value, abs=1e-9)
    assert (parent[~np.isfinite(out_cost)] == -1).all()


@given(seed=st.integers(0, 100_000))
def test_traced_path_costs_what_the_search_says(seed: int) -> None:
    cost, passable = _scene(seed)
    start = (passable.shape[0] // 2, passable.shape[1] // 2)
    out_cost, parent = np.empty(passable.shape), np.empty(passable.shape, np.int32)
    search.dijkstra_grid(cost, passable, 0.2, *start, np.inf, out_cost, parent)
    graph = _grid_graph(cost, passable, start, 0.2)
    for row, column in np.argwhere(np.isfinite(out_cost)):
        path = [(int(r), int(c)) for r, c in search.trace_path(parent, int(row), int(column))]
        assert path[0] == start and path[-1] == (row, column)
        assert nx.path_weight(graph, path, "weight") == pytest.approx(out_cost[row, column], abs=1e-9)


@given(seed=st.integers(0, 100_000))
def test_box_search_is_the_search_in_the_cut_out_grid(seed: int) -> None:
    cost, passable = _scene(seed)
    rng = np.random.default_rng(seed + 2)
    height, width = passable.shape
    rows, columns = np.sort(rng.integers(0, height + 1, 2)), np.sort(rng.integers(0, width + 1, 2))
    if rows[0] == rows[1] or columns[0] == columns[1]:
        return
    box = (int(rows[0]), int(rows[1]), int(columns[0]), int(columns[1]))
    start = (int(rng.integers(box[0], box[1])), int(rng.integers(box[2], box[3])))
    out_cost, parent = np.full(passable.shape, -1.0), np.full(passable.shape, -7, np.int32)
    search.dijkstra_box(cost, passable, 0.2, *start, box, NO_TARGETS, np.inf, out_cost, parent)
    part = (slice(box[0], box[1]), slice(box[2], box[3]))
    small_cost, small_parent = np.empty(passable[part].shape), np.empty(passable[part].shape, np.int32)
    search.dijkstra_grid(
        np.ascontiguousarray(cost[part]), np.ascontiguousarray(passable[part]), 0.2,
        start[0] - box[0], start[1] - box[2], np.inf, small_cost, small_parent,
    )  # fmt: skip
    np.testing.assert_array_equal(out_cost[part], small_cost)
    outside = np.ones(passable.shape, np.bool_)
    outside[part] = False
    assert (out_cost[outside] == -1.0).all() and (parent[outside] == -7).all()


def test_box_search_stops_when_all_targets_are_settled() -> None:
    passable = np.ones((40, 40), np.bool_)
    cost = np.ones((40, 40), np.float32)
    out_cost, parent = np.empty((40, 40)), np.empty((40, 40), np.int32)
    targets = np.array([[20, 23], [18, 20], [20, 23]], np.int32)
    box = (0, 40, 0, 40)
    settled = search.dijkstra_box(cost, passable, 1.0, 20, 20, box, targets, np.inf, out_cost, parent)
    assert out_cost[20, 23] == 3.0 and out_cost[18, 20] == 2.0
    assert settled < 60 and np.isinf(out_cost[0, 0])
    assert (parent[np.isinf(out_cost)] == -1).all()
    start_outside = search.dijkstra_box(cost, passable, 1.0, 50, 20, box, targets, np.inf, out_cost, parent)
    assert start_outside == 0


def test_no_corner_is_cut() -> None:
    passable = np.array([[True, False], [True, True]])
    out_cost, parent = np.empty((2, 2)), np.empty((2, 2), np.int32)
    search.dijkstra_grid(np.ones((2, 2), np.float32), passable, 1.0, 0, 0, np.inf, out_cost, parent)
    assert out_cost[1, 1] == 2.0


@given(seed=st.integers(0, 100_000))
def test_dijkstra_csr_equals_scipy_with_several_sources(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nodes = int(rng.integers(1, 40))
    dense = rng.uniform(0.01, 2.0, (nodes, nodes)) * (rng.random((nodes, nodes)) < 0.12)
    graph = csr_matrix(dense)
    sources = rng.integers(0, nodes, 3).astype(np.int32)
    start = rng.uniform(0, 2, 3)
    max_cost = float(rng.choice([1.5, np.inf]))
    out_cost, parent = np.empty(nodes), np.empty(nodes, np.int32)
    settled = search.dijkstra_csr(
        graph.indptr.astype(np.int32), graph.indices.astype(np.int32), graph.data, sources, start, max_cost,
        out_cost, parent,
    )  # fmt: skip
    expected = (dijkstra(graph, indices=sources) + start[:, None]).min(axis=0)
    expected[expected > max_cost] = np.inf
    np.testing.assert_allclose(out_cost, expected)
    assert settled == int(np.isfinite(expected).sum())
    for node in np.flatnonzero(parent >= 0):
        assert out_cost[parent[node]] + dense[parent[node], node] == pytest.approx(out_cost[node])


@given(seed=st.integers(0, 100_000), hazard_weight_m=st.sampled_from([0.0, 5.0]))
def test_shortcut_keeps_ends_and_clearance_and_costs_no_more(seed: int, hazard_weight_m: float) -> None:
    rng = np.random.default_rng(seed)
    spec = GridSpec(0.2, -30, 10, 60, 60)
    clearance = clearance_m(rng.random((60, 60)) < 0.01, None, None, spec)
    field = rng.uniform(0, 1, (6, 6)).repeat(10, 0).repeat(10, 1).astype(np.float32)
    hazard = footprint_hazard(field, 0.335, 0.2)
    passable = clearance >= 0.45
    start = np.unravel_index(int(clearance.argmax()), clearance.shape)
    out_cost, parent = np.empty((60, 60)), np.empty((60, 60), np.int32)
    cost_per_m = (1 + hazard_weight_m * hazard).astype(np.float32)
    search.dijkstra_grid(cost_per_m, passable, 0.2, int(start[0]), int(start[1]), np.inf, out_cost, parent)
    goal = np.unravel_index(int(np.where(np.isfinite(out_cost), out_cost, -1).argmax()), out_cost.shape)
    cells = search.trace_path(parent, int(goal[0]), int(goal[1]))
    points = np.array([spec.centre_of(int(r), int(c)) for r, c in cells])
    short = search.shortcut_path(points, clearance, hazard, 0.2, -30, 10, 0.4, hazard_weight_m, 1e-3, 200)
    assert np.array_equal(short[0], points[0]) and np.array_equal(short[-1], points[-1])

    def price(path: NDArray[np.float64]) -> float:
        parts = [segment_risk(hazard, 0.2, -30, 10, *a, *b) for a, b in pairwise(path)]
        return sum(length + hazard_weight_m * integral for length, integral in parts)

    assert len(short) <= len(points)
    assert price(short) <= price(points) * (1 + 1e-3) + 1e-6
    for a, b in pairwise(short):
        assert segment_min_clearance(clearance, 0.2, -30, 10, *a, *b) >= 0.4 - 1e-6


def test_shortcut_straightens_free_space_and_respects_a_wall() -> None:
    spec = GridSpec(0.2, 0, 0, 50, 50)
    hazard = np.zeros((50, 50), np.float32)
    stairs = np.array([(1.0 + 0.2 * ((k + 1) // 2), 1.0 + 0.2 * (k // 2)) for k in range(60)])
    free = clearance_m(np.zeros((50, 50), np.bool_), None, None, spec)
    assert len(search.shortcut_path(stairs, free, hazard, 0.2, 0, 0, 0.3, 0.0, 1e-3, 100)) == 2
    lethal = np.zeros((50, 50), np.bool_)
    lethal[10:40, 25] = True
    around = np.array([(2.0, 5.0), (5.1, 1.0), (8.0, 5.0)])
    walled = clearance_m(lethal, None, None, spec)
    assert len(search.shortcut_path(around, walled, hazard, 0.2, 0, 0, 0.3, 0.0, 1e-3, 100)) == 3


def test_shortcut_out_of_a_tight_start_asks_no_more_than_the_path_has() -> None:
    spec = GridSpec(0.2, 0, 0, 30, 30)
    lethal = np.zeros((30, 30), np.bool_)
    lethal[14, 2] = True
    clearance = clearance_m(lethal, None, None, spec)
    points = np.array([(0.5 + 0.2 * k, 3.3) for k in range(20)])  # starts 0.4 m from the lethal cell
    short = search.shortcut_path(
        points, clearance, np.zeros((30, 30), np.float32), 0.2, 0, 0, 0.6, 0.0, 1e-3, 50
    )
    assert len(short) == 2

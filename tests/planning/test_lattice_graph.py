"""Searches on the lattice against networkx and plain value iteration."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.lattice_graph import (
    empty_heap,
    neighbour,
    passable_edges,
    spread_values,
    travel_costs,
    travel_costs_over,
)
from planning.search import heap_pop, heap_push_or_lower
from tests.planning.coverage_lattices import STEPS, Edge, Reference, random_lattice

SEEDS = st.integers(0, 2**32 - 1)


def columns(lattice: Reference) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    model = lattice.model()
    return model.edge_distance_m, model.edge_risk


def test_neighbours_are_one_step_away_and_none_lies_outside() -> None:
    size = 5
    for node in range(size * size):
        for k, (dx, dy) in enumerate(STEPS):
            column, row = node % size + dx, node // size + dy
            inside = 0 <= column < size and 0 <= row < size
            assert neighbour(node, k, size) == (row * size + column if inside else -1)


@settings(max_examples=40)
@given(SEEDS, st.floats(0, 10), st.floats(0, 1))
def test_travel_costs_are_those_of_dijkstra_and_the_moves_lead_there(
    seed: int, risk_weight_m: float, max_risk: float
) -> None:
    lattice = random_lattice(seed, 6, 1, wall_share=0.3, risky_share=0.5)
    distance, risk = columns(lattice)
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(range(36))
    for (node, k), edge in lattice.edges.items():
        if edge.risk <= np.float32(max_risk):
            graph.add_edge(
                node, lattice.neighbour(node, k), weight=edge.distance_m + risk_weight_m * edge.risk
            )
    source = seed % 36
    cost, move = np.empty(36), np.empty(36, np.int8)
    travel_costs(source, 6, distance, risk, risk_weight_m, float(np.float32(max_risk)), cost, move)
    expected = nx.single_source_dijkstra_path_length(graph, source)
    for node in range(36):
        assert math.isclose(cost[node], expected.get(node, math.inf), rel_tol=1e-6, abs_tol=1e-9)
        if node == source or node not in expected:
            assert move[node] == -1
            continue
        spent, at, steps = 0.0, node, 0
        while at != source and steps < 36:
            edge = lattice.edges[at, int(move[at])]
            spent += edge.distance_m + risk_weight_m * edge.risk
            at, steps = lattice.neighbour(at, int(move[at])), steps + 1
        assert at == source
        assert math.isclose(spent, cost[node], rel_tol=1e-6, abs_tol=1e-9)


def plain_dijkstra(
    lattice: Reference, source: int, risk_weight_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """With the heap of `planning.search`: of equal ways the one that this order of taking nodes finds first."""
    n = lattice.size**2
    heap, place = np.empty(n, np.int32), np.full(n, -1, np.int32)
    cost, move = np.full(n, np.inf), np.full(n, -1, np.int8)
    count = heap_push_or_lower(heap, place, cost, 0, source, 0.0)
    while count > 0:
        node = heap_pop(heap, place, cost, count)
        count -= 1
        for k in lattice.directions(node):
            edge, other = lattice.edges[node, k], lattice.neighbour(node, k)
            value = cost[node] + edge.distance_m + risk_weight_m * edge.risk
            if value < cost[other] - 1e-12:
                move[other] = (k + 4) % 8
                count = heap_push_or_lower(heap, place, cost, count, other, value)
    return cost, move


@settings(max_examples=60)
@given(SEEDS, st.integers(1, 12), st.booleans(), st.floats(0.0, 0.4))
def test_ways_from_many_sources_over_the_same_edges_and_of_equal_ones_the_same(
    seed: int, size: int, even: bool, walls: float
) -> None:
    """even: lengths of 1 and sqrt 2, where nearly every way has others as long."""
    lattice = random_lattice(seed, size, 1, wall_share=walls, risky_share=0.0 if even else 0.4)
    if even:
        for node, k in lattice.edges:
            lattice.edges[node, k] = Edge(float(np.float32(math.hypot(*STEPS[k]))), 0.0)
    n = size * size
    distance, risk = columns(lattice)
    edges, heap = passable_edges(size, distance, risk, 1.7, 0.9), empty_heap(n)
    cost, move = np.empty(n), np.empty(n, np.int8)
    for source in {0, seed % n, n - 1}:
        travel_costs_over(edges, source, heap, cost, move)
        expected = plain_dijkstra(lattice, source, 1.7)
        np.testing.assert_array_equal(cost, expected[0])
        np.testing.assert_array_equal(move, expected[1])


@settings(max_examples=40)
@given(SEEDS, st.floats(0.7, 1.0), st.floats(0, 0.3), st.floats(0, 5))
def test_spread_values_are_the_fixed_point(seed: int, gamma: float, per_m: float, per_risk: float) -> None:
    lattice = random_lattice(seed, 5, 1, wall_share=0.2, risky_share=0.5)
    rng = np.random.default_rng(seed)
    given_values = np.where(rng.random(25) < 0.2, rng.uniform(-5, 20, 25), -np.inf)
    value = np.empty(25)
    spread_values(given_values, 5, *columns(lattice), gamma, per_m, per_risk, value)
    expected = [max(0.0, float(v)) for v in given_values]
    for _ in range(60):
        expected = [
            max(
                expected[node],
                *(
                    gamma ** lattice.edges[node, k].distance_m * expected[lattice.neighbour(node, k)]
                    - per_m * lattice.edges[node, k].distance_m
                    - per_risk * lattice.edges[node, k].risk
                    for k in lattice.directions(node)
                ),
                0.0,
            )
            for node in range(25)
        ]
    np.testing.assert_allclose(value, expected, atol=1e-6)


def test_values_find_their_way_through_a_long_spiral() -> None:
    """The sweeps must not stop before a value has come to the far end of a way as long as the lattice is big."""
    size = 9
    way = [(x, 0) for x in range(9)]
    way += (
        [(8, y) for y in range(1, 9)] + [(x, 8) for x in range(7, -1, -1)] + [(0, y) for y in range(7, 1, -1)]
    )
    way += [(x, 2) for x in range(1, 7)] + [(6, y) for y in range(3, 7)] + [(x, 6) for x in range(5, 1, -1)]
    way += [(2, 5), (2, 4), (3, 4), (4, 4)]
    distance, risk = np.zeros((81, 8), np.float32), np.zeros((81, 8), np.float32)
    nodes = [y * size + x for x, y in way]
    for a, b in itertools.pairwise(nodes):
        k = next(k for k in range(8) if neighbour(a, k, size) == b)
        distance[a, k] = distance[b, (k + 4) % 8] = 1.0
    for ends in ((nodes[0], nodes[-1]), (nodes[-1], nodes[0])):
        given_values, value = np.full(81, -np.inf), np.empty(81)
        given_values[ends[0]] = 100.0
        spread_values(given_values, size, distance, risk, 0.99, 0.0, 0.0, value)
        assert math.isclose(value[ends[1]], 100.0 * 0.99 ** (len(nodes) - 1), rel_tol=1e-9)

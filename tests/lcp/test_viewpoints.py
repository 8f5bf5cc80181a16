"""Paths to viewpoints against plain Python: their length, their worth, and which of them is the best."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from planning.reward import RewardWeights
from services.lcp.baselines import NextBestView
from services.lcp.config import NbvConfig
from services.lcp.problem import Junction
from services.lcp.viewpoints import best_view, path_to, rate_viewpoints, viewpoints_within, ways_from
from tests.lcp.local_irms import IX0, IY0, local_irm
from tests.planning.coverage_lattices import Edge, Reference, random_lattice

SEEDS = st.integers(0, 10_000)
SIZE = 5
RISK_WEIGHT_M = 3.0


def lattice_of(seed: int) -> Reference:
    """Walls, risk, hidden nodes and covered ones."""
    return random_lattice(
        seed, SIZE, 2, wall_share=0.2, risky_share=0.3, hidden_share=0.2, covered_share=0.3,
    )  # fmt: skip


def travel_m(lattice: Reference, start: int) -> dict[int, float]:
    """Cheapest way to each node that can be driven to, by networkx."""
    graph: nx.Graph[int] = nx.Graph()
    graph.add_node(start)
    for (node, k), edge in lattice.edges.items():
        if edge.risk <= 0.9:
            graph.add_edge(
                node, lattice.neighbour(node, k), weight=edge.distance_m + RISK_WEIGHT_M * edge.risk
            )
    found: dict[int, float] = nx.single_source_dijkstra_path_length(graph, start)
    return found


def expected_reward(lattice: Reference, node: int, heading: int, moves: list[int]) -> float:
    """Eq. 17 in plain Python: a step fails with its risk, and then ends the path where it began."""
    covered: frozenset[int] = frozenset()
    total, alive, discount, w = 0.0, 1.0, 1.0, lattice.weights
    for k in moves:
        edge = lattice.edges[node, k]
        turned = covered | lattice.footprint(node, k) if k != heading else covered
        gone = turned | lattice.footprint(lattice.neighbour(node, k), k)
        gain = lattice.information(turned - covered) + (1.0 - edge.risk) * lattice.information(gone - turned)
        cost = lattice.cost((1.0 - edge.risk) * edge.distance_m, edge.risk, heading, k)
        total += discount * alive * (w.k_information * gain - cost)
        discount *= w.gamma_per_m**edge.distance_m
        alive *= 1.0 - edge.risk
        node, heading, covered = lattice.neighbour(node, k), k, gone
    return total


def moves_of(lattice: Reference, start: int, viewpoint: int) -> list[int] | None:
    """The path as the kernel gives it."""
    ways = ways_from(lattice.model(start), start, RISK_WEIGHT_M)
    moves = np.empty(60, np.int64)
    count = path_to(start, ways.back, SIZE, viewpoint, moves)
    return None if count < 0 else [int(k) for k in moves[:count]]


@settings(max_examples=60)
@given(SEEDS, st.integers(0, SIZE**2 - 1), st.integers(0, SIZE**2 * 8 - 1))
def test_a_path_is_the_cheapest_one_that_arrives_under_the_heading(
    seed: int, start: int, viewpoint: int
) -> None:
    lattice = lattice_of(seed)
    node, heading = divmod(viewpoint, 8)
    before = lattice.neighbour(node, (heading + 4) % 8)
    cost = travel_m(lattice, start)
    moves = moves_of(lattice, start, viewpoint)
    if before not in cost:
        assert moves is None
        return
    assume((before, heading) in lattice.edges)
    assert moves is not None and moves[-1] == heading
    at, spent = start, 0.0
    for k in moves[:-1]:
        edge = lattice.edges[at, k]
        assert edge.risk <= 0.9
        spent += edge.distance_m + RISK_WEIGHT_M * edge.risk
        at = lattice.neighbour(at, k)
    assert (at, lattice.neighbour(at, moves[-1])) == (before, node)
    assert spent == pytest.approx(cost[before], rel=1e-6)


@settings(max_examples=40)
@given(SEEDS, st.integers(0, SIZE**2 - 1), st.floats(0.5, 9.0))
def test_the_viewpoints_around_are_those_whose_way_is_short_enough(
    seed: int, start: int, radius_m: float
) -> None:
    lattice = lattice_of(seed)
    cost, model = travel_m(lattice, start), lattice.model(start)
    wanted = []
    for node, heading in itertools.product(range(SIZE**2), range(8)):
        before = lattice.neighbour(node, (heading + 4) % 8)
        edge = lattice.edges.get((before, heading))
        if edge is None or edge.risk > 0.9 or before not in cost:
            continue
        way_m = cost[before] + edge.distance_m
        assume(abs(way_m - radius_m) > 1e-4)
        if way_m <= radius_m:
            wanted.append(node * 8 + heading)
    assert viewpoints_within(model, ways_from(model, start, RISK_WEIGHT_M), radius_m).tolist() == wanted


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(0, SIZE**2 - 1), st.integers(0, 7))
def test_the_best_view_is_the_best_of_all_by_plain_python(seed: int, start: int, heading: int) -> None:
    lattice = lattice_of(seed)
    model = lattice.model(start, heading)
    ways = ways_from(model, start, RISK_WEIGHT_M)
    viewpoints = viewpoints_within(model, ways, 1e9)
    assume(len(viewpoints) > 0)
    found = np.empty(len(viewpoints))
    rate_viewpoints(model, start, heading, ways.back, viewpoints, 60, found)
    wanted = []
    for viewpoint in viewpoints.tolist():
        moves = moves_of(lattice, start, viewpoint)
        assert moves is not None
        wanted.append(expected_reward(lattice, start, heading, moves))
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)
    best = best_view(model, ways, heading, viewpoints, 60)
    assert best is not None
    assert best.reward == pytest.approx(max(wanted))
    assert best.moves == moves_of(lattice, start, best.viewpoint)


def test_too_long_a_path_is_none() -> None:
    lattice = row_of(9, {8: 0.69})
    model = lattice.model(0)
    ways = ways_from(model, 0, 0.0)
    assert best_view(model, ways, 0, np.array([8 * 8]), 7) is None
    best = best_view(model, ways, 0, np.array([8 * 8]), 8)
    assert best is not None and best.moves == [0] * 8
    assert best_view(model, ways, 0, np.array([], np.int64), 8) is None


# --- next best view -----------------------------------------------------------------------------------------------


def row_of(size: int, entropy_at: dict[int, float], reach: int = 1) -> Reference:
    """A corridor along the lowest row of a lattice. entropy_at: by column."""
    edges: dict[tuple[int, int], Edge] = {}
    for column in range(size - 1):
        edges[column, 0] = edges[column + 1, 4] = Edge(1.0, 0.0)
    entropy = np.zeros(size * size)
    for column, nats in entropy_at.items():
        entropy[column] = nats
    sees = {c: frozenset(o for o in entropy_at if abs(o - c) <= reach) for c in range(size)}
    return Reference(size, reach, math.radians(120.0), RewardWeights(), entropy, edges, sees)


def junction(lattice: Reference, node: int, heading: int = 0) -> Junction:
    """A certain junction."""
    nothing = np.zeros(lattice.size, np.uint64)
    one = np.array([node], np.int32), np.array([heading], np.uint8), np.ones(1)
    return Junction(node, heading, *one, nothing)


def choose(planner: NextBestView, lattice: Reference, node: int, episode: int = 1) -> list[int] | None:
    """The moves that it chooses from a node, looking east."""
    view = planner.choose(local_irm(lattice), lattice.model(node), junction(lattice, node), episode)
    return None if view is None else view.moves


def test_it_goes_to_the_view_near_it_and_only_without_one_through_the_window() -> None:
    both = row_of(13, {4: 0.5, 12: 0.69})
    near = NbvConfig(radius_m=4.0, min_reward=0.2)
    # From node 6 it sees node 4 from node 5, looking west; node 12 is worth more but lies 5 m off.
    assert choose(NextBestView(near, 1), both, 6) == [4]
    assert choose(NextBestView(near, 1), row_of(13, {12: 0.69}), 6) == [0] * 5
    assert (
        choose(NextBestView(NbvConfig(radius_m=9.0, min_reward=0.2), 1), row_of(13, {12: 0.69}), 6) == [0] * 5
    )


def test_where_nothing_is_worth_its_way_there_is_no_view() -> None:
    assert choose(NextBestView(NbvConfig(min_reward=0.5), 1), row_of(9, {8: 0.4}), 4) is None
    assert choose(NextBestView(NbvConfig(min_reward=0.1), 1), row_of(9, {8: 0.4}), 4) == [0, 0, 0]


def test_samples_are_of_the_seed_and_the_episode() -> None:
    lattice = random_lattice(5, 9, 2, covered_share=0.5)
    one, two, other = (NextBestView(NbvConfig(samples=3, keep_best=False), seed) for seed in (1, 1, 2))
    mine, same, different = ([choose(p, lattice, 40, e) for e in range(8)] for p in (one, two, other))
    assert mine == same
    assert mine != different


def test_the_last_best_view_stays_among_the_candidates() -> None:
    """With one sample an answer is chance; the best of all, once found, is not lost again."""
    lattice = row_of(13, {0: 0.69, 1: 0.69, 8: 0.3})
    keeps = NextBestView(NbvConfig(samples=1, radius_m=50.0, min_reward=0.0), 3)
    found = [choose(keeps, lattice, 5, episode) for episode in range(40)]
    best = [4, 4, 4, 4]
    first = found.index(best)
    assert first > 0, "the first sample was the best already: this shows nothing"
    assert all(moves == best for moves in found[first:])
    forgets = NextBestView(NbvConfig(samples=1, radius_m=50.0, min_reward=0.0, keep_best=False), 3)
    chance = [choose(forgets, lattice, 5, episode) for episode in range(40)]
    assert len({tuple(moves or ()) for moves in chance[first:]}) > 1


def test_the_last_best_view_is_left_for_one_that_is_better_by_the_share() -> None:
    """Once it goes east for what is there; then something better comes into view in the west."""
    before, after = row_of(13, {9: 0.69}), row_of(13, {1: 0.69, 2: 0.69, 9: 0.69})
    found = []
    for share in (0.0, 0.5, 5.0):
        planner = NextBestView(NbvConfig(min_reward=0.1, switch_share=share, radius_m=50.0), 1)
        assert choose(planner, before, 5) == [0, 0, 0]
        moves = choose(planner, after, 5)
        assert moves is not None
        found.append(moves[0])
        assert choose(planner, row_of(13, {}), 5) is None, "what is covered is not gone to"
    assert found == [4, 4, 0]


def test_a_snapshot_keeps_the_last_best_view() -> None:
    lattice = row_of(13, {0: 0.69, 1: 0.69})
    planner = NextBestView(NbvConfig(), 3)
    assert choose(planner, lattice, 5) is not None
    state = planner.state()
    assert state[0] in (IX0, IX0 + 1) and state[1:] == [IY0, 4]
    other = NextBestView(NbvConfig(), 3)
    other.set_state(state)
    assert other.state() == state
    other.set_state([])
    assert other.state() == []

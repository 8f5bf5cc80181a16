"""Tours over groups of frontiers: against all orders, and what they are for."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.reward import RewardWeights
from schemas.topics import GLOBAL_IRM
from services.gcp.orienteering import (
    Legs,
    Outlook,
    Visits,
    best_tour,
    group_frontiers,
    improve,
    tour_value,
    ways_from,
)
from services.gcp.roadnet import RoadNet
from tests.gcp.test_stage import CRUMB, FRONTIER, Bench, Node, graph

GAMMA = RewardWeights().gamma_per_m


def plane_legs(places: np.ndarray) -> Legs:
    """Legs between points of the plane, the last of which is the robot's."""
    distance_m = np.linalg.norm(places[:, None, :] - places[None, :-1, :], axis=2)
    return Legs(0.05 * distance_m, GAMMA**distance_m)


def by_hand(order: tuple[int, ...], gain: np.ndarray, places: np.ndarray) -> float:
    """The definition, summed anew from the start for each stop."""
    at, driven_m, value = places[-1], 0.0, 0.0
    for stop in order:
        leg_m = float(np.linalg.norm(places[stop] - at))
        value -= GAMMA**driven_m * 0.05 * leg_m
        driven_m += leg_m
        value += GAMMA**driven_m * gain[stop]
        at = places[stop]
    return value


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 6))
def test_a_tour_is_nearly_the_best_of_all_orders(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    places, gain = rng.uniform(-40, 40, (n + 1, 2)), rng.uniform(0.3, 30.0, n)
    legs = plane_legs(places)
    best = max(by_hand(order, gain, places) for order in itertools.permutations(range(n)))
    tour = best_tour(gain, legs)
    assert sorted(tour.order.tolist()) == list(range(n))
    assert tour.value == pytest.approx(by_hand(tuple(tour.order), gain, places))
    assert best - 0.02 * gain.sum() - 1e-9 <= tour.value <= best + 1e-9
    for first in range(n):
        begun = best_tour(gain, legs, first)
        assert begun.order[0] == first
        assert begun.value <= best + 1e-9


def test_improving_never_makes_a_tour_worse() -> None:
    rng = np.random.default_rng(3)
    for _ in range(30):
        places, gain = rng.uniform(-40, 40, (9, 2)), rng.uniform(0.3, 30.0, 8)
        cost, discount = plane_legs(places)
        order = rng.permutation(8)
        fixed, before = order[:2].copy(), tour_value(order, gain, cost, discount)
        after = improve(order, 2, gain, cost, discount)
        assert after >= before
        assert after == pytest.approx(tour_value(order, gain, cost, discount))
        assert order[:2].tolist() == fixed.tolist()


def road(nodes: dict[int, Node], edges: dict[tuple[int, int], tuple[float, float]]) -> RoadNet:
    roads = RoadNet(RewardWeights())
    assert roads.apply(graph(1, nodes, edges))
    return roads


def test_ways_do_not_lead_through_frontiers() -> None:
    roads = road(
        {1: (CRUMB, 0.0, 0.0, 0.0), 2: (FRONTIER, 5.0, 0.0, 1.0), 3: (FRONTIER, 10.0, 0.0, 1.0)},
        {(1, 2): (5.0, 0.0), (2, 3): (5.0, 0.0)},
    )
    n = roads.net.node_id.size
    wanted, cost, distance_m = np.zeros(n, np.bool_), np.empty(n), np.zeros(n)
    wanted[roads.frontier_slots()] = True
    ways_from(roads.net, roads.slot_of(1), wanted, 2, -1, cost, distance_m)
    assert distance_m[roads.slot_of(2)] == 5.0
    assert cost[roads.slot_of(3)] == np.inf


def test_a_small_opening_on_the_way_comes_before_the_large_one_far_away() -> None:
    """10 is 6 m to one side and promises 3 nats; 11 lies 40 m away and promises 12."""
    nodes: dict[int, Node] = {
        1: (CRUMB, 0.0, 0.0, 0.0), 2: (CRUMB, 10.0, 0.0, 0.0), 3: (CRUMB, 20.0, 0.0, 0.0),
        10: (FRONTIER, 0.0, 6.0, 3.0), 11: (FRONTIER, 40.0, 0.0, 12.0),
    }  # fmt: skip
    edges = {(1, 2): (10.0, 0.0), (2, 3): (10.0, 0.0), (1, 10): (6.0, 0.0), (3, 11): (20.0, 0.0)}
    roads = road(nodes, edges)
    look = Visits(roads, GAMMA, 4.0, 16, 0.0).first(roads.slot_of(1), -1)
    assert roads.net.node_id[look.first] == 10
    assert look.kept_value == -np.inf
    qmdp, tour = Bench(), Bench(solver="orienteering")
    message = graph(1, nodes, edges)
    assert qmdp.step((GLOBAL_IRM, message)).target == 11
    assert tour.step((GLOBAL_IRM, message)).target == 10


@pytest.mark.parametrize(("margin", "target"), [(0.0, 10), (50.0, 11)])
def test_the_target_is_held_within_the_margin(margin: float, target: int) -> None:
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 11: (FRONTIER, 12.0, 0.0, 4.0)}
    bench = Bench(solver="orienteering", tour_margin=margin, tour_margin_relative=0.0)
    assert bench.step((GLOBAL_IRM, graph(1, nodes, {(1, 11): (12.0, 0.0)}))).target == 11
    more: dict[int, Node] = {**nodes, 10: (FRONTIER, 0.0, 5.0, 6.0)}
    policy = bench.step((GLOBAL_IRM, graph(2, more, {(1, 11): (12.0, 0.0), (1, 10): (5.0, 0.0)})))
    assert policy.target == target
    assert policy.switched == (target == 10)


def test_frontiers_side_by_side_are_one_stop_and_what_cannot_be_reached_is_none() -> None:
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 9: (FRONTIER, 3.0, 30.0, 50.0)}
    edges: dict[tuple[int, int], tuple[float, float]] = {}
    for k in range(5):
        nodes[10 + k] = (FRONTIER, 8.0, 0.5 * k, 3.0)
        edges[1, 10 + k] = (8.0, 0.0)
    roads = road(nodes, edges)
    look = Visits(roads, GAMMA, 4.0, 16, 0.0).first(roads.slot_of(1), roads.slot_of(12))
    gain = 3.0 + 0.3 * 12.0
    assert look.value == pytest.approx(GAMMA**8 * gain - 0.05 * 8.0)
    assert look.kept_value == pytest.approx(look.value)
    assert Visits(road({1: nodes[1]}, {}), GAMMA, 4.0, 16, 0.0).first(0, -1) == Outlook()
    assert Visits(road({1: nodes[1], 9: nodes[9]}, {}), GAMMA, 4.0, 16, 0.0).first(0, -1) == Outlook()


@pytest.mark.parametrize("near_worth", [-1000.0, 10.0])
def test_slivers_at_hand_do_not_hide_the_field_far_away(near_worth: float) -> None:
    """Twenty leftovers of 0.4 nats lie around the robot, a field of five openings of 20 nats 150 m away."""
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 2: (CRUMB, 150.0, 0.0, 0.0)}
    edges = {(1, 2): (150.0, 0.0)}
    for k in range(20):
        nodes[10 + k] = (FRONTIER, 0.0, 10.0 + 6.0 * k, 0.4)
        edges[1, 10 + k] = (10.0 + 6.0 * k, 0.0)
    for k in range(5):
        nodes[31 + k] = (FRONTIER, 150.0, 5.0 + 8.0 * k, 20.0)
        edges[2, 31 + k] = (5.0 + 8.0 * k, 0.0)
    roads = road(nodes, edges)
    look = Visits(roads, 0.995, 4.0, 16, near_worth).first(roads.slot_of(1), -1)
    assert (roads.net.node_id[look.first] == 31) == (near_worth > 0.0)
    near = group_frontiers(roads, roads.frontier_slots(), np.arange(25.0), 4.0, 3, -1, 2)
    assert roads.net.node_id[near.slot].tolist() == [10, 11, 12, 31, 32], (
        "the nearest, then the most for the way"
    )
    assert near.of[roads.slot_of(32)] == 4


def test_the_frontier_held_is_found_beyond_the_nearest_ones() -> None:
    nodes: dict[int, Node] = {
        1: (CRUMB, 0.0, 0.0, 0.0),
        2: (CRUMB, 20.0, 0.0, 0.0),
        3: (CRUMB, 40.0, 0.0, 0.0),
    }
    edges = {(1, 2): (20.0, 0.0), (2, 3): (20.0, 0.0)}
    for crumb in (1, 2, 3):
        nodes[10 + crumb] = (FRONTIER, 20.0 * (crumb - 1), 3.0, 1.0)
        edges[crumb, 10 + crumb] = (3.0, 0.0)
    roads = road(nodes, edges)
    n = roads.net.node_id.size
    wanted = np.zeros(n, np.bool_)
    wanted[roads.frontier_slots()] = True
    for held, found in ((-1, [11]), (roads.slot_of(12), [11, 12]), (roads.slot_of(13), [11, 12, 13])):
        cost, distance_m = np.empty(n), np.zeros(n)
        ways_from(roads.net, roads.slot_of(1), wanted, 1, held, cost, distance_m)
        assert [k for k in (11, 12, 13) if np.isfinite(cost[roads.slot_of(k)])] == found

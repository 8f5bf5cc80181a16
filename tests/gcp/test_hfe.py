"""Frontiers one step ahead, against brute force; the scopes; when the stage leaves a target for another."""

from __future__ import annotations

import itertools
import math
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.reward import RewardWeights
from schemas.operation import MissionPhase
from schemas.topics import GLOBAL_IRM, MISSION
from services.gcp.hfe import frontier_options, scope_of
from services.gcp.roadnet import RoadNet
from tests.gcp.test_stage import CRUMB, FRONTIER, Bench, Edge, Node, graph, mission

WEIGHTS = RewardWeights()
RISK_WEIGHT_M = 4.0


def random_roads(seed: int) -> tuple[RoadNet, nx.Graph[int]]:
    """Twelve breadcrumbs and six frontiers with random edges; the same as a graph of networkx."""
    rng = np.random.default_rng(seed)
    nodes: dict[int, Node] = {}
    for i in range(1, 19):
        x, y = rng.uniform(0.0, 40.0, 2).tolist()
        nodes[i] = (FRONTIER, x, y, float(rng.uniform(0.5, 9.0))) if i > 12 else (CRUMB, x, y, 0.0)
    edges: dict[tuple[int, int], Edge] = {}
    for a in range(1, 19):
        for b in range(a + 1, 19):
            if rng.random() < 0.16:
                edges[a, b] = (float(rng.uniform(1.0, 20.0)), float(rng.uniform(0.0, 0.5)))
    roads = RoadNet(WEIGHTS)
    assert roads.apply(graph(1, nodes, edges))
    plain: nx.Graph[int] = nx.Graph()
    plain.add_nodes_from((i, {"gain": nodes[i][3], "frontier": nodes[i][0] == FRONTIER}) for i in nodes)
    plain.add_edges_from(
        (a, b, {"length": d, "risk": rho, "cost": d + RISK_WEIGHT_M * rho})
        for (a, b), (d, rho) in edges.items()
    )
    return roads, plain


def plain_way(plain: nx.Graph[int], frontier: int) -> list[int] | None:
    """The cheapest way from breadcrumb 1 that passes through no other frontier."""
    others = [n for n, data in plain.nodes(data=True) if data["frontier"] and n != frontier]
    without = plain.subgraph(set(plain) - set(others))
    try:
        found: list[int] = nx.dijkstra_path(without, 1, frontier, weight="cost")
    except nx.NetworkXNoPath:
        return None
    return found


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 3.0), st.sampled_from([(), (10.0,), (6.0, 20.0)]))
def test_options_are_those_of_brute_force(seed: int, gain_weight: float, scopes: tuple[float, ...]) -> None:
    roads, plain = random_roads(seed)
    wanted = []
    for frontier in range(13, 19):
        way = plain_way(plain, frontier)
        if way is None:
            continue
        steps = [plain.edges[a, b] for a, b in itertools.pairwise(way)]
        length, safe = sum(e["length"] for e in steps), math.prod(1.0 - e["risk"] for e in steps)
        gain = plain.nodes[frontier]["gain"]
        reward = gain_weight * WEIGHTS.gamma_per_m**length * safe * gain - (
            WEIGHTS.k_distance_per_m * length + WEIGHTS.k_risk * (1.0 - safe)
        )
        scope = sum(length > s for s in scopes)
        wanted.append((scope, -reward, frontier, way, length, 1.0 - safe, gain))
    wanted.sort()
    found = frontier_options(roads, roads.slot_of(1), scopes, gain_weight, RISK_WEIGHT_M, 9, ())
    ids = roads.net.node_id
    assert [int(ids[o.node]) for o in found] == [w[2] for w in wanted]
    for option, (_, minus, _, way, length, risk, gain) in zip(found, wanted, strict=True):
        assert [int(ids[slot]) for slot in option.path] == way
        assert (option.q, option.distance_m, option.risk, option.gain) == pytest.approx(
            (-minus, length, risk, gain), rel=1e-9, abs=1e-12
        )


def test_only_the_best_are_given_and_the_one_that_is_kept() -> None:
    roads, _ = random_roads(7)
    everything = frontier_options(roads, roads.slot_of(1), (), 1.0, RISK_WEIGHT_M, 9, ())
    assert len(everything) >= 3
    last = everything[-1].node
    found = frontier_options(roads, roads.slot_of(1), (), 1.0, RISK_WEIGHT_M, 1, (last,))
    assert [o.node for o in found] == [everything[0].node, last]


def test_a_scope_holds_what_is_no_farther() -> None:
    assert [scope_of(d, (8.0, 25.0)) for d in (0.0, 8.0, 8.1, 25.0, 26.0)] == [0, 0, 1, 1, 2]
    assert scope_of(3.0, ()) == 0


# --- the stage ----------------------------------------------------------------------------------------------------


def bench(**hfe: Any) -> Bench:
    return Bench(solver="hfe", hfe=hfe, policy_radius_m=100.0)


def star(version: int, **frontiers: tuple[float, float]) -> Any:
    """Frontiers f10, f11, ... around breadcrumb 1: (distance, gain) each."""
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0)}
    edges: dict[tuple[int, int], Edge] = {}
    for name, (distance, gain) in frontiers.items():
        number = int(name[1:])
        angle = 0.9 * number
        nodes[number] = (FRONTIER, distance * math.cos(angle), distance * math.sin(angle), gain)
        edges[1, number] = (distance, 0.0)
    return graph(version, nodes, edges)


def test_near_frontiers_come_before_far_ones_whatever_they_pay() -> None:
    world = star(1, f10=(9.0, 1.0), f11=(15.0, 50.0))
    assert bench(scopes_m=[10.0]).step((GLOBAL_IRM, world)).target == 10
    assert bench(scopes_m=[]).step((GLOBAL_IRM, world)).target == 11
    assert bench(scopes_m=[], gain_weight=0.0).step((GLOBAL_IRM, world)).target == 10, "the nearest"


def test_a_way_to_a_far_frontier_is_left_for_one_that_appears_near() -> None:
    stage = bench(scopes_m=[10.0], switch_margin=1e9)
    assert stage.step((GLOBAL_IRM, star(1, f11=(30.0, 50.0)))).target == 11
    policy = stage.step((GLOBAL_IRM, star(2, f11=(30.0, 50.0), f12=(5.0, 0.5))))
    assert (policy.target, policy.switched) == (12, True)


@pytest.mark.parametrize(("margin", "target"), [(1.0, 12), (4.0, 11)])
def test_in_one_scope_a_target_is_left_for_what_pays_more_by_the_margin(margin: float, target: int) -> None:
    stage = bench(scopes_m=[], switch_margin=margin)
    assert stage.step((GLOBAL_IRM, star(1, f11=(10.0, 6.0)))).target == 11
    better = star(2, f11=(10.0, 6.0), f12=(10.0, 9.0))
    gap = WEIGHTS.gamma_per_m**10.0 * 3.0
    assert 1.0 < gap < 4.0
    policy = stage.step((GLOBAL_IRM, better))
    assert policy.target == target
    assert [o.frontier for o in policy.alternatives] == [12, 11]
    assert policy.alternatives[0].q - policy.alternatives[1].q == pytest.approx(gap)


def test_a_covered_target_gives_way_without_a_switch_and_nobody_is_told_values() -> None:
    stage = bench()
    stage.step((GLOBAL_IRM, star(1, f11=(10.0, 6.0))))
    policy = stage.step((GLOBAL_IRM, star(2, f12=(10.0, 9.0))))
    assert (policy.target, policy.switched) == (12, False)
    assert policy.path_node.tolist() == [1, 12]
    assert len(policy.node_id) == 0
    assert stage.step((GLOBAL_IRM, star(3))).target == -1


def test_on_the_way_back_it_goes_home() -> None:
    nodes: dict[int, Node] = {
        1: (CRUMB, 0.0, 0.0, 0.0),
        2: (CRUMB, 20.0, 0.0, 0.0),
        3: (FRONTIER, 1.0, 0.0, 9.0),
    }
    world = graph(1, nodes, {(1, 2): (20.0, 0.0), (1, 3): (1.0, 0.0)})
    policy = bench().step((GLOBAL_IRM, world), (MISSION, mission(MissionPhase.RETURN, home_x_m=20.0)))
    assert policy.reason.startswith("home")
    assert policy.target == 2

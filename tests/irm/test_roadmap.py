"""The Global IRM: breadcrumbs, edges and their lives, and differences that give what the whole graph gives."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.frames import Planar
from planning.graph_mirror import GraphMirror
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from planning.search import dijkstra_grid, trace_path
from schemas.base import Pose
from schemas.codec import Envelope, decode, encode
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import GLOBAL_IRM
from schemas.world import BREADCRUMB, FRONTIER, GlobalIrm
from services.irm.config import Config
from services.irm.driven import placed, seen_from
from services.irm.graph import RoadGraph
from services.irm.roadmap import ROBOT, Roadmap, path_totals
from tests.irm.worlds import Belief, Flat, room, scan_at

SECOND = 10**9
RES = 0.2
CONFIG = Config(max_edge_m=6.0, breadcrumb_spacing_m=2.0, edges_per_node=4, sensor_range_m=4.0)


def ring() -> Flat:
    """A corridor of 3 m around a block of 10 x 6 m, with a dead end."""
    flat = room(0.0, 0.0, 16.0, 12.0, RES)
    flat.fill(3.0, 3.0, 13.0, 9.0, LETHAL)
    return flat.fill(5.0, 3.0, 7.0, 7.0, FREE)


def lap(step_m: float = 0.5) -> NDArray[np.float64]:
    """Places along the middle of the ring, once around, (n, 2)."""
    corners = np.array([(1.5, 1.5), (14.5, 1.5), (14.5, 10.5), (1.5, 10.5), (1.5, 1.5)])
    parts = []
    for a, b in pairwise(corners):
        n = math.ceil(float(np.hypot(*(b - a))) / step_m)
        parts.append(a + (b - a) * (np.arange(n) / n)[:, None])
    return np.concatenate(parts)


class Drive:
    """A robot that drives through a world, covers what it sees, and keeps its roadmap."""

    def __init__(self, flat: Flat, window_m: float = 12.0, config: Config = CONFIG) -> None:
        self.flat, self.window_m, self.config = flat, window_m, config
        self.belief = Belief.new(config, RES)
        self.roadmap = Roadmap(config)
        self.tick = 0

    def to(self, x_m: float, y_m: float, look: bool = True) -> None:
        """One update with the robot at a place."""
        risk = self.flat.risk_map(x_m, y_m, self.window_m)
        g = risk.grid
        spec = GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height)
        if look:
            scan = scan_at(Planar(x_m, y_m, 0.0), self.tick, range_m=self.config.sensor_range_m)
            self.belief.store.add(scan, Planar(0.0, 0.0, 0.0), risk.state, spec, Planar(0.0, 0.0, 0.0))
        window = self.belief.window(risk, x_m, y_m)
        self.roadmap.update(window, x_m, y_m, self.tick * SECOND, 1.0)
        self.tick += 1

    def stay(self, x_m: float, y_m: float, times: int = 40) -> None:
        """Updates and messages at one place, long enough for every edge near to be looked at again."""
        for _ in range(times):
            self.to(x_m, y_m)
            self.message()

    def message(self, whole: bool = False) -> GlobalIrm:
        """What has changed since the last message."""
        return self.roadmap.message(Pose(), Pose(), self.tick, whole)

    def crumbs(self) -> dict[int, tuple[float, float]]:
        """Places of the breadcrumbs."""
        nodes = self.roadmap.graph.nodes(data=True)
        return {n: (d["x"], d["y"]) for n, d in nodes if d["kind"] == BREADCRUMB and n != ROBOT}

    def between(self, a_x: float, b_x: float) -> dict[str, Any] | None:
        """The edge between the breadcrumbs nearest to two places on y = 0."""
        crumbs = self.crumbs()
        a = min(crumbs, key=lambda n: abs(crumbs[n][0] - a_x))
        b = min(crumbs, key=lambda n: abs(crumbs[n][0] - b_x))
        assert a != b
        return self.roadmap.graph.edges.get((a, b))

    def crosses(self, edge: tuple[int, int], x_m: float) -> bool:
        """Whether the ends of an edge lie on both sides of x."""
        a, b = (self.roadmap.graph.nodes[n]["x"] - x_m for n in edge)
        return bool(a * b < 0.0)


def check_edges(drive: Drive) -> None:
    graph, config = drive.roadmap.graph, drive.config
    for a, b, d in graph.edges(data=True):
        assert a != b
        assert 0.0 <= d["risk"] < 1.0
        kinds = {graph.nodes[n]["kind"] for n in (a, b)}
        assert kinds != {FRONTIER}
        straight = math.dist(*((graph.nodes[n]["x"], graph.nodes[n]["y"]) for n in (a, b)))
        assert d["distance"] >= straight - 4 * math.sqrt(2) * RES - 1e-6
        if ROBOT not in (a, b) and not d["driven"]:
            assert d["risk"] < config.max_edge_risk
            if kinds == {BREADCRUMB}:
                assert d["distance"] < config.max_edge_m


def test_breadcrumbs_keep_their_spacing_and_the_way_driven_is_connected() -> None:
    drive = Drive(ring())
    first_lap: set[int] = set()
    for k, (x, y) in enumerate(np.concatenate((lap(), lap()))):
        drive.to(x, y)
        crumbs = drive.crumbs()
        assert min(math.dist((x, y), p) for p in crumbs.values()) <= CONFIG.breadcrumb_spacing_m
        check_edges(drive)
        if k == len(lap()) - 1:
            first_lap = set(crumbs)
    crumbs = drive.crumbs()
    places = list(crumbs.values())
    gaps = [math.dist(p, q) for i, p in enumerate(places) for q in places[:i]]
    assert min(gaps) >= CONFIG.breadcrumb_spacing_m
    assert set(crumbs) == first_lap  # the second lap adds nothing
    assert 15 <= len(crumbs) <= 25
    graph = drive.roadmap.graph
    driven = graph.edge_subgraph(
        [(a, b) for a, b, d in graph.edges(data=True) if d["driven"] and ROBOT not in (a, b)]
    )
    assert set(driven) == set(crumbs) and nx.is_connected(driven)
    assert drive.roadmap.breadcrumbs() == len(crumbs)


def test_the_ring_is_closed_by_an_edge_that_was_searched_or_driven() -> None:
    drive = Drive(ring())
    for x, y in np.concatenate((lap(), lap()[:8])):
        drive.to(x, y)
    graph = drive.roadmap.graph.copy()
    graph.remove_node(ROBOT)
    start = min(drive.crumbs(), key=lambda n: math.dist(drive.crumbs()[n], (1.5, 1.5)))
    half = min(drive.crumbs(), key=lambda n: math.dist(drive.crumbs()[n], (14.5, 10.5)))
    shortest = nx.dijkstra_path_length(graph, start, half, weight="distance")
    assert 17.5 < shortest < 23.0  # along the inner walls, or along the middle
    low = [n for n, d in graph.nodes(data=True) if d["y"] < 2.9 and 4 < d["x"] < 12]
    graph.remove_nodes_from(low)
    assert 17.5 < nx.dijkstra_path_length(graph, start, half, weight="distance") < 23.0


def test_differences_equal_the_whole_graph_and_ids_are_never_used_twice() -> None:
    drive = Drive(ring())
    mirror = GraphMirror()
    rng = np.random.default_rng(4)
    gone: set[int] = set()
    frontiers = 0
    for k, (x, y) in enumerate(lap()):
        if k % 7 == 3:
            a, b = rng.uniform(1, 15), rng.uniform(1, 11)
            drive.flat.fill(a, b, a + 0.6, b + 0.6, LETHAL if rng.random() < 0.5 else FREE)
            drive.flat.fill(3.1, 3.1, 4.9, 8.9, LETHAL)
        drive.to(x, y)
        message = drive.message(whole=k % 20 == 11)
        assert message.base_version == (0 if k == 0 or k % 20 == 11 else message.irm_version - 1)
        payload = encode(message, Envelope("husky1", "irm", 1, k, 0, {}))
        assert mirror.apply(decode(payload, GlobalIrm, GLOBAL_IRM.max_bytes)[0])
        fresh = GraphMirror()
        whole = copy.deepcopy(drive.roadmap).message(Pose(), Pose(), k, True)
        assert fresh.apply(whole)
        held: list[tuple[Any, Any]] = list(zip(mirror.road_map(), fresh.road_map(), strict=True))
        assert all(p.dtype == q.dtype and np.array_equal(p, q) for p, q in held)
        ids = set(mirror.road_map().node_id.tolist())
        assert not ids & gone
        gone |= set(message.removed_node.tolist())
        frontiers = max(frontiers, int((mirror.road_map().kind == FRONTIER).sum()))
        assert ids == set(drive.roadmap.graph.nodes)
    assert gone and frontiers >= 2


def test_an_unchanged_graph_gives_an_empty_difference() -> None:
    drive = Drive(ring())
    for _ in range(30):
        drive.to(1.5, 1.5)
        drive.message()
    drive.to(1.5, 1.5)
    message = drive.message()
    counts = [message.node_id.size, message.edge_a.size, message.removed_node.size, message.removed_edge.size]
    assert counts == [0, 0, 0, 0]
    assert message.base_version == message.irm_version - 1 > 0


def test_frontiers_are_terminal_nodes_in_reach_of_the_robot() -> None:
    drive = Drive(ring())
    for x, y in lap()[:40]:
        drive.to(x, y)
        graph = drive.roadmap.graph
        reached = nx.node_connected_component(graph, ROBOT)
        frontiers = [n for n, d in graph.nodes(data=True) if d["kind"] == FRONTIER]
        assert sorted(frontiers) == sorted(drive.roadmap.manager.frontiers)
        for n in frontiers:
            f = drive.roadmap.manager.frontiers[n]
            assert (graph.nodes[n]["x"], graph.nodes[n]["y"]) == (f.x_m, f.y_m)
            assert graph.nodes[n]["gain"] == f.gain > 0
            assert n in reached


def corridor() -> Flat:
    """24 m long, 3 m wide, along y = 0."""
    return room(-1.0, -1.5, 24.0, 1.5, RES)


def driven_corridor(until_m: float = 20.0) -> Drive:
    drive = Drive(corridor(), window_m=14.0)
    for x in np.arange(0.0, until_m + 0.01, 0.5):
        drive.to(float(x), 0.1)
    return drive


def test_a_driven_edge_stays_when_its_ground_has_rolled_out_of_the_window() -> None:
    drive = driven_corridor()
    first = drive.between(0.0, 2.5)
    assert first is not None and first["driven"]
    before = dict(first)
    drive.flat.fill(1.0, -1.5, 1.4, 1.5, LETHAL)  # nobody looks: no evidence
    drive.stay(20.0, 0.1)
    assert drive.between(0.0, 2.5) == before


def test_an_edge_that_nobody_drove_also_stays_out_of_sight() -> None:
    drive = driven_corridor()
    edges = {
        (a, b)
        for a, b, d in drive.roadmap.graph.edges(data=True)
        if not d["driven"]
        and ROBOT not in (a, b)
        and max(drive.crumbs().get(n, (99,))[0] for n in (a, b)) < 8
    }
    assert edges
    drive.stay(20.0, 0.1)
    assert all(drive.roadmap.graph.has_edge(a, b) for a, b in edges)


@pytest.mark.parametrize("closed", [False, True])
def test_a_driven_way_round_a_corner_goes_only_when_something_stands_on_it(closed: bool) -> None:
    """The robot went round a wall's end by a gap that then looks too narrow: the wall between is no news."""
    drive = Drive(room(-1.0, -3.0, 9.0, 3.0, RES))
    drive.flat.fill(3.8, -3.0, 4.2, 1.0, LETHAL)
    way = [(3.0, -1.0), (3.0, 0.0), (3.0, 1.0), (3.4, 1.8), (4.2, 1.9), (5.0, 1.4), (5.0, 0.4), (5.0, -0.6)]
    drive.to(1.0, -1.0)
    for a, b in pairwise([(1.0, -1.0), *way]):
        for share in (0.5, 1.0):
            drive.to(a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
    across = [
        e for e in drive.roadmap.graph.edges
        if ROBOT not in e and drive.crosses(e, 4.0) and drive.roadmap.graph.edges[e]["driven"]
    ]  # fmt: skip
    assert across
    for y in (1.0, 2.2) if not closed else (1.0, 1.4, 1.8, 2.2, 2.6):
        drive.flat.fill(3.8, y, 4.2, y + 0.4, LETHAL)
    drive.flat.fill(3.8, 2.6, 4.2, 3.0, LETHAL)
    drive.stay(5.0, -0.6)
    assert [drive.roadmap.graph.has_edge(*e) for e in across] == [not closed] * len(across)


def test_what_seems_to_stand_on_a_driven_way_far_off_does_not_close_it() -> None:
    """From ten metres a slope behind a stone looks closed; from near it is looked at again."""
    drive = Drive(room(-1.0, -1.0, 15.0, 1.0, RES), window_m=24.0)
    for x in np.arange(0.0, 12.5, 0.5):
        drive.to(float(x), 0.0)
    edge = next(
        e for e in drive.roadmap.graph.edges
        if ROBOT not in e and drive.crosses(e, 3.0) and drive.roadmap.graph.edges[e]["driven"]
    )  # fmt: skip
    drive.flat.fill(2.8, -1.0, 3.2, 1.0, LETHAL)
    drive.stay(12.0, 0.0)
    assert drive.roadmap.graph.has_edge(*edge), "ten metres away"
    for x in np.arange(11.5, 5.5, -0.5):
        drive.to(float(x), 0.0)
    drive.stay(6.0, 0.0)
    assert not drive.roadmap.graph.has_edge(*edge), "three metres away"


@given(
    ends=st.tuples(*[st.tuples(st.floats(-50, 50), st.floats(-50, 50))] * 2),
    points=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=8),
)
def test_a_way_seen_from_its_ends_lies_where_it_was(
    ends: tuple[tuple[float, float], tuple[float, float]], points: list[tuple[float, float]]
) -> None:
    a, b = ends
    shares = seen_from(a, b, points)
    if math.dist(a, b) < 0.5:
        assert shares == []
        return
    assert np.allclose(placed(a, b, shares), np.array(points).reshape(-1, 2), atol=1e-6)
    road = RoadGraph()
    for node, (x, y) in ((1, b), (2, a)):
        road.set_node(node, x, y, 0.0, BREADCRUMB, 0.0, 1.0)
    road.set_edge(2, 1, 1.0, 0.0, 1)
    road.set_way(2, 1, shares)
    assert np.allclose(
        placed(b, a, road.graph.edges[1, 2]["way"]), np.array(points).reshape(-1, 2), atol=1e-6
    )


def test_edges_go_when_a_wall_is_seen_between_their_ends_and_come_back_with_the_ground() -> None:
    drive = driven_corridor(10.0)
    before = drive.between(7.5, 10.0)
    assert before is not None
    drive.flat.fill(8.4, -1.5, 9.0, 1.5, LETHAL)
    drive.stay(6.0, 0.1)
    assert drive.between(7.5, 10.0) is None
    for a, b in drive.roadmap.graph.edges:
        ends = sorted(drive.roadmap.graph.nodes[n]["x"] for n in (a, b))
        assert not (ends[0] < 8.4 and ends[1] > 9.0)
    drive.flat.fill(8.4, -1.5, 9.0, 1.5, FREE)
    drive.stay(6.0, 0.1)
    after = drive.between(7.5, 10.0)
    assert after is not None and after["distance"] == pytest.approx(before["distance"], abs=0.5)


@pytest.mark.parametrize(
    ("low", "high", "what", "kept"),
    [(3.0, 4.5, UNKNOWN, True), (-1.0, 3.0, UNKNOWN, True), (3.0, 4.5, LETHAL, False)],
)
def test_an_edge_that_nobody_drove_goes_for_a_wall_and_not_for_forgotten_ground(
    low: float, high: float, what: int, kept: bool
) -> None:
    """Forgotten between its ends, or at one of them."""
    flat = room(0.0, 0.0, 12.0, 3.0, 0.5, 0.5)
    belief, roadmap = Belief.new(CONFIG, 0.5), Roadmap(CONFIG, next_id=9, last_breadcrumb=3)
    for k, x in ((1, 1.75), (2, 5.75), (3, 9.75)):
        roadmap.road.set_node(k, x, 1.75, 0.0, BREADCRUMB, 0.0, 1.0)
    roadmap.road.set_edge(1, 2, 4.0, 0.0, 0)
    belief.window(flat.risk_map(9.75, 1.75), 9.75, 1.75)
    flat.fill(low, -1.0, high, 4.0, what)
    for k in range(4):
        roadmap.update(belief.window(flat.risk_map(9.75, 1.75), 9.75, 1.75), 9.75, 1.75, k * SECOND, 1.0)
        roadmap.message(Pose(), Pose(), k, False)
    assert roadmap.graph.has_edge(1, 2) is kept


def test_a_path_of_a_search_has_its_own_length_and_hazard() -> None:
    rng = np.random.default_rng(2)
    passable = rng.random((40, 40)) < 0.8
    passable[0, 0] = True
    hazard = rng.random((40, 40)).astype(np.float32)
    cost, parent = np.full((40, 40), np.inf), np.full((40, 40), -1, np.int32)
    dijkstra_grid(np.float32(1) + hazard, passable, RES, 0, 0, math.inf, cost, parent)
    for row, column in np.argwhere(np.isfinite(cost))[::37]:
        cells = trace_path(parent, row, column)
        steps = np.hypot(*np.diff(cells, axis=0).T) * RES
        values = hazard[cells[:, 0], cells[:, 1]].astype(np.float64)
        distance, integral = path_totals(parent, hazard, RES, row, column)
        assert distance == pytest.approx(steps.sum())
        assert integral == pytest.approx((steps * 0.5 * (values[1:] + values[:-1])).sum(), rel=1e-5)


def test_hazard_on_the_way_becomes_the_risk_of_the_edge() -> None:
    drive = Drive(corridor(), window_m=14.0)
    for x in np.arange(0.0, 6.01, 0.5):
        drive.to(float(x), 0.1)
    calm = drive.between(0.0, 4.0)
    assert calm is not None and calm["risk"] < 0.05
    risk = drive.flat.risk_map(3.0, 0.1, 14.0)
    rough = risk.model_copy(update={"hazard_cvar": risk.hazard_cvar + np.float32(0.1)})
    for _ in range(12):
        drive.roadmap.version += 1
        drive.roadmap.update(drive.belief.window(rough, 3.0, 0.1), 3.0, 0.1, drive.tick * SECOND, 1.0)
    edge = drive.between(0.0, 4.0)
    assert edge is not None
    assert edge["risk"] == pytest.approx(1 - math.exp(-0.1 * edge["distance"]), abs=0.06)


def test_a_frontier_that_no_edge_leads_to_is_given_up_after_a_while_and_not_before() -> None:
    """Its ground connects, but every way to it is too risky for an edge; when it calms down in time it stays."""
    for rough_rounds, stays in ((6, True), (7, False)):
        drive = Drive(room(0.0, 0.0, 9.0, 3.0, RES), config=CONFIG.model_copy(update={"missed_rounds": 2}))
        drive.to(1.5, 1.5)
        (frontier,) = drive.roadmap.manager.frontiers
        risk = drive.flat.risk_map(1.5, 1.5, 12.0)
        deep = risk.model_copy(update={"hazard_cvar": risk.hazard_cvar + np.float32(2.0)})
        drive.roadmap.graph.remove_edges_from(list(drive.roadmap.graph.edges(frontier)))
        for _ in range(rough_rounds):
            drive.roadmap.update(drive.belief.window(deep, 1.5, 1.5), 1.5, 1.5, drive.tick * SECOND, 1.0)
            drive.tick += 1
        manager = drive.roadmap.manager
        assert (frontier in manager.frontiers) is stays
        assert (frontier in drive.roadmap.graph) is stays
        assert [g.reason for g in manager.given_up] == ([] if stays else ["no way over the graph"])
        if stays:
            drive.to(1.5, 1.5)
            assert drive.roadmap.graph.degree(frontier) > 0
            assert manager.frontiers[frontier].isolated == 0


@pytest.mark.parametrize("told", [True, False])
def test_a_snapshot_goes_on_with_the_same_messages(told: bool) -> None:
    """Also when the graph has changed since the last message, or when there was none yet."""
    drive = Drive(ring())
    for x, y in lap()[:25]:
        drive.to(x, y)
        if told:
            drive.message()
    drive.flat.fill(3.1, 1.0, 3.5, 2.0, LETHAL)
    drive.to(*lap()[25])
    twin = copy.deepcopy(drive)
    twin.roadmap = Roadmap(CONFIG)
    twin.roadmap.set_state(unpack_snapshot(pack_snapshot(drive.roadmap.state())))
    for x, y in lap()[26:32]:
        messages = [drive.message(), twin.message()]
        assert messages[0].node_id.size > 0
        assert messages[0].model_dump().keys() == messages[1].model_dump().keys()
        for name, value in messages[0].model_dump().items():
            assert np.array_equal(value, messages[1].model_dump()[name]), name
        for d in (drive, twin):
            d.to(x, y)


def test_differences_from_a_journal_lead_to_the_graph_that_was_told() -> None:
    drive = Drive(ring())
    twin = Roadmap(CONFIG)
    for k, (x, y) in enumerate(lap()[:40]):
        if k == 20:
            drive.flat.fill(8.0, 0.0, 8.6, 3.0, LETHAL)
        drive.to(x, y)
        record = drive.roadmap.difference(drive.message(whole=k == 10))
        twin.apply_difference(unpack_snapshot(pack_snapshot(record)))
    mine, theirs = drive.roadmap.state(), twin.state()
    mine["unpublished"] = theirs["unpublished"] = []
    assert pack_snapshot(mine) == pack_snapshot(theirs)
    whole = twin.message(Pose(), Pose(), 0, False)
    assert whole.base_version == 0 and whole.irm_version == drive.roadmap.version + 1


def test_a_way_that_was_driven_stays_when_its_ground_turns_out_risky_and_stones_lie_on_the_straight_line() -> (
    None
):
    drive = Drive(room(0.0, 0.0, 9.0, 3.0, RES))
    for x in np.arange(1.5, 7.0, 0.5):
        drive.to(float(x), 1.5)
    graph = drive.roadmap.graph
    driven = [(a, b) for a, b, edge in graph.edges(data=True) if edge["driven"] and ROBOT not in (a, b)]
    assert driven
    a, b = driven[0]
    (ax, ay), (bx, by) = drive.roadmap.road.place(a), drive.roadmap.road.place(b)
    x, y = 0.5 * (ax + bx), 0.5 * (ay + by)
    drive.flat.fill(x - 0.15, y - 0.15, x + 0.15, y + 0.15, LETHAL)
    risk = drive.flat.risk_map(6.5, 1.5, 16.0)
    deep = risk.model_copy(update={"hazard_cvar": risk.hazard_cvar + np.float32(1.5)})
    for _ in range(20):
        drive.roadmap.update(drive.belief.window(deep, 6.5, 1.5), 6.5, 1.5, drive.tick * SECOND, 1.0)
        drive.tick += 1
        drive.roadmap.version += 1  # edges are reviewed in turn
    assert graph.has_edge(a, b) and graph.edges[a, b]["risk"] > CONFIG.max_edge_risk

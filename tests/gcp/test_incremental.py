"""What is kept between steps against what is computed anew: after any changes of the graph both are the same."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.graph_mirror import FRONTIER, GraphMirror, RoadMap
from planning.reward import RewardWeights
from schemas.base import Pose
from schemas.snapshot import pack_snapshot
from schemas.world import GlobalIrm
from services.gcp.field import Field
from services.gcp.planner import Belief, GlobalPlanner
from services.gcp.ranking import Ranking
from services.gcp.roadnet import RoadNet
from tests.gcp import full_planner
from tests.gcp.frontier_values import _first_pass

Edge = tuple[int, int]
Floats = NDArray[np.float64]


class Node(NamedTuple):
    kind: int
    xyz_m: tuple[float, float, float]
    gain: float


class Change(NamedTuple):
    nodes: dict[int, Node]
    edges: dict[Edge, tuple[float, float]]
    removed_nodes: list[int]
    removed_edges: list[Edge]


class World:
    """A graph that changes at random as irm's does, and messages about it."""

    def __init__(self, seed: int, gamma_per_m: float = 0.985, spread_m: float = 40.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.nodes: dict[int, Node] = {}
        self.edges: dict[Edge, tuple[float, float]] = {}
        self.version, self.next_id, self.spread_m = 0, 1, spread_m
        self.weights = RewardWeights(gamma_per_m=gamma_per_m)
        self.mirror, self.roads = GraphMirror(), RoadNet(self.weights)

    def _node(self, kind: int) -> Node:
        x, y = self.rng.uniform(-self.spread_m, self.spread_m, 2).tolist()
        return Node(kind, (x, y, 0.0), float(self.rng.uniform(0.0, 30.0)) if kind == FRONTIER else 0.0)

    def _edge(self) -> tuple[float, float]:
        risk = float(self.rng.choice([0.0, self.rng.uniform(0.0, 0.5), 1.0], p=[0.4, 0.55, 0.05]))
        return float(self.rng.choice([0.0, self.rng.uniform(0.1, 9.0)], p=[0.05, 0.95])), risk

    def _pick(self, names: list[int], share: float) -> list[int]:
        return [name for name in names if self.rng.random() < share]

    def change(self, more: int) -> Change:
        """New nodes with edges, nodes and edges gone, other risks, gains and places, frontiers that turn up and go."""
        change = Change({}, {}, [], [])
        for _ in range(int(self.rng.integers(0, more + 1))):
            change.nodes[self.next_id] = self._node(int(self.rng.random() < 0.3))
            self.next_id += 1
        change.removed_nodes.extend(self._pick(sorted(self.nodes), 0.05))
        for name in self._pick(sorted(self.nodes.keys() - set(change.removed_nodes)), 0.1):
            old = self.nodes[name]
            change.nodes[name] = self._node(old.kind if self.rng.random() < 0.9 else 1 - old.kind)
        change.removed_edges.extend(e for e in sorted(self.edges) if self.rng.random() < 0.05)
        here = sorted((self.nodes.keys() | change.nodes.keys()) - set(change.removed_nodes))
        for a in here:
            for b in here:
                fresh = a in change.nodes or b in change.nodes
                share = 2.5 / len(here) if fresh else 0.1 if (a, b) in self.edges else 0.2 / len(here) ** 2
                if a < b and self.rng.random() < share:
                    change.edges[a, b] = self._edge()
        return change

    def tell(self, change: Change, whole: bool = False) -> None:
        """Apply the change, and tell the mirror and the road net of it or of the whole graph."""
        gone = set(change.removed_nodes)
        self.nodes = {n: v for n, v in self.nodes.items() if n not in gone} | change.nodes
        kept = {e: v for e, v in self.edges.items() if not gone & {*e} and e not in change.removed_edges}
        self.edges = kept | change.edges
        told = Change(self.nodes, self.edges, [], []) if whole else change
        message = graph(told, self.version + 1, 0 if whole else self.version)
        self.version += 1
        assert self.mirror.apply(message)
        assert self.roads.apply(message)

    def indices(self, slots: NDArray[np.int32]) -> NDArray[np.int64]:
        """Indices in the mirror's road map of slots."""
        return np.searchsorted(self.mirror.road_map().node_id, self.roads.net.node_id[slots])


def graph(change: Change, version: int, base: int) -> GlobalIrm:
    ids, pairs = [*change.nodes], [*change.edges]
    nodes = [change.nodes[i] for i in ids]
    return GlobalIrm(
        stamp_ns=0,
        irm_version=version,
        base_version=base,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        robot_node=1,
        node_id=np.array(ids, np.int64),
        node_kind=np.array([n.kind for n in nodes], np.uint8),
        node_xyz_m=np.array([n.xyz_m for n in nodes], np.float64).reshape(-1, 3),
        node_gain=np.array([n.gain for n in nodes], np.float64),
        node_coverage=np.zeros(len(ids), np.float32),
        edge_a=np.array([a for a, _ in pairs], np.int64),
        edge_b=np.array([b for _, b in pairs], np.int64),
        edge_distance_m=np.array([change.edges[p][0] for p in pairs], np.float64),
        edge_risk=np.array([change.edges[p][1] for p in pairs], np.float64),
        edge_driven=np.zeros(len(pairs), np.uint8),
        removed_node=np.array(change.removed_nodes, np.int64),
        removed_edge=np.array(change.removed_edges, np.int64).reshape(-1, 2),
    )


def full(world: World) -> tuple[RoadMap, full_planner.GlobalPlanner]:
    road_map = world.mirror.road_map()
    return road_map, full_planner.GlobalPlanner(road_map, world.weights)


def best_of_all(planner: full_planner.GlobalPlanner, goals: dict[int, float], floor: float) -> Floats:
    """V by going over all edges until nothing changes."""
    net = planner.graph
    value = np.full(net.terminal.size, -np.inf)
    source = np.repeat(np.arange(net.terminal.size), np.diff(net.indptr))
    while True:
        at_end = value[net.indices]
        known = np.isfinite(at_end) & np.isfinite(net.cost)
        worth = np.full(source.size, -np.inf)
        worth[known] = np.minimum(
            net.discount[known] * at_end[known] - net.cost[known], np.nextafter(at_end[known], -np.inf)
        )
        better = np.full(value.size, -np.inf)
        np.maximum.at(better, source, worth)
        better[net.terminal] = -np.inf
        for node, gain in goals.items():
            better[node] = gain
        better[better <= floor] = -np.inf
        if (better == value).all():
            return value
        value = better


SEEDS = st.integers(0, 1_000_000)


@given(seed=SEEDS)
def test_the_road_net_holds_what_the_mirror_holds(seed: int) -> None:
    world = World(seed)
    for step in range(8):
        world.tell(world.change(8), whole=step == 5)
        road_map, roads = world.mirror.road_map(), world.roads
        slots = np.flatnonzero(roads.net.node_id >= 0).astype(np.int32)
        slots = slots[np.argsort(roads.net.node_id[slots])]
        assert roads.net.node_id[slots].tolist() == road_map.node_id.tolist()
        assert roads.xyz_m[slots].tolist() == road_map.xyz_m.tolist()
        assert roads.raw_gain[slots].tolist() == road_map.gain.tolist()
        assert roads.net.terminal[slots].tolist() == (road_map.kind == FRONTIER).tolist()
        assert sorted(roads.frontiers) == road_map.node_id[road_map.kind == FRONTIER].tolist()
        for row, slot in enumerate(slots.tolist()):
            mine = slice(roads.net.begin[slot], roads.net.begin[slot] + roads.net.degree[slot])
            theirs = slice(road_map.indptr[row], road_map.indptr[row + 1])
            assert world.indices(roads.net.other[mine]).tolist() == road_map.indices[theirs].tolist()
            assert roads.net.distance_m[mine].tolist() == road_map.distance_m[theirs].tolist()
            assert roads.net.risk[mine].tolist() == road_map.risk[theirs].tolist()


@given(seed=SEEDS)
def test_what_is_near_is_found(seed: int) -> None:
    world = World(seed)
    for _ in range(4):
        world.tell(world.change(12))
        place, radius_m = world.rng.uniform(-30, 30, 3) * (1, 1, 0), float(world.rng.uniform(0.0, 60.0))
        gap_m = np.linalg.norm(world.mirror.road_map().xyz_m - place, axis=1)
        assert (
            world.indices(world.roads.near(place, radius_m)).tolist()
            == np.flatnonzero(gap_m <= radius_m).tolist()
        )
        crumb = world.mirror.road_map().nearest_breadcrumb((float(place[0]), float(place[1]), 0.0))
        slot = world.roads.nearest_breadcrumb(place)
        assert (slot < 0 and crumb < 0) or world.indices(np.array([slot], np.int32)).tolist() == [crumb]


@given(seed=SEEDS)
def test_a_snapshot_does_not_tell_how_the_graph_was_received(seed: int) -> None:
    world = World(seed)
    for _ in range(6):
        world.tell(world.change(8))
    twin = RoadNet(world.weights)
    twin.restore(world.roads.snapshot())
    assert pack_snapshot(twin.snapshot()) == pack_snapshot(world.roads.snapshot())


@given(seed=SEEDS, floor=st.sampled_from([0.0, -np.inf]), all_at_once=st.booleans())
def test_a_field_that_follows_changes_equals_one_computed_anew(
    seed: int, floor: float, all_at_once: bool
) -> None:
    """Bit by bit, whichever nodes were asked for on the way; all frontiers pay, or one."""
    world = World(seed)
    field, paid = Field(world.roads, floor), {1: -np.inf}
    for _ in range(8):
        world.tell(world.change(8))
        roads = world.roads
        before = {slot for slot, gain in paid.items() if gain > -np.inf}
        chosen = sorted(roads.frontiers)[: None if all_at_once else 1]
        paid = dict.fromkeys(before, -np.inf) | {
            roads.frontiers[name]: float(roads.net.gain[roads.frontiers[name]]) for name in chosen
        }
        field.touch(np.array(sorted(roads.touched), np.int32))
        field.pay(np.array([*paid], np.int32), np.array([*paid.values()]))
        roads.touched.clear()
        live = np.flatnonzero(roads.net.node_id >= 0).astype(np.int32)
        wanted = live[world.rng.random(live.size) < world.rng.choice([0.0, 0.2, 1.0])]
        _, planner = full(world)
        index = world.indices(np.array([*paid], np.int32))
        goals = {int(i): g for i, g in zip(index, paid.values(), strict=True) if g > -np.inf}
        expected = best_of_all(planner, goals, floor)
        assert field.values(wanted).tolist() == expected[world.indices(wanted)].tolist()


@given(seed=SEEDS, gamma_per_m=st.sampled_from([0.985, 0.9, 1.0]))
def test_the_policy_is_that_of_the_full_solution(seed: int, gamma_per_m: float) -> None:
    world = World(seed, gamma_per_m)
    planner = GlobalPlanner(world.roads)
    for _ in range(6):
        world.tell(world.change(8))
        planner.follow()
        robot = world.rng.uniform(-30, 30, 3)
        near = world.roads.near(robot, 1000.0)
        found = planner.policy(near, robot, 25.0)
        road_map, reference = full(world)
        value, to_go = reference.values(), reference.values_to_go(robot, 25.0)
        np.testing.assert_allclose(found.value, np.maximum(value.value, 0.0), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found.value_to_go, np.maximum(to_go.value, 0.0), rtol=1e-12, atol=1e-12)
        for k in np.flatnonzero((found.value > 1e-9) & (road_map.kind != FRONTIER)).tolist():
            after = road_map.index_of(int(found.action[k]))
            edge = reference._edge(k, after)
            worth = reference.graph.discount[edge] * value.value[after] - reference.graph.cost[edge]
            assert worth == pytest.approx(value.value[k], abs=1e-9)


def never_better_for_being_longer(planner: full_planner.GlobalPlanner) -> float:
    """Values above this fall along every edge: the largest -c' / (1 - gamma')."""
    graph = planner.graph
    edges = np.isfinite(graph.cost) & (graph.discount < 1.0)
    return float(-(graph.cost[edges] / (1.0 - graph.discount[edges])).min(initial=np.inf))


@given(seed=SEEDS, gamma_per_m=st.sampled_from([0.985, 1.0]))
def test_options_are_those_of_the_full_planner(seed: int, gamma_per_m: float) -> None:
    """The same frontiers; the same Q, length and risk of each that a drive for ever is not better than."""
    world = World(seed, gamma_per_m)
    planner = GlobalPlanner(world.roads)
    for _ in range(6):
        world.tell(world.change(8))
        planner.follow()
        crumbs = [slot for slot in range(world.roads.slots) if world.roads.net.node_id[slot] >= 0]
        crumbs = [slot for slot in crumbs if not world.roads.net.terminal[slot]]
        if not crumbs:
            continue
        robot = int(world.rng.choice(crumbs))
        xyz = world.roads.xyz_m[robot] + world.rng.normal(0.0, 3.0, (7, 3)) * (1, 1, 0)
        found = planner.options(Belief(xyz, robot), [], 3)
        road_map, reference = full(world)
        (index,) = world.indices(np.array([robot], np.int32)).tolist()
        expected = reference.options(full_planner.Belief(xyz, index), [], 3)
        least = never_better_for_being_longer(reference)
        by_id = {int(road_map.node_id[option.node]): option for option in expected}
        assert {int(world.roads.net.node_id[option.node]) for option in found} == by_id.keys()
        for option in found:
            other = by_id[int(world.roads.net.node_id[option.node])]
            assert option.gain == other.gain
            if min(other.q, option.q) > least + 1.0:
                assert option.q == pytest.approx(other.q, abs=1e-9)
            if gamma_per_m < 1.0 and min(other.q, option.q) > max(0.0, least + 1.0):
                assert option.distance_m == pytest.approx(other.distance_m, abs=1e-9)
                assert option.risk == pytest.approx(other.risk, abs=1e-9)


@given(seed=SEEDS)
def test_the_way_home_is_that_of_the_full_planner(seed: int) -> None:
    world = World(seed)
    planner = GlobalPlanner(world.roads)
    for _ in range(6):
        world.tell(world.change(8))
        planner.follow()
        names = sorted(world.nodes)
        if len(names) < 2:
            continue
        home, start = names[0], int(world.rng.choice(names))
        found = planner.way_home(world.roads.slot_of(start), world.roads.slot_of(home))
        road_map, reference = full(world)
        expected = reference.way_home(road_map.index_of(start), road_map.index_of(home))
        assert (found is None) == (expected is None)
        if found is not None and expected is not None:
            assert found.q == pytest.approx(expected.q, abs=1e-9)
            assert world.roads.net.node_id[found.path[[0, -1]]].tolist() == [start, home]


def chain(count: int, gain_at: dict[int, float]) -> World:
    """A corridor of breadcrumbs every 5 m, ids from 1; frontiers 3 m beside some of them."""
    world = World(0)
    nodes = {1 + i: Node(0, (5.0 * i, 0.0, 0.0), 0.0) for i in range(count)}
    edges = {(i, i + 1): (5.0, 0.02) for i in range(1, count)}
    for k, (beside, gain) in enumerate(sorted(gain_at.items())):
        nodes[count + 1 + k] = Node(FRONTIER, (5.0 * beside, 3.0, 0.0), gain)
        edges[1 + beside, count + 1 + k] = (3.0, 0.01)
    world.tell(Change(nodes, edges, [], []))
    return world


@given(seed=SEEDS, top=st.integers(1, 5))
def test_the_best_frontiers_are_those_of_the_whole_search(seed: int, top: int) -> None:
    """In a long corridor with frontiers beside it, of which most need not be looked at."""
    rng = np.random.default_rng(seed)
    gains = {
        int(k): float(rng.exponential(8.0)) for k in rng.choice(150, int(rng.integers(1, 40)), replace=False)
    }
    world = chain(150, gains)
    start = int(rng.integers(1, 151))
    ranking = Ranking(world.roads)
    ranking.best(world.roads.slot_of(75), top)
    found = ranking.best(world.roads.slot_of(start), top)
    road_map, planner = full(world)
    priced = np.empty((planner.frontiers.size, 3))
    reference = float(planner.graph.gain[planner.frontiers].max())
    first = road_map.index_of(start)
    _first_pass(
        planner.graph, road_map.distance_m, road_map.risk, first, planner.frontiers, reference, priced
    )
    order = np.argsort(-priced[:, 0], kind="stable")[:top]
    assert world.indices(found).tolist() == planner.frontiers[order].tolist()


def test_the_search_for_the_best_frontiers_ends_before_the_world_does() -> None:
    """Behind the third frontier nothing can be among the best three, and the search does not go there."""
    world = chain(3000, {10: 9.0, 20: 12.0, 40: 8.0, 1000: 20.0, 2000: 20.0})
    ranking = Ranking(world.roads)
    assert world.roads.net.node_id[ranking.best(world.roads.slot_of(1), 3)].tolist() == [3001, 3002, 3003]
    assert ranking.steps < 200


@pytest.mark.parametrize("behind", [200, 4000])
def test_a_change_costs_the_same_however_much_was_driven(behind: int) -> None:
    """At the end of a corridor a frontier goes and a new one turns up 5 m further on, 20 times."""
    world = chain(behind, {behind - 1: 20.0, 3: 15.0})
    planner = GlobalPlanner(world.roads)
    steps: list[int] = []
    for k in range(20):
        end, old = behind + 10 + 2 * k, max(n for n, v in world.nodes.items() if v.kind == FRONTIER)
        last = max(n for n, v in world.nodes.items() if v.kind != FRONTIER)
        x_m = world.nodes[last].xyz_m[0] + 5.0
        nodes = {end: Node(0, (x_m, 0.0, 0.0), 0.0), end + 1: Node(FRONTIER, (x_m, 3.0, 0.0), 20.0)}
        edges = {(last, end): (5.0, 0.02), (end, end + 1): (3.0, 0.01)}
        world.tell(Change(nodes, edges, [old], []))
        planner.follow()
        robot = np.array([x_m, 0.0, 0.0])
        planner.policy(world.roads.near(robot, 32.0), robot, 18.0)
        planner.options(Belief(robot[None, :], world.roads.slot_of(end)), [], 1)
        fields = (planner._all, planner._far, *(field for _, field in planner._single.values()))
        steps.append(sum(field.steps for field in fields))
    assert max(np.diff(steps)) < 60


def test_messages_that_do_not_fit_change_nothing() -> None:
    world = chain(5, {4: 3.0})
    before = world.roads.snapshot()
    good = graph(Change({9: Node(0, (1.0, 1.0, 0.0), 0.0)}, {(5, 9): (2.0, 0.1)}, [], []), 2, 1)
    far_off: dict[str, object] = {"edge_b": np.array([77])}
    wrong: list[dict[str, object]] = [
        {"base_version": 7},
        far_off,
        {"removed_node": np.array([5])},
        {"edge_a": np.array([9]), "edge_b": np.array([5])},
        {"base_version": 0, **far_off},
        {"base_version": 0},
    ]
    for update in wrong:
        assert not world.roads.apply(good.model_copy(update=update))
        assert pack_snapshot(world.roads.snapshot()) == pack_snapshot(before)
    assert world.roads.apply(good)

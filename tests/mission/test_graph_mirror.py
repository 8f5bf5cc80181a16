"""The mirror of the Global IRM: differences give what the whole graph gives."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.graph_mirror import BREADCRUMB, FRONTIER, GraphMirror, RoadMap
from schemas.snapshot import pack_snapshot, unpack_snapshot

Nodes = dict[int, tuple[int, float, float]]  # id -> kind, x, gain
Edges = dict[tuple[int, int], tuple[float, float, int]]  # a < b -> distance, risk, driven


def update(version: int, base: int, nodes: Nodes, edges: Edges, **removed: Any) -> Any:
    """A message as the mirror reads it."""
    ids, pairs = list(nodes), list(edges)
    return SimpleNamespace(
        irm_version=version,
        base_version=base,
        robot_node=min(ids, default=0),
        node_id=np.array(ids, np.int64),
        node_kind=np.array([nodes[i][0] for i in ids], np.uint8),
        node_xyz_m=np.array([(nodes[i][1], 0.0, 0.0) for i in ids], np.float64).reshape(-1, 3),
        node_gain=np.array([nodes[i][2] for i in ids], np.float64),
        node_coverage=np.zeros(len(ids), np.float32),
        edge_a=np.array([a for a, _ in pairs], np.int64),
        edge_b=np.array([b for _, b in pairs], np.int64),
        edge_distance_m=np.array([edges[p][0] for p in pairs], np.float64),
        edge_risk=np.array([edges[p][1] for p in pairs], np.float64),
        edge_driven=np.array([edges[p][2] for p in pairs], np.uint8),
        removed_node=np.array(removed.get("gone_nodes", []), np.int64),
        removed_edge=np.array(removed.get("gone_edges", []), np.int64).reshape(-1, 2),
    )


def same(a: RoadMap, b: RoadMap) -> bool:
    """Equal to the last bit and type."""
    columns: list[tuple[Any, Any]] = list(zip(a, b, strict=True))
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in columns)


def chain(*, gap: bool = False) -> tuple[Nodes, Edges]:
    """Breadcrumbs 1 - 2 - 3, 10 m apart, and a frontier 4 between 3 and breadcrumb 5."""
    nodes: Nodes = {i: (BREADCRUMB, 10.0 * i, 0.0) for i in (1, 2, 3, 5)}
    nodes[4] = (FRONTIER, 40.0, 2.5)
    edges: Edges = {
        (1, 2): (10.0, 0.1, 1),
        (2, 3): (11.0, 0.2, 0),
        (3, 4): (12.0, 0.0, 0),
        (4, 5): (1.0, 0.0, 0),
    }
    if gap:
        del edges[2, 3]
    return nodes, edges


def test_whole_graph_in_csr_form() -> None:
    mirror = GraphMirror()
    assert mirror.apply(update(7, 0, *chain()))
    road_map = mirror.road_map()
    assert mirror.version == 7
    assert road_map.node_id.tolist() == [1, 2, 3, 4, 5]
    assert road_map.indptr.tolist() == [0, 1, 3, 5, 7, 8]
    assert road_map.indices.tolist() == [1, 0, 2, 1, 3, 2, 4, 3]
    assert road_map.distance_m.tolist() == [10, 10, 11, 11, 12, 12, 1, 1]
    assert road_map.driven.tolist() == [1, 1, 0, 0, 0, 0, 0, 0]
    assert road_map.index_of(5) == 4
    assert road_map.index_of(6) == -1
    assert road_map.nearest_breadcrumb((39.0, 0.0, 0.0)) == 2


def test_travel_ends_at_frontiers() -> None:
    mirror = GraphMirror()
    mirror.apply(update(1, 0, *chain()))
    travel, parent = mirror.road_map().travel_from(0)
    assert travel[:4].tolist() == [0, 10, 21, 33]
    assert np.isinf(travel[4])
    assert parent.tolist() == [-1, 0, 1, 2, -1]


def test_travel_starts_at_a_frontier() -> None:
    mirror = GraphMirror()
    mirror.apply(update(1, 0, *chain()))
    assert mirror.road_map().travel_from(3)[0].tolist() == [33, 23, 12, 0, 1]


def test_a_difference_to_another_version_is_refused() -> None:
    mirror = GraphMirror()
    nodes, edges = chain()
    assert not mirror.apply(update(3, 2, nodes, edges))
    assert mirror.version == 0
    mirror.apply(update(3, 0, nodes, edges))
    before = mirror.road_map()
    assert not mirror.apply(update(5, 4, {}, {}, gone_nodes=[1]))
    assert mirror.version == 3
    assert same(before, mirror.road_map())
    assert mirror.apply(update(5, 0, *chain(gap=True)))
    assert mirror.road_map().indices.size == 6


def test_a_message_that_contradicts_itself_is_refused() -> None:
    nodes, edges = chain()
    mirror = GraphMirror()
    assert not mirror.apply(update(1, 0, nodes, {**edges, (5, 9): (1.0, 0.0, 0)}))
    assert not mirror.apply(update(1, 0, nodes, {**edges, (2, 1): (1.0, 0.0, 0)}))
    twice = update(1, 0, nodes, edges)
    twice.edge_b[1], twice.edge_a[1] = 2, 1
    assert not mirror.apply(twice)
    twin = update(1, 0, nodes, {})
    twin.node_id[1] = twin.node_id[0]
    assert not mirror.apply(twin)
    assert mirror.version == 0


def test_a_removed_node_takes_its_edges_along() -> None:
    mirror = GraphMirror()
    mirror.apply(update(1, 0, *chain()))
    assert mirror.apply(update(2, 1, {}, {}, gone_nodes=[2]))
    assert mirror.road_map().node_id.tolist() == [1, 3, 4, 5]
    assert mirror.road_map().indices.size == 4


def test_empty_graph() -> None:
    road_map = GraphMirror().road_map()
    assert road_map.nearest_breadcrumb((0.0, 0.0, 0.0)) == -1
    assert road_map.index_of(0) == -1
    assert road_map.indptr.tolist() == [0]


_NODE = st.tuples(st.sampled_from([BREADCRUMB, FRONTIER]), st.floats(-50, 50), st.floats(0, 9))
_EDGE = st.tuples(st.floats(0, 20), st.floats(0, 1), st.integers(0, 1))


@st.composite
def histories(draw: st.DrawFn) -> list[tuple[Nodes, Edges]]:
    """Some graphs, one after the other."""
    graphs = []
    for _ in range(draw(st.integers(1, 5))):
        nodes = draw(st.dictionaries(st.integers(0, 12), _NODE, max_size=10))
        pairs = [(a, b) for a in nodes for b in nodes if a < b]
        chosen = draw(st.dictionaries(st.sampled_from(pairs), _EDGE, max_size=15)) if pairs else {}
        graphs.append((nodes, chosen))
    return graphs


def difference(version: int, old: tuple[Nodes, Edges], new: tuple[Nodes, Edges]) -> Any:
    nodes = {i: n for i, n in new[0].items() if old[0].get(i) != n}
    edges = {p: e for p, e in new[1].items() if old[1].get(p) != e}
    gone_nodes = [i for i in old[0] if i not in new[0]]
    gone_edges = [p for p in old[1] if p not in new[1]]
    return update(version, version - 1, nodes, edges, gone_nodes=gone_nodes, gone_edges=gone_edges)


@settings(max_examples=60, deadline=None)
@given(histories())
def test_differences_give_the_whole_graph(graphs: list[tuple[Nodes, Edges]]) -> None:
    mirror = GraphMirror()
    mirror.apply(update(1, 0, *graphs[0]))
    for version, (old, new) in enumerate(pairwise(graphs), start=2):
        assert mirror.apply(difference(version, old, new))
        whole = GraphMirror()
        assert whole.apply(update(version, 0, *new))
        assert same(mirror.road_map(), whole.road_map())
    restored = GraphMirror()
    restored.restore(unpack_snapshot(pack_snapshot(mirror.snapshot())))
    assert same(restored.road_map(), mirror.road_map())
    assert (restored.version, restored.robot_node) == (mirror.version, mirror.robot_node)

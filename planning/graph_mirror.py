"""A reader's copy of the Global IRM: applies whole graphs and differences, and gives the graph in CSR form.

Columns instead of objects: nodes sorted by id, edges by (a, b), so that equal graphs have equal bytes
whatever the order in which they were received. What a difference names is found by bisection; the rest of a graph of
100,000 nodes is copied as blocks of memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import dijkstra_csr

BREADCRUMB = 0
FRONTIER = 1

_NODE_COLUMNS = {
    "node_kind": "uint8",
    "node_xyz_m": "float64",
    "node_gain": "float64",
    "node_coverage": "float32",
}
_MAX_ID = 2**26
"""Ids are counted up from 1; a larger one is an error in the message, not a graph of this size."""
_EDGE_COLUMNS = {"edge_distance_m": "float64", "edge_risk": "float64", "edge_driven": "uint8"}


class GraphUpdate(Protocol):
    """What the mirror reads of a Global IRM message; fields as there (`schemas.world.GlobalIrm`)."""

    @property
    def irm_version(self) -> int: ...
    @property
    def base_version(self) -> int: ...
    @property
    def robot_node(self) -> int: ...
    @property
    def node_id(self) -> NDArray[Any]: ...
    @property
    def edge_a(self) -> NDArray[Any]: ...
    @property
    def edge_b(self) -> NDArray[Any]: ...
    @property
    def removed_node(self) -> NDArray[Any]: ...
    @property
    def removed_edge(self) -> NDArray[Any]: ...


class RoadMap(NamedTuple):
    """The Global IRM as arrays; node index i stands for `node_id[i]`, ids ascending.

    kind: (n,) 0 breadcrumb, 1 frontier. xyz_m: (n, 3) in `map`. gain: (n,) nats of whole patches.
    coverage: (n,) probability. indptr, indices: (n + 1,), (e,) int32, both directions of every edge, neighbours
    ascending. distance_m, risk, driven: (e,) of the directed edges.
    """

    node_id: NDArray[np.int64]
    kind: NDArray[np.uint8]
    xyz_m: NDArray[np.float64]
    gain: NDArray[np.float64]
    coverage: NDArray[np.float32]
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    distance_m: NDArray[np.float64]
    risk: NDArray[np.float64]
    driven: NDArray[np.uint8]

    def index_of(self, node: int) -> int:
        """Index of a node id, or -1."""
        place = int(np.searchsorted(self.node_id, node))
        return place if place < self.node_id.size and int(self.node_id[place]) == node else -1

    def nearest_breadcrumb(self, xyz_m: tuple[float, float, float]) -> int:
        """Index of the breadcrumb nearest to a point by straight line, -1 when there is none (lowest id
        wins).
        """
        crumbs = np.flatnonzero(self.kind == BREADCRUMB)
        if crumbs.size == 0:
            return -1
        offset = self.xyz_m[crumbs] - np.asarray(xyz_m, dtype=np.float64)
        return int(crumbs[int(np.argmin((offset * offset).sum(axis=1)))])

    def travel_from(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Shortest travel from one node: ((n,) metres, inf where none; (n,) index of the node before, -1).

        A frontier may end a path but not lie on it: nothing is known of the ground behind it.
        """
        weights = self.distance_m.copy()
        rows = np.repeat(np.arange(self.node_id.size), np.diff(self.indptr))
        weights[(self.kind[rows] == FRONTIER) & (rows != index)] = np.inf
        cost = np.empty(self.node_id.size)
        parent = np.empty(self.node_id.size, np.int32)
        start = np.array([index], np.int32)
        dijkstra_csr(self.indptr, self.indices, weights, start, np.zeros(1), np.inf, cost, parent)
        return cost, parent


class GraphMirror:
    """A copy of the Global IRM kept by applying its messages.

    version: of the graph held, 0 when there is none. robot_node: id of the breadcrumb nearest to the robot.
    """

    def __init__(self) -> None:
        self.version = 0
        self.robot_node = 0
        self._node_id, self._nodes = _empty_nodes()
        self._edge, self._edges = _empty_edges()
        self._road_map: RoadMap | None = None

    def apply(self, update: GraphUpdate) -> bool:
        """Apply a whole graph (base_version 0) or a difference.

        Returns:
            False, with nothing changed, when the difference is not to the version held, or when the message
            contradicts itself (a node twice, an edge without its node): then ask for the whole graph.
        """
        whole = update.base_version == 0
        if not whole and update.base_version != self.version:
            return False
        if not well_formed(update):
            return False
        node_id, nodes = _empty_nodes() if whole else (self._node_id, self._nodes)
        edge, edges = _empty_edges() if whole else (self._edge, self._edges)
        node_id, nodes = _merge_nodes(node_id, nodes, update)
        edge, edges = _merge_edges(edge, edges, update)
        if not _among(node_id, np.concatenate((update.edge_a, update.edge_b))):
            return False
        self._node_id, self._nodes, self._edge, self._edges = node_id, nodes, edge, edges
        self.version, self.robot_node = update.irm_version, update.robot_node
        self._road_map = None
        return True

    def road_map(self) -> RoadMap:
        """The graph held, as arrays; the same object until the next `apply`."""
        if self._road_map is None:
            self._road_map = self._build()
        return self._road_map

    def _build(self) -> RoadMap:
        count, edges = self._node_id.size, self._edge.shape[0]
        index = _index_of(self._node_id)
        indptr, indices = np.zeros(count + 1, np.int32), np.empty(2 * edges, np.int32)
        order = np.empty(2 * edges, np.int64)
        _fill_csr(index[self._edge[:, 0]], index[self._edge[:, 1]], indptr, indices, order)
        both = {name: values[order] for name, values in self._edges.items()}
        return RoadMap(
            self._node_id,
            self._nodes["node_kind"],
            self._nodes["node_xyz_m"],
            self._nodes["node_gain"],
            self._nodes["node_coverage"],
            indptr,
            indices,
            both["edge_distance_m"],
            both["edge_risk"],
            both["edge_driven"],
        )

    def snapshot(self) -> dict[str, Any]:
        """Everything held: numbers and arrays."""
        columns = {"node_id": self._node_id, "edge": self._edge, **self._nodes, **self._edges}
        return {"version": self.version, "robot_node": self.robot_node, "columns": columns}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Hold what a snapshot held."""
        columns = snapshot["columns"]
        self.version, self.robot_node = int(snapshot["version"]), int(snapshot["robot_node"])
        self._node_id, self._edge = columns["node_id"], columns["edge"]
        self._nodes = {name: columns[name] for name in _NODE_COLUMNS}
        self._edges = {name: columns[name] for name in _EDGE_COLUMNS}
        self._road_map = None


_Columns = dict[str, NDArray[Any]]


def _empty_nodes() -> tuple[NDArray[np.int64], _Columns]:
    columns: _Columns = {name: np.empty(0, kind) for name, kind in _NODE_COLUMNS.items()}
    columns["node_xyz_m"] = np.empty((0, 3))
    return np.empty(0, np.int64), columns


def _empty_edges() -> tuple[NDArray[np.int64], _Columns]:
    return np.empty((0, 2), np.int64), {name: np.empty(0, kind) for name, kind in _EDGE_COLUMNS.items()}


def _merge_nodes(
    held: NDArray[np.int64], columns: _Columns, update: GraphUpdate
) -> tuple[NDArray[np.int64], _Columns]:
    return _merge(held, held, columns, update.removed_node, update.node_id, update.node_id, update)


def _merge_edges(
    held: NDArray[np.int64], columns: _Columns, update: GraphUpdate
) -> tuple[NDArray[np.int64], _Columns]:
    """Removed edges, edges of removed nodes, and edges that come anew give way before the new ones enter."""
    new = np.column_stack((update.edge_a, update.edge_b)).astype(np.int64).reshape(-1, 2)
    removed = _keys(update.removed_edge.reshape(-1, 2).astype(np.int64))
    if update.removed_node.size:
        # Few nodes go at once (frontiers); a graph in which many do is compared as a whole.
        removed = np.concatenate((removed, _keys(held[np.isin(held, update.removed_node).any(axis=1)])))
    return _merge(held, _keys(held), columns, removed, new, _keys(new), update)


def _keys(edge: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each pair of ids, in the order of the pairs."""
    return (edge[:, 0] << 32) + edge[:, 1]


def _merge(
    held: NDArray[np.int64],
    keys: NDArray[np.int64],
    columns: _Columns,
    removed: NDArray[np.int64],
    new: NDArray[np.int64],
    new_keys: NDArray[np.int64],
    update: GraphUpdate,
) -> tuple[NDArray[np.int64], _Columns]:
    """Rows sorted by `keys` (n,): without the removed ones, with the new ones in place of those of the same key."""
    order = np.argsort(new_keys, kind="stable")
    gone = _rows_of(keys, np.concatenate((removed, new_keys)))
    kept = np.delete(keys, gone)
    at = np.searchsorted(kept, new_keys[order])
    merged = {
        name: np.insert(np.delete(values, gone, axis=0), at, getattr(update, name)[order], axis=0)
        for name, values in columns.items()
    }
    return np.insert(np.delete(held, gone, axis=0), at, new[order], axis=0), merged


def _rows_of(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of ascending keys that are among the wanted ones."""
    rows = np.searchsorted(keys, wanted)
    rows = rows[rows < keys.size] if rows.size else rows
    inside = np.searchsorted(keys, wanted) < keys.size
    return np.unique(rows[keys[rows] == wanted[inside]])


def well_formed(update: GraphUpdate) -> bool:
    """No node twice; every edge once, from a lower to a higher id; ids that two fit into 64 bits."""
    edge = np.column_stack((update.edge_a, update.edge_b)).astype(np.int64).reshape(-1, 2)
    ids = np.concatenate((update.node_id, edge.ravel()))
    if ids.size and (int(ids.min()) < 0 or int(ids.max()) >= _MAX_ID):
        return False
    twice = np.unique(update.node_id).size < update.node_id.size or np.unique(_keys(edge)).size < len(edge)
    return not twice and bool((edge[:, 0] < edge[:, 1]).all())


def _among(ascending: NDArray[np.int64], wanted: NDArray[np.int64]) -> bool:
    """Whether all of the wanted ids are there."""
    rows = np.searchsorted(ascending, wanted)
    return bool((rows < ascending.size).all()) and bool((ascending[rows] == wanted).all())


def _index_of(node_id: NDArray[np.int64]) -> NDArray[np.int32]:
    """(largest id + 1,): index of each id. Ids are given one after the other, so that this is no larger than life."""
    index = np.zeros(int(node_id[-1]) + 1 if node_id.size else 0, np.int32)
    index[node_id] = np.arange(node_id.size, dtype=np.int32)
    return index


@njit
def _fill_csr(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    order: NDArray[np.int64],
) -> None:
    """Both directions of edges a < b that are sorted by (a, b), rows ascending; order: (2 e,) the edge of each entry.

    Of a node's neighbours the smaller ones come first (edges that end at it, by a), then the larger ones.
    """
    edges = a.shape[0]
    for e in range(edges):
        indptr[a[e] + 1] += 1
        indptr[b[e] + 1] += 1
    for node in range(indptr.shape[0] - 1):
        indptr[node + 1] += indptr[node]
    fill = indptr[:-1].copy()
    for e in range(edges):
        indices[fill[b[e]]], order[fill[b[e]]] = a[e], e
        fill[b[e]] += 1
    for e in range(edges):
        indices[fill[a[e]]], order[fill[a[e]]] = b[e], e
        fill[a[e]] += 1

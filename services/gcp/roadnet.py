"""The Global IRM as gcp keeps it: a road net whose upkeep costs what a message changes, not what has been driven."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from planning.graph_mirror import FRONTIER, GraphUpdate, well_formed
from planning.reward import RewardWeights
from services.gcp.net import Floats, Slots, drop_edges, drop_node, empty_net, move_pool, put_edges
from services.gcp.qmdp import edge_terms

CELL_M = 16.0
"""Side of the cells by which nodes are found around a place."""


class IrmUpdate(GraphUpdate, Protocol):
    """What gcp reads of a Global IRM message; fields as there (`schemas.world.GlobalIrm`)."""

    @property
    def node_kind(self) -> NDArray[Any]: ...
    @property
    def node_xyz_m(self) -> NDArray[Any]: ...
    @property
    def node_gain(self) -> NDArray[Any]: ...
    @property
    def edge_distance_m(self) -> NDArray[Any]: ...
    @property
    def edge_risk(self) -> NDArray[Any]: ...


class RoadNet:
    """The Global IRM kept by applying its messages.

    version: of the graph held, 0 when there is none. robot_node: id of the breadcrumb nearest to the robot.
    xyz_m: (n, 3), raw_gain: (n,) nats of whole patches; by slot. frontiers: slot of each frontier by its id.
    touched: slots in which something changed since it was last emptied; renewed: the graph came whole.
    """

    def __init__(self, weights: RewardWeights) -> None:
        self.weights = weights
        self.version, self.robot_node = 0, 0
        self._clear()

    def _clear(self, nodes: int = 0, edges: int = 0) -> None:
        slots = max(64, 2 * nodes)
        self.net = empty_net(slots, max(256, 4 * edges + 4 * slots))
        self.xyz_m, self.raw_gain = np.zeros((slots, 3)), np.zeros(slots)
        self._slot_of = np.full(max(256, slots), -1, np.int32)
        self._free: list[int] = []
        self._next, self._used = 0, 0
        self._cells: dict[tuple[int, int], set[int]] = {}
        self.frontiers: dict[int, int] = {}
        self._in_order: Slots | None = None
        self.touched: set[int] = set()
        self.renewed = True

    @property
    def slots(self) -> int:
        """How many slots the arrays have."""
        return self.net.node_id.size

    def slot_of(self, node: int) -> int:
        """Slot of a node id, -1 when it is not there."""
        return int(self._slot_of[node]) if 0 <= node < self._slot_of.size else -1

    def apply(self, update: IrmUpdate) -> bool:
        """Apply a whole graph (base_version 0) or a difference.

        Returns:
            False, with nothing changed, when the difference is not to the version held, or when the message
            contradicts itself (a node twice, an edge without its node): then ask for the whole graph.
        """
        whole = update.base_version == 0
        if not whole and update.base_version != self.version:
            return False
        if not well_formed(update) or not self._complete(update, whole):
            return False
        if whole:
            self._clear(update.node_id.size, update.edge_a.size)
        self._remove(update)
        self._put_nodes(update)
        self._put_edges(update)
        self.version, self.robot_node = update.irm_version, update.robot_node
        return True

    def _complete(self, update: IrmUpdate, whole: bool) -> bool:
        """Whether every edge of the message will have its nodes."""
        ends = np.unique(np.concatenate((update.edge_a, update.edge_b)))
        here = np.isin(ends, update.node_id)
        if not whole:
            held = np.array([self.slot_of(int(node)) >= 0 for node in ends], np.bool_)
            here |= held & ~np.isin(ends, update.removed_node)
        return bool(here.all())

    def _remove(self, update: IrmUpdate) -> None:
        for node in update.removed_node.tolist():
            slot = self.slot_of(node)
            if slot >= 0:
                first = int(self.net.begin[slot])
                self.touched |= {slot, *self.net.other[first : first + int(self.net.degree[slot])].tolist()}
                self._leave_cell(slot)
                self._set_frontier(node, None)
                drop_node(self.net, slot)
                self._slot_of[node] = -1
                self._free.append(slot)
        edge = update.removed_edge.reshape(-1, 2)
        if edge.size:
            a, b = self._slots(edge[:, 0]), self._slots(edge[:, 1])
            drop_edges(self.net, a, b)
            self.touched |= {*a.tolist(), *b.tolist()} - {-1}

    def _slots(self, nodes: NDArray[Any]) -> Slots:
        return np.array([self.slot_of(node) for node in nodes.tolist()], np.int32)

    def _put_nodes(self, update: IrmUpdate) -> None:
        if not update.node_id.size:
            return
        self._make_room(int(update.node_id.max()), update.node_id.size)
        gains = self.weights.k_information * update.node_gain
        columns = zip(
            update.node_id.tolist(), update.node_kind.tolist(), update.node_xyz_m.tolist(),
            update.node_gain.tolist(), gains.tolist(), strict=True,
        )  # fmt: skip
        for node, kind, xyz, raw, gain in columns:
            slot = self.slot_of(node)
            if slot < 0:
                slot = self._new_slot(node)
            elif self.xyz_m[slot].tolist() != xyz:
                self._leave_cell(slot)
            self.xyz_m[slot], self.raw_gain[slot] = xyz, raw
            self.net.terminal[slot], self.net.gain[slot] = kind == FRONTIER, gain
            self._cells.setdefault(_cell(xyz), set()).add(slot)
            self._set_frontier(node, slot if kind == FRONTIER else None)
            self.touched.add(slot)

    def _set_frontier(self, node: int, slot: int | None) -> None:
        """Note that a node is a frontier, or not (any more)."""
        if self.frontiers.get(node) == slot:
            return
        self._in_order = None
        if slot is None:
            del self.frontiers[node]
        else:
            self.frontiers[node] = slot

    def _new_slot(self, node: int) -> int:
        slot = self._free.pop() if self._free else self._next
        self._next = max(self._next, slot + 1)
        self._slot_of[node] = slot
        self.net.node_id[slot] = node
        return slot

    def _make_room(self, largest: int, more: int) -> None:
        """Room for ids up to the largest (they are given one after the other) and for more nodes."""
        if largest >= self._slot_of.size:
            self._slot_of = _longer(self._slot_of, 2 * largest, -1)
        if self._next + more > self.slots:
            slots = 2 * (self._next + more)
            names = ("terminal", "gain", "begin", "degree", "room")
            longer = {name: _longer(getattr(self.net, name), slots, 0) for name in names}
            self.net = self.net._replace(node_id=_longer(self.net.node_id, slots, -1), **longer)
            self.xyz_m, self.raw_gain = _longer(self.xyz_m, slots, 0), _longer(self.raw_gain, slots, 0)

    def _leave_cell(self, slot: int) -> None:
        self._cells[_cell(self.xyz_m[slot].tolist())].discard(slot)

    def _put_edges(self, update: IrmUpdate) -> None:
        if not update.edge_a.size:
            return
        w = self.weights
        distance_m = np.asarray(update.edge_distance_m, np.float64)
        risk = np.asarray(update.edge_risk, np.float64)
        # Paper: C = k_d d + k_rho rho + k_mu mu, with mu = 0 as headings are not in the state.
        cost = w.k_cost * (w.k_distance_per_m * distance_m + w.k_risk * risk)
        terms, home = (
            edge_terms(distance_m, risk, cost, w.gamma_per_m),
            edge_terms(distance_m, risk, cost, 1.0),
        )
        columns = np.stack((distance_m, risk, terms.discount, terms.cost, home.cost))
        a, b = self._slots(update.edge_a), self._slots(update.edge_b)
        first = 0
        while first < a.size:
            first, self._used = put_edges(self.net, a, b, columns, first, self._used)
            if first < a.size:
                self._grow_pool()
        self.touched |= {*a.tolist(), *b.tolist()}

    def _grow_pool(self) -> None:
        pool = empty_net(0, 2 * self.net.other.size)
        self._used = move_pool(self.net, pool)
        names = ("other", "distance_m", "risk", "discount", "cost", "home_cost")
        self.net = self.net._replace(**{name: getattr(pool, name) for name in names})

    def near(self, xyz_m: Floats, radius_m: float) -> Slots:
        """Slots of the nodes within a radius, by their ids."""
        slots = np.fromiter(itertools.chain.from_iterable(self._cells_around(xyz_m, radius_m)), np.int32)
        inside = slots[np.square(self.xyz_m[slots] - xyz_m).sum(axis=1) <= radius_m**2]
        return inside[np.argsort(self.net.node_id[inside])]

    def _cells_around(self, xyz_m: Floats, radius_m: float) -> Iterator[set[int]]:
        low, high = _cell((xyz_m - radius_m).tolist()), _cell((xyz_m + radius_m).tolist())
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) > len(self._cells):
            yield from self._cells.values()
            return
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                yield self._cells.get((x, y), set())

    def nearest_breadcrumb(self, xyz_m: Floats) -> int:
        """Slot of the breadcrumb nearest to a place by straight line, -1 when there is none (lowest id wins)."""
        crumbs = np.flatnonzero((self.net.node_id >= 0) & ~self.net.terminal)
        if crumbs.size == 0:
            return -1
        crumbs = crumbs[np.argsort(self.net.node_id[crumbs])]
        offset = self.xyz_m[crumbs] - xyz_m
        return int(crumbs[int(np.argmin((offset * offset).sum(axis=1)))])

    def frontier_slots(self) -> Slots:
        """Slots of the frontiers, by their ids."""
        if self._in_order is None:
            self._in_order = np.array([self.frontiers[node] for node in sorted(self.frontiers)], np.int32)
        return self._in_order

    def pays(self, slots: Slots) -> Floats:
        """What nodes pay on arrival, -inf: they are no frontiers."""
        return np.where(self.net.terminal[slots], self.net.gain[slots], -np.inf)

    def snapshot(self) -> dict[str, Any]:
        """Everything held: numbers and arrays, nodes by id, edges by (a, b)."""
        live = np.flatnonzero(self.net.node_id >= 0)
        live = live[np.argsort(self.net.node_id[live])]
        places = [
            place
            for slot in live.tolist()
            for place in range(int(self.net.begin[slot]), int(self.net.begin[slot] + self.net.degree[slot]))
        ]
        source = self.net.node_id[np.repeat(live, self.net.degree[live])]
        target = self.net.node_id[self.net.other[places]] if places else source
        once = np.array(places, np.int64)[source < target]
        columns = {
            "node_id": self.net.node_id[live],
            "node_kind": self.net.terminal[live].astype(np.uint8) * np.uint8(FRONTIER),
            "node_xyz_m": self.xyz_m[live],
            "node_gain": self.raw_gain[live],
            "edge": np.column_stack((source, target))[source < target],
            "edge_distance_m": self.net.distance_m[once],
            "edge_risk": self.net.risk[once],
        }
        return {"version": self.version, "robot_node": self.robot_node, "columns": columns}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Hold what a snapshot held."""
        columns = snapshot["columns"]
        nothing = np.empty(0, np.int64)
        graph = Graph(
            int(snapshot["version"]), 0, int(snapshot["robot_node"]), columns["node_id"], columns["node_kind"],
            columns["node_xyz_m"], columns["node_gain"], columns["edge"][:, 0], columns["edge"][:, 1],
            columns["edge_distance_m"], columns["edge_risk"], nothing, nothing.reshape(0, 2),
        )  # fmt: skip
        self.apply(graph)


class Graph(NamedTuple):
    """What a message says: a whole graph (base_version 0), or a difference."""

    irm_version: int
    base_version: int
    robot_node: int
    node_id: NDArray[Any]
    node_kind: NDArray[Any]
    node_xyz_m: NDArray[Any]
    node_gain: NDArray[Any]
    edge_a: NDArray[Any]
    edge_b: NDArray[Any]
    edge_distance_m: NDArray[Any]
    edge_risk: NDArray[Any]
    removed_node: NDArray[Any]
    removed_edge: NDArray[Any]


def _cell(xyz_m: list[float]) -> tuple[int, int]:
    return int(xyz_m[0] // CELL_M), int(xyz_m[1] // CELL_M)


def _longer(array: NDArray[Any], size: int, fill: int) -> NDArray[Any]:
    """The array with more rows, filled."""
    longer = np.full((size, *array.shape[1:]), fill, array.dtype)
    longer[: len(array)] = array
    return longer

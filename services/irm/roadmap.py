"""The Global IRM: breadcrumbs, frontiers and the edges between them, in `map` (Algorithm 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from planning.grid import LETHAL
from planning.kernels import njit
from planning.search import dijkstra_box
from schemas.base import Pose
from schemas.world import BREADCRUMB, FRONTIER, GlobalIrm
from services.irm.config import Config
from services.irm.frontiers import FrontierManager
from services.irm.window import Window

ROBOT = 0
"""Id of the node that stands for the robot itself; it moves along."""

_NO_TARGETS = np.empty((0, 2), np.int32)


@dataclass(slots=True)
class Roadmap:
    """Keeps the graph and knows what changed since the last message.

    graph: nodes with x, y, z, kind, gain, coverage; edges with distance, risk, driven. Node ids are never used twice.
    """

    config: Config
    graph: nx.Graph[Any] = field(default_factory=nx.Graph)
    manager: FrontierManager = field(init=False)
    next_id: int = 1
    version: int = 0
    last_breadcrumb: int = -1
    travelled_m: float = 0.0
    _published: dict[Any, tuple[Any, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.manager = FrontierManager(self.config)

    def update(
        self, window: Window, x_m: float, y_m: float, now_ns: int, elapsed_s: float, ground_m2: float = 0.0
    ) -> None:
        """One round: new breadcrumb, frontiers, edges near the robot. ground_m2: reachable ground known so far."""
        self.next_id = self.manager.update(window, (x_m, y_m), now_ns, elapsed_s, self.next_id, ground_m2)
        search = _Search(window)
        search.run(window.robot_cell, 3.0 * self.config.max_edge_m)
        self._place_robot(x_m, y_m)
        self._drop_breadcrumb(search, x_m, y_m)
        self._sync_frontiers()
        self._join_robot(search)
        self._join_frontiers(window)
        self._give_up_isolated(now_ns)
        self._review_edges(window)

    def _place_robot(self, x_m: float, y_m: float) -> None:
        if ROBOT in self.graph:
            self.graph.remove_edges_from(list(self.graph.edges(ROBOT)))
        self.graph.add_node(ROBOT, x=x_m, y=y_m, z=0.0, kind=BREADCRUMB, gain=0.0, coverage=1.0)

    def _drop_breadcrumb(self, search: _Search, x_m: float, y_m: float) -> None:
        """Add a breadcrumb when none is within d_b, joined to the nearest ones by travel."""
        spacing = self.config.breadcrumb_spacing_m
        near = self._near(x_m, y_m, self.config.max_edge_m, BREADCRUMB)
        if any(d < spacing for d, _ in near):
            closest = min(near)[1]
            if closest != self.last_breadcrumb:
                self._join_driven(self.last_breadcrumb, closest, search)
                self.last_breadcrumb = closest
            return
        node = self.next_id
        self.next_id += 1
        self.graph.add_node(node, x=x_m, y=y_m, z=0.0, kind=BREADCRUMB, gain=0.0, coverage=1.0)
        joined = 0
        for _, other in sorted(near):
            if joined >= self.config.edges_per_node:
                break
            joined += self._join(node, other, search)
        self._join_driven(self.last_breadcrumb, node, search)
        self.last_breadcrumb = node

    def _join_driven(self, a: int, b: int, search: _Search) -> None:
        """The robot itself went from a to b: that edge exists, whatever the search says."""
        if a < 0 or a == b or a not in self.graph or b not in self.graph:
            return
        d, rho = search.to(*self._place(a))
        straight = math.dist(self._place(a), self._place(b))
        if not math.isfinite(d) or d > 3.0 * straight + 2.0:
            d, rho = straight * 1.1, 0.05
        if straight <= 2.0 * self.config.max_edge_m:
            self.graph.add_edge(a, b, distance=max(d, straight), risk=rho, driven=1)

    def _join(self, a: int, b: int, search: _Search) -> bool:
        """Evaluate the edge a-b from the search that starts at a; add or remove it (Algorithm 1)."""
        d, rho = search.to(*self._place(b))
        if d < self.config.max_edge_m and rho < self.config.max_edge_risk:
            driven = self.graph.edges[a, b]["driven"] if self.graph.has_edge(a, b) else 0
            self.graph.add_edge(a, b, distance=max(d, 1e-3), risk=rho, driven=driven)
            return True
        known = search.knows(*self._place(b))
        if not (known and self.graph.has_edge(a, b)):
            return False
        # No way within the window is no evidence against a way that the robot has driven: it may lead around outside.
        if not self.graph.edges[a, b]["driven"] or search.obstacle_between(self._place(a), self._place(b)):
            self.graph.remove_edge(a, b)
        return False

    def _sync_frontiers(self) -> None:
        gone = [
            n
            for n, d in self.graph.nodes(data=True)
            if d["kind"] == FRONTIER and n not in self.manager.frontiers
        ]
        self.graph.remove_nodes_from(gone)
        for node, f in sorted(self.manager.frontiers.items()):
            self.graph.add_node(node, x=f.x_m, y=f.y_m, z=0.0, kind=FRONTIER, gain=f.gain, coverage=0.5)

    def _join_robot(self, search: _Search) -> None:
        """Edges from the robot to everything near that it can reach, so that no detour over breadcrumbs is seen."""
        x, y = self._place(ROBOT)
        for _, node in self._near(x, y, 2.0 * self.config.max_edge_m, None):
            d, rho = search.to(*self._place(node))
            if node != ROBOT and math.isfinite(d) and rho < self.config.max_edge_risk:
                self.graph.add_edge(ROBOT, node, distance=max(d, 1e-3), risk=rho, driven=0)
        anchor = self.last_breadcrumb
        if anchor >= 0 and not self.graph.has_edge(ROBOT, anchor):
            straight = math.dist((x, y), self._place(anchor))
            self.graph.add_edge(ROBOT, anchor, distance=max(1.1 * straight, 1e-3), risk=0.05, driven=1)

    def _join_frontiers(self, window: Window) -> None:
        """Frontiers that are new or have moved are joined to breadcrumbs, so that they stay when the robot leaves."""
        for node, f in sorted(self.manager.frontiers.items()):
            data = self.graph.nodes[node]
            place = data.get("joined_at")
            old = [n for n in self.graph.neighbors(node) if n != ROBOT]
            if old and place is not None and math.dist(place, (f.x_m, f.y_m)) < 0.5:
                continue
            cell = window.spec.cell_of(f.x_m, f.y_m)
            if not window.spec.contains(*cell):
                continue
            search = _Search(window)
            search.run(cell, self.config.max_edge_m)
            joined: set[int] = set()
            for _, other in sorted(self._near(f.x_m, f.y_m, self.config.max_edge_m, BREADCRUMB)):
                if other != ROBOT and len(joined) < 3 and self._join(node, other, search):
                    joined.add(other)
            if joined:  # else the risk map has forgotten the ground around it, which is no evidence
                self.graph.remove_edges_from([(node, n) for n in old if n not in joined])
            for other in old if not joined else []:
                if self.graph.has_edge(node, other):
                    edge = self.graph.edges[node, other]
                    edge["distance"] = max(edge["distance"], math.dist((f.x_m, f.y_m), self._place(other)))
            data["joined_at"] = (f.x_m, f.y_m)
            if (
                not joined
                and self.graph.has_edge(ROBOT, node)
                and self.graph.has_edge(ROBOT, self.last_breadcrumb)
            ):
                self._join_over_robot(node)

    def _give_up_isolated(self, now_ns: int) -> None:
        """Frontiers that no edge has led to for long cannot be planned for."""
        for node, f in sorted(self.manager.frontiers.items()):
            f.isolated = 0 if self.graph.degree(node) else f.isolated + 1
            if f.isolated > 3 * self.config.missed_rounds:
                self.manager.give_up(f, "no way over the graph", now_ns)
                self.graph.remove_node(node)

    def _join_over_robot(self, node: int) -> None:
        """No breadcrumb within d_e: join over the robot's place, which is within d_b of its last breadcrumb."""
        a, b = self.graph.edges[ROBOT, node], self.graph.edges[ROBOT, self.last_breadcrumb]
        rho = 1.0 - (1.0 - a["risk"]) * (1.0 - b["risk"])
        self.graph.add_edge(
            node, self.last_breadcrumb, distance=a["distance"] + b["distance"], risk=rho, driven=0
        )

    def _review_edges(self, window: Window) -> None:
        """Evaluate the edges of one nearby breadcrumb again, in turn: ground changes."""
        x, y = self._place(ROBOT)
        near = [n for _, n in sorted(self._near(x, y, 12.0, BREADCRUMB)) if n != ROBOT]
        if not near:
            return
        node = near[self.version % len(near)]
        search = _Search(window)
        cell = window.spec.cell_of(*self._place(node))
        if not window.spec.contains(*cell):
            return
        search.run(cell, self.config.max_edge_m)
        # Its neighbours and what lies nearest: an edge that went comes back when its ground is free again.
        around = sorted(self._near(*self._place(node), self.config.max_edge_m, BREADCRUMB))
        others = {n for _, n in around[: self.config.edges_per_node + 1]} | set(self.graph.neighbors(node))
        for other in sorted(others - {node, ROBOT}):
            if self.graph.nodes[other]["kind"] == BREADCRUMB:
                self._join(node, other, search)

    def _near(self, x_m: float, y_m: float, radius_m: float, kind: int | None) -> list[tuple[float, int]]:
        found = []
        for node, d in self.graph.nodes(data=True):
            if kind is None or d["kind"] == kind:
                distance = math.hypot(d["x"] - x_m, d["y"] - y_m)
                if distance <= radius_m and node != ROBOT:
                    found.append((distance, node))
        return found

    def _place(self, node: int) -> tuple[float, float]:
        data = self.graph.nodes[node]
        return data["x"], data["y"]

    def message(self, pose: Pose, map_to_odom: Pose, stamp_ns: int, whole: bool) -> GlobalIrm:
        """The graph as a message: whole, or what has changed since the last message."""
        whole = whole or not self._published
        before = {} if whole else self._published
        now = self._contents()
        nodes = [(k, v) for k, v in now.items() if isinstance(k, int) and before.get(k) != v]
        edges = [(k, v) for k, v in now.items() if isinstance(k, tuple) and before.get(k) != v]
        gone = [k for k in before if k not in now]
        base = 0 if whole else self.version
        self.version += 1
        self._published = now
        xyz = np.array([v[:3] for _, v in nodes], dtype=np.float64).reshape(-1, 3)
        return GlobalIrm(
            stamp_ns=stamp_ns,
            irm_version=self.version,
            base_version=base,
            robot_pose=pose,
            map_to_odom=map_to_odom,
            robot_node=ROBOT,
            node_id=np.array([k for k, _ in nodes], dtype=np.int64),
            node_kind=np.array([v[3] for _, v in nodes], dtype=np.uint8),
            node_xyz_m=xyz,
            node_gain=np.array([v[4] for _, v in nodes], dtype=np.float64),
            node_coverage=np.array([v[5] for _, v in nodes], dtype=np.float32),
            edge_a=np.array([k[0] for k, _ in edges], dtype=np.int64),
            edge_b=np.array([k[1] for k, _ in edges], dtype=np.int64),
            edge_distance_m=np.array([v[0] for _, v in edges], dtype=np.float64),
            edge_risk=np.array([v[1] for _, v in edges], dtype=np.float64),
            edge_driven=np.array([v[2] for _, v in edges], dtype=np.uint8),
            removed_node=np.array(sorted(k for k in gone if isinstance(k, int)), dtype=np.int64),
            removed_edge=np.array(sorted(k for k in gone if isinstance(k, tuple)), dtype=np.int64).reshape(
                -1, 2
            ),
        )

    def _contents(self) -> dict[Any, tuple[Any, ...]]:
        contents: dict[Any, tuple[Any, ...]] = {}
        for node, d in sorted(self.graph.nodes(data=True)):
            contents[node] = (d["x"], d["y"], d["z"], d["kind"], d["gain"], d["coverage"])
        for a, b, d in sorted((min(a, b), max(a, b), d) for a, b, d in self.graph.edges(data=True)):
            contents[(a, b)] = (d["distance"], d["risk"], d["driven"])
        return contents

    def breadcrumbs(self) -> int:
        """How many breadcrumbs there are."""
        return sum(1 for n, d in self.graph.nodes(data=True) if d["kind"] == BREADCRUMB and n != ROBOT)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "nodes": [[n, dict(d)] for n, d in sorted(self.graph.nodes(data=True))],
            "edges": sorted([min(a, b), max(a, b), dict(d)] for a, b, d in self.graph.edges(data=True)),
            **self._beside_graph(),
            "unpublished": self._unpublished(),
        }

    def _unpublished(self) -> list[list[Any]]:
        """What the last message said otherwise than the graph is now: [key, values], without values for what is new."""
        now = self._contents() if self._published else {}
        before = self._published
        differs = [[k, list(v)] for k, v in before.items() if now.get(k) != v]
        return differs + [[k, None] for k in now if k not in before]

    def _beside_graph(self) -> dict[str, Any]:
        return {
            "manager": self.manager.state(),
            "counters": [self.next_id, self.version, self.last_breadcrumb],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.graph = nx.Graph()
        self._set_parts(state)
        self._published = self._contents() if self.version > 0 else {}
        for key, values in state["unpublished"]:
            name = tuple(key) if isinstance(key, list) else key
            if values is None:
                del self._published[name]
            else:
                self._published[name] = tuple(values)

    def _set_parts(self, state: dict[str, Any]) -> None:
        """Nodes and edges are added or replaced, the rest is as in the state."""
        for node, data in state["nodes"]:
            if "joined_at" in data:
                data["joined_at"] = tuple(data["joined_at"])
            self.graph.add_node(node, **data)
        self.graph.add_edges_from((a, b, d) for a, b, d in state["edges"])
        self.manager.set_state(state["manager"])
        self.next_id, self.version, self.last_breadcrumb = state["counters"]
        self._published = {}

    def difference(self, message: GlobalIrm) -> dict[str, Any]:
        """What a message that was just made tells, with all that the graph keeps of it: for the journal."""
        edges = zip(message.edge_a.tolist(), message.edge_b.tolist(), strict=True)
        return {
            "whole": message.base_version == 0,
            "nodes": [[n, dict(self.graph.nodes[n])] for n in message.node_id.tolist()],
            "edges": [[a, b, dict(self.graph.edges[a, b])] for a, b in edges],
            "removed_nodes": message.removed_node.tolist(),
            "removed_edges": message.removed_edge.tolist(),
            **self._beside_graph(),
        }

    def apply_difference(self, difference: dict[str, Any]) -> None:
        """Take in a difference from the journal; the next message is whole."""
        if difference["whole"]:
            self.graph = nx.Graph()
        self.graph.remove_nodes_from(difference["removed_nodes"])
        self.graph.remove_edges_from((a, b) for a, b in difference["removed_edges"])
        self._set_parts(difference)


class _Search:
    """Distances and risks from one cell over the window."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._cost = np.full(window.spec.shape, np.inf)
        self._parent = np.full(window.spec.shape, -1, np.int32)

    def run(self, start: tuple[int, int], reach_m: float) -> None:
        """Search from a cell, up to `reach_m` away (straight)."""
        w = self._window
        row, column = start
        if not w.spec.contains(row, column):
            return
        cells = math.ceil(reach_m / w.spec.resolution_m)
        box = (row - cells, row + cells + 1, column - cells, column + cells + 1)
        dijkstra_box(
            w.step_cost, w.free_space, w.spec.resolution_m, row, column, box, _NO_TARGETS, 4.0 * reach_m,
            self._cost, self._parent,
        )  # fmt: skip

    def to(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(distance, rho) of the best path to a point; (inf, 1) when there is none."""
        cell = self._nearest_reached(x_m, y_m)
        if cell is None:
            return math.inf, 1.0
        s = self._window.spec
        distance, integral = path_totals(self._parent, self._window.hazard, s.resolution_m, cell[0], cell[1])
        return distance, 1.0 - math.exp(-integral)

    def knows(self, x_m: float, y_m: float) -> bool:
        """Whether the point lies in the window on known ground, so that 'no path' is evidence."""
        row, column = self._window.spec.cell_of(x_m, y_m)
        return self._window.spec.contains(row, column) and self._window.state[row, column] != 0

    def obstacle_between(self, a: tuple[float, float], b: tuple[float, float]) -> bool:
        """Whether a lethal cell lies on the straight line between two points."""
        spec, state = self._window.spec, self._window.state
        steps = max(1, math.ceil(2.0 * math.dist(a, b) / spec.resolution_m))
        for i in range(steps + 1):
            row, column = spec.cell_of(a[0] + (b[0] - a[0]) * i / steps, a[1] + (b[1] - a[1]) * i / steps)
            if spec.contains(row, column) and state[row, column] == LETHAL:
                return True
        return False

    def _nearest_reached(self, x_m: float, y_m: float) -> tuple[int, int] | None:
        row, column = self._window.spec.cell_of(x_m, y_m)
        height, width = self._cost.shape
        for reach in (0, 1, 2, 4):
            r0, r1 = max(0, row - reach), min(height, row + reach + 1)
            c0, c1 = max(0, column - reach), min(width, column + reach + 1)
            if r0 >= r1 or c0 >= c1:
                continue
            piece = self._cost[r0:r1, c0:c1]
            if np.isfinite(piece).any():
                index = int(np.argmin(piece))
                return r0 + index // piece.shape[1], c0 + index % piece.shape[1]
        return None


@njit
def path_totals(
    parent: NDArray[np.int32], hazard: NDArray[np.float32], resolution_m: float, row: int, column: int
) -> tuple[float, float]:
    """Length and hazard integral of the path to a cell, along the parents of a grid search."""
    width = parent.shape[1]
    distance, integral = 0.0, 0.0
    at = row * width + column
    while parent[at // width, at % width] >= 0:
        before = parent[at // width, at % width]
        diagonal = at // width != before // width and at % width != before % width
        step = resolution_m * (1.4142135623730951 if diagonal else 1.0)
        mean = 0.5 * (hazard[at // width, at % width] + hazard[before // width, before % width])
        distance += step
        integral += step * mean
        at = before
    return distance, integral

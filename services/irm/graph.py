"""The graph of the Global IRM: found by place, with what has changed since it was last told."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import networkx as nx
import numpy as np

from schemas.base import Pose
from schemas.world import BREADCRUMB, GlobalIrm
from services.irm.components import Components
from services.irm.keyframes import NOBODY
from services.irm.spatial import SpatialHash

ROBOT = 0
"""Id of the node that stands for the robot itself; it moves along."""

Key = int | tuple[int, int]


def edge_key(a: int, b: int) -> tuple[int, int]:
    """The name of an edge, whichever end comes first."""
    return min(a, b), max(a, b)


class RoadGraph:
    """Nodes with x, y, z, kind, gain, coverage; edges with distance, risk, driven. All changes go through here.

    Beside these an edge that was driven may have a way (see `set_way`).

    A round costs what it changes and what lies near, not what there is.
    """

    def __init__(self) -> None:
        self.graph: nx.Graph[Any] = nx.Graph()
        self.breadcrumbs = 0
        self._places = SpatialHash()
        self._components = Components()
        self._of_keyframe: dict[int, list[int]] = {}
        self._changed: set[Key] = set()
        self._new_ways: set[tuple[int, int]] = set()
        self._published: dict[Any, tuple[Any, ...]] = {}
        self._untold: set[tuple[int, int]] = set()
        self.shut: set[tuple[int, int]] = set()
        """Edges that lead through a fence: kept, but neither told nor gone along."""

    # --- nodes ------------------------------------------------------------------------------------------------

    def set_node(self, node: int, x: float, y: float, z: float, kind: int, gain: float, seen: float) -> None:
        """Add a node or replace what is known of it. seen: coverage probability."""
        is_crumb = kind == BREADCRUMB and node != ROBOT
        if is_crumb and node not in self.graph:
            self.breadcrumbs += 1
            self._components.add(node)
        self.graph.add_node(node, x=x, y=y, z=z, kind=kind, gain=gain, coverage=seen)
        if node != ROBOT:
            self._places.put(node, x, y)
        self._changed.add(node)

    def belong(self, node: int, keyframe: int, local: tuple[float, float]) -> None:
        """A breadcrumb's keyframe, and its place in that keyframe's frame, m."""
        self.graph.add_node(node, keyframe=keyframe, local=local)
        if keyframe != NOBODY:
            self._of_keyframe.setdefault(keyframe, []).append(node)

    def belonging(self, keyframes: Iterable[int]) -> list[int]:
        """The breadcrumbs of these keyframes, ascending."""
        return sorted(n for k in keyframes for n in self._of_keyframe.get(k, ()))

    def move(self, node: int, x: float, y: float) -> None:
        """Put a node elsewhere, its edges with it."""
        data = self.graph.nodes[node]
        data["x"], data["y"] = x, y
        self._places.put(node, x, y)
        self._changed.add(node)

    def drop_node(self, node: int) -> None:
        """Remove a frontier and its edges."""
        for other in list(self.graph.neighbors(node)):
            self.drop_edge(node, other)
        self.graph.remove_node(node)
        self._places.drop(node)
        self._changed.add(node)

    def place(self, node: int) -> tuple[float, float]:
        """(x, y) of a node, m."""
        data = self.graph.nodes[node]
        return data["x"], data["y"]

    def straight_m(self, a: int, b: int) -> float:
        """Straight distance between two nodes, in space."""
        p, q = self.graph.nodes[a], self.graph.nodes[b]
        return math.dist((p["x"], p["y"], p["z"]), (q["x"], q["y"], q["z"]))

    def near(
        self, x_m: float, y_m: float, z_m: float, radius_m: float, kind: int | None
    ) -> list[tuple[float, int]]:
        """(straight distance in space, node) of the nodes within a radius, nearest first; not the robot."""
        found = []
        for node in self._places.around(x_m, y_m, radius_m):
            d = self.graph.nodes[node]
            if kind is None or d["kind"] == kind:
                distance = math.hypot(d["x"] - x_m, d["y"] - y_m)
                if d["z"] != z_m:
                    distance = math.hypot(distance, d["z"] - z_m)
                if distance <= radius_m:
                    found.append((distance, node))
        return sorted(found)

    # --- edges ------------------------------------------------------------------------------------------------

    def set_edge(self, a: int, b: int, distance: float, risk: float, driven: int) -> None:
        """Add an edge or replace what is known of it."""
        is_new, key = not self.graph.has_edge(a, b), edge_key(a, b)
        self.graph.add_edge(a, b, distance=distance, risk=risk, driven=driven)
        self._changed.add(key)
        if key in self.shut:
            self._untold.add(key)
        if is_new and self._is_crumb(a) and self._is_crumb(b):
            self._components.join(a, b)

    def set_way(self, a: int, b: int, way: list[float]) -> None:
        """Where the robot went from a to b, as shares seen from them (`driven.seen_from`)."""
        if a > b:  # the line turned round: 1 - t along it, and -s across
            way = [1.0 - v if i % 2 == 0 else -v for i, v in enumerate(way)]
        self.graph.edges[a, b]["way"] = way
        self._new_ways.add(edge_key(a, b))

    def drop_edge(self, a: int, b: int) -> None:
        """Remove an edge."""
        key = edge_key(a, b)
        was_shut = key in self.shut
        self.graph.remove_edge(a, b)
        self.shut.discard(key)
        self._changed.add(key)
        if was_shut:
            self._untold.add(key)
        if not was_shut and self._is_crumb(a) and self._is_crumb(b):
            self._components.part(a, b, self._crumbs_beside)

    def shut_edges(self, edges: set[tuple[int, int]]) -> None:
        """These edges are shut from now on, and no others."""
        for a, b in sorted(edges - self.shut):
            self.shut.add((a, b))
            self._changed.add((a, b))
            if self._is_crumb(a) and self._is_crumb(b):
                self._components.part(a, b, self._crumbs_beside)
        for a, b in sorted(self.shut - edges):
            self.open_edge(a, b)

    def open_edge(self, a: int, b: int) -> None:
        """An edge is not shut any more."""
        key = edge_key(a, b)
        if key not in self.shut:
            return
        self.shut.discard(key)
        self._changed.add(key)
        if self._is_crumb(a) and self._is_crumb(b):
            self._components.join(a, b)

    def is_open(self, a: int, b: int) -> bool:
        """Whether an edge is not shut."""
        return not self.shut or edge_key(a, b) not in self.shut

    def _is_crumb(self, node: int) -> bool:
        return node != ROBOT and bool(self.graph.nodes[node]["kind"] == BREADCRUMB)

    def _crumbs_beside(self, node: int) -> list[int]:
        return [n for n in self.graph.neighbors(node) if self._is_crumb(n) and self.is_open(node, n)]

    def components_of(self, node: int) -> set[int]:
        """Which components of the breadcrumbs' graph a node is joined to, by numbers that hold until it changes."""
        return {self._components.label(n) for n in self._crumbs_beside(node)}

    def is_largest(self, components: set[int]) -> bool:
        """Whether the largest component of the breadcrumbs' graph is among these, or there is none yet."""
        largest = self._components.largest()
        return largest < 0 or largest in components

    def leads_to(self, frontier: int, components: set[int]) -> bool:
        """Whether a way leads from the robot, in these components, to a frontier; no other frontier may lie on it."""
        if self.graph.has_edge(ROBOT, frontier):
            return True
        beside = [n for n in self.graph.neighbors(frontier) if self.is_open(frontier, n)]
        return any(self._components.label(n) in components for n in beside)

    # --- what is told -----------------------------------------------------------------------------------------

    def message(self, version: int, pose: Pose, map_to_odom: Pose, stamp_ns: int, whole: bool) -> GlobalIrm:
        """The graph as message number `version`: whole, or what has changed since the last message."""
        whole = whole or not self._published
        before = {} if whole else self._published
        keys: Iterable[Key] = self._all_keys() if whole else self._changed
        now = {k: self._values(k) for k in keys if self._exists(k)}
        nodes = sorted((k, v) for k, v in now.items() if isinstance(k, int) and before.get(k) != v)
        edges = sorted((k, v) for k, v in now.items() if isinstance(k, tuple) and before.get(k) != v)
        gone = [] if whole else [k for k in self._changed if k in before and k not in now]
        if whole:
            self._published = now
        else:
            self._published.update(now)
            for key in gone:
                del self._published[key]
        self._changed = set()
        return GlobalIrm(
            stamp_ns=stamp_ns,
            irm_version=version,
            base_version=0 if whole else version - 1,
            robot_pose=pose,
            map_to_odom=map_to_odom,
            robot_node=ROBOT,
            node_id=np.array([k for k, _ in nodes], dtype=np.int64),
            node_kind=np.array([v[3] for _, v in nodes], dtype=np.uint8),
            node_xyz_m=np.array([v[:3] for _, v in nodes], dtype=np.float64).reshape(-1, 3),
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

    def _all_keys(self) -> Iterable[Key]:
        yield from self.graph.nodes
        yield from (edge_key(a, b) for a, b in self.graph.edges)

    def _exists(self, key: Key) -> bool:
        if isinstance(key, int):
            return key in self.graph
        return self.graph.has_edge(*key) and self.is_open(*key)

    def _values(self, key: Key) -> tuple[Any, ...]:
        if isinstance(key, tuple):
            d = self.graph.edges[key]
            return d["distance"], d["risk"], d["driven"]
        d = self.graph.nodes[key]
        return d["x"], d["y"], d["z"], d["kind"], d["gain"], d["coverage"]

    # --- snapshots --------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "nodes": [[n, dict(d)] for n, d in sorted(self.graph.nodes(data=True))],
            "edges": sorted([*edge_key(a, b), dict(d)] for a, b, d in self.graph.edges(data=True)),
            "unpublished": self._unpublished(),
        }

    def _unpublished(self) -> list[list[Any]]:
        """What the last message said otherwise than the graph is now: [key, values], without values for what is new."""
        before, found = self._published, []
        for key in sorted(self._changed, key=lambda k: k if isinstance(k, tuple) else (k, -1)):
            now = self._values(key) if self._exists(key) else None
            if before and now != before.get(key):
                found.append([key, list(before[key]) if key in before else None])
        return found

    def set_published(self, unpublished: list[list[Any]]) -> None:
        """All that the graph holds was told in the last message, but for this (see `state`)."""
        self._published = {k: self._values(k) for k in self._all_keys() if self._exists(k)}
        self._changed = set()
        for key, values in unpublished:
            name = tuple(key) if isinstance(key, list) else key
            self._changed.add(name)
            if values is None:
                del self._published[name]
            else:
                self._published[name] = tuple(values)

    def difference(self, message: GlobalIrm) -> dict[str, Any]:
        """What a message that was just made tells, with all that the graph keeps of it: for the journal."""
        whole = message.base_version == 0
        told = zip(message.edge_a.tolist(), message.edge_b.tolist(), strict=True)
        # No message tells of ways, nor of edges that are shut.
        others = self._new_ways | self._untold | (self.shut if whole else set())
        edges = sorted({*told, *(edge for edge in others if self.graph.has_edge(*edge))})
        removed = {*map(tuple, message.removed_edge.tolist()), *self._untold}
        self._new_ways, self._untold = set(), set()
        return {
            "whole": whole,
            "nodes": [[n, dict(self.graph.nodes[n])] for n in message.node_id.tolist()],
            "edges": [[a, b, dict(self.graph.edges[a, b])] for a, b in edges],
            "removed_nodes": message.removed_node.tolist(),
            "removed_edges": [list(e) for e in sorted(removed) if not self.graph.has_edge(*e)],
        }

    def apply_difference(self, difference: dict[str, Any]) -> None:
        """Take in a difference from the journal; the next message is whole."""
        for a, b in difference["removed_edges"]:
            if self.graph.has_edge(a, b):
                self.drop_edge(a, b)
        for node in difference["removed_nodes"]:
            if node in self.graph:
                self.drop_node(node)
        self.add_state(difference)
        self._published = {}

    def add_state(self, state: dict[str, Any]) -> None:
        """From a snapshot: nodes and edges are added or replaced."""
        for node, data in state["nodes"]:
            known = self.graph.nodes[node].get("keyframe", NOBODY) if node in self.graph else NOBODY
            d = dict(data)
            self.set_node(node, d["x"], d["y"], d["z"], d["kind"], d["gain"], d["coverage"])
            if "keyframe" in d and known == NOBODY:
                self.belong(node, d["keyframe"], (d["local"][0], d["local"][1]))
            if "joined_at" in d:
                self.graph.nodes[node]["joined_at"] = tuple(d["joined_at"])
        for a, b, d in state["edges"]:
            self.set_edge(a, b, d["distance"], d["risk"], d["driven"])
            if "way" in d:
                self.graph.edges[a, b]["way"] = d["way"]

"""The Global IRM: breadcrumbs, frontiers and the edges between them, in `map` (Algorithm 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np

from planning.fences import Placed
from planning.frames import Planar
from schemas.base import Pose
from schemas.world import BREADCRUMB, FRONTIER, GlobalIrm
from services.irm.config import Config
from services.irm.driven import REFUTED, REFUTED_WITHIN_M, Trail
from services.irm.driven import placed as placed_way
from services.irm.frontiers import ISOLATED, Frontier, FrontierManager
from services.irm.graph import ROBOT, RoadGraph, edge_key
from services.irm.keyframes import Anchor
from services.irm.out_of_reach import Place
from services.irm.search import Search, path_totals
from services.irm.window import Window

__all__ = ["ROBOT", "Roadmap", "path_totals"]

_FLOOR_M, _STACKED_M = 1.0, 2.0
"""Nodes so far apart in height and so near in the plane are on floors above one another: no edge joins them."""

_SHIFTED_M, _TORN_M = 0.05, 1.0
"""A closure that changes the distance of an edge's ends by more makes it longer; by still more ends it."""

_LEVEL_M = 0.1
"""Heights of frontiers change by such steps, so that the noise of the risk map is not told every second."""
_MOST_RISK = 0.95
"""Of an edge that was driven, however its ground looks now."""
_GUESSED_TIMES, _GUESSED_RISK = 1.3, 0.1
"""Length, against the straight line, and risk of an edge that nobody has looked for yet."""
_CUT_OFF_TIMES = 10
"""So many times longer frontiers are kept while the robot is cut off."""


@dataclass(slots=True)
class Roadmap:
    """Keeps the graph by Algorithm 1. Node ids are never used twice.

    A breadcrumb belongs to the keyframe that the robot was at when it was dropped, and moves along with it.
    """

    config: Config
    road: RoadGraph = field(default_factory=RoadGraph)
    manager: FrontierManager = field(init=False)
    next_id: int = 1
    version: int = 0
    last_breadcrumb: int = -1
    trail: Trail = field(default_factory=Trail)
    refuted: dict[tuple[int, int], int] = field(default_factory=dict)
    fences: Placed = field(default_factory=Placed)
    clear: set[tuple[int, int]] = field(default_factory=set)
    """Edges that were found under the fences that hold now: they lead around."""
    _moved: bool = False
    _back: list[int] = field(default_factory=list)
    _doubtful: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        self.manager = FrontierManager(self.config)

    @property
    def graph(self) -> nx.Graph[Any]:
        """Nodes with x, y, z, kind, gain, coverage; edges with distance, risk, driven. To be read only."""
        return self.road.graph

    def update(
        self,
        window: Window,
        x_m: float,
        y_m: float,
        now_ns: int,
        elapsed_s: float,
        ground_m2: float = 0.0,
        anchor: Anchor = Anchor(),  # noqa: B008
        doubtful: frozenset[int] = frozenset(),
    ) -> None:
        """One round: new breadcrumb, frontiers, edges near the robot.

        x_m, y_m: the robot in `map`. ground_m2: reachable ground known so far. anchor: the keyframe it is at. doubtful:
        keyframes whose place relative to it is not known well: what belongs to them may seem near and is not, so that
        nothing is joined to it, and no edge judged, before a closure tells.
        """
        self.next_id = self.manager.update(
            window, (x_m, y_m), now_ns, elapsed_s, self.next_id, ground_m2, anchor, doubtful
        )
        self._back += self.manager.take_back()
        self._doubtful = doubtful
        search = Search(window)
        search.run(window.robot_cell, 3.0 * self.config.max_edge_m)
        self._place_robot(window, x_m, y_m)
        self.trail.note(x_m, y_m)
        self._drop_breadcrumb(search, x_m, y_m, anchor)
        self._sync_frontiers(window)
        self._join_back(search)
        self._join_robot(search)
        self._join_frontiers(window)
        self._give_up_isolated(now_ns)
        self._review_edges(window)

    def fence(self, placed: Placed, changed: bool, reopened: list[Place]) -> None:
        """The fences as they lie in `map` now; changed: they are others than before. reopened: places behind fences
        that are gone. To be called before `update`.

        Edges through them are shut: kept, as a fence can be taken away, but not told to anybody.
        """
        moved = self._moved or placed is not self.fences
        self.fences, self._moved = placed, False
        self.next_id, back = self.manager.fence(placed, changed, reopened, self.next_id)
        self._back += back
        if changed:
            self.clear.clear()
        if changed or (moved and placed.shuts):
            self.road.shut_edges(self._edges_through(placed) if placed.shuts else set())

    def _edges_through(self, placed: Placed) -> set[tuple[int, int]]:
        """Edges between breadcrumbs and frontiers whose line meets what is shut, but for those found since."""
        keys: list[tuple[int, int]] = []
        lines: list[tuple[tuple[float, float], tuple[float, float]]] = []
        for a, b, edge in self.graph.edges(data=True):
            low, high = edge_key(a, b)
            if low == ROBOT or (low, high) in self.clear:
                continue
            ends = self.road.place(low), self.road.place(high)
            way = placed_way(*ends, edge["way"]) if edge.get("way") else [*ends]
            for p, q in pairwise(way):
                keys.append((low, high))
                lines.append((p, q))
        if not lines:
            return set()
        points = np.array(lines, dtype=np.float64)
        meets = placed.forbids_lines(points[:, 0], points[:, 1])
        return {keys[i] for i in np.flatnonzero(meets).tolist()}

    def _join_back(self, search: Search) -> None:
        """Frontiers that came back are joined to what lies near, as if there were a way: beside them it is seen.

        Not through what stands in between for all to see.
        """
        for node in [n for n in self._back if n in self.graph]:
            x, y = self.road.place(node)
            z = self.graph.nodes[node]["z"]
            # Of a place in doubt: to what is in doubt as well, which was seen on the same way.
            certain, reach_m = self._is_certain(node), 3.0 * self.config.max_edge_m
            around = self.road.near(x, y, z, reach_m, BREADCRUMB)
            for other in [n for _, n in around if self._is_certain(n) == certain][:3]:
                straight = max(self.road.straight_m(node, other), 1e-3)
                seen_shut = search.obstacle_on([(x, y), self.road.place(other)])
                if not self._is_fenced(node, other) and not seen_shut:
                    self.road.set_edge(node, other, _GUESSED_TIMES * straight, _GUESSED_RISK, 0)
        self._back = []

    def _is_fenced(self, a: int, b: int) -> bool:
        ends = np.array([self.road.place(a)]), np.array([self.road.place(b)])
        return self.fences.shuts and bool(self.fences.forbids_lines(*ends)[0])

    def follow(self, keyframes: dict[int, Planar]) -> None:
        """Move what belongs to keyframes that SLAM has moved (new poses in `map`)."""
        self.trail = Trail()
        self._moved = True
        frontiers = [n for n in self.manager.follow(keyframes) if n in self.graph]
        crumbs = self.road.belonging(keyframes)
        before = {
            edge_key(a, b): self.road.straight_m(a, b)
            for a in (*crumbs, *frontiers)
            for b in self.graph.neighbors(a)
        }
        for node in frontiers:
            self.road.move(node, self.manager.frontiers[node].x_m, self.manager.frontiers[node].y_m)
        for node in crumbs:
            data = self.graph.nodes[node]
            self.road.move(node, *keyframes[data["keyframe"]].apply(*data["local"]))
        for (a, b), straight_m in sorted(before.items()):
            self._stretch(a, b, straight_m)

    def _stretch(self, a: int, b: int, before_m: float) -> None:
        """The ends of an edge have moved: it was searched for between other places, or driven all the same."""
        edge, now_m = self.graph.edges[a, b], self.road.straight_m(a, b)
        if abs(now_m - before_m) <= _SHIFTED_M:
            return
        crumbs = {self.graph.nodes[n]["kind"] for n in (a, b)} == {BREADCRUMB} and ROBOT not in (a, b)
        torn = crumbs and abs(now_m - before_m) > _TORN_M
        if torn and (not edge["driven"] or now_m > self.config.max_edge_m):
            self.road.drop_edge(a, b)
        elif torn:  # it was not there that the robot drove
            self.road.set_edge(a, b, max(now_m, edge["distance"]), edge["risk"], 0)
        elif now_m > edge["distance"]:
            self.road.set_edge(a, b, now_m, edge["risk"], edge["driven"])

    def _place_robot(self, window: Window, x_m: float, y_m: float) -> None:
        height = window.height_m(x_m, y_m)
        if ROBOT in self.graph:
            for other in list(self.graph.neighbors(ROBOT)):
                self.road.drop_edge(ROBOT, other)
            height = self.graph.nodes[ROBOT]["z"] if height is None else height
        self.road.set_node(ROBOT, x_m, y_m, height or 0.0, BREADCRUMB, 0.0, 1.0)

    def _drop_breadcrumb(self, search: Search, x_m: float, y_m: float, anchor: Anchor) -> None:
        """Add a breadcrumb when none is within d_b, joined to the nearest ones by travel."""
        spacing, z_m = self.config.breadcrumb_spacing_m, self.graph.nodes[ROBOT]["z"]
        near = self._near(x_m, y_m, z_m, self.config.max_edge_m, BREADCRUMB)
        if near and near[0][0] < spacing:
            closest = near[0][1]
            if closest != self.last_breadcrumb:
                self._join_driven(self.last_breadcrumb, closest, search)
                self.last_breadcrumb = closest
            return
        node = self.next_id
        self.next_id += 1
        self.road.set_node(node, x_m, y_m, z_m, BREADCRUMB, 0.0, 1.0)
        self.road.belong(node, anchor.keyframe, anchor.local(x_m, y_m))
        joined = 0
        for _, other in near:
            if joined >= self.config.edges_per_node:
                break
            joined += self._join(node, other, search)
        self._join_driven(self.last_breadcrumb, node, search)
        self.last_breadcrumb = node

    def _join_driven(self, a: int, b: int, search: Search) -> None:
        """The robot itself went from a to b: that edge exists, whatever the search says."""
        if a < 0 or a == b or a not in self.graph or b not in self.graph:
            return
        d, rho = search.to(*self.road.place(a))
        straight = self.road.straight_m(a, b)
        if not math.isfinite(d) or d > 3.0 * straight + 2.0:
            d, rho = straight * 1.1, 0.05
        if straight <= 2.0 * self.config.max_edge_m:
            self.road.set_edge(a, b, max(d, straight), rho, 1)
            self.road.set_way(a, b, self.trail.hand_over(self.road.place(a), self.road.place(b)))

    def _join(self, a: int, b: int, search: Search) -> bool:
        """Evaluate the edge a-b from the search that starts at a; add or remove it (Algorithm 1)."""
        place, target = self.road.place(a), self.road.place(b)
        d, rho = search.to(*target)
        if d < self.config.max_edge_m and rho < self.config.max_edge_risk and not self._stacked(a, b):
            driven = self.graph.edges[a, b]["driven"] if self.graph.has_edge(a, b) else 0
            self.road.set_edge(a, b, self._climbed_m(a, b, d), rho, driven)
            self.refuted.pop(edge_key(a, b), None)
            if self.fences.shuts:
                self.road.open_edge(a, b)
                self.clear.add(edge_key(a, b))
            return True
        if not (self.graph.has_edge(a, b) and search.knows(*target)):
            return False
        if not self.road.is_open(a, b):
            return False  # that a fence is in the way says nothing of the ground
        held = self.graph.edges[a, b]
        if math.isfinite(d):
            self.refuted.pop(edge_key(a, b), None)
        if held["driven"] and d < 2.0 * self.config.max_edge_m and not self._stacked(a, b):
            # Riskier than thought, perhaps, but it leads there: the robot must not be cut off from where it came from.
            self.road.set_edge(a, b, self._climbed_m(a, b, d), min(rho, _MOST_RISK), 1)
            return True
        if d >= self.config.max_edge_m and not held["driven"] and self._may_lead(place, target, search):
            return False
        # No way within the window is no evidence against a way that the robot has driven: it may lead around outside.
        misplaced = search.is_lethal(*place) or search.is_lethal(*target)
        if not held["driven"] or (not misplaced and self._is_refuted(a, b, search)):
            self.road.drop_edge(a, b)
        return False

    def _may_lead(self, start: tuple[float, float], end: tuple[float, float], search: Search) -> bool:
        """Whether a way may lead over what the risk map has forgotten, at the start or between: no evidence."""
        return not search.knows(*start) or search.remembered_m(*end) < self.config.max_edge_m

    def _is_refuted(self, a: int, b: int, search: Search) -> bool:
        """Whether something stands, time after time, where the robot went from a to b."""
        edge = edge_key(a, b)
        low, high = (self.road.place(n) for n in edge)
        shares = self.graph.edges[edge].get("way")
        times = self.refuted.pop(edge, 0) + 1
        if not search.obstacle_on(placed_way(low, high, shares) if shares else [low, high], REFUTED_WITHIN_M):
            return False
        if times < REFUTED:
            self.refuted[edge] = times
        return times >= REFUTED

    def _stacked(self, a: int, b: int) -> bool:
        """Whether two nodes lie on floors above one another."""
        climb = abs(self.graph.nodes[a]["z"] - self.graph.nodes[b]["z"])
        return climb > _FLOOR_M and math.dist(self.road.place(a), self.road.place(b)) < _STACKED_M

    def _climbed_m(self, a: int, b: int, distance_m: float) -> float:
        """Length in space of a way whose length in the plane is known."""
        climb = abs(self.graph.nodes[a]["z"] - self.graph.nodes[b]["z"])
        if climb == 0.0:
            return max(distance_m, 1e-3)
        return max(math.hypot(distance_m, climb), self.road.straight_m(a, b))

    def _sync_frontiers(self, window: Window) -> None:
        """The frontier nodes that the manager has changed."""
        for node in sorted(self.manager.take_changes()):
            f = self.manager.frontiers.get(node)
            if f is not None:
                worth = f.gain * self.fences.boost(f.x_m, f.y_m)
                self.road.set_node(node, f.x_m, f.y_m, self._level_m(window, f), FRONTIER, worth, 0.5)
            elif node in self.graph:
                self.road.drop_node(node)

    def _level_m(self, window: Window, frontier: Frontier) -> float:
        """Height of a frontier: of the ground there where it is known, else of what was known, else of the robot."""
        node, seen = frontier.node_id, window.height_m(frontier.x_m, frontier.y_m)
        held = float(self.graph.nodes[node]["z"]) if node in self.graph else None
        if seen is None:
            return float(self.graph.nodes[ROBOT]["z"]) if held is None else held
        return seen if held is None or abs(seen - held) > _LEVEL_M else held

    def _join_robot(self, search: Search) -> None:
        """Edges from the robot to everything near that it can reach, so that no detour over breadcrumbs is seen."""
        x, y = self.road.place(ROBOT)
        z = self.graph.nodes[ROBOT]["z"]
        for _, node in self._near(x, y, z, 2.0 * self.config.max_edge_m, None):
            d, rho = search.to(*self.road.place(node))
            if math.isfinite(d) and rho < self.config.max_edge_risk and not self._stacked(ROBOT, node):
                self.road.set_edge(ROBOT, node, self._climbed_m(ROBOT, node, d), rho, 0)
        anchor = self.last_breadcrumb
        if anchor >= 0 and not self.graph.has_edge(ROBOT, anchor):
            straight = self.road.straight_m(ROBOT, anchor)
            self.road.set_edge(ROBOT, anchor, max(1.1 * straight, 1e-3), 0.05, 1)

    def _join_frontiers(self, window: Window) -> None:
        """Frontiers that are new or have moved are joined to breadcrumbs, so that they stay when the robot leaves."""
        for node in sorted(self.manager.near(window)):
            f = self.manager.frontiers[node]
            place = self.graph.nodes[node].get("joined_at")
            old = [n for n in self.graph.neighbors(node) if n != ROBOT]
            if not old or place is None or math.dist(place, (f.x_m, f.y_m)) >= 0.5:
                self._join_frontier(window, f, old)

    def _join_frontier(self, window: Window, f: Frontier, old: list[int]) -> None:
        node = f.node_id
        search = Search(window)
        search.run(window.cell(f.x_m, f.y_m), self.config.max_edge_m)
        joined: set[int] = set()
        z = self.graph.nodes[node]["z"]
        for _, other in self._near(f.x_m, f.y_m, z, self.config.max_edge_m, BREADCRUMB):
            if len(joined) < 3 and self._join(node, other, search):
                joined.add(other)
        for other in old:
            if not self.graph.has_edge(node, other) or other in joined:
                continue
            if joined:  # else the risk map has forgotten the ground around it, which is no evidence
                self.road.drop_edge(node, other)
            else:
                edge = self.graph.edges[node, other]
                length = max(edge["distance"], self.road.straight_m(node, other))
                self.road.set_edge(node, other, length, edge["risk"], edge["driven"])
        self.graph.nodes[node]["joined_at"] = (f.x_m, f.y_m)
        beside = self.graph.has_edge(ROBOT, node) and self.graph.has_edge(ROBOT, self.last_breadcrumb)
        if not joined and beside:
            self._join_over_robot(node)

    def _give_up_isolated(self, now_ns: int) -> None:
        """Frontiers that no way over the graph has led to for long cannot be planned for.

        Where the robot has no way to most of the graph, it is the robot that is cut off: it is given time to get out.
        """
        components = self.road.components_of(ROBOT)
        rounds = 3 * self.config.missed_rounds * (1 if self.road.is_largest(components) else _CUT_OFF_TIMES)
        for node in sorted(self.manager.frontiers):
            f = self.manager.frontiers[node]
            f.isolated = 0 if self.road.leads_to(node, components) else f.isolated + 1
            if f.isolated > rounds:
                self.manager.give_up(f, ISOLATED, now_ns)
                self.road.drop_node(node)

    def _join_over_robot(self, node: int) -> None:
        """No breadcrumb within d_e: join over the robot's place, which is within d_b of its last breadcrumb."""
        a, b = self.graph.edges[ROBOT, node], self.graph.edges[ROBOT, self.last_breadcrumb]
        rho = 1.0 - (1.0 - a["risk"]) * (1.0 - b["risk"])
        self.road.set_edge(node, self.last_breadcrumb, a["distance"] + b["distance"], rho, 0)

    def _review_edges(self, window: Window) -> None:
        """Evaluate the edges of one nearby breadcrumb again, in turn: ground changes, closures join what was two."""
        x, y = self.road.place(ROBOT)
        near = [n for _, n in self._near(x, y, self.graph.nodes[ROBOT]["z"], 12.0, BREADCRUMB)]
        if not near:
            return
        node = near[self.version % len(near)]
        place, z = self.road.place(node), self.graph.nodes[node]["z"]
        search = Search(window)
        cell = window.cell(*place)
        if not window.spec.contains(*cell):
            return
        search.run(cell, self.config.max_edge_m)
        # Its neighbours and what lies nearest: an edge that went comes back when its ground is free again.
        around = self._near(*place, z, self.config.max_edge_m, BREADCRUMB)
        others = {n for _, n in around[: self.config.edges_per_node + 1]} | set(self.graph.neighbors(node))
        for other in sorted(others - {node, ROBOT}):
            if self.graph.nodes[other]["kind"] == BREADCRUMB and self._is_certain(other):
                self._join(node, other, search)

    def _near(
        self, x_m: float, y_m: float, z_m: float, radius_m: float, kind: int | None
    ) -> list[tuple[float, int]]:
        """`RoadGraph.near` without what may not be there."""
        found = self.road.near(x_m, y_m, z_m, radius_m, kind)
        return [f for f in found if self._is_certain(f[1])] if self._doubtful else found

    def _is_certain(self, node: int) -> bool:
        frontier = self.manager.frontiers.get(node)
        keyframe = self.graph.nodes[node].get("keyframe") if frontier is None else frontier.keyframe
        return keyframe not in self._doubtful

    def message(self, pose: Pose, map_to_odom: Pose, stamp_ns: int, whole: bool) -> GlobalIrm:
        """The graph as a message: whole, or what has changed since the last message."""
        self.version += 1
        return self.road.message(self.version, pose, map_to_odom, stamp_ns, whole)

    def breadcrumbs(self) -> int:
        """How many breadcrumbs there are."""
        return self.road.breadcrumbs

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {**self.road.state(), **self._beside_graph()}

    def _beside_graph(self) -> dict[str, Any]:
        return {
            "manager": self.manager.state(),
            "counters": [self.next_id, self.version, self.last_breadcrumb],
            "trail": self.trail.points,
            "refuted": sorted([*edge, times] for edge, times in self.refuted.items()),
            "shut": sorted(list(edge) for edge in self.road.shut),
            "clear": sorted(list(edge) for edge in self.clear),
            "back": self._back,
            "moved": self._moved,
        }

    def _set_beside_graph(self, state: dict[str, Any]) -> None:
        self.manager.set_state(state["manager"])
        self.next_id, self.version, self.last_breadcrumb = state["counters"]
        self.trail.points = [(x, y) for x, y in state.get("trail", ())]  # older journals have none
        self.refuted = {(a, b): times for a, b, times in state.get("refuted", ())}
        shut = {(a, b) for a, b in state.get("shut", ())}
        self.road.shut_edges({edge for edge in shut if self.graph.has_edge(*edge)})
        self.clear = {(a, b) for a, b in state.get("clear", ())}
        self._back, self._moved = list(state.get("back", ())), bool(state.get("moved"))

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.road = RoadGraph()
        self.road.add_state(state)
        self._set_beside_graph(state)
        if self.version > 0:
            self.road.set_published(state["unpublished"])

    def difference(self, message: GlobalIrm) -> dict[str, Any]:
        """What a message that was just made tells, with all that is kept of it: for the journal."""
        return {**self.road.difference(message), **self._beside_graph()}

    def apply_difference(self, difference: dict[str, Any]) -> None:
        """Take in a difference from the journal; the next message is whole."""
        if difference["whole"]:
            self.road = RoadGraph()
        self.road.apply_difference(difference)
        self._set_beside_graph(difference)

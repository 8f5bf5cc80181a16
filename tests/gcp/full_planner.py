"""The planner that computes everything anew from the whole graph: what the incremental one is tested against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.graph_mirror import BREADCRUMB, FRONTIER, RoadMap
from planning.reward import RewardWeights
from services.gcp.qmdp import (
    STAY,
    EdgeTerms,
    GlobalGraph,
    edge_terms,
    global_graph,
    label_setting,
    label_setting_to,
    relocation_q,
    solve,
)
from tests.gcp.frontier_values import frontier_values

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


class Belief(NamedTuple):
    """The robot's pose as particles in `map`: (P, 3) positions, equally likely; node: index it is nearest
    to.
    """

    xyz_m: Floats
    node: int


class Option(NamedTuple):
    """One frontier and the best way to it. node: its index; path: indices from the robot's node to it.

    q: Q(b, a) of the first action of that way, with this frontier as the only goal. distance_m and risk are
    those of the way from the mean pose.
    """

    node: int
    q: float
    gain: float
    distance_m: float
    risk: float
    path: Indices


class Values(NamedTuple):
    """V and the node that the policy goes to next (-1: stay), (n,) each."""

    value: Floats
    action: NDArray[np.int64]


class Candidates(NamedTuple):
    """Actions "relocate to node j": the robot's node and its neighbours.

    node: (C,) indices. distance_m, risk: (P, C) of the way from every particle.
    """

    node: Indices
    distance_m: Floats
    risk: Floats


class GlobalPlanner:
    """The QMDP of one version of the graph."""

    def __init__(self, road_map: RoadMap, weights: RewardWeights) -> None:
        self.road_map = road_map
        self.weights = weights
        self.frontiers = np.flatnonzero(road_map.kind == FRONTIER).astype(np.int32)
        terms = self._terms(road_map.distance_m, road_map.risk)
        gains = weights.k_information * road_map.gain[self.frontiers]
        self.graph = global_graph(road_map.indptr, road_map.indices, terms, self.frontiers, gains)

    def _terms(self, distance_m: Floats, risk: Floats) -> EdgeTerms:
        """Cost (paper: C = k_d d + k_rho rho + k_mu mu, with mu = 0 as headings are not in the state) and
        discount.
        """
        w = self.weights
        cost = w.k_cost * (w.k_distance_per_m * distance_m + w.k_risk * risk)
        return edge_terms(distance_m, risk, cost, w.gamma_per_m)

    def values(self) -> Values:
        """The policy over all frontiers.

        Staying is no action: what is left must be visited, whatever it costs.
        """
        return self._values(self.graph)

    def values_to_go(self, robot_xyz_m: Floats, local_range_m: float) -> Values:
        """The policy when the frontiers within `local_range_m` of the robot are gone."""
        graph, road_map = self.graph, self.road_map
        near = np.linalg.norm(road_map.xyz_m - robot_xyz_m, axis=1) <= local_range_m
        gone = graph.terminal & near
        source = np.repeat(np.arange(gone.size), np.diff(road_map.indptr))
        cost = np.where(gone[source] | gone[road_map.indices], np.inf, graph.cost)
        reverse_cost = cost[graph.reverse_edge]
        return self._values(
            graph._replace(terminal=graph.terminal & ~gone, cost=cost, reverse_cost=reverse_cost)
        )

    def _values(self, graph: GlobalGraph) -> Values:
        solution = solve(graph, allow_stay=False)
        return Values(solution.value, self._next_node(solution.action))

    def _next_node(self, action: Indices) -> NDArray[np.int64]:
        """Ids of the nodes that the edges of a policy lead to."""
        if self.road_map.indices.size == 0:
            return np.full(action.size, -1, np.int64)
        target = self.road_map.indices[np.where(action == STAY, 0, action)]
        return np.where(action == STAY, -1, self.road_map.node_id[target])

    def options(self, belief: Belief, keep: list[int], top: int) -> list[Option]:
        """The best frontiers, best first, and those in `keep` (indices); only what can be reached."""
        road_map = self.road_map
        if self.frontiers.size == 0:
            return []
        ranked = frontier_values(self.graph, road_map.distance_m, road_map.risk, belief.node, top)
        shortlist = [
            int(n) for n, v in zip(ranked.node[:top], ranked.value[:top], strict=True) if v > -np.inf
        ]
        candidates = self.candidates(belief)
        found = [self._option(node, belief, candidates) for node in dict.fromkeys([*shortlist, *keep])]
        reached = [option for option in found if option is not None]
        return sorted(reached, key=lambda option: (-option.q, option.node))

    def _option(self, frontier: int, belief: Belief, candidates: Candidates) -> Option | None:
        """Q(b, a) = sum over q of b(q) Q(q, a), for one frontier as the only goal; None when there is no
        way.
        """
        target = np.array([frontier], np.int32)
        action = np.empty(self.road_map.node_id.size, np.int32)
        value = label_setting_to(
            self.graph, target, -np.inf, self._labelled(candidates.node, frontier), action
        )
        at = value[candidates.node]
        if not np.isfinite(at).any():
            return None
        open_ = np.isfinite(at)
        cost = self._terms(candidates.distance_m[:, open_], candidates.risk[:, open_])
        q = relocation_q(at[open_], np.ones(len(belief.xyz_m)), cost)
        first = int(candidates.node[open_][int(np.argmax(q))])
        path = self._path(belief.node, first, action)
        straight = float(np.linalg.norm(belief.xyz_m.mean(axis=0) - self.road_map.xyz_m[belief.node]))
        distance_m, risk = self._measure(path)
        gain = float(self.road_map.gain[frontier])
        return Option(frontier, float(q.max()), gain, straight + distance_m, risk, path)

    def _labelled(self, nodes: Indices, frontier: int) -> Indices:
        """Those of the nodes that get a label on the way to a frontier: not the other frontiers."""
        labelled: Indices = nodes[~self.graph.terminal[nodes] | (nodes == frontier)]
        return labelled

    def way_home(self, start: int, home: int) -> Option | None:
        """The cheapest way to a node, without discount, in which frontiers may be crossed; None when there
        is none.
        """
        goal = np.zeros_like(self.graph.terminal)
        goal[home] = True
        w, road_map = self.weights, self.road_map
        cost = w.k_cost * (w.k_distance_per_m * road_map.distance_m + w.k_risk * road_map.risk)
        terms = edge_terms(road_map.distance_m, road_map.risk, cost, 1.0)
        graph = self.graph._replace(
            discount=terms.discount, cost=terms.cost, terminal=goal, gain=np.zeros(goal.size)
        )
        action = np.empty(goal.size, np.int32)
        value = label_setting(graph, np.array([home], np.int32), -np.inf, -1, action)
        if not np.isfinite(value[start]):
            return None
        path = self._path(start, start, action)
        distance_m, risk = self._measure(path)
        return Option(home, float(value[start]), 0.0, distance_m, risk, path)

    def _path(self, start: int, first: int, action: Indices) -> Indices:
        """Nodes from `start` by way of `first` along a policy without cycles; no node twice."""
        path = [start] if first == start else [start, first]
        while action[path[-1]] != STAY:
            path.append(int(self.road_map.indices[action[path[-1]]]))
        last = len(path) - 1 - path[::-1].index(start)
        return np.array(path[last:], np.int32)

    def _measure(self, path: Indices) -> tuple[float, float]:
        """Length of a path over edges, and the probability that one of them fails."""
        length_m, safe = 0.0, 1.0
        for a, b in zip(path[:-1].tolist(), path[1:].tolist(), strict=True):
            edge = self._edge(a, b)
            length_m += float(self.road_map.distance_m[edge])
            safe *= 1.0 - float(self.road_map.risk[edge])
        return length_m, 1.0 - safe

    def _edge(self, a: int, b: int) -> int:
        """Index of the edge from a to b, -1 when there is none."""
        low, high = int(self.road_map.indptr[a]), int(self.road_map.indptr[a + 1])
        slot = low + int(np.searchsorted(self.road_map.indices[low:high], b))
        return slot if slot < high and int(self.road_map.indices[slot]) == b else -1

    def candidates(self, belief: Belief) -> Candidates:
        """The relocations from the robot's neighbourhood, with the way there from every particle.

        A particle stands at the breadcrumb nearest to it among the robot's and its neighbours, and goes from
        there by an edge, or by way of the robot's node.
        """
        road_map, robot = self.road_map, belief.node
        edges = slice(int(road_map.indptr[robot]), int(road_map.indptr[robot + 1]))
        nodes = np.concatenate((np.array([robot], np.int32), road_map.indices[edges]))
        to_robot = np.concatenate((np.zeros(1), road_map.distance_m[edges]))
        risk_robot = np.concatenate((np.zeros(1), road_map.risk[edges]))
        stands = np.flatnonzero(road_map.kind[nodes] == BREADCRUMB)
        stands = stands if stands.size else np.zeros(1, np.int64)
        offset = belief.xyz_m[:, None, :] - road_map.xyz_m[nodes[stands]][None, :, :]
        gap_m = np.linalg.norm(offset, axis=2)
        nearest = np.argmin(gap_m, axis=1)
        rows = np.unique(nearest)
        distance_m = np.empty((stands.size, nodes.size))
        risk = np.empty((stands.size, nodes.size))
        for row in rows.tolist():
            at = int(stands[row])
            distance_m[row] = to_robot[at] + to_robot
            risk[row] = 1.0 - (1.0 - risk_robot[at]) * (1.0 - risk_robot)
            distance_m[row, at] = risk[row, at] = 0.0
            for column in range(1, nodes.size):
                edge = self._edge(int(nodes[at]), int(nodes[column]))
                if column != at and edge >= 0 and road_map.distance_m[edge] < distance_m[row, column]:
                    distance_m[row, column] = road_map.distance_m[edge]
                    risk[row, column] = road_map.risk[edge]
        particles = np.arange(nearest.size)
        return Candidates(nodes, gap_m[particles, nearest][:, None] + distance_m[nearest], risk[nearest])

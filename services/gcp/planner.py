"""One planning step over the Global IRM: values, frontiers weighed under the pose belief, and the way to one.

What was computed is kept between steps and follows what the graph's messages change (`field.py`); the choice of the
target, which remembers, is the stage's.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.gcp.field import Field
from services.gcp.net import Net, find_edge
from services.gcp.qmdp import EdgeTerms, edge_terms, relocation_q
from services.gcp.ranking import Ranking
from services.gcp.roadnet import RoadNet

Floats = NDArray[np.float64]
Slots = NDArray[np.int32]

_KEPT_FIELDS = 8
"""Frontiers whose fields are kept: those weighed now, and some that were and may be again."""


class Belief(NamedTuple):
    """The robot's pose as particles in `map`: (P, 3) positions, equally likely; node: slot it is nearest to."""

    xyz_m: Floats
    node: int


class Option(NamedTuple):
    """One frontier and the best way to it. node: its slot; path: slots from the robot's node to it.

    q: Q(b, a) of the first action of that way, with this frontier as the only goal. distance_m and risk are
    those of the way from the mean pose.
    """

    node: int
    q: float
    gain: float
    distance_m: float
    risk: float
    path: Slots


class Policy(NamedTuple):
    """Of some nodes: V, the id of the node that the policy goes to next (-1: stay), and the value to go, (n,) each."""

    value: Floats
    action: NDArray[np.int64]
    value_to_go: Floats


class Candidates(NamedTuple):
    """Actions "relocate to node j": the robot's node and its neighbours.

    node: (C,) slots. distance_m, risk: (P, C) of the way from every particle.
    """

    node: Slots
    distance_m: Floats
    risk: Floats


@njit
def _measure(net: Net, path: Slots) -> tuple[float, float]:
    """Length of a path over edges, and the probability that one of them fails."""
    length_m, safe = 0.0, 1.0
    for k in range(path.shape[0] - 1):
        edge = find_edge(net, path[k], path[k + 1])
        length_m += net.distance_m[edge]
        safe *= 1.0 - net.risk[edge]
    return length_m, 1.0 - safe


@njit
def _relocations(
    net: Net, nodes: Slots, to_robot: Floats, risk_robot: Floats, at: int, distance_m: Floats, risk: Floats
) -> None:
    """Fill the way from the candidate `at` to all of them, (C,): by an edge, or by way of the robot's node."""
    for k in range(nodes.shape[0]):
        distance_m[k] = to_robot[at] + to_robot[k]
        risk[k] = 1.0 - (1.0 - risk_robot[at]) * (1.0 - risk_robot[k])
        if k > 0 and k != at:
            edge = find_edge(net, nodes[at], nodes[k])
            if edge >= 0 and net.distance_m[edge] < distance_m[k]:
                distance_m[k], risk[k] = net.distance_m[edge], net.risk[edge]
    distance_m[at] = risk[at] = 0.0


class GlobalPlanner:
    """The QMDP of a road net that changes."""

    def __init__(self, roads: RoadNet, policy_floor: float = 0.0) -> None:
        self.roads = roads
        self._floor = policy_floor
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._all, self._far = Field(self.roads, self._floor), Field(self.roads, self._floor)
        self._ranking = Ranking(self.roads)
        self._paid: dict[int, float] = {}
        self._far_paid: dict[int, float] = {}
        self._single: OrderedDict[int, tuple[float, Field]] = OrderedDict()
        self._home: tuple[int, Field] | None = None

    def follow(self) -> None:
        """Take in what changed in the road net since the last call."""
        roads = self.roads
        if roads.renewed:
            self._begin_anew()
        touched = np.array(sorted(roads.touched), np.int32)
        gains = dict(zip(touched.tolist(), roads.pays(touched).tolist(), strict=True))
        for slot in self._single.keys() & gains.keys():
            if self._single[slot][0] != gains[slot]:
                del self._single[slot]
        singles = [field for _, field in self._single.values()]
        for field in (self._all, self._far, *singles, *([self._home[1]] if self._home else [])):
            field.touch(touched)
        _pay(self._all, self._paid, gains)
        roads.renewed = False
        roads.touched.clear()

    def policy(self, nodes: Slots, robot_xyz_m: Floats, local_range_m: float) -> Policy:
        """The policy over all frontiers at nodes (slots), and V when those near the robot are gone.

        Staying, of value 0, is an action here: what is worth less than nothing from a node matters to nobody there.
        """
        roads = self.roads
        frontiers = roads.frontier_slots()
        away = np.linalg.norm(roads.xyz_m[frontiers] - robot_xyz_m, axis=1) > local_range_m
        far = frontiers[away]
        gains = dict.fromkeys(self._far_paid, -np.inf)
        gains |= dict(zip(far.tolist(), roads.net.gain[far].tolist(), strict=True))
        _pay(self._far, self._far_paid, gains)
        value, to_go = self._all.values(nodes), self._far.values(nodes)
        following = self._all.next_nodes(nodes)
        action = np.where(following >= 0, roads.net.node_id[following], -1)
        return Policy(_or_nothing(value), action, _or_nothing(to_go))

    def options(self, belief: Belief, keep: list[int], top: int) -> list[Option]:
        """The best frontiers, best first, and those in `keep` (slots); only what can be reached."""
        if not self.roads.frontiers:
            return []
        shortlist = self._ranking.best(belief.node, top).tolist()
        candidates = self.candidates(belief)
        terms = self._terms(candidates.distance_m, candidates.risk)
        wanted = [*dict.fromkeys([*shortlist, *keep])]
        found = [self._option(node, belief, candidates, terms) for node in wanted]
        while len(self._single) > max(_KEPT_FIELDS, len(wanted)):
            self._single.popitem(last=False)
        reached = [option for option in found if option is not None]
        return sorted(reached, key=lambda option: (-option.q, int(self.roads.net.node_id[option.node])))

    def _terms(self, distance_m: Floats, risk: Floats) -> EdgeTerms:
        """Cost and discount of relocations."""
        w = self.roads.weights
        cost = w.k_cost * (w.k_distance_per_m * distance_m + w.k_risk * risk)
        return edge_terms(distance_m, risk, cost, w.gamma_per_m)

    def _field_of(self, frontier: int) -> Field:
        """The field of one frontier as the only goal; the ones asked for last are kept."""
        if frontier not in self._single:
            gain = self.roads.net.gain[[frontier]]
            self._single[frontier] = (float(gain[0]), Field(self.roads))
            self._single[frontier][1].pay(np.array([frontier], np.int32), gain)
        self._single.move_to_end(frontier)
        return self._single[frontier][1]

    def _option(
        self, frontier: int, belief: Belief, candidates: Candidates, terms: EdgeTerms
    ) -> Option | None:
        """Q(b, a) = sum over q of b(q) Q(q, a), for one frontier as the only goal; None when there is no
        way.
        """
        roads, field = self.roads, self._field_of(frontier)
        nodes = candidates.node
        passing = ~roads.net.terminal[nodes] | (nodes == frontier)
        at = np.full(nodes.size, -np.inf)
        at[passing] = field.values(nodes[passing])
        open_ = np.isfinite(at)
        if not open_.any():
            return None
        part = EdgeTerms(terms.discount[:, open_], terms.cost[:, open_])
        q = relocation_q(at[open_], np.ones(len(belief.xyz_m)), part)
        path = field.way(belief.node, int(nodes[open_][int(np.argmax(q))]))
        distance_m, risk = _measure(roads.net, path)
        straight = float(np.linalg.norm(belief.xyz_m.mean(axis=0) - roads.xyz_m[belief.node]))
        gain = float(roads.raw_gain[frontier])
        return Option(frontier, float(q.max()), gain, straight + distance_m, risk, path)

    def way_home(self, start: int, home: int) -> Option | None:
        """The cheapest way to a node, without discount, in which frontiers may be crossed; None when there
        is none.
        """
        if self._home is None or self._home[0] != home:
            self._home = (home, Field(self.roads, home=True))
            self._home[1].pay(np.array([home], np.int32), np.zeros(1))
        field = self._home[1]
        value = float(field.values(np.array([start], np.int32))[0])
        if not np.isfinite(value):
            return None
        path = field.way(start, start)
        distance_m, risk = _measure(self.roads.net, path)
        return Option(home, value, 0.0, distance_m, risk, path)

    def candidates(self, belief: Belief) -> Candidates:
        """The relocations from the robot's neighbourhood, with the way there from every particle.

        A particle stands at the breadcrumb nearest to it among the robot's and its neighbours, and goes from
        there by an edge, or by way of the robot's node.
        """
        roads, robot = self.roads, belief.node
        net, first = roads.net, int(roads.net.begin[robot])
        edges = slice(first, first + int(net.degree[robot]))
        nodes = np.concatenate((np.array([robot], np.int32), net.other[edges]))
        to_robot = np.concatenate((np.zeros(1), net.distance_m[edges]))
        risk_robot = np.concatenate((np.zeros(1), net.risk[edges]))
        stands = np.flatnonzero(~net.terminal[nodes])
        stands = stands if stands.size else np.zeros(1, np.int64)
        offset = belief.xyz_m[:, None, :] - roads.xyz_m[nodes[stands]][None, :, :]
        gap_m = np.linalg.norm(offset, axis=2)
        nearest = np.argmin(gap_m, axis=1)
        distance_m, risk = np.empty((stands.size, nodes.size)), np.empty((stands.size, nodes.size))
        for row in np.unique(nearest).tolist():
            at = int(stands[row])
            _relocations(net, nodes, to_robot, risk_robot, at, distance_m[row], risk[row])
        particles = np.arange(nearest.size)
        return Candidates(nodes, gap_m[particles, nearest][:, None] + distance_m[nearest], risk[nearest])


def _pay(field: Field, paid: dict[int, float], gains: dict[int, float]) -> None:
    """Tell a field what some slots pay now (-inf: nothing). paid: what its goals paid so far, brought up to date."""
    news = {slot: gain for slot, gain in gains.items() if paid.get(slot, -np.inf) != gain}
    if news:
        field.pay(np.array([*news], np.int32), np.array([*news.values()]))
    for slot, gain in news.items():
        if gain > -np.inf:
            paid[slot] = gain
        else:
            del paid[slot]


def _or_nothing(value: Floats) -> Floats:
    """The values, 0 where there is none."""
    return np.where(value == -np.inf, 0.0, value)

"""Which frontier is best to go to first when all are to be visited: a tour over groups of frontiers.

After FIG-OP (Peltzer et al. 2022, arXiv 2203.06316): the QMDP weighs each frontier as if it were the only goal, and
drives by a small opening on the way to a large one far away, to come back for it later. Here the order of the visits
counts: V = sum over k of gamma^D_k gain_k - gamma^D_(k-1) C_k, with D the distance driven so far and C the paper's cost
of a leg.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower
from services.gcp.net import Floats, Net, Slots
from services.gcp.roadnet import RoadNet

_NEXT_OF_GROUP = 0.3
"""Frontiers of a group mostly look at the same unseen ground: the best one counts whole, the others so much."""
_OF_A_GROUP = 8
"""So many frontiers for each group are looked for near the robot."""
_NEAR_COST = 0.5
"""Ways that cost less are equally near when gain is weighed by cost, nats: ten metres."""


class Groups(NamedTuple):
    """Groups of frontiers, nearest first: slot of the best frontier of each, (k,), what the group promises, (k,), and
    for each frontier its group, by slot."""

    slot: Slots
    gain: Floats
    of: dict[int, int]


class Legs(NamedTuple):
    """Legs of a tour: cost, discount (gamma^distance), (k + 1, k): row k from the robot. inf and 0 without a way."""

    cost: Floats
    discount: Floats


class Tour(NamedTuple):
    """An order of the groups and its value; empty when none can be reached."""

    order: NDArray[np.int64]
    value: float


class Outlook(NamedTuple):
    """Where the best tour begins: slot of a frontier (-1: no tour), its value, and that of the best tour that begins
    with the frontier held (-inf: none)."""

    first: int = -1
    value: float = -np.inf
    kept_value: float = -np.inf


@njit
def ways_from(
    net: Net, source: int, wanted: NDArray[np.bool_], count: int, held: int, cost: Floats, distance_m: Floats
) -> None:
    """Cheapest ways (undiscounted cost) from a slot to the wanted frontiers, by slot, until `count` of them are found.

    held: one that is among them in any case; -1: none. Ways do not pass through frontiers. cost: (n,) out, inf where no
    way was found. distance_m: (n,) out, along it.
    """
    n = net.node_id.shape[0]
    heap, place = np.empty(n, np.int32), np.full(n, -1, np.int32)
    cost[:] = np.inf
    distance_m[source] = 0.0
    size = heap_push_or_lower(heap, place, cost, 0, source, 0.0)
    done = np.zeros(n, np.bool_)
    while size > 0 and (count > 0 or (held >= 0 and not done[held])):
        node = heap_pop(heap, place, cost, size)
        size -= 1
        done[node] = True
        if wanted[node] and node != source:
            count -= 1
        if net.terminal[node] and node != source:
            continue
        for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
            other = net.other[edge]
            value = cost[node] + net.home_cost[edge]
            if value < cost[other]:
                distance_m[other] = distance_m[node] + net.distance_m[edge]
                size = heap_push_or_lower(heap, place, cost, size, other, value)
    for node in range(n):
        if not done[node]:
            cost[node] = np.inf


@njit
def tour_value(order: NDArray[np.int64], gain: Floats, cost: Floats, discount: Floats) -> float:
    """The value of visiting the groups in this order."""
    at, left, value = gain.shape[0], 1.0, 0.0
    for k in range(order.shape[0]):
        stop = order[k]
        value -= left * cost[at, stop]
        left *= discount[at, stop]
        value += left * gain[stop]
        at = stop
    return value


@njit
def _move(order: NDArray[np.int64], i: int, j: int, turned: NDArray[np.int64]) -> None:
    """The stop at i put to place j, the others close up; into `turned`."""
    k = 0
    for t in range(order.shape[0]):
        if t == i:
            continue
        if k == j:
            k += 1
        turned[k] = order[t]
        k += 1
    turned[j] = order[i]


@njit
def improve(order: NDArray[np.int64], fixed: int, gain: Floats, cost: Floats, discount: Floats) -> float:
    """Move single stops and turn stretches round, as long as it helps, in place. The first `fixed` stops stay."""
    n = order.shape[0]
    best = tour_value(order, gain, cost, discount)
    trial = order.copy()
    better = True
    while better:
        better = False
        for i in range(fixed, n):
            for j in range(fixed, n):
                if i == j:
                    continue
                for kind in range(2):
                    if kind == 0:
                        _move(order, i, j, trial)
                    elif i < j:
                        trial[:] = order
                        trial[i : j + 1] = order[i : j + 1][::-1]
                    else:
                        continue
                    value = tour_value(trial, gain, cost, discount)
                    if value > best + 1e-9:
                        order[:] = trial
                        best, better = value, True
    return best


@njit
def _greedy(
    first: int, reached: NDArray[np.bool_], gain: Floats, cost: Floats, discount: Floats
) -> NDArray[np.int64]:
    """Always on to the stop that pays most per leg; first: where to begin, -1: free."""
    n = gain.shape[0]
    order, used = np.empty(n, np.int64), ~reached
    at, count = n, 0
    if first >= 0:
        order[0], used[first], at, count = first, True, first, 1
    while True:
        best, value = -1, -np.inf
        for k in range(n):
            if not used[k] and cost[at, k] < np.inf:
                q = discount[at, k] * gain[k] - cost[at, k]
                if q > value:
                    best, value = k, q
        if best < 0:
            return order[:count].copy()
        order[count], used[best], at = best, True, best
        count += 1


def best_tour(gain: Floats, legs: Legs, first: int = -1) -> Tour:
    """A good order of all groups that can be reached from the robot, which begins with `first` (-1: with any).

    By local search (moves of single stops, turns of stretches) from the greedy order.
    """
    cost, discount = legs
    reached = np.isfinite(cost[-1])
    if not reached.any() or (first >= 0 and not reached[first]):
        return Tour(np.zeros(0, np.int64), -np.inf)
    order = _greedy(first, reached, gain, cost, discount)
    value = improve(order, 1 if first >= 0 else 0, gain, cost, discount)
    return Tour(order, float(value))


def group_frontiers(
    roads: RoadNet, frontiers: Slots, away: Floats, apart_m: float, most: int, keep: int, far: int = 0
) -> Groups:
    """The `most` nearest groups of frontiers, and of the others the `far` that promise most for the way there.

    away: (f,) cost of the way to each, inf without one. keep: a slot, or -1. A frontier joins the group whose first
    frontier is within `apart_m` of it, straight; the frontier `keep` stands for its group.
    """
    order = np.lexsort((roads.net.node_id[frontiers], away))
    order = order[np.isfinite(away[order])]
    slots, cost = frontiers[order].tolist(), away[order]
    first: list[int] = [keep] if keep in slots else []
    members: list[list[int]] = [[] for _ in first]
    costs = [float(cost[slots.index(keep)])] if first else []
    places = np.empty((len(slots) + 1, 3))
    places[: len(first)] = roads.xyz_m[first]
    for slot, to_it in zip(slots, cost.tolist(), strict=True):
        gap_m = np.linalg.norm(places[: len(members)] - roads.xyz_m[slot], axis=1)
        group = int(np.argmin(gap_m)) if gap_m.size and gap_m.min() <= apart_m else -1
        if group < 0:
            if far == 0 and len(members) >= most:
                continue
            group = len(members)
            places[group] = roads.xyz_m[slot]
            members.append([])
            costs.append(to_it)
        members[group].append(slot)
    gain = roads.net.gain
    total = np.array([_promise(gain[group]) for group in members])
    chosen = _worth_going(total, np.array(costs), most, far)
    best = [max(members[k], key=lambda s: (gain[s], -roads.net.node_id[s])) for k in chosen]
    best[: len(first)] = first
    of = {slot: k for k, group in enumerate(chosen) for slot in members[group]}
    return Groups(np.array(best, np.int32), total[chosen], of)


def _promise(gain: Floats) -> float:
    """What a group of frontiers promises, from the gain of each."""
    return float((1.0 - _NEXT_OF_GROUP) * gain.max() + _NEXT_OF_GROUP * gain.sum())


def _worth_going(gain: Floats, cost: Floats, most: int, far: int) -> list[int]:
    """The first `most` groups, and of the others the `far` with the most gain for their cost."""
    others = np.arange(min(most, gain.size), gain.size)
    rate = gain[others] / (cost[others] + _NEAR_COST)
    chosen = others[np.argsort(-rate, kind="stable")[:far]]
    return [*range(min(most, gain.size)), *sorted(chosen.tolist())]


class Visits:
    """The tour from the robot's node over the nearest groups, `most` of them; when that is worth less than `near_worth`
    (nats), over as many far ones too. gamma_per_m: discount of gains and costs by the way driven before.
    """

    def __init__(
        self, roads: RoadNet, gamma_per_m: float, apart_m: float, most: int, near_worth: float
    ) -> None:
        self._roads, self._gamma, self._apart_m, self._most = roads, gamma_per_m, apart_m, most
        self._near_worth = near_worth

    def first(self, start: int, held: int) -> Outlook:
        """Where to begin. start: the robot's slot. held: slot of the frontier that is the target, or -1."""
        roads = self._roads
        frontiers = roads.frontier_slots()
        if frontiers.size == 0:
            return Outlook()
        near = _OF_A_GROUP * self._most
        groups = self._groups(start, held, frontiers, near, 0)
        outlook = self._over(start, held, groups)
        all_weighed = frontiers.size <= near and groups.slot.size < self._most
        if outlook.value < self._near_worth and not all_weighed:
            outlook = self._over(start, held, self._groups(start, held, frontiers, None, self._most))
        return outlook

    def _groups(self, start: int, held: int, frontiers: Slots, looked_for: int | None, far: int) -> Groups:
        """The nearest groups among so many frontiers (None: all), and `far` of the others."""
        away, _ = self._ways(start, frontiers, looked_for, held)
        return group_frontiers(self._roads, frontiers, away, self._apart_m, self._most, held, far)

    def _over(self, start: int, held: int, groups: Groups) -> Outlook:
        """The tour over these groups."""
        if groups.slot.size == 0:
            return Outlook()
        legs = self._legs(start, groups.slot)
        tour = best_tour(groups.gain, legs)
        if tour.order.size == 0:
            return Outlook()
        kept = (
            best_tour(groups.gain, legs, groups.of[held])
            if held in groups.of
            else Tour(tour.order[:0], -np.inf)
        )
        if kept.value > tour.value:  # the search of the free tour ended in a worse place
            tour = kept
        return Outlook(int(groups.slot[tour.order[0]]), tour.value, kept.value)

    def _ways(
        self, source: int, targets: Slots, most: int | None = None, held: int = -1
    ) -> tuple[Floats, Floats]:
        """Cost and length of the ways to the `most` nearest targets (all) and the one held; inf and 0 of others."""
        net = self._roads.net
        wanted = np.zeros(net.node_id.size, np.bool_)
        wanted[targets] = True
        cost, distance_m = np.empty(net.node_id.size), np.zeros(net.node_id.size)
        count = int(targets.size) if most is None else min(most, int(targets.size))
        ways_from(net, source, wanted, count, held if held >= 0 and wanted[held] else -1, cost, distance_m)
        return cost[targets], distance_m[targets]

    def _legs(self, start: int, stops: Slots) -> Legs:
        cost, discount = np.full((stops.size + 1, stops.size), np.inf), np.zeros((stops.size + 1, stops.size))
        for row, source in enumerate([*stops.tolist(), start]):
            cost[row], distance_m = self._ways(source, stops)
            discount[row] = self._gamma**distance_m
        return Legs(cost, discount)

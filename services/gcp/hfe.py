"""Hierarchical frontier-based exploration (paper, Baseline Algorithms): the next frontier, one step ahead.

The frontiers of the Global IRM are the policy search space. A frontier is worth what the one relocation to it pays by
the reward that all planners share: R = w gamma^d k_I g - k_C (k_d d + k_rho rho). The spatial scope is modulated after
Umari and Mukhopadhyay (2017): the best frontier of the smallest scope that has one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower
from services.gcp.net import Floats, Net, Slots
from services.gcp.planner import Option
from services.gcp.roadnet import RoadNet


class Travel(NamedTuple):
    """Cheapest ways from one node to all, (n,) by slot: length, probability of failing on the way, the node before."""

    distance_m: Floats
    risk: Floats
    before: Slots


@njit
def _travel(
    net: Net, start: int, risk_weight_m: float, distance_m: Floats, safe: Floats, before: Slots
) -> None:
    """Dijkstra by length and weighed risk; ways do not lead through frontiers, which are no ground to drive on yet."""
    n = net.node_id.shape[0]
    heap, place, cost = np.empty(n, np.int32), np.full(n, -1, np.int32), np.full(n, np.inf)
    distance_m[start], safe[start] = 0.0, 1.0
    size = heap_push_or_lower(heap, place, cost, 0, start, 0.0)
    while size > 0:
        node = heap_pop(heap, place, cost, size)
        size -= 1
        if net.terminal[node] and node != start:
            continue
        for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
            other, rho = net.other[edge], net.risk[edge]
            value = cost[node] + net.distance_m[edge] + risk_weight_m * rho
            if rho < 1.0 and value < cost[other] - 1e-12:
                size = heap_push_or_lower(heap, place, cost, size, other, value)
                distance_m[other] = distance_m[node] + net.distance_m[edge]
                safe[other] = safe[node] * (1.0 - rho)
                before[other] = node


def travel_from(roads: RoadNet, start: int, risk_weight_m: float) -> Travel:
    """Cheapest ways from a slot to all others; inf and -1 where none leads."""
    n = roads.slots
    distance_m, safe, before = np.full(n, np.inf), np.zeros(n), np.full(n, -1, np.int32)
    _travel(roads.net, start, risk_weight_m, distance_m, safe, before)
    return Travel(distance_m, 1.0 - safe, before)


def scope_of(distance_m: float, scopes_m: Sequence[float]) -> int:
    """The smallest spatial scope that reaches so far: an index into `scopes_m`, or their number for the global one."""
    return next((i for i, scope_m in enumerate(scopes_m) if distance_m <= scope_m), len(scopes_m))


def one_step_rewards(
    roads: RoadNet, travel: Travel, frontiers: Slots, gain_weight: float
) -> NDArray[np.float64]:
    """What the relocation to each frontier pays, (f,); -inf where no way leads."""
    w = roads.weights
    distance_m, risk = travel.distance_m[frontiers], travel.risk[frontiers]
    reached = np.isfinite(distance_m)
    far = np.where(reached, distance_m, 0.0)
    cost = w.k_cost * (w.k_distance_per_m * far + w.k_risk * risk)
    reward = gain_weight * w.gamma_per_m**far * (1.0 - risk) * roads.net.gain[frontiers] - cost
    return np.where(reached, reward, -np.inf)


def frontier_options(
    roads: RoadNet,
    start: int,
    scopes_m: Sequence[float],
    gain_weight: float,
    risk_weight_m: float,
    top: int,
    keep: Sequence[int],
) -> list[Option]:
    """The best frontiers and those in `keep`, smaller scopes first, in each the larger reward, then the lower id."""
    frontiers = roads.frontier_slots()
    if frontiers.size == 0:
        return []
    travel = travel_from(roads, start, risk_weight_m)
    reward = one_step_rewards(roads, travel, frontiers, gain_weight)
    ranked = sorted(
        (scope_of(float(travel.distance_m[f]), scopes_m), -r, int(roads.net.node_id[f]), int(f))
        for f, r in zip(frontiers.tolist(), reward.tolist(), strict=True)
        if math.isfinite(r)
    )
    kept = [entry for entry in ranked[top:] if entry[3] in keep]
    return [_option(roads, travel, start, slot, -minus) for _, minus, _, slot in [*ranked[:top], *kept]]


def _option(roads: RoadNet, travel: Travel, start: int, frontier: int, reward: float) -> Option:
    path = [frontier]
    while path[-1] != start:
        path.append(int(travel.before[path[-1]]))
    return Option(
        frontier,
        reward,
        float(roads.raw_gain[frontier]),
        float(travel.distance_m[frontier]),
        float(travel.risk[frontier]),
        np.array(path[::-1], np.int32),
    )

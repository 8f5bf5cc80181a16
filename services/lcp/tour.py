"""The tour over viewpoints: all that is left to see in the window, in the order that is short and early.

A viewpoint is a node of the Local IRM and what it alone is to see; together they see everything (greedy set cover).
Frontiers of gcp beyond the window are stops too, entered by the node from where they are nearest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import lowest_bit
from planning.frames import planar
from planning.kernels import njit
from planning.latency_tour import latency_tour
from planning.lattice_graph import travel_costs
from schemas.policy import GlobalPolicy
from schemas.world import LocalIrm
from services.lcp.config import TourConfig
from services.lcp.problem import node_at

_ONE = np.uint64(1)
Floats = NDArray[np.float64]


class Stops(NamedTuple):
    """node: (k,) where each is seen from; gain: (k,) nats that are seen there; beyond_m: (k,) way on from there."""

    node: NDArray[np.int64]
    gain: Floats
    beyond_m: Floats


class Tour(NamedTuple):
    """nodes: the stops in their order; cost: of the order; gain: of all stops."""

    nodes: list[int]
    cost: float
    gain: float


def plan_tour(
    irm: LocalIrm,
    start: int,
    entropy: Floats,
    policy: GlobalPolicy | None,
    config: TourConfig,
    risk_weight_m: float,
    max_risk: float,
) -> Tour | None:
    """The best tour from a node; None when nothing is left that can be gone to.

    entropy: (n,) what is left to see in each patch, nats; 0 where nothing.
    """
    cost = _costs(irm, start, risk_weight_m, max_risk)
    stops = _stops(irm, start, entropy, cost, config)
    outside = _beyond(irm, start, policy, cost, config, len(stops.node))
    stops = Stops(*(np.concatenate(pair) for pair in zip(stops, outside, strict=True)))
    count = len(stops.node)
    if count == 0:
        return None
    leg = np.full((count + 1, count), math.inf)
    leg[count] = cost[stops.node] + stops.beyond_m
    for k in range(count):
        away = _costs(irm, int(stops.node[k]), risk_weight_m, max_risk)
        leg[k] = stops.beyond_m[k] + away[stops.node] + stops.beyond_m
    found = latency_tour(leg, stops.gain + config.stop_gain, config.early_per_nat)
    order = [int(stops.node[k]) for k in found.order]
    return Tour(order, float(found.first_cost.min()), float(stops.gain.sum()))


def _costs(irm: LocalIrm, source: int, risk_weight_m: float, max_risk: float) -> Floats:
    cost, move = np.empty(irm.size**2), np.empty(irm.size**2, np.int8)
    travel_costs(source, irm.size, irm.edge_distance_m, irm.edge_risk, risk_weight_m, max_risk, cost, move)
    return cost


def _stops(irm: LocalIrm, start: int, entropy: Floats, cost: Floats, config: TourConfig) -> Stops:
    """Viewpoints in the window; where none is worth `min_gain`, the best of the others."""
    for least in (config.min_gain, 0.0):
        node, gain = np.zeros(config.stops, np.int64), np.zeros(config.stops)
        count = cover(
            irm.visible, irm.state, entropy.copy(), cost, start, irm.size, irm.reach, config.near_m,
            config.gain_power, least, node, gain,
        )  # fmt: skip
        if count > 0:
            break
    return Stops(node[:count], gain[:count], np.zeros(count))


def _beyond(
    irm: LocalIrm, start: int, policy: GlobalPolicy | None, cost: Floats, config: TourConfig, taken: int
) -> Stops:
    """The frontiers that gcp has weighed and that lie where the Local IRM shows no ground.

    The risk map under it may be smaller than the lattice.
    """
    nodes, gains, beyond_m = [], [], []
    usable = np.flatnonzero(np.isfinite(cost) & (irm.state == 1))
    if policy is not None and len(usable) > 1:
        to_odom = planar(policy.map_to_odom).inverse()
        for other in policy.alternatives[: max(0, config.stops - taken)]:
            place = np.array(to_odom.apply(other.x_m, other.y_m))
            here = node_at(irm, *place.tolist())
            if here >= 0 and irm.state[here] == 1:
                continue  # the Local IRM knows better what is left there
            away_m = np.hypot(*(irm.anchor_m[usable] - place).T)
            best = int(np.argmin(cost[usable] + config.detour * away_m))
            if usable[best] != start:
                nodes.append(int(usable[best]))
                gains.append(max(0.0, other.gain))
                beyond_m.append(float(config.detour * away_m[best]))
    return Stops(np.array(nodes, np.int64), np.array(gains), np.array(beyond_m))


@njit
def _in_sight(
    visible: NDArray[np.uint32], node: int, size: int, reach: int, left: Floats, clear: bool
) -> float:
    """What is left in the patches that a node sees; `clear` takes it away."""
    total = 0.0
    for r in range(2 * reach + 1):
        row = node // size + r - reach
        if row < 0 or row >= size:
            continue
        word = np.uint64(visible[node, r])
        while word != np.uint64(0):
            column = node % size + lowest_bit(word) - reach
            word &= word - _ONE
            if 0 <= column < size:
                total += left[row * size + column]
                if clear:
                    left[row * size + column] = 0.0
    return total


@njit
def cover(
    visible: NDArray[np.uint32],
    state: NDArray[np.uint8],
    left: Floats,
    cost: Floats,
    start: int,
    size: int,
    reach: int,
    near_m: float,
    power: float,
    least: float,
    node_out: NDArray[np.int64],
    gain_out: Floats,
) -> int:
    """Greedy set cover: always the node with the largest gain^power exp(-cost / near_m) next; returns how many.

    visible, size, reach: as in `LocalIrm`. left: (n,) what is left to see, changed. cost: (n,) travel from `start`,
    inf without way; `start` itself is no viewpoint. Stops with `node_out` full or no gain above `least`.
    """
    count = 0
    gain = np.zeros(size * size)
    for node in range(size * size):
        if state[node] == 1 and node != start and np.isfinite(cost[node]):
            gain[node] = _in_sight(visible, node, size, reach, left, False)
    while count < node_out.shape[0]:
        best, best_score = -1, 0.0
        for node in range(size * size):
            if gain[node] > least:
                score = gain[node] ** power * math.exp(-cost[node] / near_m)
                if score > best_score:
                    best, best_score = node, score
        if best < 0:
            break
        node_out[count], gain_out[count] = best, gain[best]
        count += 1
        _in_sight(visible, best, size, reach, left, True)
        for node in range(size * size):
            if gain[node] > least:
                gain[node] = _in_sight(visible, node, size, reach, left, False)
    return count

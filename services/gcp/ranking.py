"""The frontiers that are worth most from where the robot stands, each by a good way, without looking at all of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower
from services.gcp.net import Net
from services.gcp.roadnet import RoadNet

Floats = NDArray[np.float64]
Slots = NDArray[np.int32]

_LOOK_EVERY = 16
_SLACK = 1e-9


@njit
def _price(net: Net, before: Slots, entry: Slots, start: int, frontier: int) -> float:
    """Value of the tree's way from `start` to a frontier."""
    node, value = frontier, net.gain[frontier]
    while node != start:
        value = net.discount[entry[node]] * value - net.cost[entry[node]]
        node = before[node]
    return value


@njit
def _most(left: Floats, spent: Floats, heap: Slots, size: int, gain: float) -> float:
    """What a frontier of this gain is worth at most behind the nodes in the heap: left[i] * gain - spent[i]."""
    most = -np.inf
    for k in range(size):
        most = max(most, left[heap[k]] * gain - spent[heap[k]])
    return most


@njit
def _rank(
    net: Net, start: int, frontiers: Slots, by_gain: Slots, top: int, found: Slots, value: Floats
) -> int:
    """Frontiers in the order of a search from `start` with the values of its ways, until the others cannot be among
    the `top` best; how many were found.

    Edges are weighed c' + (1 - gamma') reference: the value lost on them if what waits behind is worth as much as the
    largest gain. Of every way to come the first part is known: to a node in the heap, with its discount and its costs;
    behind it at most the largest gain waits that was not found yet. by_gain: the frontiers, largest gain first.
    """
    nodes = net.terminal.shape[0]
    key = np.full(nodes, np.inf)
    place = np.full(nodes, -1, np.int32)
    heap = np.empty(nodes, np.int32)
    before, entry = np.full(nodes, -1, np.int32), np.full(nodes, -1, np.int32)
    left, spent = np.ones(nodes), np.zeros(nodes)
    settled = np.zeros(nodes, np.bool_)
    reference = max(0.0, net.gain[by_gain[0]])
    best = np.full(top, -np.inf)
    size = heap_push_or_lower(heap, place, key, 0, start, 0.0)
    count, next_gain, steps = 0, 0, 0
    while size > 0 and count < frontiers.shape[0]:
        node = heap_pop(heap, place, key, size)
        size -= 1
        settled[node] = True
        if net.terminal[node]:
            found[count], value[count] = node, _price(net, before, entry, start, node)
            lowest = np.argmin(best)
            best[lowest] = max(best[lowest], value[count])
            count += 1
            if node != start:
                continue
        for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
            other = net.other[edge]
            lost = key[node] + net.cost[edge] + (1.0 - net.discount[edge]) * reference
            if lost < key[other]:
                size = heap_push_or_lower(heap, place, key, size, other, lost)
                before[other], entry[other] = node, edge
                left[other] = left[node] * net.discount[edge]
                spent[other] = spent[node] + left[node] * net.cost[edge]
        steps += 1
        if steps % _LOOK_EVERY == 0 and count >= top:
            while next_gain < by_gain.shape[0] and settled[by_gain[next_gain]]:
                next_gain += 1
            if next_gain == by_gain.shape[0]:
                break
            least = best.min()
            gain = max(0.0, net.gain[by_gain[next_gain]])
            if _most(left, spent, heap, size, gain) < least - _SLACK * (1.0 + abs(least)):
                break
    return count


def best_frontiers(roads: RoadNet, start: int, top: int) -> Slots:
    """The `top` frontiers worth most from `start` (slots; fewer when fewer can be reached), best first.

    The best way depends on what waits at its end, so there is no single tree of best ways. One search from `start`
    gives every frontier a good way, whose worth is a lower bound; these are compared. It ends when no frontier that it
    has not come to can be among the best: its cost goes by how far they are, not by the size of the graph. Ways do not
    pass through other frontiers, which would end them. Equal ones: the lower id first.
    """
    frontiers = roads.frontier_slots()
    if frontiers.size == 0:
        return frontiers
    by_gain = frontiers[np.argsort(-roads.net.gain[frontiers], kind="stable")]
    found, value = np.empty(frontiers.size, np.int32), np.empty(frontiers.size)
    count = _rank(roads.net, start, frontiers, by_gain, top, found, value)
    found, value = found[:count], value[:count]
    order = np.lexsort((roads.net.node_id[found], -value))
    return found[order][:top]

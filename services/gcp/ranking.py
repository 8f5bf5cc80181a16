"""The frontiers that are worth most from where the robot stands, each by a good way, without looking at all of them."""

from __future__ import annotations

from typing import NamedTuple

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


class _Search(NamedTuple):
    """Scratch arrays of a search, (n,) by slot: made once, and left as they were found but for the last four.

    key, place, heap: the queue. came: whether a node was settled. before, entry: the node and the edge by which the
    best way comes. left, spent: its discount and its costs so far.
    """

    key: Floats
    place: Slots
    came: NDArray[np.bool_]
    heap: Slots
    before: Slots
    entry: Slots
    left: Floats
    spent: Floats


@njit
def _price(net: Net, search: _Search, start: int, frontier: int) -> float:
    """Value of the tree's way from `start` to a frontier."""
    node, value = frontier, net.gain[frontier]
    while node != start:
        edge = search.entry[node]
        value = net.discount[edge] * value - net.cost[edge]
        node = search.before[node]
    return value


@njit
def _most(search: _Search, size: int, gain: float) -> float:
    """What a frontier of this gain is worth at most behind the nodes in the heap: left[i] * gain - spent[i]."""
    most = -np.inf
    for k in range(size):
        node = search.heap[k]
        most = max(most, search.left[node] * gain - search.spent[node])
    return most


@njit
def _expand(net: Net, search: _Search, node: int, reference: float, size: int) -> int:
    """Look at the edges of a settled node; returns the size of the heap."""
    for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
        other = net.other[edge]
        lost = search.key[node] + net.cost[edge] + (1.0 - net.discount[edge]) * reference
        if lost < search.key[other]:
            size = heap_push_or_lower(search.heap, search.place, search.key, size, other, lost)
            search.before[other], search.entry[other] = node, edge
            search.left[other] = search.left[node] * net.discount[edge]
            search.spent[other] = search.spent[node] + search.left[node] * net.cost[edge]
    return size


@njit
def _tidy(search: _Search, settled: Slots, steps: int, size: int) -> None:
    """Leave the scratch arrays as they were found."""
    for k in range(steps):
        search.key[settled[k]] = np.inf
        search.came[settled[k]] = False
    for k in range(size):
        search.key[search.heap[k]] = np.inf
        search.place[search.heap[k]] = -1


@njit
def _rank(
    net: Net,
    search: _Search,
    start: int,
    by_gain: Slots,
    top: int,
    settled: Slots,
    found: Slots,
    value: Floats,
) -> tuple[int, int]:
    """Frontiers in the order of a search from `start` with the values of its ways, until the others cannot be among
    the `top` best; (how many were found, how many nodes were settled).

    Edges are weighed c' + (1 - gamma') reference: the value lost on them if what waits behind is worth as much as the
    largest gain. Of every way to come the first part is known: to a node in the heap, with its discount and its costs;
    behind it at most the largest gain waits that was not found yet. by_gain: the frontiers, largest gain first.
    settled: (n,), scratch.
    """
    reference = max(0.0, net.gain[by_gain[0]])
    best = np.full(top, -np.inf)
    search.left[start], search.spent[start] = 1.0, 0.0
    size = heap_push_or_lower(search.heap, search.place, search.key, 0, start, 0.0)
    count, next_gain, steps = 0, 0, 0
    while size > 0 and count < by_gain.shape[0]:
        node = heap_pop(search.heap, search.place, search.key, size)
        size -= 1
        search.came[node] = True
        settled[steps] = node
        steps += 1
        if net.terminal[node]:
            found[count], value[count] = node, _price(net, search, start, node)
            lowest = np.argmin(best)
            best[lowest] = max(best[lowest], value[count])
            count += 1
        if not net.terminal[node] or node == start:
            size = _expand(net, search, node, reference, size)
        if steps % _LOOK_EVERY == 0 and top <= count < by_gain.shape[0]:
            while search.came[by_gain[next_gain]]:
                next_gain += 1
            least = best.min()
            most = _most(search, size, max(0.0, net.gain[by_gain[next_gain]]))
            if most < least - _SLACK * (1.0 + abs(least)):
                break
    _tidy(search, settled, steps, size)
    return count, steps


class Ranking:
    """Finds the best frontiers of a road net."""

    def __init__(self, roads: RoadNet) -> None:
        self._roads = roads
        self._make_room()
        self.steps = 0
        """Nodes settled so far."""

    def _make_room(self) -> None:
        slots = self._roads.slots
        heap, before, entry, self._settled = (np.zeros(slots, np.int32) for _ in range(4))
        key, place, came = np.full(slots, np.inf), np.full(slots, -1, np.int32), np.zeros(slots, np.bool_)
        self._search = _Search(key, place, came, heap, before, entry, np.zeros(slots), np.zeros(slots))

    def best(self, start: int, top: int) -> Slots:
        """The `top` frontiers worth most from `start` (slots; fewer when fewer can be reached), best first.

        The best way depends on what waits at its end, so there is no single tree of best ways. One search from `start`
        gives every frontier a good way, whose worth is a lower bound; these are compared. It ends when no frontier that
        it has not come to can be among the best: its cost goes by how far they are, not by the size of the graph. Ways
        do not pass through other frontiers, which would end them. Equal ones: the lower id first.
        """
        net, frontiers = self._roads.net, self._roads.frontier_slots()
        if frontiers.size == 0:
            return frontiers
        if self._settled.size < self._roads.slots:
            self._make_room()
        by_gain = frontiers[np.argsort(-net.gain[frontiers], kind="stable")]
        found, value = np.empty(frontiers.size, np.int32), np.empty(frontiers.size)
        count, steps = _rank(net, self._search, start, by_gain, top, self._settled, found, value)
        self.steps += steps
        found, value = found[:count], value[:count]
        order = np.lexsort((net.node_id[found], -value))
        return found[order][:top]

"""Values of going to given nodes, kept while the graph changes: what a change does not reach is not computed again.

V(i) = max over j of f_ij(V(j)) from the goals backwards, by lifelong planning (LPA*, Koenig, Likhachev and Furcy 2004,
after Ramalingam and Reps 1996) for the discounted edges of `services.gcp.qmdp`: f_ij(v) = gamma' v - c', but below v. A
way is never worth more for being longer: then values fall along every way, label-setting is exact, and so is its
incremental form; V does not depend on what the graph was before. The bound is felt only where v <= -c' / (1 - gamma'),
that is where the way costs more than driving on for ever (some hundred metres), and at edges that cost nothing (by one
unit in the last place).

A node is consistent when its value g is what its neighbours say (rhs). Inconsistent ones wait in a queue, highest
max(g, rhs) first, and only as many are settled as the nodes asked for need: far ground waits until it matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.search import heap_lift
from services.gcp.roadnet import RoadNet

Floats = NDArray[np.float64]
Slots = NDArray[np.int32]


class Edges(NamedTuple):
    """The net as one kind of field sees it: discount and cost of its edges, and the nodes no way goes through."""

    begin: NDArray[np.int64]
    degree: NDArray[np.int64]
    other: Slots
    discount: Floats
    cost: Floats
    closed: NDArray[np.bool_]


class State(NamedTuple):
    """(n,) each, by slot. value: g; told: rhs; goal: what is paid there, -inf: no goal. key, place, heap: the queue."""

    value: Floats
    told: Floats
    goal: Floats
    key: Floats
    place: Slots
    heap: Slots


def _state(slots: int) -> State:
    """Of a field without goals."""
    value, told, goal, key = (np.full(slots, -np.inf) for _ in range(4))
    return State(value, told, goal, key, np.full(slots, -1, np.int32), np.empty(slots, np.int32))


@njit
def _sink(state: State, slot: int, size: int) -> None:
    """Move the item at `slot` of the queue down to where its key belongs."""
    heap, place, key = state.heap, state.place, state.key
    item = heap[slot]
    while True:
        below = 2 * slot + 1
        if below >= size:
            break
        if below + 1 < size and key[heap[below + 1]] < key[heap[below]]:
            below += 1
        if key[item] <= key[heap[below]]:
            break
        heap[slot] = heap[below]
        place[heap[slot]] = slot
        slot = below
    heap[slot] = item
    place[item] = slot


@njit
def _queue(state: State, node: int, size: int) -> int:
    """Put a node into the queue where it belongs, or take it out if it is consistent; returns the new size."""
    slot = state.place[node]
    if state.value[node] == state.told[node]:
        if slot >= 0:
            state.place[node] = -1
            size -= 1
            if slot < size:
                moved = state.heap[size]
                state.heap[slot], state.place[moved] = moved, slot
                heap_lift(state.heap, state.place, state.key, slot)
                _sink(state, state.place[moved], size)
        return size
    state.key[node] = -max(state.value[node], state.told[node])
    if slot < 0:
        slot = size
        state.heap[slot], state.place[node] = node, slot
        size += 1
    heap_lift(state.heap, state.place, state.key, slot)
    _sink(state, state.place[node], size)
    return size


@njit
def along(discount: float, cost: float, value: float) -> float:
    """f(v): what an edge leaves of the value at its end; always less than that."""
    return min(discount * value - cost, np.nextafter(value, -np.inf))


@njit
def _tell(edges: Edges, state: State, floor: float, node: int) -> None:
    """rhs of a node from its neighbours."""
    best = state.goal[node]
    if best == -np.inf and not edges.closed[node]:
        for edge in range(edges.begin[node], edges.begin[node] + edges.degree[node]):
            other = edges.other[edge]
            if state.value[other] > -np.inf and edges.cost[edge] < np.inf:
                best = max(best, along(edges.discount[edge], edges.cost[edge], state.value[other]))
    state.told[node] = best if best > floor else -np.inf


@njit
def _touch(edges: Edges, state: State, floor: float, nodes: Slots, size: int) -> int:
    """Look again at nodes of which something changed; returns the size of the queue."""
    for k in range(nodes.shape[0]):
        _tell(edges, state, floor, nodes[k])
        size = _queue(state, nodes[k], size)
    return size


@njit
def _raise(edges: Edges, state: State, floor: float, node: int, size: int) -> int:
    """A node is worth more than was known: so may its neighbours."""
    value = state.told[node]
    state.value[node] = value
    for edge in range(edges.begin[node], edges.begin[node] + edges.degree[node]):
        other = edges.other[edge]
        if state.goal[other] > -np.inf or edges.closed[other] or edges.cost[edge] == np.inf:
            continue
        worth = along(edges.discount[edge], edges.cost[edge], value)
        if worth > state.told[other] and worth > floor:
            state.told[other] = worth
            size = _queue(state, other, size)
    return size


@njit
def _lower(edges: Edges, state: State, floor: float, node: int, size: int) -> int:
    """A node is worth less than was known: those that counted on it look again."""
    old = state.value[node]
    state.value[node] = -np.inf
    for edge in range(edges.begin[node], edges.begin[node] + edges.degree[node]):
        other = edges.other[edge]
        if state.told[other] == along(edges.discount[edge], edges.cost[edge], old):
            _tell(edges, state, floor, other)
            size = _queue(state, other, size)
    return size


@njit
def _settle(edges: Edges, state: State, floor: float, wanted: Slots, size: int) -> tuple[int, int]:
    """Make the values of the wanted nodes true; (size of the queue, how many nodes were gone through).

    Keys come out of the queue in ascending order, and what a node does to others has a larger key: the first of the
    wanted nodes, once it is consistent and before the rest of the queue, stays as it is.
    """
    steps, done = 0, 0
    while size > 0:
        while done < wanted.shape[0]:
            node = wanted[done]
            if state.place[node] >= 0 or -state.value[node] > state.key[state.heap[0]]:
                break
            done += 1
        if done == wanted.shape[0]:
            break
        node = state.heap[0]
        steps += 1
        if state.told[node] > state.value[node]:
            size = _raise(edges, state, floor, node, size)
        else:
            size = _lower(edges, state, floor, node, size)
        size = _queue(state, node, size)
    return size, steps


@njit
def next_node(edges: Edges, state: State, node: int) -> int:
    """Where a node's value comes from: the neighbour of lowest id that gives it; -1 at a goal and without a value."""
    if state.goal[node] > -np.inf or state.value[node] == -np.inf:
        return -1
    for edge in range(edges.begin[node], edges.begin[node] + edges.degree[node]):
        value = state.value[edges.other[edge]]
        open_ = value > -np.inf and edges.cost[edge] < np.inf
        if open_ and along(edges.discount[edge], edges.cost[edge], value) == state.value[node]:
            return edges.other[edge]
    return -1


@njit
def _next_nodes(edges: Edges, state: State, nodes: Slots, out: Slots) -> None:
    for k in range(nodes.shape[0]):
        out[k] = next_node(edges, state, nodes[k])


@njit
def _way(edges: Edges, state: State, start: int, first: int, out: Slots) -> int:
    """Fill `out` with the way from `start` by `first` to the goal, without the loop if it comes by again; length."""
    out[0] = start
    length = 1
    node = first
    while node >= 0:
        if node == start:
            length = 0
        out[length] = node
        length += 1
        node = next_node(edges, state, node)
    return length


class Field:
    """V of going to goals over a road net, which it follows by `touch`.

    floor: values at or below it are not made. home: undiscounted costs, and ways may go through frontiers.
    """

    def __init__(self, roads: RoadNet, floor: float = -np.inf, home: bool = False) -> None:
        self._roads, self._floor, self._home = roads, floor, home
        self._state = _state(0)
        self._size = 0
        self._ones, self._nowhere = np.empty(0), np.empty(0, np.bool_)
        self.steps = 0
        """Nodes gone through so far."""

    def _edges(self) -> Edges:
        net = self._roads.net
        if not self._home:
            return Edges(net.begin, net.degree, net.other, net.discount, net.cost, net.terminal)
        if self._ones.size != net.other.size or self._nowhere.size != net.begin.size:
            self._ones, self._nowhere = np.ones(net.other.size), np.zeros(net.begin.size, np.bool_)
        return Edges(net.begin, net.degree, net.other, self._ones, net.home_cost, self._nowhere)

    def touch(self, nodes: Slots) -> None:
        """Take in that something changed at nodes (slots): their edges, whether they are frontiers."""
        self._grow()
        self._size = _touch(self._edges(), self._state, self._floor, nodes, self._size)

    def pay(self, nodes: Slots, gains: Floats) -> None:
        """What is paid at nodes from now on, -inf: they are no goals."""
        self._grow()
        self._state.goal[nodes] = gains
        self._size = _touch(self._edges(), self._state, self._floor, nodes, self._size)

    def _grow(self) -> None:
        old, slots = self._state, self._roads.slots
        if old.value.size < slots:
            self._state = _state(slots)
            for name in State._fields:
                getattr(self._state, name)[: old.value.size] = getattr(old, name)

    def values(self, nodes: Slots) -> Floats:
        """V at nodes (slots), -inf where no way is worth more than the floor."""
        self._grow()
        self._size, steps = _settle(self._edges(), self._state, self._floor, nodes, self._size)
        self.steps += steps
        return self._state.value[nodes]

    def next_nodes(self, nodes: Slots) -> Slots:
        """Where the policy goes from nodes whose values were asked for: slots, -1 at goals and without a value."""
        found = np.empty(nodes.size, np.int32)
        _next_nodes(self._edges(), self._state, nodes, found)
        return found

    def way(self, start: int, first: int) -> Slots:
        """Slots from `start` by way of `first` to the goal; no node twice. Their values were asked for."""
        found = np.empty(self._roads.slots + 2, np.int32)
        return found[: _way(self._edges(), self._state, start, first, found)].copy()

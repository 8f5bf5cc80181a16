"""The arrays of a road net, and what changes them.

Nodes live in slots and keep them; the edges of a node lie one after the other, by the id of their other end, in a pool
with room to grow. Kernels go through the neighbours by id, so that nothing computed depends on slots.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

Floats = NDArray[np.float64]
Slots = NDArray[np.int32]


class Net(NamedTuple):
    """Arrays for kernels: (n,) by slot, (e,) by place in the pool; edges of slot s: begin[s] to begin[s] + degree[s].

    node_id: (n,), -1 in a slot without a node. terminal: (n,), frontiers. gain: (n,) what a frontier pays on arrival,
    k_I times its information gain. room: (n,) places that a slot has in the pool.
    other: (e,) slot of the other end. distance_m, risk: (e,). discount, cost: (e,), see `services.gcp.qmdp.edge_terms`;
    home_cost: (e,) the cost without discount.
    """

    node_id: NDArray[np.int64]
    terminal: NDArray[np.bool_]
    gain: Floats
    begin: NDArray[np.int64]
    degree: NDArray[np.int64]
    room: NDArray[np.int64]
    other: Slots
    distance_m: Floats
    risk: Floats
    discount: Floats
    cost: Floats
    home_cost: Floats


def empty_net(slots: int, pool: int) -> Net:
    """A net without nodes."""
    begin, degree, room = (np.zeros(slots, np.int64) for _ in range(3))
    distance_m, risk, discount, cost, home_cost = (np.zeros(pool) for _ in range(5))
    return Net(
        np.full(slots, -1, np.int64),
        np.zeros(slots, np.bool_),
        np.zeros(slots),
        begin,
        degree,
        room,
        np.zeros(pool, np.int32),
        distance_m,
        risk,
        discount,
        cost,
        home_cost,
    )


@njit
def find_edge(net: Net, node: int, other: int) -> int:
    """Place in the pool of the edge from one slot to another, -1 when there is none."""
    for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
        if net.other[edge] == other:
            return edge
    return -1


@njit
def _copy_edge(net: Net, source: int, target: int) -> None:
    net.other[target] = net.other[source]
    net.distance_m[target] = net.distance_m[source]
    net.risk[target] = net.risk[source]
    net.discount[target] = net.discount[source]
    net.cost[target] = net.cost[source]
    net.home_cost[target] = net.home_cost[source]


@njit
def _drop_half(net: Net, node: int, other: int) -> bool:
    """Forget the edge in one direction; whether it was there."""
    edge = find_edge(net, node, other)
    if edge < 0:
        return False
    last = net.begin[node] + net.degree[node] - 1
    for place in range(edge, last):
        _copy_edge(net, place + 1, place)
    net.degree[node] -= 1
    return True


@njit
def drop_edges(net: Net, a: Slots, b: Slots) -> None:
    """Forget edges, both directions; unknown ones are passed over."""
    for k in range(a.shape[0]):
        if a[k] >= 0 and b[k] >= 0 and _drop_half(net, a[k], b[k]):
            _drop_half(net, b[k], a[k])


@njit
def drop_node(net: Net, node: int) -> None:
    """Forget a node and its edges. Its slot keeps its room in the pool."""
    for edge in range(net.begin[node], net.begin[node] + net.degree[node]):
        _drop_half(net, net.other[edge], node)
    net.degree[node] = 0
    net.node_id[node] = -1
    net.terminal[node] = False


@njit
def _place_half(net: Net, node: int, other: int, used: int) -> tuple[int, int]:
    """A place for the edge from a node to another, by the other's id; (place, used), place -1 when the pool is full."""
    edge = find_edge(net, node, other)
    if edge >= 0:
        return edge, used
    if net.degree[node] == net.room[node]:
        room = max(4, 2 * net.room[node])
        if used + room > net.other.shape[0]:
            return -1, used
        for k in range(net.degree[node]):
            _copy_edge(net, net.begin[node] + k, used + k)
        net.begin[node], net.room[node] = used, room
        used += room
    place = net.begin[node] + net.degree[node]
    while place > net.begin[node] and net.node_id[net.other[place - 1]] > net.node_id[other]:
        _copy_edge(net, place - 1, place)
        place -= 1
    net.degree[node] += 1
    net.other[place] = other
    return place, used


@njit
def put_edges(net: Net, a: Slots, b: Slots, columns: Floats, first: int, used: int) -> tuple[int, int]:
    """Insert or replace edges from `first` on, both directions; columns: (5, m) as in `Net` from distance_m on.

    Returns (the first edge that found no place, used places of the pool).
    """
    for k in range(first, a.shape[0]):
        for one, other in ((a[k], b[k]), (b[k], a[k])):
            place, used = _place_half(net, one, other, used)
            if place < 0:
                return k, used
            net.distance_m[place] = columns[0, k]
            net.risk[place] = columns[1, k]
            net.discount[place] = columns[2, k]
            net.cost[place] = columns[3, k]
            net.home_cost[place] = columns[4, k]
    return a.shape[0], used


@njit
def move_pool(net: Net, larger: Net) -> int:
    """Copy all edges into a larger pool, without gaps; returns how many places are used."""
    used = 0
    for node in range(net.begin.shape[0]):
        old, new = net.begin[node], used
        for k in range(net.degree[node]):
            larger.other[new + k] = net.other[old + k]
            larger.distance_m[new + k] = net.distance_m[old + k]
            larger.risk[new + k] = net.risk[old + k]
            larger.discount[new + k] = net.discount[old + k]
            larger.cost[new + k] = net.cost[old + k]
            larger.home_cost[new + k] = net.home_cost[old + k]
        net.begin[node] = new
        used += net.room[node]
    return used

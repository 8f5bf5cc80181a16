"""QMDP on the Global IRM (paper, Global Coverage Planner; Littman et al. 1995).

States are the nodes of the Global IRM in CSR form. Frontiers are terminal and pay their expected information
gain g. An action at node i traverses one edge to j: it costs c = k_C (k_d d + k_rho rho + k_mu mu), is discounted
by travel, gamma = gamma_per_m ** d, and fails with probability rho. A failure "stays and may retry": an
approximation (a real failure may leave the robot stuck). Then

    Q(i, j) = -c + gamma [(1 - rho) V(j) + rho V(i)],   V(i) = max_j Q(i, j),   V(frontier) = g,

and eliminating the self-loop gives Q(i, j) = -c' + gamma' V(j) with gamma' = gamma (1 - rho) / (1 - gamma rho)
and c' = c / (1 - gamma rho).

Label-setting from the frontiers solves this exactly when no label exceeds its predecessor, that is where V >= 0
or c' >= (1 - gamma') |V|. Values may be negative, so its result is only the first policy of an exact policy
iteration: every policy is a functional graph, evaluated in O(N), cycles in closed form. Where label-setting was
right, that takes a single check of the Bellman equation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planning.kernels import njit
from planning.search import heap_pop, heap_push_or_lower
from services.gcp.labels import best_labels, reaching

STAY = -1
"""Action of a frontier, of a node where staying is best and of a node that reaches no frontier."""
_MAX_ITERATIONS = 10_000
_IMPROVEMENT = 1e-13


class EdgeTerms(NamedTuple):
    """Edges after the self-loop of failures is eliminated, (E,) each; an impassable edge has an infinite cost."""

    discount: NDArray[np.float64]
    cost: NDArray[np.float64]


class GlobalGraph(NamedTuple):
    """The Global IRM as the solver sees it.

    indptr (N + 1,), indices (E,): edges of node i are indptr[i] to indptr[i + 1].
    discount, cost: (E,), see `edge_terms`.
    terminal: (N,), the frontiers. gain: (N,), expected information gain, read at frontiers only.
    reverse_indptr, reverse_source, reverse_edge, reverse_discount, reverse_cost: the same edges by their end node
    (copies: who replaces `cost` replaces `reverse_cost` too).
    """

    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    discount: NDArray[np.float64]
    cost: NDArray[np.float64]
    terminal: NDArray[np.bool_]
    gain: NDArray[np.float64]
    reverse_indptr: NDArray[np.int32]
    reverse_source: NDArray[np.int32]
    reverse_edge: NDArray[np.int32]
    reverse_discount: NDArray[np.float64]
    reverse_cost: NDArray[np.float64]


class QmdpSolution(NamedTuple):
    """Value and policy at every node.

    value: (N,) expected discounted return; 0 where no frontier can be reached.
    action: (N,) edge to take (index into `indices`), or `STAY`.
    reaches_frontier: (N,) whether any passable path leads to a frontier.
    residual: largest violation of the Bellman equation.
    iterations: policy improvements after label-setting; 0 where that was already exact.
    """

    value: NDArray[np.float64]
    action: NDArray[np.int32]
    reaches_frontier: NDArray[np.bool_]
    residual: float
    iterations: int


def edge_terms(distance_m: ArrayLike, risk: ArrayLike, cost: ArrayLike, gamma_per_m: float) -> EdgeTerms:
    """Eliminate "fails with probability rho and stays" from edges (any shape).

    Args:
        distance_m: length, >= 0; infinite: impassable.
        risk: rho in [0, 1]; 1: impassable.
        cost: cost of one attempt, >= 0; infinite: impassable.
        gamma_per_m: discount for a metre, in (0, 1].

    Raises:
        ValueError: for NaN, negative numbers, a risk above 1 or a discount outside (0, 1].
    """
    d, rho, c = (np.asarray(a, dtype=np.float64) for a in (distance_m, risk, cost))
    if not 0.0 < gamma_per_m <= 1.0:
        raise ValueError(f"gamma_per_m must lie in (0, 1], got {gamma_per_m}")
    for name, values, high in (("distance_m", d, np.inf), ("risk", rho, 1.0), ("cost", c, np.inf)):
        if not np.all((values >= 0.0) & (values <= high)):
            raise ValueError(f"{name} must lie in [0, {high}] and not be NaN")
    passable = np.isfinite(d) & np.isfinite(c) & (rho < 1.0)
    gamma = gamma_per_m ** np.where(passable, d, 0.0)
    rho = np.where(passable, rho, 0.0)
    retry = 1.0 - gamma * rho
    discount = np.where(passable, gamma * (1.0 - rho) / retry, 0.0)
    return EdgeTerms(discount, np.where(passable, c, np.inf) / retry)


def global_graph(
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    terms: EdgeTerms,
    frontiers: NDArray[np.int32],
    gains: NDArray[np.float64],
) -> GlobalGraph:
    """Assemble and check the solver's input.

    Args:
        indptr, indices: (N + 1,), (E,) CSR of the directed edges; both directions of a two-way edge.
        terms: (E,) discount and cost.
        frontiers: (F,) terminal nodes. gains: (F,) what each pays, finite, in the cost's unit.

    Raises:
        ValueError: on indices out of range, wrong lengths or gains that are not finite.
    """
    nodes, edges = len(indptr) - 1, len(indices)
    if nodes < 0 or indptr[0] != 0 or indptr[-1] != edges or np.any(np.diff(indptr) < 0):
        raise ValueError("indptr is not a CSR row pointer of these indices")
    if terms.discount.shape != (edges,) or terms.cost.shape != (edges,) or gains.shape != frontiers.shape:
        raise ValueError("edge terms or gains do not match the graph in length")
    for name, ids in (("indices", indices), ("frontiers", frontiers)):
        if len(ids) and (ids.min() < 0 or ids.max() >= nodes):
            raise ValueError(f"{name} name a node outside [0, {nodes})")
    if not np.isfinite(gains).all():
        raise ValueError("gains must be finite")
    terminal = np.zeros(nodes, np.bool_)
    terminal[frontiers] = True
    gain = np.zeros(nodes)
    gain[frontiers] = gains
    start, end = indptr.astype(np.int32), indices.astype(np.int32)
    reverse_indptr, source, edge = _transpose(start, end)
    return GlobalGraph(
        start, end, terms.discount, terms.cost, terminal, gain, reverse_indptr, source, edge,
        terms.discount[edge], terms.cost[edge],
    )  # fmt: skip


@njit
def _transpose(
    indptr: NDArray[np.int32], indices: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """The edges sorted by end node: row pointer, start node and edge index."""
    nodes = indptr.shape[0] - 1
    reverse_indptr = np.zeros(nodes + 1, np.int32)
    for edge in range(indices.shape[0]):
        reverse_indptr[indices[edge] + 1] += 1
    for node in range(nodes):
        reverse_indptr[node + 1] += reverse_indptr[node]
    fill = reverse_indptr[:-1].copy()
    source = np.empty(indices.shape[0], np.int32)
    reverse_edge = np.empty(indices.shape[0], np.int32)
    for node in range(nodes):
        for edge in range(indptr[node], indptr[node + 1]):
            slot = fill[indices[edge]]
            source[slot] = node
            reverse_edge[slot] = edge
            fill[indices[edge]] += 1
    return reverse_indptr, source, reverse_edge


@njit
def label_setting(
    graph: GlobalGraph, targets: NDArray[np.int32], floor: float, stop_node: int, action: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Best labels from the targets backwards, highest first; labels at or below `floor` are not made.

    The result is the exact value of the policy in `action`, which never cycles. Without labels: -inf and STAY.
    Stops once `stop_node` is settled (-1: never).
    """
    wanted = np.full(1 if stop_node >= 0 else 0, stop_node, np.int32)
    return label_setting_to(graph, targets, floor, wanted, action)


@njit
def label_setting_to(
    graph: GlobalGraph,
    targets: NDArray[np.int32],
    floor: float,
    wanted: NDArray[np.int32],
    action: NDArray[np.int32],
) -> NDArray[np.float64]:
    """`label_setting` that stops once all nodes in `wanted` (no node twice; empty: never) are settled.

    Then only they, and the nodes on their ways, have their best labels; those of other nodes may be too low.
    """
    nodes = graph.terminal.shape[0]
    key = np.full(nodes, np.inf)  # minus the label: the heap gives the smallest key first
    place = np.full(nodes, -1, np.int32)
    heap = np.empty(nodes, np.int32)
    settled = np.zeros(nodes, np.bool_)
    is_wanted = np.zeros(nodes, np.bool_)
    is_wanted[wanted] = True
    left = wanted.shape[0]
    action[:] = STAY
    size = 0
    for k in range(targets.shape[0]):
        size = heap_push_or_lower(heap, place, key, size, targets[k], -graph.gain[targets[k]])
    while size > 0:
        node = heap_pop(heap, place, key, size)
        size -= 1
        settled[node] = True
        if is_wanted[node]:
            left -= 1
            if left == 0:
                break
        for slot in range(graph.reverse_indptr[node], graph.reverse_indptr[node + 1]):
            other, edge = graph.reverse_source[slot], graph.reverse_edge[slot]
            if settled[other] or graph.terminal[other] or graph.cost[edge] == np.inf:
                continue
            label = -graph.cost[edge] - graph.discount[edge] * key[node]
            if label > floor and -label < key[other]:
                size = heap_push_or_lower(heap, place, key, size, other, -label)
                action[other] = edge
    return -key


@njit
def _improve(
    graph: GlobalGraph,
    usable: NDArray[np.bool_],
    allow_stay: bool,
    value: NDArray[np.float64],
    action: NDArray[np.int32],
) -> tuple[int, float]:
    """One greedy improvement of `action`; returns how many actions changed and the Bellman residual before."""
    changed = 0
    residual = 0.0
    for node in range(graph.terminal.shape[0]):
        if graph.terminal[node] or not usable[node]:
            continue
        best = 0.0 if allow_stay else -np.inf
        best_edge = STAY
        for edge in range(graph.indptr[node], graph.indptr[node + 1]):
            if usable[graph.indices[edge]] and graph.cost[edge] < np.inf:
                q = graph.discount[edge] * value[graph.indices[edge]] - graph.cost[edge]
                if q > best:
                    best = q
                    best_edge = edge
        residual = max(residual, abs(best - value[node]))
        if best > value[node] + _IMPROVEMENT * (1.0 + abs(value[node])):
            action[node] = best_edge
            changed += 1
    return changed, residual


@njit
def _evaluate(
    graph: GlobalGraph, usable: NDArray[np.bool_], action: NDArray[np.int32], value: NDArray[np.float64]
) -> None:
    """Exact value of a policy. Following it from any node ends at a terminal, at STAY or in a cycle.

    A cycle of total discount D < 1 and return A has the value A / (1 - D); one with D = 1 never pays: -inf.
    """
    nodes = action.shape[0]
    mark = np.full(nodes, -1, np.int32)  # start node of the walk that came by; -2: done
    walk = np.empty(nodes, np.int32)
    for node in range(nodes):
        if graph.terminal[node]:
            value[node] = graph.gain[node]
            mark[node] = -2
        elif action[node] == STAY or not usable[node]:
            value[node] = 0.0
            mark[node] = -2
    for first in range(nodes):
        node = first
        length = 0
        while mark[node] == -1:
            mark[node] = first
            walk[length] = node
            length += 1
            node = graph.indices[action[node]]
        if mark[node] == first and length > 0:
            total, discount, other = 0.0, 1.0, node
            while True:
                edge = action[other]
                total -= discount * graph.cost[edge]
                discount *= graph.discount[edge]
                other = graph.indices[edge]
                if other == node:
                    break
            value[node] = total / (1.0 - discount) if discount < 1.0 else -np.inf
        for k in range(length - 1, -1, -1):
            other = walk[k]
            if other != node:
                edge = action[other]
                value[other] = graph.discount[edge] * value[graph.indices[edge]] - graph.cost[edge]
            mark[other] = -2


@njit
def _solve(
    graph: GlobalGraph, allow_stay: bool
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.bool_], float, int]:
    nodes = graph.terminal.shape[0]
    action = np.empty(nodes, np.int32)
    value, left = best_labels(
        graph.reverse_indptr, graph.reverse_source, graph.reverse_edge, graph.reverse_discount,
        graph.reverse_cost, graph.terminal, graph.gain, 0.0 if allow_stay else -np.inf, action,
    )  # fmt: skip
    reached = reaching(
        graph.indptr,
        graph.indices,
        graph.cost,
        graph.reverse_indptr,
        graph.reverse_source,
        graph.reverse_cost,
        value,
    )
    for node in range(nodes):
        if value[node] == -np.inf:
            value[node] = 0.0
    if left <= _IMPROVEMENT:  # no edge is worth more than the action taken: the Bellman equation holds
        return value, action, reached, left, 0
    usable = np.ones(nodes, np.bool_) if allow_stay else reached
    iterations = 0
    while True:
        changed, residual = _improve(graph, usable, allow_stay, value, action)
        if changed == 0 or iterations >= _MAX_ITERATIONS:
            return value, action, reached, residual, iterations
        _evaluate(graph, usable, action, value)
        iterations += 1


def solve(graph: GlobalGraph, allow_stay: bool = True, tolerance: float = 1e-9) -> QmdpSolution:
    """Optimal value and policy at every node.

    Args:
        graph: see `global_graph`.
        allow_stay: staying, of value 0, is an action everywhere, so that no value is negative except a frontier's
            own. Without it the robot must go on for ever or reach a frontier: values may be negative and are
            exact; edges to nodes that reach no frontier are then no actions, and such nodes have the value 0.
            With an undiscounted edge cycle of no cost, the value is that of the best way to a frontier.
        tolerance: accepted Bellman residual, relative to 1 + max |V|.

    Raises:
        ArithmeticError: if the residual stays above the tolerance (not seen; it guards the proof above).
    """
    value, action, reached, residual, iterations = _solve(graph, allow_stay)
    if not residual <= tolerance * (1.0 + float(np.abs(value).max(initial=0.0))):
        raise ArithmeticError(
            f"QMDP did not converge: Bellman residual {residual} after {iterations} iterations"
        )
    return QmdpSolution(value, action, reached, float(residual), int(iterations))


def edge_q(graph: GlobalGraph, value: NDArray[np.float64], node: int) -> NDArray[np.float64]:
    """Q(node, edge) of all edges indptr[node] to indptr[node + 1]; -inf for impassable ones."""
    part = slice(graph.indptr[node], graph.indptr[node + 1])
    return graph.discount[part] * value[graph.indices[part]] - graph.cost[part]


def follow_policy(
    graph: GlobalGraph, action: NDArray[np.int32], node: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Nodes (k + 1,) and edges (k,) visited by the policy from a node, until STAY or the first repeated node."""
    nodes, edges, seen = [node], [], {node}
    while action[nodes[-1]] != STAY:
        edges.append(int(action[nodes[-1]]))
        nodes.append(int(graph.indices[edges[-1]]))
        if nodes[-1] in seen:
            break
        seen.add(nodes[-1])
    return np.array(nodes, np.int32), np.array(edges, np.int32)


def straight_distances_m(poses_m: NDArray[np.float64], nodes_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Straight 3D distances (P, C) from pose particles (P, 3) to candidate nodes (C, 3)."""
    distances: NDArray[np.float64] = np.linalg.norm(poses_m[:, None, :] - nodes_m[None, :, :], axis=2)
    return distances


def relocation_q(
    node_value: NDArray[np.float64],
    pose_weights: NDArray[np.float64],
    terms: EdgeTerms,
    blocked_value: float = 0.0,
) -> NDArray[np.float64]:
    """Q(b, a) = sum over q of b(q) Q_MDP(q, a), where a is "relocate to candidate node j" (paper, QMDP).

    An edge belongs to one node, so it is no action for a pose elsewhere; relocation is one for every pose q:
    Q_MDP(q, j) = -c'(q, j) + gamma'(q, j) V(j), the pose known after the first action.

    Args:
        node_value: (C,) V of the candidate nodes (a frontier's gain included).
        pose_weights: (P,) weights of the pose particles; normalised here.
        terms: `edge_terms` of (P, C) matrices of distance (straight or along a path), risk and cost.
        blocked_value: what a particle contributes from which the candidate is out of reach (infinite cost): it
            finds that out and stays.

    Returns:
        (C,) Q(b, a).

    Raises:
        ValueError: for weights that are negative or sum to zero.
    """
    total = float(pose_weights.sum())
    if not total > 0.0 or pose_weights.min() < 0.0:
        raise ValueError("pose weights must be >= 0 and not all zero")
    reachable = np.isfinite(terms.cost)
    q = terms.discount * node_value[None, :] - np.where(reachable, terms.cost, 0.0)
    expected: NDArray[np.float64] = (pose_weights / total) @ np.where(reachable, q, blocked_value)
    return expected

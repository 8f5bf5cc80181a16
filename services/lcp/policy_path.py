"""The most likely branch of a policy as nodes and as a line to drive."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.coverage_model import (
    MACRO_STEPS,
    MAX_EDGE_RISK,
    SWEEP,
    SWEEP_STEPS,
    CoverageModel,
    evaluate_moves,
    follow_rule,
    look,
    look_on_turn,
)
from planning.coverage_tiles import nodes_of_tiles
from planning.lattice_graph import neighbour, travel_costs
from planning.pomcp import PolicyTree
from schemas.world import LocalIrm

_FEW_PATCHES = 3
"""Steps that newly cover no more patches than this are made for them alone."""


def likely_moves(
    model: CoverageModel, tree: PolicyTree, node: int, heading: int, steps: int
) -> tuple[list[int], int]:
    """Moves along the most visited observations of the tree, then along the informed rule.

    Returns the moves (directions) and how many of them the tree gave.
    """
    covered = model.covered.copy()
    moves: list[int] = []
    at = 0
    while at >= 0 and len(moves) < steps and tree.node_action[at] >= 0:
        action = int(tree.node_action[at])
        for k in _unfold(model, action, node, heading, covered):
            look_on_turn(model, node, heading, k, covered)
            node, heading = neighbour(node, k, model.size), k
            look(model, node, k, covered)
            moves.append(k)
        at = _likely_child(tree, at)
    in_tree = min(len(moves), steps)
    if len(moves) < steps:
        rest = np.zeros(steps - len(moves), np.int64)
        count = follow_rule(model, node, heading, covered, rest)
        moves += [int(k) for k in rest[:count]]
    return moves[:steps], in_tree


def covered_by(model: CoverageModel, node: int, heading: int, moves: list[int]) -> NDArray[np.bool_]:
    """The nodes that these moves newly cover when nothing is blocked, (n,)."""
    covered, scratch = (
        model.covered.copy(),
        (np.zeros(len(moves)), np.zeros(len(moves)), np.zeros(len(moves))),
    )
    evaluate_moves(model, node, heading, np.array(moves, np.int64), covered, *scratch)
    return nodes_of_tiles(covered & ~model.covered, model.size)


def step_terms(
    model: CoverageModel, node: int, heading: int, moves: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Of the step into each node of a path (the first: 0): its expected reward, and whether a look hangs on it.

    A look hangs on a step that covers only a few patches: leftovers, seen from that node under that heading, which a
    smoother line would pass by. Amid fresh ground any line will do. Both (len(moves) + 1,).
    """
    steps = np.array(moves, np.int64)
    reward, scratch = np.zeros(len(steps)), (np.zeros(len(steps)), np.zeros(len(steps)))
    evaluate_moves(model, node, heading, steps, model.covered.copy(), reward, *scratch)
    covered, looks = model.covered.copy(), np.zeros(len(steps) + 1, np.uint8)
    before = int(np.bitwise_count(covered).sum())
    for i, k in enumerate(moves):
        if model.looks_on_turn:
            look(model, node, k, covered)
        node = neighbour(node, k, model.size)
        look(model, node, k, covered)
        after = int(np.bitwise_count(covered).sum())
        looks[i + 1], before = 0 < after - before <= _FEW_PATCHES, after
    return np.concatenate([np.zeros(1), reward]), looks


def _unfold(
    model: CoverageModel, action: int, node: int, heading: int, covered: NDArray[np.uint64]
) -> list[int]:
    """The single moves of an action when nothing is blocked.

    None where this node has no such edge: the actions of a history are those of its first particle, which may stand on
    another node than the junction.
    """
    if action == SWEEP:
        rest = np.zeros(SWEEP_STEPS, np.int64)
        return [int(k) for k in rest[: follow_rule(model, node, heading, covered.copy(), rest)]]
    moves: list[int] = []
    k, most = action % 8, 1 if action < 8 else MACRO_STEPS
    while (
        len(moves) < most
        and model.edge_distance_m[node, k] > 0.0
        and model.edge_risk[node, k] <= MAX_EDGE_RISK
    ):
        moves.append(k)
        node = neighbour(node, k, model.size)
    return moves


def _likely_child(tree: PolicyTree, at: int) -> int:
    span = range(int(tree.child_start[at]), int(tree.child_start[at + 1]))
    children = [int(tree.child_node[c]) for c in span]
    return max(children, key=lambda c: (int(tree.node_visits[c]), -c)) if children else -1


def moves_to(irm: LocalIrm, start: int, goal: int, risk_weight_m: float, max_risk: float) -> list[int] | None:
    """The cheapest moves from a node to another, or None when there is no way."""
    n = irm.size * irm.size
    cost, move = np.empty(n), np.empty(n, np.int8)
    travel_costs(goal, irm.size, irm.edge_distance_m, irm.edge_risk, risk_weight_m, max_risk, cost, move)
    if not math.isfinite(cost[start]):
        return None
    moves: list[int] = []
    while start != goal:
        moves.append(int(move[start]))
        start = neighbour(start, moves[-1], irm.size)
    return moves


def line_of(
    irm: LocalIrm, start: int, moves: list[int]
) -> tuple[list[int], list[tuple[float, float]], list[int]]:
    """Nodes, the line through their anchors (with the inner points of bent edges), and each node's point in it."""
    bent = {int(e): b for b, e in enumerate(irm.bent_edge)}
    node = start
    nodes, points = [start], [_anchor(irm, start)]
    at = [0]
    for k in moves:
        other = neighbour(node, k, irm.size)
        points += _inner_points(irm, bent, node, other, k)
        points.append(_anchor(irm, other))
        nodes.append(other)
        at.append(len(points) - 1)
        node = other
    return nodes, points, at


def _anchor(irm: LocalIrm, node: int) -> tuple[float, float]:
    return float(irm.anchor_m[node, 0]), float(irm.anchor_m[node, 1])


def _inner_points(
    irm: LocalIrm, bent: dict[int, int], node: int, other: int, k: int
) -> list[tuple[float, float]]:
    key, reverse = (node * 8 + k, False) if k < 4 else (other * 8 + k - 4, True)
    b = bent.get(key)
    if b is None:
        return []
    inner = irm.bent_xy[int(irm.bent_start[b]) : int(irm.bent_start[b + 1])]
    points = [(float(x), float(y)) for x, y in inner]
    return points[::-1] if reverse else points

"""Phase 1: the node of the Local IRM that a path of the Global IRM leads to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from planning.frames import planar
from planning.lattice_graph import travel_costs
from schemas.policy import GlobalPolicy
from schemas.world import LocalIrm
from services.lcp.policy_path import moves_to
from services.lcp.problem import node_at

_AT_PLACE = 1.5
"""A node stands for a place of the path when its anchor is so near, in spacings."""
_STEP_M = 0.5
"""Points of a straight piece are so far apart."""

Point = tuple[float, float]


def way_along(
    irm: LocalIrm, policy: GlobalPolicy, start: int, risk_weight_m: float, max_risk: float
) -> list[int]:
    """Moves from a node to the farthest place of the global path that the lattice reaches; none when it is there.

    A place is reached at the nearest of the nodes around it to which the lattice leads: in the patch that holds it the
    anchor may lie on the other side of a wall. Where the path leaves the window, and where the lattice leads to no
    place of it, points of its straight pieces stand in.
    """
    cost, move = np.empty(irm.size**2), np.empty(irm.size**2, np.int8)
    travel_costs(start, irm.size, irm.edge_distance_m, irm.edge_risk, risk_weight_m, max_risk, cost, move)
    to_odom = planar(policy.map_to_odom).inverse()
    places = [to_odom.apply(float(x), float(y)) for x, y, _ in policy.path_xyz_m]
    goal = _farthest(irm, places, policy.path_piece.tolist(), np.isfinite(cost))
    if goal < 0 or goal == start:
        return []
    return moves_to(irm, start, goal, risk_weight_m, max_risk) or []


def _farthest(
    irm: LocalIrm, places: Sequence[Point], pieces: Sequence[int], reached: NDArray[np.bool_]
) -> int:
    """The node of the last place that is reached, or -1. places: the first is the robot's."""
    usable = np.flatnonzero(reached & (irm.state == 1))
    if len(usable) == 0:
        return -1
    for i in range(len(places) - 1, 0, -1):
        if node_at(irm, *places[i]) >= 0:
            node = _node_of_place(irm, usable, places[i])
        else:
            node = next(_on_piece(irm, usable, places[i - 1], places[i], pieces[i - 1] == pieces[i]), -1)
        if node >= 0:
            return node
    for i in range(len(places) - 1, 0, -1):
        node = next(_on_piece(irm, usable, places[i - 1], places[i], pieces[i - 1] == pieces[i]), -1)
        if node >= 0:
            return node
    return -1


def _node_of_place(irm: LocalIrm, usable: NDArray[np.int64], place: Point) -> int:
    away_m = np.hypot(*(irm.anchor_m[usable] - np.array(place)).T)
    nearest = int(np.argmin(away_m))
    return int(usable[nearest]) if away_m[nearest] <= _AT_PLACE * irm.spacing_m else -1


def _on_piece(
    irm: LocalIrm, usable: NDArray[np.int64], start: Point, end: Point, joined: bool
) -> Iterator[int]:
    """Nodes whose patch a straight piece crosses, from its end on; none where the path is interrupted."""
    steps = max(1, math.ceil(math.dist(start, end) / _STEP_M)) if joined else 0
    for i in range(steps, 0, -1):
        node = node_at(irm, *(a + (b - a) * i / steps for a, b in zip(start, end, strict=True)))
        if node >= 0 and np.any(usable == node):
            yield node

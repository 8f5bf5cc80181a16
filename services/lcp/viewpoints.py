"""Viewpoints and the paths to them: the policy search space of next-best-view planning (Bircher et al. 2016).

A viewpoint is a node of the Local IRM under a heading. Its path is the cheapest one to the neighbour from which it is
entered under that heading, and the step from there. Paths are valued by the model and the reward of the other planners.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_build import RootBelief, build_model
from planning.coverage_model import MAX_EDGE_RISK, CoverageModel, evaluate_moves
from planning.kernels import njit
from planning.lattice_graph import neighbour, travel_costs
from planning.reward import RewardWeights, parameters, travel_discount

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Ways(NamedTuple):
    """Cheapest ways from one node to all. cost: (n,) travel and weighed risk, m, inf where no way leads; back: (n,)
    the direction that leads back towards the start, -1 at the start."""

    start: int
    cost: Floats
    back: NDArray[np.int8]


def ways_from(model: CoverageModel, start: int, risk_weight_m: float) -> Ways:
    """Cheapest ways from `start` over edges that can be driven. risk_weight_m: metres that a risk of 1 counts."""
    n = model.size * model.size
    cost, back = np.empty(n), np.empty(n, np.int8)
    travel_costs(
        start, model.size, model.edge_distance_m, model.edge_risk, risk_weight_m, MAX_EDGE_RISK, cost, back
    )
    return Ways(start, cost, back)


def viewpoints_within(model: CoverageModel, ways: Ways, radius_m: float) -> NDArray[np.int64]:
    """All viewpoints whose path costs no more than this, as node * 8 + heading, ascending; (v,)."""
    entered_from = model.step_to[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    before = np.where(entered_from >= 0, entered_from, 0)
    direction = np.arange(8)[None, :]
    distance, risk = model.edge_distance_m[before, direction], model.edge_risk[before, direction]
    open_ = (entered_from >= 0) & (distance > 0.0) & (risk <= MAX_EDGE_RISK)
    cost = np.where(open_, ways.cost[before] + distance, np.inf)
    return np.flatnonzero(cost.ravel() <= radius_m)


@njit
def path_to(start: int, back: NDArray[np.int8], size: int, viewpoint: int, moves: NDArray[np.int64]) -> int:
    """Moves of the path to a viewpoint; returns how many, -1 when there is no way or `moves` is too short."""
    node, heading = viewpoint // 8, viewpoint % 8
    at = neighbour(node, (heading + 4) % 8, size)
    if at < 0:
        return -1
    count, there = 1, at
    while there != start:
        if back[there] < 0:
            return -1
        there = neighbour(there, back[there], size)
        count += 1
    if count > moves.shape[0]:
        return -1
    moves[count - 1] = heading
    for i in range(count - 2, -1, -1):
        moves[i] = (back[at] + 4) % 8
        at = neighbour(at, back[at], size)
    return count


@njit
def rate_viewpoints(
    model: CoverageModel,
    start: int,
    heading: int,
    back: NDArray[np.int8],
    viewpoints: NDArray[np.int64],
    longest: int,
    reward_out: NDArray[np.float64],
) -> None:
    """Expected discounted reward of the path to each viewpoint, summed along it; (v,) out, -inf without a path.

    Discounted by travel, as the paths of Bircher et al. are (their Eq. 3). longest: moves of a path, at most.
    """
    moves = np.empty(longest, np.int64)
    reward, distance, alive = np.empty(longest), np.empty(longest), np.empty(longest)
    for v in range(viewpoints.shape[0]):
        reward_out[v] = -np.inf
        count = path_to(start, back, model.size, viewpoints[v], moves)
        if count < 0:
            continue
        covered = model.covered.copy()
        made = evaluate_moves(model, start, heading, moves[:count], covered, reward, distance, alive)
        if made < count:
            continue
        total, discount = 0.0, 1.0
        for i in range(count):
            total += discount * reward[i]
            discount *= travel_discount(model.weights, distance[i])
        reward_out[v] = total


class View(NamedTuple):
    """The best viewpoint (node * 8 + heading), the moves of its path, and what they are worth."""

    viewpoint: int
    moves: list[int]
    reward: float


def best_view(
    model: CoverageModel, ways: Ways, heading: int, viewpoints: NDArray[np.int64], longest: int
) -> View | None:
    """The viewpoint whose path is worth most (of equal ones the first); None when no path leads to any."""
    reward = np.empty(len(viewpoints))
    rate_viewpoints(model, ways.start, heading, ways.back, viewpoints, longest, reward)
    if len(reward) == 0 or not np.isfinite(reward.max()):
        return None
    best = int(np.argmax(reward))
    moves = np.empty(longest, np.int64)
    count = path_to(ways.start, ways.back, model.size, int(viewpoints[best]), moves)
    return View(int(viewpoints[best]), [int(k) for k in moves[:count]], float(reward[best]))


def warm_up_viewpoints() -> None:
    """Compile the kernels: two nodes beside each other in a lattice of nine."""
    edges, entropy = np.zeros((9, 8), np.float32), np.ones(9)
    edges[3, 0] = edges[4, 4] = 1.0
    visible = np.full((9, 3), 7, np.uint32)
    root = RootBelief(np.array([3], np.int32), np.zeros(1, np.uint8), np.ones(1), np.zeros(3, np.uint64))
    model = build_model(
        size=3, reach=1, fov_rad=2.0, edge_distance_m=edges, edge_risk=0.1 * edges, entropy=entropy, visible=visible,
        leaf_value=np.zeros(9), root=root, weights=parameters(RewardWeights()), horizon=2, rollout_random=0.0,
    )  # fmt: skip
    ways = ways_from(model, 3, 1.0)
    best_view(model, ways, 0, viewpoints_within(model, ways, 5.0), 4)

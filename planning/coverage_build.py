"""Builds the coverage model of an episode from the columns of a Local IRM: footprints, groups, tables.

The model itself is `planning.coverage_model`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import count_bits
from planning.coverage_model import MAX_EDGE_RISK, CoverageModel
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit
from planning.lattice_graph import seen_by_any, travel_costs
from planning.reward import RewardParameters

_MAX_CLUSTERS = 400
_ONE = np.uint64(1)
_FULL_TURN = 2.0 * math.pi - 1e-6


def wedge_rows(reach: int, fov_rad: float) -> NDArray[np.uint32]:
    """(8, 2 reach + 1) words: offsets inside the field of view for each heading; the own node always."""
    rows = np.zeros((8, 2 * reach + 1), np.uint32)
    for k in range(8):
        heading = k * math.pi / 4.0
        for r in range(2 * reach + 1):
            for c in range(2 * reach + 1):
                dx, dy = c - reach, r - reach
                off = abs(math.remainder(math.atan2(dy, dx) - heading, 2.0 * math.pi))
                if (dx == 0 and dy == 0) or off <= fov_rad / 2.0 + 1e-9:
                    rows[k, r] |= np.uint32(1 << c)
    return rows


@njit
def best_viewpoint(
    visible: NDArray[np.uint32],
    cost: NDArray[np.float64],
    size: int,
    reach: int,
    top: int,
    words: NDArray[np.uint64],
    middle_row: float,
    middle_column: float,
) -> int:
    """The reachable node near a block that sees most of it, then the nearest to its middle; -1 if none sees any.

    cost: (n,) travel from the root, inf where the robot cannot go. words: (3,) the block's nodes, from row `top`.
    """
    best, best_score = -1, 0.0
    for row in range(max(0, top - reach), min(size, top + 3 + reach)):
        for column in range(
            max(0, int(middle_column) - 2 - reach), min(size, int(middle_column) + 3 + reach)
        ):
            node = row * size + column
            if not math.isfinite(cost[node]):
                continue
            count = 0
            for r in range(3):
                offset = top + r - row + reach
                if offset < 0 or offset > 2 * reach or top + r >= size:
                    continue
                shift = column - reach
                word = np.uint64(visible[node, offset])
                word = word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)
                count += count_bits(word & words[r])
            if count == 0:
                continue
            score = count - 0.3 * math.hypot(row - middle_row, column - middle_column) + 100.0
            if score > best_score:
                best, best_score = node, score
    return best


@njit
def _see_block(
    visible: NDArray[np.uint32],
    node: int,
    size: int,
    reach: int,
    top: int,
    words: NDArray[np.uint64],
    seen: NDArray[np.uint64],
) -> None:
    """Move the nodes of a block that a node sees (whatever its heading) from `words` to `seen`, (3,) each."""
    shift = node % size - reach
    for r in range(3):
        seen[r] = np.uint64(0)
        offset = top + r - node // size + reach
        if 0 <= offset <= 2 * reach and top + r < size:
            word = np.uint64(visible[node, offset])
            word = word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)
            seen[r] = word & words[r]
            words[r] &= ~seen[r]


@njit
def _clusters(
    grid: NDArray[np.bool_],
    reach: int,
    visible: NDArray[np.uint32],
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    risk_weight_m: float,
    root: int,
    moves: NDArray[np.int8],
    costs: NDArray[np.float32],
    rows: NDArray[np.uint64],
    tops: NDArray[np.int32],
) -> int:
    size = grid.shape[0]
    n = size * size
    root_cost, cost, move = np.empty(n), np.empty(n), np.empty(n, np.int8)
    words, seen = np.zeros(3, np.uint64), np.zeros(3, np.uint64)
    travel_costs(root, size, edge_distance_m, edge_risk, risk_weight_m, MAX_EDGE_RISK, root_cost, move)
    count = 0
    for top in range(0, size, 3):
        for left in range(0, size, 3):
            total, middle_row, middle_column = 0, 0.0, 0.0
            for r in range(3):
                words[r] = np.uint64(0)
                for c in range(left, min(left + 3, size)):
                    if top + r < size and grid[top + r, c]:
                        words[r] |= _ONE << np.uint64(c)
                        total += 1
                        middle_row += top + r
                        middle_column += c
            while total > 0 and count < tops.shape[0] and (words[0] | words[1] | words[2]) != np.uint64(0):
                source = best_viewpoint(
                    visible, root_cost, size, reach, top, words, middle_row / total, middle_column / total
                )
                if source < 0:
                    break
                _see_block(visible, source, size, reach, top, words, seen)
                travel_costs(
                    source, size, edge_distance_m, edge_risk, risk_weight_m, MAX_EDGE_RISK, cost, move
                )
                for i in range(n):
                    moves[i, count], costs[i, count] = move[i], cost[i]
                rows[count], tops[count] = seen, top
                count += 1
    return count


def clusters(
    entropy: NDArray[np.float64],
    size: int,
    reach: int,
    visible: NDArray[np.uint32],
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    risk_weight_m: float,
    root: int,
) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.uint64], NDArray[np.int32]]:
    """Groups of uncovered nodes (blocks of 3 x 3) and the way to each from every node, for the informed rule.

    Behind a corner one viewpoint may not see the whole block: what it does not see is a group of its own, else the
    rule would come back to this place for ever. Returns moves (n, c), costs (n, c), rows (c, 3), tops (c,).
    """
    n = size * size
    moves, costs = np.full((n, _MAX_CLUSTERS), -1, np.int8), np.full((n, _MAX_CLUSTERS), np.inf, np.float32)
    rows, tops = np.zeros((_MAX_CLUSTERS, 3), np.uint64), np.zeros(_MAX_CLUSTERS, np.int32)
    grid = entropy.reshape(size, size) > 0.0
    count = _clusters(
        grid, reach, visible, edge_distance_m, edge_risk, risk_weight_m, root, moves, costs, rows, tops
    )
    return moves[:, :count].copy(), costs[:, :count].copy(), rows[:count].copy(), tops[:count].copy()


@njit
def _footprints(
    visible: NDArray[np.uint32],
    wedge: NDArray[np.uint32],
    covered: NDArray[np.uint64],
    reach: int,
    footprint: NDArray[np.uint64],
    low: NDArray[np.int8],
    high: NDArray[np.int8],
) -> None:
    """What is visible, in the field of view and not covered, by node and heading: columns `CoverageModel` has, out.

    Most rows around a robot that has looked about are empty: that they are skipped is half of the speed.
    """
    size = covered.shape[0]
    for node in range(size * size):
        shift = node % size - reach
        for k in range(8):
            low[node, k] = high[node, k] = 0
            for r in range(2 * reach + 1):
                row = node // size - reach + r
                word = np.uint64(visible[node, r] & wedge[k, r])
                word = word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)
                word = word & ~covered[row] if 0 <= row < size else np.uint64(0)
                footprint[node, k, r] = word
                if word != np.uint64(0):
                    low[node, k] = r if high[node, k] == 0 else low[node, k]
                    high[node, k] = r + 1


@njit
def _fresh_most(
    footprint: NDArray[np.uint64],
    row_low: NDArray[np.int8],
    row_high: NDArray[np.int8],
    top: NDArray[np.int32],
    step_to: NDArray[np.int32],
    fresh: NDArray[np.int16],
) -> None:
    """(n, h, 8), out: how many nodes are seen from the end of a step that are not from its start, by the heading there.

    h = 1: the sensor looks all around.
    """
    n, rows, headings = footprint.shape[0], footprint.shape[2], fresh.shape[1]
    for node in range(n):
        for k in range(8):
            other = step_to[node, k]
            if other < 0:
                continue
            for r in range(row_low[other, k], row_high[other, k]):
                own = top[other] + r - top[node]
                for h in range(headings):
                    seen = footprint[node, h, own] if 0 <= own < rows else np.uint64(0)
                    fresh[node, h, k] += count_bits(footprint[other, k, r] & ~seen)


def lattice_steps(size: int) -> NDArray[np.int32]:
    """The neighbour of each node in each direction, -1 outside the lattice, (n, 8)."""
    row, column = np.divmod(np.arange(size * size)[:, None], size)
    row, column = row + DIRECTION_DY[None, :], column + DIRECTION_DX[None, :]
    inside = (row >= 0) & (column >= 0) & (row < size) & (column < size)
    return np.where(inside, row * size + column, -1).astype(np.int32)


def reachable_entropy(
    entropy: NDArray[np.float32],
    visible: NDArray[np.uint32],
    edge_distance_m: NDArray[np.float32],
    size: int,
    reach: int,
) -> NDArray[np.float64]:
    """Entropy of each node that can be covered from some connected node; 0 for the others. (n,)"""
    connected: NDArray[np.bool_] = np.asarray((edge_distance_m > 0.0).any(axis=1))
    seen = np.zeros(size * size, np.bool_)
    seen_by_any(visible, connected, size, reach, seen)
    return np.where(seen, entropy, 0.0).astype(np.float64)


class RootBelief(NamedTuple):
    """The belief that a search starts from: particles (p,), and the nodes that count as covered, (size,) words."""

    node: NDArray[np.int32]
    heading: NDArray[np.uint8]
    weight: NDArray[np.float64]
    covered: NDArray[np.uint64]


def build_model(
    *,
    size: int,
    reach: int,
    fov_rad: float,
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    entropy: NDArray[np.float64],
    visible: NDArray[np.uint32],
    leaf_value: NDArray[np.float64],
    root: RootBelief,
    weights: RewardParameters,
    horizon: int,
    rollout_random: float,
) -> CoverageModel:
    """The model of an episode from the columns of a Local IRM (shapes as in `CoverageModel`)."""
    start = int(root.node[int(np.argmax(root.weight))])
    risk_weight_m = weights.k_risk / max(weights.k_distance_per_m, 1e-3)
    # Copies: arrays of a decoded message are read-only, which is another type to the compiler and a second compilation.
    distance, risk, seen = np.array(edge_distance_m), np.array(edge_risk), np.array(visible)
    move, cost, rows, top = clusters(entropy, size, reach, seen, distance, risk, risk_weight_m, start)
    step_to, top_row = (
        lattice_steps(size),
        (np.arange(size * size, dtype=np.int32) // size - reach).astype(np.int32),
    )
    footprint = np.zeros((size * size, 8, 2 * reach + 1), np.uint64)
    low, high = np.zeros((size * size, 8), np.int8), np.zeros((size * size, 8), np.int8)
    covered = np.array(root.covered)
    _footprints(seen, wedge_rows(reach, fov_rad), covered, reach, footprint, low, high)
    unlooked, fresh = (
        np.zeros(size * size, np.bool_),
        np.zeros((size * size, 1 if fov_rad >= _FULL_TURN else 8, 8), np.int16),
    )
    unlooked[root.node[high[root.node, root.heading] > 0]] = True
    _fresh_most(footprint, low, high, top_row, step_to, fresh)
    return CoverageModel(
        size, reach, weights, step_to, top_row, distance, risk, weights.gamma_per_m ** distance.astype(np.float64),
        np.array(entropy), low, high, footprint, np.array(leaf_value),
        np.array(root.node), np.array(root.heading),
        np.array(root.weight), covered, move, cost, rows, top, horizon, rollout_random,
        fov_rad < _FULL_TURN, fresh, unlooked,
    )  # fmt: skip

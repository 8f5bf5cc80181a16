"""Builds the coverage model of an episode from the columns of a Local IRM: footprints, groups, tables.

The model itself is `planning.coverage_model`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_groups import clusters
from planning.coverage_model import MAX_EDGE_RISK, CoverageModel, move_cost
from planning.coverage_tiles import (
    TileLists,
    by_tile,
    count_fresh,
    empty_lists,
    fill_differences,
    fill_footprints,
    tile_count,
    tiles_of_rows,
    trimmed,
)
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit
from planning.lattice_graph import seen_by_any
from planning.reward import RewardParameters

_FULL_TURN = 2.0 * math.pi - 1e-6


@lru_cache(maxsize=8)
def wedge_rows(reach: int, fov_rad: float) -> NDArray[np.uint32]:
    """(8, 2 reach + 1) words: offsets inside the field of view for each heading; the own node always.

    One array for all who ask: not to be changed.
    """
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
def _rank_moves(
    lists: TileLists,
    headings: int,
    unlooked: NDArray[np.bool_],
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    step_to: NDArray[np.int32],
    k_risk: float,
    order: NDArray[np.int32],
    most: NDArray[np.float32],
) -> None:
    """The moves from each node under each heading by the most that each can score, columns `CoverageModel` has, out.

    lists: the footprints, set node h + heading. The score is that of `coverage_model.best_gain_direction`, for all that
    the sensor sees from the end of the move and not from its start.
    """
    seen, score, fresh = np.zeros(256, np.uint64), np.zeros(8), np.zeros(8, np.int64)
    for node in range(step_to.shape[0]):
        for heading in range(8):
            if heading < headings:
                _count_steps(
                    lists, node, heading, headings, unlooked[node], edge_distance_m, step_to, seen, fresh
                )
            for k in range(8):
                distance, risk = edge_distance_m[node, k], edge_risk[node, k]
                score[k] = 0.0
                if distance > 0.0 and risk <= MAX_EDGE_RISK:
                    score[k] = 0.5 * fresh[k] / move_cost(distance, heading, k) - k_risk * risk
            order[node, heading] = _sort_moves(score, most[node, heading])


@njit
def _count_steps(
    lists: TileLists,
    node: int,
    heading: int,
    headings: int,
    unlooked: bool,
    edge_distance_m: NDArray[np.float32],
    step_to: NDArray[np.int32],
    seen: NDArray[np.uint64],
    fresh: NDArray[np.int64],
) -> None:
    """How many nodes the end of each step shows that its start under this heading does not, (8,) out.

    seen: scratch, 0 in every tile before and after.
    """
    own = node * headings + heading
    first, last = lists.start[own], lists.start[own + 1]
    for e in range(first, last):
        seen[lists.tile[e]] = np.uint64(0) if unlooked else lists.word[e]
    for k in range(8):
        if edge_distance_m[node, k] > 0.0:
            fresh[k] = count_fresh(lists, step_to[node, k] * headings + (k if headings > 1 else 0), seen)
    for e in range(first, last):
        seen[lists.tile[e]] = np.uint64(0)


@njit
def _sort_moves(score: NDArray[np.float64], most: NDArray[np.float32]) -> int:
    """The directions by falling score, 3 bits each; most: (8,) out, the scores in that order, 0 for none.

    They are raised a little, as a float32 rounds: they bound what is computed in float64.
    """
    packed, count = np.int64(0), 0
    for k in range(8):
        if score[k] <= 0.0:
            continue
        raised, at = np.float32(score[k] * 1.000001), 0
        while at < count and most[at] >= raised:
            at += 1
        for i in range(count, at, -1):
            most[i] = most[i - 1]
        most[at] = raised
        below = packed & ((np.int64(1) << (3 * at)) - 1)
        packed = ((packed - below) << 3) | (np.int64(k) << (3 * at)) | below
        count += 1
    return packed  # type: ignore[return-value]  # the compiler's int


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
    macros: bool = True,
) -> CoverageModel:
    """The model of an episode from the columns of a Local IRM (shapes as in `CoverageModel`)."""
    start = int(root.node[int(np.argmax(root.weight))])
    risk_weight_m = weights.k_risk / max(weights.k_distance_per_m, 1e-3)
    # Copies: arrays of a decoded message are read-only, which is another type to the compiler and a second compilation.
    distance, risk, seen = np.array(edge_distance_m), np.array(edge_risk), np.array(visible)
    groups = clusters(entropy, size, reach, seen, distance, risk, risk_weight_m, start)
    step_to, tile_entropy = lattice_steps(size), by_tile(entropy, size)
    n, headings = size * size, 1 if fov_rad >= _FULL_TURN else 8
    free = ~np.array(root.covered) & np.uint64((1 << size) - 1)
    whole = _room(n * headings, reach, size)
    fill_footprints(seen, wedge_rows(reach, fov_rad)[:headings], free, tile_entropy, whole)
    own = root.node.astype(np.int64) * headings + (root.heading.astype(np.int64) if headings > 1 else 0)
    unlooked = np.zeros(n, np.bool_)
    unlooked[root.node[whole.start[own] < whole.start[own + 1]]] = True
    order, most = np.zeros((n, 8), np.int32), np.zeros((n, 8, 8), np.float32)
    _rank_moves(whole, headings, unlooked, distance, risk, step_to, weights.k_risk, order, most)
    return CoverageModel(
        size, headings, weights, step_to, distance, risk, weights.gamma_per_m ** distance.astype(np.float64),
        tile_entropy,
        _sights(whole, np.where(distance > 0.0, step_to, -1), headings, unlooked, reach, size, tile_entropy),
        np.array(leaf_value),
        np.array(root.node), np.array(root.heading),
        np.array(root.weight), tiles_of_rows(np.array(root.covered), size),
        groups.move, groups.cost, groups.tile, groups.word, horizon, rollout_random,
        headings > 1, order, most, macros,
    )  # fmt: skip


def _room(sets: int, reach: int, size: int) -> TileLists:
    """Room for so many footprints: each may lie in this many tiles. (Memory is taken when it is written to.)"""
    return empty_lists(sets, sets * min(((2 * reach + 7) // 8 + 1) ** 2, tile_count(size)))


def _sights(
    whole: TileLists,
    step_to: NDArray[np.int32],
    headings: int,
    unlooked: NDArray[np.bool_],
    reach: int,
    size: int,
    tile_entropy: NDArray[np.float64],
) -> TileLists:
    """`CoverageModel.sight`: what each step newly shows, then the footprints."""
    n = size * size
    under = np.arange(8)[None, :] if headings > 1 else np.zeros((1, 8), np.int64)
    to = np.where(step_to >= 0, step_to * headings + under, -1).astype(np.int32).ravel()
    own = np.arange(n)[:, None] * headings + under
    minus = np.where(unlooked[:, None], -1, own).astype(np.int32).ravel()
    steps = _room(8 * n, reach, size)
    fill_differences(whole, to, minus, tile_entropy, steps)
    first, second = trimmed(steps), trimmed(whole)
    return TileLists(
        np.concatenate([first.start, first.start[-1] + second.start[1:]]).astype(np.int32),
        np.concatenate([first.tile, second.tile]),
        np.concatenate([first.word, second.word]),
        np.concatenate([first.entropy, second.entropy]),
    )

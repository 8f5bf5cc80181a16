"""Groups of uncovered nodes, and from every node the way to each: where the informed rule goes when all is seen here.

Part of `planning.coverage_build`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import count_bits
from planning.coverage_model import MAX_EDGE_RISK
from planning.kernels import njit, njit_borrowing
from planning.lattice_graph import PassableEdges, empty_heap, passable_edges, travel_costs_over

_MAX_CLUSTERS = 400
_ONE = np.uint64(1)


class Groups(NamedTuple):
    """c groups and the ways to them. move: (n, c) first moves, -1 where none is needed or none leads there.

    cost: (n, c), m of travel and weighed risk, inf without a way. tile, word: (c, 4), the nodes as words of tiles
    (`planning.coverage_tiles`), the empty ones last.
    """

    move: NDArray[np.int8]
    cost: NDArray[np.float32]
    tile: NDArray[np.uint8]
    word: NDArray[np.uint64]


@njit_borrowing
def _seen_of_row(visible: NDArray[np.uint32], node: int, size: int, reach: int, row: int) -> int:
    """The nodes of a row of the lattice that a node sees, a bit a column; none of a row out of range or outside."""
    offset, shift = row - node // size + reach, node % size - reach
    if offset < 0 or offset > 2 * reach or row >= size:
        return np.uint64(0)  # type: ignore[return-value]  # the compiler's int
    word = np.uint64(visible[node, offset])
    return word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)  # type: ignore[return-value]


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
                count += count_bits(_seen_of_row(visible, node, size, reach, top + r) & words[r])
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
    for r in range(3):
        seen[r] = _seen_of_row(visible, node, size, reach, top + r) & words[r]
        words[r] &= ~seen[r]


@njit
def _to_tiles(
    size: int, top: int, rows: NDArray[np.uint64], tiles: NDArray[np.uint8], words: NDArray[np.uint64]
) -> None:
    """Three rows of bits from row `top` on, no more than three columns wide, as words of tiles, (4,) out."""
    side, count = (size + 7) // 8, 0
    for tile_row in range(top // 8, min(top + 2, size - 1) // 8 + 1):
        for tile_column in range(side):
            word = np.uint64(0)
            for r in range(3):
                if top + r < size and (top + r) // 8 == tile_row:
                    byte = (rows[r] >> np.uint64(8 * tile_column)) & np.uint64(0xFF)
                    word |= byte << np.uint64(8 * ((top + r) % 8))
            if word != np.uint64(0):
                tiles[count], words[count] = tile_row * side + tile_column, word
                count += 1


@njit
def _clusters(
    grid: NDArray[np.bool_],
    reach: int,
    visible: NDArray[np.uint32],
    edges: PassableEdges,
    root: int,
    moves: NDArray[np.int8],
    costs: NDArray[np.float32],
    tiles: NDArray[np.uint8],
    group_words: NDArray[np.uint64],
) -> int:
    """Fills moves, costs (most, n), tiles and words (most, 4); returns how many groups there are."""
    size = grid.shape[0]
    n = size * size
    root_cost, cost, move, heap = np.empty(n), np.empty(n), np.empty(n, np.int8), empty_heap(n)
    words, seen, group_at = np.zeros(3, np.uint64), np.zeros(3, np.uint64), np.full(n, -1, np.int32)
    travel_costs_over(edges, root, heap, root_cost, move)
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
            while total > 0 and count < moves.shape[0] and (words[0] | words[1] | words[2]) != np.uint64(0):
                source = best_viewpoint(
                    visible, root_cost, size, reach, top, words, middle_row / total, middle_column / total
                )
                if source < 0:
                    break
                _see_block(visible, source, size, reach, top, words, seen)
                if group_at[source] >= 0:
                    moves[count], costs[count] = moves[group_at[source]], costs[group_at[source]]
                else:
                    travel_costs_over(edges, source, heap, cost, move)
                    moves[count], costs[count], group_at[source] = move, cost, count
                _to_tiles(size, top, seen, tiles[count], group_words[count])
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
) -> Groups:
    """Groups of uncovered nodes (blocks of 3 x 3) and the way to each from every node, for the informed rule.

    Behind a corner one viewpoint may not see the whole block: what it does not see is a group of its own, else the
    rule would come back to this place for ever.
    """
    n = size * size
    moves, costs = np.empty((_MAX_CLUSTERS, n), np.int8), np.empty((_MAX_CLUSTERS, n), np.float32)
    tiles, words = np.zeros((_MAX_CLUSTERS, 4), np.uint8), np.zeros((_MAX_CLUSTERS, 4), np.uint64)
    grid = entropy.reshape(size, size) > 0.0
    edges = passable_edges(size, edge_distance_m, edge_risk, risk_weight_m, MAX_EDGE_RISK)
    count = _clusters(grid, reach, visible, edges, root, moves, costs, tiles, words)
    return Groups(moves[:count].T.copy(), costs[:count].T.copy(), tiles[:count].copy(), words[:count].copy())

"""Coverage as tiles of 8 x 8 nodes, one 64-bit word a tile, and what a look covers as a short list of such words.

A footprint of 11 x 11 nodes lies in about five tiles, what one step newly shows in two or three: as rows both are
eleven words. Node (row, column) is bit 8 (row % 8) + column % 8 of tile (row // 8) T + column // 8, with T tiles a
side; bits of a tile beyond the lattice stay 0. On the wire coverage is rows (`EpisodeRequest.covered`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import count_bits, lowest_bit
from planning.kernels import njit, njit_borrowing

_ONE = np.uint64(1)
_BYTE = np.uint64(0xFF)


def tile_count(size: int) -> int:
    """How many tiles a lattice of size x size nodes has."""
    return ((size + 7) // 8) ** 2


def by_tile(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Values of the nodes, (n,), in the order of tiles and bits, (64 tiles,); 0 beyond the lattice."""
    side = (size + 7) // 8
    padded = np.zeros((8 * side, 8 * side))
    padded[:size, :size] = values.reshape(size, size)
    return padded.reshape(side, 8, side, 8).transpose(0, 2, 1, 3).reshape(-1).copy()


def tiles_of_nodes(nodes: NDArray[np.bool_], size: int) -> NDArray[np.uint64]:
    """A set of nodes, (n,) flags, as tiles."""
    bits = by_tile(nodes.astype(np.float64), size) > 0.0
    return np.packbits(bits, bitorder="little").view("<u8").astype(np.uint64)


def nodes_of_tiles(tiles: NDArray[np.uint64], size: int) -> NDArray[np.bool_]:
    """Tiles as a set of nodes, (n,) flags."""
    side = (size + 7) // 8
    bits = np.unpackbits(tiles.astype("<u8").view(np.uint8), bitorder="little")
    grid = bits.reshape(side, side, 8, 8).transpose(0, 2, 1, 3).reshape(8 * side, 8 * side)
    return grid[:size, :size].astype(np.bool_).ravel()


def tiles_of_rows(rows: NDArray[np.uint64], size: int) -> NDArray[np.uint64]:
    """Row words, (size,), as tiles; bits of columns beyond the lattice are dropped."""
    bits = np.unpackbits(rows.astype("<u8").view(np.uint8), bitorder="little").reshape(size, 64)
    return tiles_of_nodes(bits[:, :size].astype(np.bool_).ravel(), size)


def rows_of_tiles(tiles: NDArray[np.uint64], size: int) -> NDArray[np.uint64]:
    """Tiles as row words, (size,)."""
    bits = np.zeros((size, 64), np.bool_)
    bits[:, :size] = nodes_of_tiles(tiles, size).reshape(size, size)
    return np.packbits(bits, axis=1, bitorder="little").view("<u8").astype(np.uint64).ravel()


class TileLists(NamedTuple):
    """Sets of nodes. Set i is entries start[i] to start[i + 1], ascending in tile, none of them empty.

    start: (lists + 1,). tile, word: (entries,). entropy: (entries,), the sum of the entropies of a word's nodes.
    """

    start: NDArray[np.int32]
    tile: NDArray[np.uint8]
    word: NDArray[np.uint64]
    entropy: NDArray[np.float64]


@njit_borrowing
def count_fresh(lists: TileLists, i: int, covered: NDArray[np.uint64]) -> int:
    """How many nodes of set i are not covered; covered: (tiles,)."""
    total = 0
    for e in range(lists.start[i], lists.start[i + 1]):
        total += count_bits(lists.word[e] & ~covered[np.int64(lists.tile[e])])
    return total


@njit_borrowing
def cover(lists: TileLists, i: int, entropy: NDArray[np.float64], covered: NDArray[np.uint64]) -> float:
    """Cover set i. Returns I, the sum of the entropies of its nodes that were not covered.

    entropy: (64 tiles,), as `by_tile`. A word that is new as a whole counts by its sum, others bit by bit.
    """
    information = 0.0
    for e in range(lists.start[i], lists.start[i + 1]):
        tile, word = np.int64(lists.tile[e]), lists.word[e]
        before = covered[tile]
        fresh = word & ~before
        if fresh == np.uint64(0):
            continue
        covered[tile] = before | word
        if fresh == word:
            information += lists.entropy[e]
            continue
        while fresh != np.uint64(0):
            information += entropy[64 * tile + lowest_bit(fresh)]
            fresh &= fresh - _ONE
    return information


@njit
def _append(lists: TileLists, count: int, tile: int, word: np.uint64, entropy: NDArray[np.float64]) -> int:
    """Add an entry, if it is not empty; returns how many there are then."""
    if word == np.uint64(0):
        return count
    lists.tile[count], lists.word[count] = tile, word
    total, left = 0.0, word
    while left != np.uint64(0):
        total += entropy[64 * tile + lowest_bit(left)]
        left &= left - _ONE
    lists.entropy[count] = total
    return count + 1


@njit
def _append_footprint(
    lists: TileLists,
    count: int,
    node: int,
    visible: NDArray[np.uint32],
    wedge: NDArray[np.uint32],
    free: NDArray[np.uint64],
    entropy: NDArray[np.float64],
    rows: NDArray[np.uint64],
) -> int:
    """Add what is visible from a node, in the wedge and free. visible, wedge: (2 reach + 1,). rows: (8,) scratch."""
    size, reach = free.shape[0], visible.shape[0] // 2
    side, row, shift = (size + 7) // 8, node // size - reach, node % size - reach
    first_column, last_column = max(shift, 0) // 8, min(shift + 2 * reach, size - 1) // 8
    for tile_row in range(max(row, 0) // 8, min(row + 2 * reach, size - 1) // 8 + 1):
        for j in range(8):
            r = 8 * tile_row + j - row
            rows[j] = np.uint64(0)
            if 0 <= r <= 2 * reach and row + r < size:
                word = np.uint64(visible[r] & wedge[r])
                word = word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)
                rows[j] = word & free[row + r]
        for tile_column in range(first_column, last_column + 1):
            word = np.uint64(0)
            for j in range(8):
                word |= ((rows[j] >> np.uint64(8 * tile_column)) & _BYTE) << np.uint64(8 * j)
            count = _append(lists, count, tile_row * side + tile_column, word, entropy)
    return count


@njit
def fill_footprints(
    visible: NDArray[np.uint32],
    wedge: NDArray[np.uint32],
    free: NDArray[np.uint64],
    entropy: NDArray[np.float64],
    lists: TileLists,
) -> None:
    """What is visible, in the field of view and free, by node and heading: sets node h + heading of `lists`, out.

    visible: (n, 2 reach + 1), bits around each node. wedge: (h, 2 reach + 1), the field of view under each heading.
    free: (size,) rows, the nodes that count. entropy: as `by_tile`.
    """
    count, headings, rows = lists.start[0], wedge.shape[0], np.empty(8, np.uint64)
    for node in range(visible.shape[0]):
        for k in range(headings):
            count = _append_footprint(lists, count, node, visible[node], wedge[k], free, entropy, rows)
            lists.start[node * headings + k + 1] = count


@njit
def fill_differences(
    lists: TileLists,
    to: NDArray[np.int32],
    minus: NDArray[np.int32],
    entropy: NDArray[np.float64],
    out: TileLists,
) -> None:
    """Set i of `out`: set to[i] of `lists` without set minus[i]; -1 is the empty set. to, minus: (k,)."""
    count, gone = out.start[0], np.zeros(entropy.shape[0] // 64, np.uint64)
    for i in range(to.shape[0]):
        if to[i] >= 0:
            if minus[i] >= 0:
                for e in range(lists.start[minus[i]], lists.start[minus[i] + 1]):
                    gone[lists.tile[e]] = lists.word[e]
            for e in range(lists.start[to[i]], lists.start[to[i] + 1]):
                tile: int = np.int64(lists.tile[e])  # type: ignore[assignment]  # the compiler's int
                count = _append(out, count, tile, lists.word[e] & ~gone[tile], entropy)
            if minus[i] >= 0:
                for e in range(lists.start[minus[i]], lists.start[minus[i] + 1]):
                    gone[lists.tile[e]] = np.uint64(0)
        out.start[i + 1] = count


def empty_lists(count: int, entries: int) -> TileLists:
    """Room for so many sets with so many entries in all; the first set begins at entry 0."""
    return TileLists(
        np.zeros(count + 1, np.int32), np.empty(entries, np.uint8), np.empty(entries, np.uint64), np.empty(entries)
    )  # fmt: skip


def trimmed(lists: TileLists) -> TileLists:
    """Without the room that was not needed."""
    used = int(lists.start[-1])
    return TileLists(
        lists.start, lists.tile[:used].copy(), lists.word[:used].copy(), lists.entropy[:used].copy()
    )

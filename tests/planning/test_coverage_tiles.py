"""Tiles against sets of nodes."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.coverage_tiles import (
    TileLists,
    by_tile,
    count_fresh,
    cover,
    empty_lists,
    fill_differences,
    nodes_of_tiles,
    rows_of_tiles,
    tile_count,
    tiles_of_nodes,
    tiles_of_rows,
    trimmed,
)
from planning.reward import RewardWeights
from tests.planning.coverage_lattices import Reference

SIZES = st.sampled_from([1, 5, 8, 9, 16, 23, 41, 61, 64])
SEEDS = st.integers(0, 2**32 - 1)


def lattice_of(entropy: NDArray[np.float64]) -> Reference:
    """Nodes and their entropies alone."""
    size = math.isqrt(len(entropy))
    return Reference(size, 1, 1.0, RewardWeights(), entropy, {}, {})


def random_set(rng: np.random.Generator, n: int) -> frozenset[int]:
    """Few or many nodes, or all: whole words, too."""
    return frozenset(np.flatnonzero(rng.random(n) < rng.choice([0.05, 0.5, 1.0])).tolist())


@settings(max_examples=40)
@given(SEEDS, SIZES)
def test_a_set_of_nodes_as_tiles_as_rows_and_back(seed: int, size: int) -> None:
    lattice = lattice_of(np.ones(size * size))
    nodes = random_set(np.random.default_rng(seed), size * size)
    flags = np.zeros(size * size, np.bool_)
    flags[list(nodes)] = True
    tiles = tiles_of_nodes(flags, size)
    assert len(tiles) == tile_count(size)
    assert tiles.tolist() == lattice.tiles(nodes).tolist()
    np.testing.assert_array_equal(nodes_of_tiles(tiles, size), flags)
    np.testing.assert_array_equal(rows_of_tiles(tiles, size), lattice.bits(nodes))
    np.testing.assert_array_equal(tiles_of_rows(lattice.bits(nodes), size), tiles)


@settings(max_examples=40)
@given(SEEDS, SIZES)
def test_the_value_of_a_node_is_found_by_tile_and_bit(seed: int, size: int) -> None:
    values = np.random.default_rng(seed).uniform(size=size * size)
    ordered, side = by_tile(values, size), (size + 7) // 8
    assert ordered.shape == (64 * tile_count(size),)
    for node in range(0, size * size, 7):
        row, column = divmod(node, size)
        tile, bit = row // 8 * side + column // 8, row % 8 * 8 + column % 8
        assert ordered[64 * tile + bit] == values[node]
    assert math.isclose(ordered.sum(), values.sum())


def lists_of(lattice: Reference, sets: list[frozenset[int]]) -> TileLists:
    """Tile lists made in plain Python."""
    lists = empty_lists(len(sets), 64 * len(sets))
    count = 0
    for i, nodes in enumerate(sets):
        for tile, word in enumerate(lattice.tiles(nodes)):
            if word:
                one = np.zeros(tile_count(lattice.size), np.uint64)
                one[tile] = word
                lists.tile[count], lists.word[count] = tile, word
                lists.entropy[count] = lattice.information(lattice.in_tiles(one))
                count += 1
        lists.start[i + 1] = count
    return trimmed(lists)


def problem(seed: int, size: int, sets: int) -> tuple[Reference, list[frozenset[int]], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    entropy = rng.uniform(0.1, 1.0, size * size)
    lattice = lattice_of(entropy)
    return lattice, [random_set(rng, size * size) for _ in range(sets)], by_tile(entropy, size)


@settings(max_examples=40)
@given(SEEDS, SIZES)
def test_covering_is_set_arithmetic(seed: int, size: int) -> None:
    lattice, sets, entropy = problem(seed, size, 4)
    lists, covered = lists_of(lattice, sets), lattice.tiles(())
    seen = frozenset[int]()
    for i, nodes in enumerate(sets):
        fresh = nodes - seen
        assert count_fresh(lists, i, covered) == len(fresh)
        assert math.isclose(cover(lists, i, entropy, covered), lattice.information(fresh), rel_tol=1e-12)
        seen |= nodes
        assert lattice.in_tiles(covered) == seen
        assert count_fresh(lists, i, covered) == 0
        assert cover(lists, i, entropy, covered) == 0.0


@settings(max_examples=40)
@given(SEEDS, SIZES)
def test_differences_are_those_of_sets(seed: int, size: int) -> None:
    lattice, sets, entropy = problem(seed, size, 5)
    lists, rng = lists_of(lattice, sets), np.random.default_rng(seed)
    to, minus = rng.integers(-1, 5, 12).astype(np.int32), rng.integers(-1, 5, 12).astype(np.int32)
    out = empty_lists(12, 64 * 12)
    fill_differences(lists, to, minus, entropy, out)
    expected = [
        (sets[a] if a >= 0 else frozenset()) - (sets[b] if b >= 0 else frozenset())
        for a, b in zip(to, minus, strict=True)
    ]
    plain, found = lists_of(lattice, expected), trimmed(out)
    for field in ("start", "tile", "word"):
        np.testing.assert_array_equal(getattr(found, field), getattr(plain, field))
    np.testing.assert_allclose(found.entropy, plain.entropy, rtol=1e-12)

"""Patches that no node sees half of."""

from __future__ import annotations

import numpy as np
import pytest

from services.irm.glimpses import add_glimpses

SIZE, REACH, CELLS = 5, 4, 4
"""Patches a side, how far they are seen, cells a side of a patch (1 m each)."""


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A corridor along row 1, and a gap of one cell into unknown ground above its patch 3."""
    side = SIZE * CELLS
    opaque, mass = np.ones((side, side), np.bool_), np.zeros((side, side), np.float32)
    opaque[4:8] = False
    opaque[:4, 12:16] = False
    opaque[3, 13:16] = True
    mass[:4, 12:16][~opaque[:4, 12:16]] = 1.0
    row, column = np.indices((side, side)) // CELLS
    patch = (row * SIZE + column).astype(np.int32)
    state = np.zeros(SIZE * SIZE, np.uint8)
    state[5:10] = 1
    anchor = np.array([[k % SIZE * 4 + 1.5, k // SIZE * 4 + 2.5] for k in range(SIZE * SIZE)], np.float64)
    return opaque, mass, patch, state, anchor


def glimpse(rows: np.ndarray, entropy: np.ndarray) -> int:
    opaque, mass, patch, state, anchor = scene()
    return int(
        add_glimpses(opaque, mass, patch, 0.0, 0.0, 1.0, 15.0, SIZE, REACH, state, anchor, entropy, rows)
    )


def test_a_gap_is_seen_from_where_most_of_what_is_behind_it_shows_and_holds_no_more_than_that() -> None:
    rows, entropy = np.zeros((SIZE * SIZE, 2 * REACH + 1), np.uint32), np.zeros(SIZE * SIZE, np.float32)
    entropy[3] = 13.0
    assert glimpse(rows, entropy) == 1
    seers = [node for node in range(SIZE * SIZE) if rows[node].any()]
    assert seers and set(seers) < set(range(5, 10))
    assert 8 in seers, "the node below the gap"
    assert 0.0 < entropy[3] < 6.5, "no node sees half"
    for node in seers:
        row, column = -(node // SIZE) + REACH, 3 - node % SIZE + REACH
        assert rows[node, row] == np.uint32(1) << np.uint32(column)
        assert rows[node].sum() == rows[node, row]


def test_what_some_node_sees_anyway_stays_as_it_is() -> None:
    rows, entropy = np.zeros((SIZE * SIZE, 2 * REACH + 1), np.uint32), np.zeros(SIZE * SIZE, np.float32)
    entropy[3] = 13.0
    rows[8, REACH - 1] = np.uint32(1) << np.uint32(REACH)
    before = rows.copy()
    assert glimpse(rows, entropy) == 0
    assert np.array_equal(rows, before)
    assert entropy[3] == pytest.approx(13.0)


def test_what_nothing_shows_of_holds_nothing() -> None:
    rows, entropy = np.zeros((SIZE * SIZE, 2 * REACH + 1), np.uint32), np.zeros(SIZE * SIZE, np.float32)
    entropy[20] = 2.0
    assert glimpse(rows, entropy) == 1
    assert not rows.any()
    assert entropy[20] == 0.0

"""The ring buffer: rolling keeps what stays, forgets what left, and copies nothing."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from planning.grid import window_around
from services.riskmap.ring import RingWindow

_SIZE_M = 3.0
_moves = st.lists(st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), min_size=1, max_size=8)


@given(steps=_moves, resolution_m=st.sampled_from([0.1, 0.25, 0.4]))
def test_rolling_keeps_what_stays_to_the_bit_and_forgets_what_left(
    steps: list[tuple[float, float]], resolution_m: float
) -> None:
    window = RingWindow(_SIZE_M, resolution_m, 2)
    rng = np.random.default_rng(0)
    x, y = 0.0, 0.0
    for dx, dy in steps:
        window.cells[:] = rng.normal(size=window.cells.shape)
        old, before = window.spec, window.ordered()
        world = {
            (old.ix0 + c, old.iy0 + r): before[:, r, c].tolist()
            for r in range(old.height)
            for c in range(old.width)
        }
        memory = window.cells
        x, y = x + dx, y + dy
        moved = window.roll_to(x, y)
        assert window.cells is memory
        assert window.spec == window_around(x, y, _SIZE_M, resolution_m)
        assert moved == (window.spec != old)
        after = window.ordered()
        for r in range(old.height):
            for c in range(old.width):
                expected = world.get((window.spec.ix0 + c, window.spec.iy0 + r), [0.0, 0.0])
                assert after[:, r, c].tolist() == expected


@given(steps=_moves)
def test_a_cell_that_stays_keeps_its_place_in_memory(steps: list[tuple[float, float]]) -> None:
    """So rolling costs what enters, whatever the window's size."""
    window = RingWindow(_SIZE_M, 0.25, 1)
    x, y = 0.0, 0.0
    for dx, dy in steps:
        window.cells[:] = 1.0
        old = window.spec
        x, y = x + dx, y + dy
        window.roll_to(x, y)
        rows, columns = abs(window.spec.iy0 - old.iy0), abs(window.spec.ix0 - old.ix0)
        kept = max(0, old.height - rows) * max(0, old.width - columns)
        assert int(window.cells.sum()) == kept

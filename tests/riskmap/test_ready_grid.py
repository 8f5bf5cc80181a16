"""Ready grids of any resolution and origin against exact overlap in rational numbers."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.sensing import ReadyGrid
from services.riskmap.occupancy import OccupancyWindow
from services.riskmap.ready_grid import apply_ready_grid

CLAMP = 4.0


def ready_grid(occupancy: NDArray[np.int8], resolution_m: float, x_m: float, y_m: float) -> ReadyGrid:
    return ReadyGrid(
        stamp_ns=1,
        resolution_m=resolution_m,
        origin_x_m=x_m,
        origin_y_m=y_m,
        height=occupancy.shape[0],
        width=occupancy.shape[1],
        occupancy=occupancy,
    )


def _overlaps(first: int, resolution: Fraction, origin: Fraction, size: Fraction, cells: int) -> list[int]:
    """The grid cells of one axis whose inside meets the inside of window cell `first`."""
    low, high = first * resolution, (first + 1) * resolution
    return [i for i in range(cells) if origin + i * size < high and origin + (i + 1) * size > low]


def _everywhere(first: int, resolution: Fraction, origin: Fraction, size: Fraction) -> list[int]:
    """The cells of one axis that window cell `first` would meet if the grid had no end."""
    low = math.floor((first * resolution - origin) / size) - 1
    high = math.ceil(((first + 1) * resolution - origin) / size) + 1
    return [low + i for i in _overlaps(first, resolution, origin + low * size, size, high - low)]


@given(
    seed=st.integers(0, 10_000),
    resolution=st.sampled_from(["0.05", "0.1", "0.15", "0.2", "0.33", "0.7"]),
    window_resolution=st.sampled_from(["0.1", "0.2"]),
    origin=st.tuples(st.integers(-150, 100), st.integers(-150, 100)),
)
def test_each_cell_is_the_worst_that_it_overlaps_and_unknown_stays(
    seed: int, resolution: str, window_resolution: str, origin: tuple[int, int]
) -> None:
    """So a wall that is one cell thick is never lost, be its cells larger or smaller than the window's.

    And a cell is free only if all that it overlaps is known to be: unknown beats free, outside the grid is unknown.
    """
    rng = np.random.default_rng(seed)
    occupancy = rng.choice(np.array([-1, 0, 0, 30, 100], np.int8), (int(rng.integers(1, 14)), 11))
    x, y = Fraction(origin[0], 100), Fraction(origin[1], 100)
    window = OccupancyWindow(2.4, float(window_resolution))
    before = rng.normal(size=window.spec.shape).astype(np.float32)
    window.log_odds[:] = before
    for layer in (window.hit_weight, window.hit_x, window.hit_y):
        layer[:] = 0.03
    apply_ready_grid(ready_grid(occupancy, float(resolution), float(x), float(y)), window, CLAMP)
    s, fine = window.spec, Fraction(window_resolution)
    for r in range(s.height):
        rows = _overlaps(s.iy0 + r, fine, y, Fraction(resolution), occupancy.shape[0])
        for c in range(s.width):
            columns = _overlaps(s.ix0 + c, fine, x, Fraction(resolution), occupancy.shape[1])
            under = [int(occupancy[i, j]) for i in rows for j in columns]
            worst = max(under, default=-1)
            partly = len(under) < len(_everywhere(s.iy0 + r, fine, y, Fraction(resolution))) * len(
                _everywhere(s.ix0 + c, fine, x, Fraction(resolution))
            )
            if worst < 0 or (worst <= 50 and (partly or min(under) < 0)):
                assert window.log_odds[r, c] == before[r, c]
                assert window.hit_weight[r, c] == pytest.approx(0.03)
                continue
            p = min(max(worst / 100, 1e-6), 1 - 1e-6)
            expected = min(max(math.log(p / (1 - p)), -CLAMP), CLAMP)
            assert window.log_odds[r, c] == pytest.approx(expected, abs=1e-6)
            assert (window.hit_weight[r, c], window.hit_x[r, c], window.hit_y[r, c]) == (0.0, 0.0, 0.0)


def test_a_grid_beside_the_window_changes_nothing() -> None:
    window = OccupancyWindow(2.0, 0.1)
    apply_ready_grid(ready_grid(np.full((5, 5), 100, np.int8), 0.1, 40.0, -9.0), window, CLAMP)
    assert not window.log_odds.any()


def test_a_grid_fills_what_has_rolled_in_and_leaves_newer_evidence() -> None:
    window = OccupancyWindow(2.0, 0.1)
    window.log_odds[3, 3] = 2.5
    apply_ready_grid(ready_grid(np.zeros((60, 60), np.int8), 0.1, -3.0, -3.0), window, CLAMP, only_new=True)
    assert window.log_odds[3, 3] == 2.5
    assert (np.delete(window.log_odds.ravel(), 3 * 20 + 3) == -CLAMP).all()

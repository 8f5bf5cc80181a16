"""Line of sight against an exact brute force in rational numbers, its symmetries and its monotonicity."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning import rays

FULL_CIRCLE = 2 * math.pi


def _clip(start: Fraction, delta: Fraction, low: int, high: int) -> tuple[Fraction, Fraction] | None:
    """Parameters t at which start + t * delta lies strictly between low and high."""
    if delta == 0:
        return (Fraction(0), Fraction(1)) if low < start < high else None
    a, b = (low - start) / delta, (high - start) / delta
    return min(a, b), max(a, b)


def _crosses(x: Fraction, y: Fraction, end_x: Fraction, end_y: Fraction, row: int, column: int) -> bool:
    """Whether the open segment has a part of positive length in the open cell."""
    in_x = _clip(x, end_x - x, column, column + 1)
    in_y = _clip(y, end_y - y, row, row + 1)
    if in_x is None or in_y is None:
        return False
    return max(in_x[0], in_y[0], Fraction(0)) < min(in_x[1], in_y[1], Fraction(1))


def _brute_force(
    opaque: NDArray[np.bool_], x: Fraction, y: Fraction, range_cells: float
) -> NDArray[np.bool_]:
    """A ray is free when the ray itself or, where it only grazes corners, its left or right side is free.

    The sides are the same ray turned by +-1e-9 about the viewer, far below any difference of slopes here.
    """
    height, width = opaque.shape
    own = (math.floor(y), math.floor(x))
    walls = [(int(r), int(c)) for r, c in np.argwhere(opaque) if (r, c) != own]
    seen = np.zeros(opaque.shape, np.bool_)
    tiny = Fraction(1, 10**9)
    for row in range(height):
        for column in range(width):
            dx, dy = column + Fraction(1, 2) - x, row + Fraction(1, 2) - y
            if opaque[row, column] or float(dx * dx + dy * dy) > range_cells**2:
                continue
            near = [
                w
                for w in walls
                if min(own[0], row) - 1 <= w[0] <= max(own[0], row) + 1
                and min(own[1], column) - 1 <= w[1] <= max(own[1], column) + 1
            ]
            for turn in (tiny, -tiny):
                end_x, end_y = x + dx - turn * dy, y + dy + turn * dx
                if not any(_crosses(x, y, end_x, end_y, *w) for w in near):
                    seen[row, column] = True
    return seen


def _seen(
    opaque: NDArray[np.bool_], x: float, y: float, range_cells: float, heading: float = 0.0, fov: float = 7.0
) -> NDArray[np.bool_]:
    out = np.zeros(opaque.shape, np.uint8)
    count = rays.visible_cells(opaque, x, y, range_cells, heading, fov, out)
    assert count == int(out.sum())
    return out.astype(np.bool_)


def _random_walls(rng: np.random.Generator, height: int, width: int) -> NDArray[np.bool_]:
    density = rng.choice([0.02, 0.1, 0.3, 0.5])
    opaque: NDArray[np.bool_] = rng.random((height, width)) < density
    if rng.random() < 0.5:
        opaque[rng.integers(height), :] = True
        opaque[:, rng.integers(width)] = True
    return opaque


@given(seed=st.integers(0, 100_000), eighth_x=st.integers(0, 103), eighth_y=st.integers(0, 87))
def test_visible_cells_equal_exact_segment_tests(seed: int, eighth_x: int, eighth_y: int) -> None:
    rng = np.random.default_rng(seed)
    opaque = _random_walls(rng, 11, 13)
    range_cells = float(rng.choice([3.0, 5.5, 30.0]))
    expected = _brute_force(opaque, Fraction(eighth_x, 8), Fraction(eighth_y, 8), range_cells)
    own = (eighth_y // 8, eighth_x // 8)
    expected[own] = not opaque[own]
    assert np.array_equal(_seen(opaque, eighth_x / 8, eighth_y / 8, range_cells), expected)


def test_every_cell_of_an_empty_disc_is_seen_without_holes() -> None:
    opaque = np.zeros((81, 81), np.bool_)
    rows, columns = np.mgrid[0:81, 0:81] + 0.5
    for x, y in ((40.5, 40.5), (40.0, 40.0), (40.93, 39.21)):
        expected = np.hypot(columns - x, rows - y) <= 30.0
        assert np.array_equal(_seen(opaque, x, y, 30.0), expected)


def test_wall_hides_what_lies_behind_it_and_is_not_marked_itself() -> None:
    opaque = np.zeros((9, 9), np.bool_)
    opaque[:, 5] = True
    seen = _seen(opaque, 2.5, 4.5, 20.0)
    assert seen[:, :5].all() and not seen[:, 5:].any()


def test_nothing_is_seen_between_cells_that_touch_at_a_corner() -> None:
    opaque = np.zeros((7, 7), np.bool_)
    opaque[2, 3] = opaque[3, 2] = True
    assert not _seen(opaque, 2.5, 2.5, 20.0)[3, 3]
    opaque[2, 3] = False
    assert _seen(opaque, 2.5, 2.5, 20.0)[3, 3]


@given(seed=st.integers(0, 100_000))
def test_turned_and_mirrored_scenes_look_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    opaque = _random_walls(rng, 15, 15)
    x, y = (float(v) for v in rng.integers(0, 120, 2) / 8)
    heading, fov = float(rng.uniform(-4, 4)), float(rng.uniform(0.3, 6.0))
    seen = _seen(opaque, x, y, 8.0, heading, fov)
    on_line = x % 1 == 0 or y % 1 == 0  # a viewer on a cell's border belongs to another cell when mirrored
    if not on_line:
        mirrored = _seen(np.ascontiguousarray(opaque[:, ::-1]), 15 - x, y, 8.0, math.pi - heading, fov)
        assert np.array_equal(mirrored[:, ::-1], seen)
        turned = _seen(np.ascontiguousarray(opaque.T[:, ::-1]), 15 - y, x, 8.0, heading + math.pi / 2, fov)
        assert np.array_equal(turned[:, ::-1].T, seen)


@given(seed=st.integers(0, 100_000))
def test_more_range_and_a_wider_field_of_view_never_see_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    opaque = _random_walls(rng, 17, 21)
    x, y = float(rng.uniform(0, 21)), float(rng.uniform(0, 17))
    heading = float(rng.uniform(-4, 4))
    narrow = _seen(opaque, x, y, 6.0, heading, 1.2)
    assert not (narrow & ~_seen(opaque, x, y, 6.0, heading, 2.5)).any()
    assert not (narrow & ~_seen(opaque, x, y, 9.0, heading, 1.2)).any()
    assert not (narrow & ~_seen(opaque, x, y, 6.0)).any()


def test_field_of_view_is_about_the_heading() -> None:
    opaque = np.zeros((21, 21), np.bool_)
    seen = _seen(opaque, 10.5, 10.5, 8.0, math.pi / 2, math.radians(120))
    rows, columns = np.nonzero(seen)
    bearing = np.degrees(np.arctan2(rows - 10, columns - 10))
    away = np.hypot(rows - 10, columns - 10) > 0
    assert np.abs(bearing[away] - 90).max() <= 60 + 1e-6
    assert seen[10, 10] and seen[18, 10] and not seen[9, 10] and not seen[10, 18]


def test_viewer_outside_the_grid_sees_nothing() -> None:
    assert not _seen(np.zeros((5, 5), np.bool_), -0.1, 2.0, 8.0).any()


@given(seed=st.integers(0, 100_000))
def test_visible_mass_sums_the_visible_cells_per_patch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    opaque = _random_walls(rng, 20, 22)
    mass = rng.random((20, 22)).astype(np.float32)
    patch_of = rng.integers(-1, 6, (20, 22)).astype(np.int32)
    x, y = float(rng.uniform(0, 22)), float(rng.uniform(0, 20))
    out = np.zeros(6, np.float32)
    total = rays.visible_mass(opaque, mass, x, y, 7.5, patch_of, out)
    seen = _seen(opaque, x, y, 7.5, 0.0, FULL_CIRCLE)
    expected = [mass[seen & (patch_of == k)].sum() for k in range(6)]
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    np.testing.assert_allclose(total, sum(expected), rtol=1e-5)

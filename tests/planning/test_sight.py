"""Line of sight over tops, against fine sampling of the line."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.sight import SEEN_ABOVE_M, sees_over, visible_mass_over, visible_over

Z_M = 0.8


def _crossed(x: float, y: float, row: int, column: int) -> list[tuple[int, int, float]]:
    """Cells that the line to a cell's centre crosses before it, and the share of the line at their middle."""
    dx, dy = column + 0.5 - x, row + 0.5 - y
    cuts = {0.0, 1.0}
    for origin, step in ((x, dx), (y, dy)):
        if step != 0.0:
            low, high = sorted((origin, origin + step))
            cuts |= {(k - origin) / step for k in range(math.floor(low) + 1, math.ceil(high))}
    at = sorted(cuts)
    found = []
    for a, b in itertools.pairwise(at):
        middle = 0.5 * (a + b)
        cell = (math.floor(y + middle * dy), math.floor(x + middle * dx))
        if b - a > 1e-9 and cell != (row, column):
            found.append((*cell, middle))
    return found


def _sees(top: NDArray[np.float32], x: float, y: float, row: int, column: int, target: float) -> bool:
    own = (math.floor(y), math.floor(x))
    return all(
        Z_M + share * (target - Z_M) >= top[r, c]
        for r, c, share in _crossed(x, y, row, column)
        if (r, c) != own
    )


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_it_sees_what_the_line_passes_over(seed: int) -> None:
    rng = np.random.default_rng(seed)
    top = np.where(rng.random((12, 14)) < 0.25, rng.uniform(0.0, 1.0, (12, 14)), 0.0).astype(np.float32)
    x, y = rng.uniform(0.05, 13.95), rng.uniform(0.05, 11.95)  # off corners: crossings are unambiguous
    for row in range(12):
        for column in range(14):
            target = float(rng.uniform(0.0, 0.5))
            wanted = _sees(top, x, y, row, column, target)
            assert sees_over(top, x, y, Z_M, row, column, target) == wanted


def test_a_low_block_hides_what_lies_close_behind_it_and_a_wall_all() -> None:
    ground = np.zeros((3, 80), np.float32)
    everywhere = np.ones(ground.shape, np.bool_)

    def seen(height_m: float) -> NDArray[np.bool_]:
        top, out = ground.copy(), np.zeros(ground.shape, np.bool_)
        top[:, 30] = height_m
        visible_over(top, ground, everywhere, (0.5, 1.5, Z_M), 79.0, 0.0, 0.5, out)
        return np.asarray(out[1], np.bool_)

    # From 0.8 m over the ground, a block of 0.3 m at 30 cells hides up to 30 * (0.8 - 0.1) / (0.8 - 0.3) = 42 cells.
    low = seen(0.3)
    assert low[:31].all() and not low[31:42].any() and low[43:].all()
    wall = seen(5.0)
    assert wall[:31].all() and not wall[31:].any()


def test_ground_behind_a_crest_is_hidden() -> None:
    x = np.arange(80)
    ground = np.tile(np.where(x < 20, 0.05 * x, np.maximum(1.0 - 0.1 * (x - 20), -1.0)), (3, 1)).astype(
        np.float32
    )
    out = np.zeros(ground.shape, np.bool_)
    visible_over(ground, ground, np.ones(ground.shape, np.bool_), (0.5, 1.5, Z_M), 79.0, 0.0, 0.5, out)
    assert out[1, :20].all() and not out[1, 25:70].any()


@pytest.mark.parametrize(("heading", "fov", "share"), [(0.0, math.tau, 1.0), (1.0, math.pi / 2, 0.25)])
def test_range_and_field_of_view(heading: float, fov: float, share: float) -> None:
    flat, out = np.zeros((81, 81), np.float32), np.zeros((81, 81), np.bool_)
    count = visible_over(
        flat, flat, np.ones(flat.shape, np.bool_), (40.5, 40.5, Z_M), 30.0, heading, fov, out
    )
    assert count == out.sum()
    assert count == pytest.approx(share * math.pi * 30.0**2, rel=0.03)
    assert out[40, 40]


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_mass_is_summed_over_the_visible_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = rng.uniform(0.0, 0.2, (20, 20)).astype(np.float32)
    top = (ground + np.where(rng.random(ground.shape) < 0.2, 0.6, 0.0)).astype(np.float32)
    mass = np.where(rng.random(ground.shape) < 0.5, rng.random(ground.shape), 0.0).astype(np.float32)
    patch = rng.integers(-1, 5, ground.shape).astype(np.int32)
    out, seen = np.zeros(5, np.float32), np.zeros(ground.shape, np.bool_)
    view = (9.3, 10.7, Z_M)
    added = visible_mass_over(top, ground, mass, view, 8.0, patch, out)
    visible_over(top, ground, np.ones(ground.shape, np.bool_), view, 8.0, 0.0, math.tau, seen)
    for k in range(5):
        assert out[k] == pytest.approx(float(mass[seen & (patch == k)].sum()), abs=1e-5)
    assert added == pytest.approx(float(out.sum()), abs=1e-4)


def test_seen_above_is_the_judges() -> None:
    """The belief and the ground truth mean the same by a cell that is seen."""
    from services.sim.terrain_judge import SEEN_ABOVE_M as JUDGED

    assert SEEN_ABOVE_M == JUDGED

"""Kernels against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.grid import GridSpec
from services.sim.geometry import clearance, configuration_space, flood, ray_length, sees_cell
from services.sim.world import World
from tests.sim.helpers import brute_clearance_m, brute_sees

seeds = st.integers(0, 2**32 - 1)


def _random_world(seed: int, density: float = 0.15) -> tuple[World, np.random.Generator]:
    rng = np.random.default_rng(seed)
    spec = GridSpec(0.25, int(rng.integers(-20, 20)), int(rng.integers(-20, 20)), 17, 13)
    return World("random", spec, rng.random(spec.shape) < density, (0.0, 0.0, 0.0)), rng


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_clearance_is_the_distance_to_wall_areas(seed: int) -> None:
    world, rng = _random_world(seed)
    x, y = rng.uniform(0, 17), rng.uniform(0, 13)
    x_m, y_m = (x + world.spec.ix0) * 0.25, (y + world.spec.iy0) * 0.25
    expected = min(brute_clearance_m(world, x_m, y_m), 4.0 * 0.25)
    assert clearance(world.occupied, x, y, 4.0)[0] * 0.25 == pytest.approx(expected, abs=1e-9)
    assert world.clearance_m(x_m, y_m, 1.0) == pytest.approx(expected, abs=1e-9)


@given(seeds, st.floats(0.3, 3.2))
@settings(max_examples=40, deadline=None)
def test_configuration_space_is_where_the_disc_fits(seed: int, radius_cells: float) -> None:
    world, _ = _random_world(seed, 0.06)
    free = configuration_space(world.occupied, radius_cells)
    for row in range(world.spec.height):
        for column in range(world.spec.width):
            room = brute_clearance_m(world, *world.spec.centre_of(row, column)) / 0.25
            if abs(room - radius_cells) > 1e-6:
                assert free[row, column] == (room > radius_cells)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_line_of_sight_equals_fine_sampling(seed: int) -> None:
    world, rng = _random_world(seed)
    free = np.argwhere(~world.occupied)
    row, column = free[rng.integers(len(free))]
    x, y = column + rng.uniform(), row + rng.uniform()
    for to_row, to_column in free:
        seen = sees_cell(world.occupied, x, y, int(to_row), int(to_column))
        # A line that clips a corner by less than the sampling step may differ: sample finer before blaming.
        if seen != brute_sees(world.occupied, x, y, int(to_row), int(to_column), 400):
            assert seen == brute_sees(world.occupied, x, y, int(to_row), int(to_column), 200_001)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_a_ray_ends_where_the_first_wall_begins(seed: int) -> None:
    world, rng = _random_world(seed)
    free = np.argwhere(~world.occupied)
    row, column = free[rng.integers(len(free))]
    x, y, angle = column + rng.uniform(), row + rng.uniform(), rng.uniform(0, 2 * math.pi)
    dx, dy = math.cos(angle), math.sin(angle)
    length = ray_length(world.occupied, x, y, dx, dy, 100.0)
    padded = np.pad(world.occupied, 1, constant_values=True)
    t = np.linspace(0.0, length * (1.0 - 1e-9), 2000)
    assert not padded[np.floor(y + t * dy).astype(int) + 1, np.floor(x + t * dx).astype(int) + 1].any()
    beyond = length + 1e-9
    assert padded[math.floor(y + beyond * dy) + 1, math.floor(x + beyond * dx) + 1]


def test_ray_keeps_to_its_longest_and_starts_inside_walls_with_nothing() -> None:
    occupied = np.zeros((10, 10), dtype=np.bool_)
    occupied[5, 5] = True
    assert ray_length(occupied, 1.5, 1.5, 1.0, 0.0, 3.0) == 3.0
    assert ray_length(occupied, 5.5, 5.5, 1.0, 0.0, 3.0) == 0.0
    assert ray_length(occupied, 2.5, 5.25, 1.0, 0.0, 30.0) == pytest.approx(2.5)


def test_flood_does_not_pass_diagonal_gaps() -> None:
    free = np.array([[1, 0, 0], [0, 1, 1], [0, 0, 1]], dtype=np.bool_)
    assert flood(free, 1, 1).sum() == 3
    assert flood(free, 0, 1).sum() == 0

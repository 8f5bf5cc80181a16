"""Connected components and reachable sets against scipy.ndimage.label."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from planning import clusters

EIGHT = np.ones((3, 3))


def _mask(seed: int) -> NDArray[np.bool_]:
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 25)), int(rng.integers(1, 30)))
    mask: NDArray[np.bool_] = rng.random(shape) < rng.choice([0.0, 0.2, 0.4, 0.6, 1.0])
    return mask


@given(seed=st.integers(0, 100_000))
def test_components_equal_scipy(seed: int) -> None:
    mask = _mask(seed)
    labels = np.full(mask.shape, -5, np.int32)
    count = clusters.label_components(mask, labels)
    expected, expected_count = ndimage.label(mask, EIGHT)
    assert count == expected_count
    np.testing.assert_array_equal(labels, expected)


@given(seed=st.integers(0, 100_000))
def test_sizes_centroids_and_medoids(seed: int) -> None:
    mask = _mask(seed)
    labels = np.empty(mask.shape, np.int32)
    count = clusters.label_components(mask, labels)
    sizes, centroids = clusters.component_centroids(labels, count)
    medoids = clusters.component_medoids(labels, centroids)
    assert sizes.shape == (count,) and centroids.shape == medoids.shape == (count, 2)
    for k in range(count):
        cells = np.argwhere(labels == k + 1)
        assert sizes[k] == len(cells)
        assert centroids[k] == pytest.approx(cells.mean(axis=0))
        gaps = np.hypot(*(cells - cells.mean(axis=0)).T)
        own = np.hypot(*(medoids[k] - cells.mean(axis=0)))
        assert labels[medoids[k, 0], medoids[k, 1]] == k + 1
        assert own == pytest.approx(gaps.min(), abs=1e-6)


@given(seed=st.integers(0, 100_000))
def test_flood_fill_is_the_union_of_the_seeds_four_connected_components(seed: int) -> None:
    passable = _mask(seed)
    rng = np.random.default_rng(seed + 1)
    seeds = np.stack([rng.integers(-1, n + 1, 3) for n in passable.shape], axis=1).astype(np.int32)
    reached = np.empty(passable.shape, np.bool_)
    total = clusters.flood_fill(passable, seeds, reached)
    labels, _ = ndimage.label(passable)
    expected = np.zeros(passable.shape, np.bool_)
    for row, column in seeds:
        inside = 0 <= row < passable.shape[0] and 0 <= column < passable.shape[1]
        if inside and passable[row, column]:
            expected |= labels == labels[row, column]
    np.testing.assert_array_equal(reached, expected)
    assert total == int(expected.sum())

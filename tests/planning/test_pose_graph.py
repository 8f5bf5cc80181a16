"""The pose-graph optimiser against scipy's least squares, and on loops whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from planning.pose_graph import Edges, between, compose, cost, optimise, residuals, wrap

Poses = NDArray[np.float64]


def _edges(truth: Poses, pairs: list[tuple[int, int]], rng: np.random.Generator, noise: float) -> Edges:
    """Measured relative poses with noise, and a random full information matrix each."""
    first, second = np.array(pairs, dtype=np.int64).T
    measured = between(truth[first], truth[second]) + noise * rng.standard_normal((len(pairs), 3))
    root = rng.standard_normal((len(pairs), 3, 3))
    return Edges(first, second, measured, root @ root.transpose(0, 2, 1) + 0.5 * np.eye(3))


def _walk(n: int, rng: np.random.Generator) -> Poses:
    steps = np.column_stack(
        [1.0 + 0.2 * rng.standard_normal(n), 0.1 * rng.standard_normal(n), rng.uniform(-0.7, 0.7, n)]
    )
    poses = np.zeros((n, 3))
    for k in range(1, n):
        poses[k] = compose(poses[k - 1], steps[k])
    return poses


def _by_least_squares(start: Poses, edges: Edges) -> Poses:
    roots = np.linalg.cholesky(edges.information).transpose(0, 2, 1)

    def errors(free: Poses) -> Poses:
        poses = np.vstack([start[:1], free.reshape(-1, 3)])
        weighted: Poses = np.einsum("mij,mj->mi", roots, residuals(poses, edges)).ravel()
        return weighted

    found = least_squares(errors, start[1:].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return np.vstack([start[:1], found.x.reshape(-1, 3)])


def test_compose_and_between_undo_each_other() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-9, 9, (50, 3)), rng.uniform(-3.1, 3.1, (50, 3))
    np.testing.assert_allclose(between(a, compose(a, b)), b, atol=1e-12)
    assert np.all(np.abs(wrap(rng.uniform(-50, 50, 1000))) <= math.pi)


@pytest.mark.parametrize("seed", range(6))
def test_optimum_is_that_of_scipys_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = _walk(12, rng)
    pairs = [(k, k + 1) for k in range(11)] + [(11, 0), (3, 9), (10, 2)]
    edges = _edges(truth, pairs, rng, 0.1)
    start = truth + np.vstack([np.zeros(3), 0.2 * rng.standard_normal((11, 3))])
    found, reference = optimise(start, edges, tolerance=1e-9), _by_least_squares(start, edges)
    assert cost(found, edges) == pytest.approx(cost(reference, edges), rel=1e-8)
    np.testing.assert_allclose(found[:, :2], reference[:, :2], atol=1e-5)
    np.testing.assert_allclose(wrap(found[:, 2] - reference[:, 2]), 0.0, atol=1e-6)
    np.testing.assert_array_equal(found[0], start[0])


def test_perfect_measurements_are_met_from_a_bad_start() -> None:
    rng = np.random.default_rng(4)
    truth = _walk(40, rng)
    edges = _edges(truth, [(k, k + 1) for k in range(39)] + [(39, 0), (5, 30)], rng, 0.0)
    start = truth + np.vstack([np.zeros(3), rng.standard_normal((39, 3)) * [1.0, 1.0, 0.5]])
    found = optimise(start, edges, max_iterations=100)
    np.testing.assert_allclose(found[:, :2], truth[:, :2], atol=1e-4)
    assert cost(found, edges) < 1e-8 < cost(start, edges)


def test_an_error_of_heading_is_shared_along_the_loop() -> None:
    """A square loop whose odometry turns too little: every corner takes its part, and the loop closes."""
    side = 25
    turn = math.pi / 2 - 0.05
    steps = np.tile([1.0, 0.0, 0.0], (4 * side, 1))
    steps[side - 1 :: side, 2] = turn
    poses = np.zeros((4 * side + 1, 3))
    for k, step in enumerate(steps):
        poses[k + 1] = compose(poses[k], step)
    assert math.hypot(*poses[-1, :2]) > 1.5
    index = np.arange(4 * side)
    information = np.tile(np.diag([1e4, 1e4, 1e2]), (4 * side + 1, 1, 1))
    information[-1] = np.diag([1e6, 1e6, 1e6])
    edges = Edges(
        np.append(index, 0), np.append(index + 1, 4 * side), np.vstack([steps, [0.0, 0.0, 0.0]]), information
    )
    found = optimise(poses, edges)
    assert math.hypot(*found[-1, :2]) < 0.05
    moved = np.hypot(*(found - poses)[:, :2].T)
    assert moved[side] < moved[2 * side] < moved[4 * side]


def test_poses_that_no_edge_ties_down_are_refused() -> None:
    edges = Edges(np.array([0]), np.array([1]), np.array([[1.0, 0.0, 0.0]]), np.eye(3)[None])
    with pytest.raises(ValueError, match="no edges tie"):
        optimise(np.zeros((3, 3)), edges)


def test_a_graph_without_edges_stays_as_it_is() -> None:
    none = Edges(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    poses = np.array([[1.0, 2.0, 0.3]])
    np.testing.assert_array_equal(optimise(poses, none), poses)

"""The optimiser in space against scipy's least squares, its derivatives, and the planar one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from planning.pose_graph import Edges, optimise, wrap
from planning.pose_graph_3d import Edges3d, Poses3d, _jacobians, cost_3d, optimise_3d, residuals_3d

Floats = NDArray[np.float64]


def _poses(n: int, rng: np.random.Generator) -> Poses3d:
    place = np.cumsum(rng.normal([1.0, 0.0, 0.0], 0.4, (n, 3)), axis=0)
    return Poses3d(place - place[0], Rotation.from_rotvec(0.8 * rng.standard_normal((n, 3))).as_matrix())


def _edges(truth: Poses3d, pairs: list[tuple[int, int]], rng: np.random.Generator, noise: float) -> Edges3d:
    first, second = np.array(pairs, dtype=np.int64).T
    back = truth.turn[first].transpose(0, 2, 1)
    place = np.einsum("mij,mj->mi", back, truth.place[second] - truth.place[first])
    off = noise * rng.standard_normal((2, len(pairs), 3))
    turn = back @ truth.turn[second] @ Rotation.from_rotvec(off[1]).as_matrix()
    root = rng.standard_normal((len(pairs), 6, 6))
    return Edges3d(first, second, place + off[0], turn, root @ root.transpose(0, 2, 1) + np.eye(6))


def _moved(poses: Poses3d, step: Floats) -> Poses3d:
    by = step.reshape(-1, 6)
    return Poses3d(poses.place + by[:, :3], poses.turn @ Rotation.from_rotvec(by[:, 3:]).as_matrix())


def test_derivatives_are_those_of_small_differences() -> None:
    rng = np.random.default_rng(1)
    poses = _poses(5, rng)
    edges = _edges(poses, [(0, 1), (3, 2), (1, 4)], rng, 0.3)
    given = _jacobians(poses, edges, residuals_3d(poses, edges))
    for end, jacobian in zip((edges.first, edges.second), given, strict=True):
        for k in range(6):
            step = np.zeros((5, 6))
            step[end, k] = 1e-6
            other = np.zeros((5, 6))
            other[end, k] = -1e-6
            # One edge at a time has this pose at this end: the others are looked at in their own rows.
            slope = (
                residuals_3d(_moved(poses, step), edges) - residuals_3d(_moved(poses, other), edges)
            ) / 2e-6
            alone = [m for m in range(3) if (edges.first[m] in end) + (edges.second[m] in end) == 1]
            np.testing.assert_allclose(jacobian[alone, :, k], slope[alone], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_optimum_is_that_of_scipys_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = _poses(7, rng)
    pairs = [(k, k + 1) for k in range(6)] + [(6, 0), (1, 4)]
    edges = _edges(truth, pairs, rng, 0.05)
    start = _moved(truth, np.vstack([np.zeros(6), 0.05 * rng.standard_normal((6, 6))]))
    roots = np.linalg.cholesky(edges.information).transpose(0, 2, 1)

    def errors(free: Floats) -> Floats:
        poses = _moved(start, np.concatenate([np.zeros(6), free]))
        weighted: Floats = np.einsum("mij,mj->mi", roots, residuals_3d(poses, edges)).ravel()
        return weighted

    reference = least_squares(errors, np.zeros(36), xtol=1e-14, ftol=1e-14, gtol=1e-14).cost
    found = optimise_3d(start, edges, tolerance=1e-9)
    assert cost_3d(found, edges) == pytest.approx(reference, rel=1e-7)
    np.testing.assert_array_equal(found.place[0], start.place[0])


def _about_z(yaw_rad: Floats) -> Floats:
    turns: Floats = Rotation.from_rotvec(yaw_rad[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    return turns


def test_in_the_plane_it_gives_what_the_planar_one_gives() -> None:
    rng = np.random.default_rng(8)
    n = 20
    flat = np.column_stack([np.arange(n) * 1.0, rng.normal(0, 0.3, n), rng.uniform(-3, 3, n)])
    pairs = [(k, k + 1) for k in range(n - 1)] + [(n - 1, 0), (3, 12)]
    first, second = np.array(pairs, dtype=np.int64).T
    c, s = np.cos(flat[first, 2]), np.sin(flat[first, 2])
    dx, dy = (flat[second, :2] - flat[first, :2]).T
    measured = np.column_stack([c * dx + s * dy, -s * dx + c * dy, wrap(flat[second, 2] - flat[first, 2])])
    measured += 0.05 * rng.standard_normal(measured.shape)
    m = len(pairs)
    planar = optimise(flat, Edges(first, second, measured, np.tile(np.diag([4.0, 4.0, 9.0]), (m, 1, 1))))
    spatial = optimise_3d(
        Poses3d(np.column_stack([flat[:, :2], np.zeros(n)]), _about_z(flat[:, 2])),
        Edges3d(
            first, second, np.column_stack([measured[:, :2], np.zeros(m)]),
            _about_z(measured[:, 2]),
            np.tile(np.diag([4.0, 4.0, 4.0, 9.0, 9.0, 9.0]), (m, 1, 1)),
        ),
        tolerance=1e-8,
    )  # fmt: skip
    np.testing.assert_allclose(spatial.place[:, :2], planar[:, :2], atol=1e-4)
    np.testing.assert_allclose(spatial.place[:, 2], 0.0, atol=1e-9)

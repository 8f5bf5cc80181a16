"""Planar pose graphs: the poses that fit relative measurements best (Gauss-Newton on SE(2), sparse).

After Kuemmerle et al., "g2o: A general framework for graph optimization" (ICRA 2011), with its error of an edge:
z^-1 * (x_i^-1 * x_j). Levenberg's damping steps in only where a plain Gauss-Newton step would raise the cost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

_SMALLEST_DAMPING = 1e-6
_LARGEST_DAMPING = 1e8


class Edges(NamedTuple):
    """Relative measurements: pose `second` in the frame of pose `first`.

    first, second: (m,) indices of poses. measured: (m, 3) x, y in metres, yaw in radians. information: (m, 3, 3),
    inverse covariance of the measurement, symmetric and positive.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    measured: NDArray[np.float64]
    information: NDArray[np.float64]


class _Linear(NamedTuple):
    """cost: half the weighted sum of squares. hessian, gradient: of the free unknowns."""

    cost: float
    hessian: csc_array
    gradient: NDArray[np.float64]


def wrap(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi), elementwise."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def compose(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (..., 3) of `outer` after which `inner` is driven, shape (..., 3)."""
    c, s = np.cos(outer[..., 2]), np.sin(outer[..., 2])
    x = outer[..., 0] + c * inner[..., 0] - s * inner[..., 1]
    y = outer[..., 1] + s * inner[..., 0] + c * inner[..., 1]
    return np.stack([x, y, wrap(outer[..., 2] + inner[..., 2])], axis=-1)


def between(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose of `second` in the frame of `first`, both (..., 3), shape (..., 3)."""
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    dx, dy = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap(second[..., 2] - first[..., 2])], axis=-1)


def residuals(poses: NDArray[np.float64], edges: Edges) -> NDArray[np.float64]:
    """What each edge is off, in the frame of its measurement: (m, 3) x, y, yaw."""
    return between(edges.measured, between(poses[edges.first], poses[edges.second]))


def cost(poses: NDArray[np.float64], edges: Edges) -> float:
    """Half the sum of the squared residuals, weighted by the information."""
    e = residuals(poses, edges)
    return 0.5 * float(np.einsum("mi,mij,mj->", e, edges.information, e))


def optimise(
    poses: NDArray[np.float64], edges: Edges, max_iterations: int = 30, tolerance: float = 1e-5
) -> NDArray[np.float64]:
    """The poses (n, 3) of least cost near the given ones; pose 0 stays where it is.

    Ends when no pose moves by more than `tolerance` (m, rad). Raises ValueError when the edges leave a pose free.
    """
    best = poses.astype(np.float64, copy=True)
    if len(best) < 2 or not len(edges.first):
        return best
    damping, linear = 0.0, _linearise(best, edges)
    for _ in range(max_iterations):
        step = _solve(linear, damping)
        moved = best.copy()
        moved[1:] += step
        moved[:, 2] = wrap(moved[:, 2])
        small = float(np.abs(step).max()) < tolerance
        if small or cost(moved, edges) <= linear.cost:
            best, damping = moved, damping / 10.0 if damping > _SMALLEST_DAMPING else 0.0
            if small:
                break
            linear = _linearise(best, edges)
        else:
            damping = max(10.0 * damping, _SMALLEST_DAMPING)
            if damping > _LARGEST_DAMPING:
                break
    return best


def _solve(linear: _Linear, damping: float) -> NDArray[np.float64]:
    """The step of the free poses, shape (n - 1, 3)."""
    hessian = linear.hessian
    if damping > 0.0:
        hessian = csc_array(hessian + damping * diags_array(hessian.diagonal()))
    try:
        # A symmetric ordering without pivoting: as good as Cholesky here, and the fill stays small.
        factor = splu(
            hessian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise ValueError(f"pose graph: no edges tie some poses to the first one ({error})") from error
    step: NDArray[np.float64] = -factor.solve(linear.gradient)
    return step.reshape(-1, 3)


def _linearise(poses: NDArray[np.float64], edges: Edges) -> _Linear:
    """Cost, Gauss-Newton Hessian and gradient over the poses but the first."""
    e = residuals(poses, edges)
    of_first, of_second = _jacobians(poses, edges)
    weighted = np.einsum("mij,mj->mi", edges.information, e)
    n = len(poses)
    gradient = np.zeros((n, 3))
    np.add.at(gradient, edges.first, np.einsum("mji,mj->mi", of_first, weighted))
    np.add.at(gradient, edges.second, np.einsum("mji,mj->mi", of_second, weighted))
    rows, columns, values = [], [], []
    within = np.arange(3)
    for a, of_a in ((edges.first, of_first), (edges.second, of_second)):
        left = np.einsum("mji,mjk->mik", of_a, edges.information)
        for b, of_b in ((edges.first, of_first), (edges.second, of_second)):
            values.append(np.einsum("mik,mkj->mij", left, of_b).ravel())
            rows.append(np.broadcast_to(3 * a[:, None, None] + within[:, None], (len(a), 3, 3)).ravel())
            columns.append(np.broadcast_to(3 * b[:, None, None] + within, (len(a), 3, 3)).ravel())
    whole = coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(3 * n, 3 * n)
    )
    return _Linear(0.5 * float(np.sum(e * weighted)), csc_array(whole.tocsc()[3:, 3:]), gradient[1:].ravel())


def _jacobians(poses: NDArray[np.float64], edges: Edges) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of the residuals by the first and by the second pose, each (m, 3, 3)."""
    m = len(edges.first)
    yaw, of_z = poses[edges.first, 2], edges.measured[:, 2]
    c, s = np.cos(yaw + of_z), np.sin(yaw + of_z)  # R_z^T R_i^T turns by minus the sum
    dx, dy = (poses[edges.second, :2] - poses[edges.first, :2]).T
    of_first, of_second = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
    of_second[:, 0, 0], of_second[:, 0, 1], of_second[:, 1, 0], of_second[:, 1, 1] = c, s, -s, c
    of_first[:, :2, :2] = -of_second[:, :2, :2]
    of_first[:, 0, 2], of_first[:, 1, 2] = -s * dx + c * dy, -c * dx - s * dy
    of_first[:, 2, 2], of_second[:, 2, 2] = -1.0, 1.0
    return of_first, of_second

"""Planar pose graphs: the poses that fit relative measurements best (Gauss-Newton on SE(2), sparse).

The error of an edge is that of Kuemmerle et al., "g2o" (ICRA 2011): z^-1 * (x_i^-1 * x_j).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.gauss_newton import Linear, assemble, minimise


class Edges(NamedTuple):
    """Relative measurements: pose `second` in the frame of pose `first`.

    first, second: (m,) indices of poses. measured: (m, 3) x, y in metres, yaw in radians. information: (m, 3, 3),
    inverse covariance of the measurement, symmetric and positive.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    measured: NDArray[np.float64]
    information: NDArray[np.float64]


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
    if len(poses) < 2 or not len(edges.first):
        return poses.astype(np.float64, copy=True)

    def linearise(at: NDArray[np.float64]) -> Linear:
        jacobians = _jacobians(at, edges)
        ends = (edges.first, edges.second)
        return assemble(len(at), ends, residuals(at, edges), edges.information, jacobians)

    def retract(at: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = at.copy()
        moved[1:] += step.reshape(-1, 3)
        moved[:, 2] = wrap(moved[:, 2])
        return moved

    start = poses.astype(np.float64, copy=True)
    return minimise(start, linearise, lambda at: cost(at, edges), retract, max_iterations, tolerance)


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

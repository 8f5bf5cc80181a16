"""Pose graphs in space: the poses that fit relative measurements best (Gauss-Newton on SE(3), sparse).

The error of an edge is (translation, rotation vector) of z^-1 * (x_i^-1 * x_j). Places move in the world, rotations
by a rotation vector on their right (Sola et al., "A micro Lie theory for state estimation in robotics", 2018).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from planning.gauss_newton import Linear, assemble, minimise

Floats = NDArray[np.float64]


class Edges3d(NamedTuple):
    """Relative measurements: pose `second` in the frame of pose `first`.

    first, second: (m,) indices of poses. place: (m, 3), m. turn: (m, 3, 3) rotation matrices. information: (m, 6, 6),
    of the place and of the rotation vector (rad).
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    place: Floats
    turn: Floats
    information: Floats


class Poses3d(NamedTuple):
    """place: (n, 3), m. turn: (n, 3, 3) rotation matrices."""

    place: Floats
    turn: Floats


def residuals_3d(poses: Poses3d, edges: Edges3d) -> Floats:
    """What each edge is off, in the frame of its measurement: (m, 6) place, rotation vector."""
    back = np.swapaxes(edges.turn, 1, 2)
    turned = np.swapaxes(poses.turn[edges.first], 1, 2)
    seen = _apply(turned, poses.place[edges.second] - poses.place[edges.first])
    rotation = back @ turned @ poses.turn[edges.second]
    return np.hstack([_apply(back, seen - edges.place), Rotation.from_matrix(rotation).as_rotvec()])


def cost_3d(poses: Poses3d, edges: Edges3d) -> float:
    """Half the sum of the squared residuals, weighted by the information."""
    e = residuals_3d(poses, edges)
    return 0.5 * float(np.einsum("mi,mij,mj->", e, edges.information, e))


def optimise_3d(poses: Poses3d, edges: Edges3d, max_iterations: int = 30, tolerance: float = 1e-4) -> Poses3d:
    """The poses of least cost near the given ones; pose 0 stays where it is.

    Ends when no pose moves by more than `tolerance` (m, rad). Raises ValueError when the edges leave a pose free.
    """
    if len(poses.place) < 2 or not len(edges.first):
        return poses

    def linearise(at: Poses3d) -> Linear:
        errors = residuals_3d(at, edges)
        ends = (edges.first, edges.second)
        return assemble(len(at.place), ends, errors, edges.information, _jacobians(at, edges, errors))

    def retract(at: Poses3d, step: Floats) -> Poses3d:
        by = np.vstack([np.zeros(6), step.reshape(-1, 6)])
        return Poses3d(at.place + by[:, :3], at.turn @ Rotation.from_rotvec(by[:, 3:]).as_matrix())

    return minimise(poses, linearise, lambda at: cost_3d(at, edges), retract, max_iterations, tolerance)


def _apply(matrices: Floats, vectors: Floats) -> Floats:
    product: Floats = np.einsum("mij,mj->mi", matrices, vectors)
    return product


def _cross(v: Floats) -> Floats:
    """The matrices (m, 3, 3) that take the cross product with the vectors (m, 3) from the left."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - np.swapaxes(out, 1, 2)


def _inverse_right_jacobian(rotvec: Floats) -> Floats:
    """How a rotation vector changes with a small rotation on its right, (m, 3, 3) (Sola, equation 144)."""
    angle = np.linalg.norm(rotvec, axis=1)
    safe = np.where(angle < 1e-4, 1.0, angle)
    factor = np.where(
        angle < 1e-4, 1.0 / 12.0, 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    )
    cross = _cross(rotvec)
    return np.eye(3) + 0.5 * cross + factor[:, None, None] * (cross @ cross)


def _jacobians(poses: Poses3d, edges: Edges3d, errors: Floats) -> tuple[Floats, Floats]:
    """Derivatives of the residuals by the first and by the second pose, each (m, 6, 6)."""
    back = np.swapaxes(edges.turn, 1, 2)
    turned = np.swapaxes(poses.turn[edges.first], 1, 2)
    seen = _apply(turned, poses.place[edges.second] - poses.place[edges.first])
    bent = _inverse_right_jacobian(errors[:, 3:])
    of_first, of_second = np.zeros((len(errors), 6, 6)), np.zeros((len(errors), 6, 6))
    of_second[:, :3, :3] = back @ turned
    of_second[:, 3:, 3:] = bent
    of_first[:, :3, :3] = -of_second[:, :3, :3]
    of_first[:, :3, 3:] = back @ _cross(seen)
    of_first[:, 3:, 3:] = -bent @ np.swapaxes(poses.turn[edges.second], 1, 2) @ poses.turn[edges.first]
    return of_first, of_second

"""Gauss-Newton on graphs of poses: sparse, over unknowns that edges tie in pairs; pose 0 stays where it is.

Kuemmerle et al., "g2o: A general framework for graph optimization" (ICRA 2011). Levenberg's damping steps in only
where a plain Gauss-Newton step would raise the cost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

_SMALLEST_DAMPING = 1e-6
_LARGEST_DAMPING = 1e8
X = TypeVar("X")
Floats = NDArray[np.float64]


class Linear(NamedTuple):
    """A linearised problem. cost: half the weighted sum of squares. hessian, gradient: of the poses but the first."""

    cost: float
    hessian: csc_array
    gradient: Floats


def minimise(
    start: X,
    linearise: Callable[[X], Linear],
    cost: Callable[[X], float],
    retract: Callable[[X, Floats], X],
    max_iterations: int,
    tolerance: float,
) -> X:
    """What has least cost near the start. retract: the poses after a step (of the free unknowns, flat).

    Ends when no unknown moves by more than `tolerance`. Raises ValueError when the edges leave a pose free.
    """
    best, damping, linear = start, 0.0, linearise(start)
    for _ in range(max_iterations):
        step = _solve(linear, damping)
        moved = retract(best, step)
        small = float(np.abs(step).max()) < tolerance
        if small or cost(moved) <= linear.cost:
            best, damping = moved, damping / 10.0 if damping > _SMALLEST_DAMPING else 0.0
            if small:
                break
            linear = linearise(best)
        else:
            damping = max(10.0 * damping, _SMALLEST_DAMPING)
            if damping > _LARGEST_DAMPING:
                break
    return best


def _solve(linear: Linear, damping: float) -> Floats:
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
    step: Floats = -factor.solve(linear.gradient)
    return step


def assemble(
    poses: int,
    ends: tuple[NDArray[np.int64], NDArray[np.int64]],
    errors: Floats,
    information: Floats,
    jacobians: tuple[Floats, Floats],
) -> Linear:
    """The linearised problem of edges between `poses` poses of d unknowns each.

    ends: (m,) first and second pose of each edge. errors: (m, d). information, jacobians (by the first and by the
    second pose): (m, d, d).
    """
    d = errors.shape[1]
    weighted = np.einsum("mij,mj->mi", information, errors)
    gradient = np.zeros((poses, d))
    rows, columns, values = [], [], []
    within = np.arange(d)
    for a, of_a in zip(ends, jacobians, strict=True):
        np.add.at(gradient, a, np.einsum("mji,mj->mi", of_a, weighted))
        left = np.einsum("mji,mjk->mik", of_a, information)
        for b, of_b in zip(ends, jacobians, strict=True):
            values.append(np.matmul(left, of_b).ravel())
            rows.append(np.broadcast_to(d * a[:, None, None] + within[:, None], (len(a), d, d)).ravel())
            columns.append(np.broadcast_to(d * b[:, None, None] + within, (len(a), d, d)).ravel())
    whole = coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(d * poses, d * poses),
    )
    return Linear(
        0.5 * float(np.sum(errors * weighted)), csc_array(whole.tocsc()[d:, d:]), gradient[1:].ravel()
    )

"""Layers of cells seen from another frame: nearest cells, without holes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from planning.grid import GridSpec
from planning.kernels import njit


def bounds(spec: GridSpec, by: Planar) -> GridSpec:
    """The grid that holds another one after a rigid motion."""
    res = spec.resolution_m
    corners = [
        by.apply((spec.ix0 + cx) * res, (spec.iy0 + cy) * res)
        for cx in (0, spec.width)
        for cy in (0, spec.height)
    ]
    ix0 = math.floor(min(c[0] for c in corners) / res)
    iy0 = math.floor(min(c[1] for c in corners) / res)
    width = math.floor(max(c[0] for c in corners) / res) - ix0 + 1
    height = math.floor(max(c[1] for c in corners) / res) - iy0 + 1
    return GridSpec(res, ix0, iy0, width, height)


def moved(spec: GridSpec, cells: NDArray[Any], by: Planar) -> tuple[GridSpec, NDArray[Any]]:
    """The cells after a rigid motion; 0 or false around them."""
    if by.is_identity:
        return spec, cells
    target = bounds(spec, by)
    return target, resample(cells, spec, target, by, 0)


def resample(
    values: NDArray[Any], spec: GridSpec, target: GridSpec, target_from_source: Planar, fill: Any
) -> NDArray[Any]:
    """Nearest-cell values of a layer over another grid in another frame.

    Every cell of the target asks where it came from, so no holes appear.

    target_from_source: pose of the source's frame in the target's. Cells that come from outside get `fill`.
    """
    back = target_from_source.inverse()
    out = np.full(target.shape, fill, dtype=values.dtype)
    pull(
        values, spec.ix0, spec.iy0, spec.resolution_m, back.x_m, back.y_m, math.cos(back.yaw_rad),
        math.sin(back.yaw_rad), target.ix0, target.iy0, out,
    )  # fmt: skip
    return out


@njit
def pull(
    values: NDArray[Any],
    ix0: int,
    iy0: int,
    resolution_m: float,
    back_x_m: float,
    back_y_m: float,
    cosine: float,
    sine: float,
    target_ix0: int,
    target_iy0: int,
    out: NDArray[Any],
) -> None:
    """Fill `out` with the value of the cell of `values` that each of its cells' centres falls into."""
    height, width = values.shape
    for r in range(out.shape[0]):
        y = (target_iy0 + r + 0.5) * resolution_m
        for c in range(out.shape[1]):
            x = (target_ix0 + c + 0.5) * resolution_m
            column = math.floor((back_x_m + cosine * x - sine * y) / resolution_m) - ix0
            row = math.floor((back_y_m + sine * x + cosine * y) / resolution_m) - iy0
            if 0 <= row < height and 0 <= column < width:
                out[r, c] = values[row, column]

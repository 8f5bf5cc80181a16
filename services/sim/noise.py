"""Smooth random fields over a grid, in octaves: the shape of natural ground."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import GridSpec

Field = NDArray[np.float64]


def octave(spec: GridSpec, wavelength_m: float, rng: np.random.Generator) -> Field:
    """Field of about unit variance, shape of the grid, smooth below `wavelength_m`.

    Random heights on a lattice of half a wavelength, cubic splines between them.
    """
    pitch = wavelength_m / (2.0 * spec.resolution_m)
    rows, columns = (math.ceil(n / pitch) + 4 for n in spec.shape)
    lattice = rng.standard_normal((rows, columns))
    along_y = np.arange(spec.height) / pitch + 1.5
    along_x = np.arange(spec.width) / pitch + 1.5
    # Separable: splines along the rows of the lattice, then down the columns.
    down = _spline(lattice, along_y, axis=0)
    return _spline(down, along_x, axis=1) * 1.25


def _spline(values: Field, at: Field, axis: int) -> Field:
    """Cubic spline along one axis, at fractional indices."""
    weights = ndimage.spline_filter1d(values, order=3, axis=axis, mode="mirror")
    index = np.floor(at).astype(int)
    t = at - index
    basis = (
        (1.0 - t) ** 3 / 6.0,
        (3.0 * t**3 - 6.0 * t**2 + 4.0) / 6.0,
        (-3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0) / 6.0,
        t**3 / 6.0,
    )
    total: Field = np.zeros(1)
    for k, share in enumerate(basis):
        taken = np.take(weights, index - 1 + k, axis=axis)
        total = total + taken * (share[:, None] if axis == 0 else share[None, :])
    return total


def smooth_step(value: Field, low: float, high: float) -> Field:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def line_noise(count: int, knots: int, rng: np.random.Generator) -> Field:
    """Smooth random values in about [-1, 1] along a line, shape (count,)."""
    values = rng.uniform(-1.0, 1.0, max(knots, 2) + 3)
    return _spline(values[:, None], np.linspace(1.0, values.size - 2.001, count), axis=0)[:, 0]

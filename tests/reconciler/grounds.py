"""Small risk maps for the tests of the reconciler."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.footprint import clearance_m
from planning.grid import FREE, LETHAL, GridSpec
from services.reconciler.path import Ground

RESOLUTION_M = 0.1


def ground_of(lethal: NDArray[np.bool_], ix0: int = -40, iy0: int = -30) -> Ground:
    """Known ground with these lethal cells of 0.1 m."""
    spec = GridSpec(RESOLUTION_M, ix0, iy0, lethal.shape[1], lethal.shape[0])
    state = np.where(lethal, LETHAL, FREE).astype(np.uint8)
    return Ground(spec, state, clearance_m(lethal, None, None, spec))


def random_ground(seed: int, size: int = 100, boulders: int = 12) -> Ground:
    """A walled field with square boulders."""
    rng = np.random.default_rng(seed)
    lethal = np.zeros((size, size), np.bool_)
    lethal[[0, -1], :] = lethal[:, [0, -1]] = True
    for row, column in rng.integers(3, size - 6, (boulders, 2)):
        lethal[row : row + 4, column : column + 4] = True
    return ground_of(lethal)

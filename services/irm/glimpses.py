"""Patches of which no node sees half: narrow gaps into what may be free, inner corners (`coverage: known`).

At the full resolution: at half of it the cell beside a wall is hidden by the wall.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.lattice_graph import seen_by_any
from planning.rays import visible_mass

_NEARLY = 0.5
"""Share of the best view of a patch that is as good."""


@njit
def add_glimpses(
    opaque: NDArray[np.bool_],
    mass: NDArray[np.float32],
    patch_of: NDArray[np.int32],
    x0_m: float,
    y0_m: float,
    resolution_m: float,
    range_m: float,
    size: int,
    reach: int,
    state: NDArray[np.uint8],
    anchor_m: NDArray[np.float64],
    entropy: NDArray[np.float32],
    rows: NDArray[np.uint32],
) -> int:
    """A patch that no node sees half of holds what its best view shows, and is seen from where most of that is.

    Arguments as of `visible_rows`. entropy, rows: (n,), (n, 2 reach + 1), changed. Returns how many such patches.
    """
    shown = np.zeros(size * size, np.bool_)
    seen_by_any(rows, np.ones(size * size, np.bool_), size, reach, shown)
    orphan = (entropy > 0.0) & ~shown
    best, seen = np.zeros(size * size, np.float32), np.zeros(size * size, np.float32)
    view = np.zeros((size * size, 2 * reach + 1, 2 * reach + 1), np.float32)
    for sweep in range(2):
        for node in range(size * size):
            if state[node] != 1:
                continue
            own_row, own_column, near = node // size, node % size, False
            low_r, high_r = max(0, own_row - reach), min(size, own_row + reach + 1)
            low_c, high_c = max(0, own_column - reach), min(size, own_column + reach + 1)
            for r in range(low_r, high_r):
                for c in range(low_c, high_c):
                    seen[r * size + c] = 0.0
                    near = near or orphan[r * size + c]
            if not near:
                continue
            if sweep == 0:
                x = round(4.0 * (anchor_m[node, 0] - x0_m) / resolution_m) / 4.0
                y = round(4.0 * (anchor_m[node, 1] - y0_m) / resolution_m) / 4.0
                visible_mass(opaque, mass, x, y, range_m / resolution_m, patch_of, seen)
            for r in range(low_r, high_r):
                for c in range(low_c, high_c):
                    other, i, j = r * size + c, r - own_row + reach, c - own_column + reach
                    if not orphan[other]:
                        continue
                    if sweep == 0:
                        view[node, i, j] = seen[other]
                        best[other] = max(best[other], seen[other])
                    elif view[node, i, j] > 0.0 and view[node, i, j] >= _NEARLY * best[other]:
                        rows[node, i] |= np.uint32(1) << np.uint32(j)
    for node in range(size * size):
        if orphan[node]:
            entropy[node] = min(entropy[node], best[node])
    return int(np.count_nonzero(orphan))

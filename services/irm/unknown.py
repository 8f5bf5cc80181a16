"""Exploration of what is unknown (`coverage: known`): what counts as uncovered is the unknown behind the known.

The paper covers known ground with a sensor; the belief about coverage is one about free ground. Where the map itself is
the aim, a cell is covered once it is known, and what is left to gain lies behind the border of the known: unknown
ground that the robot may well enter, as far as obstacles are known, the nearer to the known the surer.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.coverage import LOG_2
from planning.kernels import njit

KNOWN_PROBABILITY = 0.99
"""Coverage of a cell that is known."""


def expected_gain(
    reachable: NDArray[np.bool_],
    hopeful: NDArray[np.bool_],
    resolution_m: float,
    depth_m: float,
    decay_m: float,
    cell_share: float,
) -> NDArray[np.float32]:
    """Entropy of the unknown cells behind the border of the known, (h, w) nats of whole patches; 0 elsewhere.

    reachable, hopeful: (h, w) known ground that the robot's centre can reach; unknown that it may enter. A cell at a
    depth d (steps of the grid, m) up to depth_m counts log 2 times exp(-d / decay_m): the deeper, the less likely it is
    that it is free, and seen from the border. cell_share: area of a cell as a share of a patch.
    """
    depth = np.zeros(reachable.shape, np.int32)
    unknown_depth(reachable, hopeful, max(1, round(depth_m / resolution_m)), depth)
    inside = depth > 0
    gain = np.zeros(reachable.shape, np.float32)
    gain[inside] = LOG_2 * cell_share * np.exp(-(depth[inside] - 1) * (resolution_m / decay_m))
    return gain


@njit
def unknown_depth(
    reachable: NDArray[np.bool_], hopeful: NDArray[np.bool_], most: int, depth: NDArray[np.int32]
) -> None:
    """Steps (8-connected, through hopeful cells) from the nearest reachable cell, up to `most`; 0 elsewhere.

    depth: (h, w) out, zeros.
    """
    height, width = reachable.shape
    queue = np.empty(height * width, np.int64)
    head, tail = 0, 0
    for row in range(height):
        for column in range(width):
            if not hopeful[row, column]:
                continue
            border = False
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    border = border or reachable[r, c]
            if border:
                depth[row, column] = 1
                queue[tail] = row * width + column
                tail += 1
    while head < tail:
        row, column = queue[head] // width, queue[head] % width
        head += 1
        if depth[row, column] >= most:
            continue
        for r in range(max(0, row - 1), min(height, row + 2)):
            for c in range(max(0, column - 1), min(width, column + 2)):
                if hopeful[r, c] and depth[r, c] == 0:
                    depth[r, c] = depth[row, column] + 1
                    queue[tail] = r * width + c
                    tail += 1


def expected_area_m2(gain: float, spacing_m: float) -> float:
    """Area of unseen ground with so much entropy (nats of whole patches)."""
    return gain / LOG_2 * spacing_m * spacing_m if math.isfinite(gain) else 0.0

"""Floors above one another: found and refused by name, or one of them taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from plgrim.feeds.errors import FeedError, StackedFloorsError

SAME_PLACE_M = 2.0
"""Keyframes so near to one another in x and y are at the same place ..."""
ANOTHER_FLOOR_M = 1.5
"""... and on two floors when their heights differ by more (a robot's height and a margin)."""
HALF_FLOOR_M = ANOTHER_FLOOR_M / 2.0
"""A floor that is chosen holds the keyframes up to so far from its height: no two of them are on two floors."""


def check_one_floor(source: str, ids: NDArray[np.int64], pose: NDArray[np.float64]) -> None:
    """Raises StackedFloorsError when keyframes lie above one another. pose: (n, 4) x, y, z, yaw."""
    pairs = cKDTree(pose[:, :2]).query_pairs(SAME_PLACE_M, output_type="ndarray")
    if not len(pairs):
        return
    apart_m = np.abs(pose[pairs[:, 0], 2] - pose[pairs[:, 1], 2])
    stacked = pairs[apart_m > ANOTHER_FLOOR_M]
    if not len(stacked):
        return
    a, b = min((min(i, j), max(i, j)) for i, j in stacked.tolist())
    low, high = float(pose[:, 2].min()), float(pose[:, 2].max())
    raise StackedFloorsError(
        f"{source}: floors above one another are not supported (keyframes {ids[a]} and {ids[b]} lie within "
        f"{SAME_PLACE_M:g} m of each other at heights {pose[a, 2]:.1f} and {pose[b, 2]:.1f} m; {len(stacked)} such "
        f"pairs): take one floor with --floor Z, {low:.1f} to {high:.1f} m"
    )


def of_floor(source: str, pose: NDArray[np.float64], floor_z_m: float) -> NDArray[np.int64]:
    """Indices of the keyframes of one floor. Raises FeedError when there are fewer than two."""
    kept = np.flatnonzero(np.abs(pose[:, 2] - floor_z_m) <= HALF_FLOOR_M)
    if len(kept) < 2:
        low, high = float(pose[:, 2].min()), float(pose[:, 2].max())
        raise FeedError(
            f"{source}: {len(kept)} keyframes within {HALF_FLOOR_M:g} m of --floor {floor_z_m:g}: "
            f"heights go from {low:.1f} to {high:.1f} m"
        )
    return kept

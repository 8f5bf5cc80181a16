"""Viewpoints: places from which, between them, all of the ground can be seen. Greedy set cover by the judge's sight."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.known_ground import Mask, Points
from services.sim.coverage import Judge

SAMPLE = 2
"""Every so many-th row and column of the judge's cells stands for those around it."""

Cells = NDArray[np.int64]
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A place to go to, and what is to be seen from there."""

    place: int
    """Index of the candidate."""
    owned: Cells
    """Flat indices of the sampled cells that it was chosen for: no viewpoint before it sees them."""


def sampled(reachable: Mask) -> Mask:
    """The cells that stand for all."""
    found = np.zeros_like(reachable)
    found[::SAMPLE, ::SAMPLE] = reachable[::SAMPLE, ::SAMPLE]
    return found


def views(judge: Judge, points: Points, tell: Tell) -> list[Cells]:
    """For each point (n, 2), in metres, the flat indices of the sampled cells that the sensor sees all around."""
    pending = sampled(judge.reachable)
    seen = np.zeros_like(pending)
    found = []
    for k, (x_m, y_m) in enumerate(points.tolist()):
        window = judge.look_around(x_m, y_m, pending, seen)
        rows, columns = np.nonzero(seen[window])
        flat = (rows + window[0].start) * pending.shape[1] + columns + window[1].start
        pending.reshape(-1)[flat], seen.reshape(-1)[flat] = True, False
        found.append(flat.astype(np.int64))
        if k % 2000 == 1999:
            tell(f"lines of sight from {k + 1} of {len(points)} places")
    return found


def cover(seen_from: list[Cells], wanted: Mask, least_cells: int) -> list[Viewpoint]:
    """Greedy set cover: always the place that sees most of what no chosen one sees, while that is `least_cells`.

    seen_from: flat indices per place. wanted: the cells to be seen; not changed. Of equal places the first is taken.
    """
    left = wanted.reshape(-1).copy()
    # What a place still sees only shrinks: a stale count is an upper bound, and only the best need be counted anew.
    heap = [(-int(np.count_nonzero(left[cells])), place) for place, cells in enumerate(seen_from)]
    heapq.heapify(heap)
    chosen = []
    while heap:
        _, place = heapq.heappop(heap)
        owned = seen_from[place][left[seen_from[place]]]
        if owned.size < max(least_cells, 1):
            continue
        if heap and (-owned.size, place) > heap[0]:
            heapq.heappush(heap, (-owned.size, place))
            continue
        left[owned] = False
        chosen.append(Viewpoint(place, owned))
    return chosen

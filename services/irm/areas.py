"""How much ground there is and how much of it is covered, counted by tile as tiles change."""

from __future__ import annotations

import math

import numpy as np

from services.irm.tiles import TileLayer
from services.irm.window import GROUND


class Areas:
    """Counts of two layers in `map`: a step costs what it has changed, not what there is."""

    def __init__(self, ground: TileLayer, coverage: TileLayer, covered_log_odds: float) -> None:
        """covered_log_odds: from which a cell is covered; -inf: as soon as it is known."""
        self._ground, self._coverage, self._bound = ground, coverage, covered_log_odds
        self._counts: dict[tuple[int, int], tuple[int, int]] = {}
        self._reachable = self._covered = 0

    def update(self) -> tuple[float, float]:
        """(reachable, covered) ground in m2, over everything seen so far."""
        for key in sorted(self._ground.take_touched() | self._coverage.take_touched()):
            before, now = self._counts.get(key, (0, 0)), self._count(key)
            self._counts[key] = now
            self._reachable += now[0] - before[0]
            self._covered += now[1] - before[1]
        area = self._ground.resolution_m**2
        return self._reachable * area, self._covered * area

    def _count(self, key: tuple[int, int]) -> tuple[int, int]:
        ground, coverage = self._ground.tile(key), self._coverage.tile(key)
        if ground is None:
            return 0, 0
        mask = ground == GROUND
        if self._bound == -math.inf:
            return int(np.count_nonzero(mask)), int(np.count_nonzero(mask))
        covered = 0 if coverage is None else int(np.count_nonzero(mask & (coverage >= self._bound)))
        return int(np.count_nonzero(mask)), covered

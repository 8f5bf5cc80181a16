"""How long the services' steps took, sampled as the mission goes on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.topics import SERVICES

COLUMNS = ("elapsed_s", *SERVICES)
"""Mission time, and the median step time of each service, ms (NaN: not known)."""


class StepTimes:
    """Samples at least `every_s` of mission time apart; beyond `limit` every second one is dropped."""

    def __init__(self, every_s: float = 2.0, limit: int = 4096) -> None:
        self.every_s = every_s
        self.limit = limit
        self._rows: list[tuple[float, ...]] = []

    def due(self, elapsed_s: float) -> bool:
        """Whether a sample is wanted now. A mission that began anew begins new samples."""
        if self._rows and elapsed_s < self._rows[-1][0]:
            self._rows.clear()
        return not self._rows or elapsed_s - self._rows[-1][0] >= self.every_s

    def add(self, elapsed_s: float, step_ms: dict[str, float]) -> None:
        """Take one sample. step_ms: median step time by service."""
        self._rows.append((elapsed_s, *(step_ms.get(name, math.nan) for name in SERVICES)))
        if len(self._rows) > self.limit:
            self._rows = self._rows[::2]
            self.every_s *= 2

    def rows(self) -> NDArray[np.float32]:
        """(n, columns) as in `COLUMNS`."""
        return np.array(self._rows, np.float32).reshape(-1, len(COLUMNS))

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        rows = np.array(self._rows, np.float64).reshape(-1, len(COLUMNS))
        return {"every_s": self.every_s, "columns": list(COLUMNS), "rows": rows}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot; one of other columns is not taken."""
        if tuple(state["columns"]) == COLUMNS:
            self.every_s = float(state["every_s"])
            self._rows = [tuple(float(value) for value in row) for row in state["rows"]]

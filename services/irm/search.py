"""Ways over the fine layers around the robot: what the edges of the Global IRM are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from planning.grid import LETHAL
from planning.kernels import njit
from planning.search import dijkstra_box
from services.irm.window import Window

_NO_TARGETS = np.empty((0, 2), np.int32)


class Search:
    """Distances and risks from one cell over the window, to points in `map`."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._cost = np.full(window.spec.shape, np.inf)
        self._parent = np.full(window.spec.shape, -1, np.int32)
        self._start, self._reach_m = (-1, -1), 0.0
        self._remembered: Search | None = None

    def run(self, start: tuple[int, int], reach_m: float) -> None:
        """Search from a cell, up to `reach_m` away (straight)."""
        self._start, self._reach_m, self._remembered = start, reach_m, None
        self._run(self._window.free_space)

    def _run(self, passable: NDArray[np.bool_]) -> None:
        w, reach_m = self._window, self._reach_m
        row, column = self._start
        if not w.spec.contains(row, column):
            return
        cells = math.ceil(reach_m / w.spec.resolution_m)
        box = (row - cells, row + cells + 1, column - cells, column + cells + 1)
        dijkstra_box(
            w.step_cost, passable, w.spec.resolution_m, row, column, box, _NO_TARGETS, 4.0 * reach_m,
            self._cost, self._parent,
        )  # fmt: skip

    def remembered_m(self, x_m: float, y_m: float) -> float:
        """Distance to a point over ground that the risk map may have forgotten; inf when no way leads there."""
        if self._remembered is None:
            self._remembered = Search(self._window)
            self._remembered._start, self._remembered._reach_m = self._start, self._reach_m
            self._remembered._run(self._window.reachable)
        return self._remembered.to(x_m, y_m)[0]

    def to(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(distance, rho) of the best path to a point; (inf, 1) when there is none."""
        cell = self._nearest_reached(x_m, y_m)
        if cell is None:
            return math.inf, 1.0
        s = self._window.spec
        distance, integral = path_totals(self._parent, self._window.hazard, s.resolution_m, cell[0], cell[1])
        return distance, 1.0 - math.exp(-integral)

    def knows(self, x_m: float, y_m: float) -> bool:
        """Whether the point lies in the window on known ground, so that 'no path' is evidence."""
        row, column = self._window.cell(x_m, y_m)
        return self._window.spec.contains(row, column) and self._window.state[row, column] != 0

    def obstacle_on(self, line: Sequence[tuple[float, float]], within_m: float = math.inf) -> bool:
        """Whether a lethal cell lies on a line of points, no farther than so from the robot."""
        return any(self._obstacle_between(a, b, within_m) for a, b in pairwise(line))

    def _obstacle_between(self, a: tuple[float, float], b: tuple[float, float], within_m: float) -> bool:
        spec, state, robot = self._window.spec, self._window.state, self._window.robot_cell
        steps = max(1, math.ceil(2.0 * math.dist(a, b) / spec.resolution_m))
        for i in range(steps + 1):
            at = (a[0] + (b[0] - a[0]) * i / steps, a[1] + (b[1] - a[1]) * i / steps)
            row, column = self._window.cell(*at)
            if not spec.contains(row, column) or state[row, column] != LETHAL:
                continue
            if math.dist((row, column), robot) * spec.resolution_m <= within_m:
                return True
        return False

    def is_lethal(self, x_m: float, y_m: float) -> bool:
        """Whether a point lies in an obstacle, where no node can be: it is not where it seems to be."""
        row, column = self._window.cell(x_m, y_m)
        return self._window.spec.contains(row, column) and bool(self._window.state[row, column] == LETHAL)

    def _nearest_reached(self, x_m: float, y_m: float) -> tuple[int, int] | None:
        row, column = self._window.cell(x_m, y_m)
        height, width = self._cost.shape
        for reach in (0, 1, 2, 4):
            r0, r1 = max(0, row - reach), min(height, row + reach + 1)
            c0, c1 = max(0, column - reach), min(width, column + reach + 1)
            if r0 >= r1 or c0 >= c1:
                continue
            piece = self._cost[r0:r1, c0:c1]
            for index in np.argsort(piece, axis=None, kind="stable")[
                : int(np.isfinite(piece).sum())
            ].tolist():
                cell = r0 + index // piece.shape[1], c0 + index % piece.shape[1]
                if reach == 0 or self._open(row, column, *cell):
                    return cell
        return None

    def _open(self, row: int, column: int, r: int, c: int) -> bool:
        """Whether no obstacle lies between two cells: the cell reached may be on the other side of a thin wall."""
        steps = 2 * max(abs(r - row), abs(c - column))
        for i in range(1, steps):
            at = round(row + (r - row) * i / steps), round(column + (c - column) * i / steps)
            if self._window.spec.contains(*at) and self._window.state[at] == LETHAL:
                return False
        return True


@njit
def path_totals(
    parent: NDArray[np.int32], hazard: NDArray[np.float32], resolution_m: float, row: int, column: int
) -> tuple[float, float]:
    """Length and hazard integral of the path to a cell, along the parents of a grid search."""
    width = parent.shape[1]
    distance, integral = 0.0, 0.0
    at = row * width + column
    while parent[at // width, at % width] >= 0:
        before = parent[at // width, at % width]
        diagonal = at // width != before // width and at % width != before % width
        step = resolution_m * (1.4142135623730951 if diagonal else 1.0)
        mean = 0.5 * (hazard[at // width, at % width] + hazard[before // width, before % width])
        distance += step
        integral += step * mean
        at = before
    return distance, integral

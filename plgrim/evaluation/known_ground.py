"""The ground as a planner that knows the map has it: where it may be, ways between places, and how long they are.

The cells are the judge's own: where the middle of the footprint can be without a wall, ledge, slope or ceiling in
the way (`services.sim.coverage.Judge.roamed`). Ways keep off the rim of it where there is room.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from planning.grid import GridSpec
from planning.search import dijkstra_box, dijkstra_grid, shortcut_path, trace_path

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

MARGIN_M = 0.4
"""From the rim of the ground; ways nearer to it cost more."""
_LEAST_MARGIN_M = 0.1
_RIM_COST = 1.5
"""A metre of way counts as this times (`MARGIN_M` / margin - 1) metres more: at half the margin, so much."""
_DEAREST = 1.0 + _RIM_COST * (MARGIN_M / _LEAST_MARGIN_M - 1.0)
"""Metres that a metre counts as at most."""
_SPAN = 400
"""Most cells that a straightened piece of a way replaces."""
_TOLERANCE = 0.002
_NEIGHBOURS_WITHIN = 2.5
"""Places so many spacings apart may be joined directly."""
_ROWS_AT_ONCE = 256


class KnownGround:
    """Where the robot's middle may be, with ways over it. roamed: bool[height, width] on `spec`, one connected part."""

    def __init__(self, spec: GridSpec, roamed: Mask) -> None:
        self.spec, self.roamed = spec, roamed
        margin = ndimage.distance_transform_edt(np.pad(roamed, 1))[1:-1, 1:-1] * spec.resolution_m
        self.margin_m: NDArray[np.float32] = margin.astype(np.float32)
        """From each cell to the nearest where the middle may not be, m; 0 there."""
        rim = _RIM_COST * np.maximum(0.0, MARGIN_M / np.maximum(margin, _LEAST_MARGIN_M) - 1.0)
        self._rim_cost: NDArray[np.float32] = rim.astype(np.float32)
        self._cost: NDArray[np.float32] = (1.0 + rim).astype(np.float32)
        self._found = np.empty(spec.shape, np.float64)
        self._parent = np.empty(spec.shape, np.int32)

    def without(self, x_m: float, y_m: float, radius_m: float) -> KnownGround:
        """The ground less a disc: ways lead around it, where they can."""
        x, y = self.spec.centres_x(), self.spec.centres_y()[:, None]
        return KnownGround(self.spec, self.roamed & (np.hypot(x - x_m, y - y_m) > radius_m))

    def part_with(self, x_m: float, y_m: float) -> KnownGround:
        """The 4-connected part of the ground that holds the cell nearest to a point."""
        parts, _ = ndimage.label(self.roamed)
        return KnownGround(self.spec, parts == parts[self.nearest_cell(x_m, y_m)])

    def places(self, spacing_m: float) -> NDArray[np.int64]:
        """One cell of each square of `spacing_m` that holds ground: clear of the rim, then near the square's middle.

        Returns (n, 2) rows and columns, by squares.
        """
        rows, columns = np.nonzero(self.roamed)
        side = max(1, round(spacing_m / self.spec.resolution_m))
        square = (rows // side) * (self.spec.width // side + 1) + columns // side
        off = np.hypot(rows % side - (side - 1) / 2, columns % side - (side - 1) / 2)
        clear = np.minimum(self.margin_m[rows, columns], MARGIN_M)
        ordered = np.lexsort((off, -clear, square))
        first = np.unique(square[ordered], return_index=True)[1]
        chosen = ordered[first]
        return np.stack([rows[chosen], columns[chosen]], axis=1).astype(np.int64)

    def centres(self, cells: NDArray[np.int64]) -> Points:
        """(n, 2) x and y in metres of cells (n, 2)."""
        x = (self.spec.ix0 + cells[:, 1] + 0.5) * self.spec.resolution_m
        y = (self.spec.iy0 + cells[:, 0] + 0.5) * self.spec.resolution_m
        return np.stack([x, y], axis=1)

    def nearest_cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """The cell of the ground nearest to a point (row, column); none is farther than the ground's own size."""
        row, column = self.spec.cell_of(x_m, y_m)
        for reach in itertools.chain((2, 8, 32), itertools.repeat(max(self.spec.shape) * 2)):
            r0, c0 = max(row - reach, 0), max(column - reach, 0)
            rows, columns = np.nonzero(
                self.roamed[r0 : max(row + reach + 1, 0), c0 : max(column + reach + 1, 0)]
            )
            if rows.size:
                best = int(np.argmin(np.hypot(rows + r0 - row, columns + c0 - column)))
                return int(rows[best]) + r0, int(columns[best]) + c0
        raise AssertionError("the ground has no cell")

    def way(self, from_m: tuple[float, float], to: tuple[int, int]) -> tuple[Points, float]:
        """The cheapest way from a point to a cell, straightened: (n, 2) points in metres, and its cost in metres.

        The cost is infinite, and the points are the first alone, where there is no way.
        """
        begin = self.nearest_cell(*from_m)
        cell = self.spec.resolution_m
        straight_m = math.hypot(begin[0] - to[0], begin[1] - to[1]) * cell
        pad_m = 0.5 * straight_m + 5.0
        targets = np.array([to], np.int32)
        while True:
            pad = math.ceil(pad_m / cell)
            box = (
                min(begin[0], to[0]) - pad, max(begin[0], to[0]) + pad + 1,
                min(begin[1], to[1]) - pad, max(begin[1], to[1]) + pad + 1,
            )  # fmt: skip
            dijkstra_box(
                self._cost, self.roamed, cell, *begin, box, targets, np.inf, self._found, self._parent
            )
            cost = float(self._found[to])
            whole = pad > max(self.spec.shape)
            if cost <= 2.0 * pad_m or whole:  # a way that leaves the box is longer
                break
            pad_m *= 2.0
        if not math.isfinite(cost):
            return np.array([from_m]), math.inf
        cells = trace_path(self._parent, *to).astype(np.int64)
        points = np.concatenate([np.array([from_m], np.float64), self.centres(cells)[1:]])
        return self._straightened(points), cost

    def _straightened(self, points: Points) -> Points:
        spec = self.spec
        return shortcut_path(
            points, self.margin_m, self._rim_cost, spec.resolution_m, spec.ix0, spec.iy0, MARGIN_M, 1.0,
            _TOLERANCE, _SPAN,
        )  # fmt: skip

    def margin_at(self, points: Points) -> NDArray[np.float64]:
        """Distance from the rim at points (n, 2), m; 0 off the ground."""
        spec = self.spec
        column = np.floor(points[:, 0] / spec.resolution_m).astype(np.int64) - spec.ix0
        row = np.floor(points[:, 1] / spec.resolution_m).astype(np.int64) - spec.iy0
        inside = (row >= 0) & (row < spec.height) & (column >= 0) & (column < spec.width)
        found = np.zeros(len(points))
        found[inside] = self.margin_m[row[inside], column[inside]]
        return found

    # --- distances --------------------------------------------------------------------------------------------

    def roadmap(self, cells: NDArray[np.int64], spacing_m: float) -> sparse.csr_array:
        """Ways between neighbouring cells (n, 2) `spacing_m` apart, as costs in metres: a connected graph, n nodes."""
        edges: dict[tuple[int, int], float] = {}
        lonely = np.arange(len(cells))
        reach_m = _NEIGHBOURS_WITHIN * spacing_m
        while True:
            for place in lonely.tolist():
                self._join(cells, place, reach_m, edges)
            graph = _symmetric(edges, len(cells))
            count, part = csgraph.connected_components(graph, directed=False)
            if count == 1 or reach_m > self.spec.resolution_m * sum(self.spec.shape) * _DEAREST:
                return graph
            main = int(np.argmax(np.bincount(part)))
            lonely = np.flatnonzero(part != main)
            reach_m *= 2.0

    def _join(
        self, cells: NDArray[np.int64], place: int, reach_m: float, edges: dict[tuple[int, int], float]
    ) -> None:
        """Edges from one place to all within reach, by cost."""
        row, column = int(cells[place, 0]), int(cells[place, 1])
        reach = math.ceil(reach_m / self.spec.resolution_m)
        box = (row - reach, row + reach + 1, column - reach, column + reach + 1)
        near = np.flatnonzero((np.abs(cells[:, 0] - row) <= reach) & (np.abs(cells[:, 1] - column) <= reach))
        dijkstra_box(
            self._cost, self.roamed, self.spec.resolution_m, row, column, box,
            cells[near].astype(np.int32), reach_m, self._found, self._parent,
        )  # fmt: skip
        costs = self._found[cells[near, 0], cells[near, 1]]
        for other, cost in zip(near.tolist(), costs.tolist(), strict=True):
            if other != place and math.isfinite(cost):
                edges[min(place, other), max(place, other)] = cost

    def from_point(self, x_m: float, y_m: float, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Costs (n,) in metres of the cheapest ways from a point to cells (n, 2)."""
        begin = self.nearest_cell(x_m, y_m)
        dijkstra_grid(
            self._cost, self.roamed, self.spec.resolution_m, *begin, np.inf, self._found, self._parent
        )
        return np.asarray(self._found[cells[:, 0], cells[:, 1]])


def _symmetric(edges: dict[tuple[int, int], float], count: int) -> sparse.csr_array:
    ends = np.array(list(edges), np.int64).reshape(-1, 2)
    costs = np.array(list(edges.values()))
    rows, columns = np.concatenate([ends[:, 0], ends[:, 1]]), np.concatenate([ends[:, 1], ends[:, 0]])
    return sparse.csr_array((np.concatenate([costs, costs]), (rows, columns)), shape=(count, count))


def distances_between(graph: sparse.csr_array, places: NDArray[np.int64]) -> NDArray[np.float32]:
    """Costs (k, k) of the cheapest ways along a roadmap between k of its nodes."""
    found = np.empty((len(places), len(places)), np.float32)
    for begin in range(0, len(places), _ROWS_AT_ONCE):
        some = places[begin : begin + _ROWS_AT_ONCE]
        found[begin : begin + len(some)] = csgraph.dijkstra(graph, directed=False, indices=some)[:, places]
    return np.minimum(found, found.T)

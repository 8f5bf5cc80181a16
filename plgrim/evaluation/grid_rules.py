"""The exploration rules of two peers, ARiADNE and DARE: maps, sensor, lattice, utilities, when a map is done.

A world is stepped from node to node; whoever chooses the next node (a peer's rule, or PLGRIM) reads `belief`, `place`,
`utility` and `legal_moves`. Lengths are in the protocol's own unit: px for ARiADNE, m for DARE.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from planning.clusters import label_components
from plgrim.errors import PlgrimError
from plgrim.evaluation.grid_kernels import (
    OPEN,
    SOLID,
    UNSEEN,
    block_minimum,
    connected_open,
    frontier_cells,
    in_sight,
    open_lines,
    scan,
    without_settled,
)

Rules = Literal["ariadne", "dare"]
MARKER = 208
"""Gray of the start marker."""
RAYS = 720
_ENOUGH_CELLS = 250


class MapError(PlgrimError):
    """An image that is no map of the protocol."""

    exit_code = 2


@dataclass(frozen=True)
class GridMap:
    """A map: truth (h, w) SOLID or OPEN, row 0 as in the image; start: cell x, y."""

    name: str
    truth: NDArray[np.uint8]
    start: tuple[int, int]


def read_map(path: Path, rules: Rules) -> GridMap:
    """An image as a map of the protocol. Raises MapError."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            image.load()
            if image.mode not in ("L", "RGB", "RGBA"):
                raise MapError(f"{path}: {image.mode} image; 8-bit gray or RGB is wanted")
            pixels = np.asarray(image, np.float64)
    except (OSError, UnidentifiedImageError) as error:
        raise MapError(f"{path}: cannot be read as an image: {error}") from error
    if pixels.ndim == 3:  # as skimage's rgb2gray, which the peers use
        pixels = pixels[:, :, :3] @ np.array([0.2125, 0.7154, 0.0721])
        gray = (pixels / 255.0 * 255.0 + 1e-9).astype(np.int64)
    else:
        gray = pixels.astype(np.int64)
    return ariadne_map(path.stem, gray) if rules == "ariadne" else dare_map(path.stem, gray)


def ariadne_map(name: str, gray: NDArray[np.int64]) -> GridMap:
    """Free where gray > 150; starts at pixel 127 of the marker, row by row. Raises MapError."""
    return GridMap(name, _truth(gray > 150), _start(name, gray, 127))


def dare_map(name: str, gray: NDArray[np.int64]) -> GridMap:
    """Blocks of 2 x 2 pixels by their minimum; free above 150 or from 50 to 80; starts at cell 10 of the marker."""
    rows, columns = gray.shape[0] // 2, gray.shape[1] // 2
    reduced = gray[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).min(axis=(1, 3))
    free = (reduced > 150) | ((reduced >= 50) & (reduced <= 80))
    return GridMap(name, _truth(free), _start(name, reduced, 10))


def _truth(free: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(free, OPEN, SOLID).astype(np.uint8)


def _start(name: str, gray: NDArray[np.int64], index: int) -> tuple[int, int]:
    rows, columns = np.nonzero(gray == MARKER)
    if len(rows) <= index:
        raise MapError(
            f"{name}: {len(rows)} cells of the start marker (gray {MARKER}), {index + 1} are wanted"
        )
    return int(columns[index]), int(rows[index])


class GridWorld(ABC):
    """One map that is being explored.

    belief: (h, w) UNSEEN, SOLID or OPEN. at: index of the robot's node. node: (n, 2) cells x, y; place: (n, 2) in the
    protocol's unit. utility: (n,), frontier points that a node sees, 0 where too few. travelled, moves: so far.
    """

    def __init__(self, grid: GridMap, cell: float, range_cells: int, wall_depth: int) -> None:
        self.map, self.cell = grid, cell
        self.truth = grid.truth
        self.belief: NDArray[np.uint8] = np.full(grid.truth.shape, UNSEEN, np.uint8)
        self.range_cells, self._wall_depth = range_cells, wall_depth
        self.free_cells = int(np.count_nonzero(grid.truth == OPEN))
        self.travelled, self.moves, self.at = 0.0, 0, 0
        self.node: NDArray[np.int64] = np.zeros((0, 2), np.int64)
        self.place: NDArray[np.float64] = np.zeros((0, 2))
        self.utility: NDArray[np.int64] = np.zeros(0, np.int64)
        self.edges: dict[int, dict[int, float]] = {}

    def look(self) -> None:
        """One scan from the robot's node."""
        x, y = self.node[self.at].tolist()
        scan(self.truth, self.belief, x, y, ray_ends(x, y, self.range_cells), self._wall_depth)

    def move(self, node: int) -> None:
        """Drive to a node by one edge, and look. Raises ValueError when there is no such edge."""
        if node not in self.edges.get(self.at, {}):
            raise ValueError(f"no edge from node {self.at} to {node}")
        self.travelled += self.edges[self.at][node]
        self.moves += 1
        self.at = node
        self.look()
        self.update()

    @abstractmethod
    def update(self) -> None:
        """Bring nodes, edges and utilities up to date with the belief."""

    @property
    @abstractmethod
    def done(self) -> bool:
        """Whether the protocol calls the map explored."""

    def belief_of_use(self) -> NDArray[np.uint8]:
        """What is known, with unseen cells that no node's utility counts any more SOLID; not to be changed."""
        return self.belief

    def unseen_cells(self) -> int:
        """Free cells of the truth that are not known to be."""
        return self.free_cells - int(np.count_nonzero(self.belief == OPEN))

    def ways(self, source: int | None = None) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(travel, previous node) from a node (default: the robot's) to all; inf and -1 without way."""
        from heapq import heappop, heappush

        start = self.at if source is None else source
        travel, before = np.full(len(self.node), math.inf), np.full(len(self.node), -1, np.int64)
        travel[start], heap = 0.0, [(0.0, start)]
        while heap:
            d, node = heappop(heap)
            if d > travel[node]:
                continue
            for other, length in self.edges.get(node, {}).items():
                if d + length < travel[other]:
                    travel[other], before[other] = d + length, node
                    heappush(heap, (d + length, other))
        return travel, before


def first_move(before: NDArray[np.int64], at: int, goal: int) -> int:
    """The first node on the way from `at` to a goal, by the previous nodes of `GridWorld.ways`; -1: no way."""
    node = goal
    while node >= 0 and before[node] != at:
        node = int(before[node])
    return node


def ray_ends(x: int, y: int, range_cells: int) -> NDArray[np.int64]:
    """(720, 2) rounded end points of rays 0.5 degrees apart. Angles are summed up, as the peers do it."""
    angles = np.cumsum(np.concatenate([[0.0], np.full(RAYS, 0.5 / 180.0 * math.pi)]))
    angles = angles[angles < 2.0 * math.pi]
    ends = np.stack([x + np.cos(angles) * range_cells, y + np.sin(angles) * range_cells], axis=1)
    return np.round(ends).astype(np.int64)


class AriadneWorld(GridWorld):
    """ARiADNE: 30 x 30 points over the map, each a node once it is known free, and the start; 20 nearest neighbours.

    As in the peers' environment, a node is its own nearest neighbour, and what it sees has a history: of the frontier
    that was there before, it sees what it saw when the frontier appeared, not what later comes into sight; a node that
    once saw too little, or was visited, never counts again.
    """

    neighbours = 20
    utility_range = 70.0
    min_utility = 2

    def __init__(self, grid: GridMap) -> None:
        super().__init__(grid, 1.0, 80, 9)
        height, width = grid.truth.shape
        x = np.linspace(0, width - 1, 30).round().astype(np.int64)
        y = np.linspace(0, height - 1, 30).round().astype(np.int64)
        self._points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        self._is_node = np.zeros(len(self._points), np.bool_)
        self._seen: list[NDArray[np.int64]] = []
        self._ended: list[bool] = []
        self._frontier: NDArray[np.int64] = np.zeros(0, np.int64)
        self.node = np.array([grid.start], np.int64)
        self.look()
        self.node = np.zeros((0, 2), np.int64)
        self.update()

    def update(self) -> None:
        """New nodes, all edges, and what the change of the frontier does to the utilities."""
        first = len(self.node) == 0
        here = self.map.start if first else tuple(self.node[self.at].tolist())
        is_free = self.belief[self._points[:, 1], self._points[:, 0]] == OPEN
        new = self._points[is_free & ~self._is_node]
        self._is_node |= is_free
        start = np.array([self.map.start], np.int64)
        new = new[np.any(new != start, axis=1)]
        if first:
            new = np.concatenate([start, new])
            new = new[np.lexsort((new[:, 1], new[:, 0]))]
        self.node = np.concatenate([self.node, new])
        self.place = self.node.astype(np.float64)
        self.at = int(np.flatnonzero(np.all(self.node == here, axis=1))[0])
        self._connect()
        self._count(len(new))

    def _connect(self) -> None:
        away = np.linalg.norm(self.place[:, None] - self.place[None], axis=2)
        nearest = np.argsort(away, axis=1, kind="stable")[:, : self.neighbours]
        pairs = np.stack([np.repeat(np.arange(len(self.node)), nearest.shape[1]), nearest.ravel()], axis=1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        free = open_lines(self.belief, self.node, pairs)
        self.edges = {}
        for (a, b), is_free in zip(pairs.tolist(), free.tolist(), strict=True):
            if is_free:
                self.edges.setdefault(a, {})[b] = float(away[a, b])

    def frontier(self) -> NDArray[np.int64]:
        """(m, 2) frontier cells of the map downsampled by 4, as cells of the map."""
        return frontier_cells(block_minimum(self.belief, 4)) * 4

    def _count(self, added: int) -> None:
        cells = self.frontier()
        frontier = cells[:, 0] * self.truth.shape[0] + cells[:, 1]
        old, known = len(self.node) - added, np.isin(frontier, self._frontier)
        fresh = self._sight(cells[~known], slice(0, old))
        all_of_them = self._sight(cells, slice(old, None))
        for i in range(old):
            kept = self._seen[i][np.isin(self._seen[i], frontier)]
            self._seen[i] = np.concatenate([kept, frontier[~known][fresh[i]]])
        self._seen += [frontier[row] for row in all_of_them]
        self._ended += [False] * added
        self._frontier = frontier
        self._ended[self.at] = True
        self.utility = np.zeros(len(self.node), np.int64)
        for i, seen in enumerate(self._seen):
            self._ended[i] = self._ended[i] or len(seen) <= self.min_utility
            self.utility[i] = 0 if self._ended[i] else len(seen)

    def belief_of_use(self) -> NDArray[np.uint8]:
        """Openings that lead to less than what may stay unseen are shut: w cells wide, they lead to w x w or so."""
        cells = self.frontier()
        mask = np.zeros((self.truth.shape[0] // 4 + 1, self.truth.shape[1] // 4 + 1), np.bool_)
        mask[cells[:, 1] // 4, cells[:, 0] // 4] = True
        labels = np.zeros(mask.shape, np.int32)
        pieces = label_components(mask, labels)
        wide = np.bincount(labels.ravel(), minlength=pieces + 1) * 4
        open_border = np.zeros(self.belief.shape, np.bool_)
        for y, x in np.argwhere(mask & (wide[labels] ** 2 > _ENOUGH_CELLS)).tolist():
            open_border[max(0, 4 * y - 4) : 4 * y + 8, max(0, 4 * x - 4) : 4 * x + 8] = True
        return without_settled(self.belief, open_border)

    def _sight(self, cells: NDArray[np.int64], part: slice) -> NDArray[np.bool_]:
        seen = np.zeros((len(self.node[part]), len(cells)), np.bool_)
        in_sight(
            self.belief,
            self.node[part],
            cells,
            self.place[part],
            cells.astype(np.float64),
            self.utility_range,
            seen,
        )
        return seen

    @property
    def done(self) -> bool:
        """At most 250 free cells are unseen, or no node has any utility."""
        return self.unseen_cells() <= _ENOUGH_CELLS or not self.utility.any()


class DareWorld(GridWorld):
    """DARE: cells of 0.4 m, nodes every 4 m that are known free and connected, moves within the 5 x 5 neighbourhood.

    A node that was visited has no utility: what it sees and its sensor does not clear would never end.
    """

    spacing = 4.0
    utility_range = 16.0
    min_utility = 1
    voxel = 1.6

    def __init__(self, grid: GridMap) -> None:
        super().__init__(grid, 0.4, 50, 1)
        height, width = grid.truth.shape
        self._origin = np.array([-round(grid.start[0] * 0.4, 1), -round(grid.start[1] * 0.4, 1)])
        low = np.ceil(self._origin / self.spacing - 1e-9)
        high = np.floor((self._origin + (np.array([width, height]) - 1) * 0.4) / self.spacing + 1e-9)
        index = [np.arange(low[k], high[k] + 1).astype(np.int64) for k in (0, 1)]
        self._index = np.stack(np.meshgrid(*index, indexing="xy"), axis=-1).reshape(-1, 2)
        self._cell = np.around((self._index * self.spacing - self._origin) / 0.4).astype(np.int64)
        inside = np.all((self._cell >= 0) & (self._cell < [width, height]), axis=1)
        self._index, self._cell = self._index[inside], self._cell[inside]
        self._visited: set[tuple[int, ...]] = set()
        self._open_border: NDArray[np.int64] = np.zeros((0, 2), np.int64)
        self.node = np.array([grid.start], np.int64)
        self.look()
        self.update()

    def update(self) -> None:
        """All nodes, edges and utilities of the belief."""
        x, y = self.node[self.at].tolist()
        here = connected_open(self.belief, x, y)
        kept = here[self._cell[:, 1], self._cell[:, 0]]
        self.node, index = self._cell[kept], self._index[kept]
        self.place = index * self.spacing
        self.at = int(np.flatnonzero(np.all(self.node == (x, y), axis=1))[0])
        gap = np.abs(index[:, None] - index[None]).max(axis=2)
        pairs = np.argwhere((gap > 0) & (gap <= 2))
        free = open_lines(self.belief, self.node, pairs)
        self.edges = {}
        for a, b in pairs[free].tolist():
            self.edges.setdefault(a, {})[b] = math.dist(self.place[a], self.place[b])
        cells, place, voxel, chosen = self._voxels()
        seen = np.zeros((len(self.node), len(chosen)), np.bool_)
        in_sight(
            self.belief, self.node, cells[chosen], self.place, place[chosen], self.utility_range, seen
        )  # fmt: skip
        count = np.count_nonzero(seen, axis=1)
        self._visited.add((x, y))
        visited = [tuple(c) in self._visited for c in self.node.tolist()]
        count[(count <= self.min_utility) | np.array(visited)] = 0
        self.utility = count.astype(np.int64)
        settled = seen.any(axis=0) & ~seen[count > 0].any(axis=0)
        self._open_border = cells[~settled[voxel]]

    def belief_of_use(self) -> NDArray[np.uint8]:
        """Of the frontier, what nodes see but none with any utility does is settled: a single voxel, or all visited."""
        open_border = np.zeros(self.belief.shape, np.bool_)
        open_border[self._open_border[:, 1], self._open_border[:, 0]] = True
        return without_settled(self.belief, open_border)

    def frontier(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """(m, 2) cells and places of frontier points: of each voxel of 1.6 m the point nearest to its corner."""
        cells, place, _, chosen = self._voxels()
        return cells[chosen], place[chosen]

    def _voxels(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """All frontier cells (n, 2) and their places; (n,) the voxel of each; (m,) the cell that stands for a voxel."""
        cells = frontier_cells(self.belief)
        place = np.around(cells * 0.4 + self._origin, 1)
        key = (place / self.voxel).astype(np.int64)
        away = np.linalg.norm(place - key * self.voxel, axis=1)
        number: dict[tuple[int, ...], int] = {}
        best: list[int] = []
        voxel = np.zeros(len(cells), np.int64)
        for i, k in enumerate(map(tuple, key.tolist())):
            voxel[i] = number.setdefault(k, len(number))
            if voxel[i] == len(best):
                best.append(i)
            elif away[i] < away[best[voxel[i]]]:
                best[voxel[i]] = i
        return cells, place, voxel, np.array(best, np.int64)

    @property
    def done(self) -> bool:
        """No node has any utility."""
        return not self.utility.any()


def make_world(grid: GridMap, rules: Rules) -> GridWorld:
    """The world of a map under the rules, after its first scan."""
    return AriadneWorld(grid) if rules == "ariadne" else DareWorld(grid)

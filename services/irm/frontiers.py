"""FrontierManager: the border of covered and uncovered traversable ground (Algorithm 1; Keidar and Kaminka 2012).

Incremental: only what lies in the window around the robot is looked at again; frontiers outside keep what they had,
as no cell there can have changed.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.clusters import component_centroids, label_components
from planning.coverage import LOG_2
from planning.grid import FREE, LETHAL, UNKNOWN
from planning.kernels import njit
from services.irm.config import Config
from services.irm.window import Window


@dataclass(slots=True)
class Frontier:
    """A frontier node. x_m, y_m: a place that the robot's centre can reach. gain: nats of whole patches."""

    node_id: int
    x_m: float
    y_m: float
    gain: float
    beside_s: float = 0.0
    best_gain: float = math.inf
    seen: bool = True
    missed: int = 0
    isolated: int = 0
    pursued_s: float = 0.0
    nearest_m: float = math.inf
    again: bool = False
    opening: bool = False
    rounds: int = 0


class Found(NamedTuple):
    """A frontier as it is found in a window. opening: mostly for what may lie behind the edge of the unseen."""

    x_m: float
    y_m: float
    gain: float
    opening: bool


@dataclass(slots=True)
class GivenUp:
    """A frontier that was given up, why, when it may come back, and whether it has come back before."""

    x_m: float
    y_m: float
    gain: float
    reason: str
    until_ns: int
    again: bool = False


@dataclass(slots=True)
class FrontierManager:
    """Finds, names, prunes and gives up frontiers."""

    config: Config
    frontiers: dict[int, Frontier] = field(default_factory=dict)
    given_up: list[GivenUp] = field(default_factory=list)

    def update(
        self,
        window: Window,
        robot: tuple[float, float],
        now_ns: int,
        elapsed_s: float,
        next_id: int,
        ground_m2: float = 0.0,
    ) -> int:
        """Look at the window again. elapsed_s: since the last call; ground_m2: known so far. Returns the next id."""
        next_id = self._second_chances(next_id)
        self.given_up = [g for g in self.given_up if g.until_ns > now_ns]
        least = least_gain(self.config, ground_m2)
        found = [f for f in find_frontiers(window, self.config, least) if not self._is_given_up(f[0], f[1])]
        self.frontiers = {k: f for k, f in self.frontiers.items() if f.gain >= least}
        inside = [f for f in self.frontiers.values() if _in_window(window, f)]
        for frontier in inside:
            frontier.seen = False
        taken: set[int] = set()
        for distance, index, node_id in self._pairs(found, inside):
            if index in taken or self.frontiers[node_id].seen or distance > self.config.frontier_same_m:
                continue
            taken.add(index)
            frontier = self.frontiers[node_id]
            if math.hypot(found[index][0] - frontier.x_m, found[index][1] - frontier.y_m) > 0.5:
                frontier.beside_s, frontier.pursued_s, frontier.nearest_m = 0.0, 0.0, math.inf
            frontier.x_m, frontier.y_m, frontier.gain, frontier.opening = found[index]
            frontier.seen, frontier.missed = True, 0
            frontier.rounds += 1
        for frontier in inside:
            if not frontier.seen:
                self._miss(frontier, window, robot, now_ns)
        for index, (x, y, gain, opening) in enumerate(found):
            if index not in taken:
                self.frontiers[next_id] = Frontier(next_id, x, y, gain, opening=opening)
                next_id += 1
        self._watch(robot, now_ns, elapsed_s)
        return next_id

    def _second_chances(self, next_id: int) -> int:
        """With nothing else left, frontiers with much to gain that were given up come back, once."""
        if self.frontiers:
            return next_id
        for g in [g for g in self.given_up if g.gain >= self.config.second_chance_gain and not g.again]:
            self.given_up.remove(g)
            self.frontiers[next_id] = Frontier(next_id, g.x_m, g.y_m, g.gain, again=True)
            next_id += 1
        return next_id

    def _miss(self, frontier: Frontier, window: Window, robot: tuple[float, float], now_ns: int) -> None:
        """A frontier in the window that was not found again: covered, forgotten by the risk map, or cut off."""
        row, column = window.spec.cell_of(frontier.x_m, frontier.y_m)
        if window.state[row, column] == UNKNOWN:
            return
        reach = round(1.0 / window.spec.resolution_m)
        near = (
            slice(max(0, row - reach), row + reach + 1),
            slice(max(0, column - reach), column + reach + 1),
        )
        if frontier.opening and window.hopeful[near].any():
            away_m = math.hypot(frontier.x_m - robot[0], frontier.y_m - robot[1])
            if away_m > self.config.opening_range_m - 1.0:
                return  # openings are looked for near the robot only
        if frontier.opening and frontier.rounds < self.config.opening_rounds:
            del self.frontiers[frontier.node_id]
            return
        looked = window.probability[near] >= self.config.covered_probability
        open_ground = (
            (window.state[near] != LETHAL) & ~looked & (window.ground[near] | (window.state[near] == FREE))
        )
        if not open_ground.any():
            del self.frontiers[frontier.node_id]
            return
        frontier.missed += 1
        if frontier.missed > self.config.missed_rounds:
            if window.reachable[near].any():
                del self.frontiers[frontier.node_id]
            else:
                self.give_up(frontier, "cut off: no way for the robot was found", now_ns)

    @staticmethod
    def _pairs(found: list[Found], old: list[Frontier]) -> list[tuple[float, int, int]]:
        pairs = [
            (math.hypot(x.x_m - f.x_m, x.y_m - f.y_m), i, f.node_id) for i, x in enumerate(found) for f in old
        ]
        return sorted(pairs)

    def _is_given_up(self, x_m: float, y_m: float) -> bool:
        near = 0.7 * self.config.give_up_radius_m
        return any(math.hypot(g.x_m - x_m, g.y_m - y_m) < near for g in self.given_up)

    def _watch(self, robot: tuple[float, float], now_ns: int, elapsed_s: float) -> None:
        """Give up frontiers beside which the robot has been for long and that yield nothing."""
        for node_id in sorted(self.frontiers):
            f = self.frontiers[node_id]
            if f.gain < 0.9 * f.best_gain:
                f.best_gain, f.beside_s, f.pursued_s = f.gain, 0.0, 0.0
            if math.hypot(f.x_m - robot[0], f.y_m - robot[1]) <= self.config.give_up_radius_m:
                f.beside_s += elapsed_s
            if f.beside_s > self.config.give_up_s:
                self.give_up(f, "stood beside it and saw nothing new", now_ns)

    def progressed(self) -> None:
        """Ground was covered somewhere: the robot has better to do than to go to its target, which loses no time."""
        for frontier in self.frontiers.values():
            frontier.pursued_s = 0.0

    def pursue(self, node_id: int, distance_m: float, now_ns: int, elapsed_s: float) -> None:
        """The global planner's target is this frontier, so far away: give it up when the robot gets no nearer."""
        f = self.frontiers.get(node_id)
        if f is None:
            return
        if distance_m < f.nearest_m - 0.5:
            f.nearest_m, f.pursued_s = distance_m, 0.0
            return
        f.pursued_s += elapsed_s
        if f.pursued_s > self.config.pursue_s:
            self.give_up(f, "pursued in vain: the robot got no nearer", now_ns)

    def give_up(self, frontier: Frontier, reason: str, now_ns: int) -> None:
        """Take a frontier off the list for a while."""
        until = now_ns + int(self.config.retry_after_s * 1e9)
        self.given_up.append(
            GivenUp(frontier.x_m, frontier.y_m, frontier.gain, reason, until, frontier.again)
        )
        self.frontiers.pop(frontier.node_id, None)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "frontiers": [list(astuple(f)) for _, f in sorted(self.frontiers.items())],
            "given_up": [list(astuple(g)) for g in self.given_up],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.frontiers = {int(f[0]): Frontier(int(f[0]), *f[1:]) for f in state["frontiers"]}
        self.given_up = [GivenUp(*g) for g in state["given_up"]]


def _in_window(window: Window, frontier: Frontier) -> bool:
    row, column = window.spec.cell_of(frontier.x_m, frontier.y_m)
    return window.spec.contains(row, column)


def least_gain(config: Config, ground_m2: float) -> float:
    """The gain from which a border is a frontier: a share of the ground known, within the two bounds, nats."""
    share = config.frontier_min_share * ground_m2 / config.spacing_m**2 * LOG_2
    return max(config.frontier_min_gain, min(share, config.frontier_enough_gain))


def find_frontiers(window: Window, config: Config, least: float | None = None) -> list[Found]:
    """The frontiers of a window with at least this expected information gain, in a fixed order.

    The uncovered ground is split into connected pieces; the border of a piece with covered ground is cut into blocks
    snapped to the plane; each cell of the piece counts for the nearest block, up to the frontier's reach. Where the
    robot's centre can get to the border of ground never seen that it may well enter (the way around a corner; not a
    gap in a ragged wall that its body does not fit), that is open too, and counts what ground may lie behind. Such
    openings are looked for near the robot only: far walls that it sees at a slant are full of holes.
    """
    s = window.spec
    labels = np.zeros(s.shape, np.int32)
    openings = window.reachable & (window.state == FREE) & beside(window.hopeful)
    openings &= near_robot(window, config.opening_range_m)
    open_ground = window.uncovered | openings
    pieces = label_components(open_ground, labels)
    if pieces == 0:
        return []
    block = np.full(s.shape, -1, np.int32)
    cells = max(1, round(config.frontier_block_m / s.resolution_m))
    covered = window.ground & ~open_ground
    blocks = mark_borders(open_ground, covered, labels, s.ix0, s.iy0, cells, pieces, window.robot_cell, block)
    if blocks == 0:
        return []
    reach = round(config.frontier_reach_m / s.resolution_m)
    spread_blocks(open_ground, block, reach, blocks)
    behind = np.zeros(s.shape, np.int32)
    sizes = component_centroids(behind, label_components(window.hopeful, behind))[0]
    gain, sums, hidden = np.zeros(blocks), np.zeros((blocks, 3)), np.zeros(blocks)
    block_gains(window.entropy, behind, sizes, block, gain, sums, hidden)
    hidden *= s.resolution_m**2
    gain += np.minimum(hidden * LOG_2 / config.spacing_m**2, config.unknown_max_gain)
    places = block_places(window.reachable, block, sums, round(1.0 / s.resolution_m))
    piece_of = np.zeros(blocks, np.int64)
    inside = block >= 0
    piece_of[block[inside]] = labels[inside]
    least = config.frontier_min_gain if least is None else least
    opening = hidden >= config.opening_min_m2 - 1e-9
    # The most that the least gain can become: an opening left behind is not dropped when the known ground grows.
    gain[opening] = np.maximum(gain[opening], max(least, config.frontier_enough_gain))
    return _select(gain, opening, places, piece_of, window, least)


def near_robot(window: Window, range_m: float) -> NDArray[np.bool_]:
    """Cells within a distance of the robot's cell."""
    rows = np.arange(window.spec.height) - window.robot_cell[0]
    columns = np.arange(window.spec.width) - window.robot_cell[1]
    near: NDArray[np.bool_] = (
        rows[:, None] ** 2 + columns[None, :] ** 2 <= (range_m / window.spec.resolution_m) ** 2
    )
    return near


def beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells with a side in common with a cell of the mask."""
    padded = np.pad(mask, 1)
    near: NDArray[np.bool_] = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    return near


def _select(
    gain: NDArray[np.float64],
    opening: NDArray[np.bool_],
    places: NDArray[np.int64],
    piece_of: NDArray[np.int64],
    window: Window,
    least: float,
) -> list[Found]:
    """Blocks with enough gain; of a piece of many small blocks that is worth it as a whole, its best block."""
    found = []
    total = np.bincount(piece_of, weights=gain, minlength=int(piece_of.max()) + 1)
    best: dict[int, int] = {}
    for index in range(len(gain)):
        piece = int(piece_of[index])
        if piece not in best or gain[index] > gain[best[piece]]:
            best[piece] = index
    for index in range(len(gain)):
        piece = int(piece_of[index])
        alone = gain[index] >= least
        together = best[piece] == index and total[piece] >= least
        if places[index, 0] >= 0 and (alone or together):
            x, y = window.spec.centre_of(int(places[index, 0]), int(places[index, 1]))
            found.append(Found(x, y, float(gain[index] if alone else total[piece]), bool(opening[index])))
    return found


@njit
def mark_borders(
    uncovered: NDArray[np.bool_],
    covered: NDArray[np.bool_],
    labels: NDArray[np.int32],
    ix0: int,
    iy0: int,
    cells: int,
    pieces: int,
    robot: tuple[int, int],
    block: NDArray[np.int32],
) -> int:
    """Number the border cells by (piece, snapped block); a piece without a border gets its cell nearest the robot.

    labels: (h, w), 0 outside, 1..pieces. block: out, -1 elsewhere. Returns how many blocks there are.
    """
    height, width = uncovered.shape
    bx0, by0 = ix0 // cells, iy0 // cells
    across = (ix0 + width) // cells - bx0 + 1
    down = (iy0 + height) // cells - by0 + 1
    number = np.full((pieces + 1) * across * down, -1, np.int32)
    has_border = np.zeros(pieces + 1, np.bool_)
    nearest = np.full(pieces + 1, -1, np.int64)
    nearest_distance = np.full(pieces + 1, np.inf)
    blocks = 0
    for row in range(height):
        for column in range(width):
            if not uncovered[row, column]:
                continue
            piece = labels[row, column]
            distance = float((row - robot[0]) ** 2 + (column - robot[1]) ** 2)
            if distance < nearest_distance[piece]:
                nearest_distance[piece], nearest[piece] = distance, row * width + column
            border = False
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    border = border or covered[r, c]
            if not border:
                continue
            has_border[piece] = True
            key = (piece * down + (iy0 + row) // cells - by0) * across + (ix0 + column) // cells - bx0
            if number[key] < 0:
                number[key] = blocks
                blocks += 1
            block[row, column] = number[key]
    for piece in range(1, pieces + 1):
        if not has_border[piece] and nearest[piece] >= 0:
            block[nearest[piece] // width, nearest[piece] % width] = blocks
            blocks += 1
    return blocks


@njit
def spread_blocks(uncovered: NDArray[np.bool_], block: NDArray[np.int32], reach: int, blocks: int) -> None:
    """Breadth-first: each uncovered cell takes the number of the block that gets to it first, within `reach` steps.

    block: (h, w), changed in place; cells that the border gave keep their number.
    """
    height, width = uncovered.shape
    queue = np.empty(height * width, np.int64)
    depth = np.zeros((height, width), np.int32)
    head, tail = 0, 0
    for row in range(height):
        for column in range(width):
            if block[row, column] >= 0:
                queue[tail] = row * width + column
                tail += 1
    while head < tail:
        row, column = queue[head] // width, queue[head] % width
        head += 1
        if depth[row, column] >= reach:
            continue
        for r in range(max(0, row - 1), min(height, row + 2)):
            for c in range(max(0, column - 1), min(width, column + 2)):
                if uncovered[r, c] and block[r, c] < 0:
                    block[r, c] = block[row, column]
                    depth[r, c] = depth[row, column] + 1
                    queue[tail] = r * width + c
                    tail += 1


@njit
def block_gains(
    entropy: NDArray[np.float32],
    behind: NDArray[np.int32],
    sizes: NDArray[np.int64],
    block: NDArray[np.int32],
    gain: NDArray[np.float64],
    sums: NDArray[np.float64],
    hidden: NDArray[np.float64],
) -> None:
    """Entropy of each block's cells, and the size of the largest piece of hopeful ground that they border on (hidden).

    behind: (h, w) labels of the pieces of hopeful ground, 0 elsewhere. sizes: cells of piece k + 1. sums: (blocks, 3):
    number of cells, sum of rows, sum of columns.
    """
    height, width = block.shape
    for row in range(height):
        for column in range(width):
            b = block[row, column]
            if b < 0:
                continue
            gain[b] += entropy[row, column]
            sums[b, 0] += 1.0
            sums[b, 1] += row
            sums[b, 2] += column
            for d_row, d_column in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                r, c = row + d_row, column + d_column
                if r >= 0 and c >= 0 and r < height and c < width and behind[r, c] > 0:
                    hidden[b] = max(hidden[b], float(sizes[behind[r, c] - 1]))


@njit
def block_places(
    free_space: NDArray[np.bool_], block: NDArray[np.int32], sums: NDArray[np.float64], reach: int
) -> NDArray[np.int64]:
    """For each block the free-space cell that is nearest to its middle and near to one of its cells; -1 if none.

    reach: a free-space cell within so many cells (Chebyshev) of a cell of the block counts.
    """
    height, width = block.shape
    places = np.full((sums.shape[0], 2), -1, np.int64)
    best = np.full(sums.shape[0], np.inf)
    for row in range(height):
        for column in range(width):
            b = block[row, column]
            if b < 0:
                continue
            mid_row, mid_column = sums[b, 1] / sums[b, 0], sums[b, 2] / sums[b, 0]
            near = 0 if free_space[row, column] else reach
            for r in range(max(0, row - near), min(height, row + near + 1)):
                for c in range(max(0, column - near), min(width, column + near + 1)):
                    if not free_space[r, c]:
                        continue
                    off = (r - row) ** 2 + (c - column) ** 2
                    score = (r - mid_row) ** 2 + (c - mid_column) ** 2 + 4.0 * off
                    if score < best[b]:
                        best[b] = score
                        places[b, 0], places[b, 1] = r, c
    return places

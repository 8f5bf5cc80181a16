"""The border of covered and uncovered traversable ground in one window: places and gains (Keidar and Kaminka 2012)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.clusters import component_centroids, label_components
from planning.coverage import LOG_2
from planning.grid import FREE
from planning.kernels import njit
from services.irm.config import Config
from services.irm.window import Window

_JOINED_M = 0.4
"""Less than what lies between the two sides of a wall, where the robot's centre fits: nothing is joined through one."""


class Found(NamedTuple):
    """A frontier as it is found in a window, its place in `map`.

    opening: mostly for what may lie behind the edge of the unseen.
    """

    x_m: float
    y_m: float
    gain: float
    opening: bool


def least_gain(config: Config, ground_m2: float) -> float:
    """The gain from which a border is a frontier: a share of the ground known, within the two bounds, nats."""
    share = config.frontier_min_share * ground_m2 / config.spacing_m**2 * LOG_2
    return max(config.frontier_min_gain, min(share, config.frontier_enough_gain))


def find_frontiers(window: Window, config: Config, least: float | None = None) -> list[Found]:
    """The frontiers of a window with at least this gain, in a fixed order.

    The uncovered ground is split into connected pieces; the border of a piece with covered ground is cut into blocks
    snapped to the plane; each cell of the piece counts for the nearest block, up to the frontier's reach. Where the
    robot's centre can get to the border of ground never seen that it may well enter (the way around a corner; not a
    gap in a ragged wall that its body does not fit), that is open too, and counts what ground may lie behind.
    Ground that the risk map has forgotten had its frontiers when it was seen; what opens there since is due to how a
    closure moved its patches.
    """
    s = window.spec
    least = config.frontier_min_gain if least is None else least
    if config.coverage == "known":
        return _find_behind(window, config, least)
    openings = joined_openings(window, config.opening_range_m)
    open_ground = (window.uncovered & (window.state == FREE)) | openings
    behind = np.zeros(s.shape, np.int32)
    sizes = component_centroids(behind, label_components(window.hopeful, behind))[0]
    blocks = _blocks_of(window, config, open_ground, window.ground & ~open_ground, behind, sizes)
    if blocks is None:
        return []
    gain, hidden = blocks.gain, blocks.hidden * s.resolution_m**2
    likely = np.minimum(hidden, blocks.mouth * s.resolution_m * config.opening_depth_m)
    gain += np.minimum(likely * LOG_2 / config.spacing_m**2, config.unknown_max_gain)
    opening = hidden >= config.opening_min_m2 - 1e-9
    # The most that the least gain can become: an opening left behind is not dropped when the known ground grows.
    gain[opening] = np.maximum(gain[opening], max(least, config.frontier_enough_gain))
    return _select(gain, opening, blocks.places, blocks.piece_of, window, least)


def _find_behind(window: Window, config: Config, least: float) -> list[Found]:
    """The frontiers of `coverage: known`: blocks of the unknown behind the border, each with its expected gain."""
    nothing = np.zeros(window.spec.shape, np.int32)
    blocks = _blocks_of(window, config, window.uncovered, window.reachable, nothing, np.zeros(0, np.int64))
    if blocks is None:
        return []
    openings = np.zeros(len(blocks.gain), np.bool_)
    return _select(blocks.gain, openings, blocks.places, blocks.piece_of, window, least)


class _Blocks(NamedTuple):
    """Blocks of a border: gain of the ground that counts for each, nats, hidden: the cells that may lie behind it,
    mouth: the width of the border with them, cells, (b,) each; places: (b, 2) cells; piece_of: (b,), the connected
    piece it belongs to."""

    gain: NDArray[np.float64]
    hidden: NDArray[np.float64]
    mouth: NDArray[np.float64]
    places: NDArray[np.int64]
    piece_of: NDArray[np.int64]


def _blocks_of(
    window: Window,
    config: Config,
    open_ground: NDArray[np.bool_],
    beside_it: NDArray[np.bool_],
    behind: NDArray[np.int32],
    sizes: NDArray[np.int64],
) -> _Blocks | None:
    """The border of the pieces of open ground with what lies beside it, in blocks; None when there is none.

    behind, sizes: labels of the pieces of unseen ground, and their cells.
    """
    s = window.spec
    labels, block = np.zeros(s.shape, np.int32), np.full(s.shape, -1, np.int32)
    pieces = label_components(open_ground, labels)
    cells = max(1, round(config.frontier_block_m / s.resolution_m))
    blocks = mark_borders(
        open_ground, beside_it, labels, s.ix0, s.iy0, cells, pieces, window.robot_cell, block
    )
    if blocks == 0:
        return None
    spread_blocks(open_ground, block, round(config.frontier_reach_m / s.resolution_m), blocks)
    gain, sums = np.zeros(blocks), np.zeros((blocks, 3))
    hidden, mouth = np.zeros(blocks), np.zeros(blocks)
    block_gains(window.entropy, behind, sizes, block, gain, sums, hidden, mouth)
    places = block_places(window.reachable, block, sums, max(1, round(1.0 / s.resolution_m)))
    piece_of, inside = np.zeros(blocks, np.int64), block >= 0
    piece_of[block[inside]] = labels[inside]
    return _Blocks(gain, hidden, mouth, places, piece_of)


def joined_openings(window: Window, range_m: float) -> NDArray[np.bool_]:
    """Reachable cells at the border of ground never seen that the robot may enter, within a distance of the robot.

    With what lies within `_JOINED_M` of them: the edge of what is seen is ragged, and the mouth of a passage, in ten
    pieces, would be ten openings as wide as a cell.
    """
    here = window.reachable & (window.state == FREE)
    rim = here & beside(window.hopeful) & near_robot(window, range_m)
    steps = round(_JOINED_M / window.spec.resolution_m)
    if steps < 1 or not rim.any():
        return rim
    joined: NDArray[np.bool_] = here & ndimage.binary_dilation(rim, np.ones((3, 3), np.bool_), steps)
    return joined


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
            x, y = window.to_map(*window.spec.centre_of(int(places[index, 0]), int(places[index, 1])))
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
    mouth: NDArray[np.float64],
) -> None:
    """Entropy of each block's cells, the size of the largest piece of hopeful ground that they border on (hidden), and
    how far from one another those are that do (mouth, cells: the border is ragged, so that their number says less).

    behind: (h, w) labels of the pieces of hopeful ground, 0 elsewhere. sizes: cells of piece k + 1. sums: (blocks, 3):
    number of cells, sum of rows, sum of columns.
    """
    height, width = block.shape
    low_row, high_row = np.full(mouth.shape[0], height), np.full(mouth.shape[0], -1)
    low_column, high_column = np.full(mouth.shape[0], width), np.full(mouth.shape[0], -1)
    for row in range(height):
        for column in range(width):
            b = block[row, column]
            if b < 0:
                continue
            gain[b] += entropy[row, column]
            sums[b, 0] += 1.0
            sums[b, 1] += row
            sums[b, 2] += column
            opens = 0
            for d_row, d_column in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                r, c = row + d_row, column + d_column
                if r >= 0 and c >= 0 and r < height and c < width and behind[r, c] > 0:
                    hidden[b] = max(hidden[b], float(sizes[behind[r, c] - 1]))
                    opens = 1
            if opens:
                low_row[b], high_row[b] = min(low_row[b], row), max(high_row[b], row)
                low_column[b], high_column[b] = min(low_column[b], column), max(high_column[b], column)
    for b in range(mouth.shape[0]):
        if high_row[b] >= 0:
            mouth[b] = 1.0 + math.hypot(high_row[b] - low_row[b], high_column[b] - low_column[b])


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

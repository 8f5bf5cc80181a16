"""Kernels of the grid protocols: sensor, lines, frontier cells, utilities. Cells are (row, column), points (x, y)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

UNSEEN, SOLID, OPEN = np.uint8(127), np.uint8(1), np.uint8(255)
"""What is known of a cell, with the values that the peers use; their order matters where blocks take the minimum."""


@njit
def scan(
    truth: NDArray[np.uint8],
    belief: NDArray[np.uint8],
    x0: int,
    y0: int,
    ray_end: NDArray[np.int64],
    depth: int,
) -> None:
    """One scan: each ray marks free cells, and up to `depth` wall cells where it meets a wall.

    truth: (h, w) SOLID or OPEN. belief: (h, w), changed in place. x0, y0: the sensor's cell. ray_end: (n, 2) x, y of
    the rays' rounded ends, which are not marked themselves. A ray that leaves a wall it has entered ends there.
    """
    height, width = truth.shape
    for i in range(ray_end.shape[0]):
        x1, y1 = ray_end[i, 0], ray_end[i, 1]
        dx, dy = abs(x1 - x0), abs(y1 - y0)
        step_x, step_y = (1 if x1 > x0 else -1), (1 if y1 > y0 else -1)
        error = dx - dy
        dx *= 2
        dy *= 2
        x, y, walls = x0, y0, 0
        while 0 <= x < width and 0 <= y < height:
            if truth[y, x] == SOLID:
                walls += 1
                if walls > depth:
                    break
            elif walls > 0:
                break
            if x == x1 and y == y1:
                break
            belief[y, x] = truth[y, x]
            if error > 0:
                x += step_x
                error -= dy
            else:
                y += step_y
                error += dx


@njit
def is_open_line(belief: NDArray[np.uint8], x0: int, y0: int, x1: int, y1: int) -> bool:
    """Whether all cells from (x0, y0) to before (x1, y1) are known to be free, by the same line as the sensor's."""
    height, width = belief.shape
    dx, dy = abs(x1 - x0), abs(y1 - y0)
    step_x, step_y = (1 if x1 > x0 else -1), (1 if y1 > y0 else -1)
    error = dx - dy
    dx *= 2
    dy *= 2
    x, y = x0, y0
    while 0 <= x < width and 0 <= y < height:
        if x == x1 and y == y1:
            return True
        if belief[y, x] != OPEN:
            return False
        if error > 0:
            x += step_x
            error -= dy
        else:
            y += step_y
            error += dx
    return True


@njit
def block_minimum(belief: NDArray[np.uint8], block: int) -> NDArray[np.uint8]:
    """The least value of each block x block cells; what a block lacks beyond the border counts 0."""
    height, width = belief.shape
    rows, columns = (height + block - 1) // block, (width + block - 1) // block
    found = np.zeros((rows, columns), np.uint8)
    for row in range(height // block):
        for column in range(width // block):
            least = np.uint8(255)
            for r in range(row * block, row * block + block):
                for c in range(column * block, column * block + block):
                    least = min(least, belief[r, c])
            found[row, column] = least
    return found


@njit
def frontier_cells(belief: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(n, 2) x, y of the known free cells with 2 to 7 of their 8 neighbours unseen, column by column."""
    height, width = belief.shape
    found = np.empty((height * width, 2), np.int64)
    count = 0
    for column in range(width):
        for row in range(height):
            if belief[row, column] != OPEN:
                continue
            unseen = 0
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    unseen += 1 if belief[r, c] == UNSEEN else 0
            if 2 <= unseen <= 7:
                found[count, 0], found[count, 1] = column, row
                count += 1
    return found[:count].copy()


@njit
def in_sight(
    belief: NDArray[np.uint8],
    node: NDArray[np.int64],
    frontier: NDArray[np.int64],
    node_place: NDArray[np.float64],
    frontier_place: NDArray[np.float64],
    range_units: float,
    seen: NDArray[np.bool_],
) -> None:
    """Which frontier points each node has within a range and in free line of sight.

    node, frontier: (n, 2), (m, 2) cells x, y. *_place: the same in the protocol's units, for distances. seen: (n, m)
    out.
    """
    for i in range(node.shape[0]):
        for j in range(frontier.shape[0]):
            away = math.hypot(
                frontier_place[j, 0] - node_place[i, 0], frontier_place[j, 1] - node_place[i, 1]
            )
            seen[i, j] = away < range_units and is_open_line(
                belief, node[i, 0], node[i, 1], frontier[j, 0], frontier[j, 1]
            )


@njit
def open_lines(
    belief: NDArray[np.uint8], node: NDArray[np.int64], pairs: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(k,) whether the straight line of each pair (k, 2) of nodes (n, 2 cells x, y) crosses known free cells only."""
    free = np.zeros(pairs.shape[0], np.bool_)
    for i in range(pairs.shape[0]):
        a, b = pairs[i, 0], pairs[i, 1]
        free[i] = is_open_line(belief, node[a, 0], node[a, 1], node[b, 0], node[b, 1])
    return free


@njit
def connected_open(belief: NDArray[np.uint8], x0: int, y0: int) -> NDArray[np.bool_]:
    """(h, w) known free cells that are connected (by 8 neighbours) with a cell."""
    height, width = belief.shape
    found = np.zeros((height, width), np.bool_)
    stack = np.empty(height * width, np.int64)
    stack[0], top = y0 * width + x0, 1
    found[y0, x0] = True
    while top > 0:
        top -= 1
        row, column = stack[top] // width, stack[top] % width
        for r in range(max(0, row - 1), min(height, row + 2)):
            for c in range(max(0, column - 1), min(width, column + 2)):
                if belief[r, c] == OPEN and not found[r, c]:
                    found[r, c] = True
                    stack[top] = r * width + c
                    top += 1
    return found


@njit
def without_settled(belief: NDArray[np.uint8], open_border: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The belief with those unseen cells SOLID that touch (8) known free cells, none of them of the open border."""
    height, width = belief.shape
    out = belief.copy()
    for row in range(height):
        for column in range(width):
            if belief[row, column] != UNSEEN:
                continue
            beside, is_open = False, False
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    beside = beside or belief[r, c] == OPEN
                    is_open = is_open or open_border[r, c]
            if beside and not is_open:
                out[row, column] = SOLID
    return out

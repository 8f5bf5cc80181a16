"""Connected components of a grid and reachable sets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit


@njit
def label_components(mask: NDArray[np.bool_], labels: NDArray[np.int32]) -> int:
    """Label the 8-connected components of a mask.

    Args:
        mask: (H, W).
        labels: out, (H, W); 0 where the mask is False, else 1 to n in the order of each component's first cell
            (row by row).

    Returns:
        The number n of components.
    """
    height, width = mask.shape
    stack = np.empty(max(mask.size, 1), np.int32)
    labels[:, :] = 0
    count = 0
    for first in range(mask.size):
        if not mask[first // width, first % width] or labels[first // width, first % width] != 0:
            continue
        count += 1
        labels[first // width, first % width] = count
        stack[0] = first
        top = 1
        while top > 0:
            top -= 1
            row, column = stack[top] // width, stack[top] % width
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    if mask[r, c] and labels[r, c] == 0:
                        labels[r, c] = count
                        stack[top] = r * width + c
                        top += 1
    return count


@njit
def component_centroids(
    labels: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Size and centroid of each component.

    Args:
        labels: (H, W) as made by `label_components`.
        count: number of components n.

    Returns:
        sizes: (n,) cells of component k + 1.
        centroids: (n, 2) mean (row, column) of its cells; cell centres have integer coordinates.
    """
    height, width = labels.shape
    sizes = np.zeros(count, np.int64)
    centroids = np.zeros((count, 2), np.float64)
    for row in range(height):
        for column in range(width):
            k = labels[row, column] - 1
            if k >= 0:
                sizes[k] += 1
                centroids[k, 0] += row
                centroids[k, 1] += column
    for k in range(count):
        centroids[k] /= max(sizes[k], 1)
    return sizes, centroids


@njit
def component_medoids(labels: NDArray[np.int32], centroids: NDArray[np.float64]) -> NDArray[np.int32]:
    """The cell of each component that is nearest to its centroid: unlike the centroid it always lies inside.

    Args:
        labels: (H, W) as made by `label_components`.
        centroids: (n, 2) (row, column), as made by `component_centroids`.

    Returns:
        (n, 2) (row, column); the first in row order among equals, (-1, -1) for a component without cells.
    """
    height, width = labels.shape
    count = centroids.shape[0]
    medoids = np.full((count, 2), -1, np.int32)
    best = np.full(count, np.inf)
    for row in range(height):
        for column in range(width):
            k = labels[row, column] - 1
            if k < 0:
                continue
            distance = (row - centroids[k, 0]) ** 2 + (column - centroids[k, 1]) ** 2
            if distance < best[k] - 1e-12:
                best[k] = distance
                medoids[k, 0] = row
                medoids[k, 1] = column
    return medoids


@njit
def flood_fill(passable: NDArray[np.bool_], seeds: NDArray[np.int32], reached: NDArray[np.bool_]) -> int:
    """Cells reachable from the seeds by the moves of the grid search: 8-connected without cutting corners.

    A diagonal move needs both cells beside it, so this is the 4-connected reachable set.

    Args:
        passable: (H, W).
        seeds: (k, 2) (row, column); seeds outside the grid or not passable are skipped.
        reached: out, (H, W).

    Returns:
        The number of reached cells.
    """
    height, width = passable.shape
    stack = np.empty(max(passable.size, 1), np.int32)
    reached[:, :] = False
    top = 0
    total = 0
    for k in range(seeds.shape[0]):
        row, column = seeds[k, 0], seeds[k, 1]
        inside = row >= 0 and column >= 0 and row < height and column < width
        if inside and passable[row, column] and not reached[row, column]:
            reached[row, column] = True
            stack[top] = row * width + column
            top += 1
    while top > 0:
        top -= 1
        total += 1
        row, column = stack[top] // width, stack[top] % width
        for d_row, d_column in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            r, c = row + d_row, column + d_column
            if r >= 0 and c >= 0 and r < height and c < width and passable[r, c] and not reached[r, c]:
                reached[r, c] = True
                stack[top] = r * width + c
                top += 1
    return total

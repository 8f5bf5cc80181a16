"""The peers' simple rules on their own environment, to prove it and to compare with."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.grid_rules import GridWorld, first_move

Score = Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]]
_MOST_MOVES = 5000


def nearest(travel: NDArray[np.float64], utility: NDArray[np.int64]) -> NDArray[np.float64]:
    """The nearest useful node is the best."""
    return -travel


def discounted_utility(travel: NDArray[np.float64], utility: NDArray[np.int64]) -> NDArray[np.float64]:
    """Utility times exp(-travel / 160)."""
    return utility.astype(np.float64) * np.exp(-travel / 160.0)


def explore(world: GridWorld, score: Score, most_moves: int = _MOST_MOVES) -> bool:
    """Move to the best useful node by the rule, one edge at a time and chosen anew after each. Returns whether done."""
    while not world.done and world.moves < most_moves:
        goal, before = best_node(world, score)
        if goal < 0:
            return False
        world.move(first_move(before, world.at, goal))
    return world.done


def best_node(world: GridWorld, score: Score) -> tuple[int, NDArray[np.int64]]:
    """The best of the useful nodes that can be reached (-1: none), and the previous nodes of the ways there."""
    travel, before = world.ways()
    useful = (world.utility > 0) & np.isfinite(travel)
    useful[world.at] = False
    if not useful.any():
        return -1, before
    rated = np.where(useful, score(np.where(useful, travel, 0.0), world.utility), -math.inf)
    return int(np.argmax(rated)), before

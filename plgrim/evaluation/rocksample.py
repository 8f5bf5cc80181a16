"""Plays RockSample with the solver of the local planner and holds the returns against those of other solvers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.pomcp import Pomcp
from planning.randomness import stream
from plgrim.evaluation.rocksample_model import (
    BAD,
    CHECK,
    DISCOUNT,
    EAST,
    EXIT_REWARD,
    GOOD,
    INFORMED,
    NOTHING,
    ROCK_REWARD,
    SAMPLE,
    RockSample,
    after,
    rock_sample,
    search_rocks,
    state_size,
)

MAX_DEPTH = 90
"""Horizon of a search, as in the published experiments."""
MAX_MOVES = 200
"""An episode ends here at the latest: what follows would be discounted by 0.95^200, less than 4e-5."""
EXPLORATION = 0.1
"""UCB constant in units of the range of returns; 0.05 and 0.1 were equal on seed 1, 0.25 and 0.5 a little worse."""


@dataclass(frozen=True)
class Layout:
    """Where the rocks lie and the robot starts; (x, y), x to the east, y to the north, from 0."""

    size: int
    start: tuple[int, int]
    rocks: tuple[tuple[int, int], ...]


LAYOUTS = {
    (7, 8): Layout(7, (0, 3), ((2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6))),
    (11, 11): Layout(
        11,
        (0, 5),
        ((0, 3), (0, 7), (1, 8), (2, 4), (3, 3), (3, 8), (4, 3), (5, 8), (6, 1), (9, 3), (9, 9)),
    ),
    (15, 15): Layout(
        15,
        (0, 7),
        ((1, 13), (10, 12), (10, 8), (12, 1), (1, 9), (7, 2), (4, 5), (1, 8), (6, 0), (1, 7), (8, 11), (9, 12),
         (5, 2), (13, 2), (10, 7)),
    ),
}  # fmt: skip
"""The two that Smith and Simmons published, and what the published POMCP program draws for (15, 15): cells from glibc's
`rand` seeded with 0, y drawn before x (the order in which gcc evaluates arguments; C++ leaves it open)."""


class Peer(NamedTuple):
    """A mean discounted return of another solver, and its standard error where it is known."""

    source: str
    mean: float
    error: float | None


_PAPER = "POMCP, Silver and Veness 2010 (published)"
_DESPOT = "DESPOT, its own program at 0.1 s a move (seen)"
PEERS = {
    (7, 8): (Peer(_PAPER, 20.71, None), Peer(_DESPOT, 19.9, 0.9)),
    (11, 11): (Peer(_PAPER, 20.01, None), Peer(_DESPOT, 20.8, 0.9)),
    (15, 15): (Peer(_PAPER, 15.32, None),),
}


class Returns(NamedTuple):
    """discounted: (episodes,) returns. moves: actions taken in all. cpu_s: processor time of the searches."""

    discounted: NDArray[np.float64]
    moves: int
    cpu_s: float

    def mean(self) -> float:
        """Mean return."""
        return float(self.discounted.mean())

    def standard_error(self) -> float:
        """Of the mean; NaN for one episode."""
        count = len(self.discounted)
        return float(self.discounted.std(ddof=1) / np.sqrt(count)) if count > 1 else float("nan")


def layout_of(size: int, rocks: int, seed: int | None = None) -> Layout:
    """The published layout, or (with a seed) a random one. `ValueError` where none is published."""
    if seed is None:
        if (size, rocks) not in LAYOUTS:
            raise ValueError(f"no layout of RockSample({size}, {rocks}) is published: give a seed for one")
        return LAYOUTS[size, rocks]
    rng = stream(seed, "rocksample-layout", size, rocks)
    cells = rng.choice(size * size, rocks, replace=False)
    return Layout(size, (0, size // 2), tuple((int(c) % size, int(c) // size) for c in cells))


def solver_for(rocks: int, simulations: int, exploration: float = EXPLORATION) -> Pomcp:
    """A solver with room for so many simulations of a problem with so many rocks."""
    return Pomcp(
        state_size=state_size(rocks),
        max_actions=CHECK + rocks,
        max_nodes=simulations + 1,
        max_branches=(CHECK + rocks) * simulations,
        max_depth=MAX_DEPTH,
        exploration=exploration,
    )


def world_step(
    model: RockSample, good: NDArray[np.bool_], action: int, rng: np.random.Generator
) -> tuple[int, float, bool]:
    """What the real world answers: (observation, reward, end). good: (k,) the truth about the rocks."""
    if action >= CHECK:
        right = rng.random() < model.right[model.at, action - CHECK]
        return (GOOD if bool(good[action - CHECK]) == right else BAD), 0.0, False
    if action == SAMPLE:
        return NOTHING, ROCK_REWARD if good[model.rock_at[model.at]] else -ROCK_REWARD, False
    if action == EAST and model.at % model.size == model.size - 1:
        return NOTHING, EXIT_REWARD, True
    return NOTHING, 0.0, False


def play(
    layout: Layout, solver: Pomcp, simulations: int, rng: np.random.Generator, knowledge: int = INFORMED
) -> tuple[float, int]:
    """One episode from fresh rocks: (discounted return, actions taken). The belief is updated exactly."""
    model = rock_sample(layout.size, layout.rocks, layout.start, knowledge)
    good = rng.random(len(layout.rocks)) < 0.5
    total, weight = 0.0, 1.0
    for moves in range(1, MAX_MOVES + 1):
        solver.search(search_rocks, model, seed=int(rng.integers(2**63)), simulations=simulations)
        action = solver.best_action()
        observation, reward, terminal = world_step(model, good, action, rng)
        total += weight * reward
        weight *= DISCOUNT
        if terminal:
            return total, moves
        model = after(model, action, observation)
    return total, MAX_MOVES


def evaluate(
    layout: Layout,
    *,
    simulations: int,
    episodes: int,
    seed: int,
    knowledge: int = INFORMED,
    progress: Callable[[int, float], None] | None = None,
) -> Returns:
    """Play episodes, each of its own random stream. progress: told the episodes done and the mean so far."""
    solver = solver_for(len(layout.rocks), simulations)
    found, moves, began = np.zeros(episodes), 0, time.process_time()
    for episode in range(episodes):
        rng = stream(seed, "rocksample", layout.size, len(layout.rocks), episode)
        found[episode], taken = play(layout, solver, simulations, rng, knowledge)
        moves += taken
        if progress is not None:
            progress(episode + 1, float(found[: episode + 1].mean()))
    return Returns(found, moves, time.process_time() - began)

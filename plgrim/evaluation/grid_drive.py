"""PLGRIM under the grid protocols: the five stages plan, their motion is projected onto its lattice."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.grid_kernels import OPEN, SOLID
from plgrim.evaluation.grid_peers import best_node, nearest
from plgrim.evaluation.grid_rules import GridWorld, Rules, first_move
from plgrim.explorer import Explorer, ExplorerConfig, Grid, Plan

CELL_M = {"ariadne": 0.15, "dare": 0.24}
"""Planner's metres a cell: the sensor of both looks 12 m, a step of either lattice is about one of the Local IRM."""
_BLOCK = {"ariadne": 2, "dare": 1}
"""Cells a side of what the planner gets as one cell (ARiADNE's own frontiers lie on blocks of 4)."""
_REACH = 1.8
"""So many (shortest) steps of the lattice of the path count for an edge."""
_OFF_PATH = 2.0
"""Metres of progress that one metre beside the path costs."""
_MOST_MOVES = 1500
_NOTHING_NEW_CELLS = 20
_AGAIN = 3


@dataclass
class Drive:
    """What one map gave. how: moves by what chose them; track: (n, 2) cells x, y; plan_s: wall time of each step."""

    finished: bool
    travelled: float
    moves: int
    unseen_cells: int
    how: dict[str, int]
    plan_s: list[float]
    track: NDArray[np.int64]
    belief: NDArray[np.uint8]
    notes: list[str] = field(default_factory=list)


def occupancy(belief: NDArray[np.uint8], block: int = 1) -> NDArray[np.int8]:
    """The protocol's belief as an occupancy grid, in blocks: occupied if any cell is, free if all are."""
    if block > 1:
        rows, columns = belief.shape[0] // block, belief.shape[1] // block
        pieces = belief[: rows * block, : columns * block].reshape(rows, block, columns, block)
        belief = pieces.min(axis=(1, 3))
    cells = np.full(belief.shape, -1, np.int8)
    cells[belief == OPEN], cells[belief == SOLID] = 0, 100
    return cells


class Projection:
    """From a planned path to the next node of the protocol's lattice.

    The edge from the robot's node that follows the path best and farthest is taken: progress along the path, less what
    its end lies off the path and what it is longer than the path. Where no edge does, the goal is the node nearest to
    the path some way ahead, else to the global target, by the lattice's shortest way. When a move leads straight back
    and the last one has shown nothing new, the robot goes on to the goal
    before, so that two plans of equal worth do not send it to and fro.
    """

    def __init__(self, world: GridWorld, cell_m: float) -> None:
        self._world, self._cell_m = world, cell_m
        self._goal: tuple[int, ...] | None = None
        self._came_from: tuple[int, ...] | None = None
        self._unseen = world.unseen_cells()
        self._taken: Counter[tuple[int, ...]] = Counter()
        self.how: Counter[str] = Counter()

    def choose(self, plan: Plan) -> int:
        """The node to move to next; -1 when no node that is useful to the protocol can be reached."""
        world = self._world
        travel, before = world.ways()
        unseen = world.unseen_cells()
        is_new = self._unseen - unseen >= _NOTHING_NEW_CELLS
        self._unseen = unseen
        if is_new:
            self._taken.clear()
        goal, how = self._goal_of(plan, travel)
        if goal >= 0 and not is_new and self._goal is not None:
            back = tuple(world.node[first_move(before, world.at, goal)].tolist()) == self._came_from
            held = self._index(self._goal)
            if back and held >= 0 and held != world.at and math.isfinite(travel[held]):
                goal, how = held, "goal kept"
        move = first_move(before, world.at, goal) if goal >= 0 else -1
        edge = (world.at, move)
        if move < 0 or self._taken[edge] >= _AGAIN:
            goal, before = best_node(world, nearest)
            move = first_move(before, world.at, goal) if goal >= 0 else -1
            how = "protocol's nearest"
        if move >= 0:
            self._taken[world.at, move] += 1
            self._goal = tuple(world.node[goal].tolist())
            self._came_from = tuple(world.node[world.at].tolist())
            self.how[how] += 1
        return move

    def _index(self, cell: tuple[int, ...]) -> int:
        found = np.flatnonzero(np.all(self._world.node == cell, axis=1))
        return int(found[0]) if len(found) else -1

    def _goal_of(self, plan: Plan, travel: NDArray[np.float64]) -> tuple[int, str]:
        world = self._world
        place_m = (world.node + 0.5) * self._cell_m
        others = np.isfinite(travel)
        others[world.at] = False
        if not others.any():
            return -1, ""
        if plan.moves:
            steps = np.hypot(*np.diff(plan.path[:, :2], axis=0).T)
            along = np.concatenate([np.zeros(1), steps.cumsum()])
            edge = self._best_edge(plan.path[:, :2], along, np.asarray(place_m, np.float64))
            if edge >= 0:
                return edge, "path"
            ahead_m = self._step_m()
            for at in range(int(np.searchsorted(along, min(ahead_m, along[-1]))), len(along)):
                away = np.hypot(*(place_m - plan.path[at, :2]).T)
                nearest_node = int(np.argmin(np.where(np.isfinite(travel), away, math.inf)))
                if nearest_node != world.at:
                    return nearest_node, "path"
        if plan.target_m is not None:
            away = np.hypot(*(place_m - np.array(plan.target_m)).T)
            nearest_node = int(np.argmin(np.where(np.isfinite(travel), away, math.inf)))
            if nearest_node != world.at:
                return nearest_node, "target"
        return -1, ""

    def _best_edge(
        self, path_m: NDArray[np.float64], along_m: NDArray[np.float64], place_m: NDArray[np.float64]
    ) -> int:
        """The neighbour that is best reached by the path's beginning; -1 when none is."""
        most = int(np.searchsorted(along_m, _REACH * self._step_m()))
        best, best_score = -1, 0.0
        for node, length in sorted(self._world.edges.get(self._world.at, {}).items()):
            off = np.hypot(*(path_m[:most] - place_m[node]).T)
            length_m = length / self._world.cell * self._cell_m
            score = float((along_m[:most] - _OFF_PATH * off).max(initial=-math.inf))
            score -= max(0.0, length_m - along_m[min(most, len(along_m) - 1)])
            if score > best_score:
                best, best_score = node, score
        return best

    def _step_m(self) -> float:
        """A usual step of the lattice from here, m."""
        edges = self._world.edges.get(self._world.at, {})
        return min(edges.values(), default=1.0) / self._world.cell * self._cell_m


def drive(world: GridWorld, rules: Rules, parameters: ExplorerConfig, most_moves: int = _MOST_MOVES) -> Drive:
    """Explore a map to the protocol's end (or until no useful node can be reached)."""
    cell_m, block = CELL_M[rules], _BLOCK[rules]
    explorer, projection = Explorer(parameters), Projection(world, cell_m)
    track, plan_s, notes = [world.node[world.at].tolist()], [], []
    yaw, seconds, over = 0.0, parameters.seconds_per_step, False
    while not world.done and world.moves < most_moves:
        x_m, y_m = ((world.node[world.at] + 0.5) * cell_m).tolist()
        began = time.perf_counter()
        plan = explorer.step(
            Grid(occupancy(world.belief_of_use(), block), cell_m * block), (x_m, y_m, yaw), seconds
        )
        plan_s.append(time.perf_counter() - began)
        if plan.finished and not over:
            over = True
            notes.append(f"the planner ended after {world.moves} moves: {plan.finish.value}")
        node = projection.choose(plan)
        if node < 0:
            notes.append("no useful node can be reached")
            break
        dx, dy = (world.node[node] - world.node[world.at]).tolist()
        yaw, seconds = math.atan2(dy, dx), max(0.2, math.hypot(dx, dy) * cell_m)
        world.move(node)
        track.append(world.node[world.at].tolist())
    return Drive(
        world.done, world.travelled, world.moves, world.unseen_cells(), dict(projection.how), plan_s,
        np.array(track), world.belief.copy(), notes,
    )  # fmt: skip


def milliseconds(plan_s: list[float]) -> dict[str, Any]:
    """Median and 99th percentile of the planner's steps, ms; the first step, which loads kernels, left out."""
    later = np.array(plan_s[1:] or [math.nan])
    return {
        "plan_ms_p50": round(1e3 * float(np.median(later)), 1),
        "plan_ms_p99": round(1e3 * float(np.quantile(later, 0.99)), 1),
    }

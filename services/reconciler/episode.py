"""Planning episodes: where the new policy begins, and what the request says."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.coverage_build import RootBelief, build_model, reachable_entropy
from planning.coverage_model import CoverageModel, evaluate_moves, look
from planning.coverage_tiles import rows_of_tiles, tiles_of_rows
from planning.randomness import stream
from planning.reward import leftover_entropy, parameters
from planning.search import dijkstra_box, trace_path
from schemas.sensing import Odometry
from schemas.snapshot import pack_message, unpack_message
from schemas.world import LocalIrm
from services.reconciler.config import Config
from services.reconciler.path import Ground, headings

_MOST_SPREAD = 0.05
"""Of a pose in `odom`, m and rad."""


@dataclass(frozen=True, slots=True)
class Committed:
    """The policy that is being driven: a line in odom, and the lattice nodes on it.

    points: (k, 2) m. lattice: (p, 2) global lattice indices of the nodes. node_point: (p,) index of each in the line.
    """

    points: NDArray[np.float64]
    lattice: NDArray[np.int64]
    node_point: NDArray[np.int64]
    target: int = -1


@dataclass(frozen=True, slots=True)
class Opened:
    """An episode that waits for its answer. prefix: the line from the robot to the junction, (k, 2) m.

    junction_point: index of the junction in the line that was driven when the episode opened.
    """

    number: int
    opened_ns: int
    irm: LocalIrm
    prefix: NDArray[np.float64]
    kept_lattice: NDArray[np.int64]
    kept_point: NDArray[np.int64]
    tau_s: float
    keeps_old: bool
    junction_point: int = 0


def pack_opened(opened: Opened) -> dict[str, Any]:
    """For a snapshot."""
    state: dict[str, Any] = {f.name: getattr(opened, f.name) for f in fields(opened)}
    return {**state, "irm": pack_message(opened.irm)}


def unpack_opened(state: dict[str, Any]) -> Opened:
    """From a snapshot."""
    return Opened(**{**state, "irm": unpack_message(state["irm"], LocalIrm)})


def heading_index(yaw_rad: float) -> int:
    """The nearest of the eight headings."""
    return round(yaw_rad / (math.pi / 4.0)) % 8


def node_index(irm: LocalIrm, ix: int, iy: int) -> int:
    """Index of a lattice node in this Local IRM, -1 outside."""
    column, row = ix - irm.ix0, iy - irm.iy0
    if not (0 <= row < irm.size and 0 <= column < irm.size):
        return -1
    return row * irm.size + column


def usable_nodes(committed: Committed, irm: LocalIrm, from_point: int) -> list[int]:
    """Positions in `committed.lattice` of the nodes ahead that this Local IRM has, up to the first gap."""
    found: list[int] = []
    for i in range(len(committed.lattice)):
        if committed.node_point[i] < from_point:
            continue
        node = node_index(irm, int(committed.lattice[i, 0]), int(committed.lattice[i, 1]))
        if node < 0 or irm.state[node] != 1:
            break
        found.append(i)
    return found


def moves_between(committed: Committed, first: int, last: int) -> NDArray[np.int64]:
    """Directions of the steps from node `first` to node `last` of the committed path."""
    steps = np.diff(committed.lattice[first : last + 1], axis=0)
    yaw = np.arctan2(steps[:, 1], steps[:, 0])
    return (np.round(yaw / (math.pi / 4.0)).astype(np.int64)) % 8


def model_here(
    irm: LocalIrm, node: int, heading: int, covered: NDArray[np.uint64], config: Config
) -> CoverageModel:
    """The shared coverage model on this Local IRM, starting at a node."""
    entropy = reachable_entropy(irm.entropy, irm.visible, irm.edge_distance_m, irm.size, irm.reach)
    root = RootBelief(np.array([node], np.int32), np.array([heading], np.uint8), np.ones(1), covered)
    return build_model(
        size=irm.size,
        reach=irm.reach,
        fov_rad=irm.sensor_fov_rad,
        edge_distance_m=irm.edge_distance_m,
        edge_risk=irm.edge_risk,
        entropy=leftover_entropy(entropy, irm.state == 1, irm.size, config.weights),
        visible=irm.visible,
        leaf_value=np.zeros(irm.size * irm.size),
        root=root,
        weights=parameters(config.weights),
        horizon=config.rollout_moves,
        rollout_random=0.0,
    )


def cover_along(
    model: CoverageModel, committed: Committed, irm: LocalIrm, nodes: list[int], covered: NDArray[np.uint64]
) -> None:
    """Mark in covered, (size,) rows, what the kept nodes of the path will have covered at the junction."""
    if not nodes:
        return
    moves = moves_between(committed, nodes[0], nodes[-1])
    first = node_index(irm, int(committed.lattice[nodes[0], 0]), int(committed.lattice[nodes[0], 1]))
    heading = _heading_at(committed, nodes[0])
    tiles = tiles_of_rows(covered, irm.size)
    look(model, first, heading, tiles)
    scratch = (np.zeros(len(moves)), np.zeros(len(moves)), np.zeros(len(moves)))
    evaluate_moves(model, first, heading, moves, tiles, *scratch)
    covered[:] = rows_of_tiles(tiles, irm.size)


def _heading_at(committed: Committed, position: int) -> int:
    point = int(committed.node_point[position])
    yaw = headings(committed.points)
    return heading_index(float(yaw[max(point - 1, 0)])) if len(yaw) else 0


def junction_particles(
    irm: LocalIrm, node: int, heading: int, odometry: Odometry, count: int, seed: int, episode: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.float64]]:
    """The junction belief: where the robot will be when the prefix ends, given its pose covariance.

    Returns (nodes, headings, weights), one entry a distinct state, the junction itself always among them.
    """
    rng = stream(seed, "reconciler", "junction", episode)
    # The junction lies in `odom`, where nothing drifts within a horizon; the covariance is that of the place in `map`.
    deviation = np.sqrt(np.maximum(np.diag(odometry.covariance), 0.0))
    spread = np.minimum(deviation, _MOST_SPREAD) + np.array([0.05, 0.05, 0.05])
    offset = rng.normal(size=(count, 3)) * spread
    x = irm.anchor_m[node, 0] + offset[:, 0]
    y = irm.anchor_m[node, 1] + offset[:, 1]
    tally: dict[tuple[int, int], int] = {(node, heading): 1}
    for i in range(count):
        place = node_index(irm, math.floor(x[i] / irm.spacing_m), math.floor(y[i] / irm.spacing_m))
        if place < 0 or irm.state[place] != 1 or not (irm.edge_distance_m[place] > 0.0).any():
            place = node
        k = heading_index(heading * math.pi / 4.0 + float(offset[i, 2]))
        tally[(place, k)] = tally.get((place, k), 0) + 1
    states = sorted(tally, key=lambda s: (-tally[s], s))
    weight = np.array([tally[s] for s in states], np.float64)
    return (
        np.array([s[0] for s in states], np.int32),
        np.array([s[1] for s in states], np.uint8),
        weight / weight.sum(),
    )


def line_to_lattice(
    irm: LocalIrm, ground: Ground, odometry: Odometry, needed_m: float, avoid: set[int]
) -> tuple[int, NDArray[np.float64]] | None:
    """The nearest connected node by travel over the risk map, and the line to its anchor; None when there is none."""
    s = ground.spec
    row, column = s.cell_of(odometry.pose.x_m, odometry.pose.y_m)
    if not s.contains(row, column):
        return None
    # A robot that stands in a tight place has to get out of it.
    for share in (1.0, 0.7, 0.4, 0.0):
        found = _nearest_node(irm, ground, odometry, share * needed_m, avoid, row, column)
        if found is not None:
            return found
    return None


def _nearest_node(
    irm: LocalIrm, ground: Ground, odometry: Odometry, needed_m: float, avoid: set[int], row: int, column: int
) -> tuple[int, NDArray[np.float64]] | None:
    """As `line_to_lattice`, over ground of this clearance."""
    s = ground.spec
    passable = (ground.state == 1) & (ground.clearance_m >= needed_m)
    cost = np.full(s.shape, np.inf)
    parent = np.full(s.shape, -1, np.int32)
    reach = math.ceil(3.0 * irm.spacing_m / s.resolution_m)
    box = (row - reach, row + reach + 1, column - reach, column + reach + 1)
    ones = np.ones(s.shape, np.float32)
    dijkstra_box(
        ones, passable, s.resolution_m, row, column, box, np.empty((0, 2), np.int32), 8.0, cost, parent
    )
    best: tuple[float, int, int, int] | None = None
    for node in range(irm.size * irm.size):
        if irm.state[node] != 1 or node in avoid or not (irm.edge_distance_m[node] > 0.0).any():
            continue
        r, c = s.cell_of(float(irm.anchor_m[node, 0]), float(irm.anchor_m[node, 1]))
        if not (max(box[0], 0) <= r < min(box[1], s.height) and max(box[2], 0) <= c < min(box[3], s.width)):
            continue
        if np.isfinite(cost[r, c]):
            yaw = math.atan2(
                irm.anchor_m[node, 1] - odometry.pose.y_m, irm.anchor_m[node, 0] - odometry.pose.x_m
            )
            turn = abs(math.remainder(yaw - odometry.pose.yaw_rad, 2.0 * math.pi)) / math.pi
            score = float(cost[r, c]) + (0.6 * turn if cost[r, c] > 0.2 else 0.0)
            if best is None or score < best[0]:
                best = (score, node, r, c)
    if best is None:
        return None
    cells = trace_path(parent, best[2], best[3])
    inner = [(s.centre_of(int(a), int(b))) for a, b in cells[1:-1]]
    end = (float(irm.anchor_m[best[1], 0]), float(irm.anchor_m[best[1], 1]))
    start = (odometry.pose.x_m, odometry.pose.y_m)
    return best[1], np.array([start, *inner, end])

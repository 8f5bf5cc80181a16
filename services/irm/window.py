"""The fine layers around the robot that both roadmaps are built from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.clusters import flood_fill
from planning.coverage import entropy, probability
from planning.fences import Shut
from planning.footprint import footprint_hazard
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from planning.kernels import njit
from schemas.world import RiskMap
from services.irm.config import Config
from services.irm.keyframes import IDENTITY
from services.irm.resample import bounds, resample
from services.irm.tiles import TileLayer
from services.irm.unknown import KNOWN_PROBABILITY, expected_gain

KNOWN, GROUND = 2, 1
"""Of the ground layer: seen but out of the robot's reach or an obstacle; ground that it can touch. 0: never seen."""


class Relief(NamedTuple):
    """Heights of the ground and of what a sensor has to look over, (h, w) each, m in `odom`."""

    ground_m: NDArray[np.float32]
    top_m: NDArray[np.float32]


@dataclass(slots=True)
class Window:
    """What is known around the robot, all (h, w) over `spec` in `odom`, in which nothing jumps.

    frame: pose of `odom` in `map`, frame_z_m: its height; roadmaps are in `map`, hence `cell` and `to_map`.
    hopeful: never seen (not only forgotten by the risk map), but the robot's centre may fit there and get there, as
    far as obstacles are known. free_space: its centre fits, and gets there over known ground; reachable: or over
    forgotten ground. ground: what its body can touch from there. uncovered: ground below the covered
    probability, slivers of one cell left out; with `coverage: known` the hopeful ground behind the border of the known
    (see `unknown`). entropy: of uncovered cells, nats of whole patches (0 elsewhere).
    top_m: what the coverage sensor has to look over; None: whatever is not free blocks the sight.
    shut: cells where the operator's fences let no robot be; clearance_m is that to obstacles and to these.
    open_clearance_m: that to obstacles alone. weight: so many times a cell counts; None: once each.
    hazard: CVaR of the hazard rate, its mean under the body, 1/m. step_cost: cost per metre of the grid search.
    """

    spec: GridSpec
    state: NDArray[np.uint8]
    hopeful: NDArray[np.bool_]
    clearance_m: NDArray[np.float32]
    hazard: NDArray[np.float32]
    step_cost: NDArray[np.float32]
    free_space: NDArray[np.bool_]
    reachable: NDArray[np.bool_]
    ground: NDArray[np.bool_]
    uncovered: NDArray[np.bool_]
    probability: NDArray[np.float32]
    entropy: NDArray[np.float32]
    robot_cell: tuple[int, int]
    elevation_m: NDArray[np.float32]
    top_m: NDArray[np.float32] | None = None
    shut: NDArray[np.bool_] | None = None
    open_clearance_m: NDArray[np.float32] | None = None
    weight: NDArray[np.float32] | None = None
    frame: Planar = IDENTITY
    frame_z_m: float = 0.0
    _from_map: Planar = field(init=False)

    def __post_init__(self) -> None:
        self._from_map = self.frame.inverse()

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """(row, column) of a point in `map`; may lie outside."""
        if not self.frame.is_identity:
            x_m, y_m = self._from_map.apply(x_m, y_m)
        return self.spec.cell_of(x_m, y_m)

    def to_map(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A point of `odom` in `map`."""
        return (x_m, y_m) if self.frame.is_identity else self.frame.apply(x_m, y_m)

    def height_m(self, x_m: float, y_m: float) -> float | None:
        """Height in `map` of the ground at a point in `map`; None where the risk map does not know it."""
        row, column = self.cell(x_m, y_m)
        if not self.spec.contains(row, column) or self.state[row, column] == UNKNOWN:
            return None
        return float(self.elevation_m[row, column]) + self.frame_z_m


def grid_of(risk: RiskMap) -> GridSpec:
    """Where a risk map lies, in `odom`."""
    g = risk.grid
    return GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height)


def tops_of(risk: RiskMap) -> NDArray[np.float32] | None:
    """What the coverage sensor has to look over, (h, w) m; None on flat ground."""
    return risk.top_m if risk.top_m.shape == risk.state.shape else None


def relief_of(risk: RiskMap) -> Relief | None:
    """The heights of a risk map; None on flat ground."""
    top_m = tops_of(risk)
    return None if top_m is None else Relief(risk.elevation_m, top_m)


def read_layer(layer: TileLayer, spec: GridSpec, frame: Planar) -> NDArray[Any]:
    """A layer in `map` as it lies in a window in `odom`, (h, w). frame: pose of `odom` in `map`."""
    if frame.is_identity:
        return layer.read(spec)
    there = bounds(spec, frame)
    return resample(layer.read(there), there, spec, frame.inverse(), layer.fill)


def build_window(
    risk: RiskMap,
    x_m: float,
    y_m: float,
    config: Config,
    layer: NDArray[np.uint8],
    log_odds: NDArray[np.float32],
    penalties: list[tuple[float, float]],
    frame: Planar = IDENTITY,
    frame_z_m: float = 0.0,
    shut: Shut | None = None,
    weight: NDArray[np.float32] | None = None,
) -> Window:
    """The layers around the robot from a risk map and what was known before.

    x_m, y_m: the robot in `odom`. layer: what was known of the ground, over the risk map's grid; brought up to date
    in place. log_odds: of coverage. penalties: places (x, y) in `odom` where the robot was blocked lately; their
    hazard is raised. shut: by the operator's fences: no ground there, and the body keeps off. weight: of cells.
    """
    fence = np.zeros(1, np.bool_) if shut is None else shut.mask
    clearance_m = risk.clearance_m if shut is None else np.minimum(risk.clearance_m, shut.distance_m)
    spec = grid_of(risk)
    g = risk.grid
    before = layer == GROUND
    hazard = footprint_hazard(
        risk.hazard_cvar, risk.footprint_radius_m + config.hazard_margin_m, g.resolution_m
    )
    for px, py in penalties:
        _raise_hazard(hazard, spec, px, py)
    needed = risk.footprint_radius_m + config.clearance_margin_m
    relaxed = needed - config.clearance_hysteresis_m
    passable = (risk.state == FREE) & ((clearance_m >= needed) | (before & (clearance_m >= relaxed)))
    passable &= ~fence
    robot = spec.cell_of(x_m, y_m)
    free_space = connected_free_space(passable, robot)
    forgotten = before & (risk.state == UNKNOWN) & ~fence
    reachable = connected_free_space(passable | forgotten, robot)
    ground = np.zeros(spec.shape, dtype=np.bool_)
    dilate_disc(reachable, risk.footprint_radius_m / g.resolution_m, ground)
    ground &= (risk.state == FREE) & ~fence
    ground |= forgotten
    layer[risk.state != UNKNOWN] = KNOWN
    layer[ground] = GROUND
    unseen = layer == 0
    hopeful = (solid(unseen) if config.unknown_solid else unseen) & (clearance_m >= needed) & ~fence
    hopeful &= connected_free_space(reachable | hopeful, robot)
    cell_share = (g.resolution_m / config.spacing_m) ** 2
    if config.coverage == "known":
        p = np.where(unseen, np.float32(0.5), np.float32(KNOWN_PROBABILITY))
        cell_entropy = expected_gain(
            reachable, hopeful, g.resolution_m, config.unknown_depth_m, config.unknown_decay_m, cell_share
        )
        uncovered = cell_entropy > 0.0
    else:
        p = probability(log_odds)
        uncovered = without_slivers(ground & (p < config.covered_probability))
        cell_entropy = np.where(uncovered, entropy(p) * np.float32(cell_share), np.float32(0.0))
    return Window(
        spec=spec,
        state=risk.state,
        hopeful=hopeful,
        clearance_m=clearance_m,
        hazard=hazard,
        step_cost=_step_cost(hazard, clearance_m, needed, config.comfort_clearance_m),
        free_space=free_space,
        reachable=reachable,
        ground=ground,
        uncovered=uncovered,
        probability=p,
        entropy=cell_entropy,
        robot_cell=robot,
        elevation_m=risk.elevation_m,
        top_m=tops_of(risk),
        shut=None if shut is None else shut.mask,
        open_clearance_m=None if shut is None else risk.clearance_m,
        weight=weight,
        frame=frame,
        frame_z_m=frame_z_m,
    )


def _step_cost(
    hazard: NDArray[np.float32], clearance_m: NDArray[np.float32], needed_m: float, comfort_m: float
) -> NDArray[np.float32]:
    """Cost per metre: 1, more where hazard is felt and within the comfort clearance (keeps paths off walls)."""
    span = max(comfort_m - needed_m, 1e-3)
    tight = np.clip((comfort_m - clearance_m) / span, 0.0, 1.0)
    cost: NDArray[np.float32] = (1.0 + 2.0 * hazard + 1.5 * tight**2).astype(np.float32)
    return cost


def _raise_hazard(hazard: NDArray[np.float32], spec: GridSpec, x_m: float, y_m: float) -> None:
    reach = math.ceil(0.4 / spec.resolution_m)
    row, column = spec.cell_of(x_m, y_m)
    r0, r1 = max(0, row - reach), min(spec.height, row + reach + 1)
    c0, c1 = max(0, column - reach), min(spec.width, column + reach + 1)
    if r0 < r1 and c0 < c1:
        hazard[r0:r1, c0:c1] += np.float32(1.0)


def connected_free_space(passable: NDArray[np.bool_], robot: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells that the robot's centre can reach. A robot whose own cell is too tight starts at the nearest good one."""
    reached = np.zeros(passable.shape, dtype=np.bool_)
    height, width = passable.shape
    row, column = robot
    for reach in range(7):
        r0, c0 = max(0, row - reach), max(0, column - reach)
        r1, c1 = max(0, min(height, row + reach + 1)), max(0, min(width, column + reach + 1))
        piece = passable[r0:r1, c0:c1]
        found = np.argwhere(piece)
        if len(found):
            offsets = found + np.array([r0 - row, c0 - column])
            nearest = found[int(np.argmin((offsets**2).sum(axis=1)))] + np.array([r0, c0])
            flood_fill(passable, nearest[None, :].astype(np.int32), reached)
            if int(reached.sum()) > 4:
                break
    return reached


def solid(unseen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Unseen cells in the midst of unseen cells (6 of 9): gaps between far rays are not unexplored ground."""
    padded = np.pad(unseen, 1, mode="edge").astype(np.uint8)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    kept: NDArray[np.bool_] = unseen & (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] >= 6)
    return kept


def without_slivers(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without cells that lie in strips of one cell: such strips beside walls are how the grid falls.

    A cell stays when at least 6 of the 9 cells around it (itself included) are in the mask, or when it touches one
    that stays.
    """
    padded = np.pad(mask, 1).astype(np.uint8)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    core = mask & (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] >= 6)
    grown = np.pad(core, 1)
    near = grown[:-2] | grown[1:-1] | grown[2:]
    kept: NDArray[np.bool_] = mask & (near[:, :-2] | near[:, 1:-1] | near[:, 2:])
    return kept


@njit
def dilate_disc(source: NDArray[np.bool_], radius_cells: float, out: NDArray[np.bool_]) -> None:
    """Cells whose centre is within the radius of a source cell's centre. Only border cells are stamped."""
    height, width = source.shape
    reach = int(math.floor(radius_cells + 1e-9))
    for row in range(height):
        for column in range(width):
            if not source[row, column]:
                continue
            out[row, column] = True
            inner = (
                0 < row < height - 1
                and 0 < column < width - 1
                and source[row - 1, column]
                and source[row + 1, column]
                and source[row, column - 1]
                and source[row, column + 1]
            )
            if inner:
                continue
            for r in range(max(0, row - reach), min(height, row + reach + 1)):
                for c in range(max(0, column - reach), min(width, column + reach + 1)):
                    if (r - row) ** 2 + (c - column) ** 2 <= radius_cells * radius_cells + 1e-9:
                        out[r, c] = True


def window_picture(window: Window) -> NDArray[np.uint8]:
    """The cells of a `CoverageWindow`: 0 unknown, 1 uncovered ground, 2 covered, 3 obstacle, 4 out of reach."""
    cell = np.zeros(window.spec.shape, dtype=np.uint8)
    cell[window.state == FREE] = 4
    cell[window.state == LETHAL] = 3
    cell[window.ground] = 2
    cell[window.uncovered] = 1
    return cell

"""The judge: which ground the robot could cover, and which it has seen from its true poses.

Reachable ground is exact on the judge's cells: the configuration space is every cell on whose centre the disc
overlaps no wall; its 4-connected part that holds the start is swept by the disc. Dilation by the disc equals
a threshold on the Euclidean distance transform, with the distance taken to the walls' areas, as in the
robot's own contact test, and not to their cells' centres.

The disc's centre is tried on cell centres only: a passage wider than the footprint by less than one cell may
count as closed, never a narrower one as open. Worlds coarser than 0.1 m are judged on cells cut to 0.1 m
or less, so that a gap of two coarse cells is not lost between their centres.

On uneven ground the configuration space is where the robot stands at acceptable risk (`terrain_judge`), and the line
of sight is in three dimensions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from planning.kernels import njit
from services.sim.config import CoverageSensorConfig, LidarConfig, RobotConfig
from services.sim.geometry import configuration_space, dilate, disc_holds_centre, flood, sees_cell
from services.sim.terrain import Heights, body_solid, finite_ceiling, height_at, resample
from services.sim.terrain_judge import acceptable_ground, look_over
from services.sim.world import StartError, World

COARSEST_CELL_M = 0.1


class Judge:
    """Ground truth of coverage for one world, footprint and coverage sensor.

    A reachable cell is covered when its centre has been within range and field of view of a true pose, with
    no wall on the line between: the simulator's own line of sight, whatever the planners believe. Detection
    probability is a matter of belief; here every look counts.
    """

    def __init__(
        self,
        world: World,
        footprint_radius_m: float,
        sensor: CoverageSensorConfig,
        robot: RobotConfig | None = None,
        sensor_height_m: float = LidarConfig().height_m,
    ) -> None:
        self._world = world
        self._radius_m = footprint_radius_m
        self._cuts = cuts_of(world)
        self.spec, self.occupied = refine(world)
        self._sensor_height_m = sensor_height_m
        self._floor_m: Heights | None = None
        if world.floor_m is not None and world.ceiling_m is not None:
            self._floor_m = resample(world.floor_m, self._cuts)
            self._ceiling_m = resample(finite_ceiling(world.ceiling_m), self._cuts)
            robot = robot or RobotConfig(footprint_radius_m=footprint_radius_m)
            solid = cut(body_solid(world, robot.height_m), self._cuts)
            free = acceptable_ground(self.spec, solid, self._floor_m, robot)
        else:
            free = configuration_space(self.occupied, footprint_radius_m / self.spec.resolution_m)
        self.roamed = roamed_part(self.spec, free, world.start)
        """bool[height, width] on `spec`: where the middle of the footprint can be, when the judge begins."""
        self.reachable = swept_part(self.spec, self.roamed, footprint_radius_m)
        """bool[height, width] on `spec`: ground that the footprint can sweep over."""
        self.covered = np.zeros(self.spec.shape, dtype=np.bool_)
        """bool[height, width] on `spec`: reachable ground seen so far."""
        self._pending = self.reachable.copy()
        self._range_cells = sensor.range_m / self.spec.resolution_m
        half_fov_rad = math.radians(sensor.fov_deg) / 2.0
        self._cos_half_fov = math.cos(half_fov_rad) if sensor.fov_deg < 360.0 else -2.0
        self._reachable_cells = int(np.count_nonzero(self.reachable))
        self._covered_cells = 0
        self._told = self.covered.copy()
        self._box: tuple[float, float, float, float] | None = None

    def update(self, x_m: float, y_m: float, yaw_rad: float) -> int:
        """Look once from a true pose; returns how many cells are newly covered."""
        cell = self.spec.resolution_m
        x, y = x_m / cell - self.spec.ix0, y_m / cell - self.spec.iy0
        low_x, low_y, high_x, high_y = self._box or (x, y, x, y)
        self._box = (min(low_x, x), min(low_y, y), max(high_x, x), max(high_y, y))
        new = self._look(x, y, yaw_rad, self._pending, self.covered, self._cos_half_fov)
        self._covered_cells += new
        return new

    def look_around(
        self, x_m: float, y_m: float, pending: NDArray[np.bool_], seen: NDArray[np.bool_]
    ) -> tuple[slice, slice]:
        """Move the cells of `pending` (bool on `spec`) that the sensor would see from a point, if it turned all around,
        to `seen` (both changed in place); what is covered stays as it is. Returns the rows and columns looked at."""
        cell, reach = self.spec.resolution_m, self._range_cells
        x, y = x_m / cell - self.spec.ix0, y_m / cell - self.spec.iy0
        self._look(x, y, 0.0, pending, seen, -2.0)
        rows = slice(max(0, math.floor(y - reach)), max(0, math.floor(y + reach) + 1))
        return rows, slice(max(0, math.floor(x - reach)), max(0, math.floor(x + reach) + 1))

    def _look(
        self,
        x: float,
        y: float,
        yaw_rad: float,
        pending: NDArray[np.bool_],
        seen: NDArray[np.bool_],
        cos_half_fov: float,
    ) -> int:
        """Look from a point in cells; `pending` and `seen` are changed in place. Returns how many cells were seen."""
        view = np.array([x, y, math.cos(yaw_rad), math.sin(yaw_rad)])
        if self._floor_m is None:
            return look(self.occupied, pending, seen, view, self._range_cells, cos_half_fov)
        view = np.append(view, height_at(self._floor_m, x, y) + self._sensor_height_m)
        return look_over(
            self.occupied,
            self._floor_m,
            self._ceiling_m,
            pending,
            seen,
            view,
            self._range_cells,
            cos_half_fov,
        )

    def close(self, occupied: NDArray[np.bool_], robot_m: tuple[float, float]) -> None:
        """Take over new walls (on the world's cells) after a door has closed, with the robot at a point.

        What has been covered still counts; ground not yet covered that the robot can no longer reach does not.
        """
        walls = cut(occupied, self._cuts)
        still = reachable_ground(self.spec, walls, (*robot_m, 0.0), self._radius_m)
        self.take_over(occupied, self.reachable & (self.covered | still))

    def take_over(self, occupied: NDArray[np.bool_], reachable: NDArray[np.bool_]) -> None:
        """Judge by these walls (on the world's cells) and this ground; what is covered of it stays covered."""
        self.occupied = cut(occupied, self._cuts)
        self.reachable = reachable
        self._reachable_cells = int(np.count_nonzero(reachable))
        self._count(self.covered)
        self._told &= reachable

    @property
    def coverage_fraction(self) -> float:
        """Covered share of the reachable ground, 0 to 1."""
        return self._covered_cells / self._reachable_cells

    @property
    def covered_area_m2(self) -> float:
        """Area of the reachable ground seen so far."""
        return self._covered_cells * self.spec.resolution_m**2

    @property
    def reachable_area_m2(self) -> float:
        """Area of the ground that the footprint can sweep over."""
        return self._reachable_cells * self.spec.resolution_m**2

    def set_covered(self, covered: NDArray[np.bool_]) -> None:
        """Take over a coverage mask (from a snapshot). Raises ValueError if its shape differs."""
        if covered.shape != self.spec.shape:
            raise ValueError(f"coverage mask of shape {covered.shape}, need {self.spec.shape}")
        self._count(covered)
        self._told, self._box = self.covered.copy(), None

    def _count(self, covered: NDArray[np.bool_]) -> None:
        self.covered = covered & self.reachable
        self._pending = self.reachable & ~self.covered
        self._covered_cells = int(np.count_nonzero(self.covered))

    def take_news(self) -> NDArray[np.int64]:
        """Flat indices of the cells covered since the last call: for the journal. Looks only where the robot was."""
        if self._box is None:
            return np.empty(0, np.int64)
        low_x, low_y, high_x, high_y = self._box
        self._box, reach = None, self._range_cells + 1.0
        r0, c0 = max(0, math.floor(low_y - reach)), max(0, math.floor(low_x - reach))
        near = (slice(r0, max(r0, math.ceil(high_y + reach))), slice(c0, max(c0, math.ceil(high_x + reach))))
        rows, columns = np.nonzero(self.covered[near] & ~self._told[near])
        self._told[near] = self.covered[near]
        return (rows + r0) * self.spec.width + columns + c0

    def add_covered(self, cells: NDArray[np.int64]) -> None:
        """Take over cells that a twin has told of (from the journal). cells: flat indices."""
        for mask, value in ((self.covered, True), (self._told, True), (self._pending, False)):
            mask.reshape(-1)[cells] = value
        self._covered_cells = int(np.count_nonzero(self.covered))


def cuts_of(world: World) -> int:
    """Into how many along a side each cell of the world is cut, so that none is over `COARSEST_CELL_M`."""
    return max(1, math.ceil(world.spec.resolution_m / COARSEST_CELL_M - 1e-6))


def cut(mask: NDArray[np.bool_], cuts: int) -> NDArray[np.bool_]:
    """The mask with each cell cut into cuts x cuts; read-only."""
    if cuts == 1:
        return mask
    finer = np.repeat(np.repeat(mask, cuts, axis=0), cuts, axis=1)
    finer.setflags(write=False)  # as the world's own: another kind of array would be another compilation
    return finer


def refine(world: World) -> tuple[GridSpec, NDArray[np.bool_]]:
    """The world on cells of at most `COARSEST_CELL_M`: each cell cut into k x k."""
    spec, cuts = world.spec, cuts_of(world)
    if cuts == 1:
        return spec, world.occupied
    finer = GridSpec(
        spec.resolution_m / cuts, spec.ix0 * cuts, spec.iy0 * cuts, spec.width * cuts, spec.height * cuts
    )
    return finer, cut(world.occupied, cuts)


def reachable_ground(
    spec: GridSpec, occupied: NDArray[np.bool_], start: tuple[float, float, float], footprint_radius_m: float
) -> NDArray[np.bool_]:
    """Cells whose centre the disc sweeps over while its own centre roams the cells it can reach.

    Raises StartError if the disc fits on no cell next to the start.
    """
    free = configuration_space(occupied, footprint_radius_m / spec.resolution_m)
    return swept_part(spec, roamed_part(spec, free, start), footprint_radius_m)


def roamed_part(
    spec: GridSpec, free: NDArray[np.bool_], start: tuple[float, float, float]
) -> NDArray[np.bool_]:
    """The 4-connected part of `free` that holds the start. Raises StartError."""
    row, column = _nearest_free(spec, free, start)
    return flood(free, row, column)


def swept_part(spec: GridSpec, roamed: NDArray[np.bool_], footprint_radius_m: float) -> NDArray[np.bool_]:
    """What the disc sweeps while its centre roams these cells."""
    return dilate(roamed, disc_holds_centre(footprint_radius_m / spec.resolution_m), False)


def _nearest_free(
    spec: GridSpec, free: NDArray[np.bool_], start: tuple[float, float, float]
) -> tuple[int, int]:
    """The free cell nearest to the start, no farther than two cells off."""
    x, y = start[0] / spec.resolution_m - spec.ix0, start[1] / spec.resolution_m - spec.iy0
    row, column = math.floor(y), math.floor(x)
    around = [
        (math.hypot(r + 0.5 - y, c + 0.5 - x), r, c)
        for r in range(row - 2, row + 3)
        for c in range(column - 2, column + 3)
        if spec.contains(r, c) and free[r, c]
    ]
    if not around:
        raise StartError(
            f"the footprint does not fit at the start ({start[0]:g}, {start[1]:g}), or the ground is too rough: "
            f"choose another"
        )
    _, row, column = min(around)
    return row, column


@njit
def look(
    occupied: NDArray[np.bool_],
    pending: NDArray[np.bool_],
    covered: NDArray[np.bool_],
    view: NDArray[np.float64],
    range_cells: float,
    cos_half_fov: float,
) -> int:
    """Move every pending cell that is seen to `covered` (both changed in place); returns how many.

    `view` is (x, y, cos yaw, sin yaw) in cells. Only pending cells are traced, one exact line each.
    """
    x, y = view[0], view[1]
    height, width = pending.shape
    row_low, row_high = max(0, math.floor(y - range_cells)), min(height - 1, math.floor(y + range_cells))
    column_low, column_high = max(0, math.floor(x - range_cells)), min(width - 1, math.floor(x + range_cells))
    new = 0
    for row in range(row_low, row_high + 1):
        for column in range(column_low, column_high + 1):
            if not pending[row, column]:
                continue
            dx, dy = column + 0.5 - x, row + 0.5 - y
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > range_cells or dx * view[2] + dy * view[3] < cos_half_fov * distance:
                continue
            if sees_cell(occupied, x, y, row, column):
                pending[row, column] = False
                covered[row, column] = True
                new += 1
    return new

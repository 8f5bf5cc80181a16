"""A world: walls on flat or uneven ground, perhaps under a ceiling, and where the robot starts in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.grid import GridSpec
from services.sim.geometry import clearance, ray_length

DEFAULT_FOOTPRINT_RADIUS_M = 0.335
WALL_HEIGHT_M = 2.5
_YAW_CANDIDATES = 64
_YAW_RANGE_M = 50.0


class WorldError(Exception):
    """A world that cannot be built or used; the message names what is wrong and how to mend it."""


class UnknownWorldError(WorldError):
    """No built-in world has that name."""


class MapFileError(WorldError):
    """A file with a map, a mesh or heights, one of its fields or its image is unusable."""


class StartError(WorldError):
    """The robot cannot stand where it should start."""


@dataclass(frozen=True)
class Mover:
    """A person who walks to and fro between two points, a standing cylinder; all as a function of mission time."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    speed_mps: float
    radius_m: float = 0.3
    height_m: float = 1.7

    def at(self, now_s: float) -> tuple[float, float]:
        """(x_m, y_m) of its centre."""
        length_m = math.hypot(self.to_m[0] - self.from_m[0], self.to_m[1] - self.from_m[1])
        way_m = math.fmod(self.speed_mps * max(now_s, 0.0), 2.0 * length_m)
        share = min(way_m, 2.0 * length_m - way_m) / length_m
        return (
            self.from_m[0] + share * (self.to_m[0] - self.from_m[0]),
            self.from_m[1] + share * (self.to_m[1] - self.from_m[1]),
        )


@dataclass(frozen=True)
class Door:
    """A rectangle (x_low, y_low, x_high, y_high) in metres that turns solid for good at a mission time.

    A door waits while the robot stands in it, and until the robot's centre has come within `closes_within_m` of it.
    """

    area_m: tuple[float, float, float, float]
    closes_at_s: float
    closes_within_m: float = math.inf

    def gap_m(self, x_m: float, y_m: float) -> float:
        """Distance of a point from the rectangle; 0 inside."""
        x_low, y_low, x_high, y_high = self.area_m
        return math.hypot(max(x_low - x_m, x_m - x_high, 0.0), max(y_low - y_m, y_m - y_high, 0.0))


@dataclass(frozen=True, eq=False)
class World:
    """Walls, and the ground between them; whatever lies outside the grid is wall.

    `occupied` is bool[height, width] on `spec`: solid. `start` is (x_m, y_m, yaw_rad) in the frame `map`.
    `floor_m`, `ceiling_m` are float32[height, width]: heights at the cells' centres, bilinear between them, so that
    the ground is a continuous surface; a ledge is one cell wide. The ceiling is inf where it is open. Cells that are
    occupied take the heights of the nearest free ones. Both None: flat ground at z = 0 under an open sky, with walls
    of `WALL_HEIGHT_M`; with a floor, walls have no end.
    `open_border`: nothing stands outside, so that rays which leave the grid do not return.
    """

    name: str
    spec: GridSpec
    occupied: NDArray[np.bool_]
    start: tuple[float, float, float]
    floor_m: NDArray[np.float32] | None = None
    ceiling_m: NDArray[np.float32] | None = None
    movers: tuple[Mover, ...] = ()
    doors: tuple[Door, ...] = ()
    open_border: bool = False

    def __post_init__(self) -> None:
        if self.occupied.shape != self.spec.shape or self.occupied.dtype != np.bool_:
            raise WorldError(
                f"world {self.name}: occupied is {self.occupied.dtype}{self.occupied.shape}, "
                f"must be bool{self.spec.shape}"
            )
        self._set("occupied", np.ascontiguousarray(self.occupied).view())
        if self.floor_m is None:
            if self.ceiling_m is not None:
                raise WorldError(f"world {self.name}: has a ceiling but no floor: give floor_m too")
            return
        ceiling = np.full(self.spec.shape, np.inf, np.float32) if self.ceiling_m is None else self.ceiling_m
        for what, heights in (("floor_m", self.floor_m), ("ceiling_m", ceiling)):
            if heights.shape != self.spec.shape or heights.dtype != np.float32:
                raise WorldError(
                    f"world {self.name}: {what} is {heights.dtype}{heights.shape}, must be float32{self.spec.shape}"
                )
            self._set(what, _filled(heights, self.occupied))
        self._check_heights()

    def _set(self, field: str, values: NDArray[np.generic]) -> None:
        values.setflags(write=False)
        object.__setattr__(self, field, values)

    def _check_heights(self) -> None:
        assert self.floor_m is not None and self.ceiling_m is not None
        if not np.isfinite(self.floor_m).all() or np.isnan(self.ceiling_m).any():
            raise WorldError(f"world {self.name}: a free cell has no height: mark it as occupied")

    @property
    def has_terrain(self) -> bool:
        """Whether the ground has heights."""
        return self.floor_m is not None

    def to_cells(self, x_m: float, y_m: float) -> tuple[float, float]:
        """(x, y) of a point in cells from the grid's lower left corner, as the kernels take it."""
        return x_m / self.spec.resolution_m - self.spec.ix0, y_m / self.spec.resolution_m - self.spec.iy0

    def clearance_m(self, x_m: float, y_m: float, reach_m: float) -> float:
        """Exact distance from the point to the nearest wall area, at most `reach_m`."""
        x, y = self.to_cells(x_m, y_m)
        return clearance(self.occupied, x, y, reach_m / self.spec.resolution_m)[0] * self.spec.resolution_m

    def longest_ray_yaw(self, x_m: float, y_m: float) -> float:
        """Yaw in radians of the longest free ray from the point (64 directions, the first of equals)."""
        x, y = self.to_cells(x_m, y_m)
        longest = _YAW_RANGE_M / self.spec.resolution_m
        yaws = [2.0 * math.pi * k / _YAW_CANDIDATES for k in range(_YAW_CANDIDATES)]
        lengths = [ray_length(self.occupied, x, y, math.cos(a), math.sin(a), longest) for a in yaws]
        best = yaws[int(np.argmax(lengths))]
        return math.remainder(best, 2.0 * math.pi)


def deepest_free_point(spec: GridSpec, occupied: NDArray[np.bool_]) -> tuple[float, float]:
    """Centre (x_m, y_m) of the free cell farthest from any wall; the first of equals."""
    padded = np.pad(occupied, 1, constant_values=True)
    depth = ndimage.distance_transform_edt(~padded)[1:-1, 1:-1]
    row, column = divmod(int(np.argmax(depth)), spec.width)
    if occupied[row, column]:
        raise StartError("the map has no free cell: check its thresholds and negate")
    return spec.centre_of(row, column)


def with_start(
    world: World,
    x_m: float,
    y_m: float,
    yaw_rad: float | None = None,
    footprint_radius_m: float = DEFAULT_FOOTPRINT_RADIUS_M,
) -> World:
    """The same world with another start; the yaw defaults to the longest free ray.

    Raises StartError if the point is not finite, lies outside or in a wall, or if the footprint does not fit.
    """
    where = f"start ({x_m:g}, {y_m:g}) in world {world.name}"
    if not all(math.isfinite(value) for value in (x_m, y_m, yaw_rad or 0.0)):
        raise StartError(f"{where} is not finite: give x and y in metres and yaw in radians")
    row, column = world.spec.cell_of(x_m, y_m)
    if not world.spec.contains(row, column):
        low = world.spec.centre_of(0, 0)
        high = world.spec.centre_of(world.spec.height - 1, world.spec.width - 1)
        raise StartError(
            f"{where} lies outside the map: x runs from {low[0]:.1f} to {high[0]:.1f} m, "
            f"y from {low[1]:.1f} to {high[1]:.1f} m"
        )
    if world.occupied[row, column]:
        raise StartError(f"{where} lies inside a wall or unknown ground: {_suggestion(world)}")
    room_m = world.clearance_m(x_m, y_m, footprint_radius_m + world.spec.resolution_m)
    if room_m < footprint_radius_m - 1e-9:
        raise StartError(
            f"{where}: the footprint of radius {footprint_radius_m:g} m does not fit, "
            f"the nearest wall is {room_m:.2f} m away: {_suggestion(world)}"
        )
    yaw_rad = world.longest_ray_yaw(x_m, y_m) if yaw_rad is None else math.remainder(yaw_rad, 2.0 * math.pi)
    return replace(world, start=(x_m, y_m, yaw_rad))


def _filled(heights_m: NDArray[np.float32], occupied: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Heights with those of the nearest free cell where occupied, so that nothing leaps at a wall."""
    if occupied.all() or not occupied.any():
        return np.array(heights_m)
    nearest = ndimage.distance_transform_edt(occupied, return_distances=False, return_indices=True)
    return np.ascontiguousarray(heights_m[tuple(nearest)])


def _suggestion(world: World) -> str:
    x_m, y_m = deepest_free_point(world.spec, world.occupied)
    return f"choose a free point, the most open one is ({x_m:.2f}, {y_m:.2f})"

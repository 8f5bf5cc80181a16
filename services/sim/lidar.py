"""A spinning LiDAR: walls of one height on flat ground share one walk per azimuth, uneven ground does not."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.sim.config import LidarConfig
from services.sim.geometry import ray_length
from services.sim.scene import Scene
from services.sim.terrain import rotation, terrain_of
from services.sim.terrain_lidar import Bounds, bounds_of, cast_rays, hide_behind_movers
from services.sim.world import WALL_HEIGHT_M, World


@njit
def cast_scan(
    occupied: NDArray[np.bool_],
    pose: NDArray[np.float64],
    azimuths: NDArray[np.float64],
    rings: NDArray[np.float64],
    limits: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Noiseless slant ranges in metres, shape (azimuths, rings), inf where nothing returns.

    `pose` is (x, y) in cells and the yaw; `azimuths` in radians; `rings`[n, 2] the tangent and the cosine of
    each elevation; `limits` is (cell size, longest range, height of the sensor, height of the walls) in metres.
    All rings of an azimuth share one walk through the grid, as every wall rises from the ground to one height.
    """
    cell, longest, height, wall_top = limits[0], limits[1], limits[2], limits[3]
    ranges = np.empty((azimuths.shape[0], rings.shape[0]))
    reach = longest / cell
    for a in range(azimuths.shape[0]):
        angle = pose[2] + azimuths[a]
        free = ray_length(occupied, pose[0], pose[1], math.cos(angle), math.sin(angle), reach)
        wall = free * cell if free < reach else math.inf
        for k in range(rings.shape[0]):
            slope, level = rings[k, 0], rings[k, 1]
            along = wall if height + wall * slope <= wall_top else math.inf
            if slope < 0.0:
                along = min(along, -height / slope)
            slant = along / level
            ranges[a, k] = slant if slant <= longest else math.inf
    return ranges


@njit
def to_points(
    ranges: NDArray[np.float64],
    directions: NDArray[np.float32],
    noise_m: NDArray[np.float32],
    luck: NDArray[np.float32],
    dropout_probability: float,
) -> NDArray[np.float32]:
    """Points float32[n, 3] of the finite ranges that do not drop out.

    All inputs have shape (azimuths, rings), `directions` with unit vectors besides.
    """
    points = np.empty((ranges.size, 3), dtype=np.float32)
    count = 0
    for a in range(ranges.shape[0]):
        for k in range(ranges.shape[1]):
            if not math.isfinite(ranges[a, k]) or luck[a, k] < dropout_probability:
                continue
            # Noise may not turn a point to behind the sensor.
            slant = max(ranges[a, k] + noise_m[a, k], 0.0)
            for axis in range(3):
                points[count, axis] = directions[a, k, axis] * slant
            count += 1
    return points[:count].copy()


class Lidar:
    """Scans of one world. Noise comes from the generator given to `scan` and from nowhere else."""

    def __init__(self, world: World, config: LidarConfig, scene: Scene | None = None) -> None:
        self._world, self._config = world, config
        self._scene = scene or Scene(world)
        self._azimuths = 2.0 * math.pi * np.arange(config.azimuths) / config.azimuths
        low, high = math.radians(config.elevation_min_deg), math.radians(config.elevation_max_deg)
        elevations = np.linspace(low, high, config.rings)
        self._rings = np.stack([np.tan(elevations), np.cos(elevations)], axis=1)
        self._directions = np.empty((config.azimuths, config.rings, 3), dtype=np.float32)
        self._directions[..., 0] = np.cos(self._azimuths)[:, None] * np.cos(elevations)
        self._directions[..., 1] = np.sin(self._azimuths)[:, None] * np.cos(elevations)
        self._directions[..., 2] = np.sin(elevations)
        self._limits = np.array([world.spec.resolution_m, config.range_m, config.height_m, WALL_HEIGHT_M])
        self._terrain = terrain_of(world) if world.has_terrain else None
        self._bounds: Bounds | None = None
        self._bounds_of: NDArray[np.bool_] | None = None

    def ranges(
        self,
        x_m: float,
        y_m: float,
        yaw_rad: float,
        z_m: float = 0.0,
        roll_rad: float = 0.0,
        pitch_rad: float = 0.0,
    ) -> NDArray[np.float64]:
        """Noiseless slant ranges in metres, shape (azimuths, rings), inf where nothing returns.

        The pose is base_link's; the sensor stands `height_m` along the body's up axis.
        """
        turn = rotation(roll_rad, pitch_rad, yaw_rad)
        origin_m = np.array([x_m, y_m, z_m]) + turn[:, 2] * self._config.height_m
        if self._terrain is not None:
            ranges = self._over_terrain(origin_m, turn)
        else:
            pose = np.array([*self._world.to_cells(x_m, y_m), yaw_rad])
            ranges = cast_scan(self._scene.occupied, pose, self._azimuths, self._rings, self._limits)
        if self._world.open_border:
            self._forget_outside(ranges, origin_m, turn)
        if self._scene.movers.size:
            movers, longest_m = self._scene.movers, self._config.range_m
            hide_behind_movers(ranges, origin_m, turn, self._directions, movers, longest_m)
        return ranges

    def _over_terrain(self, origin_m: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._terrain is not None
        occupied = self._scene.occupied
        if self._bounds is None or self._bounds_of is not occupied:
            self._bounds = bounds_of(occupied, self._terrain)
            self._bounds_of = occupied
        x, y = self._world.to_cells(float(origin_m[0]), float(origin_m[1]))
        origin = np.array([x, y, origin_m[2]])
        limits = self._limits[:2]
        return cast_rays(occupied, self._terrain, self._bounds, origin, turn, self._directions, limits)

    def _forget_outside(
        self, ranges: NDArray[np.float64], origin_m: NDArray[np.float64], turn: NDArray[np.float64]
    ) -> None:
        """Take out (in place) what stands at the border of the grid or beyond it."""
        spec = self._world.spec
        low = np.array([spec.ix0, spec.iy0]) * spec.resolution_m
        high = low + np.array([spec.width, spec.height]) * spec.resolution_m
        ways = (self._directions @ turn.T.astype(np.float32))[..., :2].astype(np.float64)
        with np.errstate(invalid="ignore"):  # inf * 0: not outside
            ends = origin_m[:2] + ranges[..., None] * ways
        ranges[((ends < low + 1e-4) | (ends > high - 1e-4)).any(axis=-1)] = np.inf

    def scan(
        self,
        x_m: float,
        y_m: float,
        yaw_rad: float,
        rng: np.random.Generator,
        z_m: float = 0.0,
        roll_rad: float = 0.0,
        pitch_rad: float = 0.0,
    ) -> NDArray[np.float32]:
        """Points (x forward, y left, z up) from the sensor, float32[n, 3]; rays without a return are absent.

        Draws the same count of random numbers whatever it sees.
        """
        ranges = self.ranges(x_m, y_m, yaw_rad, z_m, roll_rad, pitch_rad)
        noise_m = rng.standard_normal(ranges.shape, dtype=np.float32) * np.float32(self._config.range_noise_m)
        luck = rng.random(ranges.shape, dtype=np.float32)
        return to_points(ranges, self._directions, noise_m, luck, self._config.dropout_probability)

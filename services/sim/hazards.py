"""Uneven ground with what breaks robots: boulders, mounds, rubble, pits, drop-offs, talus, stalagmites.

Everything keeps off the lanes, so that a way remains; nothing lies within `CALM_M` of the start.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from services.sim.noise import Field, octave, smooth_step
from services.sim.passages import Hollow, window

CALM_M = 3.8
"""Ground around the start that is level and free of hazards."""
LANE_M = 0.95
"""Free half width of a lane."""
_STEEPEST_LANE = 0.27
"""Tangent of the steepest lasting slope of the ground without hazards."""


class Ground:
    """The floor of a cave while it is being made: `floor_m` float64[height, width], changed in place."""

    def __init__(
        self, spec: GridSpec, hollow: Hollow, start_m: tuple[float, float], rng: np.random.Generator
    ) -> None:
        self.spec, self.hollow, self.rng = spec, hollow, rng
        x, y = spec.centres_x(), spec.centres_y()[:, None]
        self._from_start_m = np.hypot(x - start_m[0], y - start_m[1])
        self._open = np.flatnonzero(hollow.depth_m > 0.05)
        self.floor_m: Field = np.zeros(spec.shape)
        self.calm: Field = smooth_step(self._from_start_m, CALM_M, CALM_M + 2.0)
        """0 at the start, 1 away from it."""
        self.aside: Field = smooth_step(hollow.lane_distance_m, LANE_M, LANE_M + 0.5) * self.calm
        """0 on the lanes, 1 away from them."""

    def undulate(self, octaves: tuple[tuple[float, float], ...]) -> None:
        """Lay smooth ground, (wavelength m, amplitude m) each, no steeper for long than lanes may be; level at
        the start."""
        ground = np.zeros(self.spec.shape)
        for wavelength_m, amplitude_m in octaves:
            ground += amplitude_m * octave(self.spec, wavelength_m, self.rng)
        slope = np.hypot(*np.gradient(ground, self.spec.resolution_m)).flat[self._open]
        ground *= min(1.0, _STEEPEST_LANE / float(np.quantile(slope, 0.995)))
        row, column = np.unravel_index(int(np.argmin(self._from_start_m)), self.spec.shape)
        gentle = smooth_step(self._from_start_m, CALM_M - 0.3, CALM_M + 14.0)
        self.floor_m += (ground - ground[row, column]) * gentle

    def roughen(self, wavelength_m: float, amplitude_m: float) -> None:
        """Small bumps everywhere but at the start."""
        self.floor_m += amplitude_m * octave(self.spec, wavelength_m, self.rng) * self.calm

    def boulders(self, tries: int, radius_m: tuple[float, float], height_m: tuple[float, float]) -> None:
        """Steep-sided blocks."""
        for x_m, y_m, r_m in self._places(tries, *radius_m):
            height = self.rng.uniform(*height_m) * min(1.0, 0.6 + r_m)
            rows, columns, d = self._disc(x_m, y_m, r_m)
            self.floor_m[rows, columns] += height * np.maximum(1.0 - (d / r_m) ** 4, 0.0) ** 0.5

    def stalagmites(self, tries: int) -> None:
        """Thin cones."""
        for x_m, y_m, r_m in self._places(tries, 0.15, 0.35):
            rows, columns, d = self._disc(x_m, y_m, r_m)
            self.floor_m[rows, columns] += self.rng.uniform(0.5, 1.6) * np.maximum(1.0 - d / r_m, 0.0) ** 0.7

    def mounds(self, tries: int, radius_m: tuple[float, float], slope: tuple[float, float]) -> None:
        """Hills whose sides rise with the given tangents, from what a robot can take to beyond."""
        for x_m, y_m, r_m in self._places(tries, *radius_m):
            height = self.rng.uniform(*slope) * r_m * 2.0 / math.pi
            rows, columns, d = self._disc(x_m, y_m, r_m)
            self.floor_m[rows, columns] += height * 0.5 * (1.0 + np.cos(np.pi * np.minimum(d / r_m, 1.0)))

    def pits(self, tries: int, radius_m: tuple[float, float], depth_m: tuple[float, float]) -> None:
        """Holes with sheer sides."""
        for x_m, y_m, r_m in self._places(tries, *radius_m):
            rows, columns, d = self._disc(x_m, y_m, r_m)
            self.floor_m[rows, columns] -= self.rng.uniform(*depth_m) * smooth_step(-d, -r_m, 0.1 - r_m)

    def rubble(self, tries: int, radius_m: tuple[float, float], stone_m: float) -> None:
        """Fields of stones up to about twice `stone_m` high."""
        stones = np.abs(octave(self.spec, 0.55, self.rng)) + 0.5 * np.abs(octave(self.spec, 0.3, self.rng))
        for x_m, y_m, r_m in self._places(tries, *radius_m, overlap_m=0.8):
            rows, columns, d = self._disc(x_m, y_m, r_m)
            patch = smooth_step(-d, -r_m, -0.6 * r_m) * self.aside[rows, columns]
            self.floor_m[rows, columns] += stone_m * stones[rows, columns] * patch

    def drop_offs(self, tries: int, radius_m: tuple[float, float], depth_m: tuple[float, float]) -> None:
        """Ground beside the lane that lies lower behind a sheer edge."""
        off_lane = smooth_step(self.hollow.lane_distance_m, LANE_M + 0.1, LANE_M + 0.2)
        wavy = 0.3 * octave(self.spec, 1.5, self.rng)
        for x_m, y_m, r_m in self._places(tries, *radius_m, overlap_m=2.0):
            rows, columns, d = self._disc(x_m, y_m, 1.3 * r_m)
            inside = smooth_step(-d + wavy[rows, columns], -r_m, 0.1 - r_m)
            self.floor_m[rows, columns] -= (
                self.rng.uniform(*depth_m) * inside * off_lane[rows, columns] * self.calm[rows, columns]
            )

    def talus(self, reach_m: float, slope: float, share: float) -> None:
        """Steep scree along some of the walls: `share` from -1 (nowhere) to 1 (nearly everywhere)."""
        where = smooth_step(octave(self.spec, 7.0, self.rng), -share, 0.5 - share)
        self.floor_m += slope * np.maximum(reach_m - self.hollow.depth_m, 0.0) * where * self.aside

    def _places(
        self, tries: int, least_m: float, most_m: float, overlap_m: float = 0.0
    ) -> list[tuple[float, float, float]]:
        """(x, y, radius) at random points of the open, the radius cut to keep off the lanes and the start.

        `overlap_m`: how far the disc may reach over a lane (its maker spares the lane itself).
        """
        found = []
        picks = self._open[self.rng.integers(self._open.size, size=tries)]
        radii = self.rng.uniform(least_m, most_m, tries)
        for cell, radius_m in zip(picks.tolist(), radii.tolist(), strict=True):
            room = min(
                float(self.hollow.lane_distance_m.flat[cell]) - LANE_M + overlap_m,
                float(self._from_start_m.flat[cell]) - CALM_M,
            )
            if room >= least_m:
                row, column = divmod(cell, self.spec.width)
                found.append((*self.spec.centre_of(row, column), min(radius_m, room)))
        return found

    def _disc(self, x_m: float, y_m: float, radius_m: float) -> tuple[slice, slice, Field]:
        """Window around a point, and the distances from it there."""
        rows, columns = window(self.spec, x_m, y_m, radius_m)
        x, y = self.spec.centres_x()[columns], self.spec.centres_y()[rows, None]
        return rows, columns, np.hypot(x - x_m, y - y_m)


def connected(free: NDArray[np.bool_], row: int, column: int) -> NDArray[np.bool_]:
    """The 4-connected part of `free` that holds a cell."""
    from services.sim.geometry import flood

    return flood(np.ascontiguousarray(free), row, column)

"""Rough ground: ground and ceiling with variance, obstacles on it, and hazard after STEP (fan2021step)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.sensing import PointCloud, ReadyGrid
from services.riskmap.cells import (
    CHANNELS,
    HIT_AT,
    HIT_WEIGHT,
    HIT_X,
    HIT_Y,
    LOG_ODDS,
    MEAN,
    TRAVELLED,
    VARIANCE,
)
from services.riskmap.collision import RiskLayers
from services.riskmap.config import Config
from services.riskmap.drift import Drift
from services.riskmap.extrinsics import base_in_odom, body_box, transform, without_body
from services.riskmap.gaps import join_rings
from services.riskmap.grid_layers import grid_layers
from services.riskmap.ground import GroundRules, fuse_ground, upright, walk
from services.riskmap.hazard import Limits, Obstacles, hazard_layers
from services.riskmap.obstacles import add_hits, clear_pierced
from services.riskmap.ready_grid import grid_evidence
from services.riskmap.ring import RingWindow
from services.riskmap.standing import stand_here, start_ground, suppose_start
from services.riskmap.sweep import read_sweep
from services.riskmap.terrain import Ground, TerrainMetrics, close_holes, spread_heights, terrain_metrics
from services.riskmap.tops import tops


class TerrainModel:
    """What is known of each cell (see `cells`) in a ring buffer, and the risk layers made from it."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._window = RingWindow(config.window_m, config.resolution_m, CHANNELS)
        self._travelled_m = 0.0
        self._drift = Drift(0.0)
        self._last_xyz: list[float] = []
        self._feet_m = 0.0
        self._box = body_box(config)

    @property
    def spec(self) -> GridSpec:
        """Where the window lies."""
        return self._window.spec

    @property
    def moving_m(self) -> NDArray[np.float32]:
        """What moves in the newest sweep, (m, 2): not known on rough ground, where old hits only fade."""
        return np.zeros((0, 2), dtype=np.float32)

    def located(self, map_to_odom: Pose, robot: Pose) -> None:
        """Where SLAM says that `odom` lies in `map`; robot: its pose in `odom`. Only closures count: see `_forget`."""
        self._drift.close(map_to_odom, robot)

    def roll_to(self, x_m: float, y_m: float) -> bool:
        """Centre the window on a point. Returns whether it moved."""
        return self._window.roll_to(x_m, y_m)

    def integrate(self, cloud: PointCloud) -> int:
        """Add a sweep, seen from the window's centre. Returns how many of its points were not finite."""
        c, cells = self._config, self._window.cells
        base = base_in_odom(cloud.sensor_in_odom, cloud.sensor_in_base)
        first = not self._last_xyz
        self._move_to(base)
        self._forget()
        points_m = without_body(cloud.points_m, transform(cloud.sensor_in_base), self._box)
        reach_m = min(cloud.range_m, c.window_m * math.sqrt(0.5)) + c.resolution_m
        sweep, bad = read_sweep(points_m, transform(cloud.sensor_in_odom), c.resolution_m, reach_m)
        rules = self._rules(base, sweep.sensor)
        kind, ground = walk(sweep, upright(sweep, rules.step_m, rules.height_m), cells, rules)
        fuse_ground(sweep, kind, ground, cells, rules)
        lowest_m = max(c.knee_height_m, c.max_step_m) if c.risk_blind else c.max_step_m
        hit_now = add_hits(sweep, ground, lowest_m, c.clamp_log_odds, cells, rules)
        cells[hit_now, HIT_AT] = self._travelled_m
        clear_pierced(sweep, hit_now, cells, rules)
        join_rings(sweep, kind, ground, cells, rules)
        x, y = self._last_xyz[:2]
        stand_here(x, y, self._feet_m, c.footprint_radius_m, c.stand_sigma_m, cells, rules)
        if first:
            reach, slope = start_ground(sweep, kind, ground, c.start_radius_m, rules)
            x, y = float(sweep.sensor[0]), float(sweep.sensor[1])
            suppose_start(x, y, reach, slope, c.start_sigma_m, cells, rules)
        return bad

    def _move_to(self, base: NDArray[np.float64]) -> None:
        xyz = [float(v) for v in base[:3, 3]]
        if self._last_xyz:
            self._travelled_m += math.dist(xyz, self._last_xyz)
        self._last_xyz = xyz
        self._feet_m = xyz[2] - self._config.base_height_m
        self._drift.count(self._travelled_m)

    def _forget(self) -> None:
        """What was last seen too long before a closure does not lie where it seems to: it becomes unknown.

        Not the ground around the robot, up to where rays reach it: nothing would make it known again.
        """
        before_m = self._drift.keeps_from_m()
        if before_m == -math.inf:
            return
        cells = self._window.cells
        stands, old_hit = cells[..., LOG_ODDS] > 0.0, cells[..., HIT_AT] < before_m
        old_ground = (cells[..., VARIANCE] > 0.0) & (cells[..., TRAVELLED] < before_m)
        cells[np.where(stands, old_hit, old_ground & ~self._around_robot())] = 0.0

    def _around_robot(self) -> NDArray[np.bool_]:
        """(h, w) in memory's order: what is so near to the robot that the lowest ring passes over it."""
        s, (row0, column0) = self._window.spec, self._window.origin
        x_m, y_m = self._last_xyz[:2]
        dx = np.roll(s.centres_x(), column0) - x_m
        dy = np.roll(s.centres_y(), row0) - y_m
        near: NDArray[np.bool_] = dy[:, None] ** 2 + dx[None, :] ** 2 <= self._config.start_radius_m**2
        return near

    def _rules(self, base: NDArray[np.float64], sensor: NDArray[np.float64]) -> GroundRules:
        c, s = self._config, self._window.spec
        row0, column0 = self._window.origin
        lean_x, lean_y = _body_slope(base)
        offset_m = lean_x * (sensor[0] - base[0, 3]) + lean_y * (sensor[1] - base[1, 3])
        return GroundRules(
            resolution_m=s.resolution_m, ix0=s.ix0, iy0=s.iy0, row0=row0, column0=column0,
            travelled_m=self._travelled_m, feet_m=self._feet_m + float(offset_m), lean_x=lean_x, lean_y=lean_y,
            height_m=c.robot_height_m, step_m=c.max_step_m, slope=math.tan(c.max_slope_rad),
            range_sigma_m=c.range_sigma_m, angle_sigma_rad=c.angle_sigma_rad, drift_per_m=c.height_drift_per_m,
            max_gap_m=c.max_gap_m, fill_sigma_per_m=c.fill_sigma_per_m, pass_log_odds=c.pass_log_odds,
            hit_log_odds=c.hit_log_odds,
        )  # fmt: skip

    def apply_grid(self, grid: ReadyGrid, robot: Pose, only_new: bool) -> None:
        """Take over a ready grid: obstacles where it is occupied, supposed ground at the robot's feet where free."""
        known, evidence = grid_evidence(grid, self._window.spec, self._config.clamp_log_odds)
        rows, columns = np.nonzero(known)
        evidence = evidence[rows, columns]
        row0, column0 = self._window.origin
        height, width = self._window.spec.shape
        cells = self._window.cells[(rows + row0) % height, (columns + column0) % width]
        take = np.ones(len(rows), dtype=np.bool_)
        if only_new:
            take = (cells[:, LOG_ODDS] == 0.0) & (cells[:, VARIANCE] == 0.0) & (cells[:, HIT_WEIGHT] == 0.0)
        cells[take, LOG_ODDS] = evidence[take]
        for hits in (HIT_WEIGHT, HIT_X, HIT_Y):
            cells[take, hits] = 0.0
        cells[take, HIT_AT] = self._travelled_m
        bare = take & (evidence < 0.0) & (cells[:, VARIANCE] == 0.0)
        cells[bare, MEAN] = robot.z_m - self._config.base_height_m
        cells[bare, VARIANCE] = self._config.start_sigma_m**2
        cells[bare, TRAVELLED] = self._travelled_m
        self._window.cells[(rows + row0) % height, (columns + column0) % width] = cells

    def layers(self, robot: Pose) -> tuple[RiskLayers, NDArray[np.float32]]:
        """The risk layers and the ground's height, m; where it is unknown that of a near known cell."""
        c, s = self._config, self._window.spec
        obstacles, height_m, metrics, ground = self.metrics()
        limits = Limits(
            slope_rad=c.max_slope_rad, step_m=c.max_step_m, roughness_m=c.max_roughness_m, drop_m=c.max_drop_m,
            height_m=c.robot_height_m, limit_hazard_per_m=c.limit_hazard_per_m,
            full_hazard_per_m=c.collision_hazard_per_m, lethal_sigmas=c.lethal_sigmas,
            clamp_log_odds=c.clamp_log_odds, terrain=not c.risk_blind,
        )  # fmt: skip
        layers = hazard_layers(metrics, obstacles, limits, s.resolution_m, c.alpha, c.max_clearance_m)
        spread_heights(height_m, ground, robot.z_m - c.base_height_m)
        return layers, height_m

    def tops(self, ground_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Height of the ground or of what stands on it, (h, w) m."""
        return tops(self._window.cells, self._window.origin, ground_m, self._config.robot_height_m)

    def metrics(
        self,
    ) -> tuple[Obstacles, NDArray[np.float32], TerrainMetrics, NDArray[np.bool_]]:
        """What stands in each cell; the ground's height, its metrics, and whether it is known; (h, w) each."""
        c, res = self._config, self._window.spec.resolution_m
        g = grid_layers(
            self._window.cells, self._window.origin, self._travelled_m, c.height_drift_per_m, c.range_sigma_m
        )
        known = g.ground & ~g.blocked  # what lies at the foot of an obstacle is no ground to drive on
        close_holes(g.height_m, g.variance, known, g.blocked, c.max_step_m, c.fill_sigma_per_m * res)
        obstacles = Obstacles(g.log_odds, g.hit_x, g.hit_y, g.room_m, g.room_variance)
        metrics = terrain_metrics(
            Ground(g.height_m, g.variance, g.single, g.drift_m, known, g.bounded & ~known), res,
            c.footprint_radius_m, math.tan(c.max_slope_rad), c.step_reach_m, c.drop_reach_m,
        )  # fmt: skip
        return obstacles, g.height_m, metrics, g.ground

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "spec": list(self._window.spec),
            "cells": self._window.cells,
            "travelled_m": self._travelled_m,
            "last_xyz": self._last_xyz,
            "feet_m": self._feet_m,
            "drift": self._drift.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self._window.place(GridSpec(*state["spec"]), state["cells"])
        self._travelled_m = float(state["travelled_m"])
        self._last_xyz = list(state["last_xyz"])
        self._feet_m = float(state["feet_m"])
        self._drift.load(state["drift"])


def _body_slope(base: NDArray[np.float64]) -> tuple[float, float]:
    """Rise per metre along x and y of the plane that the robot stands on; none if it has fallen over."""
    up = base[:3, 2]
    return (float(-up[0] / up[2]), float(-up[1] / up[2])) if up[2] > 0.5 else (0.0, 0.0)

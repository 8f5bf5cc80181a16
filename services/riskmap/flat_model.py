"""Flat ground: obstacles alone, from sweeps swept at body height."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.sensing import PointCloud, ReadyGrid
from services.riskmap.collision import RiskLayers, collision_layers
from services.riskmap.config import Config
from services.riskmap.drift import Drift
from services.riskmap.extrinsics import body_box, transform, without_body
from services.riskmap.moving import MovingRules, moving_points, update_trust
from services.riskmap.occupancy import OccupancyWindow, integrate_sweep
from services.riskmap.ready_grid import apply_ready_grid
from services.riskmap.voids import SECTORS, mark_voids, read_sectors

_CERTAIN_SHARE = 0.75
"""Of the clamp: so sure a cell is free when it earns trust, after some six sweeps that passed it."""


class FlatModel:
    """Log-odds of obstacles in a rolling window (see `occupancy`)."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._window = OccupancyWindow(config.window_m, config.resolution_m)
        self._swept_ns = -1
        self._drift = Drift(config.odometry_memory_m)
        self._shows_ground = np.zeros(SECTORS, dtype=np.bool_)
        self.moving_m: NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)
        """What moves in the newest sweep (see `moving.moving_points`), (m, 2) m in odom."""

    @property
    def spec(self) -> GridSpec:
        """Where the window lies."""
        return self._window.spec

    def roll_to(self, x_m: float, y_m: float) -> bool:
        """Centre the window on a point. Returns whether it moved."""
        before = self._window.spec
        self._window.roll_to(x_m, y_m)
        return self._window.spec != before

    def integrate(self, cloud: PointCloud) -> int:
        """Add a sweep, seen from the window's centre. Returns how many of its points were not finite."""
        c, s, w = self._config, cloud.sensor_in_odom, self._window
        points_m = without_body(cloud.points_m, transform(cloud.sensor_in_base), body_box(c))
        heights = np.array([cloud.ground_z_m, c.ground_tolerance_m, c.robot_height_m, c.self_radius_m])
        evidence = np.array([c.hit_log_odds, c.pass_log_odds, c.clamp_log_odds])
        sensor = np.array([s.x_m, s.y_m, s.z_m, s.yaw_rad])
        self.moving_m = moving_points(
            points_m, sensor, self._moving_rules(cloud.ground_z_m), w.spec.resolution_m, w.spec.ix0, w.spec.iy0,
            w.trust_s,
        )  # fmt: skip
        touched = np.zeros(w.spec.shape, dtype=np.uint8)
        bad = integrate_sweep(
            points_m, sensor, heights, evidence, w.spec.resolution_m, w.spec.ix0, w.spec.iy0, w.log_odds,
            w.hit_weight, w.hit_x, w.hit_y, touched,
        )  # fmt: skip
        w.seen_at_m[touched > 0] = self._drift.drive(s.x_m, s.y_m)
        w.forget(self._drift.keeps_from_m())
        if c.void_range_m > 0.0:
            self._mark_voids(cloud, sensor)
        elapsed_s = (cloud.stamp_ns - self._swept_ns) / SECOND_NS if self._swept_ns >= 0 else 0.0
        self._swept_ns = cloud.stamp_ns
        update_trust(w.log_odds, elapsed_s, _CERTAIN_SHARE * c.clamp_log_odds, c.settle_s, w.trust_s)
        return bad

    def located(self, map_to_odom: Pose, robot: Pose) -> None:
        """Where SLAM says that `odom` lies in `map`; robot: its pose in `odom`."""
        self._drift.close(map_to_odom, robot)

    def _mark_voids(self, cloud: PointCloud, sensor: NDArray[np.float64]) -> None:
        c, w = self._config, self._window
        feet_m = cloud.ground_z_m - cloud.sensor_in_odom.z_m
        empty = read_sectors(
            cloud.points_m, feet_m - c.ground_tolerance_m, feet_m + c.ground_tolerance_m, self._shows_ground
        )
        near_m = c.footprint_radius_m + 2.0 * c.resolution_m
        mark_voids(
            empty, sensor, near_m, c.void_range_m, c.hit_log_odds, c.clamp_log_odds, c.free_log_odds,
            w.spec.resolution_m, w.spec.ix0, w.spec.iy0, w.log_odds, w.hit_weight, w.hit_x, w.hit_y,
        )  # fmt: skip

    def _moving_rules(self, ground_m: float) -> MovingRules:
        c = self._config
        return MovingRules(
            c.moving_range_m, ground_m + c.ground_tolerance_m, ground_m + c.robot_height_m, c.self_radius_m
        )

    def apply_grid(self, grid: ReadyGrid, robot: Pose, only_new: bool) -> None:
        """Take over a ready grid (see `ready_grid`)."""
        apply_ready_grid(grid, self._window, self._config.clamp_log_odds, only_new)

    def layers(self, robot: Pose) -> tuple[RiskLayers, NDArray[np.float32]]:
        """The risk layers and the ground's height, m: 0 everywhere."""
        c, w = self._config, self._window
        layers = collision_layers(
            w.log_odds, w.hit_x, w.hit_y, w.spec.resolution_m, c.free_log_odds, c.clamp_log_odds,
            c.collision_hazard_per_m, c.alpha, c.max_clearance_m,
        )  # fmt: skip
        return layers, np.zeros(w.spec.shape, dtype=np.float32)

    def tops(self, ground_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """None, (0, 0): heights are not known, and whatever stands blocks the sight."""
        return np.zeros((0, 0), dtype=np.float32)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        w = self._window
        return {
            "spec": list(w.spec),
            "layers": list(w.layers),
            "swept_ns": self._swept_ns,
            "shows": self._shows_ground,
            "drift": self._drift.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        w = self._window
        w.spec = GridSpec(*state["spec"])
        w.log_odds, w.hit_weight, w.hit_x, w.hit_y, w.trust_s, w.seen_at_m = state["layers"]
        self._drift.load(state["drift"])
        self._swept_ns = int(state["swept_ns"])
        self._shows_ground = state["shows"].copy()

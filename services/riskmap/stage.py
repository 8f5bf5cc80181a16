"""The riskmap stage: clouds or ready grids in, the risk belief around the robot out."""

from __future__ import annotations

import numpy as np

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.sensing import PointCloud
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import CLOUD, ODOMETRY, READY_GRID, RISK_MAP
from schemas.world import GridHeader, RiskMap
from services.riskmap.collision import collision_layers
from services.riskmap.config import Config
from services.riskmap.occupancy import OccupancyWindow, integrate_sweep
from services.riskmap.ready_grid import apply_ready_grid

__all__ = ["Config", "RiskMapStage", "create", "spec", "warm_up"]


def spec(config: Config) -> StageSpec:
    """How to run the stage: at the clouds' rate."""
    return StageSpec("riskmap", SECOND_NS // 10, latency_ns=SECOND_NS // 50)


def create(config: Config, setup: StageSetup) -> Stage:
    """A riskmap stage."""
    return RiskMapStage(config)


class RiskMapStage:
    """Integrates clouds as they come and publishes the risk map at its own period."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._window = OccupancyWindow(config.window_m, config.resolution_m)
        self._stamp_ns = -1
        self._published_ns = -(10**18)
        self._news = False
        self._pose = Pose()
        self.bad_points = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Read the newest cloud or grid; give the risk map when its period has passed and it has news."""
        odometry = inputs.latest(ODOMETRY)
        if odometry is not None:
            self._pose = odometry.message.pose
        for received in inputs.new(CLOUD):
            if received.age_ns <= self._config.cloud_timeout_s * SECOND_NS:
                self._news |= self._integrate(received.message)
        for grid in inputs.new(READY_GRID):
            self._window.roll_to(self._pose.x_m, self._pose.y_m)
            apply_ready_grid(grid.message, self._window, self._config.clamp_log_odds)
            self._stamp_ns = max(self._stamp_ns, grid.message.stamp_ns)
            self._news = True
        due = now - self._published_ns >= self._config.publish_period_s * SECOND_NS - SECOND_NS // 100
        if not self._news or not due:
            return []
        self._published_ns, self._news = now, False
        return [Output(RISK_MAP, self._risk_map())]

    def _integrate(self, cloud: PointCloud) -> bool:
        if cloud.points_m.shape[0] == 0 or cloud.stamp_ns <= self._stamp_ns:
            return False
        c, s = self._config, cloud.sensor_in_odom
        self._window.roll_to(s.x_m, s.y_m)
        w = self._window
        heights = np.array([cloud.ground_z_m, c.ground_tolerance_m, c.robot_height_m, c.self_radius_m])
        evidence = np.array([c.hit_log_odds, c.pass_log_odds, c.clamp_log_odds])
        self.bad_points += integrate_sweep(
            cloud.points_m, np.array([s.x_m, s.y_m, s.z_m, s.yaw_rad]), heights, evidence, w.spec.resolution_m,
            w.spec.ix0, w.spec.iy0, w.log_odds, w.hit_weight, w.hit_x, w.hit_y,
        )  # fmt: skip
        self._stamp_ns = cloud.stamp_ns
        return True

    def _risk_map(self) -> RiskMap:
        c, w = self._config, self._window
        layers = collision_layers(
            w.log_odds, w.hit_x, w.hit_y, w.spec.resolution_m, c.free_log_odds, c.clamp_log_odds,
            c.collision_hazard_per_m, c.cvar_alpha, c.max_clearance_m,
        )  # fmt: skip
        s = w.spec
        return RiskMap(
            stamp_ns=max(self._stamp_ns, 0),
            grid=GridHeader(
                resolution_m=s.resolution_m, ix0=s.ix0, iy0=s.iy0, width=s.width, height=s.height
            ),
            robot_pose=self._pose,
            footprint_radius_m=c.footprint_radius_m,
            elevation_m=np.zeros(s.shape, dtype=np.float32),
            **layers._asdict(),
        )

    def snapshot(self) -> bytes:
        """The evidence window and the stamps."""
        w = self._window
        return pack_snapshot(
            {
                "spec": list(w.spec),
                "layers": [w.log_odds, w.hit_weight, w.hit_x, w.hit_y],
                "stamps": [self._stamp_ns, self._published_ns],
                "news": self._news,
                "pose": self._pose.model_dump(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        w = self._window
        w.spec = GridSpec(*state["spec"])
        w.log_odds, w.hit_weight, w.hit_x, w.hit_y = state["layers"]
        self._stamp_ns, self._published_ns = state["stamps"]
        self._news = bool(state["news"])
        self._pose = Pose(**state["pose"])


def warm_up() -> None:
    """Compile the kernels."""
    stage = RiskMapStage(Config())
    points = np.array([[3.0, 0.5, -0.2], [5.0, 0.0, -0.8]], dtype=np.float32)
    cloud = PointCloud(stamp_ns=1, sensor_in_odom=Pose(z_m=0.8), range_m=20.0, points_m=points)
    stage._integrate(cloud)
    stage._risk_map()

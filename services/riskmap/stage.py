"""The riskmap stage: clouds or ready grids in, the risk belief around the robot out."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.sensing import Odometry, PointCloud, ReadyGrid
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import CLOUD, FOLLOWER, MOVING, ODOMETRY, READY_GRID, RISK_MAP
from schemas.world import GridHeader, MovingPoints, RiskMap
from services.riskmap.bumps import Bumps, stamp_bumps
from services.riskmap.collision import RiskLayers
from services.riskmap.config import Config
from services.riskmap.flat_model import FlatModel
from services.riskmap.terrain_model import TerrainModel

__all__ = ["Config", "RiskMapStage", "create", "spec", "warm_up"]

_FUTURE_NS = SECOND_NS // 2
"""A message stamped further ahead of the clock is wrong; taken, it would make every right one look old."""

_MOVING_POINTS = 8192


def spec(config: Config) -> StageSpec:
    """How to run the stage: at the clouds' rate."""
    return StageSpec("riskmap", SECOND_NS // 10, latency_ns=SECOND_NS // 50)


def create(config: Config, setup: StageSetup) -> Stage:
    """A riskmap stage."""
    return RiskMapStage(config)


class Model(Protocol):
    """A belief about the ground around the robot: the flat one or the terrain one."""

    @property
    def spec(self) -> GridSpec:
        """Where the window lies."""
        ...

    def roll_to(self, x_m: float, y_m: float) -> bool:
        """Centre the window on a point. Returns whether it moved."""
        ...

    def integrate(self, cloud: PointCloud) -> int:
        """Add a sweep. Returns how many of its points were not finite."""
        ...

    def located(self, map_to_odom: Pose, robot: Pose) -> None:
        """Where SLAM says that `odom` lies in `map`; robot: its pose in `odom`."""
        ...

    def apply_grid(self, grid: ReadyGrid, robot: Pose, only_new: bool) -> None:
        """Take over a ready grid; only_new: only where nothing is known yet."""
        ...

    def layers(self, robot: Pose) -> tuple[RiskLayers, NDArray[np.float32]]:
        """The risk layers and the ground's height."""
        ...

    def tops(self, ground_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Height of the ground or of what stands on it, (h, w); (0, 0) where heights are not known."""
        ...

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        ...

    @property
    def moving_m(self) -> NDArray[np.float32]:
        """What moves in the newest sweep, (m, 2) m in odom."""
        ...


class RiskMapStage:
    """Integrates clouds as they come and publishes the risk map at its own period.

    bad_points: points that were not finite. future_messages: clouds and grids dropped for their stamp.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._model: Model = TerrainModel(config) if config.model == "terrain" else FlatModel(config)
        self._cloud_ns = self._grid_ns = -1
        self._published_ns = -(10**18)
        self._news = False
        self._pose = Pose()
        self._grid: ReadyGrid | None = None
        self._bumps = Bumps(config.footprint_radius_m, int(config.bump_memory_s * SECOND_NS))
        self.bad_points = 0
        self.future_messages = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Read the newest cloud or grid; give the risk map when its period has passed and it has news.

        A ready grid that still counts is news in every period: it is all that there may be.
        """
        odometry = inputs.latest(ODOMETRY)
        if odometry is not None:
            self._pose = odometry.message.pose
            self._model.located(odometry.message.map_to_odom, self._pose)
            follower = inputs.current(FOLLOWER)
            blocked = follower is not None and follower.blocked
            self._bumps.observe(now, self._pose, odometry.message.speed_mps, blocked)
        self._drop_old_grid(now)
        found: Outputs = []
        for received in inputs.new(CLOUD):
            if received.age_ns <= self._config.cloud_timeout_s * SECOND_NS and self._timely(
                now, received.message
            ):
                taken = self._integrate(received.message)
                self._news |= taken
                if taken:
                    found.append(
                        Output(MOVING, MovingPoints(stamp_ns=self._cloud_ns, points_m=self._moving_m()))
                    )
        for grid in inputs.new(READY_GRID):
            if self._timely(now, grid.message):
                self._take_grid(grid.message)
        standing = not self._news and self._grid is not None
        due = now - self._published_ns >= self._config.publish_period_s * SECOND_NS - SECOND_NS // 100
        if not due or not (self._news or standing):
            return found
        stamp_ns = max(self._cloud_ns, self._grid_ns, 0)
        if standing:
            self._roll_to(self._pose)
            stamp_ns = max(stamp_ns, _stamp(odometry.message if odometry is not None else None, now))
        self._published_ns, self._news = now, False
        return [*found, Output(RISK_MAP, self._risk_map(now, stamp_ns))]

    def _timely(self, now: Stamp, message: PointCloud | ReadyGrid) -> bool:
        """Whether a message may be from now; counts it otherwise."""
        if message.stamp_ns <= now + _FUTURE_NS:
            return True
        self.future_messages += 1
        return False

    def _drop_old_grid(self, now: Stamp) -> None:
        timeout_ns = self._config.grid_timeout_s * SECOND_NS
        if self._grid is not None and 0.0 < timeout_ns < now - self._grid.stamp_ns:
            self._grid = None

    def _take_grid(self, grid: ReadyGrid) -> None:
        self._roll_to(self._pose)
        self._grid = grid
        self._model.apply_grid(grid, self._pose, only_new=False)
        self._grid_ns = max(self._grid_ns, grid.stamp_ns)
        self._news = True

    def _roll_to(self, pose: Pose) -> None:
        """Centre the window; the ground that enters it is looked up in the ready grid, if there is one."""
        if self._model.roll_to(pose.x_m, pose.y_m) and self._grid is not None:
            self._model.apply_grid(self._grid, self._pose, only_new=True)

    def _integrate(self, cloud: PointCloud) -> bool:
        if cloud.points_m.shape[0] == 0 or cloud.stamp_ns <= self._cloud_ns:
            return False
        self._roll_to(cloud.sensor_in_odom)
        self.bad_points += self._model.integrate(cloud)
        self._cloud_ns = cloud.stamp_ns
        return True

    def _moving_m(self) -> NDArray[np.float32]:
        """What moves, the nearest first where it is more than a message holds: those the robot has to brake for."""
        points_m = self._model.moving_m
        if len(points_m) <= _MOVING_POINTS:
            return points_m
        away_m = np.hypot(points_m[:, 0] - self._pose.x_m, points_m[:, 1] - self._pose.y_m)
        return points_m[np.argsort(away_m, kind="stable")[:_MOVING_POINTS]]

    def _risk_map(self, now: Stamp, stamp_ns: int) -> RiskMap:
        layers, elevation_m = self._model.layers(self._pose)
        s = self._model.spec
        stamp_bumps(layers, s, self._bumps.places(now), self._config.collision_hazard_per_m)
        return RiskMap(
            stamp_ns=stamp_ns,
            grid=GridHeader(**s._asdict()),
            robot_pose=self._pose,
            footprint_radius_m=self._config.footprint_radius_m,
            elevation_m=elevation_m,
            top_m=self._model.tops(elevation_m),
            **layers._asdict(),
        )

    def snapshot(self) -> bytes:
        """The belief, the ready grid, and the stamps."""
        return pack_snapshot(
            {
                "model": self._model.state(),
                "stamps": [self._cloud_ns, self._grid_ns, self._published_ns],
                "news": self._news,
                "pose": self._pose.model_dump(),
                "grid": None if self._grid is None else self._grid.model_dump(),
                "bumps": self._bumps.state(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._model.load(state["model"])
        self._cloud_ns, self._grid_ns, self._published_ns = state["stamps"]
        self._news = bool(state["news"])
        self._pose = Pose(**state["pose"])
        self._grid = None if state["grid"] is None else ReadyGrid(**state["grid"])
        self._bumps.load(state["bumps"])


def _stamp(odometry: Odometry | None, now: Stamp) -> Stamp:
    """When the robot was where it is said to be: of its odometry, else now."""
    return now if odometry is None else odometry.stamp_ns


def warm_up() -> None:
    """Compile the kernels of both models."""
    points = np.array([[3.0, 0.5, -0.2], [3.0, 0.0, -0.8], [3.6, 0.0, -0.8]], dtype=np.float32)
    cloud = PointCloud(stamp_ns=1, sensor_in_odom=Pose(z_m=0.8), range_m=20.0, points_m=points)
    grid = ReadyGrid(
        stamp_ns=1, resolution_m=0.1, origin_x_m=0.0, origin_y_m=0.0, height=1, width=1,
        occupancy=np.zeros((1, 1), dtype=np.int8),
    )  # fmt: skip
    for model in (FlatModel(Config(window_m=6.0)), TerrainModel(Config(model="terrain", window_m=6.0))):
        model.integrate(cloud)
        model.apply_grid(grid, Pose(), only_new=True)
        model.tops(model.layers(Pose())[1])

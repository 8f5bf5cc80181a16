"""What a caller of the `Explorer` gives: a grid or a cloud, and a pose. Checked, and turned into sensors' messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar, planar
from plgrim.errors import ExplorerInputError
from schemas.base import Pose as WirePose
from schemas.contract import Inputs, Output, Outputs, StageSpec, Stamp
from schemas.sensing import CoverageScan, FollowerState, Odometry, PointCloud, PoseGraph, ReadyGrid
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import CLOUD, COVERAGE_SCAN, FOLLOWER, ODOMETRY, POSE_GRAPH, READY_GRID

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of a cell, as in nav_msgs/OccupancyGrid; between 0 and 100 a percentage, more than 50 counts as occupied."""
NEVER_NS = 1 << 60
"""A period that never passes: the stages of an `Explorer` step on what arrives, and nothing else."""
FEED_SPEC = StageSpec("sim", NEVER_NS)
_MOST_CELLS = 20_000
_RECENT = 10
"""A look hangs on the nearest of so many newest keyframes."""
_POSE_VARIANCE = np.diag([1e-4, 1e-4, 1e-5])
"""The poses are taken as they are given, m2 and rad2."""


@dataclass(frozen=True, slots=True)
class Grid:
    """What is known of a map: cells (h, w), row 0 the lowest y, 0 free to 100 occupied, -1 unknown.

    resolution_m: side of a cell. origin_m: (x, y) of the lower left corner of cell (0, 0). Raises ExplorerInputError,
    with the name of the field, when something is wrong.
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0.005 < self.resolution_m <= 10.0:
            raise ExplorerInputError(
                f"grid.resolution_m: {self.resolution_m!r} is not in (0.005, 10] metres a cell"
            )
        object.__setattr__(self, "origin_m", _numbers("grid.origin_m", self.origin_m, (2,)))
        object.__setattr__(self, "cells", _occupancy(self.cells))

    @classmethod
    def of_values(
        cls,
        values: NDArray[Any],
        resolution_m: float,
        origin_m: tuple[float, float] = (0.0, 0.0),
        *,
        free: int,
        occupied: int,
        unknown: int,
    ) -> Grid:
        """A grid of another encoding: the three values that its cells have. Any other value is an error."""
        array = np.asarray(values)
        cells = np.full(array.shape, 2, np.int16)
        for value, code in ((unknown, UNKNOWN), (free, FREE), (occupied, OCCUPIED)):
            cells[array == value] = code
        wrong = np.flatnonzero(cells == 2)
        if wrong.size:
            found = array.ravel()[wrong[0]]
            raise ExplorerInputError(
                f"grid.values: {found!r} is neither free={free}, occupied={occupied} nor unknown={unknown}"
            )
        return cls(cells.astype(np.int8), resolution_m, origin_m)


@dataclass(frozen=True, slots=True)
class Cloud:
    """One sweep of a LiDAR: points_m (n, 3) in the sensor's frame, level, the sensor sensor_height_m above the pose.

    range_m: beyond it the sensor returns nothing.
    """

    points_m: NDArray[np.float32]
    range_m: float
    sensor_height_m: float = 0.8

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise ExplorerInputError(
                f"cloud.points_m: (n, 3) numbers are wanted, got {points.shape} of {points.dtype}"
            )
        if not 0.0 < self.range_m <= 1000.0:
            raise ExplorerInputError(f"cloud.range_m: {self.range_m!r} is not in (0, 1000] metres")
        object.__setattr__(self, "points_m", np.ascontiguousarray(points, np.float32))


class Pose(NamedTuple):
    """Where the robot is: m and rad, z up, yaw counter-clockwise from x (REP-103)."""

    x_m: float
    y_m: float
    yaw_rad: float
    z_m: float = 0.0


def checked_pose(pose: Sequence[float] | Pose) -> Pose:
    """(x, y, yaw) or (x, y, yaw, z) as a `Pose`. Raises ExplorerInputError."""
    if len(pose) not in (3, 4):
        raise ExplorerInputError(f"pose: (x, y, yaw) or (x, y, yaw, z) is wanted, got {len(pose)} numbers")
    x_m, y_m, yaw_rad, *z_m = _numbers("pose", tuple(pose), (3, 4))
    return Pose(x_m, y_m, math.remainder(yaw_rad, 2.0 * math.pi), *z_m)


def _numbers(name: str, values: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError) as error:
        raise ExplorerInputError(f"{name}: numbers are wanted, got {values!r}") from error
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise ExplorerInputError(
            f"{name}: {' or '.join(map(str, counts))} finite numbers are wanted: {values!r}"
        )
    return numbers


def _occupancy(cells: Any) -> NDArray[np.int8]:
    array = np.asarray(cells)
    if array.ndim != 2 or not 0 < min(array.shape) <= max(array.shape) <= _MOST_CELLS:
        raise ExplorerInputError(
            f"grid.cells: (h, w) of 1 to {_MOST_CELLS} cells a side is wanted, got {array.shape}"
        )
    if array.dtype.kind not in "iu":
        raise ExplorerInputError(f"grid.cells: whole numbers are wanted, got {array.dtype}")
    low, high = int(array.min()), int(array.max())
    if low < UNKNOWN or high > OCCUPIED:
        wrong = low if low < UNKNOWN else high
        raise ExplorerInputError(
            f"grid.cells: {wrong} is none of 0 free to 100 occupied, -1 unknown (Grid.of_values takes others)"
        )
    return np.ascontiguousarray(array, np.int8)


class Look(NamedTuple):
    """The coverage sensor. probability: that it detects what lies in its view."""

    range_m: float
    fov_rad: float
    probability: float


class GivenSensors:
    """Stands in the simulator's place: gives the stages what the caller has given, once a step.

    look: the coverage sensor; None: it does not look (what is known counts as covered).
    """

    def __init__(self, look: Look | None, keyframe_spacing_m: float) -> None:
        self._look, self._spacing_m = look, keyframe_spacing_m
        self._keyframes = np.empty((0, 4))
        self._seen: Grid | Cloud | None = None
        self._pose = Pose(0.0, 0.0, 0.0)
        self._speed_mps = 0.0
        self._blocked_on = (0, False)

    def give(self, seen: Grid | Cloud, pose: Pose, speed_mps: float, plan_id: int, blocked: bool) -> None:
        """What the next step tells. plan_id, blocked: of the plan that was followed."""
        self._seen, self._pose, self._speed_mps, self._blocked_on = seen, pose, speed_mps, (plan_id, blocked)

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Odometry, the follower's word, a new keyframe where there is one, the grid or cloud, and a look."""
        if self._seen is None:
            return []
        found = [Output(ODOMETRY, self._odometry(now)), Output(FOLLOWER, self._follower(now))]
        x, y = self._pose.x_m, self._pose.y_m
        last = self._keyframes[-1, :2].tolist() if len(self._keyframes) else (math.inf, math.inf)
        if math.dist(last, (x, y)) >= self._spacing_m:
            row = [x, y, self._pose.z_m, self._pose.yaw_rad]
            self._keyframes = np.vstack([self._keyframes, row])
            found.append(Output(POSE_GRAPH, self._pose_graph(now)))
        if isinstance(self._seen, Grid):
            found.append(Output(READY_GRID, _ready_grid(self._seen, now)))
        else:
            found.append(Output(CLOUD, self._cloud(self._seen, now)))
        if self._look is not None:
            found.append(Output(COVERAGE_SCAN, self._scan(self._look, now)))
        self._seen = None
        return found

    def _wire_pose(self) -> WirePose:
        p = self._pose
        return WirePose(x_m=p.x_m, y_m=p.y_m, z_m=p.z_m, yaw_rad=p.yaw_rad)

    def _odometry(self, now: Stamp) -> Odometry:
        return Odometry(
            stamp_ns=now, pose=self._wire_pose(), map_to_odom=WirePose(), speed_mps=self._speed_mps,
            turn_rate_radps=0.0, covariance=_POSE_VARIANCE,
        )  # fmt: skip

    def _follower(self, now: Stamp) -> FollowerState:
        plan_id, blocked = self._blocked_on
        return FollowerState(
            stamp_ns=now, plan_id=plan_id, progress_m=0.0, tracking_error_m=0.0, stuck=False, blocked=blocked,
            contacts=0,
        )  # fmt: skip

    def _pose_graph(self, now: Stamp) -> PoseGraph:
        count = len(self._keyframes)
        return PoseGraph(
            stamp_ns=now, revision=0, keyframe_id=np.arange(count), pose_in_map=self._keyframes,
            covariance=np.tile(np.diag(_POSE_VARIANCE), (count, 1)),
        )  # fmt: skip

    def _cloud(self, cloud: Cloud, now: Stamp) -> PointCloud:
        sensor = self._wire_pose().model_copy(update={"z_m": self._pose.z_m + cloud.sensor_height_m})
        return PointCloud(
            stamp_ns=now, sensor_in_odom=sensor, sensor_in_base=WirePose(z_m=cloud.sensor_height_m),
            ground_z_m=self._pose.z_m, range_m=cloud.range_m, points_m=cloud.points_m,
        )  # fmt: skip

    def _scan(self, look: Look, now: Stamp) -> CoverageScan:
        first = max(0, len(self._keyframes) - _RECENT)
        here = planar(self._pose)
        nearest = first + int(np.argmin(np.hypot(*(self._keyframes[first:, :2] - here[:2]).T)))
        x, y, _, yaw = self._keyframes[nearest].tolist()
        relative = Planar(x, y, yaw).inverse().compose(here)
        return CoverageScan(
            stamp_ns=now, keyframe_id=nearest, pose_in_odom=self._wire_pose(),
            pose_in_keyframe=WirePose(x_m=relative.x_m, y_m=relative.y_m, yaw_rad=relative.yaw_rad),
            range_m=look.range_m, fov_rad=look.fov_rad, detection_probability=look.probability,
        )  # fmt: skip

    def snapshot(self) -> bytes:
        """The keyframes; what was given last has been told."""
        return pack_snapshot({"keyframes": self._keyframes})

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        self._keyframes = unpack_snapshot(snapshot)["keyframes"]


def _ready_grid(grid: Grid, now: Stamp) -> ReadyGrid:
    return ReadyGrid(
        stamp_ns=now, resolution_m=grid.resolution_m, origin_x_m=grid.origin_m[0], origin_y_m=grid.origin_m[1],
        height=grid.cells.shape[0], width=grid.cells.shape[1], occupancy=grid.cells,
    )  # fmt: skip

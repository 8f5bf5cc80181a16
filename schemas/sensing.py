"""What the robot (or the simulator) tells the planner."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from schemas.base import Array, F32Points, Message, Pose, column
from schemas.errors import ValueRangeError


class PointCloud(Message):
    """One LiDAR sweep. Points that hit nothing are absent.

    points_m: (n, 3) x, y, z in the sensor's frame. sensor_in_odom: the sensor's pose in `odom` when the sweep was
    taken, extrinsics included (6 degrees of freedom). sensor_in_base: the extrinsics, the sensor's pose in base_link.
    range_m: beyond it the sensor returns nothing.
    """

    schema_name: ClassVar[str] = "point_cloud"
    schema_version: ClassVar[int] = 2

    sensor_in_odom: Pose
    sensor_in_base: Pose = Pose(z_m=0.8)
    ground_z_m: float = Field(0.0, description="Height of the ground under the robot in odom, m.")
    range_m: float = Field(gt=0, le=1000)
    points_m: F32Points


class ReadyGrid(Message):
    """An occupancy grid in `odom` that somebody else has built (nav_msgs/OccupancyGrid conventions).

    occupancy: (height, width) percent: 0 free to 100 occupied, -1 unknown; row 0 is the lowest y.
    """

    schema_name: ClassVar[str] = "ready_grid"

    resolution_m: float = Field(gt=0.005, le=10)
    origin_x_m: float
    origin_y_m: float
    height: int = Field(gt=0, le=20_000)
    width: int = Field(gt=0, le=20_000)
    occupancy: Annotated[Array, column("int8", "height", "width", minimum=-1, maximum=100)]


class Odometry(Message):
    """The robot's pose and speed, at 10 Hz or faster.

    pose: base_link in `odom`, continuous. map_to_odom: pose of the `odom` frame in `map` (REP-105); it jumps at a
    loop closure, the pose does not. covariance: (3, 3) of x, y, yaw in `map`.
    """

    schema_name: ClassVar[str] = "odometry"

    pose: Pose
    map_to_odom: Pose
    speed_mps: float = Field(ge=-20, le=20)
    turn_rate_radps: float = Field(ge=-20, le=20)
    covariance: Annotated[Array, column("float64", 3, 3)]


class PoseGraph(Message):
    """SLAM's keyframes, all of them. revision changes when a loop closure has moved keyframes.

    keyframe_id: (n,) increasing, each once: readers bisect it. pose_in_map: (n, 4) x, y, z, yaw. covariance: (n, 3)
    variances of x, y, yaw.
    """

    schema_name: ClassVar[str] = "pose_graph"

    revision: int = Field(ge=0)
    keyframe_id: Annotated[Array, column("int64", "n", minimum=0)]
    pose_in_map: Annotated[Array, column("float64", "n", 4)]
    covariance: Annotated[Array, column("float64", "n", 3, minimum=0)]

    @model_validator(mode="after")
    def _check_ids(self) -> PoseGraph:
        ids = self.keyframe_id
        wrong = np.flatnonzero(ids[1:] <= ids[:-1])
        if wrong.size:
            at = int(wrong[0]) + 1
            raise ValueRangeError(
                f"pose_graph.keyframe_id: entry {at} is {ids[at]} after {ids[at - 1]}; ids must increase"
            )
        return self


class CoverageScan(Message):
    """The coverage sensor has looked once.

    keyframe_id: the nearest keyframe; pose_in_keyframe: the sensor in that keyframe's frame. pose_in_odom: the same
    pose in odom, for the line of sight through the risk map; its z is that of the sensor.
    """

    schema_name: ClassVar[str] = "coverage_scan"

    keyframe_id: int = Field(ge=0)
    pose_in_odom: Pose
    pose_in_keyframe: Pose
    range_m: float = Field(gt=0, le=100)
    fov_rad: float = Field(gt=0, le=6.2831853072)
    detection_probability: float = Field(gt=0.5, lt=1)


class FollowerState(Message):
    """What the path follower reports back.

    plan_sequence: the plan that it follows (0: none). progress_m: arc length driven along it. blocked: contact, or
    the safety layer of the robot stopped it; stuck: commanded to move but did not.
    """

    schema_name: ClassVar[str] = "follower_state"

    plan_id: int = Field(ge=0)
    progress_m: float = Field(ge=0)
    tracking_error_m: float = Field(ge=0)
    stuck: bool
    blocked: bool
    contacts: int = Field(ge=0)

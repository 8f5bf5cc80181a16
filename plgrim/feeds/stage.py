"""A stage that plays a recording in the simulator's place, and one that stands for a mission that only looks on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from plgrim.feeds.recording import CLEARANCE_M, Moment, Recording
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, StageSpec, Stamp
from schemas.operation import FinishReason, MissionPhase, MissionState
from schemas.sensing import CoverageScan, Odometry, PointCloud, PoseGraph, ReadyGrid
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import CLOUD, COVERAGE_SCAN, MISSION, ODOMETRY, POSE_GRAPH, READY_GRID

FEED_SPEC = StageSpec("sim", SECOND_NS // 20)
ONLOOKER_SPEC = StageSpec("mission", SECOND_NS // 2)
_RECENT = 10
"""A look hangs on the nearest of so many newest keyframes."""
_GRID_M = 0.1
_POSE_VARIANCE = np.diag([1e-3, 1e-3, 1e-4])


class FeedStage:
    """Plays one recording. Writes the simulator's topics: odometry, pose graph, looks, and clouds or ready grids.

    keyframe_spacing_m: where the source names no keyframes. sensor: range (m) and field of view (rad) of the coverage
    sensor. Where only poses are known, the ground around the path is given as ready grids: driven means free.
    """

    def __init__(
        self, recording: Recording, keyframe_spacing_m: float = 1.0, sensor: tuple[float, float] = (6.0, 2.1)
    ) -> None:
        self._recording, self._spacing_m, self._sensor = recording, keyframe_spacing_m, sensor
        self._next = 0
        self._keyframes = np.empty((0, 4))
        self._published_ns = -(10**18)

    @property
    def keyframes(self) -> NDArray[np.float64]:
        """Keyframes so far, (n, 4): x, y, z, yaw in `map`."""
        return self._keyframes

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Everything up to now, and the odometry."""
        found: Outputs = []
        moments = self._recording.moments
        while self._next < len(moments) and moments[self._next].stamp_ns <= now:
            found += self._play(moments[self._next], now)
            self._next += 1
        if self._next:
            found.insert(0, Output(ODOMETRY, _odometry(moments[self._next - 1], now)))
        return found

    def _play(self, moment: Moment, now: Stamp) -> Outputs:
        found: Outputs = []
        if self._add_keyframe(moment):
            found.append(Output(POSE_GRAPH, self._pose_graph(now)))
        if moment.points_m is None:
            found.append(Output(READY_GRID, driven_ground(self._way_ahead(), now)))
        else:
            found.append(Output(CLOUD, self._cloud(moment, now)))
        found.append(Output(COVERAGE_SCAN, self._look(moment, now)))
        return found

    def _way_ahead(self) -> list[Planar]:
        """From here on, as far as the coverage sensor looks: ground that is going to be driven is free by now."""
        moments = self._recording.moments
        way: list[Planar] = []
        left_m = self._sensor[0]
        for moment in moments[self._next :]:
            if way:
                left_m -= math.dist(way[-1][:2], moment.odom[:2])
                if moment.jumped or left_m < 0.0:
                    break
            way.append(moment.odom)
        return way

    def _add_keyframe(self, moment: Moment) -> bool:
        due = moment.keyframe
        if due is None:
            due = not len(self._keyframes) or (
                math.dist(self._keyframes[-1, :2].tolist(), moment.map[:2]) >= self._spacing_m
            )
        if due or not len(self._keyframes):
            x, y, yaw = moment.map
            self._keyframes = np.vstack([self._keyframes, [x, y, moment.z_m, yaw]])
            return True
        return False

    def _pose_graph(self, now: Stamp) -> PoseGraph:
        count = len(self._keyframes)
        return PoseGraph(
            stamp_ns=now,
            revision=0,
            keyframe_id=np.arange(count),
            pose_in_map=self._keyframes,
            covariance=np.tile(np.diag(_POSE_VARIANCE), (count, 1)),
        )

    def _cloud(self, moment: Moment, now: Stamp) -> PointCloud:
        assert moment.points_m is not None
        x, y, yaw = moment.odom
        height_m = self._recording.sensor_height_m
        return PointCloud(
            stamp_ns=now,
            sensor_in_odom=Pose(x_m=x, y_m=y, z_m=height_m, yaw_rad=yaw),
            sensor_in_base=Pose(z_m=height_m),
            range_m=self._recording.range_m,
            points_m=moment.points_m,
        )

    def _look(self, moment: Moment, now: Stamp) -> CoverageScan:
        first = max(0, len(self._keyframes) - _RECENT)
        away = np.hypot(*(self._keyframes[first:, :2] - moment.map[:2]).T)
        nearest = first + int(np.argmin(away))
        x, y, _, yaw = self._keyframes[nearest].tolist()
        range_m, fov_rad = self._sensor
        return CoverageScan(
            stamp_ns=now,
            keyframe_id=nearest,
            pose_in_odom=_pose(moment.odom).model_copy(update={"z_m": self._recording.sensor_height_m}),
            pose_in_keyframe=_pose(Planar(x, y, yaw).inverse().compose(moment.map)),
            range_m=range_m,
            fov_rad=fov_rad,
            detection_probability=0.95,
        )

    def snapshot(self) -> bytes:
        """How far it has come."""
        return pack_snapshot({"next": self._next, "keyframes": self._keyframes})

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot of a feed of the same recording."""
        state = unpack_snapshot(snapshot)
        self._next, self._keyframes = state["next"], state["keyframes"]


class Onlooker:
    """A mission that sends the robot nowhere: paused, so that no frontier is given up as one that was pursued."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """The state, every time."""
        state = MissionState(
            stamp_ns=now, phase=MissionPhase.PAUSED, finish=FinishReason.NONE, reason="fed from a file",
            elapsed_s=now / SECOND_NS, time_budget_s=0.0, distance_m=0.0, return_distance_m=0.0, home=Pose(),
            coverage=0.0, left=[],
        )  # fmt: skip
        return [Output(MISSION, state)]

    def snapshot(self) -> bytes:
        """Nothing."""
        return b""

    def restore(self, snapshot: bytes) -> None:
        """Nothing."""


def driven_ground(way: list[Planar], now: Stamp) -> ReadyGrid:
    """What driving along a way says of the ground: free within `CLEARANCE_M` of it, nothing else known."""
    points = np.array([place[:2] for place in way])
    low = np.floor((points.min(axis=0) - CLEARANCE_M) / _GRID_M).astype(int) - 1
    high = np.ceil((points.max(axis=0) + CLEARANCE_M) / _GRID_M).astype(int) + 1
    x = (np.arange(low[0], high[0]) + 0.5) * _GRID_M
    y = (np.arange(low[1], high[1]) + 0.5)[:, None] * _GRID_M
    free = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.bool_)
    for a, b in zip(points, points[1:] if len(points) > 1 else points, strict=False):
        dx, dy = b - a
        along = np.clip(((x - a[0]) * dx + (y - a[1]) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        free |= np.hypot(x - a[0] - along * dx, y - a[1] - along * dy) <= CLEARANCE_M
    return ReadyGrid(
        stamp_ns=now,
        resolution_m=_GRID_M,
        origin_x_m=float(low[0] * _GRID_M),
        origin_y_m=float(low[1] * _GRID_M),
        height=free.shape[0],
        width=free.shape[1],
        occupancy=np.where(free, 0, -1).astype(np.int8),
    )


def _odometry(moment: Moment, now: Stamp) -> Odometry:
    return Odometry(
        stamp_ns=now,
        pose=_pose(moment.odom),
        map_to_odom=_frame(moment),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=_POSE_VARIANCE,
    )


def _frame(moment: Moment) -> Pose:
    """Pose of `odom` in `map`: exactly nothing where both are the same."""
    same = moment.odom == moment.map
    return Pose() if same else _pose(moment.map.compose(moment.odom.inverse()))


def _pose(at: Planar) -> Pose:
    return Pose(x_m=at.x_m, y_m=at.y_m, yaw_rad=at.yaw_rad)

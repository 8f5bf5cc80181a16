"""A robot in a corridor that irm has never heard of before: steps that use every kernel, for `warm_up`."""

from __future__ import annotations

import numpy as np

from planning.footprint import clearance_m
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Stage, Topic
from schemas.rehearsal import heard
from schemas.sensing import CoverageScan, FollowerState, Odometry, PoseGraph
from schemas.topics import COVERAGE_SCAN, FOLLOWER, ODOMETRY, POSE_GRAPH, RISK_MAP
from schemas.world import GridHeader, RiskMap

_GRIDS = (GridSpec(0.2, -40, -40, 80, 80), GridSpec(0.2, -39, -40, 80, 80))
"""One begins at an odd column: what is cut from its arrays is not contiguous, and another type to numba."""
_RANGE_M, _FOV_RAD = 3.0, 2.0
_STEPS = 5


def rehearse(stage: Stage) -> None:
    """Step it along the corridor, over a loop closure, past a blocked place, with and without heights."""
    for k in range(_STEPS):
        now, x_m = (k + 1) * SECOND_NS, 0.8 * k
        risk = _corridor(now, x_m, _GRIDS[k // 2 % 2], heights=k % 2 == 1)
        stage.step(now, heard((RISK_MAP, risk), *_said(now, x_m, closed=k >= 3)))


def _said(now: int, x_m: float, closed: bool) -> list[tuple[Topic[Message], Message]]:
    here = Pose(x_m=x_m, z_m=0.8)
    keyframes = np.zeros((2, 4))
    keyframes[1, 0] = 1.1 if closed else 1.0
    graph = PoseGraph(
        stamp_ns=now, revision=int(closed), keyframe_id=np.arange(2), pose_in_map=keyframes,
        covariance=np.full((2, 3), 0.01),
    )  # fmt: skip
    scan = CoverageScan(
        stamp_ns=now, keyframe_id=0, pose_in_odom=here, pose_in_keyframe=here, range_m=_RANGE_M,
        fov_rad=_FOV_RAD, detection_probability=0.95,
    )  # fmt: skip
    follower = FollowerState(
        stamp_ns=now, plan_id=1, progress_m=0.0, tracking_error_m=0.0, stuck=False, blocked=closed, contacts=0
    )
    odometry = Odometry(
        stamp_ns=now, pose=Pose(x_m=x_m), map_to_odom=Pose(x_m=0.1 if closed else 0.0), speed_mps=0.8,
        turn_rate_radps=0.0, covariance=np.diag([1e-4, 1e-4, 1e-4]),
    )  # fmt: skip
    return [(POSE_GRAPH, graph), (COVERAGE_SCAN, scan), (FOLLOWER, follower), (ODOMETRY, odometry)]


def _corridor(now: int, x_m: float, spec: GridSpec, heights: bool) -> RiskMap:
    """3 m wide, from 3 m behind the start to as far as was seen; a pillar stands in it."""
    x, y = np.meshgrid(spec.centres_x(), spec.centres_y())
    known = (x > -3.0) & (x < x_m + 3.0) & (np.abs(y) < 1.9)
    solid = known & ((np.abs(y) > 1.5) | (np.hypot(x - 3.0, y - 0.8) < 0.3))
    state = np.where(solid, LETHAL, np.where(known, FREE, UNKNOWN)).astype(np.uint8)
    hazard = np.where(solid, 2.0, np.where(known, 0.01, 1.0)).astype(np.float32)
    zero = np.zeros(spec.shape, np.float32)
    return RiskMap(
        stamp_ns=now,
        grid=GridHeader(**spec._asdict()),
        robot_pose=Pose(x_m=x_m),
        footprint_radius_m=0.25,
        state=state,
        hazard_mean=hazard,
        hazard_variance=zero,
        hazard_cvar=hazard,
        clearance_m=clearance_m(solid, None, None, spec),
        elevation_m=zero,
        top_m=solid.astype(np.float32) if heights else np.zeros((0, 0), np.float32),
    )

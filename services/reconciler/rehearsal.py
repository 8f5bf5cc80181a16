"""A robot on open ground that the reconciler has never heard of before: steps that use every kernel, for `warm_up`."""

from __future__ import annotations

import numpy as np

from planning.coverage_build import lattice_steps
from planning.footprint import clearance_m
from planning.grid import DIRECTION_DX, DIRECTION_DY, FREE, LETHAL, GridSpec
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Outputs, Stage, Topic
from schemas.operation import FinishReason, MissionPhase, MissionState
from schemas.policy import EpisodeRequest, LocalPhase, LocalPolicy
from schemas.rehearsal import heard
from schemas.sensing import Odometry
from schemas.topics import EPISODE, LOCAL_IRM, LOCAL_POLICY, MISSION, ODOMETRY, RISK_MAP
from schemas.world import GridHeader, LocalIrm, RiskMap

_GRID = GridSpec(0.2, -60, -60, 120, 120)
_SIZE = 15
_STEPS = 40
_PERIOD_NS = SECOND_NS // 10


def rehearse(stage: Stage) -> None:
    """Four seconds along a line of nodes, each episode answered at once; then a wall stands across the path."""
    answer: list[tuple[Topic[Message], Message]] = []
    for k in range(1, _STEPS + 1):
        now, x_m = k * _PERIOD_NS, 0.5 + 0.08 * k
        said = [*_said(now, x_m, blocked=k > _STEPS - 5), *answer]
        answer = _answers(stage.step(now, heard(*said)), now)


def _answers(found: Outputs, now: int) -> list[tuple[Topic[Message], Message]]:
    return [
        (LOCAL_POLICY, _policy(output.message, now))
        for output in found
        if output.topic.name == EPISODE.name and isinstance(output.message, EpisodeRequest)
    ]


def _said(now: int, x_m: float, blocked: bool) -> list[tuple[Topic[Message], Message]]:
    mission = MissionState(
        stamp_ns=now, phase=MissionPhase.EXPLORE, finish=FinishReason.NONE, reason="", elapsed_s=0.0,
        time_budget_s=0.0, distance_m=0.0, return_distance_m=0.0, home=Pose(), coverage=0.0, left=[],
    )  # fmt: skip
    odometry = Odometry(
        stamp_ns=now, pose=Pose(x_m=x_m, y_m=0.5), map_to_odom=Pose(), speed_mps=0.8, turn_rate_radps=0.0,
        covariance=np.diag([1e-4, 1e-4, 1e-4]),
    )  # fmt: skip
    return [
        (MISSION, mission),
        (ODOMETRY, odometry),
        (RISK_MAP, _ground(now, x_m, blocked)),
        (LOCAL_IRM, _irm(now)),
    ]


def _ground(now: int, x_m: float, blocked: bool) -> RiskMap:
    """Free, but for a post beside the path, and a wall across it when it is blocked."""
    x, y = np.meshgrid(_GRID.centres_x(), _GRID.centres_y())
    solid = np.hypot(x - 2.5, y - 1.3) < 0.3
    if blocked:
        solid |= (np.abs(x - x_m - 1.5) < 0.3) & (np.abs(y - 1.5) < 2.5)
    hazard = np.where(solid, 2.0, 0.01).astype(np.float32)
    zero = np.zeros(_GRID.shape, np.float32)
    return RiskMap(
        stamp_ns=now,
        grid=GridHeader(**_GRID._asdict()),
        robot_pose=Pose(x_m=x_m, y_m=0.5),
        footprint_radius_m=0.25,
        state=np.where(solid, LETHAL, FREE).astype(np.uint8),
        hazard_mean=hazard,
        hazard_variance=zero,
        hazard_cvar=hazard,
        clearance_m=clearance_m(solid, None, None, _GRID),
        elevation_m=zero,
        top_m=np.zeros((0, 0), np.float32),
    )


def _irm(now: int) -> LocalIrm:
    """All traversable, nothing covered; node (7, 7) in the middle lies at (0.5, 0.5)."""
    half, n = _SIZE // 2, _SIZE * _SIZE
    column, row = np.arange(n) % _SIZE, np.arange(n) // _SIZE
    lengths = np.hypot(DIRECTION_DX, DIRECTION_DY)
    edges = np.where(lattice_steps(_SIZE) >= 0, lengths, 0.0).astype(np.float32)
    return LocalIrm(
        stamp_ns=now, irm_version=1, risk_stamp_ns=now, spacing_m=1.0, ix0=-half, iy0=-half, size=_SIZE,
        robot_pose=Pose(), map_to_odom=Pose(), sensor_range_m=2.0, sensor_fov_rad=2.0, reach=2,
        state=np.ones(n, np.uint8), anchor_m=np.stack([column - half + 0.5, row - half + 0.5], axis=1),
        node_risk=np.full(n, 0.01, np.float32), coverage=np.full(n, 0.5, np.float32),
        entropy=np.full(n, 0.69, np.float32), edge_distance_m=edges, edge_risk=0.01 * edges,
        bent_edge=np.zeros(0, np.int32), bent_start=np.zeros(1, np.int32), bent_xy=np.zeros((0, 2), np.float32),
        visible=np.full((n, 5), 0b11111, np.uint32),
    )  # fmt: skip


def _policy(request: EpisodeRequest, now: int) -> LocalPolicy:
    """Straight on from the junction, to the last node of the row, with a corner in it."""
    half, node = _SIZE // 2, int(request.particle_node[0])
    first, row = node % _SIZE - half, node // _SIZE - half
    columns = np.arange(first, half + 1, dtype=np.int32)
    lattice = np.stack([columns, np.where(columns > first + 3, row + 1, row)], axis=1).astype(np.int32)
    k = len(lattice)
    return LocalPolicy(
        stamp_ns=now, episode=request.episode, irm_version=request.irm_version, phase=LocalPhase.COVER, reason="",
        target=-1, root_value=1.2, rollout_value=1.0, simulations=0, tree_nodes=1, planning_ms=0.0,
        path_lattice=lattice, path_reward=np.ones(k), path_in_tree=np.ones(k, np.uint8),
        path_look=np.zeros(k, np.uint8), path_xy_m=lattice + 0.5, path_node_point=np.arange(k, dtype=np.int32),
        tree_action=np.zeros(1, np.int32), tree_value=np.ones(1), tree_visits=np.ones(1, np.int32),
        child_start=np.zeros(2, np.int32), child_node=np.zeros(0, np.int32),
        child_observation=np.zeros(0, np.int32),
    )  # fmt: skip

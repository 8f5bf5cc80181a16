"""A mission to look at: messages of every kind that the page shows, of a stated size, moving with a number."""

from __future__ import annotations

import math

import numpy as np

from schemas.base import Message, Pose
from schemas.operation import FinishReason, MissionPhase, MissionState, StageHealth
from schemas.policy import Alternative, GlobalPolicy, Plan, SafetyState
from schemas.sensing import Odometry
from schemas.topics import SERVICES
from schemas.world import CoverageSummary, CoverageWindow, GlobalIrm, GridHeader, LocalIrm, RiskMap
from services.status.app import SharedStatus

FRAME = Pose(x_m=1.0, y_m=-0.5, yaw_rad=0.05)
GRAPH_SIDE = 72


def pose_at(n: int) -> Pose:
    """Where the robot is at step n, in `odom`: round a circle of 12 m."""
    angle = 0.02 * n
    return Pose(x_m=12 * math.cos(angle), y_m=12 * math.sin(angle), yaw_rad=angle + math.pi / 2)


def odometry(n: int) -> Odometry:
    """x and y of 0.3 m and 0.15 m, correlated."""
    covariance = np.array([[0.09, 0.03, 0.0], [0.03, 0.0225, 0.0], [0.0, 0.0, 0.01]])
    return Odometry(
        stamp_ns=n * 10**8, pose=pose_at(n), map_to_odom=FRAME, speed_mps=0.8, turn_rate_radps=0.05,
        covariance=covariance,
    )  # fmt: skip


def risk_map(n: int, cells: int = 200, resolution_m: float = 0.2) -> RiskMap:
    """Walls every 8 m with gaps, low hazard between them, unknown in one corner."""
    y, x = np.mgrid[0:cells, 0:cells] * resolution_m
    wall = ((x % 8 < 0.4) & (y % 8 > 2)) | ((y % 8 < 0.4) & (x % 8 > 2))
    state = np.where(wall, 2, 1).astype(np.uint8)
    state[(x + y) > 1.7 * cells * resolution_m] = 0
    hazard = (0.3 * np.exp(-np.minimum(x % 8, y % 8)) * (1 + 0.2 * np.sin(n + x))).astype(np.float32)
    half = -cells // 2
    grid = GridHeader(resolution_m=resolution_m, ix0=half, iy0=half, width=cells, height=cells)
    return RiskMap(
        stamp_ns=n * 10**8, grid=grid, robot_pose=pose_at(n), footprint_radius_m=0.45, state=state,
        hazard_mean=hazard, hazard_variance=hazard, hazard_cvar=hazard, clearance_m=np.ones_like(hazard),
        elevation_m=np.zeros_like(hazard), top_m=np.zeros((0, 0), np.float32),
    )  # fmt: skip


def coverage_window(cells: int = 400, resolution_m: float = 0.2) -> CoverageWindow:
    """Covered in the middle, to cover round it, obstacles as in the risk map."""
    y, x = (np.mgrid[0:cells, 0:cells] - cells // 2) * resolution_m
    cell = np.where(np.hypot(x, y) < 18, 2, np.where(np.hypot(x, y) < 30, 1, 0)).astype(np.uint8)
    wall = ((x % 8 < 0.4) & (y % 8 > 2)) | ((y % 8 < 0.4) & (x % 8 > 2))
    cell[wall & (cell > 0)] = 3
    grid = GridHeader(resolution_m=resolution_m, ix0=-cells // 2, iy0=-cells // 2, width=cells, height=cells)
    return CoverageWindow(stamp_ns=0, grid=grid, cell=cell)


def graph(side: int = GRAPH_SIDE, spacing_m: float = 1.0) -> GlobalIrm:
    """A lattice of side x side nodes, 4-connected; every tenth of the border is a frontier."""
    i = np.arange(side * side)
    x, y = (i % side - side / 2) * spacing_m, (i // side - side / 2) * spacing_m
    border = (i % side == 0) | (i % side == side - 1) | (i // side == 0) | (i // side == side - 1)
    east, north = i[i % side < side - 1], i[i // side < side - 1]
    a = np.concatenate((east, north)).astype(np.int64)
    b = np.concatenate((east + 1, north + side)).astype(np.int64)
    frontier = border & (i % 10 == 0)
    return GlobalIrm(
        stamp_ns=0, irm_version=1, base_version=0, robot_pose=Pose(), map_to_odom=FRAME, robot_node=1,
        node_id=i.astype(np.int64), node_kind=frontier.astype(np.uint8),
        node_xyz_m=np.column_stack((x, y, 0 * x)), node_gain=np.where(frontier, 20.0, 0.0),
        node_coverage=np.ones(i.size, np.float32), edge_a=a, edge_b=b,
        edge_distance_m=np.full(a.size, spacing_m), edge_risk=np.full(a.size, 0.05),
        edge_driven=(a % 7 == 0).astype(np.uint8), removed_node=np.empty(0, np.int64),
        removed_edge=np.empty((0, 2), np.int64),
    )  # fmt: skip


def local_irm(size: int = 41) -> LocalIrm:
    """A lattice that is open everywhere."""
    count = size * size
    rows, columns = np.divmod(np.arange(count), size)
    anchor = np.column_stack((columns - size // 2, rows - size // 2)).astype(np.float64)
    distance = np.ones((count, 8), np.float32)
    return LocalIrm(
        stamp_ns=0, irm_version=1, risk_stamp_ns=0, spacing_m=1.0, ix0=-(size // 2), iy0=-(size // 2), size=size,
        robot_pose=Pose(), map_to_odom=FRAME, sensor_range_m=6.0, sensor_fov_rad=6.28, reach=0,
        state=np.ones(count, np.uint8), anchor_m=anchor, node_risk=np.zeros(count, np.float32),
        coverage=np.where(columns > size // 2, 0.5, 0.95).astype(np.float32),
        entropy=np.zeros(count, np.float32), edge_distance_m=distance, edge_risk=0.01 * distance,
        bent_edge=np.empty(0, np.int32), bent_start=np.zeros(1, np.int32),
        bent_xy=np.empty((0, 2), np.float32), visible=np.ones((count, 1), np.uint32),
    )  # fmt: skip


def policy(n: int) -> GlobalPolicy:
    """Every node around the robot points east; the target changes every 100 steps."""
    i = np.arange(0, 60) + 30 * GRAPH_SIDE + 5
    xyz = np.column_stack((i % GRAPH_SIDE - GRAPH_SIDE / 2, i // GRAPH_SIDE - GRAPH_SIDE / 2, 0.0 * i))
    target = 41 + n // 100
    chosen = Alternative(frontier=target, x_m=20.0, y_m=9.0, gain=38.0, distance_m=12.4, risk=0.02, q=30.0)
    return GlobalPolicy(
        stamp_ns=n * 10**8, irm_version=1, target=target, target_xyz_m=(20.0, 9.0, 0.0), target_gain=38.0,
        target_q=30.0, target_distance_m=12.4, target_risk=0.02, switched=False, reason="highest value",
        alternatives=[chosen], map_to_odom=FRAME, node_id=i, node_xyz_m=xyz, action=i + 1,
        value=np.ones(i.size), value_to_go=np.ones(i.size), path_node=i[:2], path_xyz_m=xyz[:2],
        path_piece=np.zeros(2, np.int32),
        route_xyz_m=np.array([[13.0, 0.0, 0.0], [16.0, 5.0, 0.0], [20.0, 9.0, 0.0]]),
    )  # fmt: skip


def plan(n: int) -> Plan:
    """Ahead along the circle; every 50 steps it turns off elsewhere, keeping eight points."""
    out = np.arange(20) * 0.5
    turn = 0.06 if (n // 50) % 2 else -0.08
    heading = pose_at(n).yaw_rad + turn * np.maximum(np.arange(20) - 8, 0)
    x = pose_at(n).x_m + np.cumsum(0.5 * np.cos(heading))
    y = pose_at(n).y_m + np.cumsum(0.5 * np.sin(heading))
    return Plan(
        stamp_ns=n * 10**8, plan_id=1 + n // 50, episode=1 + n // 50, valid=True, safety=SafetyState.RUN, reason="",
        tau_s=3.0, kept_points=8, ttl_s=1.5, risk_stamp_ns=0, x_m=x, y_m=y, yaw_rad=heading,
        speed_mps=np.ones(20), time_s=out,
    )  # fmt: skip


def mission(n: int, phase: MissionPhase = MissionPhase.EXPLORE) -> MissionState:
    """0.1 s a step."""
    elapsed_s = 0.1 * n
    return MissionState(
        stamp_ns=n * 10**8, phase=phase, finish=FinishReason.NONE, reason="", elapsed_s=elapsed_s,
        time_budget_s=1800.0, distance_m=0.8 * elapsed_s, return_distance_m=13.0, home=Pose(),
        coverage=min(1.0, elapsed_s / 600), left=[],
    )  # fmt: skip


def health(service: str, pid: int = 7, **changes: object) -> StageHealth:
    """A service that works."""
    base = StageHealth(
        stamp_ns=0, service=service, ready=True, steps=9, step_p50_ms=4.0 + len(service), step_p99_ms=20.0,
        rate_hz=2.0, memory_mb=120.0, pid=pid, errors=0, last_error="", dropped={}, waiting_for=[],
    )  # fmt: skip
    return base.model_copy(update=changes)


def summary(n: int) -> CoverageSummary:
    """Grows with the mission."""
    return CoverageSummary(
        stamp_ns=n * 10**8, irm_version=1, reachable_area_m2=1200.0, covered_area_m2=min(1200.0, 0.2 * n),
        covered_fraction=min(1.0, n / 6000), entropy_left=50.0, frontiers=28, frontier_gain=300.0,
        breadcrumbs=5000, settled=False, unreachable_xy_m=np.empty((0, 2)), unreachable_gain=np.empty(0),
        unreachable_reason=[],
    )  # fmt: skip


class Scene:
    """Shows a shared status one step after the other, ten steps a second."""

    def __init__(self, shared: SharedStatus, risk_cells: int = 200, graph_side: int = GRAPH_SIDE) -> None:
        self.shared = shared
        self.risk_cells = risk_cells
        self.n = 0
        self.phase = MissionPhase.EXPLORE
        self.still: list[tuple[str, Message]] = [
            ("irm/coverage_window", coverage_window()),
            ("irm/global_irm", graph(graph_side)),
        ]

    def step(self) -> None:
        """One step of 0.1 s: slow topics every tenth."""
        n, show = self.n, self.shared.observe
        if n == 0:
            for name, message in self.still:
                show(name, message)
        show("sim/odometry", odometry(n))
        if n % 2 == 0:
            show("riskmap/risk_map", risk_map(n, self.risk_cells))
            show("reconciler/plan", plan(n))
        if n % 5 == 0:
            show("mission/state", mission(n, self.phase))
            show("irm/local_irm", local_irm())
            for service in SERVICES:
                show(f"{service}/health", health(service))
        if n % 10 == 0:
            show("irm/coverage", summary(n))
            show("gcp/global_policy", policy(n))
        self.n += 1

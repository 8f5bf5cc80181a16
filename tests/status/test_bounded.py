"""A long mission in small: what the status remembers stays bounded however long it is fed."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from schemas.base import Pose
from schemas.operation import CommandAnswer, CommandKind, MissionPhase
from schemas.world import CoverageWindow, GlobalIrm, GridHeader
from services.status.app import LiveStatus, SharedStatus
from services.status.config import Config
from tests.status import scene

_CRUMBS = 200


def _difference(version: int) -> GlobalIrm:
    """A breadcrumb goes and another comes, two frontiers go and two come: ids grow, the graph does not."""
    first = 3 * version - 2
    old = [n for n in (first - 2, first - 1, first - 3 * _CRUMBS) if n > 0]
    node_id = np.array([first, first + 1, first + 2])
    links = [(first - 3, first)] if version > 1 else []
    edges = np.array([*links, (first, first + 1), (first, first + 2)])
    x_m = 0.02 * (version % 5000)
    return GlobalIrm(
        stamp_ns=0, irm_version=version, base_version=version - 1, robot_pose=Pose(), map_to_odom=scene.FRAME,
        robot_node=first, node_id=node_id, node_kind=np.array([0, 1, 1], np.uint8),
        node_xyz_m=np.array([[x_m, 0.0, 0.0]] * 3), node_gain=np.array([0.0, 9.0, 9.0]),
        node_coverage=np.ones(3, np.float32), edge_a=edges[:, 0], edge_b=edges[:, 1],
        edge_distance_m=np.ones(len(edges)), edge_risk=np.zeros(len(edges)),
        edge_driven=np.ones(len(edges), np.uint8), removed_node=np.array(old, np.int64),
        removed_edge=np.empty((0, 2), np.int64),
    )  # fmt: skip


def _feed(shared: SharedStatus, n: int, cell: np.ndarray) -> None:
    """Step n of a mission that goes round and round in a place of 100 m."""
    x_m = abs(0.1 * (n % 2000) - 100)
    pose = Pose(x_m=x_m, y_m=0.0, yaw_rad=0.0)
    shared.observe("sim/odometry", scene.odometry(n).model_copy(update={"pose": pose}))
    shared.observe("irm/global_irm", _difference(n + 1))
    if n % 10 == 0:
        grid = GridHeader(resolution_m=0.2, ix0=int(x_m / 0.2) - 50, iy0=-50, width=100, height=100)
        shared.observe("irm/coverage_window", CoverageWindow(stamp_ns=n, grid=grid, cell=np.roll(cell, n, 1)))
        shared.observe("reconciler/plan", scene.plan(5 * n))
        shared.observe("mission/state", scene.mission(10 * n))
        shared.observe("irm/coverage", scene.summary(10 * n))
        shared.observe("gcp/global_policy", scene.policy(10 * n))
        shared.observe("irm/health", scene.health("irm", pid=n, errors=n))
        answer = CommandAnswer(
            stamp_ns=n, command_id=f"c{n}", kind=CommandKind.PAUSE, accepted=True, reason="x" * 80,
            phase=MissionPhase.EXPLORE, fence_ids=[], fences_version=0,
        )  # fmt: skip
        shared.observe("mission/answer", answer)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_what_is_remembered_of_a_long_mission_is_bounded() -> None:
    """Margin: 1 MB between the 2,000th and the 4,000th update, of a core that holds a few."""
    config = Config(max_trajectory_points=500)
    shared = SharedStatus(config, "husky1")
    shared.read(lambda core, now_ns: setattr(core.events, "most", 100))
    shared.read(lambda core, now_ns: setattr(core.curve, "most", 100))
    shared.read(lambda core, now_ns: setattr(core.memory.step_times, "limit", 100))
    live, cell, held = LiveStatus(shared), scene.coverage_window(100).cell, []
    tracemalloc.start()
    try:
        for n in range(4_000):
            _feed(shared, n, cell)
            if n % 100 == 0:
                live._told_s = -1e9
                live.tick()
                live.board.frame(max(1, live.board.version - 50))
                live.board.frame(0)
            if n % 2000 == 1999:
                held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    nodes = shared.read(lambda core, now_ns: core.graph[1].node_id.size)
    print(f"\n{[f'{size / 1e6:.1f} MB' for size in held]}, {nodes} nodes, {len(live.board._parts)} parts")
    assert nodes == _CRUMBS + 2
    assert held[1] - held[0] < 1_000_000
    assert len(live.board._parts) < 600
    assert len(shared.snapshot()) < 2_000_000

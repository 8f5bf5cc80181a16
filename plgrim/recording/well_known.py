"""PLGRIM's messages as ROS 2 messages that every tool of the field knows: for recordings and for live viewing.

`Translator` gives, for each message, the ROS messages that show it. Stamps are of the mission clock; frames `map`,
`odom`, `base_link`, `lidar` (REP-105).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planning.graph_mirror import FRONTIER, GraphMirror
from plgrim.recording import ros
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS
from schemas.operation import JudgeReport, MissionState, StageHealth, WorldPicture
from schemas.policy import GlobalPolicy, LocalPolicy, Plan
from schemas.sensing import Odometry, PointCloud, PoseGraph, ReadyGrid
from schemas.world import CoverageSummary, CoverageWindow, GlobalIrm, LocalIrm, RiskMap

Shown = tuple[str, Any]
"""A channel's topic and a ROS message."""

PREFIX = "/plgrim/"
_COVERAGE_CELLS = np.array([-1, 30, 0, 100, 60], np.int8)
"""Of a coverage window: unknown, to be covered, covered, obstacle, out of reach."""
_WORLD_CELLS = np.array([100, 60, 30, 0], np.int8)
_ORANGE, _BLUE = (0.95, 0.5, 0.05, 1.0), (0.1, 0.4, 0.9, 0.6)
_NODES_PER_S = 2000
_LEVELS = {"info": 20, "warn": 30, "error": 40}


@dataclass(slots=True)
class Translator:
    """Translates messages one after the other; keeps the Global IRM, which comes as differences.

    cloud_period_ns: clouds are large; one every so often is enough to look at.
    """

    cloud_period_ns: int = SECOND_NS // 2
    _graph: GraphMirror = field(default_factory=GraphMirror)
    _cloud_ns: int = -SECOND_NS
    _graph_ns: int = 0
    _phase: str = ""
    _safety: str = ""
    _target: int = -2

    def __call__(self, message: Message) -> list[Shown]:
        """The ROS messages that show a message; none for what only the stages need."""
        translate = _TRANSLATORS.get(type(message))
        if translate is None:
            return []
        return [
            (PREFIX + name if not name.startswith("/") else name, shown)
            for name, shown in translate(self, message)
        ]

    def _cloud(self, m: PointCloud) -> Iterator[Shown]:
        if m.stamp_ns - self._cloud_ns < self.cloud_period_ns:
            return
        self._cloud_ns = m.stamp_ns
        yield "/tf", ros.transforms(m.stamp_ns, [("odom", "lidar", m.sensor_in_odom)])
        x, y, z = m.points_m.T
        yield "cloud", ros.point_cloud(m.stamp_ns, "lidar", {"x": x, "y": y, "z": z})

    def _odometry(self, m: Odometry) -> Iterator[Shown]:
        yield (
            "/tf",
            ros.transforms(m.stamp_ns, [("map", "odom", m.map_to_odom), ("odom", "base_link", m.pose)]),
        )
        yield "odometry", ros.odometry(m.stamp_ns, m.pose, m.speed_mps, m.turn_rate_radps, m.covariance)

    def _pose_graph(self, m: PoseGraph) -> Iterator[Shown]:
        yield "keyframes", ros.pose_array(m.stamp_ns, "map", m.pose_in_map)

    def _ready_grid(self, m: ReadyGrid) -> Iterator[Shown]:
        yield (
            "ready_grid",
            ros.grid(m.stamp_ns, "odom", m.resolution_m, m.origin_x_m, m.origin_y_m, m.occupancy),
        )

    def _risk_map(self, m: RiskMap) -> Iterator[Shown]:
        g = m.grid
        percent = np.where(m.state == 2, 100.0, 100.0 * (1.0 - np.exp(-m.hazard_cvar)))
        cells = np.where(m.state == 0, -1.0, np.clip(percent, 0.0, 100.0)).astype(np.int8)
        origin = (g.ix0 * g.resolution_m, g.iy0 * g.resolution_m)
        yield "risk", ros.grid(m.stamp_ns, "odom", g.resolution_m, *origin, cells)

    def _coverage_window(self, m: CoverageWindow) -> Iterator[Shown]:
        g = m.grid
        origin = (g.ix0 * g.resolution_m, g.iy0 * g.resolution_m)
        yield "coverage", ros.grid(m.stamp_ns, "map", g.resolution_m, *origin, _COVERAGE_CELLS[m.cell])

    def _world(self, m: WorldPicture) -> Iterator[Shown]:
        r = m.resolution_m
        yield "world", ros.grid(m.stamp_ns, "map", r, m.ix0 * r, m.iy0 * r, _WORLD_CELLS[m.cell])

    def _local_irm(self, m: LocalIrm) -> Iterator[Shown]:
        free = m.state == 1
        x, y = m.anchor_m[free].T
        columns = {
            "x": x,
            "y": y,
            "z": np.zeros(len(x)),
            "entropy": m.entropy[free],
            "coverage": m.coverage[free],
        }
        yield "local_irm", ros.point_cloud(m.stamp_ns, "odom", {**columns, "risk": m.node_risk[free]})

    def _global_irm(self, m: GlobalIrm) -> Iterator[Shown]:
        if not self._graph.apply(m):
            return
        graph = self._graph.road_map()
        if m.stamp_ns < self._graph_ns:
            return
        # Markers are objects, point by point: a large graph is shown less often.
        self._graph_ns = m.stamp_ns + int(SECOND_NS * len(graph.node_id) / _NODES_PER_S)
        source = np.repeat(np.arange(graph.node_id.size), np.diff(graph.indptr))
        once = source < graph.indices
        ends = np.stack([graph.xyz_m[source[once]], graph.xyz_m[graph.indices[once]]], axis=1).reshape(-1, 3)
        frontier = graph.kind == FRONTIER
        yield "global_irm", ros.markers(m.stamp_ns, "map", [
            ros.MarkerSpec("edges", ros.LINE_LIST, ends, 0.05, _BLUE),
            ros.MarkerSpec("breadcrumbs", ros.SPHERE_LIST, graph.xyz_m[~frontier], 0.3, _BLUE),
            ros.MarkerSpec("frontiers", ros.CUBE_LIST, graph.xyz_m[frontier], 0.5, _ORANGE),
        ])  # fmt: skip

    def _global_policy(self, m: GlobalPolicy) -> Iterator[Shown]:
        yield "global_path", ros.path(m.stamp_ns, "map", m.route_xyz_m)
        if m.target >= 0:
            x, y, z = m.target_xyz_m
            yield "target", ros.pose_stamped(m.stamp_ns, "map", Pose(x_m=x, y_m=y, z_m=z))
        if m.target != self._target:
            self._target = m.target
            yield "events", ros.log(m.stamp_ns, _LEVELS["info"], "gcp", m.reason)

    def _local_policy(self, m: LocalPolicy) -> Iterator[Shown]:
        yield "local_path", ros.path(m.stamp_ns, "odom", _flat(m.path_xy_m))

    def _plan(self, m: Plan) -> Iterator[Shown]:
        yield (
            "plan",
            ros.path(m.stamp_ns, "odom", np.stack([m.x_m, m.y_m, np.zeros(len(m.x_m))], 1), m.yaw_rad),
        )
        if m.safety.value != self._safety:
            self._safety = m.safety.value
            level = "info" if m.safety.value in ("run", "done", "return") else "warn"
            yield "events", ros.log(m.stamp_ns, _LEVELS[level], "reconciler", f"{m.safety.value}: {m.reason}")

    def _mission(self, m: MissionState) -> Iterator[Shown]:
        yield "distance_m", ros.number(m.distance_m)
        if m.phase.value != self._phase:
            self._phase = m.phase.value
            text = f"{m.phase.value}: {m.reason}" if m.reason else m.phase.value
            yield "events", ros.log(m.stamp_ns, _LEVELS["info"], "mission", text)

    def _coverage(self, m: CoverageSummary) -> Iterator[Shown]:
        yield "coverage_share", ros.number(m.covered_fraction)

    def _judge(self, m: JudgeReport) -> Iterator[Shown]:
        yield "true_pose", ros.pose_stamped(m.stamp_ns, "map", m.true_pose)
        yield "true_coverage_share", ros.number(m.coverage)

    def _health(self, m: StageHealth) -> Iterator[Shown]:
        level = 2 if m.last_error and not m.ready else 0 if m.ready and not m.waiting_for else 1
        text = "ready" if m.ready else m.last_error or "starting"
        if m.waiting_for:
            text += f", waits for {', '.join(m.waiting_for)}"
        values = {
            "rate_hz": f"{m.rate_hz:.2f}", "step_p50_ms": f"{m.step_p50_ms:.2f}", "step_p99_ms": f"{m.step_p99_ms:.2f}",
            "memory_mb": f"{m.memory_mb:.1f}", "errors": str(m.errors), "dropped": str(sum(m.dropped.values())),
        }  # fmt: skip
        yield "/diagnostics", ros.diagnostics(m.stamp_ns, m.service, level, text, values)


def _flat(xy_m: Any) -> Any:
    """Points (n, 2) on the ground as (n, 3)."""
    return np.column_stack([xy_m, np.zeros(len(xy_m))])


_Translate = Callable[[Translator, Any], Iterator[Shown]]
_TRANSLATORS: dict[type[Message], _Translate] = {
    PointCloud: Translator._cloud,
    Odometry: Translator._odometry,
    PoseGraph: Translator._pose_graph,
    ReadyGrid: Translator._ready_grid,
    RiskMap: Translator._risk_map,
    CoverageWindow: Translator._coverage_window,
    WorldPicture: Translator._world,
    LocalIrm: Translator._local_irm,
    GlobalIrm: Translator._global_irm,
    GlobalPolicy: Translator._global_policy,
    LocalPolicy: Translator._local_policy,
    Plan: Translator._plan,
    MissionState: Translator._mission,
    CoverageSummary: Translator._coverage,
    JudgeReport: Translator._judge,
    StageHealth: Translator._health,
}
